"""Laws of boxes, cameras, point clouds and grids; those of SE3 and of the boxes' motion are in
test_se3.py.
"""

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from strategies import arrays, boxes, cameras, clouds, grids, points, poses, upright_boxes

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


def plainly_contains(given_boxes: Boxes, given_points: np.ndarray) -> np.ndarray:
    """The definition: a point's offset along each axis of the box is at most half its size. No
    window, no grid.
    """
    offset = given_points - given_boxes.center[:, None]
    axes = quaternions.to_matrix(given_boxes.rotation)[:, None]
    along = [
        offset[..., 0] * axes[..., 0, axis]
        + offset[..., 1] * axes[..., 1, axis]
        + offset[..., 2] * axes[..., 2, axis]
        for axis in range(3)
    ]
    return (np.abs(np.stack(along, axis=-1)) <= given_boxes.size[:, None] / 2).all(axis=-1)


def footprints(given_boxes: Boxes) -> np.ndarray:
    return shapely.polygons(given_boxes.bottom_corners()[..., :2])


@given(boxes(max_count=8), points(max_count=40), arrays((8, 3), 2.0))
def test_points_in_boxes_are_the_definitions_to_the_bit(
    given_boxes: Boxes, anywhere: np.ndarray, offsets: np.ndarray
) -> None:
    near = given_boxes.center + offsets[: len(given_boxes)]
    some = np.concatenate(
        [anywhere, near, given_boxes.center, given_boxes.corners().reshape(-1, 3), [[np.nan] * 3]]
    )
    expected = plainly_contains(given_boxes, some)
    assert_array_equal(given_boxes.contains(some), expected)
    assert_array_equal(given_boxes.count_points(some), expected.sum(axis=1))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from([0.0, 3.0, 30.0, 1000.0]))
def test_points_in_boxes_of_whole_clouds(seed: int, count: int, reach: float) -> None:
    """More points than one piece of the coarse grid takes, on the boxes' faces among them."""
    rng = np.random.default_rng(seed)
    turned = SE3.from_six(rng.uniform(-1, 1, 6))
    center, size = rng.normal(size=(count, 3)) * reach, rng.uniform(0.2, 9, (count, 3)).round(1)
    upright = Boxes.from_arrays(center.round(1), size, rng.choice([0, np.pi / 2, 0.3], count))
    for some in (upright, upright.transform(turned, "ego")):
        spread = some.center[rng.integers(0, count, 9000)] + (rng.normal(size=(9000, 3)) * 3).round(
            1
        )
        assert_array_equal(some.contains(spread), plainly_contains(some, spread))


@given(upright_boxes(), upright_boxes())
def test_iou_on_the_ground_is_the_polygons(one: Boxes, two: Boxes) -> None:
    mine, theirs = footprints(one)[:, None], footprints(two)
    common = shapely.area(shapely.intersection(mine, theirs))
    iou = one.iou_bev(two)
    assert_allclose(
        iou, common / (shapely.area(mine) + shapely.area(theirs) - common), rtol=0, atol=1e-9
    )
    assert_allclose(two.iou_bev(one).T, iou, rtol=0, atol=1e-12)
    assert ((iou >= 0) & (iou <= 1)).all()
    assert_allclose(np.diag(one.iou_bev(one)), np.ones(len(one)), rtol=0, atol=1e-12)


@given(upright_boxes(), upright_boxes())
def test_iou_in_space_is_ground_times_height(one: Boxes, two: Boxes) -> None:
    ground = shapely.area(shapely.intersection(footprints(one)[:, None], footprints(two)))
    spans = [
        (some.corners()[..., 2].min(axis=1), some.corners()[..., 2].max(axis=1))
        for some in (one, two)
    ]
    (low, high), (other_low, other_high) = spans
    common = ground * np.maximum(
        np.minimum(high[:, None], other_high) - np.maximum(low[:, None], other_low), 0
    )
    expected = common / (one.size.prod(axis=1)[:, None] + two.size.prod(axis=1) - common)
    iou = one.iou_3d(two)
    assert_allclose(iou, expected, rtol=0, atol=1e-9)
    assert_allclose(two.iou_3d(one).T, iou, rtol=0, atol=1e-12)
    assert ((iou >= 0) & (iou <= 1)).all()
    assert_allclose(np.diag(one.iou_3d(one)), np.ones(len(one)), rtol=0, atol=1e-12)


@given(upright_boxes(reach=20.0), upright_boxes(reach=20.0))
def test_gaps_are_the_polygons_distances(one: Boxes, two: Boxes) -> None:
    gap = one.distance_bev(two)
    assert_allclose(
        gap, shapely.distance(footprints(one)[:, None], footprints(two)), rtol=0, atol=1e-9
    )
    assert_allclose(two.distance_bev(one).T, gap, rtol=0, atol=1e-12)
    apart = np.linalg.norm(one.center[:, None, :2] - two.center[:, :2], axis=-1)
    assert (gap <= apart + 1e-9).all()
    assert_array_equal(np.diag(one.distance_bev(one)), np.zeros(len(one)))


@given(upright_boxes(), upright_boxes(), st.floats(-np.pi, np.pi), arrays((3,), 1000.0))
def test_comparing_boxes_does_not_depend_on_the_frame(
    one: Boxes, two: Boxes, yaw: float, place: np.ndarray
) -> None:
    pose = SE3.from_yaw(yaw, place)
    moved, moved_too = (some.transform(pose, "world") for some in (one, two))
    assert_allclose(moved.iou_bev(moved_too), one.iou_bev(two), rtol=0, atol=1e-9)
    assert_allclose(moved.iou_3d(moved_too), one.iou_3d(two), rtol=0, atol=1e-9)
    assert_allclose(moved.distance_bev(moved_too), one.distance_bev(two), rtol=0, atol=1e-9)


@given(cameras(), poses(5.0), boxes())
def test_visibility_is_that_of_the_corners(camera: PinholeCamera, pose: SE3, some: Boxes) -> None:
    """The nuScenes devkit's `box_in_image`, box by box and corner by corner."""
    in_camera = some.transform(pose, "Camera_Front")
    levels = camera.box_visibility(in_camera)
    for level, corners in zip(levels, in_camera.corners(), strict=True):
        pixels, depth = camera.project(corners)
        seen = [
            0 <= u < camera.width and 0 <= v < camera.height and z > 1
            for (u, v), z in zip(pixels, depth, strict=True)
        ]
        in_front = all(depth > 0.1)
        assert (level <= BoxVisibility.ALL) == (in_front and all(seen))
        assert (level <= BoxVisibility.ANY) == (in_front and any(seen))
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
def test_points_are_within_half_a_cell_of_their_centre(grid: BevGrid, some: np.ndarray) -> None:
    index, inside = grid.index_of(some)
    (low_x, high_x, size_x), (low_y, high_y, size_y) = grid.x, grid.y
    x, y = some[:, 0], some[:, 1]
    assert_array_equal(inside, (low_x <= x) & (x < high_x) & (low_y <= y) & (y < high_y))
    assert_array_equal(index[~inside], np.full(((~inside).sum(), 2), -1))
    centers = grid.centers()[tuple(index[inside].T)]
    assert (np.abs(some[inside, :2] - centers) <= np.array([size_x, size_y]) / 2 + 1e-9).all()


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
    kept = cloud.crop(grid)
    assert_array_equal(kept.xyz, cloud.xyz[grid.index_of(cloud.xyz)[1]])
    assert_array_equal(cloud.crop(x=grid.x[:2], y=grid.y[:2]).points, kept.points)
