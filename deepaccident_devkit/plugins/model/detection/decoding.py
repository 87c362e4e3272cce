"""Decoding of the head's maps into boxes, and suppression of duplicate boxes."""

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
    check_minima,
)
from deepaccident_devkit.support.text import counted, settle_choices

Method = Literal["rotated", "circle"]
# Columns x, y, l, w, yaw of boxes x y z l w h yaw vx vy.
_FOOTPRINT_COLUMNS = [0, 1, 3, 4, 6]


@dataclass(frozen=True, slots=True, kw_only=True)
class NmsConfig:
    """Rules for non-maximum suppression within one task.

    Attributes:
        method: `rotated` compares footprints by intersection over union, `circle` the distances of
            centres.
        threshold: A worse box is suppressed if its IoU with a retained box is larger, or for
            `circle` if the distance of their centres in metres is at most this.
        scale: Factors of lengths and widths before `rotated` compares them: one number, or one for
            each slot of the task.
        keep: Maximum number of boxes per sample and task.
    """

    method: Method = "rotated"
    threshold: float = 0.2
    scale: tuple[float, ...] = (1.0,)
    keep: int = 83

    def __post_init__(self) -> None:
        """Check the values; raise ConfigError or ChoiceError if one is not valid."""
        settle_choices(self, {"method": get_args(Method)})
        check_minima(self, threshold=0, keep=1)
        if not self.scale or not min(self.scale) > 0:
            raise ConfigError(
                f"scale: expected one number above 0, or one per slot, found {self.scale!r}"
            )


RELEASED_NMS: tuple[NmsConfig, ...] = (
    NmsConfig(),
    NmsConfig(scale=(0.7, 0.7)),
    NmsConfig(scale=(0.4, 0.55)),
    NmsConfig(method="circle", threshold=1.0),
    NmsConfig(scale=(1.0, 1.0)),
    NmsConfig(scale=(4.5, 9.0), threshold=0.5),
)
"""The released settings, one for each task.

They were chosen for nuScenes' classes. The `rotated` settings are not tested against golden
numbers, because the released code runs only on CUDA.
"""


def suppress(
    boxes: AnyArray, scores: AnyArray, slots: AnyArray, config: NmsConfig | None = None
) -> IntArray:
    """Return the rows of the retained boxes, highest-scoring first.

    Boxes of equal scores are ordered by their values, so the result does not depend on their order.
    Suppression ignores slots: a truck suppresses a van of the same task, as in the release.

    Args:
        boxes: x y z l w h yaw vx vy in any common frame, metres and radians, shape (N, 9).
        scores: Scores, shape (N,).
        slots: Number of each box's class within the task, shape (N,).
        config: Rules; None for ours.
    """
    config = config or NmsConfig()
    order = np.lexsort((*boxes.T[::-1], slots, -scores))
    best_first = np.asarray(boxes, dtype=np.float64)[order]
    if config.method == "circle":
        is_overlapping = _are_near(best_first[:, :2], config.threshold)
    else:
        footprints = best_first[:, _FOOTPRINT_COLUMNS]
        scale = np.array(config.scale)
        if len(scale) > 1:
            scale = scale[slots[order], None]
        footprints[:, 2:4] *= scale
        is_overlapping = rotated_iou(footprints, footprints) > config.threshold
    rows = _suppress_rows(is_overlapping, config.keep)
    return order[rows]


def rotated_iou(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the intersection over union of N and M rectangles on the ground, (N, M) in [0, 1].

    The result is 0 for two rectangles without area.

    Args:
        first: x, y, length, width, yaw: metres and radians, shape (N, 5).
        second: Other rectangles in the same frame, shape (M, 5).
    """
    intersections = intersection_areas(first, second)
    areas = first[:, 2] * first[:, 3]
    other_areas = second[:, 2] * second[:, 3]
    unions = areas[:, None] + other_areas - intersections
    ratios = np.zeros_like(intersections)
    return np.divide(intersections, unions, out=ratios, where=unions > 0)


def _are_near(centers: FloatArray, radius: float) -> BoolArray:
    """Return whether the centres (N, 2) of each pair of boxes are within a radius, (N, N)."""
    offsets = centers[:, None] - centers
    squared_distances = np.einsum("nmi,nmi->nm", offsets, offsets)
    return np.asarray(squared_distances <= radius**2)


def _suppress_rows(is_overlapping: BoolArray, max_count: int) -> IntArray:
    """Return the retained rows of boxes that are sorted by score, best first."""
    is_suppressed = np.zeros(len(is_overlapping), dtype=bool)
    rows: list[int] = []
    for row, overlaps in enumerate(is_overlapping):
        if len(rows) == max_count:
            break
        if not is_suppressed[row]:
            rows.append(row)
            is_suppressed |= overlaps
    return np.array(rows, dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True)
class DecodingConfig:
    """Rules for reading boxes from the maps.

    Attributes:
        candidates: Number of highest-scoring cells that are examined for each sample and task.
        score_threshold: Score that a box must exceed.
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
        """Check the values; raise ConfigError if one is not valid."""
        check_minima(self, candidates=1)
        lows = self.center_range[:3]
        highs = self.center_range[3:]
        if not all(low < high for low, high in zip(lows, highs, strict=True)):
            raise ConfigError(
                "center_range: expected the lowest x, y, z, then the highest, found "
                f"{self.center_range!r}"
            )
        if not self.nms:
            raise ConfigError("nms: expected one NmsConfig, or one per task, found none")


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

    This is the released CenterPointBBoxCoder.

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
    slots = best // (rows * columns)
    cell = best % (rows * columns)
    code = gather_cells(precise(maps.code), cell)
    offset, z, size, rotation, velocity = code.split(list(CODE_CHANNELS.values()), dim=2)
    lower_corner = torch.stack([cell % columns, cell // columns], dim=2)
    origin, _, cell_size = offset.new_tensor([head.x, head.y]).T
    center_xy = (lower_corner + offset) * cell_size + origin
    sine, cosine = rotation.split(1, dim=2)
    yaw = torch.atan2(sine, cosine)
    boxes = torch.cat([center_xy, z, size.exp(), yaw, velocity], dim=2)
    low, high = boxes.new_tensor(config.center_range).view(2, 3)
    centers = boxes[:, :, :3]
    in_range = ((centers >= low) & (centers <= high)).all(dim=2)
    is_finite = boxes.isfinite().all(dim=2)
    valid = (scores > config.score_threshold) & in_range & is_finite
    return Candidates(boxes, scores, slots, valid)


def decode_detections(
    maps: Sequence[TaskMaps], head: DetectionConfig, config: DecodingConfig | None = None
) -> list[Detections]:
    """Return the boxes of each of B samples, after suppression within each task.

    Boxes of slots without a category suppress others of their task before they are left out.

    Args:
        maps: Maps of each task, from the head.
        head: Cells and slots.
        config: Rules; None for ours; `nms=RELEASED_NMS` for the released suppression of the six
            released tasks.

    Raises:
        ConfigError: `nms` has neither one entry nor one per task, or a scale does not match the
            task's slots.
    """
    config = config or DecodingConfig()
    task_nms = _assign_nms(config.nms, head.class_slots)
    detections_by_sample: list[list[Detections]] = [[] for _ in maps[0].heatmap]
    for task_maps, slots, nms in zip(maps, head.class_slots, task_nms, strict=True):
        candidates = decode_candidates(task_maps, head, config)
        sample_tensors = zip(*candidates, strict=True)
        for tensors, detections in zip(sample_tensors, detections_by_sample, strict=True):
            detections.append(_suppress_candidates(Candidates(*tensors), slots, nms))
    return [_join_detections(detections) for detections in detections_by_sample]


def detected_boxes(detections: Detections, world_from_ego: SE3 | ArrayLike) -> DetectedBoxes:
    """Return one sample's detections in the world frame, for the devkit's evaluators and results.

    Args:
        detections: Right-handed boxes; boxes of a model that works in left-handed axes must be
            mirrored first.
        world_from_ego: Pose of the sample's agent, an SE3 or a matrix (4, 4).

    Raises:
        GeometryError: The pose is not a rigid transform.
    """
    if not isinstance(world_from_ego, SE3):
        world_from_ego = SE3(world_from_ego)  # type: ignore[arg-type]
    boxes = detections.boxes.detach().cpu().double().numpy()
    scores = detections.scores.detach().cpu().double().numpy()
    ego_boxes = DetectedBoxes.from_arrays(
        boxes[:, :3],
        boxes[:, 3:6],
        boxes[:, 6],
        scores,
        category=detections.categories.cpu().numpy(),
        velocity=boxes[:, 7:],
        frame="ego",
    )
    return ego_boxes.transform(world_from_ego, "world")


def _assign_nms(nms: tuple[NmsConfig, ...], class_slots: ClassSlots) -> tuple[NmsConfig, ...]:
    """Return each task's suppression rules; raise ConfigError if their number does not fit."""
    configs = nms
    if len(nms) == 1:
        configs = nms * len(class_slots)
    if len(configs) != len(class_slots):
        raise ConfigError(
            f"nms: expected one NmsConfig, or {len(class_slots)} (one per task), found {len(nms)}"
        )
    for task, (config, slots) in enumerate(zip(configs, class_slots, strict=True)):
        if len(config.scale) not in (1, len(slots)):
            raise ConfigError(
                f"nms: task {task} has {counted(len(slots), 'slot')}, but "
                f"{counted(len(config.scale), 'scale')}; give one scale, or one per slot"
            )
    return configs


def _suppress_candidates(
    candidates: Candidates, slots: tuple[int | None, ...], nms: NmsConfig
) -> Detections:
    """Return the retained boxes of one sample's candidates of one task."""
    valid = candidates.valid
    boxes = candidates.boxes[valid]
    scores = candidates.scores[valid]
    slot = candidates.slots[valid]
    box_array = boxes.detach().cpu().numpy()
    score_array = scores.detach().cpu().numpy()
    slot_array = slot.cpu().numpy()
    retained_rows = suppress(box_array, score_array, slot_array, nms)
    rows = torch.from_numpy(retained_rows).to(boxes.device)
    slot_categories = []
    for category in slots:
        slot_categories.append(-1 if category is None else category)
    category_by_slot = torch.tensor(slot_categories, device=boxes.device)
    categories = category_by_slot[slot[rows]]
    has_category = categories >= 0
    rows = rows[has_category]
    return Detections(boxes=boxes[rows], scores=scores[rows], categories=categories[has_category])


def _join_detections(task_detections: Sequence[Detections]) -> Detections:
    """Return the boxes of all tasks, the best first."""
    boxes = torch.cat([detections.boxes for detections in task_detections])
    scores = torch.cat([detections.scores for detections in task_detections])
    categories = torch.cat([detections.categories for detections in task_detections])
    order = scores.argsort(descending=True, stable=True)
    return Detections(boxes=boxes[order], scores=scores[order], categories=categories[order])
