"""When replays of a pair first touch; no contact is missed, however short.

A time interval is proven free of contact by the gaps at its ends and by how far the two actors can
approach within it (`_contact_possible`). An interval that is not proven is halved. Intervals are
therefore long where the actors are far apart, and short where they nearly touch.
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

_LONGEST_INTERVAL_S: Final = 0.32
# Halvings of an interval at most: down to 0.3 µs, in which a car moves by less than 0.01 mm.
_MAX_HALVINGS: Final = 20
TOUCHING: Final = 1e-9
"""Largest gap that still counts as contact, metres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair(FrozenArrays):
    """The motions of two actors, and the gap between their outlines that counts as contact.

    Attributes:
        motions: Motions of the two actors, with the same number of frames.
        sizes: Lengths and widths, shape (2, 2), metres. Read-only.
        margin: Gap that counts as contact, metres. The simulator's contact need not be an overlap
            of the boxes at the last frame, so the gap at that frame counts as contact; otherwise
            doing nothing would avoid such accidents.
    """

    motions: tuple[Motion, Motion]
    sizes: FloatArray
    margin: float

    @property
    def duration(self) -> float:
        """Duration of the recording, seconds."""
        return self.motions[0].duration


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Impacts(FrozenArrays):
    """Speeds at the first contact of N replays of a pair, NaN without contact; read-only arrays.

    Attributes:
        speeds: Speeds of the two actors, shape (N, 2), m/s.
        relative_speeds: Relative speeds, shape (N,), m/s.
    """

    speeds: FloatArray
    relative_speeds: FloatArray


def pair_of(paths: ArrayLike, sizes: ArrayLike, *, margin: float | None = None) -> Pair:
    """Return the motions of two actors and the margin of their contact.

    Args:
        paths: Positions and yaws (x, y, yaw) at 10 Hz up to the impact, shape (2, F, 3), in any
            right-handed frame, metres and radians.
        sizes: Sizes that begin with length and width, shape (2, 2 or more), metres.
        margin: Gap that counts as contact, metres; None for the gap at the last frame.

    Raises:
        GeometryError: An array has another shape, or fewer than two frames, or a NaN.
    """
    actor_paths = checked("paths", paths, (2, None, 3))
    flat_sizes = checked("sizes", np.asarray(sizes)[:, :2], (2, 2))
    first_motion, second_motion = (motion_of(path) for path in actor_paths)
    if margin is None:
        last_boxes = [
            np.concatenate([path[-1, :2], size, path[-1, 2:]])
            for path, size in zip(actor_paths, flat_sizes, strict=True)
        ]
        margin = float(gaps_of_pairs(last_boxes[0], last_boxes[1])) + TOUCHING
    return Pair(motions=(first_motion, second_motion), sizes=flat_sizes, margin=margin)


def contact_times(
    pair: Pair,
    starts: ArrayLike,
    decelerations: ArrayLike,
    *,
    window: tuple[float, float] | None = None,
) -> FloatArray:
    """Return the times at which replays of a pair first touch, shape (N,), seconds; inf for never.

    Args:
        pair: Motions and sizes of the two actors.
        starts: Times at which each actor begins to brake, shape (N, 2), seconds; inf or NaN if it
            does not brake.
        decelerations: Decelerations of both actors, shape (N,), m/s².
        window: Times within which contact counts, seconds; None for all to the end of the
            continuation.

    Raises:
        GeometryError: An array has another shape.
    """
    plans = _plans(pair, starts, decelerations)
    return _search(pair, plans, window or _full_window(pair), earliest=True)


def contact_made(
    pair: Pair,
    starts: ArrayLike,
    decelerations: ArrayLike,
    *,
    window: tuple[float, float] | None = None,
) -> BoolArray:
    """Return whether replays of a pair touch at all, shape (N,).

    This is faster than `contact_times`, and has the same arguments and errors.
    """
    plans = _plans(pair, starts, decelerations)
    times = _search(pair, plans, window or _full_window(pair), earliest=False)
    return np.isfinite(times)


def impacts(pair: Pair, starts: ArrayLike, decelerations: ArrayLike, times: FloatArray) -> Impacts:
    """Return how fast the two actors are where replays first touch.

    Args:
        pair: Motions and sizes of the two actors.
        starts: Times at which each actor begins to brake, as `contact_times` expects them.
        decelerations: Decelerations, as `contact_times` expects them.
        times: Times of the first contact, shape (N,), seconds; inf without contact.
    """
    hit_rows = np.flatnonzero(np.isfinite(times))
    speeds = np.full((len(times), 2), np.nan)
    velocities = np.full((2, len(times), 2), np.nan)
    plans = _plans(pair, starts, decelerations)
    for actor, (motion, plan) in enumerate(zip(pair.motions, plans, strict=True)):
        states = replay(motion, plan, hit_rows, times[hit_rows])
        speeds[hit_rows, actor] = states.speeds
        velocities[actor, hit_rows] = states.velocities(motion)
    velocity_changes = velocities[0] - velocities[1]
    return Impacts(speeds=speeds, relative_speeds=np.hypot(*velocity_changes.T))


def _full_window(pair: Pair) -> tuple[float, float]:
    """Return the first and last time of a pair's motions, with the continuation."""
    return 0.0, float(pair.motions[0].times[-1])


def _plans(
    pair: Pair, starts: ArrayLike, decelerations: ArrayLike
) -> tuple[BrakingPlans, BrakingPlans]:
    """Return the braking plans of both actors, as `contact_times` describes the arguments."""
    actor_starts = checked("starts", starts, (None, 2))
    first_plans, second_plans = (
        braking_plans(motion, actor_starts[:, actor], decelerations)
        for actor, motion in enumerate(pair.motions)
    )
    return first_plans, second_plans


class _Mark(IntEnum):
    """Rows of the array that holds what is known of a replay at a time."""

    TIME = 0
    """Time, seconds."""
    GAP = 1
    """Gap less the margin, metres; or a lower bound of it."""
    WAY = 2
    """Distance that the two actors have travelled and their corners have turned, metres."""
    TURN = 3
    """Distance that their corners have turned, metres."""
    X = 4
    Y = 5
    """Offset from the second centre to the first, metres."""
    SPEED = 6
    """Sum of both speeds, m/s."""
    STRETCH = 7
    """Number of the pair of stretches of their paths."""


class _Gaps:
    """Gaps of replays of a pair at times, and how far the two actors have moved until then."""

    def __init__(self, pair: Pair, plans: tuple[BrakingPlans, BrakingPlans]) -> None:
        self._pair = pair
        self._plans = plans
        self._half_diagonals = np.hypot(*pair.sizes.T) / 2
        self._max_closing_speed = sum(float(motion.speeds.max()) for motion in pair.motions)

    def at(self, rows: IntArray, times: FloatArray, step: float) -> FloatArray:
        """Return the marks of replays at times, shape (8, N).

        The gap is a lower bound where the two actors are farther apart than they drive in a step of
        `step` seconds.
        """
        first, second = (
            replay(motion, plan, rows, times)
            for motion, plan in zip(self._pair.motions, self._plans, strict=True)
        )
        turn = self._half_diagonals[0] * first.turned + self._half_diagonals[1] * second.turned
        x, y = (first.poses - second.poses)[:, :2].T
        gap = np.hypot(x, y) - self._half_diagonals.sum()
        max_approach = self._max_closing_speed * step
        close_rows = np.flatnonzero(gap <= self._pair.margin + max_approach)
        first_outlines = self._outlines(first, 0, close_rows)
        second_outlines = self._outlines(second, 1, close_rows)
        gap[close_rows] = gaps_of_pairs(first_outlines, second_outlines)
        stretch = first.stretches * len(self._pair.motions[1].times) + second.stretches
        way = first.arcs + second.arcs + turn
        speed = first.speeds + second.speeds
        return np.stack([times, gap - self._pair.margin, way, turn, x, y, speed, stretch])

    def _outlines(self, states: ReplayStates, actor: int, rows: IntArray) -> FloatArray:
        """Return the flat boxes (x, y, length, width, yaw) of an actor's states at rows."""
        poses = states.poses[rows]
        sizes = np.broadcast_to(self._pair.sizes[actor], (len(rows), 2))
        return np.concatenate([poses[:, :2], sizes, poses[:, 2:]], axis=1)


def _search(
    pair: Pair,
    plans: tuple[BrakingPlans, BrakingPlans],
    window: tuple[float, float],
    *,
    earliest: bool,
) -> FloatArray:
    """Return times of contact, shape (N,), inf for none: the first ones, or any if not `earliest`.

    Until the first of the two actors brakes, a replay equals the recording, which is searched once.
    """
    nodes = _nodes(pair, window)
    braking_begins = np.minimum(plans[0].starts, plans[1].starts)
    unbraked_plans = _plans(pair, np.full((1, 2), np.inf), np.ones(1))
    unbraked_gaps = _Gaps(pair, unbraked_plans)
    recorded_time = _refined(unbraked_gaps, nodes, np.array([window[0]]), earliest=True)[0]
    times = np.where(braking_begins >= recorded_time, recorded_time, np.inf)
    rows = np.flatnonzero(braking_begins < recorded_time)
    gaps = _Gaps(pair, (plans[0].take(rows), plans[1].take(rows)))
    times[rows] = _refined(gaps, nodes, braking_begins[rows], earliest=earliest)
    return times


def _refined(
    gaps: _Gaps, nodes: FloatArray, braking_begins: FloatArray, *, earliest: bool
) -> FloatArray:
    """Return times of contact after `braking_begins` (N,), shape (N,), inf for none.

    Intervals between nodes are halved as long as needed.
    """
    times = np.full(len(braking_begins), np.inf)
    rows, ends = _first_intervals(gaps, nodes, braking_begins)
    for marks in ends:
        _note_contacts(times, rows, marks)
    for halving in range(1, _MAX_HALVINGS + 1):
        limit = times if earliest else np.where(np.isfinite(times), -np.inf, np.inf)
        undecided = _contact_possible(ends) & (ends[0, _Mark.TIME] < limit[rows])
        intervals = np.flatnonzero(undecided)
        if not len(intervals):
            break
        rows = rows[intervals]
        ends = ends[..., intervals]
        middle_times = ends[:, _Mark.TIME].mean(axis=0)
        middle = gaps.at(rows, middle_times, _LONGEST_INTERVAL_S / 2**halving)
        _note_contacts(times, rows, middle)
        rows = np.concatenate([rows, rows])
        ends = np.concatenate([[ends[0], middle], [middle, ends[1]]], axis=2)
    return times


def _contact_possible(ends: FloatArray) -> BoolArray:
    """Return whether actors can touch within intervals, shape (M,).

    The marks at both ends of the intervals have the shape (2, 8, M).

    At any moment in between, the gap is at least the mean of the gaps at both ends less half of
    what it can change. The change is no more than the distance travelled. If each of the two actors
    stays on one stretch, which is straight and on which it does not speed up, the change is also no
    more than the change of their distance plus their deviation from the straight line of constant
    speeds: a quarter of the loss of speed, times the time.
    """
    begin, end = ends
    change = np.abs(end - begin)
    distance = np.hypot(change[_Mark.X], change[_Mark.Y])
    straight_change = distance + change[_Mark.TURN] + change[_Mark.SPEED] * change[_Mark.TIME] / 2
    same_stretches = change[_Mark.STRETCH] == 0
    travelled = change[_Mark.WAY]
    max_change = np.where(same_stretches, np.minimum(straight_change, travelled), travelled)
    return np.asarray(begin[_Mark.GAP] + end[_Mark.GAP] <= max_change)


def _nodes(pair: Pair, window: tuple[float, float]) -> FloatArray:
    """Return times from the begin to the end of a window, at most `_LONGEST_INTERVAL_S` apart.

    The end of the recording is a node if the window holds it.
    """
    begin, end = window
    bounds = [begin, end]
    if begin < pair.duration < end:
        bounds.insert(1, pair.duration)
    parts = []
    for part_begin, part_end in pairwise(bounds):
        num_intervals = max(1, int(np.ceil((part_end - part_begin) / _LONGEST_INTERVAL_S)))
        parts.append(np.linspace(part_begin, part_end, num_intervals + 1))
    return np.unique(np.concatenate(parts))


def _first_intervals(
    gaps: _Gaps, nodes: FloatArray, braking_begins: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return the intervals between nodes that end after `braking_begins` (N,).

    Returns:
        Rows of replays, shape (M,), and the marks at both ends of their intervals, shape (2, 8, M).
    """
    marks = np.full((len(_Mark), len(braking_begins), len(nodes)), np.nan)
    next_nodes = np.append(nodes[1:], np.inf)
    rows, numbers = np.nonzero(next_nodes > braking_begins[:, None])
    marks[:, rows, numbers] = gaps.at(rows, nodes[numbers], _LONGEST_INTERVAL_S)
    rows, numbers = np.nonzero(nodes[1:] > braking_begins[:, None])
    begins = marks[:, rows, numbers]
    ends = marks[:, rows, numbers + 1]
    return rows, np.stack([begins, ends])


def _note_contacts(times: FloatArray, rows: IntArray, marks: FloatArray) -> None:
    """Note the times at which replays are in contact, if they are earlier than the noted ones."""
    in_contact = marks[_Mark.GAP] <= 0
    np.minimum.at(times, rows[in_contact], marks[_Mark.TIME, in_contact])
