"""Whether a source's axes, ground and cameras are those that the devkit means, by what its data show.

Four things agree in a good source: the ego moves along its x, the road lies at its origin, points lie on boxes, and
boxes lie where their camera's image shows something. The usual mistakes are tried too, so that the message names the
one that was made.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import SourceError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.support.arrays import ByteArray, FloatArray, IntArray, ShortRepr
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR, OWN_ACTOR_ID, VEHICLE_AGENTS

__all__ = ["SourceCheck", "check_source", "look_at"]

_SAMPLES: Final = 24
_STEP: Final = 0.5
"""Metres from one sample to the next, from which on it is known where the ego goes."""
_ASIDE: Final = 45.0
"""Degrees from x, beyond which x is not forward."""
_OFF: Final = 0.6
"""Metres that the road may lie above or below the ego's origin."""
_AT_ORIGIN: Final = 0.05
"""Metres above the ego's origin, below which the LiDAR is there."""
_AROUND: Final = (3.0, 15.0)
"""Metres from the ego, between which the road is looked for."""
_LEAST_POINTS: Final = 5
_LEAST_SHARE: Final = 0.5
_LEAST_BOXES: Final = 20
_DEPTHS: Final = (1.0, 40.0)
_LEAST_PIXELS: Final = 3
_CLEARER: Final = 0.4
"""Standard deviations by which boxes must stand out more, for another order of cameras or another side."""
_LOOKS: Final = np.array([0.0, 55.0, -55.0, 180.0, 110.0, -110.0])
"""Degrees, of `taxonomy.CAMERAS`: of both rigs."""
_AS_THEY_ARE, _MIRRORED = (1.0, 1.0, 1.0), (1.0, -1.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceCheck(ShortRepr):
    """What was found of a source; NaN where nothing tells.

    Attributes:
        forward: degrees by which the ego moves to the left of its x axis, the median.
        road: height of the road above the ego's origin, metres, the median.
        boxes: the height at which boxes near the ego stand.
        lidar: height of the LiDAR above it.
        looks: (6,) degrees to the left of x to which each camera looks.
        on_boxes: share of the boxes in which points lie, of those with points by their label.
        on_mirrored: the same with all boxes' y mirrored.
        num_seen: (6,) actors that each camera should show; one that is seen for long tells no more than others.
        in_images: (6, 6) by how many standard deviations they stand out where a camera (row) should show them, in the
            image of a camera (column).
        mirrored: by how many more they do with y mirrored.
    """

    forward: float
    road: float
    boxes: float
    lidar: float
    looks: FloatArray
    on_boxes: float
    on_mirrored: float
    num_seen: IntArray
    in_images: FloatArray
    mirrored: float

    def faults(self) -> Iterator[str]:
        """What is wrong, a sentence each."""
        turned = abs(self.forward) > _ASIDE
        flipped = self.on_boxes < _LEAST_SHARE <= self.on_mirrored or self.mirrored > _CLEARER
        beside = 0.0 if math.isnan(self.road) else self.road
        sunk = next((height for height in (self.road, self.boxes - beside) if abs(height) > _OFF), 0.0)
        heights = f"the road lies at {self.road:.1f} m, boxes stand at {self.boxes:.1f} m"
        if self.lidar < _AT_ORIGIN and (turned or sunk):
            yield f"the LiDAR's frame stands for the ego's: {heights}, and it moves {self.forward:.0f} degrees off x"
        elif turned:
            yield f"x is not forward: the ego moves {self.forward:.0f} degrees to the left of it"
        elif sunk:
            yield f"sunk by {-sunk:.1f} m: {heights}"
        elif flipped:
            shares = f"{self.on_boxes:.0%} of the boxes, {self.on_mirrored:.0%} of them mirrored"
            yield f"y is mirrored: points lie in {shares}"
        elif self.on_boxes < _LEAST_SHARE:
            yield f"points lie in {self.on_boxes:.0%} of the boxes that should have some"
        swapped = [*self._shown_elsewhere(), *self._turned_away(self.forward if turned else 0)]
        if swapped and not (flipped or sunk):
            yield f"the cameras are in another order: {', '.join(swapped)}"

    def _shown_elsewhere(self) -> list[str]:
        from scipy.optimize import linear_sum_assignment

        summed = self.in_images * self.num_seen[:, None] + 1e-9 * np.eye(len(CAMERAS))
        order = linear_sum_assignment(-summed)[1]
        other = np.flatnonzero(order != np.arange(len(order)))
        gain, seen = (summed[other, order[other]] - summed[other, other]).sum(), self.num_seen[other].sum()
        is_mixed = seen >= _LEAST_BOXES and gain > _CLEARER * seen
        return [f"{CAMERAS[order[at]]} shows what {CAMERAS[at]} should" for at in other.tolist() if is_mixed]

    def _turned_away(self, turn: float) -> list[str]:
        nearest = np.abs((self.looks[:, None] - turn - _LOOKS + 180) % 360 - 180).argmin(axis=1).tolist()
        return [f"{CAMERAS[at]} looks where {CAMERAS[to]} should" for at, to in enumerate(nearest) if at != to]


def check_source(dataset: Dataset) -> SourceCheck:
    """Look at some of the labelled samples of the first vehicle; `look_at` finds the same and raises no SourceError.

    Raises:
        SourceError: something is turned, mirrored, sunk or mixed up; the message says what.
        DeepAccidentError: as of `Dataset`, for a file that cannot be read.
    """
    found = look_at(dataset)
    if faults := list(found.faults()):
        raise SourceError(f"{dataset.dataroot}: {'; '.join(faults)}; mend it first: a model would learn it")
    return found


def look_at(dataset: Dataset) -> SourceCheck:
    """What some of the labelled samples of the first vehicle show."""
    samples = [dataset.sample[row]["token"] for row in labelled_rows(dataset).tolist()]
    chosen = spread(samples, _SAMPLES)
    boxes = [_boxes(dataset, sample) for sample in chosen]
    clouds = [
        dataset.load_point_cloud(sample, "ego").xyz if dataset.sensor_path(sample, LIDAR).exists() else np.zeros((0, 3))
        for sample in chosen
    ]
    views = _of_actors([_views(dataset, sample, each) for sample, each in zip(chosen, boxes, strict=True)])
    num_seen = np.bincount(views[:, 0].astype(int), minlength=len(CAMERAS))
    in_images = np.zeros((len(CAMERAS), len(CAMERAS)))
    np.add.at(in_images, views[:, 0].astype(int), views[:, 2:])
    return SourceCheck(
        forward=_median(_turn(dataset, *pair) for pair in pairwise(samples)),
        road=_median(map(road_height, clouds)),
        boxes=_median(map(_floor, boxes)),
        lidar=_median(dataset.ego_from(sample, LIDAR).translation[2] for sample in chosen),
        looks=np.array([looks_to(dataset.ego_from(chosen[0], camera)) for camera in CAMERAS]),
        on_boxes=_share(clouds, boxes, _AS_THEY_ARE),
        on_mirrored=_share(clouds, boxes, _MIRRORED),
        num_seen=num_seen,
        in_images=in_images / np.maximum(num_seen, 1)[:, None],
        mirrored=float(views[:, 1].mean()) if len(views) >= _LEAST_BOXES else np.nan,
    )


def labelled_rows(dataset: Dataset) -> IntArray:
    """The rows of the labelled samples of the first vehicle."""
    view = dataset.columns("sample")
    return np.flatnonzero(view["labelled"][:] & (view["agent"] == AGENTS.index(VEHICLE_AGENTS[0])))


def spread(samples: Sequence[str], most: int) -> list[str]:
    """So many of them, evenly from the first to the last."""
    return [
        samples[place] for place in np.unique(np.linspace(0, len(samples) - 1, min(most, len(samples))).astype(int))
    ]


def _median(values: Iterable[float]) -> float:
    known = [value for value in values if value == value]  # noqa: PLR0124 - not NaN
    return float(np.median(known)) if known else np.nan


def _boxes(dataset: Dataset, sample: str) -> Boxes:
    """Those of others in which its label counts points, in its ego frame."""
    boxes = dataset.boxes(sample, "ego")
    return boxes.select((boxes.num_lidar_pts >= _LEAST_POINTS) & (boxes.actor_id != OWN_ACTOR_ID))


def _turn(dataset: Dataset, sample: str, following: str) -> float:
    """Degrees from the ego's x to where it is at the next sample; NaN if that is near, or of another recording."""
    if sample.rsplit("/", 1)[0] != following.rsplit("/", 1)[0]:
        return np.nan
    x, y, _ = (dataset.world_from(sample, "ego").inverse() @ dataset.world_from(following, "ego")).translation
    return float(np.degrees(np.arctan2(y, x))) if np.hypot(x, y) > _STEP else np.nan


def looks_to(ego_from_camera: SE3) -> float:
    """Degrees to the left of x."""
    return float(np.degrees(np.arctan2(*ego_from_camera.rotation[1::-1, 2])))


def road_height(points: FloatArray) -> float:
    """The height at which most points around the ego lie; NaN without points."""
    distance = np.hypot(points[:, 0], points[:, 1])
    z = points[(distance > _AROUND[0]) & (distance < _AROUND[1]) & (np.abs(points[:, 2]) < _AROUND[0]), 2]
    counts, edges = np.histogram(z, np.arange(-_AROUND[0], _AROUND[0], 0.1))
    return float(edges[counts.argmax()] + 0.05) if len(z) else np.nan


def _floor(boxes: Boxes) -> float:
    """The height at which boxes around the ego stand, the median; NaN without any."""
    near = np.hypot(boxes.center[:, 0], boxes.center[:, 1]) < 2 * _AROUND[1]
    return _median((boxes.center[:, 2] - boxes.size[:, 2] / 2)[near].tolist())


def _share(clouds: Sequence[FloatArray], boxes: Sequence[Boxes], side: tuple[float, float, float]) -> float:
    """Of boxes that should hold points, in how many some lie; NaN for too few."""
    held = [each.count_points(points * side) > 0 for points, each in zip(clouds, boxes, strict=True) if len(points)]
    known = np.concatenate([np.zeros(0, dtype=bool), *held])
    return float(known.mean()) if len(known) >= _LEAST_BOXES else np.nan


def _of_actors(views: Sequence[tuple[list[tuple[str, int, int]], FloatArray]]) -> FloatArray:
    """The means (K, 8) of what was seen of the same actor by the same camera."""
    keys = [key for of_sample, _ in views for key in of_sample]
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    summed, rows = np.zeros((len(numbers), 8)), [numbers[key] for key in keys]
    np.add.at(summed, rows, np.concatenate([np.zeros((0, 8)), *[values for _, values in views]]))
    return np.asarray(summed / np.bincount(rows, minlength=len(numbers)).astype(float)[:, None])


def _views(dataset: Dataset, sample: str, boxes: Boxes) -> tuple[list[tuple[str, int, int]], FloatArray]:
    """Of each box that a camera should show: scenario, actor and camera; and (K, 8) numbers.

    These are the camera, how much more mirrored boxes stand out, and how much the box does in each camera's image, all
    in standard deviations of the six.
    """
    there = all(dataset.sensor_path(sample, camera).exists() for camera in CAMERAS)
    images = [dataset.load_image(sample, camera) for camera in CAMERAS] if there else []
    found, keys = [np.zeros((0, 8))], []
    for number, image in enumerate(images):
        (as_given, rows), (mirrored, _) = (
            _rectangles(dataset, sample, number, boxes, side) for side in (_AS_THEY_ARE, _MIRRORED)
        )
        keys += [(sample.rsplit("/", 2)[0], actor, number) for actor in boxes.actor_id[rows].tolist()]
        clear = np.stack([_contrast(each, as_given) for each in images], axis=1)
        spread = clear.std(axis=1, keepdims=True) + 1e-6
        more = _contrast(image, mirrored).mean() - clear[:, number] if len(mirrored) else np.zeros(len(clear))
        relative = (clear - clear.mean(axis=1, keepdims=True)) / spread
        found.append(np.column_stack([np.full(len(clear), number), more / spread[:, 0], relative]))
    return keys, np.concatenate(found)


def _rectangles(
    dataset: Dataset, sample: str, camera: int, boxes: Boxes, side: tuple[float, float, float]
) -> tuple[FloatArray, IntArray]:
    """(K, 4) middle and half size of boxes that the image should show, as shares of it, and their rows (K,)."""
    channel = CAMERAS[camera]
    camera_from_ego = dataset.world_from(sample, channel).inverse() @ dataset.world_from(sample, "ego")
    corners = camera_from_ego.apply((boxes.corners() * side).reshape(-1, 3)).reshape(-1, 8, 3)
    near = ((corners[..., 2] > _DEPTHS[0]) & (corners[..., 2] < _DEPTHS[1])).all(axis=1)
    lens = dataset.camera(sample, channel)
    pixels = lens.project(corners[near].reshape(-1, 3))[0].reshape(-1, 8, 2)
    low, high = pixels.min(axis=1), pixels.max(axis=1)
    whole = np.array([lens.width, lens.height])
    size = high - low
    shown = ((low + high > 0) & (low + high < 2 * whole) & (size >= _LEAST_PIXELS) & (size < whole * 0.8)).all(axis=1)
    return np.concatenate([low + high, high - low], axis=1)[shown] / 2 / np.tile(whole, 2), np.flatnonzero(near)[shown]


def _contrast(image: ByteArray, rectangles: FloatArray) -> FloatArray:
    """(K,) how far the mean colour in rectangles, as shares of an image, is from that around them."""
    import cv2

    whole = np.array(image.shape[1::-1])
    sums = cv2.integral(image).astype(np.float64)

    def total(scale: float) -> tuple[FloatArray, FloatArray]:
        middle, half = rectangles[:, :2] * whole, rectangles[:, 2:] * whole * scale
        (left, top), (right, bottom) = (
            np.rint(np.clip(corner, 0, whole)).astype(int).T for corner in (middle - half, middle + half)
        )
        summed = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        return summed, np.maximum((right - left) * (bottom - top), 1)[:, None]

    (inner, of_inner), (edge, of_edge), (outer, of_outer) = (total(scale) for scale in (0.7, 1.1, 1.8))
    return np.asarray(np.linalg.norm(inner / of_inner - (outer - edge) / np.maximum(of_outer - of_edge, 1), axis=1))
