"""The last moment to brake, and what a warning at each earlier moment would have changed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.collisions.contact import Pair, contact_made, contact_times, pair_of
from deepaccident_devkit.collisions.outcomes import (
    BRAKINGS,
    MOST_MARGIN,
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
    known,
)
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

BRAKERS: Final = ("first", "second", "both")
"""The braking actors of the pair; the pair is in the meta file's order."""
MASKS: Final = ((True, False), (False, True), (True, True))
"""`BRAKERS` as `outcomes_of` takes them: whether each actor of the pair brakes."""
# Seconds between the tried starts of braking.
_SCAN_STEP_S: Final = 0.01
# Least angle between the headings at the end, radians.
_MIN_HEAD_ON_ANGLE_RAD: Final = 3 * math.pi / 4
# Metres of a gap that counts as contact. With other actors no contact was recorded, so no larger
# margin is needed.
_CONTACT_GAP_M: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LastMoments(FrozenArrays):
    """The last moments to brake of N ways to brake; arrays are read-only.

    Attributes:
        time: Latest start of a braking that avoids the accident, shape (N,), seconds from the first
            frame; NaN if no start does.
        switches: Number of changes of the answer from one tried start to the next, shape (N,). With
            more than one, braking a little earlier than the last moment can be worse than braking
            at it, for example if one actor passes behind the other.
        extrapolated: Whether no start avoids the accident although some start avoids it until the
            recording ends, shape (N,). The contact is then part of the continuation, in which the
            other actor goes straight on.
    """

    time: FloatArray
    switches: IntArray
    extrapolated: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondaryContact:
    """A contact of the pair with another actor, in a replay only and not in the recording.

    The other actor keeps its recorded motion, though a driver would react: the contact is a hint,
    not an outcome.

    Attributes:
        replay: Number of the replay.
        actor_id: CARLA id of the actor of the pair.
        other_id: CARLA id of the other actor.
        category: Class of the other actor.
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
    """When braking could have avoided an accident, and what warnings would have changed.

    Arrays are read-only.

    Attributes:
        accident: Recorded motion.
        check: Replay in which nobody brakes.
        brakings: The K ways to brake after a warning.
        decelerations: Decelerations of `brakings`, shape (D,), m/s², ascending.
        last_moments: One value for each of `BRAKERS` and each deceleration, row by row (3 · D).
        leads: Seconds from a warning to the end of the recording, shape (L,): 0, 0.1, …
        outcomes: For each of `BRAKERS`, what the L warnings make of the accident in K ways.
        secondary: Contacts with other actors in the replays in which the braking begins at the last
            moment; their `replay` is the position in `last_moments`.
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

        It is NaN if nothing avoids the accident.
        """
        seconds = self.accident.duration - self.last_moments.time
        return np.reshape(seconds, (len(BRAKERS), -1))

    @property
    def head_on(self) -> bool:
        """Whether the pair meets head-on.

        If only one of the two brakes, the outcome then depends on how the other goes on.
        """
        first_yaw, second_yaw = self.accident.paths[:, -1, 2]
        angle = math.remainder(float(first_yaw - second_yaw), 2 * math.pi)
        return abs(angle) >= _MIN_HEAD_ON_ANGLE_RAD

    @property
    def pedestrian(self) -> bool:
        """Whether one of the pair is a pedestrian: a pedestrian cannot answer by braking."""
        return "pedestrian" in self.accident.categories

    def to_dict(self, *, warnings: bool = True) -> dict[str, Any]:
        """Return values for JSON; None for what does not exist.

        Args:
            warnings: Whether to include what each warning changes, about a thousand values.
        """
        accident = self.accident
        actors = zip(
            accident.actor_ids,
            accident.categories,
            accident.agents,
            accident.masses.tolist(),
            strict=True,
        )
        keys = ("actor_id", "category", "agent", "mass")
        result: dict[str, Any] = {
            "scenario": accident.scenario,
            "actors": [dict(zip(keys, actor, strict=True)) for actor in actors],
            "duration": round(accident.duration, 1),
            "head_on": self.head_on,
            "pedestrian": self.pedestrian,
            "recorded": self._recorded(),
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
                "last_moment": known(moments.time[row], 2),
                "slack": known(self.slack.flat[row], 2),
                "switches": int(moments.switches[row]),
                "extrapolated": bool(moments.extrapolated[row]),
                "secondary": self._secondary_rows(row),
            }

    def _secondary_rows(self, replay: int) -> list[dict[str, Any]]:
        rows = []
        for contact in self.secondary:
            if contact.replay == replay:
                rows.append(
                    {
                        "actor_id": contact.actor_id,
                        "other_id": contact.other_id,
                        "category": contact.category,
                        "time": round(contact.time, 3),
                        "extrapolated": contact.extrapolated,
                    }
                )
        return rows

    def _recorded(self) -> dict[str, Any]:
        return {
            "margin": self.check.margin,
            "time": round(self.check.time, 6),
            "speeds": known(self.check.speeds, 3),
            "delta_v": known(self.check.delta_v, 3),
            "delta_v_ranges": known(delta_v_ranges(self.accident.masses, self.relative_speed), 3),
        }

    @property
    def relative_speed(self) -> float:
        """Relative speed of the pair at the recorded contact, m/s."""
        return float(self.check.delta_v.sum())  # the shares of the two add up to 1

    def _warning_rows(self) -> Iterator[dict[str, Any]]:
        for brakers, outcomes in zip(BRAKERS, self.outcomes, strict=True):
            for column, braking in enumerate(self.brakings):
                yield {
                    "brakers": brakers,
                    "reaction": braking.reaction,
                    "deceleration": braking.deceleration,
                    "outcome": [OUTCOMES[code] for code in outcomes.outcome[:, column]],
                    "extrapolated": outcomes.extrapolated[:, column].tolist(),
                    "speeds": known(outcomes.speeds[:, column], 3),
                    "delta_v": known(outcomes.delta_v[:, column], 3),
                    "reduction": known(outcomes.reduction[:, column], 3),
                }


def last_moments(pair: Pair, brakers: tuple[bool, bool], decelerations: ArrayLike) -> LastMoments:
    """Return the last moments to brake with decelerations (N,) m/s².

    Each hundredth of a second is tried, because the answer may change more than once.
    """
    values = checked("decelerations", decelerations, (None,))
    count = len(values)
    scan = np.arange(round(pair.duration / _SCAN_STEP_S) + 1) * _SCAN_STEP_S
    starts = np.where(brakers, np.tile(scan, count)[:, None], np.inf)
    repeated = np.repeat(values, len(scan))
    avoids = ~contact_made(pair, starts, repeated).reshape(count, -1)
    possible = avoids.any(axis=1)
    latest = len(scan) - 1 - np.argmax(avoids[:, ::-1], axis=1)
    extrapolated = np.zeros(count, dtype=bool)
    rows = np.flatnonzero(np.repeat(~possible, len(scan)))
    recorded = (0.0, pair.duration)
    touches = contact_made(pair, starts[rows], repeated[rows], window=recorded)
    extrapolated[~possible] = (~touches).reshape(-1, len(scan)).any(axis=1)
    switches = np.count_nonzero(np.diff(avoids, axis=1), axis=1)
    return LastMoments(
        time=np.where(possible, scan[latest], np.nan),
        switches=switches.astype(np.int64),
        extrapolated=extrapolated,
    )


def unusable(accident: Accident, check: ReplayCheck) -> str:
    """Return in words why an accident with a failed check cannot be replayed."""
    first, second = accident.actor_ids
    return (
        f"{accident.scenario}: the outlines of {first} and {second} are {check.margin:.2f} m apart "
        f"at their last frame, more than {MOST_MARGIN:g} m: "
        "the recording does not show the accident"
    )


def avoidability_of(
    accident: Accident,
    tracks: ScenarioTracks | None = None,
    *,
    brakings: Sequence[Braking] = BRAKINGS,
) -> Avoidability:
    """Return when braking could have avoided an accident.

    Args:
        accident: Recorded motion.
        tracks: Tracks of all actors of its scenario, for contacts with actors outside the pair;
            None to leave these out.
        brakings: Ways to brake after a warning.

    Raises:
        NotAvailableError: The gap between the two at the last frame is so large that the recording
            does not show the accident.
    """
    check = undisturbed(accident)
    if not check.usable:
        raise NotAvailableError(unusable(accident, check))
    pair = pair_of(accident.paths, accident.sizes)
    decelerations = np.unique([braking.deceleration for braking in brakings])
    scans = [last_moments(pair, brakers, decelerations) for brakers in MASKS]
    columns = {}
    for name in LastMoments.__slots__:
        columns[name] = np.concatenate([getattr(scan, name) for scan in scans])
    moments = LastMoments(**columns)
    leads = as_floats(np.arange(accident.paths.shape[1]) * FRAME_PERIOD)
    warnings = accident.duration - leads
    first, second, both = (
        outcomes_of(accident, brakers, warnings, brakings=brakings) for brakers in MASKS
    )
    return Avoidability(
        accident=accident,
        check=check,
        brakings=tuple(brakings),
        decelerations=decelerations,
        last_moments=moments,
        leads=leads,
        outcomes=(first, second, both),
        secondary=() if tracks is None else _secondary(accident, tracks, moments, decelerations),
    )


def avoidability(
    dataset: Dataset, scenario: RowArgument, *, brakings: Sequence[Braking] = BRAKINGS
) -> Avoidability | None:
    """Return when braking could have avoided a scenario's accident.

    It is None if the meta file names no collision.

    Args:
        dataset: The release.
        scenario: Token or record.
        brakings: Ways to brake after a warning.

    Raises:
        TokenError: No such scenario.
        NotAvailableError: The scenario lacks labels or meta, or its labels do not show the
            accident.
    """
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    return avoidability_of(accident, scenario_tracks(dataset, scenario), brakings=brakings)


def _secondary(
    accident: Accident, tracks: ScenarioTracks, moments: LastMoments, decelerations: FloatArray
) -> tuple[SecondaryContact, ...]:
    """Return contacts with other actors in replays that avoid the accident at the last moment."""
    brakes = np.repeat(np.array(MASKS), len(decelerations), axis=0)
    moment = moments.time[:, None]
    starts = np.where(brakes & np.isfinite(moment), moment, np.inf)
    repeated = np.tile(decelerations, len(MASKS))
    return tuple(secondary_contacts(accident, tracks, starts, repeated))


@dataclass(frozen=True, slots=True)
class _Other:
    """An actor outside the pair.

    Attributes:
        actor_id: CARLA id.
        category: Class.
        path: Path at the accident's frames.
        size: Length and width, shape (2,), metres.
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
    """Return first contacts of the pair with other actors in N replays, by replay, then by time.

    Contacts that the recording has too are left out, and so are actors that labels show at one
    frame only: they have no motion.

    Args:
        accident: Recorded motion.
        tracks: Tracks of all actors of the scenario.
        starts: Seconds at which each of the pair begins to brake, shape (N, 2); inf if it does not.
        decelerations: Decelerations of the replays, shape (N,), m/s².
    """
    contacts = []
    for other, member in product(_others(accident, tracks), (0, 1)):
        rows = np.flatnonzero(np.isfinite(starts[:, member]))
        if not len(rows) or not _may_meet(accident.paths[member], accident.sizes[member], other):
            continue
        times = _new_contacts(accident, member, other, starts[rows], decelerations[rows])
        for row, time in zip(rows, times, strict=True):
            if np.isfinite(time):
                contacts.append(
                    SecondaryContact(
                        replay=int(row),
                        actor_id=accident.actor_ids[member],
                        other_id=other.actor_id,
                        category=other.category,
                        time=float(time),
                        extrapolated=bool(time > accident.duration),
                    )
                )
    return sorted(contacts, key=lambda contact: (contact.replay, contact.time, contact.other_id))


def _new_contacts(
    accident: Accident, member: int, other: _Other, starts: FloatArray, decelerations: FloatArray
) -> FloatArray:
    """Return seconds at which one of the pair touches another actor in N replays, shape (N,).

    They are inf if the two never touch, or touch in the recording too.
    """
    paths = np.stack([accident.paths[member], other.path])
    pair = pair_of(paths, [accident.sizes[member, :2], other.size], margin=_CONTACT_GAP_M)
    # one row for each replay, and a last one for the recording
    pair_starts = np.full((len(starts) + 1, 2), np.inf)
    pair_starts[:-1, 0] = starts[:, member]
    times = contact_times(pair, pair_starts, np.append(decelerations, 1.0), window=other.window)
    if times[-1] > accident.duration:
        return times[:-1]
    return np.full(len(starts), np.inf)


def _others(accident: Accident, tracks: ScenarioTracks) -> Iterator[_Other]:
    frames = np.arange(accident.first_frame, accident.last_frame + 1)
    within = (tracks.index >= frames[0]) & (tracks.index <= frames[-1])
    for actor in np.unique(tracks.actor_id[within]).tolist():
        rows = np.flatnonzero(within & (tracks.actor_id == actor))
        if actor not in accident.actor_ids and len(rows) >= 2:
            yield _other(tracks, rows, frames)


def _other(tracks: ScenarioTracks, rows: IntArray, frames: IntArray) -> _Other:
    start, end = ((tracks.index[row] - frames[0]) * FRAME_PERIOD for row in (rows[0], rows[-1]))
    if tracks.index[rows[-1]] == frames[-1]:
        end = end + HORIZON
    return _Other(
        actor_id=int(tracks.actor_id[rows[0]]),
        category=CATEGORIES[int(tracks.boxes.category[rows[-1]])],
        path=recorded_path(tracks, rows, frames),
        size=np.median(tracks.boxes.size[rows, :2], axis=0),
        window=(float(start), float(end)),
    )


def _may_meet(path: FloatArray, size: FloatArray, other: _Other) -> bool:
    """Return whether the two can touch at all.

    A braking actor is where it was recorded, or earlier on its path.
    """
    positions, other_positions = _positions(path), _positions(other.path)
    offsets = positions[:, None] - other_positions[None]
    distances = np.hypot(*offsets.transpose(2, 0, 1))
    steps = _longest_step(positions) + _longest_step(other_positions)
    max_distance = (np.hypot(*size[:2]) + np.hypot(*other.size)) / 2 + steps
    not_ahead = np.arange(len(positions))[:, None] <= np.arange(len(other_positions)) + 1
    return bool((not_ahead & (distances <= max_distance)).any())


def _longest_step(positions: FloatArray) -> Any:
    steps = np.diff(positions, axis=0)
    return np.hypot(*steps.T).max()


def _positions(path: FloatArray) -> FloatArray:
    """Return positions at each frame of the recording and of its continuation."""
    count = round(HORIZON / FRAME_PERIOD)
    last_step = path[-1, :2] - path[-2, :2]
    steps = np.arange(1, count + 1)[:, None]
    continuation = path[-1, :2] + steps * last_step
    return np.concatenate([path[:, :2], continuation])
