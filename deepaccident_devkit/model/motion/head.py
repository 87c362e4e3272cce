"""The motion head: a latent, the future states of the BEV features, and the maps that are read off each; its labels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.model.motion.decoders import (
    HIDDEN_WARPS,
    FlowGru,
    HiddenWarp,
    LatentDistribution,
    MotionMaps,
    SeparateDecoders,
    SharedDecoder,
    SpatialDistribution,
)
from deepaccident_devkit.support.arrays import check_least
from deepaccident_devkit.support.text import settle_choices

IGNORE_INDEX: Final = 255
"""What offset and flow have outside instances (`motion.MotionLabelConfig.ignore_index`)."""
LABEL_CHANNELS: Final = 6
"""Of a frame's maps as the posterior sees them: segmentation, centerness, offset and flow."""
PosteriorIgnore = Literal["keep", "zero"]
POSTERIOR_IGNORES: Final[tuple[PosteriorIgnore, ...]] = ("keep", "zero")


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


Decoders = Literal["separate", "shared"]
_DECODERS: Final[tuple[Decoders, ...]] = ("separate", "shared")


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionHeadConfig:
    """Sizes and rules of the motion head; the defaults are the released sizes with our rules.

    Attributes:
        in_channels: of the features and of all states.
        latent: channels of the latent.
        future_frames: frames after the present.
        samples: random draws of a prediction; the mean comes on top.
        log_sigma: the smallest and the largest logarithm of a standard deviation.
        decoders: `separate` convolutions for each map, as released, or `shared` ones.
        hidden: channels of the shared decoder; the separate ones have `in_channels`.
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
        words = {"decoders": _DECODERS, "posterior_ignore": POSTERIOR_IGNORES, "hidden_warp": HIDDEN_WARPS}
        settle_choices(self, words, error=ConfigError)
        check_least(self, in_channels=2, latent=1, future_frames=1, samples=0, hidden=1, upsample=1)
        if not self.log_sigma[0] < self.log_sigma[1]:
            raise ConfigError(f"log_sigma: expected the smaller limit first, such as (-5, 5), found {self.log_sigma!r}")
        if self.decoders == "separate" and self.upsample != 1:
            raise ConfigError(
                f"upsample: separate decoders keep the states' resolution, found {self.upsample!r}; choose 1, or "
                "decoders='shared'"
            )


class MotionOutputs(NamedTuple):
    """What the motion head returns.

    Attributes:
        maps: with targets, (N, T, …) of one draw from `future`; without, (K, N, T, …) of draws from `present`, the mean
            last.
        present: the latent's distribution, from the features alone.
        future: the posterior, from features and labels; None without targets.
    """

    maps: MotionMaps
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
            else SharedDecoder(channels, config.hidden, config.upsample)
        )
        self.present_distribution, self.future_distribution = (
            SpatialDistribution(inputs, inputs // 2, config.latent, config.log_sigma)
            for inputs in (channels, channels + labels)
        )
        self.future_prediction = FlowGru(
            channels, config.latent, config.future_frames, hidden_warp=config.hidden_warp, detach=config.detach
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
                stride=config.upsample, ignore=config.posterior_ignore, ignore_index=config.ignore_index
            )
            future = self.future_distribution(torch.cat([features, labels.to(features)], dim=1))
            latent = future.sample(future.noise(generator) if noise is None else noise)
            return MotionOutputs(self._decoded(features, latent), present, future)
        # one draw after the other: all at once would need as many times the memory
        draws = [self._decoded(features, latent) for latent in self._draws(present, noise, generator)]
        return MotionOutputs(MotionMaps(*map(torch.stack, zip(*draws, strict=True))), present, None)

    def _draws(
        self, present: LatentDistribution, noise: Tensor | None, generator: torch.Generator | None
    ) -> Iterator[Tensor]:
        """The latent of each draw and, last, the mean."""
        count = self.config.samples
        if noise is not None and len(noise) != count:
            raise GeometryError(f"noise: expected that of {count} draws, found {len(noise)}; change noise or samples")
        for draw in range(count):
            yield present.sample(present.noise(generator) if noise is None else noise[draw])
        yield present.mu

    def _decoded(self, features: Tensor, latent: Tensor) -> MotionMaps:
        """The maps (N, T, …) of the features with one latent."""
        latent = functional.interpolate(latent, size=features.shape[-2:], mode="bilinear", align_corners=False)
        future = self.future_prediction(latent, features)
        states = torch.cat([features[:, None], future], dim=1)
        frames = states.shape[:2]
        return MotionMaps(*(each.unflatten(0, frames) for each in self.task_heads(states.flatten(0, 1))))

    def _check_targets(self, features: Tensor, targets: MotionTargets) -> None:
        rows, columns = (self.config.upsample * size for size in features.shape[-2:])
        expected = (len(features), self.config.future_frames + 1, rows, columns)
        if tuple(targets.segmentation.shape) != expected:
            raise GeometryError(
                f"targets: expected segmentation of shape {expected}, found {tuple(targets.segmentation.shape)}; "
                "change the labels' grid or frames, or the head's upsample or future_frames"
            )
