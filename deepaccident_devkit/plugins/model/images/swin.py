"""`Swin`: the image backbone of the release, a Swin Transformer, and its official weights.

Liu et al., ICCV 2021.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from deepaccident_devkit.errors import ConfigError, shortened

# Pixels along the side of a patch.
_PATCH_PIXELS = 4
# Hidden channels of an MLP, as a multiple of its channels.
_MLP_RATIO = 4
# Patterns of the official names → templates of the released names.
_RENAMING_RULES = (
    (r"patch_embed\.proj\.(.+)", r"patch_embed.projection.\1"),
    (r"(patch_embed\.norm\..+)", r"\1"),
    (r"layers\.(\d+\.blocks\.\d+\.norm[12]\..+)", r"stages.\1"),
    (r"layers\.(\d+\.blocks\.\d+\.attn)\.(.+)", r"stages.\1.w_msa.\2"),
    (r"layers\.(\d+\.blocks\.\d+)\.mlp\.fc1\.(.+)", r"stages.\1.ffn.layers.0.0.\2"),
    (r"layers\.(\d+\.blocks\.\d+)\.mlp\.fc2\.(.+)", r"stages.\1.ffn.layers.1.\2"),
    (r"layers\.(\d+\.downsample\..+)", r"stages.\1"),
    (r"(norm\..+)", r"\1"),
)
# The classifier, and masks that depend only on the image's size.
_DROPPED_NAMES = re.compile(r"head\..+|layers\.\d+\.blocks\.\d+\.attn_mask")
_MERGING_NAMES = re.compile(r"layers\.\d+\.downsample\.(norm\.weight|norm\.bias|reduction\.weight)")


class _SwinAttention(nn.Module):
    """Multi-head self-attention in one window, with a learned bias for each relative position."""

    relative_position_index: Tensor

    def __init__(self, channels: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads = heads
        num_positions = (2 * window - 1) ** 2
        self.relative_position_bias_table = nn.Parameter(torch.zeros(num_positions, heads))
        self.register_buffer("relative_position_index", relative_positions(window))
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor, is_visible: Tensor | None = None) -> Tensor:
        """Apply attention within K windows of L tokens, shape (N, K, L, C).

        `is_visible` (K, L, L) bool says whether a token may attend to another one; None if all may.
        """
        # (N, K, L, 3C) → query, key and value, each (N, K, heads, L, C / heads)
        qkv = self.qkv(tokens).unflatten(-1, (3, self.heads, -1))
        query, key, value = qkv.permute(3, 0, 1, 4, 2, 5).unbind(0)
        scaled_query = query * query.shape[-1] ** -0.5
        scores = scaled_query @ key.transpose(-1, -2)
        bias = self.relative_position_bias_table[self.relative_position_index]
        scores = scores + bias.permute(2, 0, 1)
        if is_visible is not None:
            scores = scores.masked_fill(~is_visible[:, None], -torch.inf)
        attended = scores.softmax(-1) @ value
        return self.proj(attended.transpose(2, 3).flatten(3))


class ShiftedWindowAttention(nn.Module):
    """Self-attention in the windows of a map; `shift` moves the windows over the map as a torus.

    A map that does not consist of complete windows is padded with zeros on the right and at the
    bottom. As in the release, tokens also attend to the padding.
    """

    def __init__(self, channels: int, heads: int, window: int, shift: int) -> None:
        super().__init__()
        self.window = window
        self.shift = shift
        self.w_msa = _SwinAttention(channels, heads, window)

    def forward(self, features: Tensor) -> Tensor:
        """Apply attention to features (N, h, w, C); return the same shape."""
        window = self.window
        shift = self.shift
        height, width = features.shape[1:3]
        padded = functional.pad(features, (0, 0, 0, -width % window, 0, -height % window))
        rows, columns = padded.shape[1:3]
        is_visible = None
        if shift:
            padded = padded.roll((-shift, -shift), (1, 2))
            is_visible = neighbours(rows, columns, window, shift, padded.device)
        attended = self.w_msa(split_windows(padded, window), is_visible)
        result = join_windows(attended, rows, columns)
        if shift:
            result = result.roll((shift, shift), (1, 2))
        return result[:, :height, :width]


def relative_positions(window: int) -> Tensor:
    """Return the row of the bias table for each query (first axis) and key, (L, L) int64.

    L = window² is the number of tokens.
    """
    steps = torch.arange(window)
    cells = torch.cartesian_prod(steps, steps)
    offsets = cells[:, None] - cells + window - 1
    row_offsets, column_offsets = offsets.unbind(-1)
    return row_offsets * (2 * window - 1) + column_offsets


def split_windows(features: Tensor, window: int) -> Tensor:
    """Return the windows of a map (N, h, w, C), in reading order, shape (N, K, L, C).

    The map consists of K complete windows of L = window² tokens.
    """
    count, rows, columns, channels = features.shape
    windows = features.view(count, rows // window, window, columns // window, window, channels)
    windows = windows.transpose(2, 3)
    return windows.reshape(count, -1, window * window, channels)


def join_windows(windows: Tensor, rows: int, columns: int) -> Tensor:
    """Return the map (N, rows, columns, C) that `split_windows` divided into windows."""
    count, _, tokens, channels = windows.shape
    window = round(tokens**0.5)
    windows = windows.view(count, rows // window, columns // window, window, window, channels)
    return windows.transpose(2, 3).reshape(count, rows, columns, channels)


def neighbours(
    rows: int, columns: int, window: int, shift: int, device: torch.device | str | None = None
) -> Tensor:
    """Return whether two tokens in a window of a shifted map may attend to each other, (K, L, L).

    They may if they lie on the same side of the map; the shift puts opposite sides next to each
    other.
    """
    # In the last row and column of windows, the last `shift` tokens come from the opposite side.
    side_map = torch.zeros((1, rows, columns, 1), dtype=torch.int64, device=device)
    side_map[:, rows - shift :] += 2
    side_map[:, :, columns - shift :] += 1
    sides = split_windows(side_map, window)[0, :, :, 0]
    return sides[:, :, None] == sides[:, None, :]


@dataclass(frozen=True, slots=True, kw_only=True)
class SwinConfig:
    """Sizes of the Swin Transformer; the defaults are Swin-T's, as in the release.

    Attributes:
        embed_dims: Channels of the first stage; each further stage has twice as many.
        depths: Number of blocks of each stage.
        num_heads: Number of attention heads of each stage.
        window_size: Tokens along the side of a window.
        out_stages: The two successive stages whose maps are returned; stage i has 1 / 2^(i + 2) of
            the image's resolution.
        checkpointing: Whether training recomputes blocks in the backward pass, which saves memory
            but takes longer.
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
        """Check that the stages fit together; raise ConfigError if they do not."""
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
        pairs = list(pairwise(range(stages)))
        if self.out_stages not in pairs:
            raise ConfigError(f"out_stages: expected one of {pairs}, found {self.out_stages!r}")

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each stage."""
        stages = range(len(self.depths))
        return tuple(self.embed_dims << stage for stage in stages)

    @property
    def stride(self) -> int:
        """Pixels of the image per cell of the features."""
        return _PATCH_PIXELS << self.out_stages[0]


class Swin(nn.Module):
    """Swin Transformer with a LayerNorm for each map that it returns.

    As in the release, there is no stochastic depth. Parameters have the released names;
    `from_official` converts the names of the official weights.

    Attributes:
        out_channels: Channels of the two maps.
    """

    def __init__(self, config: SwinConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.widths
        first, second = config.out_stages
        self.out_channels = (widths[first], widths[second])
        self.patch_embed = PatchEmbedding(config.embed_dims)
        last_stage = len(widths) - 1
        self.stages = nn.ModuleList(
            _SwinStage(config, i, downsample=i < last_stage) for i in range(len(widths))
        )
        for i in config.out_stages:
            self.add_module(f"norm{i}", nn.LayerNorm(widths[i]))
        self.apply(_initialise)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Encode images (N, 3, h, w); return the maps of `out_stages`, (N, C, h', w').

        Sizes are rounded up.
        """
        features = self.patch_embed(images)
        maps = []
        for i, stage in enumerate(self.stages):
            features, stage_features = stage(features)
            if i in self.config.out_stages:
                normalised = self.get_submodule(f"norm{i}")(stage_features)
                maps.append(normalised.permute(0, 3, 1, 2).contiguous())
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
        padded = functional.pad(images, (0, -width % _PATCH_PIXELS, 0, -height % _PATCH_PIXELS))
        tokens = self.projection(padded).permute(0, 2, 3, 1)
        return self.norm(tokens)


class _SwinStage(nn.Module):
    """Blocks of one resolution, and the layer that halves it for the next stage."""

    def __init__(self, config: SwinConfig, index: int, *, downsample: bool) -> None:
        super().__init__()
        self.checkpointing = config.checkpointing
        channels = config.widths[index]
        heads = config.num_heads[index]
        window = config.window_size
        self.blocks = nn.ModuleList()
        for i in range(config.depths[index]):
            shift = window // 2 if i % 2 else 0
            self.blocks.append(_SwinBlock(channels, heads, window, shift=shift))
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
        if self.downsample is None:
            return features, features
        return self.downsample(features), features


class _SwinBlock(nn.Module):
    """Window attention and a per-token MLP, each with a LayerNorm and a residual connection."""

    def __init__(self, channels: int, heads: int, window: int, *, shift: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels)
        self.attn = ShiftedWindowAttention(channels, heads, window, shift)
        self.norm2 = nn.LayerNorm(channels)
        hidden = _MLP_RATIO * channels
        hidden_layers = nn.Sequential(nn.Linear(channels, hidden), nn.GELU())
        layers = nn.Sequential(hidden_layers, nn.Linear(hidden, channels))
        self.ffn = nn.ModuleDict({"layers": layers})

    def forward(self, features: Tensor) -> Tensor:
        """Transform features (N, h, w, C); return the same shape."""
        attended = self.attn(self.norm1(features))
        features = features + attended
        transformed = self.ffn["layers"](self.norm2(features))
        return features + transformed


class PatchMerging(nn.Module):
    """Layer that merges four neighbouring tokens into one with twice the channels.

    A channel's four values are adjacent, in row-by-row order. The official order is by token,
    column by column; `from_official` converts it.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * channels)
        self.reduction = nn.Linear(4 * channels, 2 * channels, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        """Merge features (N, h, w, C) to (N, h / 2, w / 2, 2C); odd sizes are padded with zeros."""
        height, width = features.shape[1:3]
        padded = functional.pad(features, (0, 0, 0, width % 2, 0, height % 2))
        count, rows, columns, channels = padded.shape
        squares = padded.reshape(count, rows // 2, 2, columns // 2, 2, channels)
        merged = squares.permute(0, 1, 3, 5, 2, 4).flatten(3)
        return self.reduction(self.norm(merged))


def _initialise(module: nn.Module) -> None:
    """Draw a layer's initial weights, as in the release."""
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, _SwinAttention):
        nn.init.trunc_normal_(module.relative_position_bias_table, std=0.02)


def from_official(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convert official weights to the names and layout of `Swin`, without the classifier.

    Args:
        weights: State dict with the names of microsoft/Swin-Transformer (its files have it under
            `model`).

    Returns:
        The state dict. It contains `norm.*`, the classifier's norm, which `Swin` does not use, and
        lacks `norm2.*` and `norm3.*`, which must be learned. Therefore pass `strict=False` to
        `load_state_dict`.

    Raises:
        ConfigError: A name is not one of Swin's.
    """
    state = {}
    for name, tensor in weights.items():
        if _MERGING_NAMES.fullmatch(name):
            state[_convert_name(name)] = _reorder_merged_tokens(tensor)
        elif not _DROPPED_NAMES.fullmatch(name):
            state[_convert_name(name)] = tensor
    return state


def _convert_name(name: str) -> str:
    """Convert an official weight's name to that in `Swin`; raise ConfigError if it is unknown."""
    for pattern, template in _RENAMING_RULES:
        match = re.fullmatch(pattern, name)
        if match:
            return match.expand(template)
    raise ConfigError(
        "expected names of Swin's official weights, such as 'layers.0.blocks.0.norm1.weight', "
        f"found {shortened(name)!r}; if it is a file's content, give its entry 'model'"
    )


def _reorder_merged_tokens(tensor: Tensor) -> Tensor:
    """Reorder the values (…, 4C) of four merged tokens from token-major to channel-major order.

    Official tokens are ordered column by column: (0, 0), (1, 0), (0, 1), (1, 1). Ours are in
    reading order.
    """
    by_token = tensor.unflatten(-1, (4, -1))
    reading_order = by_token[..., [0, 2, 1, 3], :]
    return reading_order.transpose(-1, -2).flatten(-2)
