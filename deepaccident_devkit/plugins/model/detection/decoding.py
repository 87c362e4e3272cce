"""Decoding of the head's maps to boxes, with suppression of boxes of the same object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation import DetectedBoxes
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.geometry.box_arrays import intersection_areas
from deepaccident_devkit.plugins.model.detection.head import (
    CODE_CHANNELS,
    ClassSlots,
    DetectionConfig,
    TaskMaps,
)
from deepaccident_devkit.plugins.model.detection.targets import gather_cells
from deepaccident_devkit.plugins.model.warps import precise
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    check_least,
)
from deepaccident_devkit.support.text import settle_choices

Method = Literal["rotated", "circle"]
# Columns x, y, l, w, yaw of boxes x y z l w h yaw vx vy.
_FOOTPRINT_COLUMNS = [0, 1, 3, 4, 6]


@dataclass(frozen=True, slots=True, kw_only=True)
class NmsConfig:
    """Suppression within one task.

    Attributes:
        method: `rotated` compares footprints by intersection over union, `circle` the distances of
            centres.
        threshold: A worse box is suppressed if its IoU with a retained box is larger, or for
            `circle` if the distance of their centres in metres is at most this.
        scale: Factors of lengths and widths before `rotated` compares them: one number, or one a
            slot of the task.
        keep: Maximum number of boxes of a sample and task.
    """

    method: Method = "rotated"
    threshold: float = 0.2
    scale: tuple[float, ...] = (1.0,)
    keep: int = 83

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError or ChoiceError."""
        settle_choices(self, {"method": get_args(Method)})
        check_least(self, threshold=0, keep=1)
        if not self.scale or not min(self.scale) > 0:
            raise ConfigError(
                f"scale: expected one number above 0, or one a slot, found {self.scale!r}"
            )


RELEASED_NMS: tuple[NmsConfig, ...] = (
    NmsConfig(),
    NmsConfig(scale=(0.7, 0.7)),
    NmsConfig(scale=(0.4, 0.55)),
    NmsConfig(method="circle", threshold=1.0),
    NmsConfig(scale=(1.0, 1.0)),
    NmsConfig(scale=(4.5, 9.0), threshold=0.5),
)
"""The released settings, one a task.

They were chosen for nuScenes' classes. No golden numbers test the `rotated` ones, because the
released code only runs on CUDA.
"""


def suppress(
    boxes: AnyArray, scores: AnyArray, slots: AnyArray, config: NmsConfig | None = None
) -> IntArray:
    """Return the rows of the retained boxes, the best first.

    Boxes of equal scores are ordered by their values, so the result does not depend on their order.
    Slots do not protect each other: a truck suppresses a van of the same task, as in the release.

    Args:
        boxes: x y z l w h yaw vx vy in any common frame, metres and radians, shape (N, 9).
        scores: Scores, shape (N,).
        slots: Number of each box's class within the task, shape (N,).
        config: Rules; None for ours.
    """
    config = config or NmsConfig()
    order = np.lexsort((*np.asarray(boxes).T[::-1], slots, -np.asarray(scores)))
    best_first = np.asarray(boxes, dtype=np.float64)[order]
    if config.method == "circle":
        is_overlapping = _are_near(best_first[:, :2], config.threshold)
    else:
        footprints = best_first[:, _FOOTPRINT_COLUMNS]
        scale = np.array(config.scale)
        footprints[:, 2:4] *= scale if len(scale) == 1 else scale[slots[order], None]
        is_overlapping = rotated_iou(footprints, footprints) > config.threshold
    return order[_retained_rows(is_overlapping, config.keep)]


def rotated_iou(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the intersection over union of N and M rectangles on the ground, (N, M) in [0, 1].

    It is 0 for two rectangles without area.

    Args:
        first: x, y, length, width, yaw: metres and radians, shape (N, 5).
        second: Other rectangles in the same frame, shape (M, 5).
    """
    intersections = intersection_areas(first, second)
    areas, other_areas = first[:, 2] * first[:, 3], second[:, 2] * second[:, 3]
    unions = areas[:, None] + other_areas - intersections
    return np.divide(intersections, unions, out=np.zeros_like(intersections), where=unions > 0)


def _are_near(centers: FloatArray, radius: float) -> BoolArray:
    """Return whether the centres (N, 2) of two boxes are within a radius, (N, N)."""
    offsets = centers[:, None] - centers
    return np.asarray(np.einsum("nmi,nmi->nm", offsets, offsets) <= radius**2)


def _retained_rows(is_overlapping: BoolArray, max_count: int) -> IntArray:
    """Return the retained rows of boxes that are sorted by score, best first."""
    is_suppressed = np.zeros(len(is_overlapping), dtype=bool)
    rows: list[int] = []
    for row, overlaps in enumerate(is_overlapping):
        if not is_suppressed[row]:
            rows.append(row)
            if len(rows) == max_count:
                break
            is_suppressed |= overlaps
    return np.array(rows, dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class DecodingConfig:
    """Rules for reading boxes from the maps.

    Attributes:
        candidates: Number of cells with the best scores that are examined, for each sample and
            task.
        score_threshold: Scores must exceed it.
        center_range: Lowest x, y, z and highest x, y, z of the centres, metres, ego frame.
        nms: Suppression of each task, or one for all tasks.
    """

    candidates: int = 500
    score_threshold: float = 0.1
    center_range: tuple[float, float, float, float, float, float] = (
        -61.2,
        -61.2,
        -10.0,
        61.2,
        61.2,
        10.0,
    )
    nms: tuple[NmsConfig, ...] = (NmsConfig(),)

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        check_least(self, candidates=1)
        lows, highs = self.center_range[:3], self.center_range[3:]
        if not all(low < high for low, high in zip(lows, highs, strict=True)):
            raise ConfigError(
                f"center_range: expected least x, y, z, then greatest, found {self.center_range!r}"
            )
        if not self.nms:
            raise ConfigError("nms: expected one NmsConfig, or one a task, found none")


class Candidates(NamedTuple):
    """The K best cells of one task for each of B samples, the best first.

    Attributes:
        boxes: x y z l w h yaw vx vy, ego frame, z of the centre; metres, radians, m/s; shape (B, K,
            9).
        scores: Scores in (0, 1), shape (B, K).
        slots: Heatmap channel in the task, (B, K) int64.
        valid: Whether a cell is above the score threshold, in the range and finite, (B, K) bool.
    """

    boxes: Tensor
    scores: Tensor
    slots: Tensor
    valid: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detections:
    """The boxes of one sample, the best first.

    Attributes:
        boxes: x y z l w h yaw vx vy, ego frame, z of the centre; metres, radians, m/s; shape (N,
            9).
        scores: Scores in (0, 1), shape (N,).
        categories: Index into `taxonomy.CATEGORIES`, (N,) int64.
    """

    boxes: Tensor
    scores: Tensor
    categories: Tensor


def decode_candidates(
    maps: TaskMaps, head: DetectionConfig, config: DecodingConfig | None = None
) -> Candidates:
    """Return the best cells of a task as boxes, before suppression.

    It is the released CenterPointBBoxCoder.

    Args:
        maps: Maps of the task.
        head: Cells of the maps.
        config: Rules; None for the released ones.
    """
    config = config or DecodingConfig()
    rows, columns = maps.heatmap.shape[-2:]
    probabilities = precise(maps.heatmap).sigmoid().flatten(1)
    count = min(config.candidates, probabilities.shape[1])
    scores, best = probabilities.topk(count, dim=1)
    slots, cell = best // (rows * columns), best % (rows * columns)
    code = gather_cells(precise(maps.code), cell)
    offset, z, size, rotation, velocity = code.split(list(CODE_CHANNELS.values()), dim=2)
    position = torch.stack([cell % columns, cell // columns], dim=2) + offset
    cell_size = position.new_tensor([head.x[2], head.y[2]])
    center = position * cell_size + position.new_tensor([head.x[0], head.y[0]])
    yaw = torch.atan2(rotation[:, :, :1], rotation[:, :, 1:])
    boxes = torch.cat([center, z, size.exp(), yaw, velocity], dim=2)
    low, high = boxes.new_tensor(config.center_range).view(2, 3)
    in_range = ((boxes[:, :, :3] >= low) & (boxes[:, :, :3] <= high)).all(dim=2)
    is_finite = boxes.isfinite().all(dim=2)
    valid = (scores > config.score_threshold) & in_range & is_finite
    return Candidates(boxes, scores, slots, valid)


def decode_detections(
    maps: Sequence[TaskMaps], head: DetectionConfig, config: DecodingConfig | None = None
) -> list[Detections]:
    """Return the boxes of each of B samples, after suppression within each task.

    Boxes of slots without a category first suppress others of their task, and are then left out.

    Args:
        maps: Maps of each task, from the head.
        head: Cells and slots.
        config: Rules; None for ours; `nms=RELEASED_NMS` for the released suppression of the six
            released tasks.

    Raises:
        ConfigError: Another number of `nms` than tasks, or of its scales than slots.
    """
    config = config or DecodingConfig()
    suppressions = _nms_of_tasks(config.nms, head.class_slots)
    parts_of_samples: list[list[Detections]] = [[] for _ in range(len(maps[0].heatmap))]
    for task_maps, slots, nms in zip(maps, head.class_slots, suppressions, strict=True):
        candidates = decode_candidates(task_maps, head, config)
        for sample, parts in enumerate(parts_of_samples):
            sample_candidates = Candidates(*(tensor[sample] for tensor in candidates))
            parts.append(_retained_detections(sample_candidates, slots, nms))
    return [_joined(parts) for parts in parts_of_samples]


def detected_boxes(detections: Detections, world_from_ego: SE3 | ArrayLike) -> DetectedBoxes:
    """Return one sample's detections in the world frame, for the devkit's evaluators and results.

    Args:
        detections: Right-handed boxes; boxes of a model that works in left-handed axes must be
            mirrored first.
        world_from_ego: Pose of the sample's agent; (4, 4) if it is no SE3.

    Raises:
        GeometryError: The pose is no rigid transform.
    """
    pose = world_from_ego if isinstance(world_from_ego, SE3) else SE3(world_from_ego)  # type: ignore[arg-type]
    boxes = detections.boxes.detach().cpu().double().numpy()
    ego_boxes = DetectedBoxes.from_arrays(
        boxes[:, :3],
        boxes[:, 3:6],
        boxes[:, 6],
        detections.scores.detach().cpu().double().numpy(),
        category=detections.categories.cpu().numpy(),
        velocity=boxes[:, 7:],
        frame="ego",
    )
    return ego_boxes.transform(pose, "world")


def _nms_of_tasks(nms: tuple[NmsConfig, ...], class_slots: ClassSlots) -> tuple[NmsConfig, ...]:
    """Return the suppression of each task; raises ConfigError if numbers do not fit."""
    configs = nms * len(class_slots) if len(nms) == 1 else nms
    if len(configs) != len(class_slots):
        raise ConfigError(
            f"nms: expected one NmsConfig, or {len(class_slots)}, one a task; found {len(nms)}"
        )
    for task, (config, slots) in enumerate(zip(configs, class_slots, strict=True)):
        if len(config.scale) not in (1, len(slots)):
            raise ConfigError(
                f"nms: task {task} has {len(slots)} slots, found {len(config.scale)} scales; give "
                "one, or one a slot"
            )
    return configs


def _retained_detections(
    candidates: Candidates, slots: tuple[int | None, ...], nms: NmsConfig
) -> Detections:
    """Return the retained boxes of one sample's candidates of one task."""
    valid = candidates.valid
    boxes, scores, slot = candidates.boxes[valid], candidates.scores[valid], candidates.slots[valid]
    box_array, score_array, slot_array = (
        tensor.detach().cpu().numpy() for tensor in (boxes, scores, slot)
    )
    rows = torch.from_numpy(suppress(box_array, score_array, slot_array, nms)).to(boxes.device)
    category_numbers = [-1 if number is None else number for number in slots]
    categories = torch.tensor(category_numbers, device=boxes.device)
    rows = rows[categories[slot[rows]] >= 0]
    return Detections(boxes=boxes[rows], scores=scores[rows], categories=categories[slot[rows]])


def _joined(parts: Sequence[Detections]) -> Detections:
    """Return the boxes of all tasks, the best first."""
    boxes = torch.cat([part.boxes for part in parts])
    scores = torch.cat([part.scores for part in parts])
    categories = torch.cat([part.categories for part in parts])
    order = scores.argsort(descending=True, stable=True)
    return Detections(boxes=boxes[order], scores=scores[order], categories=categories[order])
