"""Facts of detected boxes that show without the truth: twins that nobody suppressed, and boxes that do not stand."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.detection.boxes import columns_of
from deepaccident_devkit.geometry import Boxes

_FEWEST: Final = 10
"""Boxes from which on their shares tell."""
_SUREST: Final = 500
"""Boxes of a sample that are looked at."""
_TWIN: Final = 0.25
"""Metres on the ground between the centres of twins, at most."""
_ALIKE: Final = 0.2
"""The largest difference of twins' lengths, widths and heights, as a share of the larger one."""
_TWINS: Final = 0.2
"""Share of the boxes that have a twin from which on non-maximum suppression is missing."""
_UPRIGHT: Final = 0.5
"""The least z of the up axis of a box that stands, with a slope of 60 degrees."""
_TILTED: Final = 0.2
"""Share of the boxes that do not stand from which on their quaternions are wrong."""


def box_counts(found: DetectedBoxes) -> list[int]:
    """Of a sample's surest boxes, in the world: how many there are, have a twin, and do not stand."""
    boxes = found.boxes.select(columns_of(found.boxes, found.scores).surest_first[:_SUREST])
    return [len(boxes), int(np.count_nonzero(_has_twin(boxes))), int(np.count_nonzero(~_stands(boxes)))]


def box_warnings(facts: Collection[Mapping[str, Any]]) -> list[str]:
    """Sentences on many twins and many boxes that do not stand.

    Args:
        facts: of each sample, with `boxes` as `box_counts` gives it, if it has boxes.
    """
    number, twins, tilted = (sum(each["boxes"][index] for each in facts if "boxes" in each) for index in range(3))
    warnings = []
    if number >= _FEWEST and twins >= _TWINS * number:
        warnings.append(
            f"{twins} of {number} boxes have a twin, a box of the same class and size at the same place (centres "
            f"within {_TWIN:g} m): apply non-maximum suppression"
        )
    if number >= _FEWEST and tilted >= _TILTED * number:
        warnings.append(
            f"{tilted} of {number} boxes lie on their side or upside down: rotation is a quaternion w, x, y, z, in "
            "this order; scipy's are x, y, z, w"
        )
    return warnings


def _has_twin(boxes: Boxes) -> BoolArray:
    """(N,) whether a box has another one of its class nearly at its place, of nearly its size."""
    first, second = np.triu_indices(len(boxes), 1)
    apart = boxes.center[first, :2] - boxes.center[second, :2]
    near = (np.abs(apart) <= _TWIN).all(axis=1) & (boxes.category[first] == boxes.category[second])
    first, second, apart = first[near], second[near], apart[near]
    sizes = boxes.size[first], boxes.size[second]
    alike = (np.abs(sizes[0] - sizes[1]) <= _ALIKE * np.maximum(*sizes)).all(axis=1)
    alike &= np.hypot(*apart.T) <= _TWIN
    twins = np.zeros(len(boxes), dtype=bool)
    twins[first[alike]] = twins[second[alike]] = True
    return twins


def _stands(boxes: Boxes) -> BoolArray:
    """(N,) whether a box's up axis points up rather than aside or down."""
    _, x, y, _ = boxes.rotation.T
    return np.asarray(1 - 2 * (x**2 + y**2) >= _UPRIGHT)
