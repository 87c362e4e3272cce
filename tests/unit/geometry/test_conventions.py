"""On numbers of real files (docs/format.md, Calib); the laws are in
tests/property/test_handedness.py.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, conventions

RAW_K = [[800, 560.166, 0], [450, 0, -560.166], [1, 0, 0]]
K = [[560.166, 0, 800], [0, 560.166, 450], [0, 0, 1]]


def test_y_changes_its_sign_and_nothing_else() -> None:
    assert_array_equal(
        conventions.flip_points([-38.698, -19.789, -0.882]), [-38.698, 19.789, -0.882]
    )
    assert_array_equal(
        conventions.flip_vectors2([[0.0034441, -5.6166797]]), [[0.0034441, 5.6166797]]
    )
    assert_array_equal(conventions.flip_yaw([-0.000518, 2.19]), [0.000518, -2.19])
    assert_array_equal(conventions.flip_six_vector([1, 2, 3, 4, 5, 6]), [1, -2, 3, -4, 5, -6])


def test_matrices_by_hand() -> None:
    matrix = np.arange(1.0, 17).reshape(4, 4)
    assert_array_equal(
        conventions.flip_pose(matrix),
        [[1, -2, 3, 4], [-5, 6, -7, -8], [9, -10, 11, 12], [13, -14, 15, 16]],
    )


def test_camera_back_by_hand() -> None:
    """A point 10 m behind the LiDAR, 1 m to the left, 0.5 m up is 10 − 2.096 m deep, 1 m to the
    camera's right.
    """
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


def test_one_turn_each_by_hand() -> None:
    """A quarter turn about x takes y to z, about y takes z to x, about z takes x to y."""
    about_x, about_y, about_z = conventions.matrices_of_six(np.pi / 2 * np.eye(6)[3:])[:, :3, :3]
    assert_allclose(about_x @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    assert_allclose(about_y @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    assert_allclose(about_z @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_any_leading_axes() -> None:
    six = np.random.default_rng(0).uniform(-1, 1, (2, 3, 6))
    matrices = conventions.matrices_of_six(six)
    assert matrices.shape == (2, 3, 4, 4)
    assert_allclose(conventions.six_vectors_of(matrices), six, atol=1e-12)
    assert_array_equal(SE3.from_six(six[1, 2]).matrix, matrices[1, 2])
    assert conventions.matrices_of_six(np.zeros((0, 6))).shape == (0, 4, 4)
    assert_array_equal(conventions.six_vectors_of(np.eye(4)), np.zeros(6))


def test_at_the_gimbal_the_pose_stays_although_the_angles_do_not() -> None:
    pose = SE3.from_six([1, 2, 3, 0.4, np.pi / 2, 0.3])
    assert pose.to_six()[4] == pytest.approx(np.pi / 2)
    assert_allclose(SE3.from_six(pose.to_six()).matrix, pose.matrix, atol=1e-7)


def test_wrong_shapes_are_refused() -> None:
    assert_refused(
        (
            lambda: conventions.six_vectors_of(np.eye(3)),
            GeometryError,
            ("matrix", "(…, 4, 4)", "(3, 3)"),
        ),
        (
            lambda: conventions.matrices_of_six(np.zeros(4)),
            GeometryError,
            ("six", "(…, 6)", "(4,)"),
        ),
        (lambda: SE3.from_six(np.zeros((1, 6))), GeometryError, ("vector: expected shape (6)",)),
        (
            lambda: SE3.from_six([0, 0, np.nan, 0, 0, 0]),
            GeometryError,
            ("vector: ", "holds NaN or infinity"),
        ),
    )
