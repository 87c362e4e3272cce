"""The last moment to brake, and what an earlier warning would have changed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.collisions.contact import Pair, contact_times, has_contact, pair_of
from deepaccident_devkit.collisions.outcomes import (
    BRAKINGS,
    MAX_END_GAP_M,
    OUTCOMES,
    Braking,
    Outcomes,
    ReplayCheck,
    delta_v_ranges,
    outcomes_of,
    undisturbed,
)
from deepaccident_devkit.collisions.recorded import Accident, accident_of, recorded_path
from deepaccident_devkit.collisions.replay import HORIZON
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    as_floats,
    checked,
    json_numbers,
)
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

BRAKERS = ("first", "second", "both")
"""Which of the two colliders brakes; the meta file determines their order."""
MASKS = ((True, False), (False, True), (True, True))
"""`BRAKERS` as masks for `outcomes_of`: whether each of the two colliders brakes."""
# Time between two successive candidate times at which braking begins.
_SCAN_STEP_S = 0.01
# Smallest angle between the final headings of two colliders that counts as head-on.
_MIN_HEAD_ON_ANGLE_RAD = 3 * math.pi / 4
# Largest gap that counts as contact. Contacts with other actors were not recorded, so no tolerance
# for label errors is needed.
_CONTACT_GAP_M = 1e-9
# Values that can be written as JSON.
_JsonObject = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LastMoments(FrozenArrays):
    """The last moments to brake for N cases; arrays are read-only.

    Attributes:
        time: Latest start of braking that avoids the accident, in seconds from the first frame,
            shape (N,); NaN if no start avoids it.
        switches: How often the answer changes from one candidate start to the next, shape (N,). If
            more than once, braking a little earlier than the last moment can be worse than braking
            at it, for example if one actor then no longer passes behind the other.
        extrapolated: Whether some start avoids the accident until the recording ends, but none
            avoids it altogether, shape (N,). Contact then happens in the extrapolation, in which
            the other actor goes straight on.
    """

    time: FloatArray
    switches: IntArray
    extrapolated: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondaryContact:
    """A contact of a collider with a third actor, in a replay but not in the recording.

    The third actor keeps its recorded motion, although a driver would react. The contact is thus a
    hint, not an outcome.

    Attributes:
        replay: Index of the replay.
        actor_id: CARLA id of the collider.
        other_id: CARLA id of the third actor.
        category: Class of the third actor.
        time: Seconds from the first frame of the accident.
        extrapolated: Whether the contact is after the end of the recording.
    """

    replay: int
    actor_id: int
    other_id: int
    category: str
    time: float
    extrapolated: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Avoidability(FrozenArrays):
    """When braking could have avoided an accident, and what a warning would have changed.

    Arrays are read-only.

    Attributes:
        accident: Recorded motion.
        check: Replay without any braking.
        brakings: The K ways to brake after a warning.
        decelerations: Decelerations of `brakings` in m/s², shape (D,), ascending.
        last_moments: One value for each of `BRAKERS` and deceleration (3 · D, row by row).
        leads: Seconds from a warning to the end of the recording, shape (L,): 0, 0.1, …
        outcomes: For each of `BRAKERS`, the accident's outcomes for L warnings and K ways to brake.
        secondary: Contacts with third actors in the replays in which braking begins at the last
            moment; their `replay` is an index into `last_moments`.
    """

    accident: Accident
    check: ReplayCheck
    brakings: tuple[Braking, ...]
    decelerations: FloatArray
    last_moments: LastMoments
    leads: FloatArray
    outcomes: tuple[Outcomes, Outcomes, Outcomes]
    secondary: tuple[SecondaryContact, ...]

    @property
    def slack(self) -> FloatArray:
        """Seconds from the last moment to brake to the end of the recording, shape (3, D).

        It is NaN where no braking avoids the accident.
        """
        seconds = self.accident.duration - self.last_moments.time
        return np.reshape(seconds, (len(BRAKERS), -1))

    @property
    def head_on(self) -> bool:
        """Whether the two collide head-on.

        If only one of them brakes, the outcome then depends on how the other continues.
        """
        first_yaw, second_yaw = self.accident.paths[:, -1, 2].tolist()
        angle = math.remainder(first_yaw - second_yaw, 2 * math.pi)
        return abs(angle) >= _MIN_HEAD_ON_ANGLE_RAD

    @property
    def pedestrian(self) -> bool:
        """Whether one of the colliders is a pedestrian, who cannot brake like a vehicle."""
        return "pedestrian" in self.accident.categories

    def to_dict(self, *, warnings: bool = True) -> dict[str, Any]:
        """Return the values for JSON; None for values that do not exist.

        Args:
            warnings: Whether to include what each warning changes (about a thousand values).
        """
        accident = self.accident
        actors = []
        for member, mass in enumerate(accident.masses.tolist()):
            actors.append(
                {
                    "actor_id": accident.actor_ids[member],
                    "category": accident.categories[member],
                    "agent": accident.agents[member],
                    "mass": mass,
                }
            )
        result: _JsonObject = {
            "scenario": accident.scenario,
            "actors": actors,
            "duration": round(accident.duration, 1),
            "head_on": self.head_on,
            "pedestrian": self.pedestrian,
            "recorded": self._describe_recorded(),
            "last_moments": list(self.last_moment_rows()),
        }
        if warnings:
            result["leads"] = [round(lead, 1) for lead in self.leads.tolist()]
            result["warnings"] = list(self._warning_rows())
        return result

    def last_moment_rows(self) -> Iterator[dict[str, Any]]:
        """Yield the last moment to brake, with its facts, for `BRAKERS` and each deceleration."""
        moments = self.last_moments
        ways = product(BRAKERS, self.decelerations.tolist())
        for row, (brakers, deceleration) in enumerate(ways):
            yield {
                "brakers": brakers,
                "deceleration": deceleration,
                "avoidable": bool(np.isfinite(moments.time[row])),
                "last_moment": json_numbers(moments.time[row], 2),
                "slack": json_numbers(self.slack.flat[row], 2),
                "switches": int(moments.switches[row]),
                "extrapolated": bool(moments.extrapolated[row]),
                "secondary": self._secondary_rows(row),
            }

    def _secondary_rows(self, replay: int) -> list[_JsonObject]:
        rows = []
        for contact in self.secondary:
            if contact.replay == replay:
                row = {
                    "actor_id": contact.actor_id,
                    "other_id": contact.other_id,
                    "category": contact.category,
                    "time": round(contact.time, 3),
                    "extrapolated": contact.extrapolated,
                }
                rows.append(row)
        return rows

    def _describe_recorded(self) -> _JsonObject:
        ranges = delta_v_ranges(self.accident.masses, self.relative_speed)
        return {
            "margin": self.check.margin,
            "time": round(self.check.time, 6),
            "speeds": json_numbers(self.check.speeds, 3),
            "delta_v": json_numbers(self.check.delta_v, 3),
            "delta_v_ranges": json_numbers(ranges, 3),
        }

    @property
    def relative_speed(self) -> float:
        """Relative speed of the two at the recorded contact, in m/s."""
        return float(self.check.delta_v.sum())  # the two fractions of it add up to 1

    def _warning_rows(self) -> Iterator[_JsonObject]:
        for brakers, outcomes in zip(BRAKERS, self.outcomes, strict=True):
            for column, braking in enumerate(self.brakings):
                yield {
                    "brakers": brakers,
                    "reaction": braking.reaction,
                    "deceleration": braking.deceleration,
                    "outcome": [OUTCOMES[code] for code in outcomes.outcome[:, column]],
                    "extrapolated": outcomes.extrapolated[:, column].tolist(),
                    "speeds": json_numbers(outcomes.speeds[:, column], 3),
                    "delta_v": json_numbers(outcomes.delta_v[:, column], 3),
                    "reduction": json_numbers(outcomes.reduction[:, column], 3),
                }


def last_moments(pair: Pair, brakers: tuple[bool, bool], decelerations: ArrayLike) -> LastMoments:
    """Find the last moments to brake for decelerations (N,) in m/s².

    All candidates, 0.01 s apart, are tried, because the answer may change more than once.
    """
    values = checked("decelerations", decelerations, (None,))
    count = len(values)
    tried_starts = np.arange(round(pair.duration / _SCAN_STEP_S) + 1) * _SCAN_STEP_S
    num_tried = len(tried_starts)
    starts = np.where(brakers, np.tile(tried_starts, count)[:, None], np.inf)
    repeated_values = np.repeat(values, num_tried)
    avoids = ~has_contact(pair, starts, repeated_values).reshape(count, -1)
    is_possible = avoids.any(axis=1)
    latest = num_tried - 1 - np.argmax(avoids[:, ::-1], axis=1)
    rows = np.flatnonzero(np.repeat(~is_possible, num_tried))
    recorded = (0.0, pair.duration)
    touches = has_contact(pair, starts[rows], repeated_values[rows], window=recorded)
    extrapolated = np.zeros(count, dtype=bool)
    extrapolated[~is_possible] = (~touches).reshape(-1, num_tried).any(axis=1)
    switches = np.count_nonzero(np.diff(avoids, axis=1), axis=1)
    return LastMoments(
        time=np.where(is_possible, tried_starts[latest], np.nan),
        switches=switches.astype(np.int64),
        extrapolated=extrapolated,
    )


def unusable(accident: Accident, check: ReplayCheck) -> str:
    """Explain why an accident whose replay check failed cannot be replayed."""
    first, second = accident.actor_ids
    return (
        f"{accident.scenario}: the outlines of {first} and {second} are {check.margin:.2f} m apart "
        f"at their last frame, more than {MAX_END_GAP_M:g} m: "
        "the recording does not show the accident"
    )


def avoidability_of(
    accident: Accident,
    tracks: ScenarioTracks | None = None,
    *,
    brakings: Sequence[Braking] = BRAKINGS,
) -> Avoidability:
    """Find out when braking could have avoided an accident.

    Args:
        accident: Recorded motion.
        tracks: Tracks of all actors in the scenario, to find contacts with third actors; None to
            skip these.
        brakings: Ways to brake after a warning.

    Raises:
        NotAvailableError: If the two are so far apart in the last frame that the recording does
            not show the accident.
    """
    check = undisturbed(accident)
    if not check.usable:
        raise NotAvailableError(unusable(accident, check))
    pair = pair_of(accident.paths, accident.sizes)
    decelerations = np.unique([braking.deceleration for braking in brakings])
    scans = [last_moments(pair, brakers, decelerations) for brakers in MASKS]
    moments = LastMoments(
        time=np.concatenate([scan.time for scan in scans]),
        switches=np.concatenate([scan.switches for scan in scans]),
        extrapolated=np.concatenate([scan.extrapolated for scan in scans]),
    )
    leads = as_floats(np.arange(accident.paths.shape[1]) * FRAME_PERIOD)
    warnings = accident.duration - leads
    first, second, joint = (
        outcomes_of(accident, brakers, warnings, brakings=brakings) for brakers in MASKS
    )
    contacts: list[SecondaryContact] = []
    if tracks is not None:
        # In each replay, braking begins at that replay's last moment.
        times = moments.time[:, None]
        brakes = np.repeat(np.array(MASKS), len(decelerations), axis=0)
        starts = np.where(brakes & np.isfinite(times), times, np.inf)
        repeated_decelerations = np.tile(decelerations, len(MASKS))
        contacts = secondary_contacts(accident, tracks, starts, repeated_decelerations)
    return Avoidability(
        accident=accident,
        check=check,
        brakings=tuple(brakings),
        decelerations=decelerations,
        last_moments=moments,
        leads=leads,
        outcomes=(first, second, joint),
        secondary=tuple(contacts),
    )


def avoidability(
    dataset: Dataset, scenario: RowArgument, *, brakings: Sequence[Braking] = BRAKINGS
) -> Avoidability | None:
    """Find out when braking could have avoided a scenario's accident; None without a collision.

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.
        brakings: Ways to brake after a warning.

    Raises:
        TokenError: If the release has no such scenario.
        NotAvailableError: If the scenario lacks labels or meta, or its labels do not show the
            accident.
    """
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    return avoidability_of(accident, scenario_tracks(dataset, scenario), brakings=brakings)


@dataclass(frozen=True, slots=True)
class _OtherActor:
    """An actor that is not one of the two colliders.

    Attributes:
        actor_id: CARLA id.
        category: Class.
        path: Path in the accident's frames.
        size: Length and width in metres, shape (2,).
        window: First and last second in which labels show the actor.
    """

    actor_id: int
    category: str
    path: FloatArray
    size: FloatArray
    window: tuple[float, float]


def secondary_contacts(
    accident: Accident, tracks: ScenarioTracks, starts: FloatArray, decelerations: FloatArray
) -> list[SecondaryContact]:
    """Find the colliders' first contacts with third actors in N replays.

    They are sorted by replay, then by time. Contacts that also happen in the recording are left
    out, and so are actors that are labelled in one frame only: their motion is unknown.

    Args:
        accident: Recorded motion.
        tracks: Tracks of all actors of the scenario.
        starts: Seconds at which each collider begins to brake, shape (N, 2); inf if it does not.
        decelerations: Decelerations in the replays in m/s², shape (N,).
    """
    contacts = []
    for other, member in product(_other_actors(accident, tracks), (0, 1)):
        rows = np.flatnonzero(np.isfinite(starts[:, member]))
        if not len(rows) or not _may_meet(accident.paths[member], accident.sizes[member], other):
            continue
        times = _first_contact_times(accident, member, other, starts[rows], decelerations[rows])
        for row, time in zip(rows, times, strict=True):
            if np.isfinite(time):
                contact = SecondaryContact(
                    replay=int(row),
                    actor_id=accident.actor_ids[member],
                    other_id=other.actor_id,
                    category=other.category,
                    time=float(time),
                    extrapolated=bool(time > accident.duration),
                )
                contacts.append(contact)
    return sorted(contacts, key=lambda contact: (contact.replay, contact.time, contact.other_id))


def _first_contact_times(
    accident: Accident,
    member: int,
    other: _OtherActor,
    starts: FloatArray,
    decelerations: FloatArray,
) -> FloatArray:
    """Return when one collider first touches a third actor in N replays, in seconds, shape (N,).

    Times are inf if the two never touch, or also touch in the recording.
    """
    paths = np.stack([accident.paths[member], other.path])
    pair = pair_of(paths, [accident.sizes[member, :2], other.size], margin=_CONTACT_GAP_M)
    # The additional last row is the recording.
    pair_starts = np.full((len(starts) + 1, 2), np.inf)
    pair_starts[:-1, 0] = starts[:, member]
    times = contact_times(pair, pair_starts, np.append(decelerations, 1.0), window=other.window)
    if times[-1] > accident.duration:
        return times[:-1]
    return np.full(len(starts), np.inf)


def _other_actors(accident: Accident, tracks: ScenarioTracks) -> Iterator[_OtherActor]:
    """Yield all actors, except the colliders, that are labelled in at least two frames."""
    frames = np.arange(accident.first_frame, accident.last_frame + 1)
    is_within = (tracks.index >= frames[0]) & (tracks.index <= frames[-1])
    for actor in np.unique(tracks.actor_id[is_within]).tolist():
        rows = np.flatnonzero(is_within & (tracks.actor_id == actor))
        if actor in accident.actor_ids or len(rows) < 2:
            continue
        first_row = rows[0]
        last_row = rows[-1]
        start = (tracks.index[first_row] - frames[0]) * FRAME_PERIOD
        end = (tracks.index[last_row] - frames[0]) * FRAME_PERIOD
        # An actor that is still labelled at the impact can be hit in the continuation after it.
        if tracks.index[last_row] == frames[-1]:
            end = end + HORIZON
        yield _OtherActor(
            actor_id=actor,
            category=CATEGORIES[int(tracks.boxes.category[last_row])],
            path=recorded_path(tracks, rows, frames),
            size=np.median(tracks.boxes.size[rows, :2], axis=0),
            window=(float(start), float(end)),
        )


def _may_meet(path: FloatArray, size: FloatArray, other: _OtherActor) -> bool:
    """Return whether a collider and a third actor can touch at all.

    When it brakes, the collider is where it was recorded, or further back on its path.
    """
    positions = _extended_positions(path)
    other_positions = _extended_positions(other.path)
    offsets = positions[:, None] - other_positions
    distances = np.hypot(offsets[..., 0], offsets[..., 1])
    sum_of_diagonals = np.hypot(*size[:2]) + np.hypot(*other.size)
    steps = _longest_step(positions) + _longest_step(other_positions)
    is_near = distances <= sum_of_diagonals / 2 + steps
    frames = np.arange(len(positions))
    other_frames = np.arange(len(other_positions))
    is_not_ahead = frames[:, None] <= other_frames + 1
    return bool((is_not_ahead & is_near).any())


def _longest_step(positions: FloatArray) -> Any:
    steps = np.diff(positions, axis=0)
    return np.hypot(*steps.T).max()


def _extended_positions(path: FloatArray) -> FloatArray:
    """Return the positions in each frame of the recording, and of its straight continuation."""
    count = round(HORIZON / FRAME_PERIOD)
    positions = path[:, :2]
    last_step = positions[-1] - positions[-2]
    steps = np.arange(1, count + 1)[:, None]
    continuation = positions[-1] + steps * last_step
    return np.concatenate([positions, continuation])
