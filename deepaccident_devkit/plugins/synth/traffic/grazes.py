"""Contacts beside the accident: a driver swerves, and scrapes along a vehicle that it passes."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from deepaccident_devkit.plugins.synth.traffic.driving import PERIOD, WHEELBASE
from deepaccident_devkit.plugins.synth.traffic.simulate import Simulation, relative, separation
from deepaccident_devkit.support.arrays import FloatArray

# Largest gap between two vehicles that pass each other side by side that a swerve can close.
_MAX_GAP_M = 2.2
# Both vehicles are faster than this, m/s.
_MIN_SPEED = 2.5
# Two vehicles pass each other side by side if their nearest parts are at most this much nearer than
# their flanks.
_FLANK_TOLERANCE_M = 0.1
# Depth of the two in each other where they are side by side, and the limit of it at any time.
_CONTACT_DEPTH_M = 0.15
_MAX_DEPTH_M = 0.35
# Duration of a swerve to each side of the contact, and its shortest length.
_SWERVE_S = 1.9
_MIN_SWERVE_M = 9.0


def swerves(
    simulation: Simulation, size: FloatArray, drivers: Sequence[int], window: tuple[float, float]
) -> Iterator[tuple[tuple[int, int], Simulation]]:
    """Yield pairs of drivers that pass each other, and simulations in which the first one swerves.

    Args:
        simulation: The simulation without a swerve.
        size: Lengths and widths, shape (A, 2), metres.
        drivers: Rows of the drivers.
        window: Start and end of the time in which the two touch, seconds; both move then.

    Yields:
        The rows of the two, and the simulation in which they touch.
    """
    in_window = (simulation.time > window[0]) & (simulation.time < window[1])
    moving = in_window[:, None] & (simulation.states[..., 3] > _MIN_SPEED)
    for row, other_row in combinations(drivers, 2):
        poses = simulation.poses[:, row]
        other_poses = simulation.poses[:, other_row]
        lateral = relative(poses, other_poses[:, :2])[:, 1]
        gap = separation(poses, size[row], other_poses, size[other_row])
        flank_gap = np.abs(lateral) - size[[row, other_row], 1].mean()
        both_moving = moving[:, row] & moving[:, other_row]
        side_by_side = both_moving & (flank_gap - gap < _FLANK_TOLERANCE_M)
        passing_gap = np.where(side_by_side, gap, np.inf)
        step = int(passing_gap.argmin())
        if passing_gap[step] >= _MAX_GAP_M:
            continue
        shift = np.copysign(passing_gap[step] + _CONTACT_DEPTH_M, lateral[step])
        swerving = _swerving(simulation, row, step, shift, WHEELBASE * size[row, 0])
        gap = separation(swerving.poses[:, row], size[row], other_poses, size[other_row])
        if gap.min() > -_MAX_DEPTH_M and gap[~both_moving].min() > 0:
            yield (row, other_row), swerving


def _swerving(
    simulation: Simulation, row: int, step: int, shift: float, wheelbase: float
) -> Simulation:
    """Return a simulation in which one driver is `shift` metres farther to the left at a step."""
    states = simulation.states.copy()
    velocities = simulation.velocities.copy()
    x, y, yaw, speed, _ = states[:, row].T
    along = np.cumsum(speed) * PERIOD
    reach = max(_SWERVE_S * speed[step], _MIN_SWERVE_M)
    phase = np.clip((along - along[step]) / reach, -1.0, 1.0) * np.pi / 2
    lateral = shift * np.cos(phase) ** 4  # so the steering does not jump where the swerve ends
    slope = -2 * np.pi / reach * shift * np.cos(phase) ** 3 * np.sin(phase)
    swerving_yaw = yaw + np.arctan(slope)
    # The swerve moves the rear axle, because rear wheels do not slide.
    rear = x + 1j * y + (1j * lateral - wheelbase / 2) * np.exp(1j * yaw)
    middle = rear + wheelbase / 2 * np.exp(1j * swerving_yaw)
    states[:, row, :3] = np.stack([middle.real, middle.imag, swerving_yaw], axis=-1)
    velocities[:, row] = np.gradient(states[:, row, :2], PERIOD, axis=0)
    return replace(simulation, states=states, velocities=velocities)
