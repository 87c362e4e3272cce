"""Times at which replays of a pair first touch; no contact is missed, however short.

An interval of time is proven free of contact from the gaps at its ends and from how far the two
actors can approach each other within it (`_can_touch`). An interval without such a proof is halved.
Intervals are therefore long where the actors are far apart, and short where they nearly touch.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.collisions.replay import (
    BrakingPlans,
    Motion,
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

_LONGEST_INTERVAL_S = 0.32
# Largest number of halvings of an interval: down to 0.3 µs, in which a car moves by less than
# 0.01 mm.
_MAX_HALVINGS = 20
TOUCHING: Final = 1e-9
"""Largest gap that still counts as contact, metres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair(FrozenArrays):
    """The motions of two actors, and the gap between their outlines that counts as contact.

    Attributes:
        motions: Motions of the two actors, with the same number of frames.
        sizes: Lengths and widths, shape (2, 2), metres. Read-only.
        margin: Gap that counts as contact, metres. When the simulator reports a contact, the boxes
            need not overlap at the last frame, so the gap at that frame counts as contact;
            otherwise doing nothing would avoid such accidents.
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
        GeometryError: An array has a wrong shape or contains NaN, or there are fewer than two
            frames.
    """
    first_path, second_path = checked("paths", paths, (2, None, 3))
    flat_sizes = checked("sizes", np.asarray(sizes)[:, :2], (2, 2))
    motions = (motion_of(first_path), motion_of(second_path))
    if margin is None:
        first_box = _make_boxes(first_path[-1:], flat_sizes[0])
        second_box = _make_boxes(second_path[-1:], flat_sizes[1])
        margin = gaps_of_pairs(first_box, second_box).item() + TOUCHING
    return Pair(motions=motions, sizes=flat_sizes, margin=margin)


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
        starts: Start time of the braking of each actor, shape (N, 2), seconds; inf or NaN if it
            does not brake.
        decelerations: Decelerations of both actors, shape (N,), m/s².
        window: Times within which contact counts, seconds; None for all to the end of the
            continuation.

    Raises:
        GeometryError: An array has another shape.
    """
    plans = _plan_braking(pair, starts, decelerations)
    return _search_contacts(pair, plans, window or _find_full_window(pair), earliest=True)


def has_contact(
    pair: Pair,
    starts: ArrayLike,
    decelerations: ArrayLike,
    *,
    window: tuple[float, float] | None = None,
) -> BoolArray:
    """Return whether replays of a pair touch at all, shape (N,).

    This is faster than `contact_times`, and has the same arguments and errors.
    """
    plans = _plan_braking(pair, starts, decelerations)
    times = _search_contacts(pair, plans, window or _find_full_window(pair), earliest=False)
    return np.isfinite(times)


def impacts(pair: Pair, starts: ArrayLike, decelerations: ArrayLike, times: FloatArray) -> Impacts:
    """Return the speeds of the two actors at the first contact of each replay.

    Args:
        pair: Motions and sizes of the two actors.
        starts: Start times of the braking, as `contact_times` expects them.
        decelerations: Decelerations, as `contact_times` expects them.
        times: Times of the first contact, shape (N,), seconds; inf without contact.
    """
    hit_rows = np.flatnonzero(np.isfinite(times))
    hit_times = times[hit_rows]
    speeds = np.full((len(times), 2), np.nan)
    velocities = np.full((2, len(times), 2), np.nan)
    plans = _plan_braking(pair, starts, decelerations)
    for actor, motion in enumerate(pair.motions):
        states = replay(motion, plans[actor], hit_rows, hit_times)
        speeds[hit_rows, actor] = states.speeds
        velocities[actor, hit_rows] = states.velocities(motion)
    relative_x, relative_y = (velocities[0] - velocities[1]).T
    return Impacts(speeds=speeds, relative_speeds=np.hypot(relative_x, relative_y))


def _find_full_window(pair: Pair) -> tuple[float, float]:
    """Return the first and last time of a pair's motions, with the continuation."""
    motion, _ = pair.motions
    end = float(motion.times[-1])
    return 0.0, end


def _plan_braking(
    pair: Pair, starts: ArrayLike, decelerations: ArrayLike
) -> tuple[BrakingPlans, BrakingPlans]:
    """Return the braking plans of both actors, as `contact_times` describes the arguments."""
    first_starts, second_starts = checked("starts", starts, (None, 2)).T
    first_motion, second_motion = pair.motions
    first_plans = braking_plans(first_motion, first_starts, decelerations)
    second_plans = braking_plans(second_motion, second_starts, decelerations)
    return first_plans, second_plans


class _Row(IntEnum):
    """Rows of an array that describes the state of a pair in N replays, shape (8, N)."""

    TIME = 0
    """Time, seconds."""
    GAP = 1
    """Gap less the margin, metres; or a lower bound of it."""
    TRAVEL = 2
    """Sum of the distances that both actors have driven, plus `TURN`, metres."""
    TURN = 3
    """Sum of the distances that the corners of both actors have moved by turning, metres."""
    X = 4
    Y = 5
    """Offset from the second centre to the first, metres."""
    SPEED = 6
    """Sum of both speeds, m/s."""
    STRETCH = 7
    """Number that stands for the two stretches of the paths that the actors are on."""


class _Gaps:
    """Calculator of the gap between two actors, and the rest of their state, in replays."""

    def __init__(self, pair: Pair, plans: tuple[BrakingPlans, BrakingPlans]) -> None:
        self._pair = pair
        self._plans = plans
        self._half_diagonals = np.hypot(*pair.sizes.T) / 2
        self._max_closing_speed = sum(float(motion.speeds.max()) for motion in pair.motions)

    def pair_states(self, rows: IntArray, times: FloatArray, step: float) -> FloatArray:
        """Return the states of the pair in replays, shape (8, N), with the rows of `_Row`.

        If the two actors are too far apart to touch within `step` seconds, the gap is only a lower
        bound.

        Args:
            rows: Rows of the replays in the plans, shape (N,).
            times: Time of each state, shape (N,), seconds.
            step: Duration of an interval, seconds.
        """
        pair = self._pair
        first_motion, second_motion = pair.motions
        first_plans, second_plans = self._plans
        first_states = replay(first_motion, first_plans, rows, times)
        second_states = replay(second_motion, second_plans, rows, times)
        first_radius, second_radius = self._half_diagonals
        turn = first_radius * first_states.turned + second_radius * second_states.turned
        x, y, _ = (first_states.poses - second_states.poses).T
        gap = np.hypot(x, y) - self._half_diagonals.sum()
        max_approach = self._max_closing_speed * step
        close_rows = np.flatnonzero(gap <= pair.margin + max_approach)
        first_boxes = _make_boxes(first_states.poses[close_rows], pair.sizes[0])
        second_boxes = _make_boxes(second_states.poses[close_rows], pair.sizes[1])
        gap[close_rows] = gaps_of_pairs(first_boxes, second_boxes)
        # A different number for each combination of two stretches.
        stretch = first_states.stretches * len(second_motion.times) + second_states.stretches
        travel = first_states.arcs + second_states.arcs + turn
        speed = first_states.speeds + second_states.speeds
        return np.stack([times, gap - pair.margin, travel, turn, x, y, speed, stretch])


def _make_boxes(poses: FloatArray, size: FloatArray) -> FloatArray:
    """Return flat boxes (x, y, length, width, yaw) of poses (N, 3) with one size (2,), (N, 5)."""
    x, y, yaw = poses.T
    length, width = np.broadcast_to(size, (len(poses), 2)).T
    return np.stack([x, y, length, width, yaw], axis=1)


def _search_contacts(
    pair: Pair,
    plans: tuple[BrakingPlans, BrakingPlans],
    window: tuple[float, float],
    *,
    earliest: bool,
) -> FloatArray:
    """Return times of contact, shape (N,), inf for none.

    With `earliest`, these are the first times of contact; otherwise, any times of contact. Until
    the first of the two actors brakes, a replay equals the recording, which is searched once.
    """
    nodes = _place_nodes(pair, window)
    first_plans, second_plans = plans
    braking_begins = np.minimum(first_plans.starts, second_plans.starts)
    unbraked_plans = _plan_braking(pair, np.full((1, 2), np.inf), np.ones(1))
    unbraked_gaps = _Gaps(pair, unbraked_plans)
    window_begin = np.array(window[:1])
    recorded_time = _find_contacts(unbraked_gaps, nodes, window_begin, earliest=True)[0]
    times = np.where(braking_begins >= recorded_time, recorded_time, np.inf)
    rows = np.flatnonzero(braking_begins < recorded_time)
    gaps = _Gaps(pair, (first_plans.take(rows), second_plans.take(rows)))
    times[rows] = _find_contacts(gaps, nodes, braking_begins[rows], earliest=earliest)
    return times


def _find_contacts(
    gaps: _Gaps, nodes: FloatArray, braking_begins: FloatArray, *, earliest: bool
) -> FloatArray:
    """Return times of contact after `braking_begins` (N,), shape (N,), inf for none.

    Intervals between nodes are halved as long as needed.
    """
    times = np.full(len(braking_begins), np.inf)
    rows, end_states = _find_first_intervals(gaps, nodes, braking_begins)
    for states in end_states:
        _note_contacts(times, rows, states)
    for halving in range(1, _MAX_HALVINGS + 1):
        limit = times
        if not earliest:
            limit = np.where(np.isfinite(times), -np.inf, np.inf)
        undecided = _can_touch(end_states) & (end_states[0, _Row.TIME] < limit[rows])
        intervals = np.flatnonzero(undecided)
        if not len(intervals):
            break
        rows = rows[intervals]
        end_states = end_states[..., intervals]
        middle_times = end_states[:, _Row.TIME].mean(axis=0)
        middle_states = gaps.pair_states(rows, middle_times, _LONGEST_INTERVAL_S / 2**halving)
        _note_contacts(times, rows, middle_states)
        rows = np.concatenate([rows, rows])
        begin, end = end_states
        end_states = np.concatenate([[begin, middle_states], [middle_states, end]], axis=2)
    return times


def _can_touch(end_states: FloatArray) -> BoolArray:
    """Return whether actors can touch within intervals, shape (M,).

    The states at both ends of the intervals have the shape (2, 8, M).

    At any moment in between, the gap is at least the mean of the gaps at both ends less half of
    what it can change. The change is no more than the distance travelled. If each of the two actors
    stays on one stretch, which is straight and on which it does not speed up, the change is also no
    more than the change of their distance plus their deviation from the straight line of constant
    speeds: a quarter of the loss of speed, times the time.
    """
    begin, end = end_states
    time, _, travelled, turn, x, y, speed, stretch = np.abs(end - begin)
    straight_change = np.hypot(x, y) + turn + speed * time / 2
    least_change = np.minimum(straight_change, travelled)
    max_change = np.where(stretch == 0, least_change, travelled)
    return np.asarray(begin[_Row.GAP] + end[_Row.GAP] <= max_change)


def _place_nodes(pair: Pair, window: tuple[float, float]) -> FloatArray:
    """Return times from the beginning to the end of a window, at most `_LONGEST_INTERVAL_S` apart.

    The end of the recording is a node if the window holds it.
    """
    begin, end = window
    bounds = [begin, end]
    if begin < pair.duration < end:
        bounds.insert(1, pair.duration)
    nodes = []
    for part_begin, part_end in pairwise(bounds):
        min_intervals = (part_end - part_begin) / _LONGEST_INTERVAL_S
        num_intervals = max(1, math.ceil(min_intervals))
        nodes.append(np.linspace(part_begin, part_end, num_intervals + 1))
    return np.unique(np.concatenate(nodes))


def _find_first_intervals(
    gaps: _Gaps, nodes: FloatArray, braking_begins: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return the intervals between nodes that end after `braking_begins` (N,).

    Returns:
        Rows of replays, shape (M,); states at both ends of their intervals, shape (2, 8, M).
    """
    states = np.full((len(_Row), len(braking_begins), len(nodes)), np.nan)
    next_nodes = np.append(nodes[1:], np.inf)
    ends_after = next_nodes > braking_begins[:, None]
    rows, numbers = np.nonzero(ends_after)
    node_times = nodes[numbers]
    states[:, rows, numbers] = gaps.pair_states(rows, node_times, _LONGEST_INTERVAL_S)
    rows, numbers = np.nonzero(ends_after[:, :-1])
    begin_states = states[:, rows, numbers]
    end_states = states[:, rows, numbers + 1]
    return rows, np.stack([begin_states, end_states])


def _note_contacts(times: FloatArray, rows: IntArray, states: FloatArray) -> None:
    """Store the times at which replays touch, where they are earlier than the stored ones."""
    in_contact = states[_Row.GAP] <= 0
    found_times = states[_Row.TIME, in_contact]
    np.minimum.at(times, rows[in_contact], found_times)
