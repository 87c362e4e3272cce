from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, conventions


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


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: conventions.six_vectors_of(np.eye(3)), r"matrix: expected shape \(…, 4, 4\), found \(3, 3\)"),
        (lambda: conventions.matrices_of_six(np.zeros(4)), r"six: expected shape \(…, 6\), found \(4,\)"),
        (lambda: SE3.from_six(np.zeros((1, 6))), r"vector: expected shape \(6\)"),
        (lambda: SE3.from_six([0, 0, np.nan, 0, 0, 0]), r"vector: .* holds NaN or infinity"),
    ],
)
def test_wrong_shapes_are_refused(make: Callable[[], object], sentence: str) -> None:
    with pytest.raises(GeometryError, match=sentence):
        make()
