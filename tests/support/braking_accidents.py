"""Accidents for the tests of `accidents` and `safety`; their outcome under braking follows from
school physics.
"""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

from deepaccident_devkit.collisions.recorded import Accident

CAR_SIZE = (4.0, 2.0, 1.5)
STEP_S = 0.1


def straight_path(start: tuple[float, float], yaw: float, speed: float, frames: int) -> np.ndarray:
    """Make a path of shape (F, 3) at constant speed along the heading."""
    distance = np.arange(frames) * STEP_S * speed
    return np.column_stack(
        [
            start[0] + distance * np.cos(yaw),
            start[1] + distance * np.sin(yaw),
            np.full(frames, yaw),
        ]
    )


def make_accident(
    first: np.ndarray,
    second: np.ndarray,
    *,
    sizes: tuple[tuple[float, float, float], ...] = (CAR_SIZE, CAR_SIZE),
    masses: tuple[float, float] = (1500.0, 1500.0),
    categories: tuple[str, str] = ("car", "car"),
) -> Accident:
    """Make an accident from two paths; the first actor is the ego."""
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


def swap_actors(accident: Accident) -> Accident:
    """Make the same accident with the other actor first."""
    return make_accident(
        accident.paths[1],
        accident.paths[0],
        sizes=(tuple(accident.sizes[1]), tuple(accident.sizes[0])),
        masses=(accident.masses[1], accident.masses[0]),
    )


def rear_end_accident(
    striker: float = 20.0, leader: float = 10.0, seconds: float = 5.0
) -> Accident:
    """Make an accident in which a striker (first) reaches the rear of a leader exactly at the last
    frame, both at constant speeds in m/s.
    """
    frames = round(seconds / STEP_S) + 1
    distance = CAR_SIZE[0] + (striker - leader) * seconds

    return make_accident(
        straight_path((0, 0), 0, striker, frames),
        straight_path((distance, 0), 0, leader, frames),
    )


def head_on_accident(speed: float = 10.0, seconds: float = 5.0) -> Accident:
    """Make an accident of two cars that drive towards each other at the same speed, m/s, and touch
    exactly at the last frame.
    """
    frames = round(seconds / STEP_S) + 1
    distance = CAR_SIZE[0] + 2 * speed * seconds

    return make_accident(
        straight_path((0, 0), 0, speed, frames),
        straight_path((distance, 0), np.pi, speed, frames),
    )


@st.composite
def erratic_paths(draw: Callable[..., float], frames: int = 21) -> np.ndarray:
    """Draw a path of shape (F, 3) that turns, stands still and jumps in speed, and ends near the
    origin.
    """
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    levels = rng.choice([0.0, 2.0, 8.0, 15.0, 25.0], 7)
    speeds = np.repeat(levels, 3)[: frames - 1] + rng.normal(0, 0.3, frames - 1)
    speeds = np.maximum(speeds, 0) * (speeds > 0.5)
    yaws = np.cumsum(rng.normal(0, 0.08, frames)) + rng.uniform(-np.pi, np.pi)

    headings = np.column_stack([np.cos(yaws[1:]), np.sin(yaws[1:])])
    steps = headings * speeds[:, None] * STEP_S
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    end = rng.uniform(-3, 3, 2)
    return np.column_stack([xy - xy[-1] + end, yaws])


@st.composite
def erratic_accidents(draw: Callable[..., np.ndarray]) -> Accident:
    """Draw an accident of two erratic paths that end near each other."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    sizes = tuple((float(rng.uniform(0.4, 9)), float(rng.uniform(0.4, 2.5)), 1.5) for _ in range(2))
    masses = (float(rng.uniform(70, 9000)), float(rng.uniform(70, 9000)))

    return make_accident(
        draw(erratic_paths()),
        draw(erratic_paths()),
        sizes=sizes,
        masses=masses,
    )
