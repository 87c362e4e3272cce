from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, GeometryError
from deepaccident_devkit.geometry import SE3, Boxes, BoxVisibility, PinholeCamera


@pytest.mark.parametrize(("degrees", "focal_px"), [(70, 1142.5184), (110, 560.166)])
def test_field_of_view_gives_the_releases_focal_lengths(degrees: float, focal_px: float) -> None:
    camera = PinholeCamera.from_field_of_view(1600, 900, np.radians(degrees))
    expected = [[focal_px, 0, 800], [0, focal_px, 450], [0, 0, 1]]
    assert_allclose(camera.intrinsic, expected, atol=1e-3)


def test_right_is_larger_u_and_down_is_larger_v() -> None:
    camera = PinholeCamera(np.array([[500.0, 0, 800], [0, 400, 450], [0, 0, 1]]), 1600, 900)
    pixels, depth = camera.project([[0, 0, 5], [1, 0, 5], [0, 1, 5], [2, 2, 10]])
    assert_array_equal(pixels, [[800, 450], [900, 450], [800, 530], [900, 530]])
    assert_array_equal(depth, [5, 5, 5, 10])


def test_a_point_that_is_not_in_front_has_no_pixel() -> None:
    camera = PinholeCamera.from_field_of_view(1600, 900, 1.2)
    pixels, depth = camera.project([[0, 0, 0], [1, 1, -3], [0, 0, 1]])
    assert_array_equal(np.isnan(pixels), [[True, True], [True, True], [False, False]])
    assert_array_equal(depth, [0, -3, 1])
    assert_array_equal(camera.in_image(pixels), [False, False, True])
    assert camera.project(np.zeros((0, 3)))[0].shape == (0, 2)


def test_the_image_starts_at_zero_and_ends_before_its_size() -> None:
    camera = PinholeCamera.from_field_of_view(1600, 900, 1.2)
    pixels = [[0, 0], [1599.9, 899.9], [1600, 450], [800, 900], [-0.1, 450], [800, -0.1]]
    assert_array_equal(camera.in_image(pixels), [True, True, False, False, False, False])


def test_a_resized_camera_sees_the_same_parts_of_its_picture() -> None:
    camera = PinholeCamera.from_field_of_view(1600, 900, 1.2)
    small_camera = camera.resized(400, 300)
    points = np.array([[1.0, -2.0, 9.0], [-3.0, 0.5, 20.0]])
    pixels, depth = camera.project(points)
    smaller_pixels, smaller_depth = small_camera.project(points)

    assert (small_camera.width, small_camera.height) == (400, 300)
    assert_allclose(smaller_pixels * [4, 3], pixels)
    assert_allclose(smaller_depth, depth)


def test_in_image_by_depth_and_margin() -> None:
    camera = PinholeCamera.from_field_of_view(100, 50, 1.2)
    pixels = [[50, 25], [50, 25], [1, 25], [-1, 25], [98, 25], [99, 25]]
    depth = [3, 1, 3, 3, 3, -3]

    assert_array_equal(
        camera.in_image(pixels, depth, min_depth=1), [True, False, True, False, True, False]
    )
    assert_array_equal(camera.in_image(pixels, depth), [True, True, True, False, True, False])
    assert_array_equal(camera.in_image(pixels, margin=1), [True, True, True, False, True, False])
    assert_array_equal(camera.in_image(pixels, margin=-1), [True] * 6)
    top_and_bottom = [[50, 0.5], [50, 1], [50, 48.5], [50, 49]]
    assert_array_equal(camera.in_image(top_and_bottom, margin=1), [False, True, True, False])
    assert camera.in_image(top_and_bottom).all()
    assert_array_equal(camera.in_image([[50, np.nan]], margin=-100), [False])


def test_a_box_is_seen_whole_in_part_or_not() -> None:
    """The boxes are ahead; cut by the left edge; beside; behind; around the camera; with corners
    nearer than 1 m; too large.
    """
    camera = PinholeCamera.from_field_of_view(100, 100, np.pi / 2)
    centers = [
        [0, 0, 10],
        [-10, 0, 10],
        [-30, 0, 10],
        [0, 0, -10],
        [0, 0, 0.5],
        [0, 0, 1.2],
        [0, 0, 10],
    ]
    sizes = [[2, 2, 2], [2, 2, 2], [2, 2, 2], [2, 2, 2], [2, 2, 2], [1, 1, 1], [40, 40, 2]]
    boxes = Boxes.from_arrays(centers, sizes, np.zeros(7), frame="Camera_Front")
    whole, part, none = BoxVisibility.ALL, BoxVisibility.ANY, BoxVisibility.NONE

    assert_array_equal(camera.box_visibility(boxes), [whole, part, none, none, none, part, none])
    assert_array_equal(camera.boxes_in_image(boxes), [True, True, False, False, False, True, False])
    assert_array_equal(camera.boxes_in_image(boxes, whole), [True] + [False] * 6)
    assert camera.boxes_in_image(boxes, none).all()
    assert camera.box_visibility(boxes.select([])).shape == (0,)


def test_all_corners_must_be_at_least_0_1_m_in_front() -> None:
    camera = PinholeCamera.from_field_of_view(100, 100, np.pi / 2)
    nearest_depth = np.array([0.2, 0.11, 0.09, -0.05])
    sizes = np.column_stack([np.ones((4, 2)), 3 - nearest_depth])
    centers = np.column_stack([np.zeros((4, 2)), 3 - sizes[:, 2] / 2])
    boxes = Boxes.from_arrays(centers, sizes, [0] * 4, frame="Camera_Back")
    assert_array_equal(camera.boxes_in_image(boxes), [True, True, False, False])


def test_boxes_must_be_in_the_cameras_frame() -> None:
    camera = PinholeCamera.from_field_of_view(100, 100, 1.2)
    box = Boxes.from_arrays([[10, 0, 0]], [[2, 2, 2]], [0], frame="lidar")
    frames = ("world", "ego", "lidar", "lidar01", "BEV_instance_camera")

    assert_raises(
        *[
            (
                partial(call, replace(box, frame=frame)),
                GeometryError,
                (f"'{frame}'", "camera_from_source"),
            )
            for call in (camera.boxes_in_image, camera.box_visibility)
            for frame in frames
        ],
    )
    camera_from_lidar = SE3.from_rotation([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    assert camera.boxes_in_image(box.transform(camera_from_lidar, "Camera_Front")).all()


def test_impossible_cameras_and_pixels_are_refused() -> None:
    camera = PinholeCamera(np.eye(3), np.int64(8), np.uint16(6))
    assert type(camera.width) is int
    assert (camera.width, camera.height) == (8, 6)
    assert_raises(
        (
            lambda: PinholeCamera(np.eye(4), 10, 10),
            GeometryError,
            ("PinholeCamera.intrinsic", "(3, 3)"),
        ),
        (lambda: camera.project([1, 2, 3]), GeometryError, ("points", "(N, 3)")),
        (lambda: camera.in_image([[1, 2, 3]]), GeometryError, ("pixels", "(N, 2)")),
        (lambda: camera.in_image(np.zeros((6, 2)), [1.0]), GeometryError, ("depth", "(6)")),
        *[
            (
                partial(PinholeCamera, np.diag([focal_px, 1, 1]), 10, 10),
                GeometryError,
                "intrinsic: expected finite numbers",
            )
            for focal_px in (np.nan, np.inf)
        ],
        *[
            (
                partial(PinholeCamera, np.eye(3), width, 10),
                GeometryError,
                "width: expected a whole number of pixels from 1, found",
            )
            for width in (0, -3, 10.5, "10", None)
        ],
        *[
            (
                partial(PinholeCamera.from_field_of_view, 10, height, 1.2),
                GeometryError,
                "height: expected a whole number of pixels from 1, found",
            )
            for height in (0, -3, 10.5, "10", None)
        ],
        *[
            (
                partial(PinholeCamera.from_field_of_view, 10, 10, angle),
                GeometryError,
                "horizontal: expected a field of view between 0 and π radians, found",
            )
            for angle in (0, np.pi, -1, np.nan)
        ],
        (
            lambda: PinholeCamera.from_field_of_view(10, 10, "wide"),
            GeometryError,
            "horizontal: expected a field of view in radians, found 'wide'",
        ),
    )


def test_visibility_levels_that_do_not_exist_are_refused() -> None:
    camera = PinholeCamera.from_field_of_view(100, 100, 1.2)
    box = Boxes.from_arrays([[0, 0, 10]], [[2, 2, 2]], [0], frame="Camera_Front")

    assert [(level.name, level.value) for level in BoxVisibility] == [
        ("ALL", 0),
        ("ANY", 1),
        ("NONE", 2),
    ]
    assert camera.boxes_in_image(box, 1)  # type: ignore[arg-type]
    assert_raises(
        *[
            (
                partial(camera.boxes_in_image, box, level),
                ChoiceError,
                r"level: expected one of BoxVisibility.ALL, BoxVisibility.ANY, .*found",
            )
            for level in ("any", 3, None)
        ],
        (
            lambda: camera.box_visibility(None),
            GeometryError,
            "boxes: expected Boxes, found NoneType",
        ),
    )


def test_points_at_infinity_have_no_pixel_and_raise_no_warning() -> None:
    camera = PinholeCamera.from_field_of_view(100, 100, 1.2)
    points = [[np.inf, 0, 5], [0, 0, np.inf], [-np.inf, 1, -1], [0, np.nan, 1]]
    pixels, _ = camera.project(points)
    assert not camera.in_image(pixels).any()
