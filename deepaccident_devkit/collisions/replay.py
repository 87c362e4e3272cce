"""Recorded motions, and the same with braking from some moment on: positions, speeds and arc lengths at any time.

A braking actor stays on its recorded path. How far it has come is the lesser of what it came in the recording and what
the braking allows, so that an actor that brakes harder in the recording does so in the replay too, and nobody is sped
up. There are no limits of jerk or friction.
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
"""Seconds after the end of the recording in which actors go straight on."""
# Metres; an actor whose last step is no longer than this stands after the recording.
_STANDING: Final = 1e-3
# Share of a frame by which a time that is meant to be a frame's may miss it.
_SAME_TIME: Final = 1e-6
# Metres behind the recording from which a braking actor counts as behind it.
_SAME_ARC: Final = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion(FrozenArrays):
    """A recorded path and what follows it: from the last frame straight on at the last speed, the heading kept.

    Positions and headings are linear in time between neighbouring nodes: the F frames, and the end of the
    continuation. Any right-handed frame; metres, radians, seconds; arrays are read-only.

    Attributes:
        poses: (F + 1, 3) x, y, yaw at the nodes; yaw without jumps by 2π.
        times: (F + 1,) of the nodes, the first 0.
        arcs: (F + 1,) lengths of the path up to the nodes.
        turned: (F + 1,) sums of the absolute turns up to the nodes.
        speeds: (F,) between the nodes, m/s.
        steps: (F, 3) changes of the poses from each node to the next.
        periods: (F,) seconds from each node to the next.
        lengths: (F,) metres from each node to the next.
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
        """Seconds of the recording."""
        return float(self.times[-2])

    def stretches(self, times: FloatArray) -> IntArray:
        """(…) numbers of the stretches between nodes that hold some times; a frame's time is of the one after it.

        The end of the recording is of its last stretch, since the speed there is the one of the impact.
        """
        last = len(self.speeds) - 1
        numbers: IntArray = (times / FRAME_PERIOD + _SAME_TIME).astype(np.int64)
        np.minimum(numbers, last - 1, out=numbers)
        numbers[times > self.duration] = last
        return numbers


class BrakingPlans(NamedTuple):
    """When N replays of one actor begin to brake, and how hard.

    Attributes:
        starts: (N,) seconds; inf for no braking.
        decelerations: (N,) m/s².
        arcs: (N,) metres along the path at which the braking begins; inf for no braking.
        speeds: (N,) m/s at which it begins; 0 for no braking.
    """

    starts: FloatArray
    decelerations: FloatArray
    arcs: FloatArray
    speeds: FloatArray

    def take(self, rows: IntArray) -> BrakingPlans:
        """The plans of some rows."""
        return BrakingPlans(*(each[rows] for each in self))


class ReplayStates(NamedTuple):
    """Where replays of one actor are at N moments.

    Attributes:
        poses: (N, 3) x, y, yaw.
        speeds: (N,) along the path, m/s.
        arcs: (N,) metres along the path.
        turned: (N,) sums of the absolute turns along the path, radians.
        stretches: (N,) numbers of the path's stretches.
    """

    poses: FloatArray
    speeds: FloatArray
    arcs: FloatArray
    turned: FloatArray
    stretches: IntArray

    def velocities(self, motion: Motion) -> FloatArray:
        """(N, 2) m/s: along the path of `motion`, which need not be the heading."""
        steps, lengths = motion.steps[:, :2], motion.lengths[:, None]
        along = np.divide(steps, lengths, out=np.zeros_like(steps), where=lengths > 0)
        return np.asarray(self.speeds[:, None] * along[self.stretches])


def motion_of(path: ArrayLike, *, horizon: float = HORIZON) -> Motion:
    """The motion along a path (F, 3) of x, y, yaw at 10 Hz that goes on for `horizon` seconds; raises GeometryError."""
    poses = checked("path", path, (None, 3)).copy()
    if len(poses) < 2 or not np.isfinite(poses).all():
        raise GeometryError(
            f"path: expected two or more frames of finite x, y, yaw, found {poses.shape} or a NaN in it"
        )
    poses[:, 2] = np.unwrap(poses[:, 2])
    last_step = poses[-1, :2] - poses[-2, :2]
    onward = np.zeros(3)
    if np.hypot(*last_step) > _STANDING:
        onward[:2] = last_step * (horizon / FRAME_PERIOD)
    poses = np.concatenate([poses, [poses[-1] + onward]])
    steps = np.diff(poses, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    periods = np.full(len(steps), FRAME_PERIOD)
    periods[-1] = horizon
    end = (len(steps) - 1) * FRAME_PERIOD
    return Motion(
        poses=poses,
        times=np.append(np.arange(len(steps)) * FRAME_PERIOD, end + horizon),
        arcs=np.concatenate([[0.0], np.cumsum(lengths)]),
        turned=np.concatenate([[0.0], np.cumsum(np.abs(steps[:, 2]))]),
        speeds=lengths / periods,
        steps=steps,
        periods=periods,
        lengths=lengths,
    )


def braking_plans(motion: Motion, starts: ArrayLike, decelerations: ArrayLike) -> BrakingPlans:
    """The plans of N replays that begin to brake at `starts` (N,) seconds, with (N,) m/s² or one number.

    From the end of the recording on, braking has no effect: these, inf and NaN are plans without braking. Before 0
    nothing is recorded, and the braking begins at 0. Raises GeometryError.
    """
    given = checked("starts", starts, (None,))
    hard = checked("decelerations", np.broadcast_to(decelerations, given.shape), given.shape)
    brakes = given < motion.duration - _SAME_TIME * FRAME_PERIOD
    at = np.where(brakes, np.maximum(given, 0.0), 0.0)
    stretches = motion.stretches(at)
    speeds = motion.speeds[stretches]
    return BrakingPlans(
        starts=np.where(brakes, at, np.inf),
        decelerations=hard,
        arcs=np.where(
            brakes, motion.arcs[stretches] + speeds * (at - motion.times[stretches]), np.inf
        ),
        speeds=np.where(brakes, speeds, 0.0),
    )


def replay(motion: Motion, plans: BrakingPlans, rows: IntArray, times: FloatArray) -> ReplayStates:
    """Where replays of one actor are, by their numbers (N,) among plans, at `times` (N,) seconds of the motion."""
    stretches = motion.stretches(times)
    speeds = motion.speeds[stretches]
    passed = times - motion.times[stretches]
    arcs = motion.arcs[stretches] + speeds * passed
    shares = passed / motion.periods[stretches]
    late = np.flatnonzero(times > plans.starts[rows])
    if len(late):
        behind, allowed, left = _braked(plans.take(rows[late]), times[late], arcs[late])
        late = late[behind]
        speeds[late], arcs[late] = left, allowed
        stretches[late], shares[late] = _places(motion, allowed)
    poses = motion.poses[stretches] + shares[:, None] * motion.steps[stretches]
    turned = motion.turned[stretches] + shares * np.abs(motion.steps[stretches, 2])
    return ReplayStates(poses=poses, speeds=speeds, arcs=arcs, turned=turned, stretches=stretches)


def _braked(
    plans: BrakingPlans, times: FloatArray, arcs: FloatArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Which replays are behind the recording's arc lengths; of these, the arc lengths and speeds."""
    braking = np.minimum(times - plans.starts, plans.speeds / plans.decelerations)
    lost = plans.decelerations * braking
    allowed = plans.arcs + (plans.speeds - lost / 2) * braking
    behind = allowed < arcs - _SAME_ARC
    return behind, allowed[behind], np.maximum(0.0, plans.speeds - lost)[behind]


def _places(motion: Motion, arcs: FloatArray) -> tuple[IntArray, FloatArray]:
    """Stretches, and the shares of them, at which the path last has some lengths, shorter than the whole.

    So an actor that stands when it begins to brake keeps the heading that it has when it would drive on.
    """
    numbers = np.searchsorted(motion.arcs, arcs, side="right") - 1
    lengths = motion.lengths[numbers]
    shares = np.divide(
        arcs - motion.arcs[numbers], lengths, out=np.zeros_like(arcs), where=lengths > 0
    )
    return numbers, shares
