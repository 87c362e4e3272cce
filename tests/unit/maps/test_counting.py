"""A picture of a BEV camera in the cells of the world."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.maps.counting import GROUND_CLASSES, cells_around, codes_in_world
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.support.arrays import ByteArray


def checkered(side: int) -> ByteArray:
    """Squares of road and sidewalk, larger than cells."""
    index = np.arange(1200) // side
    return np.where((index[:, None] + index[None, :]) % 2 == 0, TAGS["road"], TAGS["sidewalk"]).astype(np.uint8)


@given(st.floats(-300, 300), st.floats(-300, 300), st.floats(-4, 4), st.floats(-0.15, 0.15), st.integers(0, 10**6))
def test_a_point_of_the_picture_is_at_its_place_in_the_world(x: float, y: float, yaw: float, tilt: float, seed: int):
    pitch = SE3.from_quaternion((np.cos(tilt / 2), 0, np.sin(tilt / 2), 0))
    world_from_ego = SE3.from_yaw(yaw, (x, y, 1.0)) @ pitch
    tags, resolution = checkered(40), 0.25
    (first_row, first_column), codes = codes_in_world(tags, world_from_ego.matrix, resolution)
    points = np.random.default_rng(seed).uniform(-59, 59, (200, 2))
    row, column = np.rint(599.5 - points.T / 0.1).astype(int)
    away = np.minimum(*(np.abs((each + 20) % 40 - 20 + 0.5) for each in (row, column))) > 4  # of a square's edge
    placed = world_from_ego.apply(np.column_stack([points, np.zeros(len(points))]))[:, :2]
    cell_column, cell_row = np.floor(placed / resolution).astype(int).T
    found = codes[cell_row - first_row, cell_column - first_column]
    expected = np.where(tags[row, column] == TAGS["road"], 1, 3)
    assert away.sum() > 50
    np.testing.assert_array_equal(found[away], expected[away])


def test_beyond_the_picture_nothing_is_seen() -> None:
    (first_row, first_column), codes = codes_in_world(
        np.full((1200, 1200), TAGS["road"], np.uint8), SE3.from_yaw(0.7).matrix, 0.5
    )
    side = codes.shape[0] * 0.5
    assert side == pytest.approx(120 * (np.cos(0.7) + np.sin(0.7)), abs=1.5)
    assert codes[0, 0] == codes[-1, -1] == 0
    assert codes.sum() * 0.25 == pytest.approx(120**2, rel=0.002)
    assert codes[-first_row, -first_column] == 1


def test_what_moves_and_what_has_no_tag_says_nothing_of_the_ground() -> None:
    tags = np.full((1200, 1200), 22, np.uint8)
    rows = {"pedestrian": 100, "vehicle": 300, "road_line": 500, "road": 700, "sidewalk": 900}
    for name, row in rows.items():
        tags[row : row + 100] = TAGS[name]
    tags[1100:] = 0
    (first_row, first_column), codes = codes_in_world(tags, np.eye(4), 0.5)
    seen = {name: codes[-first_row, int((599.5 - row - 50) * 0.1 / 0.5) - first_column] for name, row in rows.items()}
    assert seen == {"pedestrian": 0, "vehicle": 0, "road_line": 2, "road": 1, "sidewalk": 3}
    assert codes[-first_row, int(-55 / 0.5) - first_column] == 0
    assert codes[-first_row, int(55 / 0.5) - first_column] == 1 + GROUND_CLASSES.index("other")


@pytest.mark.parametrize("resolution", [0.1, 0.25, 0.7])
def test_the_cells_around_hold_every_picture(resolution: float) -> None:
    rng = np.random.default_rng(5)
    poses = np.stack([SE3.from_yaw(yaw, (*rng.uniform(-90, 90, 2), 0)).matrix for yaw in rng.uniform(-4, 4, 6)])
    low, high = cells_around(poses, resolution)
    parts = [cells_around(pose[None], resolution) for pose in poses]
    np.testing.assert_array_equal(low, np.min([part[0] for part in parts], axis=0))
    np.testing.assert_array_equal(high, np.max([part[1] for part in parts], axis=0))
    corners = np.array([[x, y, 0, 1] for x in (-60, 60) for y in (-60, 60)])
    reached = (poses @ corners.T)[:, :2] / resolution
    np.testing.assert_array_equal(low[::-1], np.floor(reached.min(axis=(0, 2)) + 1e-9))
    np.testing.assert_array_equal(high[::-1], np.ceil(reached.max(axis=(0, 2)) - 1e-9))
