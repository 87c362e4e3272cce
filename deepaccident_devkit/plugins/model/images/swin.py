"""`Swin`: the image backbone of the release, a Swin Transformer (Liu et al., ICCV 2021), and its official weights."""

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


class _SwinAttention(nn.Module):
    """Multi-head self-attention of the tokens of one window, with a learned bias for each relative position."""

    relative_position_index: Tensor

    def __init__(self, channels: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads = heads
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        self.register_buffer("relative_position_index", relative_positions(window))
        self.qkv = nn.Linear(channels, 3 * channels)
        self.proj = nn.Linear(channels, channels)

    def forward(self, tokens: Tensor, together: Tensor | None = None) -> Tensor:
        """Attend in K windows of L tokens, (N, K, L, C); `together` (K, L, L) bool tells which may see each other."""
        channels = tokens.shape[-1]
        # (N, K, L, 3C) → query, key and value, each (N, K, heads, L, C / heads)
        parts = self.qkv(tokens).unflatten(-1, (3, self.heads, channels // self.heads))
        query, key, value = parts.permute(3, 0, 1, 4, 2, 5).unbind(0)
        scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
        scores = scores + self.relative_position_bias_table[self.relative_position_index].permute(
            2, 0, 1
        )
        if together is not None:
            scores = scores.masked_fill(~together[:, None], -torch.inf)
        return self.proj((scores.softmax(-1) @ value).transpose(2, 3).flatten(3))


class ShiftedWindowAttention(nn.Module):
    """A map cut into windows of which each attends to itself; `shift` moves the windows, and the map is a torus.

    A map that is not a whole number of windows is filled with zeros on the right and at the bottom. As in the release,
    tokens see the filling as they see others.
    """

    def __init__(self, channels: int, heads: int, window: int, shift: int) -> None:
        super().__init__()
        self.window, self.shift = window, shift
        self.w_msa = _SwinAttention(channels, heads, window)

    def forward(self, features: Tensor) -> Tensor:
        """Features (N, h, w, C) → the same shape."""
        height, width = features.shape[1:3]
        padded = functional.pad(features, (0, 0, 0, -width % self.window, 0, -height % self.window))
        rows, columns = padded.shape[1:3]
        together = None
        if self.shift:
            padded = padded.roll((-self.shift, -self.shift), (1, 2))
            together = neighbours(rows, columns, self.window, self.shift, padded.device)
        attended = self.w_msa(windows_of(padded, self.window), together)
        result = map_of(attended, rows, columns)
        if self.shift:
            result = result.roll((self.shift, self.shift), (1, 2))
        return result[:, :height, :width]


def relative_positions(window: int) -> Tensor:
    """(L, L) int64 for L = window² tokens: the row of the bias table for a query (first axis) and a key."""
    cells = torch.cartesian_prod(torch.arange(window), torch.arange(window))
    down, along = (cells[:, None] - cells + window - 1).unbind(-1)
    return down * (2 * window - 1) + along


def windows_of(features: Tensor, window: int) -> Tensor:
    """A map (N, h, w, C) of whole windows as (N, K, L, C): K windows in reading order of L = window² tokens."""
    count, rows, columns, channels = features.shape
    cut = features.view(count, rows // window, window, columns // window, window, channels)
    return cut.transpose(2, 3).reshape(count, -1, window * window, channels)


def map_of(windows: Tensor, rows: int, columns: int) -> Tensor:
    """The map (N, rows, columns, C) that `windows_of` cut."""
    count, _, tokens, channels = windows.shape
    window = round(tokens**0.5)
    cut = windows.view(count, rows // window, columns // window, window, window, channels)
    return cut.transpose(2, 3).reshape(count, rows, columns, channels)


def neighbours(
    rows: int, columns: int, window: int, shift: int, device: torch.device | str | None = None
) -> Tensor:
    """Which tokens of the windows of a shifted map may see each other, (K, L, L) bool.

    Those that lay beside each other before the shift: not the two sides of the map that it brought together.
    """
    # in the last row and column of windows the last `shift` steps come from the other side
    down, along = (
        (torch.arange(size, device=device) >= size - shift).long() for size in (rows, columns)
    )
    sides = windows_of((2 * down[:, None] + along)[None, :, :, None], window)[0, :, :, 0]
    return sides[:, :, None] == sides[:, None, :]


# Pixels along the side of a patch.
_PATCH = 4
_MLP_RATIO = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class SwinConfig:
    """Sizes of the Swin Transformer; the defaults are Swin-T's, as in the release.

    Attributes:
        embed_dims: channels of the first stage; each further stage has twice as many.
        depths: blocks of each stage.
        num_heads: of each stage.
        window_size: tokens along the side of a window.
        out_stages: the two stages whose maps are the result, the second after the first; stage i is at 1 / 2^(i + 2)
            of the image's resolution.
        checkpointing: whether training computes blocks again for the gradient, which saves memory and costs time.
        neck_channels: of the features.
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
                    f"num_heads: {width} channels cannot be shared by {heads} heads; choose a divisor"
                )
        if self.out_stages not in pairwise(range(stages)):
            raise ConfigError(
                f"out_stages: expected one of {[*pairwise(range(stages))]}, found {self.out_stages!r}"
            )

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of each stage."""
        return tuple(self.embed_dims << i for i in range(len(self.depths)))

    @property
    def stride(self) -> int:
        """Pixels of the image a step of the features."""
        return _PATCH << self.out_stages[0]


class Swin(nn.Module):
    """Swin Transformer with a LayerNorm for each map of its result, without stochastic depth, as in the release.

    Parameters have the released names; `from_official` converts those of the official weights.

    Attributes:
        out_channels: of the two maps.
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
        """Images (N, 3, h, w) → the maps of `out_stages`, (N, C, h', w'), sizes rounded up."""
        features, maps = self.patch_embed(images), []
        for i, stage in enumerate(self.stages):
            features, larger = stage(features)
            if i in self.config.out_stages:
                maps.append(self.get_submodule(f"norm{i}")(larger).permute(0, 3, 1, 2).contiguous())
        return maps[0], maps[1]


class PatchEmbedding(nn.Module):
    """Patches of 4×4 pixels → tokens."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.projection = nn.Conv2d(3, channels, _PATCH, _PATCH)
        self.norm = nn.LayerNorm(channels)

    def forward(self, images: Tensor) -> Tensor:
        """Images (N, 3, h, w) → (N, h / 4, w / 4, C); black fills what lacks of the last patches."""
        height, width = images.shape[-2:]
        padded = nn.functional.pad(images, (0, -width % _PATCH, 0, -height % _PATCH))
        return self.norm(self.projection(padded).permute(0, 2, 3, 1))


class _SwinStage(nn.Module):
    """Blocks of one resolution, and what halves it for the next stage."""

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
        """Features (N, h, w, C) → those for the next stage, (N, h / 2, w / 2, 2C), and this stage's, (N, h, w, C)."""
        for block in self.blocks:
            if self.checkpointing and self.training:
                features = checkpoint(block, features, use_reentrant=False)
            else:
                features = block(features)
        return (features if self.downsample is None else self.downsample(features)), features


class _SwinBlock(nn.Module):
    """Window attention and a perceptron of each token, each after a LayerNorm and beside a shortcut."""

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
        """Features (N, h, w, C) → the same shape."""
        features = features + self.attn(self.norm1(features))
        return features + self.ffn["layers"](self.norm2(features))


class PatchMerging(nn.Module):
    """Four neighbouring tokens → one with twice the channels; a channel's four values stand together, row by row.

    (The official order is by token, and down before along: `from_official`.)
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * channels)
        self.reduction = nn.Linear(4 * channels, 2 * channels, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        """Features (N, h, w, C) → (N, h / 2, w / 2, 2C); zeros fill what lacks to even sizes."""
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


_RENAMED: Final = (
    (r"patch_embed\.proj\.(.+)", r"patch_embed.projection.\1"),
    (r"(patch_embed\.norm\..+)", r"\1"),
    (r"layers\.(\d+\.blocks\.\d+\.norm[12]\..+)", r"stages.\1"),
    (r"layers\.(\d+\.blocks\.\d+\.attn)\.(.+)", r"stages.\1.w_msa.\2"),
    (r"layers\.(\d+\.blocks\.\d+)\.mlp\.fc1\.(.+)", r"stages.\1.ffn.layers.0.0.\2"),
    (r"layers\.(\d+\.blocks\.\d+)\.mlp\.fc2\.(.+)", r"stages.\1.ffn.layers.1.\2"),
    (r"layers\.(\d+\.downsample\..+)", r"stages.\1"),
    (r"(norm\..+)", r"\1"),
)
# The classifier, and masks that depend on the size of the image alone.
_DROPPED: Final = re.compile(r"head\..+|layers\.\d+\.blocks\.\d+\.attn_mask")
_MERGING: Final = re.compile(
    r"layers\.\d+\.downsample\.(norm\.weight|norm\.bias|reduction\.weight)"
)


def from_official(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A state dict with the names and the layout of `Swin`, without the classifier.

    Args:
        weights: with the names of microsoft/Swin-Transformer (in its files they are under `model`).

    Returns:
        `norm.*`, the classifier's norm, is among them, and is not used by `Swin`; `norm2.*` and `norm3.*` are not, and
        are to be learned. So `load_state_dict` needs `strict=False`.

    Raises:
        ConfigError: a name is not one of Swin's.
    """
    return {
        _renamed(name): _channel_major(tensor) if _MERGING.fullmatch(name) else tensor
        for name, tensor in weights.items()
        if not _DROPPED.fullmatch(name)
    }


def _renamed(name: str) -> str:
    for pattern, template in _RENAMED:
        match = re.fullmatch(pattern, name)
        if match:
            return match.expand(template)
    raise ConfigError(
        "expected names of Swin's official weights, such as 'layers.0.blocks.0.norm1.weight', found "
        f"{shortened(name)!r}; if it is a file's content, give its entry 'model'"
    )


def _channel_major(tensor: Tensor) -> Tensor:
    """Values (…, 4C) of the four tokens that are merged, from token-major to channel-major.

    Official tokens come down, then along: (0, 0), (1, 0), (0, 1), (1, 1). Ours come in reading order.
    """
    by_token = tensor.unflatten(-1, (4, -1))[..., [0, 2, 1, 3], :]
    return by_token.transpose(-1, -2).flatten(-2)
