"""Accidents whose outcome under braking follows from school physics, for the tests of `accidents`
and `safety`.
"""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from deepaccident_devkit.collisions.recorded import Accident

CAR = (4.0, 2.0, 1.5)
STEP = 0.1


def straight(start: tuple[float, float], yaw: float, speed: float, frames: int) -> np.ndarray:
    """(F, 3) constant speed along the heading."""
    way = np.arange(frames) * STEP * speed
    return np.column_stack(
        [start[0] + way * np.cos(yaw), start[1] + way * np.sin(yaw), np.full(frames, yaw)]
    )


def accident(
    first: np.ndarray,
    second: np.ndarray,
    *,
    sizes: tuple[tuple[float, float, float], ...] = (CAR, CAR),
    masses: tuple[float, float] = (1500.0, 1500.0),
    categories: tuple[str, str] = ("car", "car"),
) -> Accident:
    """An accident of two paths; the first actor is the ego."""
    return Accident(
        scenario="type1_subtype1_accident/Town01_type001_subtype0001_scenario00001",
        actor_ids=(11, 12),
        categories=categories,
        agents=("ego_vehicle", None),
        first_frame=1,
        num_frames=len(first),
        paths=np.stack([first, second]),
        sizes=np.array(sizes),
        masses=np.array(masses),
        interpolated=0,
    )


def swapped(given: Accident) -> Accident:
    """The same accident, the other actor first."""
    return accident(
        given.paths[1],
        given.paths[0],
        sizes=(tuple(given.sizes[1]), tuple(given.sizes[0])),
        masses=(given.masses[1], given.masses[0]),
    )


def rear_end(striker: float = 20.0, leader: float = 10.0, seconds: float = 5.0) -> Accident:
    """A striker (first) reaches the rear of a leader exactly at the last frame, both at constant
    speeds, m/s.
    """
    frames = round(seconds / STEP) + 1
    ahead = CAR[0] + (striker - leader) * seconds
    return accident(straight((0, 0), 0, striker, frames), straight((ahead, 0), 0, leader, frames))


def head_on(speed: float = 10.0, seconds: float = 5.0) -> Accident:
    """Two that drive towards each other at the same speed, m/s, and touch exactly at the last
    frame.
    """
    frames = round(seconds / STEP) + 1
    apart = CAR[0] + 2 * speed * seconds
    return accident(straight((0, 0), 0, speed, frames), straight((apart, 0), np.pi, speed, frames))


@st.composite
def wild_paths(draw: Callable[..., float], frames: int = 21) -> np.ndarray:
    """(F, 3) of a path with turns, standing still and jumps of speed, whose last frame is near the
    origin.
    """
    seed = draw(st.integers(0, 10_000))
    rng = np.random.default_rng(seed)
    speeds = np.repeat(rng.choice([0.0, 2.0, 8.0, 15.0, 25.0], 7), 3)[: frames - 1] + rng.normal(
        0, 0.3, frames - 1
    )
    speeds = np.maximum(speeds, 0) * (speeds > 0.5)
    yaws = np.cumsum(rng.normal(0, 0.08, frames)) + rng.uniform(-np.pi, np.pi)
    steps = np.column_stack([np.cos(yaws[1:]), np.sin(yaws[1:])]) * speeds[:, None] * STEP
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    end = rng.uniform(-3, 3, 2)
    return np.column_stack([xy - xy[-1] + end, yaws])


@st.composite
def wild_accidents(draw: Callable[..., np.ndarray]) -> Accident:
    """Two wild paths that end near each other."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    sizes = tuple((float(rng.uniform(0.4, 9)), float(rng.uniform(0.4, 2.5)), 1.5) for _ in range(2))
    first, second = float(rng.uniform(70, 9000)), float(rng.uniform(70, 9000))
    return accident(draw(wild_paths()), draw(wild_paths()), sizes=sizes, masses=(first, second))
