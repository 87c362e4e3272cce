"""Replays of recorded motions, with braking from some moment on.

They give positions, speeds and arc lengths at any time. A braking actor stays on its recorded path.
Its arc length is the lesser of the recorded one and the one that the braking allows, so that an
actor that brakes harder in the recording does so in the replay too, and no actor is sped up. There
are no limits of jerk or friction.
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
# An actor with a last step no longer than this stands still after the recording.
_STANDING_STEP_M: Final = 1e-3
# A time may miss the frame that it means by this share of a frame.
_FRAME_TOLERANCE: Final = 1e-6
# A braking actor counts as behind the recording from this distance on.
_ARC_TOLERANCE_M: Final = 1e-9


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
        """Return the numbers of the stretches between nodes that hold times, shape as `times`.

        The time of a frame belongs to the stretch after it. The end of the recording belongs to its
        last stretch, since the speed on it is that of the impact.
        """
        continuation = len(self.speeds) - 1
        numbers: IntArray = (times / FRAME_PERIOD + _FRAME_TOLERANCE).astype(np.int64)
        np.minimum(numbers, continuation - 1, out=numbers)
        numbers[times > self.duration] = continuation
        return numbers


class BrakingPlans(NamedTuple):
    """Begin and strength of the braking in N replays of one actor.

    Attributes:
        starts: Times at which the braking begins, shape (N,), seconds; inf for no braking.
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
        """Return the plans of some rows."""
        return BrakingPlans(*(column[rows] for column in self))


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
        return np.asarray(self.speeds[:, None] * directions[self.stretches])


def motion_of(path: ArrayLike, *, horizon: float = HORIZON) -> Motion:
    """Return the motion along a path, which goes on for `horizon` seconds.

    Args:
        path: x, y, yaw at 10 Hz, shape (F, 3).
        horizon: Time of the continuation, seconds.

    Raises:
        GeometryError: The path has another shape, fewer than two frames, or a NaN.
    """
    poses = checked("path", path, (None, 3)).copy()
    if len(poses) < 2 or not np.isfinite(poses).all():
        raise GeometryError(
            "path: expected two or more frames of finite x, y, yaw, "
            f"found {poses.shape} or a NaN in it"
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
    end = (len(steps) - 1) * FRAME_PERIOD
    return Motion(
        poses=poses,
        times=np.append(np.arange(len(steps)) * FRAME_PERIOD, end + horizon),
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
    without braking. Nothing is recorded before 0, so that the braking begins at 0 at the earliest.

    Args:
        motion: The recorded motion.
        starts: Times at which the braking begins, shape (N,), seconds.
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
        behind, braked_arcs, braked_speeds = _braked(active_plans, times[braking], arcs[braking])
        braked = braking[behind]
        speeds[braked] = braked_speeds
        arcs[braked] = braked_arcs
        stretches[braked], shares[braked] = _positions(motion, braked_arcs)
    poses = motion.poses[stretches] + shares[:, None] * motion.steps[stretches]
    turned = motion.turned[stretches] + shares * np.abs(motion.steps[stretches, 2])
    return ReplayStates(poses=poses, speeds=speeds, arcs=arcs, turned=turned, stretches=stretches)


def _braked(
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
    behind = allowed_arcs < arcs - _ARC_TOLERANCE_M
    return behind, allowed_arcs[behind], speeds[behind]


def _positions(motion: Motion, arcs: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the last stretches, and shares of them, at which the path has some lengths.

    The lengths are shorter than the full path. An actor that stands when it begins to brake
    therefore keeps the heading with which it would drive on.
    """
    numbers = np.searchsorted(motion.arcs, arcs, side="right") - 1
    lengths = motion.lengths[numbers]
    distances = arcs - motion.arcs[numbers]
    shares = np.divide(distances, lengths, out=np.zeros_like(arcs), where=lengths > 0)
    return numbers, shares
