"""Contacts of a braking actor with others than the one it was to collide with, such as who follows it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.safety.accidents import Accident, recorded_path
from deepaccident_devkit.safety.contact import contact_times, pair_of
from deepaccident_devkit.safety.replay import HORIZON
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD
from deepaccident_devkit.v2x.tracks import ScenarioTracks

_TOUCHING: Final = 1e-9
"""Metres of a gap that counts as contact: of others no contact is recorded that would need a margin."""


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

    Args:
        accident: the recorded motion of the pair.
        tracks: of all actors of its scenario.
        starts: (N, 2) seconds at which each of the two begins to brake; inf if it does not.
        decelerations: (N,) m/s².

    Returns:
        By replay, then by time. Others that labels show at one frame alone have no motion, and are left out.
    """
    found = []
    for other, which in product(_others(accident, tracks), (0, 1)):
        rows = np.flatnonzero(np.isfinite(starts[:, which]))
        if not len(rows) or not _may_meet(accident.paths[which], accident.sizes[which], other):
            continue
        for row, time in zip(
            rows, _new_contacts(accident, which, other, starts[rows], decelerations[rows]), strict=True
        ):
            if np.isfinite(time):
                found.append(
                    SecondaryContact(
                        replay=int(row),
                        actor_id=accident.actor_ids[which],
                        other_id=other.actor_id,
                        category=other.category,
                        time=float(time),
                        extrapolated=bool(time > accident.duration),
                    )
                )
    return sorted(found, key=lambda each: (each.replay, each.time, each.other_id))


def _new_contacts(
    accident: Accident, which: int, other: _Other, starts: FloatArray, decelerations: FloatArray
) -> FloatArray:
    """(N,) seconds at which one of the pair touches another in N replays; inf if never, or in the recording too."""
    paths = np.stack([accident.paths[which], other.path])
    pair = pair_of(paths, [accident.sizes[which, :2], other.size], margin=_TOUCHING)
    begun = np.full((len(starts) + 1, 2), np.inf)  # the last one is the recording
    begun[:-1, 0] = starts[:, which]
    times = contact_times(pair, begun, np.append(decelerations, 1.0), window=other.window)
    return times[:-1] if times[-1] > accident.duration else np.full(len(starts), np.inf)


def _others(accident: Accident, tracks: ScenarioTracks) -> Iterator[_Other]:
    frames = np.arange(accident.first_frame, accident.last_frame + 1)
    within = (tracks.index >= frames[0]) & (tracks.index <= frames[-1])
    for actor in np.unique(tracks.actor_id[within]).tolist():
        rows = np.flatnonzero(within & (tracks.actor_id == actor))
        if actor in accident.actor_ids or len(rows) < 2:
            continue
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
    onward = np.arange(1, round(HORIZON / FRAME_PERIOD) + 1)[:, None] * (path[-1, :2] - path[-2, :2])
    return np.concatenate([path[:, :2], path[-1, :2] + onward])
