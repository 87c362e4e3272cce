"""What a BEV camera's picture adds to the cells of the world."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.maps import TownMapConfig
from deepaccident_devkit.maps.counting import (
    GROUND_CLASSES,
    agent_pictures,
    cells_around,
    codes_in_world,
    hidden_ground,
    select_frames,
)
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.support.arrays import ByteArray
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA


def make_checkerboard(side: int) -> ByteArray:
    """Make a picture with squares of road and sidewalk, larger than cells."""
    index = np.arange(1200) // side
    is_road = (index[:, None] + index[None, :]) % 2 == 0
    return np.where(is_road, TAGS["road"], TAGS["sidewalk"]).astype(np.uint8)


def distance_to_edge(pixels: np.ndarray) -> np.ndarray:
    """Return how many pixels lie between each pixel and the edge of its square."""
    return np.abs((pixels + 20) % 40 - 20 + 0.5)


@given(
    st.floats(-300, 300),
    st.floats(-300, 300),
    st.floats(-4, 4),
    st.floats(-0.15, 0.15),
    st.integers(0, 10**6),
)
def test_a_point_of_the_picture_is_at_its_place_in_the_world(
    x: float, y: float, yaw: float, tilt: float, seed: int
):
    pitch = SE3.from_quaternion((np.cos(tilt / 2), 0, np.sin(tilt / 2), 0))
    world_from_ego = SE3.from_yaw(yaw, (x, y, 1.0)) @ pitch
    tags = make_checkerboard(40)
    resolution = 0.25
    (first_row, first_column), codes = codes_in_world(tags, world_from_ego.matrix, resolution)

    points = np.random.default_rng(seed).uniform(-59, 59, (200, 2))
    row, column = np.rint(599.5 - points.T / 0.1).astype(int)
    expected_codes = np.where(tags[row, column] == TAGS["road"], 1, 3)

    world_points = world_from_ego.apply(np.column_stack([points, np.zeros(len(points))]))
    cell_column, cell_row = np.floor(world_points[:, :2] / resolution).astype(int).T
    point_codes = codes[cell_row - first_row, cell_column - first_column]
    is_inside_square = np.minimum(distance_to_edge(row), distance_to_edge(column)) > 4
    assert is_inside_square.sum() > 50
    np.testing.assert_array_equal(point_codes[is_inside_square], expected_codes[is_inside_square])


def test_beyond_the_picture_nothing_is_seen() -> None:
    tags = np.full((1200, 1200), TAGS["road"], np.uint8)
    (first_row, first_column), codes = codes_in_world(tags, SE3.from_yaw(0.7).matrix, 0.5)
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
    expected = {"pedestrian": 0, "vehicle": 0, "road_line": 2, "road": 1, "sidewalk": 3}
    for name, row in rows.items():
        column = int((599.5 - row - 50) * 0.1 / 0.5)
        assert codes[-first_row, column - first_column] == expected[name]
    assert codes[-first_row, int(-55 / 0.5) - first_column] == 0
    assert codes[-first_row, int(55 / 0.5) - first_column] == 1 + GROUND_CLASSES.index("other")


@pytest.mark.parametrize("resolution", [0.1, 0.25, 0.7])
def test_the_cells_around_hold_every_picture(resolution: float) -> None:
    rng = np.random.default_rng(5)
    yaws = rng.uniform(-4, 4, 6)
    poses = np.stack([SE3.from_yaw(yaw, (*rng.uniform(-90, 90, 2), 0)).matrix for yaw in yaws])
    low, high = cells_around(poses, resolution)

    pose_lows, pose_highs = zip(
        *[cells_around(pose[None], resolution) for pose in poses], strict=True
    )
    np.testing.assert_array_equal(low, np.min(pose_lows, axis=0))
    np.testing.assert_array_equal(high, np.max(pose_highs, axis=0))
    corners = np.array([[x, y, 0, 1] for x in (-60, 60) for y in (-60, 60)])
    world_corners = (poses @ corners.T)[:, :2] / resolution
    np.testing.assert_array_equal(low[::-1], np.floor(world_corners.min(axis=(0, 2)) + 1e-9))
    np.testing.assert_array_equal(high[::-1], np.ceil(world_corners.max(axis=(0, 2)) - 1e-9))


def test_settings_that_are_refused() -> None:
    for name, value, message in (
        ("resolution", 0.05, ("at least 0.1", "found 0.05")),
        ("resolution", float("nan"), ("at least 0.1", "found nan")),
        ("travel", 0.0, ("above 0", "found 0")),
        ("period", -1.0, ("above 0", "found -1")),
        ("period", float("inf"), ("above 0", "found inf")),
        ("travel", "far", ("a number", "found 'far'")),
    ):
        assert_raises(
            (partial(TownMapConfig, **{name: value}), ConfigError, (f"{name}: expected", *message))
        )


@pytest.fixture
def street() -> np.ndarray:
    """A street of 20 × 40 cells with a sidewalk of 8 more rows; cells of 1 m."""
    classes = np.full((28, 40), 1, np.uint8)
    classes[20:] = 3
    return classes


def test_a_hole_is_what_lies_around_it(street: np.ndarray) -> None:
    street[3:7, 24:31] = 2  # road lines are taken for road
    for hole in (
        (slice(4, 6), slice(10, 15)),
        (slice(4, 6), slice(25, 30)),
        (slice(22, 24), slice(10, 15)),
    ):
        street[hole] = 0
    expected = np.zeros_like(street)
    expected[4:6, 10:15] = expected[4:6, 25:30] = 1
    expected[22:24, 10:15] = 3
    np.testing.assert_array_equal(hidden_ground(street, 1.0), expected)


def test_a_hole_between_two_kinds_is_what_has_more_of_its_edge(street: np.ndarray) -> None:
    street[18:21, 5:9] = 0  # of its 14 neighbours 4 + 2 · 2 are road
    street[19:23, 20:24] = 0
    filled = hidden_ground(street, 1.0)
    assert set(filled[18:21, 5:9].ravel()) == {1}
    assert set(filled[19:23, 20:24].ravel()) == {3}


def test_large_holes_and_holes_at_the_edge_stay(street: np.ndarray) -> None:
    street[2:10, 2:10] = 0  # 64 m²
    for edge_hole in (
        (slice(0, 2), slice(20, 22)),
        (slice(12, 14), 0),
        (slice(12, 14), -1),
        (-1, 7),
    ):
        street[edge_hole] = 0
    assert not hidden_ground(street, 1.0).any()
    assert (hidden_ground(street, 0.9) > 0).sum() == 64


def test_a_driving_agent_is_read_every_ten_metres() -> None:
    xy = np.column_stack([np.arange(14) * 3.0, np.arange(14) * 4.0])  # 5 m a frame
    assert select_frames(xy, TownMapConfig()).tolist() == [0, 2, 4, 6, 8, 10, 12, 13]


def test_the_looks_are_the_agents_own_samples_with_their_poses(da: DeepAccident) -> None:
    token = da.scenario[1]["token"]
    recordings = agent_pictures(da, 1, TownMapConfig())
    assert len(recordings) == len(AGENTS)
    for agent, looks in zip(AGENTS, recordings, strict=True):
        samples = [f"{token}/{agent}/{frame:03d}" for frame in (1, 6)]
        assert [da.sample[row]["token"] for row in looks.sample_rows.tolist()] == samples
        assert list(looks.files(da)) == [da.sensor_path(sample, BEV_CAMERA) for sample in samples]
        for sample, pose in zip(samples, looks.poses, strict=True):
            np.testing.assert_array_equal(pose, da.world_from(sample, "ego").matrix)
