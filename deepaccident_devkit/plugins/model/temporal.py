"""Temporal models: one agent's BEV maps of the past and the present → one map of the present.

They run before any fusion. These are the released TemporalBlock and Bottleneck3D, which the release
has from FIERY. The sequence is over frames in the temporal model, and over agents in the released
fusion's unused part. Attributes have the names of the released state dict.

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

# Channels that an egomotion takes: a 6-vector, the same in all cells.
EGOMOTION_CHANNELS = 6


class ConvBnRelu3d(nn.Module):
    """A convolution without bias, batch norm and ReLU; T, H and W stay the same.

    Its kernel is (steps, rows, columns).
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
        return functional.relu(self.norm(self.conv(x)))


class PooledStep(nn.Module):
    """The mean over the map and two successive steps, after a 1×1×1 convolution, in every cell."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv_bn_relu = ConvBnRelu3d(in_channels, out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Transform (B, C, T, H, W) to (B, C', T, H, W); the first step is its own mean.

        As in the released code an additional step, the last one's own mean, counts in the batch
        statistics.
        """
        means = x.mean((-2, -1), keepdim=True)
        first_mean = means[:, :, :1]
        pair_means = (means[:, :, 1:] + means[:, :, :-1]) / 2
        padded_means = torch.cat([first_mean, pair_means, means[:, :, -1:]], 2)
        return self.conv_bn_relu(padded_means)[:, :, :-1].expand(-1, -1, -1, *x.shape[-2:])


class PyramidPooling(nn.Module):
    """The released pyramid with one level, the complete map."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.features = nn.ModuleList([PooledStep(in_channels, out_channels)])

    def forward(self, x: Tensor) -> Tensor:
        """Transform (B, C, T, H, W) to (B, C', T, H, W)."""
        return torch.cat([level(x) for level in self.features], 1)


class TemporalBlock(nn.Module):
    """Three convolution paths and a pooled one over two successive steps, added to the input."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        half, third = in_channels // 2, in_channels // 3
        self.convolution_paths = nn.ModuleList(
            [
                nn.Sequential(ConvBnRelu3d(in_channels, half), ConvBnRelu3d(half, half, (2, 3, 3))),
                nn.Sequential(ConvBnRelu3d(in_channels, half), ConvBnRelu3d(half, half, (1, 3, 3))),
                ConvBnRelu3d(in_channels, half),
            ]
        )
        self.pyramid_pooling = PyramidPooling(in_channels, third)
        self.aggregation = nn.Sequential(ConvBnRelu3d(3 * half + third, out_channels))
        self.projection: nn.Module = nn.Identity()
        if in_channels != out_channels:
            self.projection = nn.Sequential(
                nn.Conv3d(in_channels, out_channels, 1, bias=False), nn.BatchNorm3d(out_channels)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Transform (B, C, T, H, W) to (B, C', T, H, W)."""
        paths = [path(x) for path in self.convolution_paths]
        projected = self.projection(x)
        pooled = self.pyramid_pooling(x)
        return projected + self.aggregation(torch.cat([*paths, pooled], 1))


class Bottleneck3d(nn.Module):
    """1×1×1 convolution to half the channels, 1×3×3, 1×1×1 back; added to the input."""

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
    """A temporal model.

    Attributes:
        channels: Channels C of the maps, in and out.
        grid: Cells of the maps.
        frames: Number P of frames, including the present.
        kind: `blocks`, the released 3D convolutions, or `concat`, two 2D convolutions over all
            frames together.
        warp: Sampling rule of a warp (`warps.warp_features`).
        chain: Order in which motions are multiplied (`warps.present_from_past_batch`).
        egomotion_input: With a BEV augmentation A, the motion that the convolutions see:
            `augmented` is A · E · A⁻¹, as the maps move; `raw` is E, as in the released code.
    """

    channels: int
    grid: BevGrid
    frames: int = 3
    kind: Literal["blocks", "concat"] = "blocks"
    warp: FeatureWarpRule = "exact"
    chain: Chain = "exact"
    egomotion_input: EgomotionInput = "augmented"

    def __post_init__(self) -> None:
        """Check the numbers and words; raises ConfigError."""
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
    """Return the temporal model that a config names."""
    return Temporal3D(config) if config.kind == "blocks" else TemporalConcat(config)


class Temporal3D(nn.Module):
    """The released Temporal3DConvModel: P − 1 causal blocks over the warped frames.

    A single frame stays unchanged. State-dict keys are the released ones (`temporal_model.` and
    these).
    """

    def __init__(self, config: TemporalConfig) -> None:
        super().__init__()
        self.config = config
        widths = [config.channels + EGOMOTION_CHANNELS] + [config.channels] * (config.frames - 1)
        self.model = nn.Sequential(*map(TemporalBlock, widths[:-1], widths[1:]))

    def forward(
        self,
        features: Tensor,
        egomotion: Tensor,
        valid: Tensor,
        bev_transform: Tensor | None = None,
    ) -> Tensor:
        """Return the present's map (N, C, H, W).

        Frames up to the *first* one that is not `valid` are replaced by the frame after it, as the
        released code does; with [no, no, yes] frame 0 becomes frame 1. In the released batches
        invalid frames repeat the present with identity motion, so this does no harm.

        Args:
            features: Maps, each in its own frame, the present last, shape (N, P, C, H, W).
            egomotion: 6-vectors, shape (N, P, 6): row t moves frame t to t + 1, in the handedness
                of the maps, before their BEV augmentation; the last row is not used.
            valid: Whether each frame is valid, shape (N, P).
            bev_transform: BEV augmentation, shape (N, 4, 4); None without one.
        """
        present = features[:, -1]
        if self.config.frames == 1:
            return present
        warped = _warped_to_present(features, egomotion, bev_transform, self.config)
        motion = _motion_input(egomotion[:, :-1], bev_transform, self.config)
        motion = torch.cat([torch.zeros_like(motion[:, :1]), motion], 1)
        frames = torch.cat([warped, _as_maps(motion, warped)], 2)
        return self.model(_without_invalid(frames, valid).transpose(1, 2))[:, :, -1] + present


class TemporalConcat(nn.Module):
    """All warped frames and motions, transformed by a 1×1 and a 3×3 convolution.

    Each convolution has batch norm and ReLU.
    """

    def __init__(self, config: TemporalConfig) -> None:
        super().__init__()
        self.config = config
        width, past = config.channels, config.frames - 1
        self.mix = nn.Sequential(
            nn.Conv2d(config.frames * width + past * EGOMOTION_CHANNELS, width, 1, bias=False),
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
        """Return the present's map; arguments and result as in `Temporal3D.forward`.

        A past frame that is not valid is replaced by the present, and its motion by zeros.
        """
        past_valid = valid[:, :-1]
        past_motion = egomotion[:, :-1].masked_fill(~past_valid[..., None], 0)
        egomotion = torch.cat([past_motion, torch.zeros_like(egomotion[:, -1:])], 1)
        warped = _warped_to_present(features, egomotion, bev_transform, self.config)
        present = features[:, -1:]
        warped = torch.where(valid[..., None, None, None], warped, present)
        motion = _motion_input(egomotion[:, :-1], bev_transform, self.config)
        motion_maps = _as_maps(motion, warped)
        return self.mix(torch.cat([warped.flatten(1, 2), motion_maps.flatten(1, 2)], 1))


def _warped_to_present(
    features: Tensor, egomotion: Tensor, bev_transform: Tensor | None, config: TemporalConfig
) -> Tensor:
    """Return the maps (N, P, C, H, W) in the present's frame; the present itself is not warped."""
    past = features[:, :-1]
    chain = present_from_past_batch(
        egomotion[:, :-1], chain=config.chain, bev_transform=bev_transform
    )
    warped = warp_features(past.flatten(0, 1), chain.flatten(0, 1), config.grid, warp=config.warp)
    return torch.cat([warped.view_as(past), features[:, -1:]], 1)


def _motion_input(
    egomotion: Tensor, bev_transform: Tensor | None, config: TemporalConfig
) -> Tensor:
    """Return the motions that the convolutions see, shape (N, T, 6)."""
    if bev_transform is None or config.egomotion_input == "raw":
        return egomotion
    matrix = bev_transform[:, None]
    return six_from_matrices(between_augmented(matrices_from_six(egomotion), matrix, matrix))


def _as_maps(motion: Tensor, maps: Tensor) -> Tensor:
    """Return motions (N, T, 6) as maps (N, T, 6, H, W) of the maps' dtype, equal in all cells."""
    rows, columns = maps.shape[-2:]
    return motion.to(maps.dtype)[..., None, None].expand(-1, -1, -1, rows, columns)


def _without_invalid(frames: Tensor, valid: Tensor) -> Tensor:
    """Return frames (N, P, …); each frame up to the first invalid one is the frame after that."""
    first_invalid = (~valid).to(torch.uint8).argmax(1, keepdim=True)
    steps = torch.arange(frames.shape[1], device=frames.device)
    is_replaced = (steps <= first_invalid) & ~valid.all(1, keepdim=True)
    source = torch.where(is_replaced, first_invalid + 1, steps).clamp(max=frames.shape[1] - 1)
    return frames[torch.arange(len(frames), device=frames.device)[:, None], source]
