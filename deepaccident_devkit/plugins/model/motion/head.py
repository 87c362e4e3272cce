"""The motion head: a latent, the future states of the BEV features, the maps read off each; its labels and losses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError, GeometryError, NotAvailableError
from deepaccident_devkit.plugins.model.motion.decoders import (
    HIDDEN_WARPS,
    FlowGru,
    HiddenWarp,
    LatentDistribution,
    PredictedMotionMaps,
    SeparateDecoders,
    ShuffledDecoder,
    SpatialDistribution,
)
from deepaccident_devkit.plugins.model.warps import precise
from deepaccident_devkit.support.arrays import check_least
from deepaccident_devkit.support.text import settle_choices

# What offset and flow have outside instances (`motion.MotionLabelConfig.ignore_index`).
IGNORE_INDEX: Final = 255
# Of a frame's maps as the posterior sees them: segmentation, centerness, offset and flow.
LABEL_CHANNELS: Final = 6
PosteriorIgnore = Literal["keep", "zero"]
POSTERIOR_IGNORES: Final[tuple[PosteriorIgnore, ...]] = ("keep", "zero")
Decoders = Literal["separate", "shuffled"]
# Probabilities of a centre stay so far from 0 and 1.
_CLIP: Final = 1e-4


class MotionTargets(NamedTuple):
    """A batch's motion labels, all frames warped to the present (`V2XConfig(to_present="nearest")`).

    Attributes:
        segmentation: (N, T, H, W) int64, 1 on instances.
        centerness: (N, T, 1, H, W) 1 at the instances' centres, less around them.
        offset: (N, T, 2, H, W) cells to the centre, down the rows and along the columns; 255 = ignored.
        flow: (N, T, 2, H, W) cells to the centre in the next frame, likewise.
        frame_mask: (N, T) bool, the frames that losses count (`frame_mask`).
    """

    segmentation: Tensor
    centerness: Tensor
    offset: Tensor
    flow: Tensor
    frame_mask: Tensor

    def posterior_input(self, *, stride: int, ignore: PosteriorIgnore, ignore_index: int) -> Tensor:
        """The maps of the future frames as channels beside the features.

        Args:
            stride: take every such row and column, the first included.
            ignore: what ignored cells of offset and flow show: `keep` the mark (as released), or `zero`.
            ignore_index: the mark.

        Returns:
            (N, (T − 1) · 6, H / stride, W / stride): frame after frame segmentation, centerness, offset, flow.
        """
        centerness, offset, flow = (
            maps[:, 1:, :, ::stride, ::stride] for maps in (self.centerness, self.offset, self.flow)
        )
        segmentation = self.segmentation[:, 1:, None, ::stride, ::stride].to(centerness.dtype)
        if ignore == "zero":
            offset, flow = (maps.masked_fill(maps == ignore_index, 0) for maps in (offset, flow))
        return torch.cat([segmentation, centerness, offset, flow], dim=2).flatten(1, 2)


def frame_mask(label_valid: Tensor, past_valid: Tensor) -> Tensor:
    """Which label frames losses count: those in the recording, of samples whose past frames all are in it.

    The released rule (`sample_ignore_mode = "past_valid"`).

    Args:
        label_valid: (N, T) bool, the label frames in the recording, from the present on.
        past_valid: (N, P − 1) bool, the frames before the present.

    Returns:
        (N, T) bool.
    """
    return label_valid & past_valid.all(dim=1, keepdim=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionHeadConfig:
    """Sizes and rules of the motion head; the defaults are the released sizes with our rules.

    Attributes:
        in_channels: of the features and of all states.
        latent: channels of the latent.
        future_frames: frames after the present.
        samples: random draws of a prediction; the mean comes on top.
        log_sigma: the smallest and the largest logarithm of a standard deviation.
        decoders: `separate` convolutions for each map, as released, or `shuffled`: one decoder for all maps, in which
            each finer cell has channels of its own.
        hidden: channels of the one decoder; the separate ones have `in_channels`.
        upsample: how many cells of the maps and labels lie along a cell of the features; 1 if separate.
        posterior_ignore: what the posterior sees where offset and flow are ignored: the mark 255 as released (`keep`),
            or `zero`.
        hidden_warp: which state the GRU updates, `none` (as released: the last one in its old place) or `warped`.
        detach: whether gradients stop between a frame and the next, as released.
        ignore_index: the labels' mark (`motion.MotionLabelConfig.ignore_index`).
    """

    in_channels: int = 256
    latent: int = 32
    future_frames: int = 4
    samples: int = 5
    log_sigma: tuple[float, float] = (-5.0, 5.0)
    decoders: Decoders = "separate"
    hidden: int = 24
    upsample: int = 1
    posterior_ignore: PosteriorIgnore = "zero"
    hidden_warp: HiddenWarp = "warped"
    detach: bool = True
    ignore_index: int = IGNORE_INDEX

    def __post_init__(self) -> None:
        """Check the values; raises ConfigError."""
        words = {
            "decoders": get_args(Decoders),
            "posterior_ignore": POSTERIOR_IGNORES,
            "hidden_warp": HIDDEN_WARPS,
        }
        settle_choices(self, words, error=ConfigError)
        check_least(self, in_channels=2, latent=1, future_frames=1, samples=0, hidden=1, upsample=1)
        if not self.log_sigma[0] < self.log_sigma[1]:
            raise ConfigError(
                f"log_sigma: expected the smaller limit first, such as (-5, 5), found {self.log_sigma!r}"
            )
        if self.decoders == "separate" and self.upsample != 1:
            raise ConfigError(
                f"upsample: separate decoders keep the states' resolution, found {self.upsample!r}; choose 1, or "
                "decoders='shuffled'"
            )


class MotionOutputs(NamedTuple):
    """What the motion head returns.

    Attributes:
        maps: with targets, (N, T, …) of one draw from `future`; without, (K, N, T, …) of draws from `present`, the mean
            last.
        present: the latent's distribution, from the features alone.
        future: the posterior, from features and labels; None without targets.
    """

    maps: PredictedMotionMaps
    present: LatentDistribution
    future: LatentDistribution | None


class MotionHead(nn.Module):
    """Iterative flow, BEVerse's motion head (the released `IterativeFlow`)."""

    def __init__(self, config: MotionHeadConfig) -> None:
        """Make the layers that the configuration says."""
        super().__init__()
        self.config = config
        channels, labels = config.in_channels, config.future_frames * LABEL_CHANNELS
        self.task_heads: nn.Module = (
            SeparateDecoders(channels)
            if config.decoders == "separate"
            else ShuffledDecoder(channels, config.hidden, config.upsample)
        )
        self.present_distribution, self.future_distribution = (
            SpatialDistribution(inputs, inputs // 2, config.latent, config.log_sigma)
            for inputs in (channels, channels + labels)
        )
        self.future_prediction = FlowGru(
            channels,
            config.latent,
            config.future_frames,
            hidden_warp=config.hidden_warp,
            detach=config.detach,
        )

    def forward(
        self,
        features: Tensor,
        targets: MotionTargets | None = None,
        *,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> MotionOutputs:
        """Predict the maps of the present and the future frames; with targets as in training, without as in a test.

        Args:
            features: (N, in_channels, H, W), encoded; `upsample` says how much coarser than the motion grid.
            targets: the labels on the motion grid, for a latent from the posterior.
            noise: standard normal, (N, latent, H / 4, W / 4) with targets, (samples, N, …) without; drawn if None.
            generator: draws the noise, on the features' device; None for torch's own.

        Returns:
            Maps and distributions; vectors in cells of the maps.

        Raises:
            GeometryError: targets or noise do not have the shape of the features.
        """
        present = self.present_distribution(features)
        if targets is not None:
            self._check_targets(features, targets)
            config = self.config
            labels = targets.posterior_input(
                stride=config.upsample,
                ignore=config.posterior_ignore,
                ignore_index=config.ignore_index,
            )
            future = self.future_distribution(torch.cat([features, labels.to(features)], dim=1))
            latent = future.sample(future.noise(generator) if noise is None else noise)
            return MotionOutputs(self._decoded(features, latent), present, future)
        # one draw after the other: all at once would need as many times the memory
        draws = [
            self._decoded(features, latent) for latent in self._draws(present, noise, generator)
        ]
        return MotionOutputs(
            PredictedMotionMaps(*map(torch.stack, zip(*draws, strict=True))), present, None
        )

    def _draws(
        self, present: LatentDistribution, noise: Tensor | None, generator: torch.Generator | None
    ) -> Iterator[Tensor]:
        """The latent of each draw and, last, the mean."""
        count = self.config.samples
        if noise is not None and len(noise) != count:
            raise GeometryError(
                f"noise: expected that of {count} draws, found {len(noise)}; change noise or samples"
            )
        for draw in range(count):
            yield present.sample(present.noise(generator) if noise is None else noise[draw])
        yield present.mu

    def _decoded(self, features: Tensor, latent: Tensor) -> PredictedMotionMaps:
        """The maps (N, T, …) of the features with one latent."""
        latent = functional.interpolate(
            latent, size=features.shape[-2:], mode="bilinear", align_corners=False
        )
        future = self.future_prediction(latent, features)
        states = torch.cat([features[:, None], future], dim=1)
        frames = states.shape[:2]
        return PredictedMotionMaps(
            *(each.unflatten(0, frames) for each in self.task_heads(states.flatten(0, 1)))
        )

    def _check_targets(self, features: Tensor, targets: MotionTargets) -> None:
        rows, columns = (self.config.upsample * size for size in features.shape[-2:])
        expected = (len(features), self.config.future_frames + 1, rows, columns)
        if tuple(targets.segmentation.shape) != expected:
            raise GeometryError(
                f"targets: expected segmentation of shape {expected}, found {tuple(targets.segmentation.shape)}; "
                "change the labels' grid or frames, or the head's upsample or future_frames"
            )


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
            raise ConfigError(
                f"top_k: expected a share above 0 and at most 1, found {self.top_k!r}"
            )
        if len(self.class_weights) != 2:
            raise ConfigError(
                f"class_weights: expected those of background and foreground, found {self.class_weights!r}"
            )


def motion_losses(
    outputs: MotionOutputs, targets: MotionTargets, config: MotionLossConfig
) -> dict[str, Tensor]:
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
        raise NotAvailableError(
            "outputs: expected those of a call with targets, found no posterior; give the targets"
        )
    maps, mask = outputs.maps, targets.frame_mask
    losses = {
        "seg": config.segmentation
        * segmentation_loss(maps.segmentation, targets.segmentation, mask, config),
        "centerness": config.centerness
        * center_loss(maps.instance_center, targets.centerness, mask, config),
        "offset": config.offset * vector_loss(maps.instance_offset, targets.offset, mask, config),
        "flow": config.flow * vector_loss(maps.instance_flow, targets.flow, mask, config),
        "prob": config.prob * latent_loss(outputs.present, outputs.future, mask.any(dim=1)),
    }
    return {f"motion_{name}": loss for name, loss in losses.items()}


def segmentation_loss(
    logits: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig
) -> Tensor:
    """Weighted cross entropy of each frame's hardest cells of (N, T, 2, H, W), averaged over all that are kept.

    The target is (N, T, H, W) int64, whose ignored cells have no loss; the mask (N, T) bool.
    """
    logits = precise(logits)
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


def center_loss(
    logits: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig
) -> Tensor:
    """Gaussian focal loss (CornerNet, arXiv:1808.01244) of (N, T, 1, H, W), over the discounted number of centres."""
    logits = precise(logits)
    likely = logits.sigmoid().clamp(_CLIP, 1 - _CLIP)
    center = target == 1
    hit = -likely.log() * (1 - likely).square()
    miss = -(1 - likely).log() * likely.square() * (1 - target.to(logits)).pow(4)
    weight = torch.where(frame_mask, _discounts(logits, config), 0)
    loss = (torch.where(center, hit, miss).flatten(2).sum(dim=2) * weight).sum()
    return loss / (center.flatten(2).sum(dim=2) * weight).sum().clamp(min=1)


def vector_loss(
    vectors: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig
) -> Tensor:
    """Absolute error of (N, T, 2, H, W), cells, summed over both channels, averaged over cells that are not ignored.

    A cell is ignored if either channel of the target has the mark; the frames' mask is (N, T) bool.
    """
    vectors = precise(vectors)
    error = (vectors - target.to(vectors)).abs().sum(dim=2) * _discounts(vectors, config)[
        :, None, None
    ]
    return _mean(error, (target != config.ignore_index).all(dim=2) & frame_mask[:, :, None, None])


def latent_loss(
    present: LatentDistribution, future: LatentDistribution, sample_mask: Tensor
) -> Tensor:
    """The divergence KL(future ‖ present): what the posterior says that the present's distribution does not.

    Summed over the latent's channels, averaged over its cells and over the samples in `sample_mask` (N,) bool.
    """
    mu, log_sigma = (precise(each) for each in present)
    future_mu, future_log_sigma = (precise(each) for each in future)
    spread = (2 * (future_log_sigma - log_sigma)).exp() + (
        (future_mu - mu) * (-log_sigma).exp()
    ).square()
    divergence = (log_sigma - future_log_sigma + (spread - 1) / 2).sum(dim=1)
    return _mean(divergence, sample_mask[:, None, None].expand_as(divergence))


def _discounts(like: Tensor, config: MotionLossConfig) -> Tensor:
    """(T,) the weight of each frame of maps (N, T, …)."""
    return torch.pow(
        config.discount, torch.arange(like.shape[1], device=like.device, dtype=like.dtype)
    )


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """The mean of the values in the mask; zero, with zero gradients, if there are none."""
    return torch.where(mask, values, 0).sum() / mask.sum().clamp(min=1)
