"""Contacts other than the accident: a driver swerves, and sideswipes a vehicle that it passes."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from deepaccident_devkit.plugins.synth.traffic.driving import PERIOD, WHEELBASE
from deepaccident_devkit.plugins.synth.traffic.simulate import (
    Simulation,
    separation,
    to_pose_frame,
)
from deepaccident_devkit.support.arrays import FloatArray

# Largest gap that a swerve can close between two vehicles that pass each other side by side.
_MAX_GAP_M = 2.2
# Smallest speed of both vehicles, m/s.
_MIN_SPEED = 2.5
# Two vehicles are side by side if their nearest points are at most this much nearer to each other
# than their flanks.
_FLANK_TOLERANCE_M = 0.1
# Depth to which the two overlap where they are side by side, and the largest depth at any time.
_CONTACT_DEPTH_M = 0.15
_MAX_DEPTH_M = 0.35
# Duration of a swerve before the contact, and as much after it; and the shortest such length.
_SWERVE_S = 1.9
_MIN_SWERVE_M = 9.0


def find_swerves(
    simulation: Simulation, size: FloatArray, drivers: Sequence[int], window: tuple[float, float]
) -> Iterator[tuple[tuple[int, int], Simulation]]:
    """Find pairs of drivers that pass each other closely, and let the first of each swerve.

    Args:
        simulation: The simulation without a swerve.
        size: Lengths and widths, shape (A, 2), metres.
        drivers: Rows of the drivers.
        window: Start and end of the time in which two drivers may touch, seconds; both move then.

    Yields:
        The rows of the two, and the simulation in which they touch.
    """
    in_window = (simulation.time > window[0]) & (simulation.time < window[1])
    is_moving = in_window[:, None] & (simulation.speeds > _MIN_SPEED)
    for row, other_row in combinations(drivers, 2):
        poses = simulation.poses[:, row]
        other_poses = simulation.poses[:, other_row]
        lateral = to_pose_frame(poses, other_poses[:, :2])[:, 1]
        gap = separation(poses, size[row], other_poses, size[other_row])
        mean_width = size[[row, other_row], 1].mean()
        flank_gap = np.abs(lateral) - mean_width
        both_move = is_moving[:, row] & is_moving[:, other_row]
        side_by_side = both_move & (flank_gap - gap < _FLANK_TOLERANCE_M)
        passing_gap = np.where(side_by_side, gap, np.inf)
        step = int(passing_gap.argmin())
        min_gap = passing_gap[step]
        if min_gap >= _MAX_GAP_M:
            continue
        shift = np.copysign(min_gap + _CONTACT_DEPTH_M, lateral[step])
        wheelbase = WHEELBASE * size[row, 0]
        swerving = _add_swerve(simulation, row, step, shift, wheelbase)
        new_gap = separation(swerving.poses[:, row], size[row], other_poses, size[other_row])
        if new_gap.min() > -_MAX_DEPTH_M and new_gap[~both_move].min() > 0:
            yield (row, other_row), swerving


def _add_swerve(
    simulation: Simulation, row: int, step: int, shift: float, wheelbase: float
) -> Simulation:
    """Return a simulation in which one driver swerves.

    Args:
        simulation: The simulation without the swerve.
        row: Row of the driver.
        step: Step at which the swerve is widest.
        shift: Sideways shift at that step, metres, positive to the left.
        wheelbase: Wheelbase of the vehicle, metres.
    """
    states = simulation.states.copy()
    velocities = simulation.velocities.copy()
    x, y, yaw, speed, _ = states[:, row].T
    along = np.cumsum(speed) * PERIOD
    half_length = max(_SWERVE_S * speed[step], _MIN_SWERVE_M)
    progress = np.clip((along - along[step]) / half_length, -1.0, 1.0)
    phase = progress * np.pi / 2
    cos = np.cos(phase)
    lateral = shift * cos**4  # so the steering does not jump where the swerve ends
    slope = -2 * np.pi / half_length * shift * cos**3 * np.sin(phase)
    swerving_yaw = yaw + np.arctan(slope)
    # The swerve moves the rear axle, because rear wheels do not slide. Positions are complex here.
    center = x + 1j * y
    half_wheelbase = wheelbase / 2
    rear_axle = center + (1j * lateral - half_wheelbase) * np.exp(1j * yaw)
    swerving_center = rear_axle + half_wheelbase * np.exp(1j * swerving_yaw)
    new_poses = [swerving_center.real, swerving_center.imag, swerving_yaw]
    states[:, row, :3] = np.stack(new_poses, axis=-1)
    velocities[:, row] = np.gradient(states[:, row, :2], PERIOD, axis=0)
    return replace(simulation, states=states, velocities=velocities)
