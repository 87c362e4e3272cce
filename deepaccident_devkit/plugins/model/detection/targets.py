"""What the detection head should say, from boxes in the ego frame, and the losses where it says something else."""

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


def peak_radius(length: Tensor, width: Tensor, min_overlap: float) -> Tensor:
    """Radius (N,) of boxes' peaks in the heatmap, cells, before rounding and the least radius; the released formula.

    It is the smallest of three roots, in each of which the release divides by 2 where 2a would be right. Lengths and
    widths are (N,) cells.
    """
    total, area = length + width, length * width
    quadratics = (
        (1.0, total, area * (1 - min_overlap) / (1 + min_overlap)),
        (4.0, 2 * total, (1 - min_overlap) * area),
        (4 * min_overlap, -2 * min_overlap * total, (min_overlap - 1) * area),
    )
    roots = [(b + (b**2 - 4 * a * c).clamp(min=0).sqrt()) / 2 for a, b, c in quadratics]
    return torch.stack(roots).amin(dim=0)


def draw_peaks(heatmap: Tensor, layer: Tensor, cell: Tensor, radius: Tensor) -> None:
    """Draw Gaussians with σ = (2r + 1)/6 in squares of 2r + 1 cells; where they meet, the larger value stays.

    The heatmap (L, H, W) is changed in place; each peak has a layer (N,), a cell (N, 2), column and row inside the map,
    and a radius r (N,), cells; all int64.
    """
    if not len(layer):
        return
    rows, columns = heatmap.shape[1:]
    reach = int(radius.max())
    offset = torch.arange(-reach, reach + 1, device=heatmap.device)
    column, row = cell[:, :1] + offset, cell[:, 1:] + offset  # (N, side)
    sigma = (2 * radius[:, None].to(heatmap.dtype) + 1) / 6
    bell = torch.exp(-(offset.to(heatmap.dtype) ** 2) / (2 * sigma**2)) * (
        offset.abs() <= radius[:, None]
    )
    # what lies beyond an edge is moved onto it, where the Gaussian itself is larger
    place = row.clamp(0, rows - 1)[:, :, None] * columns + column.clamp(0, columns - 1)[:, None]
    place = place + layer[:, None, None] * (rows * columns)
    peaks = bell[:, :, None] * bell[:, None]
    heatmap.view(-1).scatter_reduce_(0, place.flatten(), peaks.flatten(), "amax")


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
            raise ConfigError(
                f"min_overlap: expected a number between 0 and 1, found {self.min_overlap!r}"
            )
        check_least(self, min_radius=0, max_boxes=1)


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
        categories: for each sample (M,) indices into `taxonomy.CATEGORIES`; others are left out. Boxes of −1 are
            ignored: where they lie, nothing that is found is wrong.
        head: cells and slots.
        config: None for ours.
        velocity_known: for each sample (M,) bool; None where every finite velocity is known.

    Returns:
        One a task, on the boxes' device and of their type.
    """
    rules = config or TargetConfig()
    placed = _placed(boxes, categories, velocity_known, head, rules)
    made = [
        _task_targets(placed, task, len(boxes), head, rules)
        for task in range(len(head.class_slots))
    ]
    if all(bool((each >= 0).all()) for each in categories):
        return made
    ignored = torch.stack(
        [_covered(box[each < 0], head) for box, each in zip(boxes, categories, strict=True)]
    )[:, None]
    return [
        one._replace(heatmap=torch.where(ignored, one.heatmap.clamp(min=_ANYTHING), one.heatmap))
        for one in made
    ]


def _covered(boxes: Tensor, head: DetectionConfig) -> Tensor:
    """Which cells (H, W) have their middle in one of the boxes (M, 9)."""
    y, x = (
        low + step * (torch.arange(count, device=boxes.device, dtype=boxes.dtype) + 0.5)
        for (low, _, step), count in zip((head.y, head.x), head.shape, strict=True)
    )
    away_x, away_y = (
        x[None, None] - boxes[:, 0, None, None],
        y[None, :, None] - boxes[:, 1, None, None],
    )
    cosine, sine = boxes[:, 6, None, None].cos(), boxes[:, 6, None, None].sin()
    along, across = (away_x * cosine + away_y * sine).abs(), (away_y * cosine - away_x * sine).abs()
    return ((along <= boxes[:, 3, None, None] / 2) & (across <= boxes[:, 4, None, None] / 2)).any(
        dim=0
    )


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
    inside = ((cell >= 0) & (cell < box.new_tensor([columns, rows]))).all(dim=1) & (
        box[:, 3:6] > 0
    ).all(dim=1)
    known = box[:, 7:].isfinite().all(dim=1)
    if velocity_known is not None:
        known = known & torch.cat(list(velocity_known))
    yaw, velocity = (
        box[:, 6:7],
        torch.where(known[:, None], box[:, 7:], torch.zeros_like(box[:, 7:])),
    )
    code = torch.cat(
        [place - cell, box[:, 2:3], box[:, 3:6].log(), yaw.sin(), yaw.cos(), velocity], dim=1
    )
    task, slot = _slots_of(category, head)
    radius = (
        peak_radius(size[:, 0], size[:, 1], config.min_overlap).long().clamp(min=config.min_radius)
    )
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
    places = {
        each: (task, slot)
        for task, slots in enumerate(head.class_slots)
        for slot, each in enumerate(slots)
    }
    rows = [places.get(each, (-1, -1)) for each in range(len(CATEGORIES))]
    table = torch.tensor([*rows, (-1, -1)], device=category.device)
    known = (category >= 0) & (category < len(CATEGORIES))
    found = table[torch.where(known, category, len(CATEGORIES))]
    return found[:, 0], found[:, 1]


def _task_targets(
    placed: _Placed, task: int, samples: int, head: DetectionConfig, config: TargetConfig
) -> TaskTargets:
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
    mask, known = (
        torch.zeros_like(place, dtype=torch.bool),
        torch.zeros_like(place, dtype=torch.bool),
    )
    box[sample, number] = placed.code[mine]
    place[sample, number] = cell[:, 1] * columns + cell[:, 0]
    mask[sample, number] = True
    known[sample, number] = placed.velocity_known[mine]
    heatmap = box.new_zeros((samples * slots, rows, columns))
    draw_peaks(heatmap, sample * slots + placed.slot[mine], cell, placed.radius[mine])
    return TaskTargets(heatmap.view(samples, slots, rows, columns), box, place, mask, known)


# Of the heatmap, in cells of ignored boxes: what is found there costs less than a trillionth (`heatmap_loss`).
_ANYTHING = 1 - 1e-3
# Probabilities stay this far from 0 and 1.
_CLIP = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectionLossConfig:
    """Weights of the losses, the released ones.

    Attributes:
        weight: of all of them, beside the other tasks of the network.
        box_weight: of the box codes' loss beside the heatmap's.
    """

    weight: float = 0.5
    box_weight: float = 0.25

    def __post_init__(self) -> None:
        """Check; raises ConfigError."""
        check_least(self, weight=0, box_weight=0)


def detection_losses(
    maps: Sequence[TaskMaps],
    targets: Sequence[TaskTargets],
    config: DetectionLossConfig | None = None,
) -> dict[str, Tensor]:
    """`task0.loss_heatmap`, `task0.loss_bbox`, … as the released CenterHeadv1 has them, times the weights.

    Args:
        maps: of each task, from the head.
        targets: of each task.
        config: None for the released weights.

    Returns:
        Scalars, in single precision or better.
    """
    weights = config or DetectionLossConfig()
    losses: dict[str, Tensor] = {}
    for number, (map_, target) in enumerate(zip(maps, targets, strict=True)):
        losses[f"task{number}.loss_heatmap"] = weights.weight * heatmap_loss(
            map_.heatmap, target.heatmap
        )
        losses[f"task{number}.loss_bbox"] = (
            weights.weight * weights.box_weight * box_loss(map_.code, target)
        )
    return losses


def heatmap_loss(logits: Tensor, heatmap: Tensor) -> Tensor:
    """Gaussian focal loss (CornerNet, α = 2, γ = 4) of (B, slots, H, W), summed, over the number of peaks or 1."""
    found = precise(logits).sigmoid().clamp(_CLIP, 1 - _CLIP)
    peak = heatmap == 1
    missed = -((1 - found) ** 2) * found.log()
    invented = -(found**2) * (1 - found).log() * (1 - heatmap) ** 4
    return torch.where(peak, missed, invented).sum() / peak.sum().clamp(min=1)


def box_loss(code: Tensor, target: TaskTargets) -> Tensor:
    """L1 distances of box codes (B, 10, H, W), summed, over the number of boxes; unknown velocities do not count."""
    found = gather_cells(precise(code), target.place)
    counts = target.mask[:, :, None].repeat(1, 1, found.shape[-1])
    counts[:, :, -CODE_CHANNELS["vel"] :] &= target.velocity_known[:, :, None]
    distance = (found - target.box).abs() * counts
    return distance.sum() / (target.mask.sum() + 1e-4)


def gather_cells(maps: Tensor, place: Tensor) -> Tensor:
    """Values (B, C, H, W) at cells (B, K), given as row · W + column: (B, K, C)."""
    channels = maps.shape[1]
    return maps.flatten(2).gather(2, place[:, None].expand(-1, channels, -1)).transpose(1, 2)
