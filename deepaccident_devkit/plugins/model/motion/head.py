"""The motion head: a latent, future states of the BEV features, maps, labels and losses."""

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

# Value of offset and flow outside instances (`motion.MotionLabelConfig.ignore_index`).
IGNORE_INDEX: Final = 255
# Channels of a frame's maps in the posterior: segmentation, centerness, offset and flow.
LABEL_CHANNELS: Final = 6
PosteriorIgnore = Literal["keep", "zero"]
POSTERIOR_IGNORES: Final[tuple[PosteriorIgnore, ...]] = ("keep", "zero")
Decoders = Literal["separate", "shuffled"]
# Smallest distance of a centre's probability from 0 and 1.
_MIN_PROBABILITY: Final = 1e-4


class MotionTargets(NamedTuple):
    """A batch's motion labels, all frames warped to the present.

    They are read with `V2XConfig(to_present="nearest")`.

    Attributes:
        segmentation: 1 on instances, (N, T, H, W) int64.
        centerness: 1 at the instances' centres, less around them, shape (N, T, 1, H, W).
        offset: Cells to the centre, down the rows and along the columns, shape (N, T, 2, H, W); 255
            = ignored.
        flow: Cells to the centre in the next frame, as `offset`.
        frame_mask: The frames that losses count (`frame_mask`), (N, T) bool.
    """

    segmentation: Tensor
    centerness: Tensor
    offset: Tensor
    flow: Tensor
    frame_mask: Tensor

    def posterior_input(self, *, stride: int, ignore: PosteriorIgnore, ignore_index: int) -> Tensor:
        """Return the maps of the future frames as additional channels of the features.

        Args:
            stride: Step between the rows and columns that are used, beginning with the first.
            ignore: Value in ignored cells of offset and flow: `keep` the mark (as released), or
                `zero`.
            ignore_index: The mark.

        Returns:
            Segmentation, centerness, offset, flow, frame after frame, shape (N, (T − 1) · 6, H /
            stride, W / stride).
        """
        centerness, offset, flow = (
            maps[:, 1:, :, ::stride, ::stride] for maps in (self.centerness, self.offset, self.flow)
        )
        segmentation = self.segmentation[:, 1:, None, ::stride, ::stride].to(centerness.dtype)
        if ignore == "zero":
            offset, flow = (maps.masked_fill(maps == ignore_index, 0) for maps in (offset, flow))
        return torch.cat([segmentation, centerness, offset, flow], dim=2).flatten(1, 2)


def frame_mask(label_valid: Tensor, past_valid: Tensor) -> Tensor:
    """Return the label frames that losses count, (N, T) bool.

    These are frames in the recording, of samples with all past frames in it. This is the released
    rule (`sample_ignore_mode = "past_valid"`).

    Args:
        label_valid: Whether each label frame, from the present on, is in the recording, (N, T)
            bool.
        past_valid: Whether each frame before the present is in the recording, (N, P − 1) bool.
    """
    return label_valid & past_valid.all(dim=1, keepdim=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionHeadConfig:
    """Sizes and rules of the motion head; the defaults are the released sizes with our rules.

    Attributes:
        in_channels: Channels of the features and of all states.
        latent: Channels of the latent.
        future_frames: Number of frames after the present.
        samples: Number of random draws of a prediction; the mean is additional.
        log_sigma: The smallest and the largest logarithm of a standard deviation.
        decoders: `separate` convolutions for each map, as released, or `shuffled`: one decoder for
            all maps, with separate channels for each finer cell.
        hidden: Channels of the shuffled decoder; the separate ones have `in_channels`.
        upsample: Number of the maps' and labels' cells along a cell of the features; 1 if separate.
        posterior_ignore: Value that the posterior sees in ignored cells of offset and flow: the
            mark 255 as released (`keep`), or `zero`.
        hidden_warp: State that the GRU updates, `none` (as released: the previous one in its old
            place) or `warped`.
        detach: Whether gradients stop between a frame and the next, as released.
        ignore_index: The labels' mark (`motion.MotionLabelConfig.ignore_index`).
    """

    # Sizes.
    in_channels: int = 256
    latent: int = 32
    future_frames: int = 4
    samples: int = 5
    log_sigma: tuple[float, float] = (-5.0, 5.0)
    # Decoders.
    decoders: Decoders = "separate"
    hidden: int = 24
    upsample: int = 1
    # Rules.
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
                "log_sigma: expected the smaller limit first, such as (-5, 5), found "
                f"{self.log_sigma!r}"
            )
        if self.decoders == "separate" and self.upsample != 1:
            raise ConfigError(
                "upsample: separate decoders keep the states' resolution, found "
                f"{self.upsample!r}; choose 1, or decoders='shuffled'"
            )


class MotionOutputs(NamedTuple):
    """The result of the motion head.

    Attributes:
        maps: With targets, maps of one draw from `future`, (N, T, …); without, maps of draws from
            `present`, the mean last, (K, N, T, …).
        present: Distribution of the latent that follows from the features.
        future: The posterior, from features and labels; None without targets.
    """

    maps: PredictedMotionMaps
    present: LatentDistribution
    future: LatentDistribution | None


class MotionHead(nn.Module):
    """Iterative flow, BEVerse's motion head (the released `IterativeFlow`)."""

    def __init__(self, config: MotionHeadConfig) -> None:
        """Build the layers of a configuration."""
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
        """Predict the maps of the present and the future frames.

        With targets it predicts as in training, without targets as in a test.

        Args:
            features: Encoded features, coarser than the motion grid by the factor `upsample`, shape
                (N, in_channels, H, W).
            targets: Labels on the motion grid, for a latent from the posterior.
            noise: Standard normal noise, (N, latent, H / 4, W / 4) with targets, (samples, N, …)
                without; drawn if None.
            generator: Generator of the noise, on the features' device; None for torch's own.

        Returns:
            Maps and distributions; vectors in cells of the maps.

        Raises:
            GeometryError: Targets or noise do not have the shape of the features.
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
        # One draw after the other, because all draws together would need several times the memory.
        draws = [
            self._decoded(features, latent) for latent in self._draws(present, noise, generator)
        ]
        maps = PredictedMotionMaps(*map(torch.stack, zip(*draws, strict=True)))
        return MotionOutputs(maps, present, None)

    def _draws(
        self, present: LatentDistribution, noise: Tensor | None, generator: torch.Generator | None
    ) -> Iterator[Tensor]:
        """Yield the latent of each draw and, last, the mean."""
        count = self.config.samples
        if noise is not None and len(noise) != count:
            raise GeometryError(
                f"noise: expected that of {count} draws, found {len(noise)}; change noise or "
                "samples"
            )
        for draw in range(count):
            yield present.sample(present.noise(generator) if noise is None else noise[draw])
        yield present.mu

    def _decoded(self, features: Tensor, latent: Tensor) -> PredictedMotionMaps:
        """Return the maps (N, T, …) of the features with one latent."""
        latent = functional.interpolate(
            latent, size=features.shape[-2:], mode="bilinear", align_corners=False
        )
        future = self.future_prediction(latent, features)
        states = torch.cat([features[:, None], future], dim=1)
        maps = self.task_heads(states.flatten(0, 1))
        return PredictedMotionMaps(*(tensor.unflatten(0, states.shape[:2]) for tensor in maps))

    def _check_targets(self, features: Tensor, targets: MotionTargets) -> None:
        rows, columns = (self.config.upsample * size for size in features.shape[-2:])
        expected = (len(features), self.config.future_frames + 1, rows, columns)
        shape = tuple(targets.segmentation.shape)
        if shape != expected:
            raise GeometryError(
                f"targets: expected segmentation of shape {expected}, found {shape}; change the "
                "labels' grid or frames, or the head's upsample or future_frames"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionLossConfig:
    """Rules and weights of the motion losses; the defaults are the released ones.

    Attributes:
        class_weights: Weights of background and foreground in the segmentation's cross entropy.
        top_k: Share of a frame's cells that counts in the cross entropy: the hardest cells.
        discount: Weight of a frame relative to the previous one.
        segmentation: Weight of the segmentation's loss.
        centerness: Weight of the centres' loss.
        offset: Weight of the offsets' loss.
        flow: Weight of the flows' loss.
        prob: Weight of the divergence of the latent's distributions.
        ignore_index: The labels' mark of ignored cells (`motion.MotionLabelConfig.ignore_index`).
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
                "class_weights: expected those of background and foreground, found "
                f"{self.class_weights!r}"
            )


def motion_losses(
    outputs: MotionOutputs, targets: MotionTargets, config: MotionLossConfig
) -> dict[str, Tensor]:
    """Return all weighted losses of a batch as scalars.

    They are `motion_seg`, `_centerness`, `_offset`, `_flow` and `_prob`. Frames that
    `targets.frame_mask` leaves out do not count. If nothing counts, a loss is zero, with zero
    gradients.

    Args:
        outputs: Outputs of a call with targets.
        targets: The same targets.
        config: Rules and weights.

    Raises:
        NotAvailableError: The outputs are of a call without targets.
    """
    if outputs.future is None:
        raise NotAvailableError(
            "outputs: expected those of a call with targets, found no posterior; give the targets"
        )
    maps, mask = outputs.maps, targets.frame_mask
    seg = segmentation_loss(maps.segmentation, targets.segmentation, mask, config)
    losses = {"motion_seg": config.segmentation * seg}
    centerness = center_loss(maps.instance_center, targets.centerness, mask, config)
    losses["motion_centerness"] = config.centerness * centerness
    offset = vector_loss(maps.instance_offset, targets.offset, mask, config)
    losses["motion_offset"] = config.offset * offset
    flow = vector_loss(maps.instance_flow, targets.flow, mask, config)
    losses["motion_flow"] = config.flow * flow
    prob = latent_loss(outputs.present, outputs.future, mask.any(dim=1))
    losses["motion_prob"] = config.prob * prob
    return losses


def segmentation_loss(
    logits: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig
) -> Tensor:
    """Return the weighted cross entropy of each frame's hardest cells, averaged over frames.

    Logits are (N, T, 2, H, W), the target is (N, T, H, W) int64, and its ignored cells have no
    loss; frames outside the mask (N, T) bool do not count.
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
    count = max(int(config.top_k * cells.shape[1]), 1)
    hardest = cells.topk(count, sorted=False).values
    per_frame = hardest.mean(dim=1).unflatten(0, frame_mask.shape) * _discounts(logits, config)
    return _mean(per_frame, frame_mask)


def center_loss(
    logits: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig
) -> Tensor:
    """Return the Gaussian focal loss over the discounted number of centres.

    CornerNet, arXiv:1808.01244. Logits and target are (N, T, 1, H, W).
    """
    logits = precise(logits)
    probability = logits.sigmoid().clamp(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    is_center = target == 1
    center_losses = -probability.log() * (1 - probability).square()
    other_losses = -(1 - probability).log() * probability.square() * (1 - target.to(logits)).pow(4)
    weight = torch.where(frame_mask, _discounts(logits, config), 0)
    losses = torch.where(is_center, center_losses, other_losses)
    loss = (losses.flatten(2).sum(dim=2) * weight).sum()
    return loss / (is_center.flatten(2).sum(dim=2) * weight).sum().clamp(min=1)


def vector_loss(
    vectors: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig
) -> Tensor:
    """Return the absolute error of vectors (N, T, 2, H, W) in cells, averaged over counted cells.

    Errors of both channels are added. A cell is ignored if either channel of the target has the
    mark; the frames' mask is (N, T) bool.
    """
    vectors = precise(vectors)
    distances = (vectors - target.to(vectors)).abs().sum(dim=2)
    errors = distances * _discounts(vectors, config)[:, None, None]
    is_known = (target != config.ignore_index).all(dim=2)
    return _mean(errors, is_known & frame_mask[:, :, None, None])


def latent_loss(
    present: LatentDistribution, future: LatentDistribution, sample_mask: Tensor
) -> Tensor:
    """Return the divergence KL(future ‖ present) of the posterior from the present's distribution.

    It is summed over the latent's channels, and averaged over its cells and over the samples in
    `sample_mask` (N,) bool.
    """
    mu, log_sigma = (precise(tensor) for tensor in present)
    future_mu, future_log_sigma = (precise(tensor) for tensor in future)
    spread = (2 * (future_log_sigma - log_sigma)).exp() + (
        (future_mu - mu) * (-log_sigma).exp()
    ).square()
    divergence = (log_sigma - future_log_sigma + (spread - 1) / 2).sum(dim=1)
    return _mean(divergence, sample_mask[:, None, None].expand_as(divergence))


def _discounts(maps: Tensor, config: MotionLossConfig) -> Tensor:
    """Return the weight of each frame of maps (N, T, …), shape (T,)."""
    steps = torch.arange(maps.shape[1], device=maps.device, dtype=maps.dtype)
    return torch.pow(config.discount, steps)


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of the values in the mask; zero, with zero gradients, if there are none."""
    return torch.where(mask, values, 0).sum() / mask.sum().clamp(min=1)
