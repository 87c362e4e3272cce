"""Laws of boxes, cameras, point clouds and grids; test_se3.py has the laws of moved boxes."""

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from support.strategies import arrays, boxes, cameras, clouds, grids, points, poses, upright_boxes

from deepaccident_devkit.geometry import (
    SE3,
    BevGrid,
    Boxes,
    BoxVisibility,
    LidarPointCloud,
    PinholeCamera,
    quaternions,
)
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS, Orientation


def plain_contains(given_boxes: Boxes, given_points: np.ndarray) -> np.ndarray:
    """Return which points are in which boxes by the definition, without a window or grid.

    A point's offset along each axis of the box is at most half its size.
    """
    offset = given_points - given_boxes.center[:, None]
    axes = quaternions.to_matrix(given_boxes.rotation)[:, None]
    offsets_by_axis = [
        offset[..., 0] * axes[..., 0, axis]
        + offset[..., 1] * axes[..., 1, axis]
        + offset[..., 2] * axes[..., 2, axis]
        for axis in range(3)
    ]
    half_size = given_boxes.size[:, None] / 2
    return (np.abs(np.stack(offsets_by_axis, axis=-1)) <= half_size).all(axis=-1)


def footprints(given_boxes: Boxes) -> np.ndarray:
    return shapely.polygons(given_boxes.bottom_corners()[..., :2])


@given(boxes(max_count=8), points(max_count=40), arrays((8, 3), 2.0))
def test_points_in_boxes_are_the_definitions_to_the_bit(
    given_boxes: Boxes, anywhere: np.ndarray, offsets: np.ndarray
) -> None:
    center = given_boxes.center
    near_points = center + offsets[: len(given_boxes)]
    corners = given_boxes.corners().reshape(-1, 3)
    all_points = np.concatenate([anywhere, near_points, center, corners, [[np.nan] * 3]])
    expected = plain_contains(given_boxes, all_points)
    assert_array_equal(given_boxes.contains(all_points), expected)
    assert_array_equal(given_boxes.count_points(all_points), expected.sum(axis=1))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([0.0, 3.0, 30.0, 1000.0]))
def test_points_in_boxes_of_whole_clouds(seed: int, count: int, reach: float) -> None:
    """One piece of the coarse grid takes fewer points; some lie on the faces of boxes."""
    rng = np.random.default_rng(seed)
    pose = SE3.from_six(rng.uniform(-1, 1, 6))
    center = (rng.normal(size=(count, 3)) * reach).round(1)
    size = rng.uniform(0.2, 9, (count, 3)).round(1)
    upright = Boxes.from_arrays(center, size, rng.choice([0, np.pi / 2, 0.3], count))
    for some_boxes in (upright, upright.transform(pose, "ego")):
        offsets = (rng.normal(size=(9000, 3)) * 3).round(1)
        cloud = some_boxes.center[rng.integers(0, count, 9000)] + offsets
        assert_array_equal(some_boxes.contains(cloud), plain_contains(some_boxes, cloud))


@given(upright_boxes(), upright_boxes())
def test_iou_on_the_ground_is_the_polygons(first: Boxes, second: Boxes) -> None:
    first_polygons, second_polygons = footprints(first)[:, None], footprints(second)
    intersection = shapely.area(shapely.intersection(first_polygons, second_polygons))
    union = shapely.area(first_polygons) + shapely.area(second_polygons) - intersection
    iou = first.iou_bev(second)
    assert_allclose(iou, intersection / union, rtol=0, atol=1e-9)
    assert_allclose(second.iou_bev(first).T, iou, rtol=0, atol=1e-12)
    assert ((iou >= 0) & (iou <= 1)).all()
    assert_allclose(np.diag(first.iou_bev(first)), np.ones(len(first)), rtol=0, atol=1e-12)


@given(upright_boxes(), upright_boxes())
def test_iou_in_space_is_ground_times_height(first: Boxes, second: Boxes) -> None:
    area = shapely.area(shapely.intersection(footprints(first)[:, None], footprints(second)))
    first_z = first.corners()[:, None, :, 2]
    second_z = second.corners()[..., 2]
    top = np.minimum(first_z.max(axis=-1), second_z.max(axis=-1))
    bottom = np.maximum(first_z.min(axis=-1), second_z.min(axis=-1))
    intersection = area * np.maximum(top - bottom, 0)
    union = first.size.prod(axis=1)[:, None] + second.size.prod(axis=1) - intersection
    iou = first.iou_3d(second)
    assert_allclose(iou, intersection / union, rtol=0, atol=1e-9)
    assert_allclose(second.iou_3d(first).T, iou, rtol=0, atol=1e-12)
    assert ((iou >= 0) & (iou <= 1)).all()
    assert_allclose(np.diag(first.iou_3d(first)), np.ones(len(first)), rtol=0, atol=1e-12)


@given(upright_boxes(reach=20.0), upright_boxes(reach=20.0))
def test_gaps_are_the_polygons_distances(first: Boxes, second: Boxes) -> None:
    gap = first.distance_bev(second)
    expected = shapely.distance(footprints(first)[:, None], footprints(second))
    assert_allclose(gap, expected, rtol=0, atol=1e-9)
    assert_allclose(second.distance_bev(first).T, gap, rtol=0, atol=1e-12)
    center_distance = np.linalg.norm(first.center[:, None, :2] - second.center[:, :2], axis=-1)
    assert (gap <= center_distance + 1e-9).all()
    assert_array_equal(np.diag(first.distance_bev(first)), np.zeros(len(first)))


@given(upright_boxes(), upright_boxes(), st.floats(-np.pi, np.pi), arrays((3,), 1000.0))
def test_comparing_boxes_does_not_depend_on_the_frame(
    first: Boxes, second: Boxes, yaw: float, translation: np.ndarray
) -> None:
    pose = SE3.from_yaw(yaw, translation)
    moved_first = first.transform(pose, "world")
    moved_second = second.transform(pose, "world")
    for compare in (Boxes.iou_bev, Boxes.iou_3d, Boxes.distance_bev):
        moved_values = compare(moved_first, moved_second)
        assert_allclose(moved_values, compare(first, second), rtol=0, atol=1e-9)


@given(cameras(), poses(5.0), boxes())
def test_visibility_is_that_of_the_corners(
    camera: PinholeCamera, pose: SE3, given_boxes: Boxes
) -> None:
    """Compares with the nuScenes devkit's `box_in_image`, box by box and corner by corner."""
    in_camera = given_boxes.transform(pose, "Camera_Front")
    levels = camera.box_visibility(in_camera)
    for level, corners in zip(levels, in_camera.corners(), strict=True):
        pixels, depth = camera.project(corners)
        are_visible = [
            0 <= u < camera.width and 0 <= v < camera.height and z > 1
            for (u, v), z in zip(pixels, depth, strict=True)
        ]
        is_in_front = all(depth > 0.1)
        assert (level <= BoxVisibility.ALL) == (is_in_front and all(are_visible))
        assert (level <= BoxVisibility.ANY) == (is_in_front and any(are_visible))
    assert camera.boxes_in_image(in_camera, BoxVisibility.NONE).all()
    assert_array_equal(camera.boxes_in_image(in_camera), levels <= BoxVisibility.ANY)


@given(grids())
def test_every_centre_is_in_its_own_cell(grid: BevGrid) -> None:
    centers = grid.centers()
    assert centers.shape == (*grid.shape, 2)
    assert grid.cells == np.prod(grid.shape)
    index, inside = grid.index_of(centers.reshape(-1, 2))
    assert inside.all()
    assert_array_equal(index.reshape(*grid.shape, 2), np.moveaxis(np.indices(grid.shape), 0, -1))


@given(grids(), points(max_count=20, reach=60.0))
def test_points_are_within_half_a_cell_of_their_centre(
    grid: BevGrid, given_points: np.ndarray
) -> None:
    index, inside = grid.index_of(given_points)
    (low_x, high_x, size_x), (low_y, high_y, size_y) = grid.x, grid.y
    x, y = given_points[:, 0], given_points[:, 1]
    assert_array_equal(inside, (low_x <= x) & (x < high_x) & (low_y <= y) & (y < high_y))
    assert_array_equal(index[~inside], np.full(((~inside).sum(), 2), -1))
    centers = grid.centers()[tuple(index[inside].T)]
    half_cell = np.array([size_x, size_y]) / 2
    assert (np.abs(given_points[inside, :2] - centers) <= half_cell + 1e-9).all()


@given(grids(), st.sampled_from(ORIENTATIONS))
def test_reorienting_moves_each_cell_to_its_place(grid: BevGrid, orientation: Orientation) -> None:
    target = grid.with_orientation(orientation)
    for channel in range(2):
        moved = grid.reorient(grid.centers()[..., channel], orientation)
        assert_array_equal(moved, target.centers()[..., channel])
        assert_array_equal(target.reorient(moved, grid.orientation), grid.centers()[..., channel])
    assert target.with_orientation(grid.orientation) == grid
    assert hash(target.with_orientation(grid.orientation)) == hash(grid)


@given(clouds(), grids())
def test_cropping_to_a_grid_keeps_what_has_a_cell(cloud: LidarPointCloud, grid: BevGrid) -> None:
    cropped = cloud.crop(grid)
    _, has_cell = grid.index_of(cloud.xyz)
    assert_array_equal(cropped.xyz, cloud.xyz[has_cell])
    assert_array_equal(cloud.crop(x=grid.x[:2], y=grid.y[:2]).points, cropped.points)
