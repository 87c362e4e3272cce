"""How near boxes are to one another, and how far off a match is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, as_floats
from deepaccident_devkit.evaluation.detection.boxes import BoxColumns
from deepaccident_devkit.evaluation.detection.protocols import DetectionProtocol
from deepaccident_devkit.geometry.footprints import intersection_areas

ERRORS: Final = ("ATE", "ASE", "AOE", "AVE")
"""Errors of translation (m), scale (1 − overlap), orientation (rad) and velocity (m/s), in the order of columns."""
RELEASED_TURN: Final = 2 * 3.1415926
"""The released code's full turn, radians."""


def costs(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> AnyArray:
    """How far each of D detections is from each of G true boxes by the protocol's measure: (D, G), the less the nearer.

    Distances in metres, of the boxes' own precision; overlaps negated, so that they too are the less the nearer.
    """
    return _MEASURES[protocol.measure](detections, truth, protocol)


def limit_of(threshold: float, protocol: DetectionProtocol) -> float:
    """The cost below which (or, where the protocol includes it, up to which) a threshold's pairs match."""
    return threshold if protocol.measure.startswith("distance") else -threshold


def match_errors(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> FloatArray:
    """The errors of M matches, `detections[i]` with `truth[i]`: (M, 4) in the order of `ERRORS`; NaN where unknown."""
    offset = as_floats(detections.center) - truth.center
    if protocol.error_of_bottoms:
        offset[:, 2] = as_floats(detections.bottom) - truth.bottom
        translation = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2 + offset[:, 2] ** 2)
    else:
        translation = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2)
    turn = _turn_between(as_floats(detections.yaw), as_floats(truth.yaw), protocol)
    speed = as_floats(truth.velocity) - detections.velocity
    speed_error = np.sqrt(speed[:, 0] ** 2 + speed[:, 1] ** 2)
    return np.column_stack([translation, 1 - _overlap_of_matches(detections, truth, protocol), turn, speed_error])


def _overlap_of_matches(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> FloatArray:
    if protocol.scale_by_overlap:
        return as_floats(_iou_3d(detections, truth, protocol).diagonal())
    mine, theirs = as_floats(detections.size), as_floats(truth.size)
    common = _product(np.minimum(mine, theirs))
    union = _product(mine) + _product(theirs) - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


def _turn_between(detected: FloatArray, true: FloatArray, protocol: DetectionProtocol) -> FloatArray:
    if not protocol.orientation_unwrapped:
        return as_floats(np.abs((true - detected + np.pi) % (2 * np.pi) - np.pi))
    true = true % RELEASED_TURN
    if protocol.single_precision:  # the released code writes this back into single precision, the detection's not
        true = as_floats(true.astype(np.float32))
    return np.abs(true - detected % RELEASED_TURN)


def _distance_of_bottoms(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> AnyArray:
    squares = _squares(truth.center[:, 0], detections.center[:, 0])
    squares += _squares(truth.center[:, 1], detections.center[:, 1])
    squares += _squares(truth.bottom, detections.bottom)
    result: AnyArray = np.sqrt(squares)
    return result


def _distance_bev(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> AnyArray:
    squares = _squares(truth.center[:, 0], detections.center[:, 0])
    squares += _squares(truth.center[:, 1], detections.center[:, 1])
    result: AnyArray = np.sqrt(squares)
    return result


def _squares(truth: AnyArray, detections: AnyArray) -> AnyArray:
    difference: AnyArray = truth - detections[:, None]
    difference *= difference
    return difference


def _iou_3d(detections: BoxColumns, truth: BoxColumns, protocol: DetectionProtocol) -> FloatArray:
    areas = intersection_areas(detections.footprint, truth.footprint)
    down = protocol.bottom_taken_as_top
    (low, high), (true_low, true_high) = _heights(detections, down=down), _heights(truth, down=down)
    shared = np.minimum(high[:, None], true_high) - np.maximum(low[:, None], true_low)
    return _over_union(areas * np.maximum(shared, 0), _product(detections.size), _product(truth.size))


def _iou_bev(detections: BoxColumns, truth: BoxColumns, _: DetectionProtocol) -> FloatArray:
    areas = intersection_areas(detections.footprint, truth.footprint)
    return _over_union(areas, _product(detections.size[:, :2]), _product(truth.size[:, :2]))


def _heights(boxes: BoxColumns, *, down: bool) -> tuple[FloatArray, FloatArray]:
    bottom, height = as_floats(boxes.bottom), as_floats(boxes.size[:, 2])
    return (bottom - height, bottom) if down else (bottom, bottom + height)


def _product(sizes: AnyArray) -> FloatArray:
    return as_floats(as_floats(sizes).prod(axis=1))


def _over_union(common: FloatArray, mine: FloatArray, theirs: FloatArray) -> FloatArray:
    union = mine[:, None] + theirs - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


_MEASURES: Final[Mapping[str, Callable[[BoxColumns, BoxColumns, DetectionProtocol], AnyArray]]] = {
    "distance_of_bottoms": _distance_of_bottoms,
    "distance_bev": _distance_bev,
    "iou_3d": lambda detections, truth, protocol: -_iou_3d(detections, truth, protocol),
    "iou_bev": lambda detections, truth, protocol: -_iou_bev(detections, truth, protocol),
}
