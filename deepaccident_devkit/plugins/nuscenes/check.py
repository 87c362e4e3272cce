"""Check whether a source's axes, ground and cameras follow the devkit's conventions, from its data.

Four things agree in a good source: the ego moves along its x, the road lies at its origin, points
lie on boxes, and boxes stand out in the images of their own cameras. The usual mistakes are tried
too, so that the message names the mistake. Only points decide about sides, and no deviation within
its own error counts: a good source passes.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError, SourceError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.support.arrays import AnyArray, ByteArray, FloatArray, IntArray, ShortRepr
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR, OWN_ACTOR_ID, VEHICLE_AGENTS

__all__ = ["SourceCheck", "check_source", "look_at"]

logger = logging.getLogger(__name__)

_NUM_SAMPLES: Final = 48
# Probability with which a test may detect a fault by chance.
_MAX_P_VALUE: Final = 1e-5
_NUM_CAMERA_ORDERS: Final = math.factorial(len(CAMERAS))
# Smallest number of samples, steps or boxes for a decision.
_MIN_VALUES: Final = 8
# Shortest distance in metres between two samples that shows where the ego goes.
_MIN_STEP_M: Final = 0.5
# Largest angle in degrees between the motion and x for which x is forward.
_MAX_TURN_DEG: Final = 45.0
# Share of the steps that may lead elsewhere, since cars also reverse.
_MAX_TURNED_SHARE: Final = 0.75
# Metres that the road may lie above or below the ego's origin.
_MAX_ROAD_OFFSET_M: Final = 0.6
# Height in metres above the ego's origin below which the LiDAR stands at the origin.
_MIN_LIDAR_HEIGHT_M: Final = 0.05
# Nearest and farthest distance in metres from the ego at which the height of the road is measured.
_ROAD_RANGE_M: Final = (3.0, 15.0)
_MIN_LIDAR_POINTS: Final = 5
_MIN_OCCUPIED_SHARE: Final = 0.5
_DEPTH_RANGE_M: Final = (1.0, 40.0)
# Half of a box's width and height, as a share of the image's.
_MIN_HALF_SIZE, _MAX_HALF_SIZE = 0.01, 0.4
# Smallest height and width of images that show boxes well enough.
_MIN_IMAGE_SIZE: Final = (90, 160)
# Directions of `taxonomy.CAMERAS` in degrees, in both sensor setups.
_CAMERA_DIRECTIONS_DEG: Final = np.array([0.0, 55.0, -55.0, 180.0, 110.0, -110.0])
# Factors of points that leave them as they are, and that mirror y.
_MIRRORINGS: Final = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceCheck(ShortRepr):
    """What S samples of a source show; NaN where nothing is known.

    Attributes:
        turns: Degrees by which the ego moves to the left of its x axis, from sample to sample,
            shape (P,).
        road: Heights of the road above the ego's origin in metres, shape (S,).
        boxes: Heights at which boxes near the ego stand, shape (S,).
        lidar: Height of the LiDAR.
        looks: Direction of each camera in degrees to the left of x, shape (6,).
        occupied: Whether each box that should hold points has some, 0 or 1, as the points are and
            mirrored, shape (B, 2).
        contrasts: How much boxes stand out where a camera (row) should show them, in the image of a
            camera (column): the mean logarithm, shape (S, 6, 6).
    """

    turns: FloatArray
    road: FloatArray
    boxes: FloatArray
    lidar: float
    looks: FloatArray
    occupied: FloatArray
    contrasts: FloatArray

    def faults(self) -> Iterator[str]:
        """Yield each fault in a sentence."""
        mean_direction = np.exp(1j * np.radians(self.turns)).sum()
        direction = float(np.degrees(np.angle(mean_direction)))
        turned = _is_above((np.abs(self.turns) > _MAX_TURN_DEG) - _MAX_TURNED_SHARE)
        road, floor = _mean(self.road), _mean(self.boxes)
        depths = []
        for heights in (self.road, self.boxes - np.nan_to_num(road)):
            if _is_above(heights * np.sign(_mean(heights)) - _MAX_ROAD_OFFSET_M):
                depths.append(-_mean(heights))
        where = f"the road lies at {road:.1f} m, boxes stand at {floor:.1f} m"
        side_fault = self._side_fault()
        if self.lidar < _MIN_LIDAR_HEIGHT_M and (turned or depths):
            yield (
                f"the LiDAR's frame stands for the ego's: {where}, and it moves {direction:.0f} "
                "degrees off x"
            )
        elif turned:
            yield f"x is not forward: the ego moves {direction:.0f} degrees to the left of it"
        elif depths:
            yield f"sunk by {depths[0]:.1f} m: {where}"
        elif side_fault:
            yield side_fault
        swaps = [*self._swapped_images(), *self._swapped_poses(direction if turned else 0)]
        if swaps and not (depths or side_fault):
            yield f"the cameras are in another order: {', '.join(swaps)}"

    def unchecked(self) -> Iterator[str]:
        """Yield what these samples cannot show, a clause each."""
        if len(self.turns) < _MIN_VALUES:
            yield "whether x is forward, since the ego hardly moves"
        if np.isfinite([self.road, self.boxes]).sum(axis=1).max() < _MIN_VALUES:
            yield "how high the road lies, since there are few points and few boxes"
        if len(self.occupied) < _MIN_VALUES:
            yield "whether y is to the left, since few boxes should hold points"
        contrasts = self._centred_contrasts()
        unclear = [
            name for code, name in enumerate(CAMERAS) if not _is_above(contrasts[:, code, code])
        ]
        if unclear:
            yield (
                f"whether the images are those of {', '.join(unclear)}, since boxes hardly stand "
                "out in them"
            )

    def _side_fault(self) -> str:
        """Return how boxes lie beside the points; empty if they do not."""
        actual, mirrored = self.occupied.T
        if not _is_above(_MIN_OCCUPIED_SHARE - actual):
            return ""
        shares = (
            f"points lie in {_mean(actual):.0%} of the boxes, in {_mean(mirrored):.0%} of them "
            "mirrored"
        )
        if _is_above(mirrored - actual):
            return f"y is mirrored: {shares}"
        return f"boxes are in other places: {shares}"

    def _centred_contrasts(self) -> FloatArray:
        """Return the contrasts less the means of the same boxes and images, shape (S, 6, 6)."""
        centred = self.contrasts - _mean(self.contrasts, axis=2)
        return np.asarray(centred - _mean(centred, axis=1))

    def _swapped_images(self) -> list[str]:
        """Return which cameras have the images of others, if that is certain."""
        from scipy.optimize import linear_sum_assignment

        contrasts = self._centred_contrasts()
        # The small diagonal keeps a camera's own image among equals.
        means = np.nan_to_num(_mean(contrasts, axis=0)[0]) + 1e-9 * np.eye(len(CAMERAS))
        cameras, images = linear_sum_assignment(means, maximize=True)
        swapped = np.flatnonzero(cameras != images)
        matched = contrasts[:, swapped, images[swapped]]
        own = contrasts[:, swapped, swapped]
        if not (_is_above(matched, tests=_NUM_CAMERA_ORDERS) and _is_above(matched - own)):
            return []
        return [
            f"{CAMERAS[images[camera]]} shows what {CAMERAS[camera]} should"
            for camera in swapped.tolist()
        ]

    def _swapped_poses(self, turn: float) -> list[str]:
        """Return which cameras look where others should, with the ego turned by some degrees."""
        differences = self.looks[:, None] - turn - _CAMERA_DIRECTIONS_DEG
        nearest = np.abs((differences + 180) % 360 - 180).argmin(axis=1)
        swaps = []
        for camera, other in enumerate(nearest.tolist()):
            if camera != other:
                swaps.append(f"{CAMERAS[camera]} looks where {CAMERAS[other]} should")
        return swaps


def _mean(values: FloatArray, axis: int | None = None) -> Any:
    """Return the mean of the known values, NaN of none; an axis along which it is taken stays."""
    known = np.ma.masked_invalid(values)
    return np.ma.filled(known.mean(axis=axis, keepdims=axis is not None), np.nan)


def _is_above(values: AnyArray, tests: int = 1) -> bool:
    """Return whether the mean of many values is significantly above 0 (Student's t).

    The probability of error is corrected for the number of tests.
    """
    from scipy.special import stdtr

    known = values[np.isfinite(values)]
    if len(known) < _MIN_VALUES:
        return False
    error = known.std(ddof=1) / len(known) ** 0.5 + 1e-9
    return bool(stdtr(len(known) - 1, -known.mean() / error) * tests < _MAX_P_VALUE)


def check_source(dataset: Dataset) -> SourceCheck:
    """Check some of the labelled samples of the first vehicle; raise SourceError.

    `look_at` does the same without raising SourceError.

    What these samples cannot show is logged as a warning.

    Raises:
        SourceError: Something is turned, mirrored, sunk or mixed up; the message describes it.
        NotAvailableError: No sample has labels.
        DeepAccidentError: `Dataset` cannot read a file.
    """
    check = look_at(dataset)
    faults = list(check.faults())
    if faults:
        raise SourceError(
            f"{dataset.dataroot}: {'; '.join(faults)}; mend it first: a model would learn it"
        )
    unchecked = list(check.unchecked())
    if unchecked:
        logger.warning("%s: could not be checked: %s", dataset.dataroot, "; ".join(unchecked))
    return check


def look_at(dataset: Dataset) -> SourceCheck:
    """Return what some of the labelled samples of the first vehicle show.

    Raises the errors of `check_source`, except SourceError.
    """
    labelled = [dataset.sample[row]["token"] for row in labelled_rows(dataset).tolist()]
    with_clouds = [sample for sample in labelled if dataset.sensor_path(sample, LIDAR).exists()]
    samples = spread(with_clouds or labelled, _NUM_SAMPLES)
    floors, lidar_heights, contrasts, roads = [], [], [], []
    occupied = [np.zeros((0, 2))]
    for sample in samples:
        boxes = _visible_boxes(dataset, sample)
        floors.append(_floor_height(boxes))
        lidar_heights.append(dataset.ego_from(sample, LIDAR).translation[2])
        contrasts.append(_contrasts(dataset, sample, boxes))
        if with_clouds:
            points = dataset.load_point_cloud(sample, "ego").xyz
            roads.append(road_height(points))
            columns = [boxes.count_points(points * factors) > 0 for factors in _MIRRORINGS]
            occupied.append(np.column_stack(columns))
    turns = np.array([_turn(dataset, *pair) for pair in pairwise(labelled)])
    directions = [looks_to(dataset.ego_from(samples[0], camera)) for camera in CAMERAS]
    return SourceCheck(
        turns=turns[np.isfinite(turns)],
        road=np.array(roads or [np.nan] * len(samples)),
        boxes=np.array(floors),
        lidar=float(np.median(lidar_heights)),
        looks=np.array(directions),
        occupied=np.concatenate(occupied),
        contrasts=np.stack(contrasts),
    )


def _visible_boxes(dataset: Dataset, sample: str) -> Boxes:
    """Return the boxes of a sample that should hold points, in the ego frame."""
    boxes = dataset.with_ignored.boxes(sample, "ego")
    has_points = boxes.num_lidar_pts >= _MIN_LIDAR_POINTS
    return boxes.select(has_points & (boxes.actor_id != OWN_ACTOR_ID))


def labelled_rows(dataset: Dataset) -> IntArray:
    """Return the rows of the labelled samples of the first vehicle; raise NotAvailableError."""
    view = dataset.columns("sample")
    rows = np.flatnonzero(view["labelled"][:] & (view["agent"] == AGENTS.index(VEHICLE_AGENTS[0])))
    if not len(rows):
        raise NotAvailableError(
            f"{dataset.dataroot}: {VEHICLE_AGENTS[0]} has no labels, so that there is nothing to "
            "see"
        )
    return rows


def spread(samples: Sequence[str], max_count: int) -> list[str]:
    """Return at most `max_count` samples, evenly from the first to the last."""
    count = min(max_count, len(samples))
    positions = np.linspace(0, len(samples) - 1, count).astype(int)
    return [samples[position] for position in np.unique(positions)]


def _turn(dataset: Dataset, sample: str, next_sample: str) -> float:
    """Return the degrees from the ego's x to its position at the next sample.

    NaN if that is near, or in another recording.
    """
    if sample.rsplit("/", 1)[0] != next_sample.rsplit("/", 1)[0]:
        return np.nan
    ego_from_world = dataset.world_from(sample, "ego").inverse()
    ego_from_next = ego_from_world @ dataset.world_from(next_sample, "ego")
    x, y, _ = ego_from_next.translation
    if np.hypot(x, y) > _MIN_STEP_M:
        return float(np.degrees(np.arctan2(y, x)))
    return np.nan


def looks_to(ego_from_camera: SE3) -> float:
    """Return the direction of a camera in degrees to the left of x."""
    y, x = ego_from_camera.rotation[1::-1, 2]
    return float(np.degrees(np.arctan2(y, x)))


def road_height(points: FloatArray) -> float:
    """Return the height at which most points around the ego lie; NaN without points."""
    nearest, farthest = _ROAD_RANGE_M
    distance, height = np.hypot(*points[:, :2].T), points[:, 2]
    is_road = (distance > nearest) & (distance < farthest) & (np.abs(height) < nearest)
    road_heights = height[is_road]
    counts, edges = np.histogram(road_heights, np.arange(-nearest, nearest, 0.1))
    if len(road_heights):
        return float(edges[counts.argmax()] + 0.05)
    return np.nan


def _floor_height(boxes: Boxes) -> float:
    """Return the median height at which boxes around the ego stand; NaN without any."""
    near_boxes = boxes.select(np.hypot(*boxes.center[:, :2].T) < 2 * _ROAD_RANGE_M[1])
    if not len(near_boxes):
        return np.nan
    return float(np.median(near_boxes.center[:, 2] - near_boxes.size[:, 2] / 2))


def _contrasts(dataset: Dataset, sample: str, boxes: Boxes) -> FloatArray:
    """Return the contrasts of a sample as `SourceCheck` has them, shape (6, 6)."""
    contrasts = np.full((len(CAMERAS), len(CAMERAS)), np.nan)
    if not all(dataset.sensor_path(sample, camera).exists() for camera in CAMERAS):
        return contrasts
    images = [dataset.load_image(sample, camera, min_size=_MIN_IMAGE_SIZE) for camera in CAMERAS]
    for row, camera in enumerate(CAMERAS):
        rectangles = _rectangles(dataset, sample, camera, boxes)
        if len(rectangles):
            for column, image in enumerate(images):
                values = [_contrast(image, middle, half) for middle, half in rectangles]
                contrasts[row, column] = np.log1p(values).mean()
    return contrasts


def _rectangles(dataset: Dataset, sample: str, camera: str, boxes: Boxes) -> FloatArray:
    """Return the rectangles of the boxes that a camera should show, shape (K, 2, 2).

    They are middle and half size, as shares of the image.
    """
    camera_from_world = dataset.world_from(sample, camera).inverse()
    camera_from_ego = camera_from_world @ dataset.world_from(sample, "ego")
    corners = boxes.transform(camera_from_ego, camera).corners()
    depths = corners[..., 2]
    min_depth, max_depth = _DEPTH_RANGE_M
    is_near = ((depths > min_depth) & (depths < max_depth)).all(axis=1)
    calibration = dataset.camera(sample, camera)
    pixels = calibration.project(corners[is_near].reshape(-1, 3))[0].reshape(-1, 8, 2)
    shares = pixels / (calibration.width, calibration.height)
    middle = (shares.max(axis=1) + shares.min(axis=1)) / 2
    half = np.ptp(shares, axis=1) / 2
    is_visible = (middle > 0) & (middle < 1) & (half > _MIN_HALF_SIZE) & (half < _MAX_HALF_SIZE)
    rectangles = np.stack([middle, half], axis=1)
    return np.asarray(rectangles[is_visible.all(axis=1)])


def _contrast(image: ByteArray, middle: FloatArray, half: FloatArray) -> float:
    """Return how far the mean colour in a rectangle is from the mean colour in and around it.

    The rectangle is in shares of the image.
    """
    size = np.array(image.shape[1::-1])

    def mean_colour(scale: float) -> FloatArray:
        reach = half * scale
        left, top = np.maximum((middle - reach) * size, 0).astype(int)
        right, bottom = np.ceil((middle + reach) * size).astype(int)
        pixels = image[top:bottom, left:right]
        return np.asarray(pixels.mean(axis=(0, 1)))

    return float(np.linalg.norm(mean_colour(0.7) - mean_colour(1.8)))
