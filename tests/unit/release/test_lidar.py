from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError, SensorFileError
from deepaccident_devkit.release import read_lidar, write_lidar

RAW = np.array([[10.0, 2.5, -1.5, 0.25], [-3, -4, 0.5, 1]])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "points.npz"


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", ">f4"])
@pytest.mark.parametrize("key", ["data", "arr_0"])
def test_any_float_type_becomes_right_handed_double(path: Path, dtype: str, key: str) -> None:
    raw = RAW.astype(dtype)
    np.savez(path, **{key: raw})

    cloud = read_lidar(path)

    assert cloud.frame == "lidar"
    assert cloud.xyz.dtype == np.float64
    assert_array_equal(cloud.points, [[10, -2.5, -1.5, 0.25], [-3, 4, 0.5, 1]])
    assert_array_equal(read_lidar(path, raw=True), raw, strict=True)


def test_no_points_are_a_cloud(path: Path) -> None:
    np.savez(path, data=np.zeros((0, 4), dtype=np.float32))
    assert len(read_lidar(path)) == 0


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize(
    ("data", "description"),
    [
        (np.zeros((5, 3)), r"shape \(5, 3\) of float64"),
        (np.zeros(4), r"shape \(4,\) of float64"),
        (np.zeros((1, 5, 4)), r"shape \(1, 5, 4\) of float64"),
        (np.zeros((5, 4), dtype=int), r"shape \(5, 4\) of int64"),
        (np.zeros((5, 4), dtype=complex), r"shape \(5, 4\) of complex128"),
        (np.zeros((5, 4), dtype="U3"), r"shape \(5, 4\) of <U3"),
    ],
)
def test_other_arrays_are_refused(
    path: Path, data: np.ndarray, description: str, raw: bool
) -> None:
    np.savez(path, data=data)
    message = (
        rf"^{path}: expected points \(N, 4\) of floats, found {description}; restore "
        rf"the file from its archive$"
    )
    assert_raises((lambda: read_lidar(path, raw=raw), SensorFileError, message))


def test_writing_restores_carlas_signs_in_single_precision_as_float64(path: Path) -> None:
    expected = np.array([[1, -2, np.float32(0.1), 0.5]])

    write_lidar(path, [[1, 2, 0.1]], [0.5])

    with np.load(path) as archive:
        np.testing.assert_array_equal(archive["data"], expected, strict=True)


@pytest.mark.parametrize(
    ("xyz", "intensity"), [([[1, 2]], [1]), ([[1, 2, 3]], [1, 2]), ([[1, 2, 3]], 1)]
)
def test_writing_other_shapes_is_refused_and_leaves_nothing(
    path: Path, xyz: list, intensity: list
) -> None:
    assert_raises(
        (
            lambda: write_lidar(path, xyz, intensity),
            GeometryError,
            r"(xyz|intensity): expected shape",
        )
    )
    assert list(path.parent.iterdir()) == []
