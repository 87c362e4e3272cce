"""Contacts beside the accident: a driver swerves, and scrapes along a vehicle that it passes."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from deepaccident_devkit.plugins.synth.traffic.driving import PERIOD, WHEELBASE
from deepaccident_devkit.plugins.synth.traffic.simulate import Simulation, relative, separation
from deepaccident_devkit.support.arrays import FloatArray

# The most between two vehicles that pass each other side by side, so that a swerve can close the gap.
_MOST_GAP_M = 2.2
# m/s of both.
_LEAST_SPEED = 2.5
# How much nearer than their flanks the nearest parts of two are that still pass each other side by side.
_BESIDE_M = 0.1
# How deep the two are in each other where they are side by side, and the most at any time.
_DEPTH_M, _DEEPEST_M = 0.15, 0.35
# How long a swerve takes to each side of the contact, and over which distance at least.
_SWERVE_S, _SHORTEST_SWERVE_M = 1.9, 9.0


def swerves(
    simulation: Simulation, size: FloatArray, drivers: Sequence[int], window: tuple[float, float]
) -> Iterator[tuple[tuple[int, int], Simulation]]:
    """Yield rows of two drivers who pass each other side by side, and what happens if the first one swerves.

    Sizes are (A, 2) length and width, metres. The two touch in a window, seconds, and while both move.
    """
    inside = (simulation.time > window[0]) & (simulation.time < window[1])
    moving = inside[:, None] & (simulation.states[..., 3] > _LEAST_SPEED)
    for row, other in combinations(drivers, 2):
        poses, others = simulation.poses[:, row], simulation.poses[:, other]
        left = relative(poses, others[:, :2])[:, 1]
        apart = separation(poses, size[row], others, size[other])
        flanks = np.abs(left) - size[[row, other], 1].mean()
        both = moving[:, row] & moving[:, other]
        gap = np.where(both & (flanks - apart < _BESIDE_M), apart, np.inf)
        step = int(gap.argmin())
        if gap[step] < _MOST_GAP_M:
            shift = np.copysign(gap[step] + _DEPTH_M, left[step])
            swerving = _swerving(simulation, row, step, shift, WHEELBASE * size[row, 0])
            apart = separation(swerving.poses[:, row], size[row], others, size[other])
            if apart.min() > -_DEEPEST_M and apart[~both].min() > 0:
                yield (row, other), swerving


def _swerving(
    simulation: Simulation, row: int, step: int, shift: float, wheelbase: float
) -> Simulation:
    """Return a simulation in which one driver is `shift` metres farther to the left at a step."""
    states, velocities = simulation.states.copy(), simulation.velocities.copy()
    x, y, yaw, speed, _ = states[:, row].T
    along = np.cumsum(speed) * PERIOD
    reach = max(_SWERVE_S * speed[step], _SHORTEST_SWERVE_M)
    phase = np.clip((along - along[step]) / reach, -1.0, 1.0) * np.pi / 2
    left = shift * np.cos(phase) ** 4  # so the steering does not jump where the swerve ends
    slope = -2 * np.pi / reach * shift * np.cos(phase) ** 3 * np.sin(phase)
    turned = yaw + np.arctan(slope)
    rear = x + 1j * y + (1j * left - wheelbase / 2) * np.exp(1j * yaw)  # where wheels do not slide
    middle = rear + wheelbase / 2 * np.exp(1j * turned)
    states[:, row, :3] = np.stack([middle.real, middle.imag, turned], axis=-1)
    velocities[:, row] = np.gradient(states[:, row, :2], PERIOD, axis=0)
    return replace(simulation, states=states, velocities=velocities)
