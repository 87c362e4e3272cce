"""The losses of the motion head, FIERY's as BEVerse weighs them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.model.motion.decoders import LatentDistribution
from deepaccident_devkit.model.motion.head import IGNORE_INDEX, MotionOutputs, MotionTargets

_CLIP: Final = 1e-4
"""Probabilities of a centre stay so far from 0 and 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionLossConfig:
    """How the motion losses are computed and weighed; the defaults are the released ones.

    Attributes:
        class_weights: of background and foreground in the segmentation's cross entropy.
        top_k: share of a frame's cells that counts in it, the hardest.
        discount: weight of a frame relative to the one before.
        segmentation: weight of the segmentation's loss.
        centerness: of the centres' loss.
        offset: of the offsets' loss.
        flow: of the flows' loss.
        prob: of the divergence of the latent's distributions.
        ignore_index: the labels' mark of ignored cells (`motion.MotionLabelConfig.ignore_index`).
    """

    class_weights: tuple[float, float] = (1.0, 2.0)
    top_k: float = 0.25
    discount: float = 0.95
    segmentation: float = 5.0
    centerness: float = 1.0
    offset: float = 1.0
    flow: float = 1.0
    prob: float = 10.0
    ignore_index: int = IGNORE_INDEX

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        if not 0 < self.top_k <= 1:
            raise ConfigError(f"top_k: expected a share above 0 and at most 1, found {self.top_k!r}")
        if len(self.class_weights) != 2:
            raise ConfigError(
                f"class_weights: expected those of background and foreground, found {self.class_weights!r}"
            )


def motion_losses(outputs: MotionOutputs, targets: MotionTargets, config: MotionLossConfig) -> dict[str, Tensor]:
    """All losses of a batch, weighed: `motion_seg`, `_centerness`, `_offset`, `_flow` and `_prob`, scalars.

    Frames that `targets.frame_mask` leaves out do not count. If nothing counts, a loss is zero, with zero gradients.

    Args:
        outputs: of a call with targets.
        targets: the same.
        config: how to compute and weigh.

    Raises:
        NotAvailableError: the outputs are of a call without targets.
    """
    if outputs.future is None:
        raise NotAvailableError("outputs: expected those of a call with targets, found no posterior; give the targets")
    maps, mask = outputs.maps, targets.frame_mask
    losses = {
        "seg": config.segmentation * segmentation_loss(maps.segmentation, targets.segmentation, mask, config),
        "centerness": config.centerness * center_loss(maps.instance_center, targets.centerness, mask, config),
        "offset": config.offset * vector_loss(maps.instance_offset, targets.offset, mask, config),
        "flow": config.flow * vector_loss(maps.instance_flow, targets.flow, mask, config),
        "prob": config.prob * latent_loss(outputs.present, outputs.future, mask.any(dim=1)),
    }
    return {f"motion_{name}": loss for name, loss in losses.items()}


def segmentation_loss(logits: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig) -> Tensor:
    """Weighted cross entropy of each frame's hardest cells, averaged over all that are kept.

    Args:
        logits: (N, T, 2, H, W).
        target: (N, T, H, W) int64; ignored cells have no loss.
        frame_mask: (N, T) bool.
        config: the class weights, share of cells, discount and mark.
    """
    logits = _full(logits)
    losses = functional.cross_entropy(
        logits.flatten(0, 1),
        target.flatten(0, 1),
        weight=logits.new_tensor(config.class_weights),
        reduction="none",
        ignore_index=config.ignore_index,
    )
    cells = losses.flatten(1)
    hardest = cells.topk(max(int(config.top_k * cells.shape[1]), 1), sorted=False).values
    per_frame = hardest.mean(dim=1).unflatten(0, frame_mask.shape) * _discounts(logits, config)
    return _mean(per_frame, frame_mask)


def center_loss(logits: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig) -> Tensor:
    """Gaussian focal loss (CornerNet, arXiv:1808.01244), summed and divided by the discounted number of centres.

    Args:
        logits: (N, T, 1, H, W).
        target: (N, T, 1, H, W) 1 at centres.
        frame_mask: (N, T) bool.
        config: the discount.
    """
    logits = _full(logits)
    likely = logits.sigmoid().clamp(_CLIP, 1 - _CLIP)
    center = target == 1
    hit = -likely.log() * (1 - likely).square()
    miss = -(1 - likely).log() * likely.square() * (1 - target.to(logits)).pow(4)
    weight = torch.where(frame_mask, _discounts(logits, config), 0)
    loss = (torch.where(center, hit, miss).flatten(2).sum(dim=2) * weight).sum()
    return loss / (center.flatten(2).sum(dim=2) * weight).sum().clamp(min=1)


def vector_loss(vectors: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig) -> Tensor:
    """Absolute error summed over both channels, averaged over the cells that are not ignored.

    Args:
        vectors: (N, T, 2, H, W), cells.
        target: (N, T, 2, H, W), cells; ignored if either channel has the mark.
        frame_mask: (N, T) bool.
        config: the discount and mark.
    """
    vectors = _full(vectors)
    error = (vectors - target.to(vectors)).abs().sum(dim=2) * _discounts(vectors, config)[:, None, None]
    return _mean(error, (target != config.ignore_index).all(dim=2) & frame_mask[:, :, None, None])


def latent_loss(present: LatentDistribution, future: LatentDistribution, sample_mask: Tensor) -> Tensor:
    """The divergence KL(future ‖ present): what the posterior says that the present's distribution does not.

    Summed over the latent's channels, averaged over its cells and over the samples in `sample_mask` (N,) bool.
    """
    mu, log_sigma = (_full(each) for each in present)
    future_mu, future_log_sigma = (_full(each) for each in future)
    spread = (2 * (future_log_sigma - log_sigma)).exp() + ((future_mu - mu) * (-log_sigma).exp()).square()
    divergence = (log_sigma - future_log_sigma + (spread - 1) / 2).sum(dim=1)
    return _mean(divergence, sample_mask[:, None, None].expand_as(divergence))


def _discounts(like: Tensor, config: MotionLossConfig) -> Tensor:
    """(T,) the weight of each frame of maps (N, T, …)."""
    return torch.pow(config.discount, torch.arange(like.shape[1], device=like.device, dtype=like.dtype))


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """The mean of the values in the mask; zero, with zero gradients, if there are none."""
    return torch.where(mask, values, 0).sum() / mask.sum().clamp(min=1)


def _full(values: Tensor) -> Tensor:
    """In float32 at least: sums over maps overflow half precision."""
    return values.to(torch.promote_types(values.dtype, torch.float32))
