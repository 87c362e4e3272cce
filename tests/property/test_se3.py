"""Laws of SE(3) transforms, quaternions and six-vectors, and of boxes that they move."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from pyquaternion import Quaternion
from support.strategies import ANGLES, arrays, boxes, points, poses

from deepaccident_devkit.geometry import SE3, Boxes, conventions, quaternions
from deepaccident_devkit.geometry.boxes import CORNER_SIGNS


@given(poses(), poses(), points())
def test_compose_then_apply_is_apply_twice(a_from_b: SE3, b_from_c: SE3, p_c: np.ndarray) -> None:
    p_a = a_from_b.apply(b_from_c.apply(p_c))
    assert_allclose((a_from_b @ b_from_c).apply(p_c), p_a, atol=1e-9)
    assert_allclose(a_from_b @ p_c, a_from_b.apply(p_c), rtol=0)


@given(poses(), poses(), poses())
def test_composing_is_associative(a_from_b: SE3, b_from_c: SE3, c_from_d: SE3) -> None:
    left_first = (a_from_b @ b_from_c) @ c_from_d
    right_first = a_from_b @ (b_from_c @ c_from_d)
    assert_allclose(left_first.matrix, right_first.matrix, atol=1e-9)


@given(poses(), points())
def test_the_inverse_undoes(a_from_b: SE3, p_b: np.ndarray) -> None:
    b_from_a = a_from_b.inverse()
    assert_allclose(b_from_a.apply(a_from_b.apply(p_b)), p_b, atol=1e-9)
    assert_allclose((a_from_b @ b_from_a).matrix, np.eye(4), atol=1e-9)
    assert_allclose(b_from_a.inverse().matrix, a_from_b.matrix, atol=1e-9)


@given(poses())
def test_quaternion_there_and_back(pose: SE3) -> None:
    quaternion = pose.quaternion
    assert quaternion.w >= 0
    assert_allclose(quaternion.norm, 1, atol=1e-12)
    # pyquaternion's own formula
    assert_allclose(quaternion.rotation_matrix, pose.rotation, atol=1e-9)
    same_pose = SE3.from_quaternion(quaternion, pose.translation)
    assert_allclose(same_pose.matrix, pose.matrix, atol=1e-9)


@given(poses(), arrays((3,), 100))
def test_vectors_turn_and_do_not_move(pose: SE3, vector: np.ndarray) -> None:
    expected = pose.apply(vector) - pose.apply(np.zeros(3))
    assert_allclose(pose.rotate(vector), expected, atol=1e-9)


@given(ANGLES, arrays((3,), 100))
def test_yaw_turns_counter_clockwise(yaw: float, translation: np.ndarray) -> None:
    moved = SE3.from_yaw(yaw, translation).apply([1.0, 0.0, 0.0])
    assert_allclose(moved - translation, [np.cos(yaw), np.sin(yaw), 0], atol=1e-9)


@given(poses(), poses())
def test_quaternion_product_is_the_rotations_product(first: SE3, second: SE3) -> None:
    q = quaternions.from_matrix(first.rotation)
    r = quaternions.from_matrix(second.rotation)
    product = quaternions.left_multiplier(q) @ r
    assert_allclose(quaternions.to_matrix(product), first.rotation @ second.rotation, atol=1e-9)
    assert_allclose(product, (Quaternion(q) * Quaternion(r)).elements, atol=1e-12)
    rotations = np.stack([first.rotation, second.rotation])
    assert_allclose(quaternions.from_matrix(rotations), [q, r], rtol=0)


@given(poses(), boxes())
def test_boxes_and_their_corners_move_together(target_from_source: SE3, given_boxes: Boxes) -> None:
    moved = given_boxes.transform(target_from_source, "world")
    corners = target_from_source.apply(given_boxes.corners().reshape(-1, 3)).reshape(-1, 8, 3)
    assert moved.frame == "world"
    assert_allclose(moved.corners(), corners, atol=1e-8)
    assert_allclose(moved.velocity, given_boxes.velocity @ target_from_source.rotation.T, atol=1e-9)
    assert_allclose(np.linalg.norm(moved.rotation, axis=1), np.ones(len(moved)), atol=1e-9)
    for name in ("size", "category", "actor_id", "num_lidar_pts", "camera_visible", "row"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(given_boxes, name))


@given(poses(), boxes())
def test_boxes_come_back(target_from_source: SE3, given_boxes: Boxes) -> None:
    moved = given_boxes.transform(target_from_source, "world")
    returned = moved.transform(target_from_source.inverse(), "lidar")
    assert_allclose(returned.corners(), given_boxes.corners(), atol=1e-8)
    assert_allclose(returned.velocity, given_boxes.velocity, atol=1e-9)


@given(boxes(), arrays((30, 3), 1.5))
def test_points_in_boxes_by_their_own_coordinates(
    given_boxes: Boxes, fractions: np.ndarray
) -> None:
    """A point at fractions of a box's half size is in it exactly if no fraction exceeds one."""
    # no point lies on a face
    fractions = np.where(np.abs(np.abs(fractions) - 1) < 1e-6, 0.5, fractions)
    is_inside = (np.abs(fractions) <= 1).all(axis=1)
    for index in range(len(given_boxes)):
        box = given_boxes.select([index])
        center, half_size = box.center[0], box.size[0] / 2
        axes = Quaternion(box.rotation[0]).rotation_matrix
        points = center + (fractions * half_size) @ axes.T
        np.testing.assert_array_equal(box.contains(points)[0], is_inside)
        corners = center + (CORNER_SIGNS * half_size) @ axes.T
        assert_allclose(box.corners()[0], corners, atol=1e-9)


@given(poses())
def test_six_vector_there_and_back(pose: SE3) -> None:
    # near gimbal lock half the digits are lost
    assert_allclose(SE3.from_six(pose.to_six()).matrix, pose.matrix, atol=1e-7)


@given(arrays((3,), 1e3), ANGLES, st.floats(-1.5, 1.5), ANGLES)
def test_six_numbers_there_and_back(
    translation: np.ndarray, rx: float, ry: float, rz: float
) -> None:
    six = SE3.from_six([*translation, rx, ry, rz]).to_six()
    assert_array_equal(six[:3], translation)
    differences = np.abs(six[3:] - [rx, ry, rz])
    # −π and π are the same angle
    assert_allclose(np.minimum(differences, 2 * np.pi - differences), 0, atol=1e-9)


@given(arrays((3,), 1e3), ANGLES, ANGLES, ANGLES)
def test_six_turns_about_z_then_y_then_x(
    translation: np.ndarray, rx: float, ry: float, rz: float
) -> None:
    x, y, z = (
        Quaternion(axis=axis, angle=angle).rotation_matrix
        for axis, angle in zip(np.eye(3), (rx, ry, rz), strict=True)
    )
    pose = SE3.from_six([*translation, rx, ry, rz])
    assert_allclose(pose.rotation, x @ y @ z, atol=1e-12)
    assert_array_equal(pose.translation, translation)


@given(poses())
def test_a_flipped_six_vector_is_the_flipped_poses(pose: SE3) -> None:
    flipped_six = conventions.flip_six_vector(pose.to_six())
    flipped_pose = conventions.flip_pose(pose.matrix)
    assert_allclose(conventions.matrices_of_six(flipped_six), flipped_pose, atol=1e-7)
