"""Targets of the detection head, from boxes in the ego frame, and its losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.detection.head import (
    CODE_CHANNELS,
    CODE_SIZE,
    DetectionConfig,
    TaskMaps,
)
from deepaccident_devkit.plugins.model.warps import precise
from deepaccident_devkit.support.arrays import check_least
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import CATEGORIES

# Smallest value of the heatmap in cells of ignored boxes: detections in such cells cost less than a
# trillionth (`heatmap_loss`).
_IGNORED_HEATMAP_VALUE = 1 - 1e-3
# Smallest distance of probabilities from 0 and 1.
_MIN_PROBABILITY = 1e-4


def peak_radius(length: Tensor, width: Tensor, min_overlap: float) -> Tensor:
    """Return the radius (N,) of boxes' peaks in the heatmap, in cells, by the released formula.

    It is not rounded, and may be below the minimum radius. It is the smallest of three
    roots; in each, the release divides by 2 where 2a would be right. Lengths and widths are (N,)
    cells.
    """
    half_perimeter, area = length + width, length * width
    quadratics = (
        (1.0, half_perimeter, area * (1 - min_overlap) / (1 + min_overlap)),
        (4.0, 2 * half_perimeter, (1 - min_overlap) * area),
        (4 * min_overlap, -2 * min_overlap * half_perimeter, (min_overlap - 1) * area),
    )
    roots = [(b + (b**2 - 4 * a * c).clamp(min=0).sqrt()) / 2 for a, b, c in quadratics]
    return torch.stack(roots).amin(dim=0)


def draw_peaks(heatmap: Tensor, layer: Tensor, cell: Tensor, radius: Tensor) -> None:
    """Draw Gaussians with σ = (2r + 1)/6 in squares of 2r + 1 cells; the larger value is retained.

    The heatmap is changed in place.

    Args:
        heatmap: Heatmap, shape (L, H, W).
        layer: Layer of each peak, (N,) int64.
        cell: Column and row of each peak, in the map, (N, 2) int64.
        radius: Radius r of each peak in cells, (N,) int64.
    """
    if not len(layer):
        return
    rows, columns = heatmap.shape[1:]
    max_radius = int(radius.max())
    offset = torch.arange(-max_radius, max_radius + 1, device=heatmap.device)
    column, row = cell[:, :1] + offset, cell[:, 1:] + offset  # (N, side)
    sigma = (2 * radius[:, None].to(heatmap.dtype) + 1) / 6
    gaussian = torch.exp(-(offset.to(heatmap.dtype) ** 2) / (2 * sigma**2))
    bell = gaussian * (offset.abs() <= radius[:, None])
    # Values beyond an edge are moved to the edge, where the Gaussian itself is larger.
    row, column = row.clamp(0, rows - 1), column.clamp(0, columns - 1)
    index = row[:, :, None] * columns + column[:, None]
    index = index + layer[:, None, None] * (rows * columns)
    peaks = bell[:, :, None] * bell[:, None]
    heatmap.view(-1).scatter_reduce_(0, index.flatten(), peaks.flatten(), "amax")


UnknownVelocity = Literal["ignore", "zero"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetConfig:
    """Rules for the targets of boxes.

    Attributes:
        min_overlap: Overlap of a box with a copy that is shifted by the radius; the radius of its
            peak follows from it.
        min_radius: Smallest radius of a peak in the heatmap, cells.
        max_boxes: Maximum number of boxes of a task and sample; further boxes are left out.
        unknown_velocity: `ignore` trains no velocity where none is known; `zero`, as released,
            trains 0.
    """

    min_overlap: float = 0.1
    min_radius: int = 2
    max_boxes: int = 500
    unknown_velocity: UnknownVelocity = "ignore"

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError or ChoiceError."""
        settle_choices(self, {"unknown_velocity": get_args(UnknownVelocity)})
        if not 0 < self.min_overlap < 1:
            raise ConfigError(
                f"min_overlap: expected a number between 0 and 1, found {self.min_overlap!r}"
            )
        check_least(self, min_radius=0, max_boxes=1)


class TaskTargets(NamedTuple):
    """One task's targets for B samples.

    Attributes:
        heatmap: Values in [0, 1], 1 at the cells of centres, shape (B, slots, H, W).
        box: Box codes: centre in the cell (x, y), z, log l, log w, log h, sin, cos, vx, vy; 0
            without a box, shape (B, max_boxes, 10).
        cell_index: row · W + column of each box's cell, (B, max_boxes) int64; 0 without a box.
        mask: Whether there is a box, (B, max_boxes) bool.
        velocity_known: Whether each box trains its velocity, (B, max_boxes) bool.
    """

    heatmap: Tensor
    box: Tensor
    cell_index: Tensor
    mask: Tensor
    velocity_known: Tensor


class _GridBoxes(NamedTuple):
    """All N boxes of a batch, on the grid."""

    sample: Tensor  # (N,)
    task: Tensor  # (N,), −1 for boxes that belong to no task
    slot: Tensor  # (N,), in the task
    cell: Tensor  # (N, 2), column and row
    code: Tensor  # (N, 10)
    radius: Tensor  # (N,), cells
    velocity_known: Tensor  # (N,)
    has_cell: Tensor  # (N,)


def detection_targets(
    boxes: Sequence[Tensor],
    categories: Sequence[Tensor],
    head: DetectionConfig,
    config: TargetConfig | None = None,
    *,
    velocity_known: Sequence[Tensor] | None = None,
) -> list[TaskTargets]:
    """Return the targets of each task, as in the released CenterHeadv1.

    A box belongs to the cell (x − x₀)/step, truncated toward zero: centres up to one cell below the
    lower edges count in the first row or column. Other boxes outside are left out, and so are boxes
    without length, width or height (of these, the release retains boxes without height, which have
    an infinite logarithm).

    Args:
        boxes: For each of B samples, x y z l w h yaw vx vy in the ego frame, z of the centre;
            metres, radians, m/s; shape (M, 9).
        categories: For each sample, indices into `taxonomy.CATEGORIES`, shape (M,); others are left
            out. Boxes of −1 are ignored: detections in them are not wrong.
        head: Cells and slots.
        config: Rules; None for ours.
        velocity_known: For each sample, whether a box's velocity is known, (M,) bool; None if every
            finite velocity is known.

    Returns:
        Targets of each task, on the boxes' device and of their dtype.
    """
    config = config or TargetConfig()
    grid_boxes = _grid_boxes(boxes, categories, velocity_known, head, config)
    targets = [
        _task_targets(grid_boxes, task, len(boxes), head, config)
        for task in range(len(head.class_slots))
    ]
    if all(bool((category >= 0).all()) for category in categories):
        return targets
    ignored_cells = []
    for box, category in zip(boxes, categories, strict=True):
        ignored_cells.append(_covered_cells(box[category < 0], head))
    is_ignored = torch.stack(ignored_cells)[:, None]
    masked_targets = []
    for target in targets:
        raised = target.heatmap.clamp(min=_IGNORED_HEATMAP_VALUE)
        heatmap = torch.where(is_ignored, raised, target.heatmap)
        masked_targets.append(target._replace(heatmap=heatmap))
    return masked_targets


def _covered_cells(boxes: Tensor, head: DetectionConfig) -> Tensor:
    """Return whether each cell (H, W) has its centre in one of the boxes (M, 9)."""
    y, x = (
        low + step * (torch.arange(count, device=boxes.device, dtype=boxes.dtype) + 0.5)
        for (low, _, step), count in zip((head.y, head.x), head.shape, strict=True)
    )
    offset_x = x[None, None] - boxes[:, 0, None, None]
    offset_y = y[None, :, None] - boxes[:, 1, None, None]
    cosine, sine = boxes[:, 6, None, None].cos(), boxes[:, 6, None, None].sin()
    longitudinal = (offset_x * cosine + offset_y * sine).abs()
    lateral = (offset_y * cosine - offset_x * sine).abs()
    half_length, half_width = boxes[:, 3, None, None] / 2, boxes[:, 4, None, None] / 2
    return ((longitudinal <= half_length) & (lateral <= half_width)).any(dim=0)


def _grid_boxes(
    boxes: Sequence[Tensor],
    categories: Sequence[Tensor],
    velocity_known: Sequence[Tensor] | None,
    head: DetectionConfig,
    config: TargetConfig,
) -> _GridBoxes:
    """Return the boxes of all samples on the grid."""
    box, category = torch.cat(list(boxes)), torch.cat(list(categories))
    counts = torch.tensor([len(sample_boxes) for sample_boxes in boxes], device=box.device)
    rows, columns = head.shape
    low, step = box.new_tensor([head.x[0], head.y[0]]), box.new_tensor([head.x[2], head.y[2]])
    position = (box[:, :2] - low) / step
    cell = position.trunc()
    size = box[:, 3:5] / step
    in_grid = ((cell >= 0) & (cell < box.new_tensor([columns, rows]))).all(dim=1)
    has_cell = in_grid & (box[:, 3:6] > 0).all(dim=1)
    is_known = box[:, 7:].isfinite().all(dim=1)
    if velocity_known is not None:
        is_known = is_known & torch.cat(list(velocity_known))
    yaw = box[:, 6:7]
    velocity = torch.where(is_known[:, None], box[:, 7:], torch.zeros_like(box[:, 7:]))
    code = torch.cat(
        [position - cell, box[:, 2:3], box[:, 3:6].log(), yaw.sin(), yaw.cos(), velocity], dim=1
    )
    task, slot = _tasks_and_slots(category, head)
    radius = peak_radius(size[:, 0], size[:, 1], config.min_overlap).long()
    return _GridBoxes(
        sample=torch.repeat_interleave(torch.arange(len(boxes), device=box.device), counts),
        task=task,
        slot=slot,
        cell=cell.long(),
        code=code,
        radius=radius.clamp(min=config.min_radius),
        velocity_known=is_known | (config.unknown_velocity == "zero"),
        has_cell=has_cell,
    )


def _tasks_and_slots(category: Tensor, head: DetectionConfig) -> tuple[Tensor, Tensor]:
    """Return the task of each category, and its slot in the task; −1 for no task."""
    rows = [(-1, -1)] * (len(CATEGORIES) + 1)  # the last row is that of unknown categories
    for task, slots in enumerate(head.class_slots):
        for slot, number in enumerate(slots):
            if number is not None:
                rows[number] = (task, slot)
    table = torch.tensor(rows, device=category.device)
    is_known = (category >= 0) & (category < len(CATEGORIES))
    matches = table[torch.where(is_known, category, len(CATEGORIES))]
    return matches[:, 0], matches[:, 1]


def _task_targets(
    boxes: _GridBoxes, task: int, samples: int, head: DetectionConfig, config: TargetConfig
) -> TaskTargets:
    """Return a task's targets.

    Boxes are ordered by their slots, then as in the input; a box without a cell leaves its row
    empty, as in the release.
    """
    slots, (rows, columns) = len(head.class_slots[task]), head.shape
    selected = torch.nonzero(boxes.task == task)[:, 0]
    order = torch.argsort(boxes.sample[selected] * slots + boxes.slot[selected], stable=True)
    selected = selected[order]
    ends = torch.cumsum(torch.bincount(boxes.sample[selected], minlength=samples), dim=0)
    starts = torch.cat([ends.new_zeros(1), ends[:-1]])
    all_numbers = torch.arange(len(selected), device=selected.device)
    number = all_numbers - starts[boxes.sample[selected]]
    is_retained = boxes.has_cell[selected] & (number < config.max_boxes)
    selected, number = selected[is_retained], number[is_retained]
    sample, cell = boxes.sample[selected], boxes.cell[selected]
    size = (samples, config.max_boxes)
    box = boxes.code.new_zeros((*size, CODE_SIZE))
    cell_index = selected.new_zeros(size)
    mask = torch.zeros_like(cell_index, dtype=torch.bool)
    velocity_known = torch.zeros_like(cell_index, dtype=torch.bool)
    box[sample, number] = boxes.code[selected]
    cell_index[sample, number] = cell[:, 1] * columns + cell[:, 0]
    mask[sample, number] = True
    velocity_known[sample, number] = boxes.velocity_known[selected]
    heatmap = box.new_zeros((samples * slots, rows, columns))
    draw_peaks(heatmap, sample * slots + boxes.slot[selected], cell, boxes.radius[selected])
    heatmap = heatmap.view(samples, slots, rows, columns)
    return TaskTargets(heatmap, box, cell_index, mask, velocity_known)


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionLossConfig:
    """Weights of the losses, the released ones.

    Attributes:
        weight: Weight of all detection losses relative to the network's other tasks.
        box_weight: Weight of the box codes' loss relative to the heatmap's.
    """

    weight: float = 0.5
    box_weight: float = 0.25

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        check_least(self, weight=0, box_weight=0)


def detection_losses(
    maps: Sequence[TaskMaps],
    targets: Sequence[TaskTargets],
    config: DetectionLossConfig | None = None,
) -> dict[str, Tensor]:
    """Return the weighted losses of the released CenterHeadv1.

    They are `task0.loss_heatmap`, `task0.loss_bbox`, …

    Args:
        maps: Maps of each task, from the head.
        targets: Targets of each task.
        config: Weights; None for the released ones.

    Returns:
        Scalars, in single precision or better.
    """
    weights = config or DetectionLossConfig()
    losses: dict[str, Tensor] = {}
    for number, (task_maps, target) in enumerate(zip(maps, targets, strict=True)):
        losses[f"task{number}.loss_heatmap"] = weights.weight * heatmap_loss(
            task_maps.heatmap, target.heatmap
        )
        losses[f"task{number}.loss_bbox"] = (
            weights.weight * weights.box_weight * box_loss(task_maps.code, target)
        )
    return losses


def heatmap_loss(logits: Tensor, heatmap: Tensor) -> Tensor:
    """Return the Gaussian focal loss (CornerNet, α = 2, γ = 4) of (B, slots, H, W).

    It is summed and divided by the number of peaks or 1.
    """
    probability = precise(logits).sigmoid().clamp(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    is_peak = heatmap == 1
    peak_losses = -((1 - probability) ** 2) * probability.log()
    other_losses = -(probability**2) * (1 - probability).log() * (1 - heatmap) ** 4
    return torch.where(is_peak, peak_losses, other_losses).sum() / is_peak.sum().clamp(min=1)


def box_loss(code: Tensor, target: TaskTargets) -> Tensor:
    """Return the sum of L1 distances of box codes (B, 10, H, W), over the number of boxes.

    Unknown velocities do not count.
    """
    predicted = gather_cells(precise(code), target.cell_index)
    is_counted = target.mask[:, :, None].repeat(1, 1, predicted.shape[-1])
    is_counted[:, :, -CODE_CHANNELS["vel"] :] &= target.velocity_known[:, :, None]
    distance = (predicted - target.box).abs() * is_counted
    return distance.sum() / (target.mask.sum() + 1e-4)


def gather_cells(maps: Tensor, cell_index: Tensor) -> Tensor:
    """Return values (B, K, C) of maps (B, C, H, W) at cells (B, K), given as row · W + column."""
    channels = maps.shape[1]
    index = cell_index[:, None].expand(-1, channels, -1)
    return maps.flatten(2).gather(2, index).transpose(1, 2)
