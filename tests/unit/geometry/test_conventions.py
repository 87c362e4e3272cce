"""Conventions by hand, on numbers of real files (docs/format.md, Calib);
tests/property/test_handedness.py has the laws.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, conventions

RAW_K = [[800, 560.166, 0], [450, 0, -560.166], [1, 0, 0]]
K = [[560.166, 0, 800], [0, 560.166, 450], [0, 0, 1]]


def test_only_y_changes_its_sign() -> None:
    assert_array_equal(
        conventions.flip_points([-38.698, -19.789, -0.882]), [-38.698, 19.789, -0.882]
    )
    assert_array_equal(
        conventions.flip_vectors2([[0.0034441, -5.6166797]]), [[0.0034441, 5.6166797]]
    )
    assert_array_equal(conventions.flip_yaw([-0.000518, 2.19]), [0.000518, -2.19])
    assert_array_equal(conventions.flip_six_vector([1, 2, 3, 4, 5, 6]), [1, -2, 3, -4, 5, -6])


def test_flipped_matrix_by_hand() -> None:
    matrix = np.arange(1.0, 17).reshape(4, 4)
    flipped_matrix = [[1, -2, 3, 4], [-5, 6, -7, -8], [9, -10, 11, 12], [13, -14, 15, 16]]
    assert_array_equal(conventions.flip_pose(matrix), flipped_matrix)


def test_camera_back_by_hand() -> None:
    """A point 10 m behind the LiDAR, 1 m to the left and 0.5 m up is 10 − 2.096 m deep and 1 m to
    the camera's right.
    """
    raw = np.diag([-1.0, -1, 1, 1])
    raw[:3, 3] = -2.096, 0, 0.3
    camera_from_lidar = conventions.camera_from_lidar(raw)
    assert_array_equal(camera_from_lidar[:3] @ [-10, 1, 0.5, 1], [1, -0.8, 10 - 2.096])
    assert_array_equal(conventions.camera_from_lidar_to_raw(camera_from_lidar), raw)
    assert np.linalg.det(camera_from_lidar) == 1


def test_intrinsic_has_the_usual_axes() -> None:
    assert_array_equal(conventions.intrinsic(RAW_K), K)
    assert_array_equal(conventions.intrinsic_to_raw(K), RAW_K)
    assert_array_equal(conventions.intrinsic([[RAW_K] * 3] * 2), [[K] * 3] * 2)


def test_a_quarter_turn_about_each_axis_by_hand() -> None:
    """A quarter turn about x takes y to z, about y takes z to x, about z takes x to y."""
    quarter_turns = np.pi / 2 * np.eye(6)[3:]
    about_x, about_y, about_z = conventions.matrices_of_six(quarter_turns)[:, :3, :3]
    assert_allclose(about_x @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    assert_allclose(about_y @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    assert_allclose(about_z @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_conversions_take_any_leading_axes() -> None:
    six = np.random.default_rng(0).uniform(-1, 1, (2, 3, 6))
    matrices = conventions.matrices_of_six(six)

    assert matrices.shape == (2, 3, 4, 4)
    assert_allclose(conventions.six_vectors_of(matrices), six, atol=1e-12)
    assert_array_equal(SE3.from_six(six[1, 2]).matrix, matrices[1, 2])
    assert conventions.matrices_of_six(np.zeros((0, 6))).shape == (0, 4, 4)
    assert_array_equal(conventions.six_vectors_of(np.eye(4)), np.zeros(6))


def test_a_pose_at_gimbal_lock_stays_although_its_angles_change() -> None:
    pose = SE3.from_six([1, 2, 3, 0.4, np.pi / 2, 0.3])
    six = pose.to_six()
    assert six[4] == pytest.approx(np.pi / 2)
    assert_allclose(SE3.from_six(six).matrix, pose.matrix, atol=1e-7)


def test_wrong_shapes_are_refused() -> None:
    assert_raises(
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
            ("vector: ", "contains NaN or infinity"),
        ),
    )
