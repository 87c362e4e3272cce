"""What the detection head should say: heatmaps, box codes and where they count, from boxes in the ego frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.detection.head import CODE_SIZE, DetectionConfig
from deepaccident_devkit.model.detection.peaks import draw_peaks, peak_radius
from deepaccident_devkit.taxonomy import CATEGORIES
from deepaccident_devkit.text import settle_choices

UnknownVelocity = Literal["ignore", "zero"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetConfig:
    """How boxes become targets.

    Attributes:
        min_overlap: of a box with its like, shifted by the radius, from which the radius of its peak follows.
        min_radius: of a peak in the heatmap, cells.
        max_boxes: of a task and sample; further ones are left out.
        unknown_velocity: `ignore` trains no velocity where none is known; `zero`, as released, trains 0.
    """

    min_overlap: float = 0.1
    min_radius: int = 2
    max_boxes: int = 500
    unknown_velocity: UnknownVelocity = "ignore"

    def __post_init__(self) -> None:
        """Check; raises ConfigError or ChoiceError."""
        settle_choices(self, {"unknown_velocity": get_args(UnknownVelocity)})
        if not 0 < self.min_overlap < 1:
            raise ConfigError(f"min_overlap: expected a number between 0 and 1, found {self.min_overlap!r}")
        for name, least in (("min_radius", 0), ("max_boxes", 1)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name}: expected a whole number from {least}, found {getattr(self, name)!r}")


class TaskTargets(NamedTuple):
    """One task's targets for B samples.

    Attributes:
        heatmap: (B, slots, H, W) in [0, 1], 1 at the cells of centres.
        box: (B, max_boxes, 10) box codes: centre in the cell (x, y), z, log l, log w, log h, sin, cos, vx, vy; else 0.
        place: (B, max_boxes) int64, row · W + column of each box's cell; 0 where there is none.
        mask: (B, max_boxes) bool, where there is a box.
        velocity_known: (B, max_boxes) bool, which boxes train their velocity.
    """

    heatmap: Tensor
    box: Tensor
    place: Tensor
    mask: Tensor
    velocity_known: Tensor


class _Placed(NamedTuple):
    """All boxes of a batch, N, on the grid."""

    sample: Tensor  # (N,)
    task: Tensor  # (N,) −1 for those that no task has
    slot: Tensor  # (N,) in the task
    cell: Tensor  # (N, 2) column, row
    code: Tensor  # (N, 10)
    radius: Tensor  # (N,) cells
    velocity_known: Tensor  # (N,)
    inside: Tensor  # (N,) whether they have a cell


def detection_targets(
    boxes: Sequence[Tensor],
    categories: Sequence[Tensor],
    head: DetectionConfig,
    config: TargetConfig | None = None,
    *,
    velocity_known: Sequence[Tensor] | None = None,
) -> list[TaskTargets]:
    """The targets of each task, as the released CenterHeadv1 makes them.

    A box belongs to the cell (x − x₀)/step, truncated toward zero: centres up to one cell below the lower edges count
    in the first row or column. Other boxes outside are left out, and so are those without length, width or
    height (of these, the release keeps boxes without height, whose logarithm is infinite).

    Args:
        boxes: for each of B samples (M, 9): x y z l w h yaw vx vy, ego frame, z of the centre; metres, radians, m/s.
        categories: for each sample (M,) indices into `taxonomy.CATEGORIES`; others are left out.
        head: cells and slots.
        config: None for ours.
        velocity_known: for each sample (M,) bool; None where every finite velocity is known.

    Returns:
        One a task, on the boxes' device and of their type.
    """
    rules = config or TargetConfig()
    placed = _placed(boxes, categories, velocity_known, head, rules)
    return [_task_targets(placed, task, len(boxes), head, rules) for task in range(len(head.class_slots))]


def _placed(
    boxes: Sequence[Tensor],
    categories: Sequence[Tensor],
    velocity_known: Sequence[Tensor] | None,
    head: DetectionConfig,
    config: TargetConfig,
) -> _Placed:
    box, category = torch.cat(list(boxes)), torch.cat(list(categories))
    counts = torch.tensor([len(each) for each in boxes], device=box.device)
    rows, columns = head.shape
    low, step = box.new_tensor([head.x[0], head.y[0]]), box.new_tensor([head.x[2], head.y[2]])
    place = (box[:, :2] - low) / step
    cell = place.trunc()
    size = box[:, 3:5] / step
    inside = ((cell >= 0) & (cell < box.new_tensor([columns, rows]))).all(dim=1) & (box[:, 3:6] > 0).all(dim=1)
    known = box[:, 7:].isfinite().all(dim=1)
    if velocity_known is not None:
        known = known & torch.cat(list(velocity_known))
    yaw, velocity = box[:, 6:7], torch.where(known[:, None], box[:, 7:], torch.zeros_like(box[:, 7:]))
    code = torch.cat([place - cell, box[:, 2:3], box[:, 3:6].log(), yaw.sin(), yaw.cos(), velocity], dim=1)
    task, slot = _slots_of(category, head)
    radius = peak_radius(size[:, 0], size[:, 1], config.min_overlap).long().clamp(min=config.min_radius)
    return _Placed(
        sample=torch.repeat_interleave(torch.arange(len(boxes), device=box.device), counts),
        task=task,
        slot=slot,
        cell=cell.long(),
        code=code,
        radius=radius,
        velocity_known=known | (config.unknown_velocity == "zero"),
        inside=inside,
    )


def _slots_of(category: Tensor, head: DetectionConfig) -> tuple[Tensor, Tensor]:
    """Task, and slot in it, of each category; task −1 for those that have none."""
    places = {each: (task, slot) for task, slots in enumerate(head.class_slots) for slot, each in enumerate(slots)}
    rows = [places.get(each, (-1, -1)) for each in range(len(CATEGORIES))]
    table = torch.tensor([*rows, (-1, -1)], device=category.device)
    known = (category >= 0) & (category < len(CATEGORIES))
    found = table[torch.where(known, category, len(CATEGORIES))]
    return found[:, 0], found[:, 1]


def _task_targets(placed: _Placed, task: int, samples: int, head: DetectionConfig, config: TargetConfig) -> TaskTargets:
    """Boxes stand in the order of their slots, then as given; one outside leaves its place empty, as in the release."""
    slots, (rows, columns) = len(head.class_slots[task]), head.shape
    mine = torch.nonzero(placed.task == task)[:, 0]
    mine = mine[torch.argsort(placed.sample[mine] * slots + placed.slot[mine], stable=True)]
    first = torch.cumsum(torch.bincount(placed.sample[mine], minlength=samples), dim=0)
    first = torch.cat([first.new_zeros(1), first[:-1]])
    number = torch.arange(len(mine), device=mine.device) - first[placed.sample[mine]]
    kept = placed.inside[mine] & (number < config.max_boxes)
    mine, number = mine[kept], number[kept]
    sample, cell = placed.sample[mine], placed.cell[mine]
    size = (samples, config.max_boxes)
    box = placed.code.new_zeros((*size, CODE_SIZE))
    place = mine.new_zeros(size)
    mask, known = torch.zeros_like(place, dtype=torch.bool), torch.zeros_like(place, dtype=torch.bool)
    box[sample, number] = placed.code[mine]
    place[sample, number] = cell[:, 1] * columns + cell[:, 0]
    mask[sample, number] = True
    known[sample, number] = placed.velocity_known[mine]
    heatmap = box.new_zeros((samples * slots, rows, columns))
    draw_peaks(heatmap, sample * slots + placed.slot[mine], cell, placed.radius[mine])
    return TaskTargets(heatmap.view(samples, slots, rows, columns), box, place, mask, known)
