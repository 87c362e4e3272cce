"""From the head's maps to boxes, of which those that stand for the same object are suppressed."""

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
_FOOTPRINT = [0, 1, 3, 4, 6]


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

They were chosen for nuScenes' classes. No golden numbers test the `rotated` ones: the released code runs on CUDA alone.
"""


def suppress(
    boxes: AnyArray, scores: AnyArray, slots: AnyArray, config: NmsConfig | None = None
) -> IntArray:
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
    return np.asarray(np.einsum("nmi,nmi->nm", apart, apart) <= radius**2)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class DecodingConfig:
    """Which boxes are read from the maps.

    Attributes:
        candidates: cells with the best scores that are looked at, for each sample and task.
        score_threshold: scores must be above it.
        center_range: least x, y, z and greatest x, y, z of the centres, metres, ego frame.
        nms: suppression of each task, or one for all.
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
        """Check; raises ConfigError."""
        check_least(self, candidates=1)
        if not all(
            low < high
            for low, high in zip(self.center_range[:3], self.center_range[3:], strict=True)
        ):
            raise ConfigError(
                f"center_range: expected least x, y, z, then greatest, found {self.center_range!r}"
            )
        if not self.nms:
            raise ConfigError("nms: expected one NmsConfig, or one a task, found none")


class Candidates(NamedTuple):
    """The K best cells of one task for each of B samples, the best first.

    Attributes:
        boxes: (B, K, 9) x y z l w h yaw vx vy, ego frame, z of the centre; metres, radians, m/s.
        scores: (B, K) in (0, 1).
        slots: (B, K) int64, heatmap channel in the task.
        valid: (B, K) bool: above the score threshold, in the range and finite.
    """

    boxes: Tensor
    scores: Tensor
    slots: Tensor
    valid: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detections:
    """The boxes of one sample, the best first.

    Attributes:
        boxes: (N, 9) x y z l w h yaw vx vy, ego frame, z of the centre; metres, radians, m/s.
        scores: (N,) in (0, 1).
        categories: (N,) int64, index into `taxonomy.CATEGORIES`.
    """

    boxes: Tensor
    scores: Tensor
    categories: Tensor


def decode_candidates(
    maps: TaskMaps, head: DetectionConfig, config: DecodingConfig | None = None
) -> Candidates:
    """The best cells of a task as boxes, before suppression; the released CenterPointBBoxCoder's.

    Args:
        maps: of the task.
        head: cells.
        config: None for the released rules.
    """
    rules = config or DecodingConfig()
    rows, columns = maps.heatmap.shape[-2:]
    flat = precise(maps.heatmap).sigmoid().flatten(1)
    scores, best = flat.topk(min(rules.candidates, flat.shape[1]), dim=1)
    slots, cell = best // (rows * columns), best % (rows * columns)
    code = gather_cells(precise(maps.code), cell)
    offset, z, size, turn, velocity = code.split(list(CODE_CHANNELS.values()), dim=2)
    place = torch.stack([cell % columns, cell // columns], dim=2) + offset
    center = place * place.new_tensor([head.x[2], head.y[2]]) + place.new_tensor(
        [head.x[0], head.y[0]]
    )
    yaw = torch.atan2(turn[:, :, :1], turn[:, :, 1:])
    boxes = torch.cat([center, z, size.exp(), yaw, velocity], dim=2)
    low, high = boxes.new_tensor(rules.center_range).view(2, 3)
    inside = ((boxes[:, :, :3] >= low) & (boxes[:, :, :3] <= high)).all(dim=2)
    return Candidates(
        boxes,
        scores,
        slots,
        (scores > rules.score_threshold) & inside & boxes.isfinite().all(dim=2),
    )


def decode_detections(
    maps: Sequence[TaskMaps], head: DetectionConfig, config: DecodingConfig | None = None
) -> list[Detections]:
    """The boxes of each of B samples, after suppression within each task.

    Boxes of slots that stand for no category are left out; they suppress others of their task before.

    Args:
        maps: of each task, from the head.
        head: cells and slots.
        config: None for ours; `nms=RELEASED_NMS` for the released suppression of the six released tasks.

    Raises:
        ConfigError: another number of `nms` than tasks, or of its scales than slots.
    """
    rules = config or DecodingConfig()
    suppressions = _nms_of_tasks(rules.nms, head.class_slots)
    parts: list[list[Detections]] = [[] for _ in range(len(maps[0].heatmap))]
    for task, slots, nms in zip(maps, head.class_slots, suppressions, strict=True):
        candidates = decode_candidates(task, head, rules)
        for sample, found in enumerate(parts):
            found.append(_kept(Candidates(*(each[sample] for each in candidates)), slots, nms))
    return [_joined(found) for found in parts]


def detected_boxes(detections: Detections, world_from_ego: SE3 | ArrayLike) -> DetectedBoxes:
    """One sample's detections for the devkit's evaluators and results files, in the world frame.

    Args:
        detections: right-handed; those of a model that works in left-handed axes must be mirrored first.
        world_from_ego: pose of the sample's agent, (4, 4) if no SE3.

    Raises:
        GeometryError: it is no rigid transform.
    """
    pose = world_from_ego if isinstance(world_from_ego, SE3) else SE3(world_from_ego)  # type: ignore[arg-type]
    boxes = detections.boxes.detach().cpu().double().numpy()
    found = DetectedBoxes.from_arrays(
        boxes[:, :3],
        boxes[:, 3:6],
        boxes[:, 6],
        detections.scores.detach().cpu().double().numpy(),
        category=detections.categories.cpu().numpy(),
        velocity=boxes[:, 7:],
        frame="ego",
    )
    return found.transform(pose, "world")


def _nms_of_tasks(nms: tuple[NmsConfig, ...], class_slots: ClassSlots) -> tuple[NmsConfig, ...]:
    every = nms * len(class_slots) if len(nms) == 1 else nms
    if len(every) != len(class_slots):
        raise ConfigError(
            f"nms: expected one NmsConfig, or {len(class_slots)}, one a task; found {len(nms)}"
        )
    for task, (each, slots) in enumerate(zip(every, class_slots, strict=True)):
        if len(each.scale) not in (1, len(slots)):
            raise ConfigError(
                f"nms: task {task} has {len(slots)} slots, found {len(each.scale)} scales; give one, or one a slot"
            )
    return every


def _kept(candidates: Candidates, slots: tuple[int | None, ...], nms: NmsConfig) -> Detections:
    """What stays of one sample's candidates of one task."""
    valid = candidates.valid
    boxes, scores, slot = candidates.boxes[valid], candidates.scores[valid], candidates.slots[valid]
    rows, values, numbers = (each.detach().cpu().numpy() for each in (boxes, scores, slot))
    stay = torch.from_numpy(suppress(rows, values, numbers, nms)).to(boxes.device)
    codes = torch.tensor([-1 if each is None else each for each in slots], device=boxes.device)
    category = codes[slot[stay]]
    stay = stay[category >= 0]
    return Detections(boxes=boxes[stay], scores=scores[stay], categories=codes[slot[stay]])


def _joined(parts: Sequence[Detections]) -> Detections:
    boxes, scores, categories = (
        torch.cat([getattr(each, name) for each in parts])
        for name in ("boxes", "scores", "categories")
    )
    order = scores.argsort(descending=True, stable=True)
    return Detections(boxes=boxes[order], scores=scores[order], categories=categories[order])
