from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pyquaternion import Quaternion
from refusals import assert_refused

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
    assert (box.category, box.actor_id, box.num_lidar_pts, box.camera_visible) == (
        "van",
        1236,
        42,
        True,
    )
    assert (box.frame, box.token, box.instance_token) == (
        "lidar",
        "sample/12",
        "scenario/actor/1236",
    )
    assert (
        repr(box)
        == "Box(van 1236, lidar [10.00, 0.00, 1.00], size [4.00, 2.00, 1.50], yaw 0.500, points 42)"
    )


def test_a_box_of_nuscenes_arguments() -> None:
    turn = Quaternion(axis=(0, 1, 0), angle=0.2)
    made = Box.from_wlh(
        (10, 0, 1), (2, 4, 1.5), turn, frame="ego", category="van", velocity=(3, 0, 0)
    )
    assert (made.frame, made.category, made.token) == ("ego", "van", None)
    for name, value in (
        ("center", [10, 0, 1]),
        ("wlh", [2, 4, 1.5]),
        ("size", [4, 2, 1.5]),
        ("velocity", [3, 0, 0]),
    ):
        assert_array_equal(getattr(made, name), value)
    assert_allclose(made.rotation_matrix, turn.rotation_matrix, atol=1e-12)
    plain = Box.from_wlh((10, 0, 1), (2, 4, 1.5), [1, 0, 0, 0], frame="world")
    assert (plain.yaw, plain.category, np.isnan(plain.velocity).all()) == (0, "car", True)


def test_corners_stand_in_columns(box: Box) -> None:
    turn = np.array([[np.cos(0.5), -np.sin(0.5), 0], [np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]])
    assert box.corners().shape == (3, 8)
    assert_allclose(box.corners()[:, 0], turn @ [2, 1, 0.75] + [10, 0, 1])
    assert_allclose(box.bottom_corners()[:, 0], turn @ [2, -1, -0.75] + [10, 0, 1])
    assert_allclose(box.bottom_corners()[:, 2], turn @ [-2, 1, -0.75] + [10, 0, 1])


def test_moving_makes_a_new_box_and_keeps_the_tokens(box: Box) -> None:
    moved, turned = box.translate((1, 2, 3)), box.rotate(Quaternion(axis=(0, 0, 1), degrees=90))
    assert_allclose(moved.center, [11, 2, 4])
    assert_array_equal(moved.velocity, [3, 0, 0])
    assert_allclose(turned.center, [0, 10, 1], atol=1e-12)
    assert_allclose(turned.velocity, [0, 3, 0], atol=1e-12)
    assert turned.yaw == pytest.approx(0.5 + np.pi / 2)
    assert_array_equal(box.center, [10, 0, 1])
    in_ego = box.transform(SE3.from_rotation(np.eye(3), (0, 0, 1.94)), "ego")
    assert_allclose(in_ego.center, [10, 0, 2.94])
    assert (in_ego.frame, moved.frame) == ("ego", "lidar")
    for other in (moved, turned, in_ego):
        assert (other.token, other.instance_token, other.actor_id) == (
            box.token,
            box.instance_token,
            1236,
        )


def test_refuses_other_than_one_row_and_other_than_three_numbers(box: Box) -> None:
    none = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert_refused(
        (lambda: Box(none), GeometryError, ("one row of Boxes", "found 0", "boxes[i]")),
        (lambda: box.translate((1, 2)), GeometryError, ("translation", "(3)")),
        (
            lambda: Box.from_wlh((0, 0, 0), (1, 2), Quaternion(), frame="ego"),
            GeometryError,
            ("wlh", "(3)", "(2,)"),
        ),
        *[
            (
                partial(Box, (0, 0, 0), (1, 2, 3), Quaternion(), **names),
                GeometryError,
                ("Box.from_wlh(center, wlh",),
            )
            for names in ({}, {"name": "car"})  # nuScenes' way to call it
        ],
    )
