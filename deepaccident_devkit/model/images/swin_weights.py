"""Names and layouts of Swin's official weights → those of `Swin`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from torch import Tensor

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.reading import shortened

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
_DROPPED: Final = re.compile(r"head\..+|layers\.\d+\.blocks\.\d+\.attn_mask")
"""The classifier, and masks that depend on the size of the image alone."""
_MERGING: Final = re.compile(r"layers\.\d+\.downsample\.(norm\.weight|norm\.bias|reduction\.weight)")


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
    converted = {}
    for name, tensor in weights.items():
        if not _DROPPED.fullmatch(name):
            converted[_renamed(name)] = _channel_major(tensor) if _MERGING.fullmatch(name) else tensor
    return converted


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
