"""`Swin`: the image backbone of the release, a Swin Transformer (Liu et al., ICCV 2021)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.images.swin_attention import ShiftedWindowAttention, WindowAttention

_PATCH = 4
"""Pixels along the side of a patch."""
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
            raise ConfigError(f"num_heads: expected {stages}, one for each of depths, found {self.num_heads!r}")
        for width, heads in zip(self.widths, self.num_heads, strict=True):
            if width % heads:
                raise ConfigError(f"num_heads: {width} channels cannot be shared by {heads} heads; choose a divisor")
        if self.out_stages not in pairwise(range(stages)):
            raise ConfigError(f"out_stages: expected one of {[*pairwise(range(stages))]}, found {self.out_stages!r}")

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

    Parameters have the released names; `swin_weights` converts those of the official weights.

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
            Stage(config, i, downsample=i < len(config.depths) - 1) for i in range(len(config.depths))
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
        fine, coarse = maps
        return fine, coarse


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


class Stage(nn.Module):
    """Blocks of one resolution, and what halves it for the next stage."""

    def __init__(self, config: SwinConfig, index: int, *, downsample: bool) -> None:
        super().__init__()
        self.checkpointing = config.checkpointing
        channels, heads, window = config.widths[index], config.num_heads[index], config.window_size
        self.blocks = nn.ModuleList(
            Block(channels, heads, window, shift=window // 2 if i % 2 else 0) for i in range(config.depths[index])
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


class Block(nn.Module):
    """Window attention and a perceptron of each token, each after a LayerNorm and beside a shortcut."""

    def __init__(self, channels: int, heads: int, window: int, *, shift: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels)
        self.attn = ShiftedWindowAttention(channels, heads, window, shift)
        self.norm2 = nn.LayerNorm(channels)
        hidden = _MLP_RATIO * channels
        layers = nn.Sequential(nn.Sequential(nn.Linear(channels, hidden), nn.GELU()), nn.Linear(hidden, channels))
        self.ffn = nn.ModuleDict({"layers": layers})

    def forward(self, features: Tensor) -> Tensor:
        """Features (N, h, w, C) → the same shape."""
        features = features + self.attn(self.norm1(features))
        return features + self.ffn["layers"](self.norm2(features))


class PatchMerging(nn.Module):
    """Four neighbouring tokens → one with twice the channels; a channel's four values stand together, row by row.

    (The official order is by token, and down before along: `swin_weights`.)
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * channels)
        self.reduction = nn.Linear(4 * channels, 2 * channels, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        """Features (N, h, w, C) → (N, h / 2, w / 2, 2C); zeros fill what lacks to even sizes."""
        padded = nn.functional.pad(features, (0, 0, 0, features.shape[2] % 2, 0, features.shape[1] % 2))
        count, rows, columns, channels = padded.shape
        cut = padded.reshape(count, rows // 2, 2, columns // 2, 2, channels)
        return self.reduction(self.norm(cut.permute(0, 1, 3, 5, 2, 4).flatten(3)))


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.trunc_normal_(module.weight, std=0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, WindowAttention):
        nn.init.trunc_normal_(module.relative_position_bias_table, std=0.02)
