from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, BevGrid, LidarPointCloud
from deepaccident_devkit.geometry.pointcloud import concatenate_clouds


def test_points_move_and_intensity_stays() -> None:
    cloud = LidarPointCloud(np.array([[1.0, 0, 0], [0, 2, 0]]), np.array([0.5, 0.25]))
    moved = cloud.transform(SE3.from_yaw(np.pi / 2, (0, 0, 3)), "ego")
    assert (cloud.frame, moved.frame, len(moved)) == ("lidar", "ego", 2)
    assert_allclose(moved.xyz, [[0, 1, 3], [-2, 0, 3]], atol=1e-15)
    assert_array_equal(moved.intensity, cloud.intensity)
    assert moved.intensity.dtype == np.float32
    assert_allclose(moved.points, [[0, 1, 3, 0.5], [-2, 0, 3, 0.25]], atol=1e-15)


@pytest.fixture
def cloud() -> LidarPointCloud:
    return LidarPointCloud(
        np.array([[0.0, 0, 0], [1, 1, 0], [1.4, 1.4, 0.4], [-3, 4, 1], [10, -2, 2]]),
        np.arange(5) / 10,
    )


def rows(part: LidarPointCloud) -> list[int]:
    return (part.intensity * 10).round().astype(int).tolist()


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
    assert rows(cloud.crop(grid, **ranges)) == expected


def test_remove_close_cuts_a_circle_around_the_sensor(cloud: LidarPointCloud) -> None:
    assert rows(cloud.remove_close(1.5)) == [2, 3, 4]  # (1, 1) is 1.41 m away
    assert (rows(cloud.remove_close(5)), rows(cloud.remove_close(0))) == ([3, 4], [0, 1, 2, 3, 4])
    assert rows(cloud.remove_close(1, sensor=(10, -2, -7))) == [0, 1, 2, 3]
    in_world = cloud.transform(SE3.from_yaw(0, (100, 0, 0)), "world")
    assert rows(in_world.remove_close(1.5, sensor=(100, 0, 2))) == [2, 3, 4]
    assert_refused(
        (lambda: in_world.remove_close(1.5), GeometryError, ("sensor=(x, y, z)", "frame='lidar'"))
    )


def test_select_picks_points(cloud: LidarPointCloud) -> None:
    assert (rows(cloud.select([4, 0])), rows(cloud.select([]))) == ([4, 0], [])
    assert rows(cloud.select(cloud.xyz[:, 2] > 0.5)) == [3, 4]


def test_clouds_of_one_frame_join(cloud: LidarPointCloud) -> None:
    joined = concatenate_clouds([cloud, cloud.crop(z=(1, 5))], "lidar")
    assert (rows(joined), joined.intensity.dtype, len(concatenate_clouds([], "ego"))) == (
        [0, 1, 2, 3, 4, 3, 4],
        np.float32,
        0,
    )


def test_points_keep_their_sources(cloud: LidarPointCloud) -> None:
    of_two = replace(cloud, agent=[0, 0, 4, 4, 4], time_lag=[0, 0, 0.1, 0.1, 0.2])
    assert (of_two.agent.dtype, of_two.time_lag.dtype) == (np.int8, np.float32)
    part = of_two.transform(SE3.identity(), "ego").crop(x=(1, 11)).select([0, 2])
    assert rows(part) == [1, 4]
    for each in (part, concatenate_clouds([part], "ego")):
        assert_array_equal(each.agent, [0, 4])
        assert_array_equal(each.time_lag, np.float32([0, 0.2]))
    assert not part.time_lag.flags.writeable
    joined = concatenate_clouds([of_two, replace(of_two, agent=None)], "lidar")
    assert (joined.agent, len(joined.time_lag)) == (None, 10)


def test_misuse_of_clouds_says_what_to_give(cloud: LidarPointCloud) -> None:
    assert_refused(
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
            ("y: expected a start and an end not before it", "(1, 0)"),
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
                partial(LidarPointCloud, np.zeros((1, 3)), [0], wrong),
                GeometryError,
                r"LidarPointCloud.frame: expected the name of a frame, .* found",
            )
            for wrong in (7, None, "")
        ],
        *[
            (
                partial(cloud.remove_close, wrong),
                GeometryError,
                "radius: expected metres from 0 on, found",
            )
            for wrong in ("near", None, [1.0], -1)
        ],
        (
            lambda: cloud.crop((-50, 50)),
            GeometryError,
            r"grid: expected a BevGrid, found \(-50, 50\); ranges go by name",
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
    assert rows(cloud.remove_close(np.float32(1.5))) == rows(cloud.remove_close(1.5))


def test_points_at_infinity_warn_of_nothing() -> None:
    cloud = LidarPointCloud(
        [[np.inf, 0, 0], [1, -np.inf, 2], [np.nan, 0, 0], [5, 0, 0]], [0, 0.1, 0.2, 0.3]
    )
    assert (rows(cloud.crop(BevGrid())), rows(cloud.remove_close(2))) == ([3], [0, 1, 3])
    assert len(cloud.transform(SE3.from_yaw(0.3), "ego")) == 4
