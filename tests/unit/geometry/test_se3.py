from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pyquaternion import Quaternion
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Box, Boxes, LidarPointCloud
from deepaccident_devkit.geometry.conventions import stored_transforms

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
    expected = SE3.from_rotation(QUARTER_LEFT, (1, 2, 3)).matrix

    assert_allclose(SE3.from_quaternion(quaternion, (1, 2, 3)).matrix, expected, atol=1e-15)
    assert_allclose(SE3.from_quaternion(2.5 * quaternion, (1, 2, 3)).matrix, expected, atol=1e-15)
    elements = [0.5**0.5, 0, 0, 0.5**0.5]
    assert_allclose(SE3.from_quaternion(elements, (1, 2, 3)).matrix, expected, atol=1e-15)
    assert_allclose(SE3.from_yaw(np.pi / 2, (1, 2, 3)).matrix, expected, atol=1e-15)
    assert_array_equal(SE3.identity().matrix, np.eye(4))


def test_stored_transforms_have_the_last_row_of_every_transform() -> None:
    pose = SE3.from_yaw(0.3, (1, 2, 3)).matrix
    expected = np.tile(pose, (2, 5, 1, 1))
    for num_values in (12, 16):
        stored = np.tile(pose.ravel()[:num_values], (2, 5, 1))
        assert_array_equal(stored_transforms(stored), expected)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.eye(3), r"SE3.matrix: expected shape \(4, 4\), found \(3, 3\)"),
        (np.diag([1.0, np.nan, 1, 1]), "contains NaN or infinity"),
        (np.diag([1.0, -1, 1, 1]), "mirror image"),
        (np.diag([2.0, 2, 2, 1]), "not orthonormal"),
        (
            np.block([[np.full((3, 3), 1e200) * [1, -1, 1], np.zeros((3, 1))], [np.eye(4)[3]]]),
            "not orthonormal",
        ),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (np.vstack([np.eye(4)[:3], [1, 0, 0, 1]]), "last row"),
        ("no matrix", r"SE3.matrix: expected an array of shape \(4, 4\)"),
    ],
)
def test_a_value_that_is_no_rigid_transform_is_refused(value: object, message: str) -> None:
    assert_raises(
        (lambda: SE3(value), GeometryError, message),
    )


@pytest.fixture
def boxes() -> Boxes:
    return Boxes.from_arrays(
        [[1, 2, 3], [4, 5, 6]], [[4, 2, 1.5]] * 2, [0.1, 2.0], frame="lidar", velocity=np.eye(3)[:2]
    )


def test_boxes_a_box_and_a_cloud_are_carried_along(boxes: Boxes) -> None:
    pose = SE3.from_rotation(QUARTER_LEFT, (10, 0, 1))
    expected = boxes.transform(pose, "ego")
    for moved_boxes, frame in (
        (pose @ boxes, "lidar"),
        (pose.apply(boxes), "lidar"),
        (pose.apply(boxes, frame="ego"), "ego"),
    ):
        assert isinstance(moved_boxes, Boxes)
        assert moved_boxes.frame == frame
        assert_array_equal(moved_boxes.corners(), expected.corners())
        assert_array_equal(moved_boxes.velocity, expected.velocity)

    box = Box(boxes[:1], "a/b")
    for moved_box, frame in ((pose @ box, "lidar"), (pose.apply(box, frame="ego"), "ego")):
        assert (moved_box.frame, moved_box.token) == (frame, box.token)
        assert_array_equal(moved_box.center, expected.center[0])

    cloud = LidarPointCloud(boxes.center, [1, 2])
    moved_cloud = pose.apply(cloud, frame="ego")
    assert moved_cloud.frame == "ego"
    assert_array_equal(moved_cloud.xyz, expected.center)
    assert_array_equal((pose @ cloud).xyz, expected.center)


def test_misuse_says_what_to_give(boxes: Boxes) -> None:
    pose = SE3.identity()
    text = repr(SE3.from_yaw(np.float32(0.5), (1, -2, 3)))

    assert text == "SE3(translation=[1.000, -2.000, 3.000], yaw=0.5000)"
    wrong_points = (None, "abc", object(), ["1", "2", "3"], [[1, 2], [1, 2, 3]], {})
    assert_raises(
        *[
            (
                partial(move, points),
                GeometryError,
                ("points of shape (N, 3) or (3,), boxes or a point",),
            )
            for move in (pose.apply, pose.__matmul__)
            for points in wrong_points
        ],
        *[
            (partial(pose.rotate, points), GeometryError, ("vectors of shape (…, 3)",))
            for points in wrong_points
        ],
        *[
            (partial(pose.apply, points), GeometryError, ("points: expected shape (N, 3) or (3,)",))
            for points in (3.0, [1, 2], np.zeros((2, 4)), np.zeros((1, 2, 3)))
        ],
        (
            lambda: pose.apply(np.zeros((3, 8))),
            GeometryError,
            ("points: ", "found (3, 8); transpose it (.T)"),
        ),
        (
            lambda: pose @ np.eye(4),
            GeometryError,
            ("found (4, 4); make an SE3 from a matrix (4, 4)",),
        ),
        (
            lambda: pose.rotate(np.zeros((3, 2))),
            GeometryError,
            ("vectors: expected shape (…, 3), found (3, 2)",),
        ),
        (
            lambda: pose.apply([1, 2, 3], frame="ego"),
            GeometryError,
            ("frame: ", "have no frame", "'ego'"),
        ),
        (
            lambda: pose.apply(boxes, frame=5),
            GeometryError,
            ("frame: expected the name of a frame", "5"),
        ),
        *[
            (partial(SE3.from_yaw, yaw), GeometryError, ("yaw: ", "angle in radians, found"))
            for yaw in ("left", None, [0.1], np.nan)
        ],
        *[
            (partial(SE3.from_quaternion, elements), GeometryError, ("quaternion: ",))
            for elements in (
                *(None, 7, "abcd", [None] * 4),
                *((0, 0, 0, 0), (np.nan, 0, 0, 1), (1, 0, 0)),
            )
        ],
    )


def test_points_at_infinity_raise_no_warning() -> None:
    pose = SE3.from_yaw(0.3)
    points = pose.apply([[np.inf, 0, 0], [np.nan, 1, 2]])
    assert not np.isfinite(points).all(axis=1).any()
    assert not np.isfinite(pose.rotate([np.inf, 0, 0])).all()


def make_inexact_pose(rng: np.random.Generator, error: str) -> SE3:
    """Return a pose up to 600 m out with a rotation as far from orthonormal as in files."""
    matrix = SE3.from_six([*rng.uniform(-600, 600, 3), *rng.uniform(-3, 3, 3)]).matrix
    if error == "single":
        return SE3(matrix.astype(np.float32))
    if error == "rounded":
        return SE3(matrix.round(4))
    return SE3(matrix + np.pad(rng.uniform(-2e-4, 2e-4, (3, 3)), (0, 1)))


@pytest.mark.parametrize("error", ["single", "rounded", "coarse"])
def test_transforms_there_and_back_cancel_although_poses_are_rounded(error: str) -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        a, b, c = (make_inexact_pose(rng, error) for _ in range(3))
        a_from_b = a.inverse() @ b
        b_from_a = b.inverse() @ a
        assert_allclose((a_from_b @ b_from_a).matrix, np.eye(4), atol=1e-9)
        assert_allclose((a @ a.inverse()).matrix, np.eye(4), atol=1e-9)

        points = rng.uniform(-600, 600, (9, 3))
        a_from_a_by_c = a_from_b @ (b.inverse() @ c) @ (c.inverse() @ a)
        assert_allclose(b_from_a.apply(a_from_b.apply(points)), points, atol=1e-9)
        assert_allclose(a_from_a_by_c.apply(points), points, atol=1e-9)

        boxes = Boxes.from_arrays(points, np.full((9, 3), 8.0), rng.uniform(-3, 3, 9), frame="a")
        returned_boxes = boxes.transform(b_from_a, "b").transform(a_from_b, "a")
        assert_allclose(returned_boxes.corners(), boxes.corners(), atol=1e-5)


def test_a_rounded_pose_keeps_its_numbers_and_has_the_nearest_rotations_quaternion() -> None:
    turn = SE3.from_six([0, 0, 0, 0.4, -0.3, 2.0]).rotation
    stretch = np.eye(3) + 1e-4 * np.array([[1, 2, -1], [2, 0, 3], [-1, 3, -2]])
    # a polar decomposition: the nearest rotation is `turn`
    pose = SE3.from_rotation(turn @ stretch)

    assert_array_equal(pose.rotation, turn @ stretch)
    assert_allclose(pose.quaternion.rotation_matrix, turn, atol=1e-7)
    assert_allclose(pose.inverse().quaternion.rotation_matrix, turn.T, atol=1e-7)


def test_a_last_row_that_is_a_little_off_is_made_exact() -> None:
    matrix = SE3.from_yaw(0.3, (600, -600, 10)).matrix.copy()
    matrix[3] = (1e-4, 0, -1e-4, 1.0005)
    pose = SE3(matrix)
    assert_array_equal(pose.matrix[3], [0, 0, 0, 1])
    assert_allclose((pose.inverse() @ pose).matrix, np.eye(4), atol=1e-9)
