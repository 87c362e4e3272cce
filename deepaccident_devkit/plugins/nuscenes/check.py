"""Whether a source's axes, ground and cameras are those that the devkit means, by what its data show.

Four things agree in a good source: the ego moves along its x, the road lies at its origin, points lie on boxes, and
boxes stand out in the images of their own cameras. The usual mistakes are tried too, so that the message names the one
that was made. Sides are told by points alone, and nothing is believed within its own error: a good source passes.
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

_SAMPLES: Final = 48
# Probability with which a test may find a fault by chance.
_CHANCE: Final = 1e-5
_ORDERS: Final = math.factorial(len(CAMERAS))
# Samples, steps or boxes from which on something can be decided.
_LEAST_VALUES: Final = 8
# Metres from one sample to the next, from which on it is known where the ego goes.
_STEP: Final = 0.5
# Degrees from x, beyond which x is not forward.
_ASIDE: Final = 45.0
# Share of the steps that may lead aside: cars reverse, too.
_MOST_ASIDE: Final = 0.75
# Metres that the road may lie above or below the ego's origin.
_OFF: Final = 0.6
# Metres above the ego's origin, below which the LiDAR is there.
_AT_ORIGIN: Final = 0.05
# Metres from the ego, between which the road is looked for.
_AROUND: Final = (3.0, 15.0)
_LEAST_POINTS: Final = 5
_LEAST_SHARE: Final = 0.5
_DEPTHS: Final = (1.0, 40.0)
# Half of a box's width and height, as a share of the image's.
_LEAST_HALF, _MOST_HALF = 0.01, 0.4
# Height and width of images from which on boxes are seen well enough.
_LEAST_SIZE: Final = (90, 160)
# Degrees, of `taxonomy.CAMERAS`: of both rigs.
_LOOKS: Final = np.array([0.0, 55.0, -55.0, 180.0, 110.0, -110.0])
# Boxes as they are, and with y mirrored.
_SIDES: Final = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceCheck(ShortRepr):
    """What S samples of a source show; NaN where nothing tells.

    Attributes:
        turns: (P,) degrees by which the ego moves to the left of its x axis, from sample to sample.
        road: (S,) heights of the road above the ego's origin, metres.
        boxes: (S,) heights at which boxes near the ego stand.
        lidar: height of the LiDAR.
        looks: (6,) degrees to the left of x to which each camera looks.
        held: (B, 2) of boxes that should hold points, the share of those with some: 0 or 1, as they are and mirrored.
        contrasts: (S, 6, 6) how much boxes stand out where a camera (row) should show them, in the image of a camera
            (column): the mean logarithm.
    """

    turns: FloatArray
    road: FloatArray
    boxes: FloatArray
    lidar: float
    looks: FloatArray
    held: FloatArray
    contrasts: FloatArray

    def faults(self) -> Iterator[str]:
        """What is wrong, a sentence each."""
        way = float(np.degrees(np.angle(np.exp(1j * np.radians(self.turns)).sum())))
        turned = _is_above((np.abs(self.turns) > _ASIDE) - _MOST_ASIDE)
        road, floor = _mean(self.road), _mean(self.boxes)
        heights = (self.road, self.boxes - np.nan_to_num(road))
        sunk = [
            -_mean(height)
            for height in heights
            if _is_above(height * np.sign(_mean(height)) - _OFF)
        ]
        where = f"the road lies at {road:.1f} m, boxes stand at {floor:.1f} m"
        side = self._side_fault()
        if self.lidar < _AT_ORIGIN and (turned or sunk):
            yield f"the LiDAR's frame stands for the ego's: {where}, and it moves {way:.0f} degrees off x"
        elif turned:
            yield f"x is not forward: the ego moves {way:.0f} degrees to the left of it"
        elif sunk:
            yield f"sunk by {sunk[0]:.1f} m: {where}"
        elif side:
            yield side
        swapped = [*self._shown_elsewhere(), *self._turned_away(way if turned else 0)]
        if swapped and not (sunk or side):
            yield f"the cameras are in another order: {', '.join(swapped)}"

    def unchecked(self) -> Iterator[str]:
        """What these samples cannot tell, a clause each."""
        if len(self.turns) < _LEAST_VALUES:
            yield "whether x is forward, since the ego hardly moves"
        if np.isfinite([self.road, self.boxes]).sum(axis=1).max() < _LEAST_VALUES:
            yield "how high the road lies, since there are few points and few boxes"
        if len(self.held) < _LEAST_VALUES:
            yield "whether y is to the left, since few boxes should hold points"
        clearer = self._clearer()
        unclear = [
            name for code, name in enumerate(CAMERAS) if not _is_above(clearer[:, code, code])
        ]
        if unclear:
            yield f"whether the images are those of {', '.join(unclear)}, since boxes hardly stand out in them"

    def _side_fault(self) -> str:
        """How boxes lie beside what points show; empty if they do not."""
        given, mirrored = self.held.T
        shares = f"points lie in {_mean(given):.0%} of the boxes, in {_mean(mirrored):.0%} of them mirrored"
        if not _is_above(_LEAST_SHARE - given):
            return ""
        return (
            f"y is mirrored: {shares}"
            if _is_above(mirrored - given)
            else f"boxes are in other places: {shares}"
        )

    def _clearer(self) -> FloatArray:
        """(S, 6, 6) the contrasts of boxes beside those of the same boxes, and of the same image."""
        beside = self.contrasts - _mean(self.contrasts, axis=2)
        return np.asarray(beside - _mean(beside, axis=1))

    def _shown_elsewhere(self) -> list[str]:
        from scipy.optimize import linear_sum_assignment

        clearer = self._clearer()
        summed = np.nan_to_num(_mean(clearer, axis=0)[0]) + 1e-9 * np.eye(len(CAMERAS))
        cameras, images = linear_sum_assignment(summed, maximize=True)
        moved = np.flatnonzero(cameras != images)
        others = clearer[:, moved, images[moved]]
        if not (_is_above(others, tests=_ORDERS) and _is_above(others - clearer[:, moved, moved])):
            return []
        return [f"{CAMERAS[images[at]]} shows what {CAMERAS[at]} should" for at in moved.tolist()]

    def _turned_away(self, turn: float) -> list[str]:
        nearest = (
            np.abs((self.looks[:, None] - turn - _LOOKS + 180) % 360 - 180).argmin(axis=1).tolist()
        )
        return [
            f"{CAMERAS[at]} looks where {CAMERAS[to]} should"
            for at, to in enumerate(nearest)
            if at != to
        ]


def _mean(values: FloatArray, axis: int | None = None) -> Any:
    """The mean of those that are known, NaN of none; along an axis, which stays."""
    return np.ma.filled(
        np.ma.masked_invalid(values).mean(axis=axis, keepdims=axis is not None), np.nan
    )


def _is_above(values: AnyArray, tests: int = 1) -> bool:
    """Whether the mean of many values is above 0, and not by chance in any of as many tests (Student's t)."""
    from scipy.special import stdtr

    known = values[np.isfinite(values)]
    if len(known) < _LEAST_VALUES:
        return False
    error = known.std(ddof=1) / len(known) ** 0.5 + 1e-9
    return bool(stdtr(len(known) - 1, -known.mean() / error) * tests < _CHANCE)


def check_source(dataset: Dataset) -> SourceCheck:
    """Look at some of the labelled samples of the first vehicle; `look_at` finds the same and raises no SourceError.

    What these samples cannot tell is logged as a warning.

    Raises:
        SourceError: something is turned, mirrored, sunk or mixed up; the message says what.
        NotAvailableError: no sample has labels.
        DeepAccidentError: as of `Dataset`, for a file that cannot be read.
    """
    found = look_at(dataset)
    if faults := list(found.faults()):
        raise SourceError(
            f"{dataset.dataroot}: {'; '.join(faults)}; mend it first: a model would learn it"
        )
    if unchecked := list(found.unchecked()):
        logger.warning("%s: could not be checked: %s", dataset.dataroot, "; ".join(unchecked))
    return found


def look_at(dataset: Dataset) -> SourceCheck:
    """What some of the labelled samples of the first vehicle show; raises as `check_source`, but no SourceError."""
    samples = [dataset.sample[row]["token"] for row in labelled_rows(dataset).tolist()]
    with_clouds = [sample for sample in samples if dataset.sensor_path(sample, LIDAR).exists()]
    chosen = spread(with_clouds or samples, _SAMPLES)
    boxes = [dataset.with_ignored.boxes(sample, "ego") for sample in chosen]
    boxes = [
        each.select((each.num_lidar_pts >= _LEAST_POINTS) & (each.actor_id != OWN_ACTOR_ID))
        for each in boxes
    ]
    clouds = [dataset.load_point_cloud(sample, "ego").xyz for sample in chosen if with_clouds]
    held = [
        np.column_stack([each.count_points(points * side) > 0 for side in _SIDES])
        for points, each in zip(clouds, boxes, strict=False)  # without any cloud none
    ]
    turns = np.array([_turn(dataset, *pair) for pair in pairwise(samples)])
    return SourceCheck(
        turns=turns[np.isfinite(turns)],
        road=np.array([road_height(points) for points in clouds] or [np.nan] * len(chosen)),
        boxes=np.array([_floor(each) for each in boxes]),
        lidar=float(
            np.median([dataset.ego_from(sample, LIDAR).translation[2] for sample in chosen])
        ),
        looks=np.array([looks_to(dataset.ego_from(chosen[0], camera)) for camera in CAMERAS]),
        held=np.concatenate([np.zeros((0, 2)), *held]),
        contrasts=np.stack(
            [_contrasts(dataset, *each) for each in zip(chosen, boxes, strict=True)]
        ),
    )


def labelled_rows(dataset: Dataset) -> IntArray:
    """The rows of the labelled samples of the first vehicle; raises NotAvailableError if it has none."""
    view = dataset.columns("sample")
    rows = np.flatnonzero(view["labelled"][:] & (view["agent"] == AGENTS.index(VEHICLE_AGENTS[0])))
    if not len(rows):
        raise NotAvailableError(
            f"{dataset.dataroot}: {VEHICLE_AGENTS[0]} has no labels, so that there is nothing to see"
        )
    return rows


def spread(samples: Sequence[str], most: int) -> list[str]:
    """So many of them, evenly from the first to the last."""
    return [
        samples[place]
        for place in np.unique(
            np.linspace(0, len(samples) - 1, min(most, len(samples))).astype(int)
        )
    ]


def _turn(dataset: Dataset, sample: str, following: str) -> float:
    """Degrees from the ego's x to where it is at the next sample; NaN if that is near, or of another recording."""
    if sample.rsplit("/", 1)[0] != following.rsplit("/", 1)[0]:
        return np.nan
    x, y, _ = (
        dataset.world_from(sample, "ego").inverse() @ dataset.world_from(following, "ego")
    ).translation
    return float(np.degrees(np.arctan2(y, x))) if np.hypot(x, y) > _STEP else np.nan


def looks_to(ego_from_camera: SE3) -> float:
    """Degrees to the left of x."""
    return float(np.degrees(np.arctan2(*ego_from_camera.rotation[1::-1, 2])))


def road_height(points: FloatArray) -> float:
    """The height at which most points around the ego lie; NaN without points."""
    nearest, farthest = _AROUND
    distance, height = np.hypot(*points[:, :2].T), points[:, 2]
    z = height[(distance > nearest) & (distance < farthest) & (np.abs(height) < nearest)]
    counts, edges = np.histogram(z, np.arange(-nearest, nearest, 0.1))
    return float(edges[counts.argmax()] + 0.05) if len(z) else np.nan


def _floor(boxes: Boxes) -> float:
    """The height at which boxes around the ego stand, the median; NaN without any."""
    near = boxes.select(np.hypot(*boxes.center[:, :2].T) < 2 * _AROUND[1])
    return float(np.median(near.center[:, 2] - near.size[:, 2] / 2)) if len(near) else np.nan


def _contrasts(dataset: Dataset, sample: str, boxes: Boxes) -> FloatArray:
    """Return those of a sample (6, 6), as `SourceCheck` has them."""
    contrasts = np.full((len(CAMERAS), len(CAMERAS)), np.nan)
    if all(dataset.sensor_path(sample, camera).exists() for camera in CAMERAS):
        images = [dataset.load_image(sample, camera, min_size=_LEAST_SIZE) for camera in CAMERAS]
        for row, camera in zip(contrasts, CAMERAS, strict=True):
            shown = _rectangles(dataset, sample, camera, boxes)
            if len(shown):
                row[:] = [
                    np.log1p([_contrast(image, *each) for each in shown]).mean() for image in images
                ]
    return contrasts


def _rectangles(dataset: Dataset, sample: str, camera: str, boxes: Boxes) -> FloatArray:
    """Return middle and half size (K, 2, 2), as shares of the image, of the boxes that it should show."""
    camera_from_ego = dataset.world_from(sample, camera).inverse() @ dataset.world_from(
        sample, "ego"
    )
    corners = boxes.transform(camera_from_ego, camera).corners()
    near = ((corners[..., 2] > _DEPTHS[0]) & (corners[..., 2] < _DEPTHS[1])).all(axis=1)
    lens = dataset.camera(sample, camera)
    pixels = lens.project(corners[near].reshape(-1, 3))[0].reshape(-1, 8, 2) / (
        lens.width,
        lens.height,
    )
    middle, half = (pixels.max(axis=1) + pixels.min(axis=1)) / 2, np.ptp(pixels, axis=1) / 2
    shown = (middle > 0) & (middle < 1) & (half > _LEAST_HALF) & (half < _MOST_HALF)
    return np.asarray(np.stack([middle, half], axis=1)[shown.all(axis=1)])


def _contrast(image: ByteArray, middle: FloatArray, half: FloatArray) -> float:
    """How far the mean colour in a rectangle, of shares of an image, is from that in and around it."""
    whole = np.array(image.shape[1::-1])

    def mean(scale: float) -> FloatArray:
        left, top = np.maximum((middle - half * scale) * whole, 0).astype(int)
        right, bottom = np.ceil((middle + half * scale) * whole).astype(int)
        return np.asarray(image[top:bottom, left:right].mean(axis=(0, 1)))

    return float(np.linalg.norm(mean(0.7) - mean(1.8)))
