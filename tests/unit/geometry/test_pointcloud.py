import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, LidarPointCloud


def test_points_move_and_intensity_stays() -> None:
    cloud = LidarPointCloud(np.array([[1.0, 0, 0], [0, 2, 0]]), np.array([0.5, 0.25]))
    moved = cloud.transform(SE3.from_yaw(np.pi / 2, (0, 0, 3)), "ego")
    assert (cloud.frame, moved.frame, len(moved)) == ("lidar", "ego", 2)
    assert_allclose(moved.xyz, [[0, 1, 3], [-2, 0, 3]], atol=1e-15)
    assert_array_equal(moved.intensity, cloud.intensity)
    assert moved.intensity.dtype == np.float32
    assert_allclose(moved.points, [[0, 1, 3, 0.5], [-2, 0, 3, 0.25]], atol=1e-15)


def test_arrays_are_read_only_and_the_callers_are_not() -> None:
    xyz, intensity = np.zeros((2, 3)), np.zeros(2, dtype=np.float32)
    cloud = LidarPointCloud(xyz, intensity)
    for array in (cloud.xyz, cloud.intensity):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    xyz[0] = intensity[0] = 1  # must not raise


def test_an_empty_cloud_moves_too() -> None:
    assert len(LidarPointCloud(np.zeros((0, 3)), np.zeros(0)).transform(SE3.identity(), "world")) == 0


@pytest.mark.parametrize(
    ("xyz", "intensity", "name"), [(np.zeros((2, 4)), np.zeros(2), "xyz"), (np.zeros((2, 3)), np.zeros(3), "intensity")]
)
def test_wrong_shapes_are_refused(xyz: np.ndarray, intensity: np.ndarray, name: str) -> None:
    with pytest.raises(GeometryError, match=f"LidarPointCloud.{name}: expected shape"):
        LidarPointCloud(xyz, intensity)
