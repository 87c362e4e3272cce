"""The motion head: a latent, future states of the BEV features, maps, labels and losses."""

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
from deepaccident_devkit.support.arrays import check_minima
from deepaccident_devkit.support.text import settle_choices

# Value of offset and flow outside instances (`motion.MotionLabelConfig.ignore_index`).
IGNORE_INDEX: Final = 255
# Channels of a frame's maps in the posterior: segmentation, centerness, offset and flow.
LABEL_CHANNELS: Final = 6
PosteriorIgnore = Literal["keep", "zero"]
POSTERIOR_IGNORES: Final[tuple[PosteriorIgnore, ...]] = ("keep", "zero")
Decoders = Literal["separate", "shuffled"]
# Smallest distance of a centre's probability from 0 and 1.
_MIN_PROBABILITY = 1e-4


class MotionTargets(NamedTuple):
    """The motion labels of a batch, with all frames warped to the present.

    They are read with `V2XConfig(to_present="nearest")`.

    Attributes:
        segmentation: 1 on instances, (N, T, H, W) int64.
        centerness: 1 at the instances' centres, falling off around them, shape (N, T, 1, H, W).
        offset: Cells to the centre, down the rows and along the columns, shape (N, T, 2, H, W); 255
            = ignored.
        flow: Cells to the centre in the next frame, as `offset`.
        frame_mask: Whether losses include each frame (`frame_mask`), (N, T) bool.
    """

    segmentation: Tensor
    centerness: Tensor
    offset: Tensor
    flow: Tensor
    frame_mask: Tensor

    def posterior_input(self, *, stride: int, ignore: PosteriorIgnore, ignore_index: int) -> Tensor:
        """Stack the maps of the future frames as additional channels of the features.

        Args:
            stride: Step between the rows and columns that are used, starting with the first.
            ignore: Value in ignored cells of offset and flow: `keep` the mark (as released), or
                `zero`.
            ignore_index: The mark.

        Returns:
            Segmentation, centerness, offset, flow, frame after frame, shape (N, (T − 1) · 6, H /
            stride, W / stride).
        """
        segmentation = _thin_future_maps(self.segmentation[:, :, None], stride)
        centerness = _thin_future_maps(self.centerness, stride)
        offset = _thin_future_maps(self.offset, stride)
        flow = _thin_future_maps(self.flow, stride)
        if ignore == "zero":
            offset = offset.masked_fill(offset == ignore_index, 0)
            flow = flow.masked_fill(flow == ignore_index, 0)
        segmentation = segmentation.to(centerness.dtype)
        maps = torch.cat([segmentation, centerness, offset, flow], dim=2)
        return maps.flatten(1, 2)


def _thin_future_maps(maps: Tensor, stride: int) -> Tensor:
    """Drop the present from maps (N, T, C, H, W), and keep every `stride`-th row and column."""
    return maps[:, 1:, :, ::stride, ::stride]


def frame_mask(label_valid: Tensor, past_valid: Tensor) -> Tensor:
    """Return whether losses include each label frame, (N, T) bool.

    They include the frames that are in the recording, of samples whose past frames are all in it.
    This is the released rule (`sample_ignore_mode = "past_valid"`).

    Args:
        label_valid: Whether each label frame, from the present on, is in the recording, (N, T)
            bool.
        past_valid: Whether each frame before the present is in the recording, (N, P − 1) bool.
    """
    has_whole_past = past_valid.all(dim=1, keepdim=True)
    return label_valid & has_whole_past


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionHeadConfig:
    """Sizes and rules of the motion head; the defaults are the released sizes with our rules.

    Attributes:
        in_channels: Channels of the features and of all states.
        latent: Channels of the latent.
        future_frames: Number of frames after the present.
        samples: Number of random draws per prediction; the mean comes in addition.
        log_sigma: The smallest and the largest logarithm of a standard deviation.
        decoders: `separate` convolutions for each map, as released, or a `shuffled` decoder of all
            maps, with separate channels for each finer cell.
        hidden: Channels of the shuffled decoder; the separate ones have `in_channels`.
        upsample: Number of map and label cells along the side of a feature cell; 1 for separate
            decoders.
        posterior_ignore: Value that the posterior sees in ignored cells of offset and flow: the
            mark 255 as released (`keep`), or `zero`.
        hidden_warp: Previous state that the GRU updates: `none` leaves it in place, as released;
            `warped` warps it with the flow.
        detach: Whether gradients stop between consecutive frames, as released.
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
        """Check the values; raise ConfigError if one is not valid."""
        words = {
            "decoders": get_args(Decoders),
            "posterior_ignore": POSTERIOR_IGNORES,
            "hidden_warp": HIDDEN_WARPS,
        }
        settle_choices(self, words, error=ConfigError)
        check_minima(
            self, in_channels=2, latent=1, future_frames=1, samples=0, hidden=1, upsample=1
        )
        smallest, largest = self.log_sigma
        if not smallest < largest:
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
        channels = config.in_channels
        latent = config.latent
        self.task_heads: nn.Module
        if config.decoders == "separate":
            self.task_heads = SeparateDecoders(channels)
        else:
            self.task_heads = ShuffledDecoder(channels, config.hidden, config.upsample)
        self.present_distribution = SpatialDistribution(
            channels, channels // 2, latent, config.log_sigma
        )
        all_channels = channels + config.future_frames * LABEL_CHANNELS
        self.future_distribution = SpatialDistribution(
            all_channels, all_channels // 2, latent, config.log_sigma
        )
        self.future_prediction = FlowGru(
            channels,
            latent,
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

        With targets, it predicts as in training; without targets, as at test time.

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
            if noise is None:
                noise = future.noise(generator)
            maps = self._decode(features, future.sample(noise))
            return MotionOutputs(maps, present, future)
        draws = []
        # Decode one draw after another: all draws at once would need several times the memory.
        for latent in self._draw_latents(present, noise, generator):
            draws.append(self._decode(features, latent))
        stacked_maps = [torch.stack(maps) for maps in zip(*draws, strict=True)]
        return MotionOutputs(PredictedMotionMaps(*stacked_maps), present, None)

    def _draw_latents(
        self, present: LatentDistribution, noise: Tensor | None, generator: torch.Generator | None
    ) -> Iterator[Tensor]:
        """Yield the latent of each draw and, last, the mean."""
        count = self.config.samples
        if noise is not None and len(noise) != count:
            raise GeometryError(
                f"noise: expected noise for {count} draws, found {len(noise)}; change noise or "
                "samples"
            )
        for draw in range(count):
            if noise is None:
                draw_noise = present.noise(generator)
            else:
                draw_noise = noise[draw]
            yield present.sample(draw_noise)
        yield present.mu

    def _decode(self, features: Tensor, latent: Tensor) -> PredictedMotionMaps:
        """Return the maps (N, T, …) of the features with one latent."""
        latent = functional.interpolate(
            latent, features.shape[-2:], mode="bilinear", align_corners=False
        )
        future = self.future_prediction(latent, features)
        states = torch.cat([features[:, None], future], dim=1)
        maps = self.task_heads(states.flatten(0, 1))
        frame_maps = [tensor.unflatten(0, states.shape[:2]) for tensor in maps]
        return PredictedMotionMaps(*frame_maps)

    def _check_targets(self, features: Tensor, targets: MotionTargets) -> None:
        """Raise GeometryError unless the targets fit the features."""
        samples, _, rows, columns = features.shape
        config = self.config
        frames = config.future_frames + 1
        expected = (samples, frames, config.upsample * rows, config.upsample * columns)
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
        """Check the values; raise ConfigError if one is not valid."""
        if not 0 < self.top_k <= 1:
            raise ConfigError(
                f"top_k: expected a share above 0 and at most 1, found {self.top_k!r}"
            )
        if len(self.class_weights) != 2:
            raise ConfigError(
                "class_weights: expected the weights of background and foreground, found "
                f"{self.class_weights!r}"
            )


def motion_losses(
    outputs: MotionOutputs, targets: MotionTargets, config: MotionLossConfig
) -> dict[str, Tensor]:
    """Compute all weighted losses of a batch, as scalars.

    Their names are `motion_seg`, `motion_centerness`, `motion_offset`, `motion_flow` and
    `motion_prob`. Frames that `targets.frame_mask` excludes are ignored. If nothing is left, a loss
    is zero, with zero gradients.

    Args:
        outputs: Outputs of a call with targets.
        targets: Targets that the call had.
        config: Rules and weights.

    Raises:
        NotAvailableError: The outputs come from a call without targets.
    """
    if outputs.future is None:
        raise NotAvailableError(
            "outputs: expected the outputs of a forward pass with targets, found no "
            "posterior; pass the targets to the forward pass"
        )
    maps = outputs.maps
    mask = targets.frame_mask
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
    losses = losses.flatten(1)
    count = max(int(config.top_k * losses.shape[1]), 1)
    hardest = losses.topk(count, sorted=False).values
    frame_losses = hardest.mean(dim=1).unflatten(0, frame_mask.shape)
    return _average_masked(frame_losses * _discount_frames(logits, config), frame_mask)


def center_loss(
    logits: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig
) -> Tensor:
    """Return the Gaussian focal loss, divided by the discounted number of centres.

    CornerNet, arXiv:1808.01244. Logits and target are (N, T, 1, H, W).
    """
    logits = precise(logits)
    probability = logits.sigmoid().clamp(_MIN_PROBABILITY, 1 - _MIN_PROBABILITY)
    is_center = target == 1
    complement = 1 - probability
    center_losses = -probability.log() * complement.square()
    distance = 1 - target.to(logits)
    other_losses = -complement.log() * probability.square() * distance.pow(4)
    losses = torch.where(is_center, center_losses, other_losses)
    weight = torch.where(frame_mask, _discount_frames(logits, config), 0)
    loss = (losses.flatten(2).sum(dim=2) * weight).sum()
    center_count = (is_center.flatten(2).sum(dim=2) * weight).sum()
    return loss / center_count.clamp(min=1)


def vector_loss(
    vectors: Tensor, target: Tensor, frame_mask: Tensor, config: MotionLossConfig
) -> Tensor:
    """Return the absolute error of vectors (N, T, 2, H, W) in cells, averaged over counted cells.

    Errors of both channels are added. A cell is ignored if either channel of the target has the
    mark; the frames' mask is (N, T) bool.
    """
    vectors = precise(vectors)
    distances = (vectors - target.to(vectors)).abs().sum(dim=2)
    discounts = _discount_frames(vectors, config)[:, None, None]
    is_known = (target != config.ignore_index).all(dim=2)
    is_counted = is_known & frame_mask[:, :, None, None]
    return _average_masked(distances * discounts, is_counted)


def latent_loss(
    present: LatentDistribution, future: LatentDistribution, sample_mask: Tensor
) -> Tensor:
    """Return the divergence KL(future ‖ present) of the posterior from the present's distribution.

    The divergence is summed over the latent's channels, and averaged over its cells and over the
    samples in `sample_mask` (N,) bool.
    """
    mu = precise(present.mu)
    log_sigma = precise(present.log_sigma)
    future_mu = precise(future.mu)
    future_log_sigma = precise(future.log_sigma)
    variance_ratio = (2 * (future_log_sigma - log_sigma)).exp()
    scaled_difference = (future_mu - mu) * (-log_sigma).exp()
    spread = variance_ratio + scaled_difference.square()
    divergence = log_sigma - future_log_sigma + (spread - 1) / 2
    divergence = divergence.sum(dim=1)
    is_counted = sample_mask[:, None, None].expand_as(divergence)
    return _average_masked(divergence, is_counted)


def _discount_frames(maps: Tensor, config: MotionLossConfig) -> Tensor:
    """Return the weight of each frame of maps (N, T, …), shape (T,)."""
    frames = maps.shape[1]
    steps = torch.arange(frames, device=maps.device, dtype=maps.dtype)
    return torch.pow(config.discount, steps)


def _average_masked(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of the values in the mask; zero, with zero gradients, if there are none."""
    total = torch.where(mask, values, 0).sum()
    return total / mask.sum().clamp(min=1)
