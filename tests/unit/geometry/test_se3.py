from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pyquaternion import Quaternion
from refusals import assert_refused

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
    want = SE3.from_rotation(QUARTER_LEFT, (1, 2, 3)).matrix
    assert_allclose(SE3.from_quaternion(quaternion, (1, 2, 3)).matrix, want, atol=1e-15)
    assert_allclose(SE3.from_quaternion(2.5 * quaternion, (1, 2, 3)).matrix, want, atol=1e-15)
    assert_allclose(
        SE3.from_quaternion([0.5**0.5, 0, 0, 0.5**0.5], (1, 2, 3)).matrix, want, atol=1e-15
    )
    assert_allclose(SE3.from_yaw(np.pi / 2, (1, 2, 3)).matrix, want, atol=1e-15)
    assert_array_equal(SE3.identity().matrix, np.eye(4))


def test_stored_transforms_have_the_last_row_of_every_transform() -> None:
    pose = SE3.from_yaw(0.3, (1, 2, 3)).matrix
    for kept in (12, 16):
        assert_array_equal(
            stored_transforms(np.tile(pose.ravel()[:kept], (2, 5, 1))), np.tile(pose, (2, 5, 1, 1))
        )


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (np.eye(3), r"SE3.matrix: expected shape \(4, 4\), found \(3, 3\)"),
        (np.diag([1.0, np.nan, 1, 1]), "holds NaN or infinity"),
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
def test_what_is_no_rigid_transform_is_refused(fault: object, message: str) -> None:
    assert_refused(
        (lambda: SE3(fault), GeometryError, message),
    )


@pytest.fixture
def boxes() -> Boxes:
    return Boxes.from_arrays(
        [[1, 2, 3], [4, 5, 6]], [[4, 2, 1.5]] * 2, [0.1, 2.0], frame="lidar", velocity=np.eye(3)[:2]
    )


def test_boxes_a_box_and_a_cloud_are_carried_along(boxes: Boxes) -> None:
    pose = SE3.from_rotation(QUARTER_LEFT, (10, 0, 1))
    want = boxes.transform(pose, "ego")
    for moved, frame in (
        (pose @ boxes, "lidar"),
        (pose.apply(boxes), "lidar"),
        (pose.apply(boxes, frame="ego"), "ego"),
    ):
        assert isinstance(moved, Boxes)
        assert moved.frame == frame
        assert_array_equal(moved.corners(), want.corners())
        assert_array_equal(moved.velocity, want.velocity)
    box = Box(boxes[:1], "a/b")
    for one, frame in ((pose @ box, "lidar"), (pose.apply(box, frame="ego"), "ego")):
        assert (one.frame, one.token) == (frame, "a/b")
        assert_array_equal(one.center, want.center[0])
    cloud = pose.apply(LidarPointCloud(boxes.center, [1, 2]), frame="ego")
    assert cloud.frame == "ego"
    assert_array_equal(cloud.xyz, want.center)
    assert_array_equal((pose @ LidarPointCloud(boxes.center, [1, 2])).xyz, want.center)


def test_misuse_says_what_to_give(boxes: Boxes) -> None:
    pose = SE3.identity()
    assert (
        repr(SE3.from_yaw(np.float32(0.5), (1, -2, 3)))
        == "SE3(translation=[1.000, -2.000, 3.000], yaw=0.5000)"
    )
    wrong_points = (None, "abc", object(), ["1", "2", "3"], [[1, 2], [1, 2, 3]], {})
    assert_refused(
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
        (lambda: pose @ np.eye(4), GeometryError, ("found (4, 4); of a matrix (4, 4) make SE3",)),
        (
            lambda: pose.rotate(np.zeros((3, 2))),
            GeometryError,
            ("vectors: expected shape (…, 3), found (3, 2)",),
        ),
        (
            lambda: pose.apply([1, 2, 3], frame="ego"),
            GeometryError,
            ("frame: ", "carry no name", "'ego'"),
        ),
        (
            lambda: pose.apply(boxes, frame=5),
            GeometryError,
            ("frame: expected the name of a frame", "5"),
        ),
        *[
            (partial(SE3.from_yaw, wrong), GeometryError, ("yaw: ", "angle in radians, found"))
            for wrong in ("left", None, [0.1], np.nan)
        ],
        *[
            (partial(SE3.from_quaternion, wrong), GeometryError, ("quaternion: ",))
            for wrong in (None, 7, "abcd", [None] * 4, (0, 0, 0, 0), (np.nan, 0, 0, 1), (1, 0, 0))
        ],
    )


def test_points_at_infinity_warn_of_nothing() -> None:
    pose = SE3.from_yaw(0.3)
    assert not np.isfinite(pose.apply([[np.inf, 0, 0], [np.nan, 1, 2]])).all(axis=1).any()
    assert not np.isfinite(pose.rotate([np.inf, 0, 0])).all()


def off_rotation(source: np.random.Generator, *, how: str) -> np.ndarray:
    """A pose up to 600 m out whose rotation is as far from orthonormal as files have it."""
    matrix = SE3.from_six([*source.uniform(-600, 600, 3), *source.uniform(-3, 3, 3)]).matrix
    if how == "single":
        return matrix.astype(np.float32)
    if how == "rounded":
        return matrix.round(4)
    return matrix + np.pad(source.uniform(-2e-4, 2e-4, (3, 3)), (0, 1))


@pytest.mark.parametrize("how", ["single", "rounded", "coarse"])
def test_ways_there_and_back_end_where_they_began_though_poses_are_rounded(how: str) -> None:
    source = np.random.default_rng(0)
    for _ in range(100):
        a, b, c = (SE3(off_rotation(source, how=how)) for _ in range(3))
        a_from_b, b_from_a = a.inverse() @ b, b.inverse() @ a
        assert_allclose((a_from_b @ b_from_a).matrix, np.eye(4), atol=1e-9)
        assert_allclose((a @ a.inverse()).matrix, np.eye(4), atol=1e-9)
        points = source.uniform(-600, 600, (9, 3))
        assert_allclose(b_from_a.apply(a_from_b.apply(points)), points, atol=1e-9)
        assert_allclose(
            ((a.inverse() @ b) @ (b.inverse() @ c) @ (c.inverse() @ a)).apply(points),
            points,
            atol=1e-9,
        )
        boxes = Boxes.from_arrays(points, np.full((9, 3), 8.0), source.uniform(-3, 3, 9), frame="a")
        assert_allclose(
            boxes.transform(b_from_a, "b").transform(a_from_b, "a").corners(),
            boxes.corners(),
            atol=1e-5,
        )


def test_a_rounded_pose_keeps_its_numbers_and_has_the_nearest_rotations_quaternion() -> None:
    turn = SE3.from_six([0, 0, 0, 0.4, -0.3, 2.0]).rotation
    stretch = np.eye(3) + 1e-4 * np.array([[1, 2, -1], [2, 0, 3], [-1, 3, -2]])
    pose = SE3.from_rotation(
        turn @ stretch
    )  # a polar decomposition: the nearest rotation is `turn`
    assert_array_equal(pose.rotation, turn @ stretch)
    assert_allclose(pose.quaternion.rotation_matrix, turn, atol=1e-7)
    assert_allclose(pose.inverse().quaternion.rotation_matrix, turn.T, atol=1e-7)


def test_a_last_row_that_is_a_little_off_is_made_exact() -> None:
    matrix = SE3.from_yaw(0.3, (600, -600, 10)).matrix.copy()
    matrix[3] = (1e-4, 0, -1e-4, 1.0005)
    pose = SE3(matrix)
    assert_array_equal(pose.matrix[3], [0, 0, 0, 1])
    assert_allclose((pose.inverse() @ pose).matrix, np.eye(4), atol=1e-9)
