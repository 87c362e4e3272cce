"""Targets for the detection head from boxes in the ego frame, and the head's losses."""

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
from deepaccident_devkit.support.arrays import check_minima
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import CATEGORIES

# Smallest value of the heatmap in cells of ignored boxes: detections in such cells cost less than a
# trillionth (`heatmap_loss`).
_IGNORED_HEATMAP_VALUE = 1 - 1e-3
# Smallest distance of probabilities from 0 and 1.
_MIN_PROBABILITY = 1e-4
# Added to the number of boxes, so that a batch without boxes has no loss.
_COUNT_OFFSET = 1e-4

UnknownVelocity = Literal["ignore", "zero"]


def peak_radius(length: Tensor, width: Tensor, min_overlap: float) -> Tensor:
    """Return the radius (N,) of boxes' peaks in the heatmap, in cells, by the released formula.

    The radius is not rounded, and may be below the minimum radius. It is the smallest of three
    roots; in each, the release divides by 2 where 2a would be right. Lengths and widths are in
    cells, shape (N,).
    """
    half_perimeter = length + width
    area = length * width
    quadratics = (
        (1.0, half_perimeter, area * (1 - min_overlap) / (1 + min_overlap)),
        (4.0, 2 * half_perimeter, (1 - min_overlap) * area),
        (4 * min_overlap, -2 * min_overlap * half_perimeter, (min_overlap - 1) * area),
    )
    roots = []
    for a, b, c in quadratics:
        discriminant = (b**2 - 4 * a * c).clamp(min=0)
        roots.append((b + discriminant.sqrt()) / 2)
    return torch.stack(roots).amin(dim=0)


def draw_peaks(heatmap: Tensor, layer: Tensor, cell: Tensor, radius: Tensor) -> None:
    """Draw Gaussians with σ = (2r + 1)/6 in squares of 2r + 1 cells.

    The heatmap is changed in place. Where peaks overlap, the larger value is retained.

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
    column = cell[:, :1] + offset
    row = cell[:, 1:] + offset  # (N, side)
    sigma = (2 * radius[:, None].to(heatmap.dtype) + 1) / 6
    squares = offset.to(heatmap.dtype) ** 2
    gaussian = torch.exp(-squares / (2 * sigma**2))
    is_within_radius = offset.abs() <= radius[:, None]
    bell = gaussian * is_within_radius
    # Values beyond an edge are moved to the edge, where the Gaussian itself is larger.
    row = row.clamp(0, rows - 1)
    column = column.clamp(0, columns - 1)
    index = layer[:, None, None] * rows + row[:, :, None]
    index = index * columns + column[:, None]
    peaks = bell[:, :, None] * bell[:, None]
    heatmap.view(-1).scatter_reduce_(0, index.flatten(), peaks.flatten(), "amax")


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetConfig:
    """Rules for computing targets from boxes.

    Attributes:
        min_overlap: Overlap of a box with a copy that is shifted by the radius of its peak; the
            radius follows from it.
        min_radius: Smallest radius of a peak in the heatmap, cells.
        max_boxes: Maximum number of boxes per task and sample; further boxes are left out.
        unknown_velocity: Target of unknown velocities: `ignore` excludes them from training;
            `zero`, as released, trains them towards 0.
    """

    min_overlap: float = 0.1
    min_radius: int = 2
    max_boxes: int = 500
    unknown_velocity: UnknownVelocity = "ignore"

    def __post_init__(self) -> None:
        """Check the values; raise ConfigError or ChoiceError if one is not valid."""
        settle_choices(self, {"unknown_velocity": get_args(UnknownVelocity)})
        if not 0 < self.min_overlap < 1:
            raise ConfigError(
                f"min_overlap: expected a number between 0 and 1, found {self.min_overlap!r}"
            )
        check_minima(self, min_radius=0, max_boxes=1)


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
    """All N boxes of a batch in cells of the grid."""

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
    lower edges count in the first row or column. Other boxes outside are left out. So are boxes
    without length, width or height; the release retains boxes without height, and their logarithm
    is infinite.

    Args:
        boxes: For each of B samples, x y z l w h yaw vx vy in the ego frame, z of the centre;
            metres, radians, m/s; shape (M, 9).
        categories: For each sample, indices into `taxonomy.CATEGORIES`, shape (M,); others are left
            out. Boxes of category −1 are ignored: detections inside them are not counted as wrong.
        head: Cells and slots.
        config: Rules; None for ours.
        velocity_known: For each sample, whether a box's velocity is known, (M,) bool; None if every
            finite velocity is known.

    Returns:
        Targets of each task, on the boxes' device and of their dtype.
    """
    config = config or TargetConfig()
    grid_boxes = _place_boxes(boxes, categories, velocity_known, head, config)
    targets = []
    for task in range(len(head.class_slots)):
        targets.append(_make_task_targets(grid_boxes, task, len(boxes), head, config))
    if all((sample_categories >= 0).all() for sample_categories in categories):
        return targets
    ignored_cells = []
    for sample_boxes, sample_categories in zip(boxes, categories, strict=True):
        ignored_boxes = sample_boxes[sample_categories < 0]
        ignored_cells.append(_cover_cells(ignored_boxes, head))
    is_ignored = torch.stack(ignored_cells)[:, None]
    for target in targets:
        raised = target.heatmap.clamp(min=_IGNORED_HEATMAP_VALUE)
        target.heatmap.copy_(torch.where(is_ignored, raised, target.heatmap))
    return targets


def _cover_cells(boxes: Tensor, head: DetectionConfig) -> Tensor:
    """Return whether each cell (H, W) has its centre in one of the boxes (M, 9)."""
    centers = []
    for (low, _, step), count in zip((head.y, head.x), head.shape, strict=True):
        steps = torch.arange(count, device=boxes.device, dtype=boxes.dtype)
        centers.append(low + step * (steps + 0.5))
    y, x = centers
    columns = boxes[:, :, None, None].unbind(1)
    box_x, box_y, _, length, width, _, yaw, _, _ = columns
    offset_x = x - box_x
    offset_y = y[:, None] - box_y
    cosine = yaw.cos()
    sine = yaw.sin()
    longitudinal = (offset_x * cosine + offset_y * sine).abs()
    lateral = (offset_y * cosine - offset_x * sine).abs()
    is_covered = (longitudinal <= length / 2) & (lateral <= width / 2)
    return is_covered.any(dim=0)


def _place_boxes(
    boxes: Sequence[Tensor],
    categories: Sequence[Tensor],
    velocity_known: Sequence[Tensor] | None,
    head: DetectionConfig,
    config: TargetConfig,
) -> _GridBoxes:
    """Return the boxes of all samples in cells of the grid."""
    box = torch.cat(list(boxes))
    category = torch.cat(list(categories))
    counts = torch.tensor([len(sample_boxes) for sample_boxes in boxes], device=box.device)
    rows, columns = head.shape
    center_xy, z, size, yaw, velocity = box.split([2, 1, 3, 1, 2], dim=1)
    low, _, step = box.new_tensor([head.x, head.y]).T
    position = (center_xy - low) / step
    cell = position.trunc()
    in_grid = ((cell >= 0) & (cell < box.new_tensor([columns, rows]))).all(dim=1)
    has_cell = in_grid & (size > 0).all(dim=1)
    is_known = velocity.isfinite().all(dim=1)
    if velocity_known is not None:
        is_known = is_known & torch.cat(list(velocity_known))
    velocity = velocity.masked_fill(~is_known[:, None], 0)
    code = torch.cat([position - cell, z, size.log(), yaw.sin(), yaw.cos(), velocity], dim=1)
    task, slot = _find_slots(category, head)
    length, width = (size[:, :2] / step).unbind(1)
    radius = peak_radius(length, width, config.min_overlap).long()
    return _GridBoxes(
        sample=torch.repeat_interleave(counts),
        task=task,
        slot=slot,
        cell=cell.long(),
        code=code,
        radius=radius.clamp(min=config.min_radius),
        velocity_known=is_known | (config.unknown_velocity == "zero"),
        has_cell=has_cell,
    )


def _find_slots(category: Tensor, head: DetectionConfig) -> tuple[Tensor, Tensor]:
    """Return the task of each category, and its slot in the task; −1 for no task."""
    num_categories = len(CATEGORIES)
    rows = [(-1, -1)] * (num_categories + 1)  # the last row is for unknown categories
    for task, slots in enumerate(head.class_slots):
        for slot, slot_category in enumerate(slots):
            if slot_category is not None:
                rows[slot_category] = (task, slot)
    table = torch.tensor(rows, device=category.device)
    is_known = (category >= 0) & (category < num_categories)
    matches = table[torch.where(is_known, category, num_categories)]
    return matches[:, 0], matches[:, 1]


def _make_task_targets(
    boxes: _GridBoxes, task: int, samples: int, head: DetectionConfig, config: TargetConfig
) -> TaskTargets:
    """Return a task's targets.

    Boxes are ordered by their slots, then as in the input; a box without a cell leaves its row
    empty, as in the release.
    """
    slots = len(head.class_slots[task])
    rows, columns = head.shape
    layers = boxes.sample * slots + boxes.slot
    box_rows = torch.nonzero(boxes.task == task)[:, 0]
    order = torch.argsort(layers[box_rows], stable=True)
    box_rows = box_rows[order]
    sample = boxes.sample[box_rows]
    counts = torch.bincount(sample, minlength=samples)
    starts = torch.cumsum(counts, dim=0) - counts
    number = torch.arange(len(box_rows), device=box_rows.device) - starts[sample]
    is_retained = boxes.has_cell[box_rows] & (number < config.max_boxes)
    box_rows = box_rows[is_retained]
    number = number[is_retained]
    sample = sample[is_retained]
    cell = boxes.cell[box_rows]
    shape = (samples, config.max_boxes)
    box = boxes.code.new_zeros((*shape, CODE_SIZE))
    cell_index = box_rows.new_zeros(shape)
    mask = torch.zeros_like(cell_index, dtype=torch.bool)
    velocity_known = torch.zeros_like(mask)
    box[sample, number] = boxes.code[box_rows]
    cell_index[sample, number] = cell[:, 1] * columns + cell[:, 0]
    mask[sample, number] = True
    velocity_known[sample, number] = boxes.velocity_known[box_rows]
    heatmap = box.new_zeros((samples * slots, rows, columns))
    draw_peaks(heatmap, layers[box_rows], cell, boxes.radius[box_rows])
    heatmap = heatmap.view(samples, slots, rows, columns)
    return TaskTargets(heatmap, box, cell_index, mask, velocity_known)


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionLossConfig:
    """Weights of the losses; the defaults are the released ones.

    Attributes:
        weight: Weight of all detection losses relative to the network's other tasks.
        box_weight: Weight of the box codes' loss relative to the heatmap's.
    """

    weight: float = 0.5
    box_weight: float = 0.25

    def __post_init__(self) -> None:
        """Check the values; raise ConfigError if one is not valid."""
        check_minima(self, weight=0, box_weight=0)


def detection_losses(
    maps: Sequence[TaskMaps],
    targets: Sequence[TaskTargets],
    config: DetectionLossConfig | None = None,
) -> dict[str, Tensor]:
    """Return the weighted losses of the released CenterHeadv1.

    Their names are `task0.loss_heatmap`, `task0.loss_bbox`, and so on.

    Args:
        maps: Maps of each task, from the head.
        targets: Targets of each task.
        config: Weights; None for the released ones.

    Returns:
        Name → loss, a scalar of at least single precision.
    """
    config = config or DetectionLossConfig()
    box_weight = config.weight * config.box_weight
    losses = {}
    for task, (task_maps, target) in enumerate(zip(maps, targets, strict=True)):
        task_heatmap_loss = heatmap_loss(task_maps.heatmap, target.heatmap)
        task_box_loss = box_loss(task_maps.code, target)
        losses[f"task{task}.loss_heatmap"] = config.weight * task_heatmap_loss
        losses[f"task{task}.loss_bbox"] = box_weight * task_box_loss
    return losses


def heatmap_loss(logits: Tensor, heatmap: Tensor) -> Tensor:
    """Return the Gaussian focal loss (CornerNet, α = 2, γ = 4) of logits (B, slots, H, W).

    It is summed and divided by the number of peaks, or by 1 if there are none.
    """
    probability = precise(logits).sigmoid().clamp(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    complement = 1 - probability
    is_peak = heatmap == 1
    peak_losses = -(complement**2) * probability.log()
    distance = 1 - heatmap
    other_losses = -(probability**2) * complement.log() * distance**4
    losses = torch.where(is_peak, peak_losses, other_losses)
    return losses.sum() / is_peak.sum().clamp(min=1)


def box_loss(code: Tensor, target: TaskTargets) -> Tensor:
    """Return the sum of L1 distances of box codes (B, 10, H, W), over the number of boxes.

    Unknown velocities are left out.
    """
    predicted = gather_cells(precise(code), target.cell_index)
    is_counted = target.mask[:, :, None].repeat(1, 1, predicted.shape[-1])
    is_counted[:, :, -CODE_CHANNELS["vel"] :] &= target.velocity_known[:, :, None]
    distance = (predicted - target.box).abs() * is_counted
    box_count = target.mask.sum()
    return distance.sum() / (box_count + _COUNT_OFFSET)


def gather_cells(maps: Tensor, cell_index: Tensor) -> Tensor:
    """Return values (B, K, C) of maps (B, C, H, W) at cells (B, K), given as row · W + column."""
    channels = maps.shape[1]
    index = cell_index[:, None].expand(-1, channels, -1)
    return maps.flatten(2).gather(2, index).transpose(1, 2)
