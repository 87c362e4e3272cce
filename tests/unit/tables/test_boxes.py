"""Which way of writing velocities a scenario keeps, and the release's own way there and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from deepaccident_devkit.release import label_from_world_velocity, world_from_label_velocity
from deepaccident_devkit.tables.boxes import VelocityFit, displacement_velocities, total_fit
from deepaccident_devkit.taxonomy import VELOCITY_FRAMES

NUMBERS = st.floats(-50, 50)


def make_fit(boxes: int, **fits: int) -> VelocityFit:
    return VelocityFit(boxes=boxes, fits={name: fits.get(name, 0) for name in VELOCITY_FRAMES})


@given(
    velocity=hnp.arrays(float, (5, 2), elements=NUMBERS), yaw=hnp.arrays(float, 5, elements=NUMBERS)
)
def test_there_and_back_in_either_handedness(velocity: np.ndarray, yaw: np.ndarray) -> None:
    written = label_from_world_velocity(velocity, yaw)
    np.testing.assert_allclose(world_from_label_velocity(written, yaw), velocity, atol=1e-9)
    np.testing.assert_allclose(
        label_from_world_velocity(velocity * (1, -1), -yaw), written * (1, -1), atol=1e-9
    )


def test_a_real_line_is_what_the_format_says() -> None:
    """A car with yaw 90° (clockwise, y right) in the label that drives along world x has its
    velocity along y.
    """
    np.testing.assert_allclose(
        label_from_world_velocity(np.array([[8.0, 0.0]]), np.array([np.pi / 2])),
        [[0, 8]],
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("velocity_fit", "best_frame"),
    [
        (make_fit(100, released=97, lidar=18), "released"),
        (
            make_fit(100, released=96, lidar=100),
            "released",
        ),  # all drive along x: nothing tells them apart
        (make_fit(100, released=60, lidar=100), "lidar"),
        (make_fit(100, released=49, world=20), None),
        (make_fit(19, released=19), None),
        (make_fit(0), None),
    ],
)
def test_the_best_frame(velocity_fit: VelocityFit, best_frame: str | None) -> None:
    assert velocity_fit.best == best_frame


def test_fits_add_up() -> None:
    assert total_fit([make_fit(10, released=9), make_fit(15, released=15, box=2)]) == make_fit(
        25, released=24, box=2
    )
    assert total_fit([]).best is None


def test_displacements_are_of_one_agents_neighbour_frames() -> None:
    """Central, one-sided, none over a gap, none of the untracked; another agent's rows do not
    count.
    """
    frame = np.array([1, 2, 3, 5, 1, 1])
    agent = np.array([0, 0, 0, 0, 0, 1])
    label_id = np.array([7, 7, 7, 7, -1, 7])
    centers = np.column_stack([[0.0, 1.0, 4.0, 9.0, 3.0, 50.0], np.zeros(6), np.zeros(6)])
    speeds = displacement_velocities(centers, agent, label_id, frame)[:, 0]
    np.testing.assert_allclose(speeds, [10, 20, 30, np.nan, np.nan, np.nan])
