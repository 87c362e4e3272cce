"""On numbers of real files (docs/format.md, Calib); the laws are in tests/property/test_handedness.py."""

import numpy as np
from numpy.testing import assert_array_equal

from deepaccident_devkit.geometry import conventions

RAW_K = [[800, 560.166, 0], [450, 0, -560.166], [1, 0, 0]]
K = [[560.166, 0, 800], [0, 560.166, 450], [0, 0, 1]]


def test_y_changes_its_sign_and_nothing_else() -> None:
    assert_array_equal(conventions.flip_points([-38.698, -19.789, -0.882]), [-38.698, 19.789, -0.882])
    assert_array_equal(conventions.flip_vectors2([[0.0034441, -5.6166797]]), [[0.0034441, 5.6166797]])
    assert_array_equal(conventions.flip_yaw([-0.000518, 2.19]), [0.000518, -2.19])
    assert_array_equal(conventions.flip_six_vector([1, 2, 3, 4, 5, 6]), [1, -2, 3, -4, 5, -6])


def test_matrices_by_hand() -> None:
    matrix = np.arange(1.0, 17).reshape(4, 4)
    flipped = [[1, -2, 3, 4], [-5, 6, -7, -8], [9, -10, 11, 12], [13, -14, 15, 16]]
    assert_array_equal(conventions.flip_pose(matrix), flipped)


def test_camera_back_by_hand() -> None:
    """A point 10 m behind the LiDAR, 1 m to the left, 0.5 m up is 10 − 2.096 m deep, 1 m to the camera's right."""
    raw = np.diag([-1.0, -1, 1, 1])
    raw[:3, 3] = -2.096, 0, 0.3
    camera_from_lidar = conventions.camera_from_lidar(raw)
    assert_array_equal(camera_from_lidar[:3] @ [-10, 1, 0.5, 1], [1, -0.8, 10 - 2.096])
    assert_array_equal(conventions.camera_from_lidar_to_raw(camera_from_lidar), raw)
    assert np.linalg.det(camera_from_lidar) == 1


def test_intrinsic_is_the_ordinary_one() -> None:
    assert_array_equal(conventions.intrinsic(RAW_K), K)
    assert_array_equal(conventions.intrinsic_to_raw(K), RAW_K)
    assert_array_equal(conventions.intrinsic([[RAW_K] * 3] * 2), [[K] * 3] * 2)
