"""Non-maximum suppression: of boxes that stand for the same object, the best stays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry.footprints import intersection_areas
from deepaccident_devkit.text import settle_choices

Method = Literal["rotated", "circle"]
_FOOTPRINT = [0, 1, 3, 4, 6]
"""Columns x, y, l, w, yaw of boxes x y z l w h yaw vx vy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NmsConfig:
    """Suppression within one task.

    Attributes:
        method: `rotated` compares footprints by intersection over union, `circle` the distances of centres.
        threshold: a worse box goes if its IoU with a kept one is above it or, of `circle`, if its centre is at most so
            many metres away.
        scale: lengths and widths are multiplied by it before `rotated` compares them: one number, or one a slot of the
            task.
        keep: boxes of a sample and task that stay at most.
    """

    method: Method = "rotated"
    threshold: float = 0.2
    scale: tuple[float, ...] = (1.0,)
    keep: int = 83

    def __post_init__(self) -> None:
        """Check; raises ConfigError or ChoiceError."""
        settle_choices(self, {"method": get_args(Method)})
        if not self.threshold >= 0:
            raise ConfigError(f"threshold: expected a number from 0, found {self.threshold!r}")
        if not self.scale or not min(self.scale) > 0:
            raise ConfigError(f"scale: expected one number above 0, or one a slot, found {self.scale!r}")
        if self.keep < 1:
            raise ConfigError(f"keep: expected a whole number from 1, found {self.keep!r}")


RELEASED_NMS: tuple[NmsConfig, ...] = (
    NmsConfig(),
    NmsConfig(scale=(0.7, 0.7)),
    NmsConfig(scale=(0.4, 0.55)),
    NmsConfig(method="circle", threshold=1.0),
    NmsConfig(scale=(1.0, 1.0)),
    NmsConfig(scale=(4.5, 9.0), threshold=0.5),
)
"""The released settings, one a task.

They were chosen for nuScenes' classes. No golden numbers test the `rotated` ones: the released code runs on CUDA alone.
"""


def suppress(boxes: AnyArray, scores: AnyArray, slots: AnyArray, config: NmsConfig | None = None) -> IntArray:
    """Rows of the boxes that stay, the best first; of equal scores by what is in the boxes, whatever their order.

    Slots do not protect each other: a truck suppresses a van of the same task, as in the release.

    Args:
        boxes: (N, 9) x y z l w h yaw vx vy; any one frame, metres and radians.
        scores: (N,).
        slots: (N,) number of each box's class within the task.
        config: None for ours.
    """
    rules = config or NmsConfig()
    order = np.lexsort((*np.asarray(boxes).T[::-1], slots, -np.asarray(scores)))
    best_first = np.asarray(boxes, dtype=np.float64)[order]
    if rules.method == "circle":
        same = _near(best_first[:, :2], rules.threshold)
    else:
        footprints = best_first[:, _FOOTPRINT]
        scale = np.array(rules.scale)
        footprints[:, 2:4] *= scale if len(scale) == 1 else scale[slots[order], None]
        same = rotated_iou(footprints, footprints) > rules.threshold
    return order[_greedy(same, rules.keep)]


def rotated_iou(first: FloatArray, second: FloatArray) -> FloatArray:
    """Intersection over union of rectangles on the ground: (N, 5) and (M, 5) → (N, M) in [0, 1].

    Args:
        first: x, y, length, width, yaw: metres and radians.
        second: the others, of the same frame.

    Returns:
        0 for two that have no area.
    """
    common = intersection_areas(first, second)
    union = (first[:, 2] * first[:, 3])[:, None] + second[:, 2] * second[:, 3] - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


def _near(centers: FloatArray, radius: float) -> BoolArray:
    apart = centers[:, None] - centers
    near: BoolArray = np.einsum("nmi,nmi->nm", apart, apart) <= radius**2
    return near


def _greedy(same: BoolArray, keep: int) -> IntArray:
    """Rows kept, of boxes that are sorted by score, best first."""
    gone = np.zeros(len(same), dtype=bool)
    kept: list[int] = []
    for row, others in enumerate(same):
        if not gone[row]:
            kept.append(row)
            if len(kept) == keep:
                break
            gone |= others
    return np.array(kept, dtype=np.int64)
