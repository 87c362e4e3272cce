import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pyquaternion import Quaternion

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3

QUARTER_LEFT = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def test_a_quarter_turn_to_the_left_and_a_step() -> None:
    pose = SE3.from_rotation(QUARTER_LEFT, (10, 0, 1))
    assert_allclose(pose.apply([1.0, 2, 3]), [8, 1, 4])
    assert_allclose(pose @ [[1.0, 2, 3], [0, 0, 0]], [[8, 1, 4], [10, 0, 1]])
    assert_allclose(pose.rotate([1.0, 2, 3]), [-2, 1, 3])
    assert_allclose(pose.inverse().apply([8.0, 1, 4]), [1, 2, 3])
    assert pose.yaw == pytest.approx(np.pi / 2)
    assert_allclose(pose.translation, [10, 0, 1])
    assert pose.quaternion == Quaternion(axis=(0, 0, 1), degrees=90)


def test_constructors_agree() -> None:
    quaternion = Quaternion(axis=(0, 0, 1), degrees=90)
    want = SE3.from_rotation(QUARTER_LEFT, (1, 2, 3)).matrix
    assert_allclose(SE3.from_quaternion(quaternion, (1, 2, 3)).matrix, want, atol=1e-15)
    assert_allclose(SE3.from_quaternion(2.5 * quaternion, (1, 2, 3)).matrix, want, atol=1e-15)
    assert_allclose(SE3.from_quaternion([0.5**0.5, 0, 0, 0.5**0.5], (1, 2, 3)).matrix, want, atol=1e-15)
    assert_allclose(SE3.from_yaw(np.pi / 2, (1, 2, 3)).matrix, want, atol=1e-15)
    assert_array_equal(SE3.identity().matrix, np.eye(4))


def test_the_matrix_is_a_read_only_copy_and_the_callers_stays_writable() -> None:
    mine = np.eye(4)
    pose = SE3(mine)
    mine[0, 3] = 5
    assert pose.translation[0] == 0
    for array in (pose.matrix, pose.rotation, pose.translation, pose.inverse().matrix, (pose @ pose).matrix):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_no_points_and_integer_points() -> None:
    pose = SE3.from_yaw(0.3, (1, 2, 3))
    assert pose.apply(np.zeros((0, 3))).shape == (0, 3)
    assert_allclose(pose.apply([[0, 0, 0]]), [[1, 2, 3]])


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (np.eye(3), r"SE3.matrix: expected shape \(4, 4\), found \(3, 3\)"),
        (np.diag([1.0, np.nan, 1, 1]), "holds NaN or infinity"),
        (np.diag([1.0, -1, 1, 1]), "mirror image"),
        (np.diag([2.0, 2, 2, 1]), "not orthonormal"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (np.vstack([np.eye(4)[:3], [1, 0, 0, 1]]), "last row"),
        ("no matrix", r"SE3.matrix: expected an array of shape \(4, 4\)"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(fault: object, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        SE3(fault)


def test_single_precision_rotations_are_taken() -> None:
    turn = SE3.from_quaternion(Quaternion(1, 2, 3, 4)).matrix.astype(np.float32)
    assert_allclose(SE3(turn).matrix, turn, rtol=0)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (1, 0, 0)])
def test_a_quaternion_without_direction_is_refused(quaternion: tuple[float, ...]) -> None:
    with pytest.raises(GeometryError, match="quaternion: "):
        SE3.from_quaternion(quaternion)


@pytest.mark.parametrize("points", [3.0, [1, 2], np.zeros((2, 4)), np.zeros((1, 2, 3))])
def test_points_of_another_shape_are_refused(points: object) -> None:
    with pytest.raises(GeometryError, match=r"points: expected shape \(N, 3\) or \(3,\)"):
        SE3.identity().apply(points)


def test_repr_shows_translation_and_yaw() -> None:
    assert repr(SE3.from_yaw(0.5, (1, -2, 3))) == "SE3(translation=[1.000, -2.000, 3.000], yaw=0.5000)"


def test_half_way() -> None:
    there, here = SE3.from_yaw(1.0, (4, 0, 0)), SE3.identity()
    assert_allclose(here.interpolate(there, 0.5).matrix, SE3.from_yaw(0.5, (2, 0, 0)).matrix, atol=1e-15)
    across = SE3.from_yaw(-3.0).interpolate(SE3.from_yaw(3.0), 0.5)  # over π, the shorter way
    assert_allclose(across.rotation, SE3.from_yaw(np.pi).rotation, atol=1e-12)
    assert_allclose(there.interpolate(there, 0.3).matrix, there.matrix, atol=1e-15)


@pytest.mark.parametrize("share", [-0.1, 1.1, np.nan])
def test_shares_beyond_the_ends_are_refused(share: float) -> None:
    with pytest.raises(GeometryError, match="share: expected a number from 0 to 1"):
        SE3.identity().interpolate(SE3.identity(), share)
