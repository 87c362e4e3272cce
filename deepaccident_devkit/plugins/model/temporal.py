"""Temporal models: one agent's past and present BEV maps → one map of the present.

They run before any fusion. The layers are the released TemporalBlock and Bottleneck3D, which the
release took from FIERY. The temporal model applies them over frames, and the unused part of the
released fusion over agents. Attributes have the names of the released state dict.

Both models take the same arguments; `temporal_model` builds the model that a config names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.plugins.model.warps import (
    Chain,
    FeatureWarpRule,
    between_augmented,
    matrices_from_six,
    present_from_past_batch,
    six_from_matrices,
    warp_features,
)
from deepaccident_devkit.support.text import settle_choices

# Channels that the egomotion occupies: a 6-vector, the same in all cells.
EGOMOTION_CHANNELS = 6


class ConvBnRelu3d(nn.Module):
    """A convolution without bias, a batch norm and a ReLU; T, H and W stay the same.

    The convolution's kernel is (steps, rows, columns).
    """

    def __init__(
        self, in_channels: int, out_channels: int, kernel: tuple[int, int, int] = (1, 1, 1)
    ) -> None:
        super().__init__()
        padding = (0, kernel[1] // 2, kernel[2] // 2)
        self.conv = nn.Conv3d(in_channels, out_channels, kernel, padding=padding, bias=False)
        self.norm = nn.BatchNorm3d(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Transform (B, C, T, H, W) to (B, C', T, H, W); steps before the first one are zeros."""
        padding_steps = self.conv.kernel_size[0] - 1
        if padding_steps:
            x = functional.pad(x, (0, 0, 0, 0, padding_steps, 0))
        x = self.norm(self.conv(x))
        return functional.relu(x)


class PooledStep(nn.Module):
    """The mean over the map and two successive steps, after a 1×1×1 convolution, in every cell."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv_bn_relu = ConvBnRelu3d(in_channels, out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Transform (B, C, T, H, W) to (B, C', T, H, W); the first step is its own mean.

        As in the released code, an additional step (the mean of only the last step) contributes to
        the batch statistics.
        """
        means = x.mean((-2, -1), keepdim=True)
        first_mean = means[:, :, :1]
        pair_sums = means[:, :, 1:] + means[:, :, :-1]
        last_mean = means[:, :, -1:]
        padded_means = torch.cat([first_mean, pair_sums / 2, last_mean], 2)
        pooled = self.conv_bn_relu(padded_means)[:, :, :-1]
        rows, columns = x.shape[-2:]
        return pooled.expand(-1, -1, -1, rows, columns)


class PyramidPooling(nn.Module):
    """The released pyramid pooling, whose only level is the complete map."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.features = nn.ModuleList([PooledStep(in_channels, out_channels)])

    def forward(self, x: Tensor) -> Tensor:
        """Transform (B, C, T, H, W) to (B, C', T, H, W)."""
        pooled = [level(x) for level in self.features]
        return torch.cat(pooled, 1)


class TemporalBlock(nn.Module):
    """Three convolution paths and a pooled one over two successive steps, added to the input."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        half = in_channels // 2
        third = in_channels // 3
        self.convolution_paths = nn.ModuleList()
        for kernel in ((2, 3, 3), (1, 3, 3)):
            projection = ConvBnRelu3d(in_channels, half)
            convolution = ConvBnRelu3d(half, half, kernel)
            self.convolution_paths.append(nn.Sequential(projection, convolution))
        self.convolution_paths.append(ConvBnRelu3d(in_channels, half))
        self.pyramid_pooling = PyramidPooling(in_channels, third)
        self.aggregation = nn.Sequential(ConvBnRelu3d(3 * half + third, out_channels))
        self.projection: nn.Module = nn.Identity()
        if in_channels != out_channels:
            projection_conv = nn.Conv3d(in_channels, out_channels, 1, bias=False)
            self.projection = nn.Sequential(projection_conv, nn.BatchNorm3d(out_channels))

    def forward(self, x: Tensor) -> Tensor:
        """Transform (B, C, T, H, W) to (B, C', T, H, W)."""
        paths = [path(x) for path in self.convolution_paths]
        projected = self.projection(x)
        paths.append(self.pyramid_pooling(x))
        return projected + self.aggregation(torch.cat(paths, 1))


class Bottleneck3d(nn.Module):
    """Convolutions to half the channels, over 1×3×3 cells, and back; added to the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        half = channels // 2
        self.layers = nn.Sequential()
        self.layers.add_module("conv_down_project", ConvBnRelu3d(channels, half))
        self.layers.add_module("conv", ConvBnRelu3d(half, half, (1, 3, 3)))
        self.layers.add_module("conv_up_project", ConvBnRelu3d(half, channels))

    def forward(self, x: Tensor) -> Tensor:
        """Transform (B, C, T, H, W); return the same shape."""
        return x + self.layers(x)


EgomotionInput = Literal["raw", "augmented"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TemporalConfig:
    """Sizes and rules of a temporal model.

    Attributes:
        channels: Channels C of the input and output maps.
        grid: Cells of the maps.
        frames: Number P of frames, including the present.
        kind: `blocks`, the released 3D convolutions, or `concat`, two 2D convolutions over all
            frames together.
        warp: Sampling rule of a warp (`warps.warp_features`).
        chain: Order in which motions are multiplied (`warps.present_from_past_batch`).
        egomotion_input: Which motion the convolutions see under a BEV augmentation A. `augmented`:
            A · E · A⁻¹, by which the maps move. `raw`: E, as in the released code.
    """

    channels: int
    grid: BevGrid
    frames: int = 3
    kind: Literal["blocks", "concat"] = "blocks"
    warp: FeatureWarpRule = "exact"
    chain: Chain = "exact"
    egomotion_input: EgomotionInput = "augmented"

    def __post_init__(self) -> None:
        """Check the values; raise ConfigError if one is not valid."""
        if self.channels < 1 or self.frames < 1:
            raise ConfigError(
                "TemporalConfig: expected at least 1 channel and 1 frame, found "
                f"{self.channels} and {self.frames}"
            )
        words = {
            "kind": ("blocks", "concat"),
            "warp": get_args(FeatureWarpRule),
            "chain": get_args(Chain),
            "egomotion_input": get_args(EgomotionInput),
        }
        settle_choices(self, words, error=ConfigError)


def temporal_model(config: TemporalConfig) -> Temporal3D | TemporalConcat:
    """Build the temporal model that a config selects."""
    if config.kind == "blocks":
        return Temporal3D(config)
    return TemporalConcat(config)


class Temporal3D(nn.Module):
    """The released Temporal3DConvModel: P − 1 causal blocks over the warped frames.

    A single frame is returned unchanged. State-dict keys are the released ones, without the prefix
    `temporal_model.`.
    """

    def __init__(self, config: TemporalConfig) -> None:
        super().__init__()
        self.config = config
        channels = config.channels
        in_channels = channels + EGOMOTION_CHANNELS
        self.model = nn.Sequential()
        for _ in range(config.frames - 1):
            self.model.append(TemporalBlock(in_channels, channels))
            in_channels = channels

    def forward(
        self,
        features: Tensor,
        egomotion: Tensor,
        valid: Tensor,
        bev_transform: Tensor | None = None,
    ) -> Tensor:
        """Return the present's map (N, C, H, W).

        Frames up to and including the *first* invalid one are replaced by the frame after it, as in
        the released code: with [invalid, invalid, valid], frame 0 becomes a copy of frame 1. In the
        released batches, invalid frames repeat the present with identity motion, so this does no
        harm.

        Args:
            features: Maps, each in its own frame, the present last, shape (N, P, C, H, W).
            egomotion: 6-vectors, shape (N, P, 6): row t transforms frame t to frame t + 1, in the
                handedness of the maps and before their BEV augmentation; the last row is not used.
            valid: Whether each frame is valid, shape (N, P).
            bev_transform: BEV augmentation, shape (N, 4, 4); None for none.
        """
        present = features[:, -1]
        if self.config.frames == 1:
            return present
        warped = _warp_to_present(features, egomotion, bev_transform, self.config)
        motion = _augment_motion(egomotion[:, :-1], bev_transform, self.config)
        motion = functional.pad(motion, (0, 0, 1, 0))
        frames = torch.cat([warped, _expand_to_maps(motion, warped)], 2)
        frames = _replace_invalid(frames, valid)
        output = self.model(frames.transpose(1, 2))
        return output[:, :, -1] + present


class TemporalConcat(nn.Module):
    """All warped frames and motions, transformed by a 1×1 and a 3×3 convolution.

    Each convolution has batch norm and ReLU.
    """

    def __init__(self, config: TemporalConfig) -> None:
        super().__init__()
        self.config = config
        width = config.channels
        past_frames = config.frames - 1
        self.mix = nn.Sequential(
            nn.Conv2d(
                config.frames * width + past_frames * EGOMOTION_CHANNELS, width, 1, bias=False
            ),
            nn.BatchNorm2d(width),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.ReLU(),
        )

    def forward(
        self,
        features: Tensor,
        egomotion: Tensor,
        valid: Tensor,
        bev_transform: Tensor | None = None,
    ) -> Tensor:
        """Return the present's map; arguments and result are as in `Temporal3D.forward`.

        A past frame that is not valid is replaced by the present, and its motion by zeros.
        """
        past_valid = valid[:, :-1]
        past_motion = egomotion[:, :-1].masked_fill(~past_valid[..., None], 0)
        egomotion = functional.pad(past_motion, (0, 0, 0, 1))
        warped = _warp_to_present(features, egomotion, bev_transform, self.config)
        present = features[:, -1:]
        warped = torch.where(valid[..., None, None, None], warped, present)
        motion = _augment_motion(past_motion, bev_transform, self.config)
        motion_maps = _expand_to_maps(motion, warped).flatten(1, 2)
        return self.mix(torch.cat([warped.flatten(1, 2), motion_maps], 1))


def _warp_to_present(
    features: Tensor, egomotion: Tensor, bev_transform: Tensor | None, config: TemporalConfig
) -> Tensor:
    """Return the maps (N, P, C, H, W) in the present's frame; the present itself is not warped."""
    past_features = features[:, :-1]
    chain = present_from_past_batch(
        egomotion[:, :-1], chain=config.chain, bev_transform=bev_transform
    )
    warped = warp_features(
        past_features.flatten(0, 1), chain.flatten(0, 1), config.grid, warp=config.warp
    )
    return torch.cat([warped.view_as(past_features), features[:, -1:]], 1)


def _augment_motion(
    egomotion: Tensor, bev_transform: Tensor | None, config: TemporalConfig
) -> Tensor:
    """Return the motions that the convolutions see, shape (N, T, 6)."""
    if bev_transform is None or config.egomotion_input == "raw":
        return egomotion
    matrix = bev_transform[:, None]
    next_from_this = matrices_from_six(egomotion)
    augmented = between_augmented(next_from_this, matrix, matrix)
    return six_from_matrices(augmented)


def _expand_to_maps(motion: Tensor, maps: Tensor) -> Tensor:
    """Expand motions (N, T, 6) to maps (N, T, 6, H, W) that are constant over all cells."""
    rows, columns = maps.shape[-2:]
    one_cell = motion.to(maps.dtype)[..., None, None]
    return one_cell.expand(-1, -1, -1, rows, columns)


def _replace_invalid(frames: Tensor, valid: Tensor) -> Tensor:
    """Replace the frames up to the first invalid one by the frame after it, shape (N, P, …).

    `valid` marks whether each frame is valid, shape (N, P).
    """
    samples, num_frames = valid.shape
    first_invalid = (~valid).to(torch.uint8).argmax(1, keepdim=True)
    steps = torch.arange(num_frames, device=frames.device)
    is_replaced = (steps <= first_invalid) & ~valid.all(1, keepdim=True)
    source = torch.where(is_replaced, first_invalid + 1, steps)
    source = source.clamp(max=num_frames - 1)
    rows = torch.arange(samples, device=frames.device)[:, None]
    return frames[rows, source]
