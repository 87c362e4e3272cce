"""Measure points in boxes, projection and rotated IoU, each against the plain or the usual way to
do it.
"""

import numpy as np
import shapely

from benchmarks import cooperative, statistics
from benchmarks.measure import Figure, best_of, milliseconds, one_core
from deepaccident_devkit.geometry import SE3, Boxes, PinholeCamera, quaternions

POINTS, BOXES, PAIRED = 40_000, 30, 100
REPEATS = 100


def measure() -> list[Figure]:
    source = np.random.default_rng(0)
    boxes = make_boxes(source, BOXES)
    points = make_points(source)
    first = make_boxes(source, PAIRED)
    second = make_boxes(source, PAIRED)
    camera = PinholeCamera.from_field_of_view(1600, 900, np.radians(70))
    in_camera = SE3.from_rotation([[0, -1, 0], [0, 0, -1], [1, 0, 0]]).apply(points)
    if not np.array_equal(boxes.contains(points), plainly_contains(boxes, points)):
        raise AssertionError("the two ways to find points in boxes disagree")
    if np.abs(first.iou_bev(second) - shapely_iou(first, second)).max() > 1e-9:
        raise AssertionError("IoU differs from shapely's by more than 1e-9")
    with one_core():
        seconds = {
            "points_in_boxes": best_of(REPEATS, lambda: boxes.contains(points)),
            "points_in_boxes_plain": best_of(5, lambda: plainly_contains(boxes, points)),
            "count_points": best_of(REPEATS, lambda: boxes.count_points(points)),
            "project": best_of(REPEATS, lambda: camera.project(in_camera)),
            "bev_iou": best_of(REPEATS, lambda: first.iou_bev(second)),
            "bev_iou_shapely": best_of(5, lambda: shapely_iou(first, second)),
            "bev_distance": best_of(REPEATS, lambda: first.distance_bev(second)),
        }
    bounds = {"points_in_boxes": 2.0, "project": 3.0}
    figures = [
        milliseconds(f"geometry_{name}_ms", value, bound=bounds.get(name))
        for name, value in seconds.items()
    ]
    return [*figures, *cooperative.measure(), *statistics.measure()]


def make_boxes(source: np.random.Generator, count: int) -> Boxes:
    """Return upright boxes of road users' sizes, all over a BEV grid."""
    position = source.uniform(-50, 50, (count, 2))
    height = source.uniform(-1, 1, count)
    center = np.column_stack([position, height])
    size = source.uniform([0.5, 0.5, 1.4], [9, 3, 3.5], (count, 3))
    yaw = source.uniform(-np.pi, np.pi, count)
    return Boxes.from_arrays(center, size, yaw, frame="lidar")


def make_points(source: np.random.Generator) -> np.ndarray:
    """Return a cloud that thins out with the distance, as a LiDAR's does."""
    bearing = source.uniform(-np.pi, np.pi, POINTS)
    distance = 2 + np.abs(source.normal(0, 25, POINTS))
    height = source.uniform(-2, 3, POINTS)
    x = distance * np.cos(bearing)
    y = distance * np.sin(bearing)
    return np.column_stack([x, y, height])


def plainly_contains(boxes: Boxes, points: np.ndarray) -> np.ndarray:
    """Return whether points lie in boxes as one writes it first: every point in every box's own
    axes.
    """
    inside = np.empty((len(boxes), len(points)), dtype=bool)
    for index, axes in enumerate(quaternions.to_matrix(boxes.rotation)):
        x, y, z = (points - boxes.center[index]).T
        coordinates = [x * ax + y * ay + z * az for ax, ay, az in axes.T]
        distance = np.abs(np.stack(coordinates, axis=1))
        inside[index] = (distance <= boxes.size[index] / 2).all(axis=1)
    return inside


def shapely_iou(first: Boxes, second: Boxes) -> np.ndarray:
    """Return the BEV IoU of all pairs by shapely."""
    first_polygons = shapely.polygons(first.bottom_corners()[..., :2])[:, None]
    second_polygons = shapely.polygons(second.bottom_corners()[..., :2])
    first_area = shapely.area(first_polygons)
    second_area = shapely.area(second_polygons)
    common_area = shapely.area(shapely.intersection(first_polygons, second_polygons))
    return common_area / (first_area + second_area - common_area)
