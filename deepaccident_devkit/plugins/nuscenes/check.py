"""Check from the data of a source whether its axes, ground and cameras follow the conventions.

Four things are true of a good source: the ego moves along its x axis, the road is at the height of
the ego's origin, points are on boxes, and boxes stand out in the images of the right cameras. The
usual mistakes are tried as well, so that the message can name the mistake. Only points decide
between left and right. A deviation that is within its statistical error never counts, so that a
good source passes.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import NotAvailableError, SourceError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.support.arrays import AnyArray, ByteArray, FloatArray, IntArray, ShortRepr
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR, OWN_ACTOR_ID, VEHICLE_AGENTS

__all__ = ["SourceCheck", "check_source", "look_at"]

logger = logging.getLogger(__name__)

_NUM_SAMPLES = 48
# Largest probability that a test detects a fault by chance.
_MAX_P_VALUE = 1e-5
_NUM_CAMERA_ORDERS = math.factorial(len(CAMERAS))
# Smallest number of samples, steps or boxes for a decision.
_MIN_VALUES = 8
# Shortest distance between two samples that shows where the ego goes.
_MIN_STEP_M = 0.5
# Largest angle between the motion and x for which x counts as forward.
_MAX_TURN_DEG = 45.0
# Largest share of steps with a larger angle, since cars also reverse.
_MAX_TURNED_SHARE = 0.75
# Largest distance of the road from the ego's origin, upwards or downwards.
_MAX_ROAD_OFFSET_M = 0.6
# Height above the ego's origin below which the LiDAR counts as being at the origin.
_MIN_LIDAR_HEIGHT_M = 0.05
# Nearest and farthest distance from the ego at which the height of the road is measured.
_ROAD_RANGE_M = (3.0, 15.0)
# Sizes of the rectangles in which colours are averaged, relative to the rectangle of a box.
_INNER_SCALE = 0.7
_OUTER_SCALE = 1.8
_MIN_LIDAR_POINTS = 5
_MIN_OCCUPIED_SHARE = 0.5
_DEPTH_RANGE_M = (1.0, 40.0)
# Bounds of half the width and height of a box, as a share of the image's.
_MIN_HALF_SIZE = 0.01
_MAX_HALF_SIZE = 0.4
# Smallest height and width of images that show boxes well enough.
_MIN_IMAGE_SIZE = (90, 160)
# Directions of `taxonomy.CAMERAS` in degrees, in both sensor setups.
_CAMERA_DIRECTIONS_DEG = np.array([0.0, 55.0, -55.0, 180.0, 110.0, -110.0])
# Factors that leave points as they are, and factors that mirror y.
_MIRRORINGS = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceCheck(ShortRepr):
    """Measurements on S samples of a source; NaN where nothing is known.

    Attributes:
        turns: Angles from the ego's x axis to its motion between samples, in degrees to the left,
            shape (P,).
        road: Heights of the road above the ego's origin in metres, shape (S,).
        boxes: Heights of the floors of boxes near the ego in metres, shape (S,).
        lidar: Height of the LiDAR above the ego's origin in metres.
        looks: Direction of each camera in degrees to the left of x, shape (6,).
        occupied: Whether each box that should contain points contains any (0 or 1), with the points
            as they are and with mirrored points, shape (B, 2).
        contrasts: Mean logarithm of the boxes' contrast, shape (S, 6, 6). Boxes are where one
            camera (row) should show them, but in the image of another camera (column).
    """

    turns: FloatArray
    road: FloatArray
    boxes: FloatArray
    lidar: float
    looks: FloatArray
    occupied: FloatArray
    contrasts: FloatArray

    def faults(self) -> Iterator[str]:
        """Yield a sentence about each fault."""
        mean_direction = np.exp(1j * np.radians(self.turns)).sum()
        direction = float(np.degrees(np.angle(mean_direction)))
        is_far_turned = np.abs(self.turns) > _MAX_TURN_DEG
        is_turned = _is_above(is_far_turned - _MAX_TURNED_SHARE)
        road = _mean_known(self.road)
        floor = _mean_known(self.boxes)
        height_faults = []
        heights_above_road = self.boxes - np.nan_to_num(road)
        for subject, heights in (
            ("everything lies", self.road),
            ("the boxes lie", heights_above_road),
        ):
            mean_height = _mean_known(heights)
            if _is_above(heights * np.sign(mean_height) - _MAX_ROAD_OFFSET_M):
                side = "low" if mean_height < 0 else "high"
                height_faults.append(f"{subject} {abs(mean_height):.1f} m too {side}")
        where = f"the road lies at {road:.1f} m, boxes stand at {floor:.1f} m"
        side_fault = self._find_side_fault()
        if self.lidar < _MIN_LIDAR_HEIGHT_M and (is_turned or height_faults):
            yield (
                f"the LiDAR frame is used as the ego frame: {where}, and the ego moves "
                f"{direction:.0f} degrees off x"
            )
        elif is_turned:
            yield f"x is not forward: the ego moves {direction:.0f} degrees to the left of it"
        elif height_faults:
            yield f"{height_faults[0]}: {where}"
        elif side_fault:
            yield side_fault
        swaps = self._find_swapped_images()
        swaps += self._find_swapped_poses(direction if is_turned else 0)
        if swaps and not (height_faults or side_fault):
            yield f"the cameras are in another order: {', '.join(swaps)}"

    def unchecked(self) -> Iterator[str]:
        """Yield a clause about each thing that these samples cannot show."""
        if len(self.turns) < _MIN_VALUES:
            yield "whether x is forward, since the ego hardly moves"
        if np.isfinite([self.road, self.boxes]).sum(axis=1).max() < _MIN_VALUES:
            yield "how high the road lies, since there are few points and few boxes"
        if len(self.occupied) < _MIN_VALUES:
            yield "whether y is to the left, since few boxes should hold points"
        contrasts = self._centre_contrasts()
        unclear_cameras = []
        for index, camera in enumerate(CAMERAS):
            if not _is_above(contrasts[:, index, index]):
                unclear_cameras.append(camera)
        if unclear_cameras:
            yield (
                f"whether the images of {', '.join(unclear_cameras)} are from these cameras, "
                "since boxes hardly stand out in the images"
            )

    def _find_side_fault(self) -> str:
        """Return a sentence if boxes miss their points or y is mirrored; otherwise an empty one."""
        actual, mirrored = self.occupied.T
        if not _is_above(_MIN_OCCUPIED_SHARE - actual):
            return ""
        actual_share = _mean_known(actual)
        mirrored_share = _mean_known(mirrored)
        shares = (
            f"{actual_share:.0%} of the boxes contain points, and {mirrored_share:.0%} of the "
            "boxes do if y is mirrored"
        )
        if _is_above(mirrored - actual):
            return f"y is mirrored: {shares}"
        return f"boxes are in other places: {shares}"

    def _centre_contrasts(self) -> FloatArray:
        """Subtract from the contrasts their means over images and over boxes, (S, 6, 6)."""
        centred = self.contrasts - _mean_known(self.contrasts, axis=2)
        return np.asarray(centred - _mean_known(centred, axis=1))

    def _find_swapped_images(self) -> list[str]:
        """Return a clause for each camera that significantly matches another camera's image."""
        from scipy.optimize import linear_sum_assignment

        contrasts = self._centre_contrasts()
        means = np.nan_to_num(_mean_known(contrasts, axis=0)[0])
        # The small diagonal prefers a camera's own image among equals.
        means += 1e-9 * np.eye(len(CAMERAS))
        cameras, images = linear_sum_assignment(means, maximize=True)
        swapped = np.flatnonzero(cameras != images)
        matched = contrasts[:, swapped, images[swapped]]
        own = contrasts[:, swapped, swapped]
        if not (_is_above(matched, tests=_NUM_CAMERA_ORDERS) and _is_above(matched - own)):
            return []
        swaps = []
        for camera in swapped.tolist():
            swaps.append(f"{CAMERAS[images[camera]]} shows what {CAMERAS[camera]} should")
        return swaps

    def _find_swapped_poses(self, turn: float) -> list[str]:
        """Return a clause for each camera that looks where another one should.

        Args:
            turn: Angle in degrees by which the ego is turned.
        """
        differences = self.looks[:, None] - turn - _CAMERA_DIRECTIONS_DEG
        nearest_indices = np.abs((differences + 180) % 360 - 180).argmin(axis=1)
        swaps = []
        for camera, other in enumerate(nearest_indices.tolist()):
            if camera != other:
                swaps.append(f"{CAMERAS[camera]} looks where {CAMERAS[other]} should")
        return swaps


def _mean_known(values: FloatArray, axis: int | None = None) -> Any:
    """Return the mean of the values that are not NaN; NaN if there are none.

    If `axis` is not None, it is kept with size 1.
    """
    known = np.ma.masked_invalid(values)
    means = known.mean(axis=axis, keepdims=axis is not None)
    return np.ma.filled(means, np.nan)


def _is_above(values: AnyArray, tests: int = 1) -> bool:
    """Return whether the mean of the values is significantly above 0 (Student's t-test).

    The significance level is corrected for the number of tests.
    """
    from scipy.special import stdtr

    known_values = values[np.isfinite(values)]
    if len(known_values) < _MIN_VALUES:
        return False
    standard_error = known_values.std(ddof=1) / len(known_values) ** 0.5 + 1e-9
    p_value = stdtr(len(known_values) - 1, -known_values.mean() / standard_error)
    return bool(p_value * tests < _MAX_P_VALUE)


def check_source(dataset: Dataset) -> SourceCheck:
    """Check some labelled samples of the first vehicle, and return what they show.

    What these samples cannot show is logged as a warning. `look_at` measures the same, but raises
    no SourceError.

    Raises:
        SourceError: If something is rotated, mirrored, at the wrong height or swapped; the message
            describes it.
        NotAvailableError: If no sample has labels.
        DeepAccidentError: If `Dataset` cannot read a file.
    """
    check = look_at(dataset)
    faults = list(check.faults())
    if faults:
        raise SourceError(
            f"{dataset.dataroot}: {'; '.join(faults)}; correct this before you train, or "
            "the model learns it"
        )
    unchecked = list(check.unchecked())
    if unchecked:
        logger.warning("%s: could not be checked: %s", dataset.dataroot, "; ".join(unchecked))
    return check


def look_at(dataset: Dataset) -> SourceCheck:
    """Return what some labelled samples of the first vehicle show.

    Raises the errors of `check_source`, except SourceError.
    """
    tokens = [dataset.sample[row]["token"] for row in find_labelled_rows(dataset).tolist()]
    with_clouds = [token for token in tokens if dataset.sensor_path(token, LIDAR).exists()]
    samples = spread_samples(with_clouds or tokens, _NUM_SAMPLES)
    floors = []
    lidar_heights = []
    contrasts = []
    roads = []
    occupied = [np.zeros((0, 2))]
    for sample in samples:
        boxes = _read_visible_boxes(dataset, sample)
        floors.append(_measure_floor_height(boxes))
        lidar_heights.append(dataset.ego_from(sample, LIDAR).translation[2])
        contrasts.append(_measure_contrasts(dataset, sample, boxes))
        if with_clouds:
            points = dataset.load_point_cloud(sample, "ego").xyz
            roads.append(measure_road_height(points))
            columns = [boxes.count_points(points * factors) > 0 for factors in _MIRRORINGS]
            occupied.append(np.column_stack(columns))
    turns = np.array([_measure_turn(dataset, *pair) for pair in pairwise(tokens)])
    directions = [measure_direction(dataset.ego_from(samples[0], camera)) for camera in CAMERAS]
    return SourceCheck(
        turns=turns[np.isfinite(turns)],
        road=np.array(roads or [np.nan] * len(samples)),
        boxes=np.array(floors),
        lidar=float(np.median(lidar_heights)),
        looks=np.array(directions),
        occupied=np.concatenate(occupied),
        contrasts=np.stack(contrasts),
    )


def _read_visible_boxes(dataset: Dataset, sample: str) -> Boxes:
    """Return the boxes of a sample that should contain points, in the ego frame."""
    boxes = dataset.with_ignored.boxes(sample, "ego")
    has_points = boxes.num_lidar_pts >= _MIN_LIDAR_POINTS
    return boxes.select(has_points & (boxes.actor_id != OWN_ACTOR_ID))


def find_labelled_rows(dataset: Dataset) -> IntArray:
    """Return the rows of the labelled samples of the first vehicle.

    Raises NotAvailableError if there are none.
    """
    view = dataset.columns("sample")
    is_first_vehicle = view["agent"] == AGENTS.index(VEHICLE_AGENTS[0])
    rows = np.flatnonzero(view["labelled"][:] & is_first_vehicle)
    if not len(rows):
        raise NotAvailableError(
            f"{dataset.dataroot}: {VEHICLE_AGENTS[0]} has no labels, so there is nothing to check"
        )
    return rows


def spread_samples(samples: Sequence[str], max_count: int) -> list[str]:
    """Return at most `max_count` samples, evenly spread from the first to the last."""
    count = min(max_count, len(samples))
    positions = np.linspace(0, len(samples) - 1, count).astype(int)
    return [samples[position] for position in np.unique(positions)]


def _measure_turn(dataset: Dataset, sample: str, next_sample: str) -> float:
    """Return the angle in degrees from the ego's x axis to its position at the next sample.

    The angle is NaN if that position is too close, or if the next sample is of another recording.
    """
    if sample.rsplit("/", 1)[0] != next_sample.rsplit("/", 1)[0]:
        return np.nan
    ego_from_world = dataset.world_from(sample, "ego").inverse()
    ego_from_next = ego_from_world @ dataset.world_from(next_sample, "ego")
    x, y, _ = ego_from_next.translation
    if np.hypot(x, y) > _MIN_STEP_M:
        return float(np.degrees(np.arctan2(y, x)))
    return np.nan


def measure_direction(ego_from_camera: SE3) -> float:
    """Return the direction in which a camera looks, in degrees to the left of x."""
    view_axis = ego_from_camera.rotation[:, 2]
    angle = np.arctan2(view_axis[1], view_axis[0])
    return float(np.degrees(angle))


def measure_road_height(points: FloatArray) -> float:
    """Return the height in metres at which most points around the ego lie; NaN without points."""
    nearest, farthest = _ROAD_RANGE_M
    distance = np.hypot(*points[:, :2].T)
    height = points[:, 2]
    is_road = (distance > nearest) & (distance < farthest) & (np.abs(height) < nearest)
    road_heights = height[is_road]
    counts, edges = np.histogram(road_heights, np.arange(-nearest, nearest, 0.1))
    if len(road_heights):
        return float(edges[counts.argmax()] + 0.05)
    return np.nan


def _measure_floor_height(boxes: Boxes) -> float:
    """Return the median height of the floors of boxes around the ego; NaN without boxes."""
    distance = np.hypot(*boxes.center[:, :2].T)
    near_boxes = boxes.select(distance < 2 * _ROAD_RANGE_M[1])
    if not len(near_boxes):
        return np.nan
    half_heights = near_boxes.size[:, 2] / 2
    return float(np.median(near_boxes.center[:, 2] - half_heights))


def _measure_contrasts(dataset: Dataset, sample: str, boxes: Boxes) -> FloatArray:
    """Return the contrasts of a sample, shape (6, 6), as in `SourceCheck.contrasts`."""
    contrasts = np.full((len(CAMERAS), len(CAMERAS)), np.nan)
    if not all(dataset.sensor_path(sample, camera).exists() for camera in CAMERAS):
        return contrasts
    images = [dataset.load_image(sample, camera, min_size=_MIN_IMAGE_SIZE) for camera in CAMERAS]
    for row, camera in enumerate(CAMERAS):
        rectangles = _find_rectangles(dataset, sample, camera, boxes)
        if len(rectangles):
            for column, image in enumerate(images):
                values = [_measure_contrast(image, *rectangle) for rectangle in rectangles]
                contrasts[row, column] = np.log1p(values).mean()
    return contrasts


def _find_rectangles(dataset: Dataset, sample: str, camera: str, boxes: Boxes) -> FloatArray:
    """Return the rectangles of the boxes that a camera should show, shape (K, 2, 2).

    A rectangle is its middle and its half size (x, y), as shares of the image.
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


def _measure_contrast(image: ByteArray, middle: FloatArray, half: FloatArray) -> float:
    """Return the difference between the mean colours inside a rectangle and around it.

    Args:
        image: Image, shape (h, w, 3).
        middle: Middle of the rectangle (x, y), as shares of the image.
        half: Half size of the rectangle (x, y), as shares of the image.
    """
    size = np.array(image.shape[1::-1])

    def average_color(scale: float) -> FloatArray:
        reach = half * scale
        left, top = np.maximum((middle - reach) * size, 0).astype(int)
        right, bottom = np.ceil((middle + reach) * size).astype(int)
        pixels = image[top:bottom, left:right]
        return np.asarray(pixels.mean(axis=(0, 1)))

    difference = average_color(_INNER_SCALE) - average_color(_OUTER_SCALE)
    return float(np.linalg.norm(difference))
