"""The future states of the BEV features: each is the last one moved along a predicted flow and updated by a GRU.

BEVerse's iterative flow (the released `ResFuturePrediction`).
"""

from __future__ import annotations

from typing import Final, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional


HiddenWarp = Literal["none", "warped"]
HIDDEN_WARPS: Final[tuple[HiddenWarp, ...]] = ("none", "warped")
_FLOW_DEVIATION: Final = 0.02
"""Standard deviation of the flow layer's first weights, so that training starts close to no motion."""


def warp_with_flow(features: Tensor, flow: Tensor) -> Tensor:
    """Features at each cell plus its flow, by bilinear sampling; zero outside (the released `warp_with_flow`).

    Args:
        features: (N, C, H, W).
        flow: (N, 2, H, W), cells: along the columns (channel 0) and down the rows (channel 1) to the source.

    Returns:
        (N, C, H, W).
    """
    rows, columns = features.shape[-2:]
    # half precision cannot tell neighbouring cells of a large grid apart
    dtype = torch.promote_types(features.dtype, torch.float32)
    along = torch.arange(columns, device=flow.device, dtype=dtype) + flow[:, 0].to(dtype)
    down = torch.arange(rows, device=flow.device, dtype=dtype)[:, None] + flow[:, 1].to(dtype)
    points = torch.stack([2 * along / max(columns - 1, 1) - 1, 2 * down / max(rows - 1, 1) - 1], dim=-1)
    return functional.grid_sample(features.to(dtype), points, align_corners=True).to(features.dtype)


class FlowGru(nn.Module):
    """Latent and present state → the states of the future frames (the released `ResFuturePrediction`)."""

    def __init__(self, channels: int, latent: int, frames: int, *, hidden_warp: HiddenWarp, detach: bool) -> None:
        """Make the layers.

        Args:
            channels: of the states.
            latent: channels of the latent.
            frames: future frames.
            hidden_warp: which state the GRU updates: the last one in its old place (`none`, as released), or moved
                along the flow as its input is (`warped`).
            detach: whether gradients stop between a frame and the next, as released.
        """
        super().__init__()
        self._frames, self._hidden_warp, self._detach = frames, hidden_warp, detach
        joint = channels + latent
        self.offset_conv = _ConvNorm(joint, joint)
        self.offset_pred = nn.Conv2d(joint, 2, 1)
        nn.init.normal_(self.offset_pred.weight, std=_FLOW_DEVIATION)
        nn.init.zeros_(self.offset_pred.get_parameter("bias"))
        self.gru_cells = nn.ModuleList([_GruCell(joint, channels)])
        self.spatial_conv = _ConvNorm(channels, channels)

    def forward(self, latent: Tensor, state: Tensor) -> Tensor:
        """Predict the states of the future frames.

        Args:
            latent: (N, L, H, W).
            state: (N, C, H, W) of the present.

        Returns:
            (N, frames, C, H, W).
        """
        states = []
        for _ in range(self._frames):
            flow = self.offset_pred(self.offset_conv(torch.cat([latent, state], dim=1)))
            moved = warp_with_flow(state, flow)
            hidden = state if self._hidden_warp == "none" else moved
            state = self.spatial_conv(self.gru_cells[0](torch.cat([moved, latent], dim=1), hidden))
            states.append(state)
            if self._detach:
                state = state.detach()
        return torch.stack(states, dim=1)


class _GruCell(nn.Module):
    """A GRU of convolutions whose reset gate is the share that is *forgotten*, as in FIERY."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.conv_update = nn.Conv2d(inputs + channels, channels, 3, padding=1)
        self.conv_reset = nn.Conv2d(inputs + channels, channels, 3, padding=1)
        self.conv_state_tilde = _ConvNorm(inputs + channels, channels)

    def forward(self, inputs: Tensor, state: Tensor) -> Tensor:
        both = torch.cat([inputs, state], dim=1)
        update, reset = self.conv_update(both).sigmoid(), self.conv_reset(both).sigmoid()
        proposed = self.conv_state_tilde(torch.cat([inputs, (1 - reset) * state], dim=1))
        return (1 - update) * state + update * proposed


class _ConvNorm(nn.Module):
    """A 3 × 3 convolution without bias, batch norm and ReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, features: Tensor) -> Tensor:
        return functional.relu(self.norm(self.conv(features)), inplace=True)
