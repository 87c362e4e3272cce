from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pyquaternion import Quaternion
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Box, Boxes


@pytest.fixture
def box() -> Box:
    boxes = Boxes.from_arrays(
        [[10, 0, 1]],
        [[4, 2, 1.5]],
        [0.5],
        frame="lidar",
        category=["van"],
        velocity=[[3, 0, 0]],
        actor_id=[1236],
        num_lidar_pts=[42],
        camera_visible=[True],
    )
    return Box(boxes, "sample/12", "scenario/actor/1236")


def test_one_row_in_the_nuscenes_vocabulary(box: Box) -> None:
    assert_array_equal(box.center, [10, 0, 1])
    assert_array_equal(box.size, [4, 2, 1.5])
    assert_array_equal(box.wlh, [2, 4, 1.5])
    assert_array_equal(box.velocity, [3, 0, 0])
    assert box.orientation == Quaternion(axis=(0, 0, 1), angle=0.5)
    assert_allclose(box.rotation_matrix, box.orientation.rotation_matrix)
    assert box.yaw == pytest.approx(0.5)
    assert box.category == "van"
    assert box.actor_id == 1236
    assert box.num_lidar_pts == 42
    assert box.camera_visible is True
    assert box.frame == "lidar"
    assert (box.token, box.instance_token) == ("sample/12", "scenario/actor/1236")
    assert (
        repr(box)
        == "Box(van 1236, lidar [10.00, 0.00, 1.00], size [4.00, 2.00, 1.50], yaw 0.500, points 42)"
    )


def test_a_box_of_nuscenes_arguments() -> None:
    turn = Quaternion(axis=(0, 1, 0), angle=0.2)
    box = Box.from_wlh(
        (10, 0, 1), (2, 4, 1.5), turn, frame="ego", category="van", velocity=(3, 0, 0)
    )
    assert (box.frame, box.category, box.token) == ("ego", "van", None)
    assert_array_equal(box.center, [10, 0, 1])
    assert_array_equal(box.wlh, [2, 4, 1.5])
    assert_array_equal(box.size, [4, 2, 1.5])
    assert_array_equal(box.velocity, [3, 0, 0])
    assert_allclose(box.rotation_matrix, turn.rotation_matrix, atol=1e-12)

    plain_box = Box.from_wlh((10, 0, 1), (2, 4, 1.5), [1, 0, 0, 0], frame="world")
    assert (plain_box.yaw, plain_box.category) == (0, "car")
    assert np.isnan(plain_box.velocity).all()


def test_corners_stand_in_columns(box: Box) -> None:
    cosine = np.cos(0.5)
    sine = np.sin(0.5)
    rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    corners = box.corners()
    bottom = box.bottom_corners()

    assert corners.shape == (3, 8)
    assert_allclose(corners[:, 0], rotation @ [2, 1, 0.75] + box.center)
    assert_allclose(bottom[:, 0], rotation @ [2, -1, -0.75] + box.center)
    assert_allclose(bottom[:, 2], rotation @ [-2, 1, -0.75] + box.center)


def test_moving_makes_a_new_box_and_keeps_the_tokens(box: Box) -> None:
    moved_box = box.translate((1, 2, 3))
    assert_allclose(moved_box.center, [11, 2, 4])
    assert_array_equal(moved_box.velocity, [3, 0, 0])
    assert moved_box.frame == "lidar"

    turned_box = box.rotate(Quaternion(axis=(0, 0, 1), degrees=90))
    assert_allclose(turned_box.center, [0, 10, 1], atol=1e-12)
    assert_allclose(turned_box.velocity, [0, 3, 0], atol=1e-12)
    assert turned_box.yaw == pytest.approx(0.5 + np.pi / 2)
    assert_array_equal(box.center, [10, 0, 1])

    ego_box = box.transform(SE3.from_rotation(np.eye(3), (0, 0, 1.94)), "ego")
    assert_allclose(ego_box.center, [10, 0, 2.94])
    assert ego_box.frame == "ego"
    for other in (moved_box, turned_box, ego_box):
        assert (other.token, other.instance_token) == (box.token, box.instance_token)
        assert other.actor_id == 1236


def test_only_one_row_and_vectors_of_three_numbers_are_accepted(box: Box) -> None:
    no_boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert_raises(
        (lambda: Box(no_boxes), GeometryError, ("one row of Boxes", "found 0", "boxes[i]")),
        (lambda: box.translate((1, 2)), GeometryError, ("translation", "(3)")),
        (
            lambda: Box.from_wlh((0, 0, 0), (1, 2), Quaternion(), frame="ego"),
            GeometryError,
            ("wlh", "(3)", "(2,)"),
        ),
        *[
            (
                partial(Box, (0, 0, 0), (1, 2, 3), Quaternion(), **options),
                GeometryError,
                ("Box.from_wlh(center, wlh",),
            )
            for options in ({}, {"name": "car"})  # nuScenes' way to call it
        ],
    )
