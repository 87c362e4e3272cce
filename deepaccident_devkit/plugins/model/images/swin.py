"""`Swin`: the image backbone of the release, a Swin Transformer, and its official weights.

Liu et al., ICCV 2021.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from deepaccident_devkit.errors import ConfigError, shortened

# Pixels along the side of a patch.
_PATCH_PIXELS = 4
_MLP_RATIO = 4
_RENAMING_RULES: Final = (
    (r"patch_embed\.proj\.(.+)", r"patch_embed.projection.\1"),
    (r"(patch_embed\.norm\..+)", r"\1"),
    (r"layers\.(\d+\.blocks\.\d+\.norm[12]\..+)", r"stages.\1"),
    (r"layers\.(\d+\.blocks\.\d+\.attn)\.(.+)", r"stages.\1.w_msa.\2"),
    (r"layers\.(\d+\.blocks\.\d+)\.mlp\.fc1\.(.+)", r"stages.\1.ffn.layers.0.0.\2"),
    (r"layers\.(\d+\.blocks\.\d+)\.mlp\.fc2\.(.+)", r"stages.\1.ffn.layers.1.\2"),
    (r"layers\.(\d+\.downsample\..+)", r"stages.\1"),
    (r"(norm\..+)", r"\1"),
)
# The classifier, and masks that only depend on the size of the image.
_DROPPED_NAMES: Final = re.compile(r"head\..+|layers\.\d+\.blocks\.\d+\.attn_mask")
_MERGING_NAMES: Final = re.compile(
    r"layers\.\d+\.downsample\.(norm\.weight|norm\.bias|reduction\.weight)"
)


class _SwinAttention(nn.Module):
    """Multi-head self-attention in one window, with a learned bias for each relative position."""

    relative_position_index: Tensor

    def __init__(self, channels: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads = heads
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        self.register_buffer("relative_position_index", relative_positions(window))
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor, is_visible: Tensor | None = None) -> Tensor:
        """Attend in K windows of L tokens, shape (N, K, L, C).

        `is_visible` (K, L, L) bool is whether a token may attend to another one.
        """
        channels = tokens.shape[-1]
        # (N, K, L, 3C) → query, key and value, each (N, K, heads, L, C / heads)
        parts = self.qkv(tokens).unflatten(-1, (3, self.heads, channels // self.heads))
        query, key, value = parts.permute(3, 0, 1, 4, 2, 5).unbind(0)
        scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
        bias = self.relative_position_bias_table[self.relative_position_index]
        scores = scores + bias.permute(2, 0, 1)
        if is_visible is not None:
            scores = scores.masked_fill(~is_visible[:, None], -torch.inf)
        return self.proj((scores.softmax(-1) @ value).transpose(2, 3).flatten(3))


class ShiftedWindowAttention(nn.Module):
    """Self-attention in the windows of a map; `shift` moves the windows over the map as a torus.

    A map that is not an integer number of windows is padded with zeros on the right and at the
    bottom. As in the release, tokens also attend to the padding.
    """

    def __init__(self, channels: int, heads: int, window: int, shift: int) -> None:
        super().__init__()
        self.window, self.shift = window, shift
        self.w_msa = _SwinAttention(channels, heads, window)

    def forward(self, features: Tensor) -> Tensor:
        """Attend in features (N, h, w, C); return the same shape."""
        height, width = features.shape[1:3]
        padded = functional.pad(features, (0, 0, 0, -width % self.window, 0, -height % self.window))
        rows, columns = padded.shape[1:3]
        is_visible = None
        if self.shift:
            padded = padded.roll((-self.shift, -self.shift), (1, 2))
            is_visible = neighbours(rows, columns, self.window, self.shift, padded.device)
        attended = self.w_msa(windows_of(padded, self.window), is_visible)
        result = map_of(attended, rows, columns)
        if self.shift:
            result = result.roll((self.shift, self.shift), (1, 2))
        return result[:, :height, :width]


def relative_positions(window: int) -> Tensor:
    """Return the row of the bias table for each query (first axis) and key, (L, L) int64.

    L = window² is the number of tokens.
    """
    cells = torch.cartesian_prod(torch.arange(window), torch.arange(window))
    row_offsets, column_offsets = (cells[:, None] - cells + window - 1).unbind(-1)
    return row_offsets * (2 * window - 1) + column_offsets


def windows_of(features: Tensor, window: int) -> Tensor:
    """Return the windows of a map (N, h, w, C), in reading order, shape (N, K, L, C).

    The map consists of K complete windows of L = window² tokens.
    """
    count, rows, columns, channels = features.shape
    cut = features.view(count, rows // window, window, columns // window, window, channels)
    return cut.transpose(2, 3).reshape(count, -1, window * window, channels)


def map_of(windows: Tensor, rows: int, columns: int) -> Tensor:
    """Return the map (N, rows, columns, C) that `windows_of` cut."""
    count, _, tokens, channels = windows.shape
    window = round(tokens**0.5)
    cut = windows.view(count, rows // window, columns // window, window, window, channels)
    return cut.transpose(2, 3).reshape(count, rows, columns, channels)


def neighbours(
    rows: int, columns: int, window: int, shift: int, device: torch.device | str | None = None
) -> Tensor:
    """Return which tokens of the windows of a shifted map may attend to each other, (K, L, L) bool.

    These are tokens on the same side of the map: not the two sides that the shift brought together.
    """
    # In the last row and column of windows the last `shift` steps come from the other side.
    is_low, is_right = (
        (torch.arange(size, device=device) >= size - shift).long() for size in (rows, columns)
    )
    sides = windows_of((2 * is_low[:, None] + is_right)[None, :, :, None], window)[0, :, :, 0]
    return sides[:, :, None] == sides[:, None, :]


@dataclass(frozen=True, slots=True, kw_only=True)
class SwinConfig:
    """Sizes of the Swin Transformer; the defaults are Swin-T's, as in the release.

    Attributes:
        embed_dims: Channels of the first stage; each further stage has twice as many.
        depths: Number of blocks of each stage.
        num_heads: Number of attention heads of each stage.
        window_size: Tokens along the side of a window.
        out_stages: The two successive stages that give the resulting maps; stage i is at 1 / 2^(i +
            2) of the image's resolution.
        checkpointing: Whether training recomputes blocks for the gradient, which saves memory and
            costs time.
        neck_channels: Channels of the features.
    """

    embed_dims: int = 96
    depths: tuple[int, ...] = (2, 2, 6, 2)
    num_heads: tuple[int, ...] = (3, 6, 12, 24)
    window_size: int = 7
    out_stages: tuple[int, int] = (2, 3)
    checkpointing: bool = False
    neck_channels: int = 512

    def __post_init__(self) -> None:
        """Check that the stages fit together; raises ConfigError."""
        stages = len(self.depths)
        if len(self.num_heads) != stages:
            raise ConfigError(
                f"num_heads: expected {stages}, one for each of depths, found {self.num_heads!r}"
            )
        for width, heads in zip(self.widths, self.num_heads, strict=True):
            if width % heads:
                raise ConfigError(
                    f"num_heads: {width} channels cannot be shared by {heads} heads; choose a "
                    "divisor"
                )
        pairs = [*pairwise(range(stages))]
        if self.out_stages not in pairs:
            raise ConfigError(f"out_stages: expected one of {pairs}, found {self.out_stages!r}")

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each stage."""
        return tuple(self.embed_dims << i for i in range(len(self.depths)))

    @property
    def stride(self) -> int:
        """Pixels of the image per cell of the features."""
        return _PATCH_PIXELS << self.out_stages[0]


class Swin(nn.Module):
    """Swin Transformer with a LayerNorm for each map of its result.

    As in the release it has no stochastic depth. Parameters have the released names;
    `from_official` converts the names of the official weights.

    Attributes:
        out_channels: Channels of the two maps.
    """

    def __init__(self, config: SwinConfig) -> None:
        super().__init__()
        self.config = config
        first, second = config.out_stages
        self.out_channels = (config.widths[first], config.widths[second])
        self.patch_embed = PatchEmbedding(config.embed_dims)
        self.stages = nn.ModuleList(
            _SwinStage(config, i, downsample=i < len(config.depths) - 1)
            for i in range(len(config.depths))
        )
        for i in config.out_stages:
            self.add_module(f"norm{i}", nn.LayerNorm(config.widths[i]))
        self.apply(_initialise)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Encode images (N, 3, h, w); return the maps of `out_stages`, (N, C, h', w').

        Sizes are rounded up.
        """
        features, maps = self.patch_embed(images), []
        for i, stage in enumerate(self.stages):
            features, stage_features = stage(features)
            if i in self.config.out_stages:
                norm = self.get_submodule(f"norm{i}")
                maps.append(norm(stage_features).permute(0, 3, 1, 2).contiguous())
        return maps[0], maps[1]


class PatchEmbedding(nn.Module):
    """Encoder of patches of 4×4 pixels as tokens."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.projection = nn.Conv2d(3, channels, _PATCH_PIXELS, _PATCH_PIXELS)
        self.norm = nn.LayerNorm(channels)

    def forward(self, images: Tensor) -> Tensor:
        """Encode images (N, 3, h, w) as tokens (N, h / 4, w / 4, C).

        Incomplete patches are filled with black.
        """
        height, width = images.shape[-2:]
        padded = nn.functional.pad(images, (0, -width % _PATCH_PIXELS, 0, -height % _PATCH_PIXELS))
        return self.norm(self.projection(padded).permute(0, 2, 3, 1))


class _SwinStage(nn.Module):
    """Blocks of one resolution, and the layer that halves it for the next stage."""

    def __init__(self, config: SwinConfig, index: int, *, downsample: bool) -> None:
        super().__init__()
        self.checkpointing = config.checkpointing
        channels, heads, window = config.widths[index], config.num_heads[index], config.window_size
        self.blocks = nn.ModuleList(
            _SwinBlock(channels, heads, window, shift=window // 2 if i % 2 else 0)
            for i in range(config.depths[index])
        )
        self.downsample = PatchMerging(channels) if downsample else None

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the features for the next stage, (N, h / 2, w / 2, 2C), and this stage's.

        The input and this stage's features have shape (N, h, w, C).
        """
        for block in self.blocks:
            if self.checkpointing and self.training:
                features = checkpoint(block, features, use_reentrant=False)
            else:
                features = block(features)
        return (features if self.downsample is None else self.downsample(features)), features


class _SwinBlock(nn.Module):
    """Window attention and a perceptron of each token, each with a LayerNorm and a shortcut."""

    def __init__(self, channels: int, heads: int, window: int, *, shift: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels)
        self.attn = ShiftedWindowAttention(channels, heads, window, shift)
        self.norm2 = nn.LayerNorm(channels)
        hidden = _MLP_RATIO * channels
        layers = nn.Sequential(
            nn.Sequential(nn.Linear(channels, hidden), nn.GELU()), nn.Linear(hidden, channels)
        )
        self.ffn = nn.ModuleDict({"layers": layers})

    def forward(self, features: Tensor) -> Tensor:
        """Transform features (N, h, w, C); return the same shape."""
        features = features + self.attn(self.norm1(features))
        return features + self.ffn["layers"](self.norm2(features))


class PatchMerging(nn.Module):
    """Merging of four neighbouring tokens into one with twice the channels.

    A channel's four values are adjacent, row by row. (The official order is by token, column by
    column: `from_official`.)
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * channels)
        self.reduction = nn.Linear(4 * channels, 2 * channels, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        """Merge features (N, h, w, C) to (N, h / 2, w / 2, 2C); odd sizes are padded with zeros."""
        padded = nn.functional.pad(
            features, (0, 0, 0, features.shape[2] % 2, 0, features.shape[1] % 2)
        )
        count, rows, columns, channels = padded.shape
        cut = padded.reshape(count, rows // 2, 2, columns // 2, 2, channels)
        return self.reduction(self.norm(cut.permute(0, 1, 3, 5, 2, 4).flatten(3)))


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, _SwinAttention):
        nn.init.trunc_normal_(module.relative_position_bias_table, std=0.02)


def from_official(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return a state dict with the names and the layout of `Swin`, without the classifier.

    Args:
        weights: State dict with the names of microsoft/Swin-Transformer (its files have it under
            `model`).

    Returns:
        The state dict. It has `norm.*`, the classifier's norm, which `Swin` does not use; it lacks
        `norm2.*` and `norm3.*`, which must be learned. So `load_state_dict` needs `strict=False`.

    Raises:
        ConfigError: A name is not one of Swin's.
    """
    state = {}
    for name, tensor in weights.items():
        if not _DROPPED_NAMES.fullmatch(name):
            is_merging = _MERGING_NAMES.fullmatch(name)
            state[_renamed(name)] = _channel_major(tensor) if is_merging else tensor
    return state


def _renamed(name: str) -> str:
    """Return the name in `Swin` of an official weight; raises ConfigError."""
    for pattern, template in _RENAMING_RULES:
        match = re.fullmatch(pattern, name)
        if match:
            return match.expand(template)
    raise ConfigError(
        "expected names of Swin's official weights, such as 'layers.0.blocks.0.norm1.weight', "
        f"found {shortened(name)!r}; if it is a file's content, give its entry 'model'"
    )


def _channel_major(tensor: Tensor) -> Tensor:
    """Return values (…, 4C) of four merged tokens in channel-major instead of token-major order.

    Official tokens are ordered column by column: (0, 0), (1, 0), (0, 1), (1, 1). Ours are in
    reading order.
    """
    by_token = tensor.unflatten(-1, (4, -1))[..., [0, 2, 1, 3], :]
    return by_token.transpose(-1, -2).flatten(-2)
