"""Replays of recorded motions in which actors start to brake at some moment.

They give positions, speeds and arc lengths at any time. A braking actor stays on its recorded path.
Its arc length is the smaller of the recorded one and the one that braking allows. So an actor that
brakes harder in the recording also does so in the replay, and no actor is sped up. Jerk and
friction are not limited.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.support.arrays import (
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked,
)
from deepaccident_devkit.taxonomy import FRAME_PERIOD

HORIZON: Final = 3.0
"""Time after the end of the recording during which actors go straight on, seconds."""
# Longest last step of an actor that stands still after the recording.
_STANDING_STEP_M = 1e-3
# Maximum deviation of a time from the frame that it denotes, in frames.
_FRAME_TOLERANCE = 1e-6
# Smallest distance by which a braking actor must be behind the recording to count as behind it.
_ARC_TOLERANCE_M = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion(FrozenArrays):
    """A recorded path, and its continuation straight on at the last speed and heading.

    Positions and headings are linear in time between neighbouring nodes: the F frames, and the end
    of the continuation. Any right-handed frame; metres, radians, seconds; arrays are read-only.

    Attributes:
        poses: x, y, yaw at the nodes, shape (F + 1, 3); yaw without jumps by 2π.
        times: Times of the nodes, shape (F + 1,), the first 0.
        arcs: Lengths of the path up to the nodes, shape (F + 1,).
        turned: Sums of the absolute turns up to the nodes, shape (F + 1,).
        speeds: Speeds between the nodes, shape (F,), m/s.
        steps: Changes of the poses from each node to the next, shape (F, 3).
        periods: Times from each node to the next, shape (F,), seconds.
        lengths: Distances from each node to the next, shape (F,), metres.
    """

    poses: FloatArray
    times: FloatArray
    arcs: FloatArray
    turned: FloatArray
    speeds: FloatArray
    steps: FloatArray
    periods: FloatArray
    lengths: FloatArray

    @property
    def duration(self) -> float:
        """Duration of the recording, seconds."""
        return float(self.times[-2])

    def stretches(self, times: FloatArray) -> IntArray:
        """Return the index of the stretch between nodes that contains each time, shaped as `times`.

        The time of a frame belongs to the stretch after it. The end of the recording belongs to its
        last stretch, which has the speed of the impact.
        """
        continuation = len(self.speeds) - 1
        numbers: IntArray = (times / FRAME_PERIOD + _FRAME_TOLERANCE).astype(np.int64)
        np.minimum(numbers, continuation - 1, out=numbers)
        numbers[times > self.duration] = continuation
        return numbers


class BrakingPlans(NamedTuple):
    """Start and strength of the braking in N replays of one actor.

    Attributes:
        starts: Start times of the braking, shape (N,), seconds; inf for no braking.
        decelerations: Decelerations, shape (N,), m/s².
        arcs: Distances along the path at which the braking begins, shape (N,), metres; inf for no
            braking.
        speeds: Speeds at which the braking begins, shape (N,), m/s; 0 for no braking.
    """

    starts: FloatArray
    decelerations: FloatArray
    arcs: FloatArray
    speeds: FloatArray

    def take(self, rows: IntArray) -> BrakingPlans:
        """Return the plans of the replays at some rows."""
        return BrakingPlans(
            self.starts[rows], self.decelerations[rows], self.arcs[rows], self.speeds[rows]
        )


class ReplayStates(NamedTuple):
    """States of replays of one actor at N moments.

    Attributes:
        poses: x, y, yaw, shape (N, 3).
        speeds: Speeds along the path, shape (N,), m/s.
        arcs: Distances along the path, shape (N,), metres.
        turned: Sums of the absolute turns along the path, shape (N,), radians.
        stretches: Numbers of the path's stretches, shape (N,).
    """

    poses: FloatArray
    speeds: FloatArray
    arcs: FloatArray
    turned: FloatArray
    stretches: IntArray

    def velocities(self, motion: Motion) -> FloatArray:
        """Return the velocities along the path of `motion`, shape (N, 2), m/s.

        The direction of the path need not be the heading.
        """
        steps = motion.steps[:, :2]
        lengths = motion.lengths[:, None]
        directions = np.divide(steps, lengths, out=np.zeros_like(steps), where=lengths > 0)
        velocities: FloatArray = self.speeds[:, None] * directions[self.stretches]
        return velocities


def motion_of(path: ArrayLike, *, horizon: float = HORIZON) -> Motion:
    """Return the motion along a path, continued for `horizon` seconds.

    Args:
        path: x, y, yaw at 10 Hz, shape (F, 3).
        horizon: Time of the continuation, seconds.

    Raises:
        GeometryError: The path has a wrong shape, fewer than two frames, or contains NaN.
    """
    poses = checked("path", path, (None, 3)).copy()
    if len(poses) < 2 or not np.isfinite(poses).all():
        raise GeometryError(
            "path: expected an array of finite x, y, yaw with two or more frames, found shape "
            f"{poses.shape} or a NaN"
        )
    poses[:, 2] = np.unwrap(poses[:, 2])
    last_step = poses[-1, :2] - poses[-2, :2]
    continuation = np.zeros(3)
    if np.hypot(*last_step) > _STANDING_STEP_M:
        continuation[:2] = last_step * (horizon / FRAME_PERIOD)
    poses = np.concatenate([poses, [poses[-1] + continuation]])
    steps = np.diff(poses, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    turns = np.abs(steps[:, 2])
    periods = np.full(len(steps), FRAME_PERIOD)
    periods[-1] = horizon
    frame_times = np.arange(len(steps)) * FRAME_PERIOD
    return Motion(
        poses=poses,
        times=np.append(frame_times, frame_times[-1] + horizon),
        arcs=np.concatenate([[0.0], np.cumsum(lengths)]),
        turned=np.concatenate([[0.0], np.cumsum(turns)]),
        speeds=lengths / periods,
        steps=steps,
        periods=periods,
        lengths=lengths,
    )


def braking_plans(motion: Motion, starts: ArrayLike, decelerations: ArrayLike) -> BrakingPlans:
    """Return the plans of N replays of a motion.

    From the end of the recording on, braking has no effect: such times, inf and NaN give plans
    without braking. Nothing is recorded before time 0, so braking begins at time 0 at the earliest.

    Args:
        motion: The recorded motion.
        starts: Start times of the braking, shape (N,), seconds.
        decelerations: Decelerations, shape (N,) or one number, m/s².

    Raises:
        GeometryError: An array has another shape.
    """
    brake_times = checked("starts", starts, (None,))
    shape = brake_times.shape
    replay_decelerations = checked("decelerations", np.broadcast_to(decelerations, shape), shape)
    brakes = brake_times < motion.duration - _FRAME_TOLERANCE * FRAME_PERIOD
    times = np.where(brakes, np.maximum(brake_times, 0.0), 0.0)
    stretches = motion.stretches(times)
    speeds = motion.speeds[stretches]
    arcs = motion.arcs[stretches] + speeds * (times - motion.times[stretches])
    return BrakingPlans(
        starts=np.where(brakes, times, np.inf),
        decelerations=replay_decelerations,
        arcs=np.where(brakes, arcs, np.inf),
        speeds=np.where(brakes, speeds, 0.0),
    )


def replay(motion: Motion, plans: BrakingPlans, rows: IntArray, times: FloatArray) -> ReplayStates:
    """Return the states of replays of one actor.

    Args:
        motion: The recorded motion.
        plans: Braking plans of the replays.
        rows: Rows of the replays among the plans, shape (N,).
        times: Times of the motion, shape (N,), seconds.
    """
    stretches = motion.stretches(times)
    speeds = motion.speeds[stretches]
    elapsed = times - motion.times[stretches]
    arcs = motion.arcs[stretches] + speeds * elapsed
    shares = elapsed / motion.periods[stretches]
    braking = np.flatnonzero(times > plans.starts[rows])
    if len(braking):
        active_plans = plans.take(rows[braking])
        is_behind, braked_arcs, braked_speeds = _brake(active_plans, times[braking], arcs[braking])
        behind = braking[is_behind]
        speeds[behind] = braked_speeds
        arcs[behind] = braked_arcs
        stretches[behind], shares[behind] = _locate_arcs(motion, braked_arcs)
    steps = motion.steps[stretches]
    poses = motion.poses[stretches] + shares[:, None] * steps
    turned = motion.turned[stretches] + shares * np.abs(steps[:, 2])
    return ReplayStates(poses, speeds, arcs, turned, stretches)


def _brake(
    plans: BrakingPlans, times: FloatArray, arcs: FloatArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Return the braked arc lengths and speeds of replays that are behind the recording.

    Args:
        plans: Braking plans of N replays.
        times: Times of the motion, shape (N,), seconds.
        arcs: Arc lengths of the recording at the times, shape (N,), metres.

    Returns:
        Whether each replay is behind the recording, shape (N,); and for the M replays that are,
        their arc lengths and speeds, each of shape (M,).
    """
    braking_time = np.minimum(times - plans.starts, plans.speeds / plans.decelerations)
    lost_speed = plans.decelerations * braking_time
    allowed_arcs = plans.arcs + (plans.speeds - lost_speed / 2) * braking_time
    speeds = np.maximum(0.0, plans.speeds - lost_speed)
    is_behind = allowed_arcs < arcs - _ARC_TOLERANCE_M
    return is_behind, allowed_arcs[is_behind], speeds[is_behind]


def _locate_arcs(motion: Motion, arcs: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the stretch on which each arc length lies, and the fraction of it up to that point.

    The arc lengths are shorter than the full path. If several stretches fit, the last one is used:
    an actor that is standing when it begins to brake keeps the heading with which it would drive
    on.
    """
    stretches = np.searchsorted(motion.arcs, arcs, side="right") - 1
    lengths = motion.lengths[stretches]
    distances = arcs - motion.arcs[stretches]
    shares = np.divide(distances, lengths, out=np.zeros_like(arcs), where=lengths > 0)
    return stretches, shares
