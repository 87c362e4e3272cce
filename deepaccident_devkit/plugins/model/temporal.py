"""Temporal models: one agent's BEV maps of the past and the present → one map of the present, before any fusion.

The released TemporalBlock and Bottleneck3D, which it has from FIERY. The sequence is frames in the temporal model and
agents in the released fusion's unused part. Attributes have the names of the released state dict.

Both take the same arguments; `temporal_model` makes the one that a config names.
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


class ConvBnRelu3d(nn.Module):
    """A convolution (kernel: steps, rows, columns) without bias, batch norm and ReLU; keeps T, H and W."""

    def __init__(
        self, in_channels: int, out_channels: int, kernel: tuple[int, int, int] = (1, 1, 1)
    ) -> None:
        super().__init__()
        padding = (0, kernel[1] // 2, kernel[2] // 2)
        self.conv = nn.Conv3d(in_channels, out_channels, kernel, padding=padding, bias=False)
        self.norm = nn.BatchNorm3d(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → (B, C', T, H, W); the steps before the first are zeros."""
        earlier = self.conv.kernel_size[0] - 1
        if earlier:
            x = functional.pad(x, (0, 0, 0, 0, earlier, 0))
        return functional.relu(self.norm(self.conv(x)))


class PooledStep(nn.Module):
    """The mean over the map and over each step and the one before, through a 1×1×1 convolution; in every cell."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv_bn_relu = ConvBnRelu3d(in_channels, out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → (B, C', T, H, W); the first step is its own mean.

        As in the released code a further step, the last one's own mean, counts in the batch statistics.
        """
        means = x.mean((-2, -1), keepdim=True)
        pairs = torch.cat(
            [means[:, :, :1], (means[:, :, 1:] + means[:, :, :-1]) / 2, means[:, :, -1:]], 2
        )
        return self.conv_bn_relu(pairs)[:, :, :-1].expand(-1, -1, -1, *x.shape[-2:])


class PyramidPooling(nn.Module):
    """The released pyramid of one level, the whole map."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.features = nn.ModuleList([PooledStep(in_channels, out_channels)])

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → (B, C', T, H, W)."""
        return torch.cat([level(x) for level in self.features], 1)


class TemporalBlock(nn.Module):
    """Three convolution paths and a pooled one over a step and the one before, added to the input."""

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
        self.projection = (
            nn.Identity()
            if in_channels == out_channels
            else nn.Sequential(
                nn.Conv3d(in_channels, out_channels, 1, bias=False), nn.BatchNorm3d(out_channels)
            )
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → (B, C', T, H, W)."""
        paths = [path(x) for path in self.convolution_paths]
        return self.projection(x) + self.aggregation(
            torch.cat([*paths, self.pyramid_pooling(x)], 1)
        )


class Bottleneck3d(nn.Module):
    """1×1×1 to half the channels, 1×3×3, 1×1×1 back, added to the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        half = channels // 2
        self.layers = nn.Sequential()
        self.layers.add_module("conv_down_project", ConvBnRelu3d(channels, half))
        self.layers.add_module("conv", ConvBnRelu3d(half, half, (1, 3, 3)))
        self.layers.add_module("conv_up_project", ConvBnRelu3d(half, channels))

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, T, H, W) → the same shape."""
        return x + self.layers(x)


# Channels that an egomotion takes: a 6-vector, the same in all cells.
EGOMOTION = 6
EgomotionInput = Literal["raw", "augmented"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TemporalConfig:
    """A temporal model.

    Attributes:
        channels: C of the maps, in and out.
        grid: the maps' cells.
        frames: P, the past ones and the present.
        kind: `blocks`, the released 3D convolutions, or `concat`, two 2D convolutions over all frames at once.
        warp: where a warp samples (`warps.warp_features`).
        chain: the order in which motions are multiplied (`warps.present_from_past_batch`).
        egomotion_input: with a BEV augmentation A, the motion that the convolutions see: `augmented` is
            A · E · A⁻¹, as the maps move; `raw` is E, the released code's.
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
                f"TemporalConfig: expected at least 1 channel and 1 frame, found {self.channels} and {self.frames}"
            )
        words = {
            "kind": ("blocks", "concat"),
            "warp": get_args(FeatureWarpRule),
            "chain": get_args(Chain),
            "egomotion_input": get_args(EgomotionInput),
        }
        settle_choices(self, words, error=ConfigError)


def temporal_model(config: TemporalConfig) -> Temporal3D | TemporalConcat:
    """The temporal model that a config names."""
    return Temporal3D(config) if config.kind == "blocks" else TemporalConcat(config)


class Temporal3D(nn.Module):
    """The released Temporal3DConvModel: P − 1 causal blocks over the warped frames; one frame stays as it is.

    State-dict keys are the released ones (`temporal_model.` and these).
    """

    def __init__(self, config: TemporalConfig) -> None:
        super().__init__()
        self.config = config
        widths = [config.channels + EGOMOTION] + [config.channels] * (config.frames - 1)
        self.model = nn.Sequential(*map(TemporalBlock, widths[:-1], widths[1:]))

    def forward(
        self,
        features: Tensor,
        egomotion: Tensor,
        valid: Tensor,
        bev_transform: Tensor | None = None,
    ) -> Tensor:
        """Maps (N, P, C, H, W), each in its own frame, the present last → the present's (N, C, H, W).

        Frames up to the *first* one that is not `valid` (N, P) are replaced by the frame after it, as the released code
        does; of [no, no, yes] frame 0 so becomes frame 1. In its batches invalid frames repeat the present with
        identity motion, so that this does no harm. Row t of `egomotion` (N, P, 6) moves frame t to t + 1, in the
        handedness of the maps, before their BEV augmentation (N, 4, 4); the last row is not used.
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
    """All warped frames and motions through a 1×1 and a 3×3 convolution, each with batch norm and ReLU."""

    def __init__(self, config: TemporalConfig) -> None:
        super().__init__()
        self.config = config
        width, past = config.channels, config.frames - 1
        self.mix = nn.Sequential(
            nn.Conv2d(config.frames * width + past * EGOMOTION, width, 1, bias=False),
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
        """One map of the present; arguments and result as `Temporal3D.forward`.

        A past frame that is not valid is replaced by the present, and its motion by none at all.
        """
        past = valid[:, :-1]
        egomotion = torch.cat(
            [
                egomotion[:, :-1].masked_fill(~past[..., None], 0),
                torch.zeros_like(egomotion[:, -1:]),
            ],
            1,
        )
        warped = _warped_to_present(features, egomotion, bev_transform, self.config)
        present = features[:, -1:]
        warped = torch.where(valid[..., None, None, None], warped, present)
        motion = _motion_input(egomotion[:, :-1], bev_transform, self.config)
        return self.mix(
            torch.cat([warped.flatten(1, 2), _as_maps(motion, warped).flatten(1, 2)], 1)
        )


def _warped_to_present(
    features: Tensor, egomotion: Tensor, bev_transform: Tensor | None, config: TemporalConfig
) -> Tensor:
    """(N, P, C, H, W) in the present's frame; the present itself is not warped."""
    past = features[:, :-1]
    chain = present_from_past_batch(
        egomotion[:, :-1], chain=config.chain, bev_transform=bev_transform
    )
    warped = warp_features(past.flatten(0, 1), chain.flatten(0, 1), config.grid, warp=config.warp)
    return torch.cat([warped.view_as(past), features[:, -1:]], 1)


def _motion_input(
    egomotion: Tensor, bev_transform: Tensor | None, config: TemporalConfig
) -> Tensor:
    """(N, T, 6) the motions that the convolutions see."""
    if bev_transform is None or config.egomotion_input == "raw":
        return egomotion
    matrix = bev_transform[:, None]
    return six_from_matrices(between_augmented(matrices_from_six(egomotion), matrix, matrix))


def _as_maps(motion: Tensor, maps: Tensor) -> Tensor:
    """(N, T, 6) → (N, T, 6, H, W) of the maps' dtype, the same in all cells."""
    return motion.to(maps.dtype)[..., None, None].expand(-1, -1, -1, *maps.shape[-2:])


def _without_invalid(frames: Tensor, valid: Tensor) -> Tensor:
    """Frames (N, P, …) in which those up to the first invalid one are the frame after it."""
    first = (~valid).to(torch.uint8).argmax(1, keepdim=True)
    steps = torch.arange(frames.shape[1], device=frames.device)
    replaced = (steps <= first) & ~valid.all(1, keepdim=True)
    source = torch.where(replaced, first + 1, steps).clamp(max=frames.shape[1] - 1)
    return frames[torch.arange(len(frames), device=frames.device)[:, None], source]
