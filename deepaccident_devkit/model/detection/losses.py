"""The detection losses: a focal loss of the heatmap, and an L1 loss of the box codes at the boxes' cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.detection.head import CODE_CHANNELS, TaskMaps
from deepaccident_devkit.model.detection.targets import TaskTargets

_CLIP = 1e-4
"""Probabilities stay this far from 0 and 1."""


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
        for name in ("weight", "box_weight"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name}: expected a number from 0, found {getattr(self, name)!r}")


def detection_losses(
    maps: Sequence[TaskMaps], targets: Sequence[TaskTargets], config: DetectionLossConfig | None = None
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
        losses[f"task{number}.loss_heatmap"] = weights.weight * heatmap_loss(map_.heatmap, target.heatmap)
        losses[f"task{number}.loss_bbox"] = weights.weight * weights.box_weight * box_loss(map_.code, target)
    return losses


def heatmap_loss(logits: Tensor, heatmap: Tensor) -> Tensor:
    """Gaussian focal loss (CornerNet, α = 2, γ = 4), summed, over the number of peaks or 1.

    Args:
        logits: (B, slots, H, W).
        heatmap: the same shape, in [0, 1].
    """
    found = precise(logits).sigmoid().clamp(_CLIP, 1 - _CLIP)
    peak = heatmap == 1
    missed = -((1 - found) ** 2) * found.log()
    invented = -(found**2) * (1 - found).log() * (1 - heatmap) ** 4
    return torch.where(peak, missed, invented).sum() / peak.sum().clamp(min=1)


def box_loss(code: Tensor, target: TaskTargets) -> Tensor:
    """L1 distances of the box codes, summed, over the number of boxes.

    Args:
        code: (B, 10, H, W) predicted.
        target: its boxes; velocities that are not known do not count.
    """
    found = gather_cells(precise(code), target.place)
    counts = target.mask[:, :, None].repeat(1, 1, found.shape[-1])
    counts[:, :, -CODE_CHANNELS["vel"] :] &= target.velocity_known[:, :, None]
    distance = (found - target.box).abs() * counts
    return distance.sum() / (target.mask.sum() + 1e-4)


def gather_cells(maps: Tensor, place: Tensor) -> Tensor:
    """Values (B, C, H, W) at cells (B, K), given as row · W + column: (B, K, C)."""
    channels = maps.shape[1]
    return maps.flatten(2).gather(2, place[:, None].expand(-1, channels, -1)).transpose(1, 2)


def precise(values: Tensor) -> Tensor:
    """In single precision, if mixed precision made them coarser."""
    return values.to(torch.promote_types(values.dtype, torch.float32))
