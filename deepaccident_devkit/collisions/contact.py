"""When replays of a pair first touch: no contact is missed, however short.

A time interval is proven free of contact by the gaps at its ends and by how far the two can come within it
(`_contact_possible`). What is not proven is halved. So the steps are long where the two are far apart and short where
they nearly touch.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.collisions.replay import (
    BrakingPlans,
    Motion,
    ReplayStates,
    braking_plans,
    motion_of,
    replay,
)
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked,
)

# Seconds of the longest intervals.
_COARSE: Final = 0.32
# How often an interval is halved at most: down to 0.3 µs, in which a car moves by less than 0.01 mm.
_HALVINGS: Final = 20
TOUCHING: Final = 1e-9
"""Metres of a gap that still counts as contact."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair(FrozenArrays):
    """The motions of two actors, and the gap between their outlines that counts as contact.

    Attributes:
        motions: of the two; the same number of frames.
        sizes: (2, 2) lengths and widths, metres. Read-only.
        margin: metres. The simulator's contact need not be an overlap of the boxes at the last frame, so that the gap
            there counts as contact: otherwise such accidents would be avoided by doing nothing.
    """

    motions: tuple[Motion, Motion]
    sizes: FloatArray
    margin: float

    @property
    def duration(self) -> float:
        """Seconds of the recording."""
        return self.motions[0].duration


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Impacts(FrozenArrays):
    """How N replays of a pair first touch; NaN where they do not. Arrays are read-only.

    Attributes:
        speeds: (N, 2) of the two, m/s.
        relative_speeds: (N,) m/s.
    """

    speeds: FloatArray
    relative_speeds: FloatArray


def pair_of(paths: ArrayLike, sizes: ArrayLike, *, margin: float | None = None) -> Pair:
    """The motions of two on paths (2, F, 3) of x, y, yaw at 10 Hz up to the impact, and the margin of their contact.

    Any right-handed frame, metres, radians; `sizes` (2, 2 or more) begin with length and width. A `margin` of None
    is the gap at the last frame. Raises GeometryError.
    """
    both = checked("paths", paths, (2, None, 3))
    flat = checked("sizes", np.asarray(sizes)[:, :2], (2, 2))
    first, second = (motion_of(path) for path in both)
    if margin is None:
        last = [
            np.concatenate([path[-1, :2], size, path[-1, 2:]])
            for path, size in zip(both, flat, strict=True)
        ]
        margin = float(gaps_of_pairs(last[0], last[1])) + TOUCHING
    return Pair(motions=(first, second), sizes=flat, margin=margin)


def contact_times(
    pair: Pair,
    starts: ArrayLike,
    decelerations: ArrayLike,
    *,
    window: tuple[float, float] | None = None,
) -> FloatArray:
    """(N,) seconds at which replays of a pair first touch; inf for those that never do.

    `starts` (N, 2) are the seconds at which each of the two begins to brake, inf or NaN if it does not;
    `decelerations` (N,) are m/s² of both. Contact counts within the `window`, None for all to the end of the
    continuation. Raises GeometryError.
    """
    return _search(pair, _plans(pair, starts, decelerations), window or _whole(pair), earliest=True)


def contact_made(
    pair: Pair,
    starts: ArrayLike,
    decelerations: ArrayLike,
    *,
    window: tuple[float, float] | None = None,
) -> BoolArray:
    """(N,) whether replays of a pair touch at all: faster than `contact_times`, whose arguments and errors it has."""
    found = _search(
        pair, _plans(pair, starts, decelerations), window or _whole(pair), earliest=False
    )
    return np.isfinite(found)


def impacts(pair: Pair, starts: ArrayLike, decelerations: ArrayLike, times: FloatArray) -> Impacts:
    """How fast the two are where replays first touch: at `times` (N,), inf for none; else as `contact_times`."""
    hit = np.flatnonzero(np.isfinite(times))
    speeds, velocities = np.full((len(times), 2), np.nan), np.full((2, len(times), 2), np.nan)
    plans = _plans(pair, starts, decelerations)
    for which, (motion, plan) in enumerate(zip(pair.motions, plans, strict=True)):
        states = replay(motion, plan, hit, times[hit])
        speeds[hit, which] = states.speeds
        velocities[which, hit] = states.velocities(motion)
    return Impacts(speeds=speeds, relative_speeds=np.hypot(*(velocities[0] - velocities[1]).T))


def _whole(pair: Pair) -> tuple[float, float]:
    return 0.0, float(pair.motions[0].times[-1])


def _plans(
    pair: Pair, starts: ArrayLike, decelerations: ArrayLike
) -> tuple[BrakingPlans, BrakingPlans]:
    begun = checked("starts", starts, (None, 2))
    first, second = (
        braking_plans(motion, begun[:, each], decelerations)
        for each, motion in enumerate(pair.motions)
    )
    return first, second


class _Mark(IntEnum):
    """Rows of what is known of a replay at a time."""

    TIME = 0
    """Seconds."""
    GAP = 1
    """Metres, less the margin; or a lower bound."""
    WAY = 2
    """Metres that the two have travelled, and their corners turned."""
    TURN = 3
    """Metres that their corners have turned."""
    X = 4
    Y = 5
    """Metres from the second centre to the first."""
    SPEED = 6
    """m/s of both together."""
    STRETCH = 7
    """A number for the two stretches of their paths."""


class _Gaps:
    """Gaps of replays of a pair at times, and how far the two have moved until then."""

    def __init__(self, pair: Pair, plans: tuple[BrakingPlans, BrakingPlans]) -> None:
        self._pair = pair
        self._plans = plans
        self._reaches = np.hypot(*pair.sizes.T) / 2
        self._fastest = sum(float(motion.speeds.max()) for motion in pair.motions)

    def at(self, rows: IntArray, times: FloatArray, step: float) -> FloatArray:
        """(8, N) marks; the gap is a lower bound where the two are farther apart than they drive in a step."""
        one, two = (
            replay(motion, plan, rows, times)
            for motion, plan in zip(self._pair.motions, self._plans, strict=True)
        )
        turn = self._reaches[0] * one.turned + self._reaches[1] * two.turned
        x, y = (one.poses - two.poses)[:, :2].T
        gap = np.hypot(x, y) - self._reaches.sum()
        near = np.flatnonzero(gap <= self._pair.margin + self._fastest * step)
        outlines = (self._outlines(states, which, near) for which, states in enumerate((one, two)))
        gap[near] = gaps_of_pairs(*outlines)
        stretch = one.stretches * len(self._pair.motions[1].times) + two.stretches
        way = one.arcs + two.arcs + turn
        return np.stack(
            [times, gap - self._pair.margin, way, turn, x, y, one.speeds + two.speeds, stretch]
        )

    def _outlines(self, states: ReplayStates, which: int, rows: IntArray) -> FloatArray:
        poses = states.poses[rows]
        sizes = np.broadcast_to(self._pair.sizes[which], (len(rows), 2))
        return np.concatenate([poses[:, :2], sizes, poses[:, 2:]], axis=1)


def _search(
    pair: Pair,
    plans: tuple[BrakingPlans, BrakingPlans],
    window: tuple[float, float],
    *,
    earliest: bool,
) -> FloatArray:
    """(N,) times of contact, inf for none: the first ones, or any (`earliest` false).

    Until the first of the two brakes, a replay is the recording, which is searched once.
    """
    nodes = _nodes(pair, window)
    begun = np.minimum(plans[0].starts, plans[1].starts)
    never = _plans(pair, np.full((1, 2), np.inf), np.ones(1))
    recorded = _refined(_Gaps(pair, never), nodes, np.array([window[0]]), earliest=True)[0]
    found = np.where(begun >= recorded, recorded, np.inf)
    rows = np.flatnonzero(begun < recorded)
    gaps = _Gaps(pair, (plans[0].take(rows), plans[1].take(rows)))
    found[rows] = _refined(gaps, nodes, begun[rows], earliest=earliest)
    return found


def _refined(gaps: _Gaps, nodes: FloatArray, begun: FloatArray, *, earliest: bool) -> FloatArray:
    """(N,) times of contact after `begun` (N,), inf for none; intervals between nodes are halved as long as needed."""
    found = np.full(len(begun), np.inf)
    rows, ends = _first_intervals(gaps, nodes, begun)
    for marks in ends:
        _note(found, rows, marks)
    for halving in range(1, _HALVINGS + 1):
        limit = found if earliest else np.where(np.isfinite(found), -np.inf, np.inf)
        kept = np.flatnonzero(_contact_possible(ends) & (ends[0, _Mark.TIME] < limit[rows]))
        if not len(kept):
            break
        rows, ends = rows[kept], ends[..., kept]
        middle = gaps.at(rows, ends[:, _Mark.TIME].mean(axis=0), _COARSE / 2**halving)
        _note(found, rows, middle)
        rows = np.concatenate([rows, rows])
        ends = np.concatenate([[ends[0], middle], [middle, ends[1]]], axis=2)
    return found


def _contact_possible(ends: FloatArray) -> BoolArray:
    """(M,) whether the two can touch within intervals whose marks at both ends are (2, 8, M).

    At any moment in between, the gap is at least the mean of those at the ends less half of what it can change. That
    is no more than the ways. Where each of the two stays on one stretch, which is straight and on which it does not
    speed up, it is no more than the change of their distance either, and what they leave the straight line of constant
    speeds by: a quarter of the loss of speed, times the time.
    """
    begin, end = ends
    change = np.abs(end - begin)
    apart = np.hypot(change[_Mark.X], change[_Mark.Y])
    relative = apart + change[_Mark.TURN] + change[_Mark.SPEED] * change[_Mark.TIME] / 2
    most = np.where(
        change[_Mark.STRETCH] == 0, np.minimum(relative, change[_Mark.WAY]), change[_Mark.WAY]
    )
    return np.asarray(begin[_Mark.GAP] + end[_Mark.GAP] <= most)


def _nodes(pair: Pair, window: tuple[float, float]) -> FloatArray:
    """Times from the first to the last of a window, at most `_COARSE` apart; the end of the recording is one."""
    since, until = window
    bounds = [since, *([pair.duration] if since < pair.duration < until else []), until]
    parts = [
        np.linspace(start, end, max(1, int(np.ceil((end - start) / _COARSE))) + 1)
        for start, end in pairwise(bounds)
    ]
    return np.unique(np.concatenate(parts))


def _first_intervals(
    gaps: _Gaps, nodes: FloatArray, begun: FloatArray
) -> tuple[IntArray, FloatArray]:
    """The intervals between nodes that end after `begun`: replays (M,), and marks (2, 8, M) at both ends."""
    marks = np.full((len(_Mark), len(begun), len(nodes)), np.nan)
    rows, numbers = np.nonzero(np.append(nodes[1:], np.inf) > begun[:, None])
    marks[:, rows, numbers] = gaps.at(rows, nodes[numbers], _COARSE)
    rows, numbers = np.nonzero(nodes[1:] > begun[:, None])
    return rows, np.stack([marks[:, rows, numbers], marks[:, rows, numbers + 1]])


def _note(found: FloatArray, rows: IntArray, marks: FloatArray) -> None:
    """Note the times at which replays are in contact, if they are earlier than those noted before."""
    hit = marks[_Mark.GAP] <= 0
    np.minimum.at(found, rows[hit], marks[_Mark.TIME, hit])
