"""When it was too late: the last moment to brake, and what a warning at each earlier moment would have changed."""

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
"""Who of the pair brakes; the pair is in the meta file's order."""
MASKS: Final = ((True, False), (False, True), (True, True))
"""The same as `outcomes_of` takes it."""
# Seconds between the starts of braking that are tried.
_SCAN_STEP: Final = 0.01
# Least angle between the headings at the end, radians.
_HEAD_ON: Final = 3 * math.pi / 4
# Metres of a gap that counts as contact: of others no contact is recorded that would need a margin.
_NO_GAP: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LastMoments(FrozenArrays):
    """The last moments to brake of N ways to brake; arrays are read-only.

    Attributes:
        time: (N,) seconds from the first frame: the latest start of a braking that avoids the accident; NaN if none
            does.
        switches: (N,) how often the answer changes from one tried start to the next. More than once: braking a little
            earlier than the last moment can be worse than it, as when one passes behind the other.
        extrapolated: (N,) whether no start avoids the accident, but some start does until the recording ends: the
            contact is one of the continuation, in which the other goes straight on.
    """

    time: FloatArray
    switches: IntArray
    extrapolated: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondaryContact:
    """One of the pair touches another actor in a replay, and did not in the recording.

    The other's motion stays as recorded, though a driver would react: these are no outcomes, but a hint.

    Attributes:
        replay: number of the replay.
        actor_id: CARLA id of the one of the pair.
        other_id: the other's.
        category: the other's class.
        time: seconds from the first frame of the accident.
        extrapolated: whether it is after the end of the recording.
    """

    replay: int
    actor_id: int
    other_id: int
    category: str
    time: float
    extrapolated: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Avoidability(FrozenArrays):
    """When an accident could have been avoided by braking, and what warnings would have changed. Arrays are read-only.

    Attributes:
        accident: the recorded motion.
        check: the replay in which nobody brakes.
        brakings: the K ways to brake after a warning.
        decelerations: (D,) m/s², those of `brakings`, ascending.
        last_moments: one value for each of `BRAKERS` and each deceleration, row by row (3 · D).
        leads: (L,) seconds from a warning to the end of the recording: 0, 0.1, …
        outcomes: for each of `BRAKERS` what the L warnings make of the accident in K ways.
        secondary: contacts with others in the replays in which the braking begins at the last moment; their `replay`
            is the position in `last_moments`.
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
        """(3, D) seconds from the last moment to brake to the end of the recording; NaN if nothing avoids it."""
        return np.reshape(self.accident.duration - self.last_moments.time, (len(BRAKERS), -1))

    @property
    def head_on(self) -> bool:
        """Whether they meet head-on, where one who brakes alone depends on how the other goes on."""
        first, second = self.accident.paths[:, -1, 2]
        return abs(math.remainder(float(first - second), 2 * math.pi)) >= _HEAD_ON

    @property
    def pedestrian(self) -> bool:
        """Whether one of them walks: braking is no answer that a pedestrian gives."""
        return "pedestrian" in self.accident.categories

    def to_dict(self, *, warnings: bool = True) -> dict[str, Any]:
        """Values for JSON; None for what does not exist.

        Args:
            warnings: whether to give what each warning changes, some thousand values.
        """
        accident = self.accident
        actors = zip(
            accident.actor_ids,
            accident.categories,
            accident.agents,
            accident.masses.tolist(),
            strict=True,
        )
        result: dict[str, Any] = {
            "scenario": accident.scenario,
            "actors": [
                dict(zip(("actor_id", "category", "agent", "mass"), each, strict=True))
                for each in actors
            ],
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
        """For each of `BRAKERS` and each deceleration the last moment to brake, and what comes with it."""
        moments = self.last_moments
        for row, (brakers, deceleration) in enumerate(
            product(BRAKERS, self.decelerations.tolist())
        ):
            yield {
                "brakers": brakers,
                "deceleration": deceleration,
                "avoidable": bool(np.isfinite(moments.time[row])),
                "last_moment": known(moments.time[row], 2),
                "slack": known(self.slack.flat[row], 2),
                "switches": int(moments.switches[row]),
                "extrapolated": bool(moments.extrapolated[row]),
                "secondary": [
                    {
                        "actor_id": each.actor_id,
                        "other_id": each.other_id,
                        "category": each.category,
                        "time": round(each.time, 3),
                        "extrapolated": each.extrapolated,
                    }
                    for each in self.secondary
                    if each.replay == row
                ],
            }

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
        """m/s between the two at the recorded contact."""
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
    """The last moments to brake with decelerations (N,) m/s²: each hundredth of a second is tried.

    The answer may change more than once.
    """
    hard = checked("decelerations", decelerations, (None,))
    tried = np.arange(round(pair.duration / _SCAN_STEP) + 1) * _SCAN_STEP
    starts = np.where(brakers, np.tile(tried, len(hard))[:, None], np.inf)
    each = np.repeat(hard, len(tried))
    avoids = ~contact_made(pair, starts, each).reshape(len(hard), -1)
    possible = avoids.any(axis=1)
    last = len(tried) - 1 - np.argmax(avoids[:, ::-1], axis=1)
    extrapolated = np.zeros(len(hard), dtype=bool)
    rows = np.flatnonzero(np.repeat(~possible, len(tried)))
    until_the_end = contact_made(pair, starts[rows], each[rows], window=(0.0, pair.duration))
    extrapolated[~possible] = (~until_the_end).reshape(-1, len(tried)).any(axis=1)
    return LastMoments(
        time=np.where(possible, tried[last], np.nan),
        switches=np.count_nonzero(np.diff(avoids, axis=1), axis=1).astype(np.int64),
        extrapolated=extrapolated,
    )


def unusable(accident: Accident, check: ReplayCheck) -> str:
    """Why an accident whose check fails cannot be replayed, in words."""
    first, second = accident.actor_ids
    return (
        f"{accident.scenario}: the outlines of {first} and {second} are {check.margin:.2f} m apart at their last "
        f"frame, more than {MOST_MARGIN:g} m: the recording does not show the accident"
    )


def avoidability_of(
    accident: Accident,
    tracks: ScenarioTracks | None = None,
    *,
    brakings: Sequence[Braking] = BRAKINGS,
) -> Avoidability:
    """When an accident could have been avoided by braking.

    Args:
        accident: the recorded motion.
        tracks: of all actors of its scenario, for contacts with others than the pair; None leaves these out.
        brakings: the ways to brake after a warning.

    Raises:
        NotAvailableError: the gap between the two at the last frame is so large that the recording does not show the
            accident.
    """
    check = undisturbed(accident)
    if not check.usable:
        raise NotAvailableError(unusable(accident, check))
    pair = pair_of(accident.paths, accident.sizes)
    decelerations = np.unique([each.deceleration for each in brakings])
    scans = [last_moments(pair, brakers, decelerations) for brakers in MASKS]
    moments = LastMoments(
        **{
            name: np.concatenate([getattr(each, name) for each in scans])
            for name in LastMoments.__slots__
        }
    )
    leads = as_floats(np.arange(accident.paths.shape[1]) * FRAME_PERIOD)
    first, second, both = (
        outcomes_of(accident, brakers, accident.duration - leads, brakings=brakings)
        for brakers in MASKS
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
    """When a scenario's accident could have been avoided by braking; None if the meta file names no collision.

    Args:
        dataset: the release.
        scenario: token or record.
        brakings: the ways to brake after a warning.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: the scenario lacks labels or meta, or its labels do not show the accident.
    """
    accident = accident_of(dataset, scenario)
    return (
        None
        if accident is None
        else avoidability_of(accident, scenario_tracks(dataset, scenario), brakings=brakings)
    )


def _secondary(
    accident: Accident, tracks: ScenarioTracks, moments: LastMoments, decelerations: FloatArray
) -> tuple[SecondaryContact, ...]:
    """Contacts with others in the replays that avoid the accident at the last moment."""
    brakes = np.repeat(np.array(MASKS), len(decelerations), axis=0)
    starts = np.where(brakes & np.isfinite(moments.time)[:, None], moments.time[:, None], np.inf)
    return tuple(secondary_contacts(accident, tracks, starts, np.tile(decelerations, len(MASKS))))


@dataclass(frozen=True, slots=True)
class _Other:
    """Another actor: its path at the accident's frames, and the seconds within which labels show it."""

    actor_id: int
    category: str
    path: FloatArray
    size: FloatArray
    window: tuple[float, float]


def secondary_contacts(
    accident: Accident, tracks: ScenarioTracks, starts: FloatArray, decelerations: FloatArray
) -> list[SecondaryContact]:
    """The first contacts of each of the pair with each other actor in N replays, which the recording does not have.

    `starts` (N, 2) are the seconds at which each of the two begins to brake, inf if it does not. By replay, then by
    time. Others that labels show at one frame alone have no motion, and are left out.
    """
    found = []
    for other, which in product(_others(accident, tracks), (0, 1)):
        rows = np.flatnonzero(np.isfinite(starts[:, which]))
        if len(rows) and _may_meet(accident.paths[which], accident.sizes[which], other):
            times = _new_contacts(accident, which, other, starts[rows], decelerations[rows])
            found += [
                SecondaryContact(
                    replay=int(row),
                    actor_id=accident.actor_ids[which],
                    other_id=other.actor_id,
                    category=other.category,
                    time=float(time),
                    extrapolated=bool(time > accident.duration),
                )
                for row, time in zip(rows, times, strict=True)
                if np.isfinite(time)
            ]
    return sorted(found, key=lambda each: (each.replay, each.time, each.other_id))


def _new_contacts(
    accident: Accident, which: int, other: _Other, starts: FloatArray, decelerations: FloatArray
) -> FloatArray:
    """(N,) seconds at which one of the pair touches another in N replays; inf if never, or in the recording too."""
    paths = np.stack([accident.paths[which], other.path])
    pair = pair_of(paths, [accident.sizes[which, :2], other.size], margin=_NO_GAP)
    begun = np.full((len(starts) + 1, 2), np.inf)  # the last one is the recording
    begun[:-1, 0] = starts[:, which]
    times = contact_times(pair, begun, np.append(decelerations, 1.0), window=other.window)
    return times[:-1] if times[-1] > accident.duration else np.full(len(starts), np.inf)


def _others(accident: Accident, tracks: ScenarioTracks) -> Iterator[_Other]:
    frames = np.arange(accident.first_frame, accident.last_frame + 1)
    within = (tracks.index >= frames[0]) & (tracks.index <= frames[-1])
    for actor in np.unique(tracks.actor_id[within]).tolist():
        rows = np.flatnonzero(within & (tracks.actor_id == actor))
        if actor not in accident.actor_ids and len(rows) >= 2:
            yield _other(tracks, rows, frames)


def _other(tracks: ScenarioTracks, rows: IntArray, frames: IntArray) -> _Other:
    first, last = ((tracks.index[rows[end]] - frames[0]) * FRAME_PERIOD for end in (0, -1))
    stays = tracks.index[rows[-1]] == frames[-1]
    return _Other(
        actor_id=int(tracks.actor_id[rows[0]]),
        category=CATEGORIES[int(tracks.boxes.category[rows[-1]])],
        path=recorded_path(tracks, rows, frames),
        size=np.median(tracks.boxes.size[rows, :2], axis=0),
        window=(float(first), float(last + HORIZON if stays else last)),
    )


def _may_meet(path: FloatArray, size: FloatArray, other: _Other) -> bool:
    """Whether the two can touch at all: a braking actor is where it was recorded, or earlier on its path."""
    mine, theirs = _positions(path), _positions(other.path)
    apart = np.hypot(*(mine[:, None] - theirs[None]).transpose(2, 0, 1))
    steps = sum(np.hypot(*np.diff(each, axis=0).T).max() for each in (mine, theirs))
    reach = (np.hypot(*size[:2]) + np.hypot(*other.size)) / 2 + steps
    not_ahead = np.arange(len(mine))[:, None] <= np.arange(len(theirs)) + 1
    return bool((not_ahead & (apart <= reach)).any())


def _positions(path: FloatArray) -> FloatArray:
    """Positions at each frame of the recording and of its continuation."""
    onward = np.arange(1, round(HORIZON / FRAME_PERIOD) + 1)[:, None] * (
        path[-1, :2] - path[-2, :2]
    )
    return np.concatenate([path[:, :2], path[-1, :2] + onward])
