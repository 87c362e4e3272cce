"""What is read off each frame's state: segmentation, instances' centres, and their offset and flow vectors."""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional


_CHANNELS: Final = {"segmentation": 2, "instance_center": 1, "instance_offset": 2, "instance_flow": 2}
_RARE: Final = -2.19
"""First bias of the centres' logits: one cell in ten, so that empty cells do not dominate the first steps (CenterNet,
arXiv:1904.07850)."""


class MotionMaps(NamedTuple):
    """The maps of a motion prediction, in the orientation of the features; vectors in cells of these maps.

    Attributes:
        segmentation: (…, T, 2, H, W) logits of background and foreground.
        instance_center: (…, T, 1, H, W) logits of a centre.
        instance_offset: (…, T, 2, H, W) to the centre, down the rows and along the columns.
        instance_flow: (…, T, 2, H, W) to the centre in the next frame, down the rows and along the columns.
    """

    segmentation: Tensor
    instance_center: Tensor
    instance_offset: Tensor
    instance_flow: Tensor


class SeparateDecoders(nn.ModuleDict):
    """The released task heads: for each map a 3 × 3 and a 1 × 1 convolution, at the states' resolution."""

    def __init__(self, channels: int) -> None:
        """Make the layers for states of so many channels."""
        super().__init__(
            {
                name: _decoder(channels, channels, count, rare=0 if name == "instance_center" else None)
                for name, count in _CHANNELS.items()
            }
        )

    def forward(self, states: Tensor) -> MotionMaps:
        """Decode states (M, C, H, W) to maps (M, …, H, W)."""
        return MotionMaps(**{name: decoder(states) for name, decoder in self.items()})


class SharedDecoder(nn.Module):
    """Our small decoder: all maps from the same few channels, brought to a finer grid."""

    def __init__(self, channels: int, hidden: int, upsample: int) -> None:
        """Make the layers.

        Args:
            channels: of the states.
            hidden: channels after the 3 × 3 convolution.
            upsample: how many cells of the maps lie along a cell of the states.
        """
        super().__init__()
        self._upsample = upsample
        self.layers = _decoder(channels, hidden, sum(_CHANNELS.values()), rare=_CHANNELS["segmentation"])

    def forward(self, states: Tensor) -> MotionMaps:
        """Decode states (M, C, H, W) to maps (M, …, H', W') on the finer grid."""
        maps = self.layers(states)
        if self._upsample > 1:
            # after the 1 × 1 convolution: the same values as before it, from fewer channels
            maps = functional.interpolate(maps, scale_factor=self._upsample, mode="bilinear", align_corners=False)
        return MotionMaps(*maps.split(list(_CHANNELS.values()), dim=1))


def _decoder(channels: int, hidden: int, outputs: int, *, rare: int | None) -> nn.Sequential:
    """Two convolutions; `rare` is the output that is a centre's logit, if there is one."""
    last = nn.Conv2d(hidden, outputs, 1)
    if rare is not None:
        with torch.no_grad():
            last.get_parameter("bias")[rare] = _RARE
    return nn.Sequential(
        nn.Conv2d(channels, hidden, 3, padding=1, bias=False),
        nn.BatchNorm2d(hidden),
        nn.ReLU(inplace=True),
        last,
    )
