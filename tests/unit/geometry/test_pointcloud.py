from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, BevGrid, LidarPointCloud
from deepaccident_devkit.geometry.pointcloud import concatenate_clouds


def test_points_move_and_intensity_stays() -> None:
    cloud = LidarPointCloud(np.array([[1.0, 0, 0], [0, 2, 0]]), np.array([0.5, 0.25]))
    moved_cloud = cloud.transform(SE3.from_yaw(np.pi / 2, (0, 0, 3)), "ego")

    assert cloud.frame == "lidar"
    assert (moved_cloud.frame, len(moved_cloud)) == ("ego", 2)
    assert_allclose(moved_cloud.xyz, [[0, 1, 3], [-2, 0, 3]], atol=1e-15)
    assert_array_equal(moved_cloud.intensity, cloud.intensity)
    assert moved_cloud.intensity.dtype == np.float32
    assert_allclose(moved_cloud.points, [[0, 1, 3, 0.5], [-2, 0, 3, 0.25]], atol=1e-15)


@pytest.fixture
def cloud() -> LidarPointCloud:
    return LidarPointCloud(
        np.array([[0.0, 0, 0], [1, 1, 0], [1.4, 1.4, 0.4], [-3, 4, 1], [10, -2, 2]]),
        np.arange(5) / 10,
    )


def read_rows(cloud: LidarPointCloud) -> list[int]:
    """Return the rows that the points had in the fixture's cloud (10 times the intensity)."""
    return (cloud.intensity * 10).round().astype(int).tolist()


@pytest.mark.parametrize(
    ("grid", "ranges", "expected"),
    [
        (None, {"x": (0, 10)}, [0, 1, 2]),  # the start is in, the end is out
        (None, {"x": (-5, 11), "z": (0.4, 3)}, [2, 3, 4]),
        (BevGrid((0, 12, 1), (-2, 2, 1)), {}, [0, 1, 2, 4]),
        (BevGrid((0, 12, 1), (-2, 0, 1), "released"), {}, [4]),  # left is left in every orientation
        (BevGrid((0, 12, 1), (-2, 2, 1)), {"z": (0, 1)}, [0, 1, 2]),
        (None, {}, [0, 1, 2, 3, 4]),
        (None, {"y": (1, 1)}, []),
    ],
)
def test_crop_by_ranges_and_by_grid(
    cloud: LidarPointCloud,
    grid: BevGrid | None,
    ranges: dict[str, tuple[float, float]],
    expected: list[int],
) -> None:
    assert read_rows(cloud.crop(grid, **ranges)) == expected


def test_remove_close_cuts_a_circle_around_the_sensor(cloud: LidarPointCloud) -> None:
    assert read_rows(cloud.remove_close(1.5)) == [2, 3, 4]  # (1, 1) is 1.41 m away
    assert read_rows(cloud.remove_close(5)) == [3, 4]
    assert read_rows(cloud.remove_close(0)) == [0, 1, 2, 3, 4]
    assert read_rows(cloud.remove_close(1, sensor=(10, -2, -7))) == [0, 1, 2, 3]
    in_world = cloud.transform(SE3.from_yaw(0, (100, 0, 0)), "world")
    assert read_rows(in_world.remove_close(1.5, sensor=(100, 0, 2))) == [2, 3, 4]
    assert_raises(
        (lambda: in_world.remove_close(1.5), GeometryError, ("sensor=(x, y, z)", "frame='lidar'"))
    )


def test_select_picks_points(cloud: LidarPointCloud) -> None:
    high = cloud.xyz[:, 2] > 0.5
    assert read_rows(cloud.select([4, 0])) == [4, 0]
    assert read_rows(cloud.select([])) == []
    assert read_rows(cloud.select(high)) == [3, 4]


def test_clouds_of_one_frame_join(cloud: LidarPointCloud) -> None:
    joined_cloud = concatenate_clouds([cloud, cloud.crop(z=(1, 5))], "lidar")
    assert read_rows(joined_cloud) == [0, 1, 2, 3, 4, 3, 4]
    assert joined_cloud.intensity.dtype == np.float32
    assert len(concatenate_clouds([], "ego")) == 0


def test_points_keep_their_sources(cloud: LidarPointCloud) -> None:
    cloud_of_two = replace(cloud, agent=[0, 0, 4, 4, 4], time_lag=[0, 0, 0.1, 0.1, 0.2])
    assert cloud_of_two.agent.dtype == np.int8
    assert cloud_of_two.time_lag.dtype == np.float32

    selected_cloud = cloud_of_two.transform(SE3.identity(), "ego").crop(x=(1, 11)).select([0, 2])
    assert read_rows(selected_cloud) == [1, 4]
    for points in (selected_cloud, concatenate_clouds([selected_cloud], "ego")):
        assert_array_equal(points.agent, [0, 4])
        assert_array_equal(points.time_lag, np.float32([0, 0.2]))
    assert not selected_cloud.time_lag.flags.writeable

    joined_cloud = concatenate_clouds([cloud_of_two, replace(cloud_of_two, agent=None)], "lidar")
    assert joined_cloud.agent is None
    assert len(joined_cloud.time_lag) == 10


def test_misuse_of_clouds_says_what_to_give(cloud: LidarPointCloud) -> None:
    assert_raises(
        (
            lambda: LidarPointCloud(np.zeros((2, 4)), np.zeros(2)),
            GeometryError,
            ("LidarPointCloud.xyz: expected shape",),
        ),
        (
            lambda: LidarPointCloud(cloud.xyz, np.zeros(3)),
            GeometryError,
            ("LidarPointCloud.intensity", "(5)", "(3,)"),
        ),
        (
            lambda: replace(cloud, time_lag=[0, 0]),
            GeometryError,
            ("LidarPointCloud.time_lag", "(5)", "(2,)"),
        ),
        (
            lambda: cloud.crop(y=(1, 0)),
            GeometryError,
            ("y: expected (start, end) with end not less", "(1, 0)"),
        ),
        (lambda: cloud.crop(z=(1, 2, 3)), GeometryError, ("z: expected shape (2)",)),
        (lambda: cloud.select([5]), GeometryError, ("does not pick from 5 points",)),
        (
            lambda: concatenate_clouds([cloud], "ego"),
            GeometryError,
            ("'lidar'", "'ego'", "transform them first"),
        ),
        *[
            (
                partial(LidarPointCloud, np.zeros((1, 3)), [0], frame),
                GeometryError,
                r"LidarPointCloud.frame: expected the name of a frame, .* found",
            )
            for frame in (7, None, "")
        ],
        *[
            (
                partial(cloud.remove_close, radius_m),
                GeometryError,
                "radius: expected 0 m or more, found",
            )
            for radius_m in ("near", None, [1.0], -1)
        ],
        (
            lambda: cloud.crop((-50, 50)),
            GeometryError,
            r"grid: expected a BevGrid, found \(-50, 50\); pass ranges by name",
        ),
        (
            lambda: cloud.transform(None, "ego"),
            GeometryError,
            "target_from_source: expected an SE3, found NoneType",
        ),
        (
            lambda: cloud.transform(SE3.identity(), 5),
            GeometryError,
            "frame: expected the name of a frame",
        ),
    )
    assert read_rows(cloud.remove_close(np.float32(1.5))) == read_rows(cloud.remove_close(1.5))


def test_points_at_infinity_raise_no_warning() -> None:
    xyz = [[np.inf, 0, 0], [1, -np.inf, 2], [np.nan, 0, 0], [5, 0, 0]]
    cloud = LidarPointCloud(xyz, [0, 0.1, 0.2, 0.3])
    assert read_rows(cloud.crop(BevGrid())) == [3]
    assert read_rows(cloud.remove_close(2)) == [0, 1, 3]
    assert len(cloud.transform(SE3.from_yaw(0.3), "ego")) == 4
