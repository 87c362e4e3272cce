"""The motion head's parts: distributions of the latent, future states by flow and GRU, and decoders to maps.

As in FIERY and BEVerse (the released `SpatialDistributionModule`): a diagonal normal distribution at each cell of a map
a quarter as fine as the features.

BEVerse's iterative flow (the released `ResFuturePrediction`).
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import GeometryError


class LatentDistribution(NamedTuple):
    """A diagonal normal distribution.

    Attributes:
        mu: (N, L, h, w) means.
        log_sigma: (N, L, h, w) logarithms of the standard deviations.
    """

    mu: Tensor
    log_sigma: Tensor

    def sample(self, noise: Tensor) -> Tensor:
        """The latent (N, L, h, w) that belongs to standard normal noise of that shape; raises GeometryError."""
        if noise.shape != self.mu.shape:
            raise GeometryError(
                f"noise: expected shape {tuple(self.mu.shape)}, found {tuple(noise.shape)}"
            )
        return self.mu + noise.to(self.mu) * self.log_sigma.exp()

    def noise(self, generator: torch.Generator | None = None) -> Tensor:
        """Standard normal noise of this shape, from a generator on the same device or from torch's own."""
        return torch.randn(
            self.mu.shape, generator=generator, device=self.mu.device, dtype=self.mu.dtype
        )


class SpatialDistribution(nn.Module):
    """Features → `LatentDistribution`: two bottlenecks of stride 2, and a 1 × 1 convolution."""

    def __init__(
        self, inputs: int, hidden: int, latent: int, log_sigma: tuple[float, float]
    ) -> None:
        """Make the layers, with `hidden` channels between them, and the range of `LatentDistribution.log_sigma`."""
        super().__init__()
        self._log_sigma = log_sigma
        self.encoder = nn.Sequential(
            OrderedDict(
                model=nn.Sequential(_Bottleneck(inputs, hidden), _Bottleneck(hidden, hidden))
            )
        )
        last = nn.Conv2d(hidden, 2 * latent, 1)
        # two distributions that begin far apart have a divergence of thousands, beside which nothing else is learned
        nn.init.normal_(last.weight, std=0.01)
        self.last_conv = nn.Sequential(last)

    def forward(self, features: Tensor) -> LatentDistribution:
        """Features (N, inputs, H, W) → means and log deviations, each (N, latent, H / 4, W / 4), rounded up."""
        mu, log_sigma = self.last_conv(self.encoder(features)).chunk(2, dim=1)
        return LatentDistribution(mu, log_sigma.clamp(*self._log_sigma))


class _Bottleneck(nn.Module):
    """Half the channels, a 3 × 3 convolution of stride 2, the wanted channels; plus a pooled and projected skip."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        inner = inputs // 2
        self.layers = nn.Sequential(
            OrderedDict(
                conv_down_project=nn.Conv2d(inputs, inner, 1, bias=False),
                abn_down_project=_norm(inner),
                conv=nn.Conv2d(inner, inner, 3, stride=2, padding=1, bias=False),
                abn=_norm(inner),
                conv_up_project=nn.Conv2d(inner, outputs, 1, bias=False),
                abn_up_project=_norm(outputs),
            )
        )
        self.projection = nn.Sequential(
            OrderedDict(
                conv_skip_proj=nn.Conv2d(inputs, outputs, 1, bias=False),
                bn_skip_proj=nn.BatchNorm2d(outputs),
            )
        )

    def forward(self, features: Tensor) -> Tensor:
        rows, columns = features.shape[-2:]
        # zeros count at a padded edge, as released
        padded = functional.pad(features, (0, columns % 2, 0, rows % 2))
        return self.layers(features) + self.projection(functional.max_pool2d(padded, 2))


def _norm(channels: int) -> nn.Sequential:
    return nn.Sequential(nn.BatchNorm2d(channels), nn.ReLU(inplace=True))


HiddenWarp = Literal["none", "warped"]
HIDDEN_WARPS: Final[tuple[HiddenWarp, ...]] = ("none", "warped")
# Standard deviation of the flow layer's first weights, so that training starts close to no motion.
_FLOW_DEVIATION: Final = 0.02


def warp_with_flow(features: Tensor, flow: Tensor) -> Tensor:
    """Features (N, C, H, W) at each cell plus its flow, by bilinear sampling; zero outside (the released function).

    The flow is (N, 2, H, W), cells: along the columns (channel 0) and down the rows (channel 1) to the source.
    """
    rows, columns = features.shape[-2:]
    # half precision cannot tell neighbouring cells of a large grid apart
    dtype = torch.promote_types(features.dtype, torch.float32)
    along = torch.arange(columns, device=flow.device, dtype=dtype) + flow[:, 0].to(dtype)
    down = torch.arange(rows, device=flow.device, dtype=dtype)[:, None] + flow[:, 1].to(dtype)
    points = torch.stack(
        [2 * along / max(columns - 1, 1) - 1, 2 * down / max(rows - 1, 1) - 1], dim=-1
    )
    return functional.grid_sample(features.to(dtype), points, align_corners=True).to(features.dtype)


class FlowGru(nn.Module):
    """Latent and present state → the states of the future frames (the released `ResFuturePrediction`)."""

    def __init__(
        self, channels: int, latent: int, frames: int, *, hidden_warp: HiddenWarp, detach: bool
    ) -> None:
        """Make the layers for so many future frames.

        The GRU updates the last state in its old place (`none`, as released), or moved along the flow as its input is
        (`warped`). With `detach`, gradients stop between a frame and the next, as released.
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
        """A latent (N, L, H, W) and the present (N, C, H, W) → the future states (N, frames, C, H, W)."""
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


_CHANNELS: Final = {
    "segmentation": 2,
    "instance_center": 1,
    "instance_offset": 2,
    "instance_flow": 2,
}
# First bias of the centres' logits: one cell in ten, so that empty cells do not dominate the first steps (CenterNet,
# arXiv:1904.07850).
_RARE: Final = -2.19


class PredictedMotionMaps(NamedTuple):
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
                name: _decoder(
                    channels,
                    channels,
                    count,
                    rare=slice(0, 1) if name == "instance_center" else None,
                )
                for name, count in _CHANNELS.items()
            }
        )

    def forward(self, states: Tensor) -> PredictedMotionMaps:
        """Decode states (M, C, H, W) to maps (M, …, H, W)."""
        return PredictedMotionMaps(**{name: decoder(states) for name, decoder in self.items()})


class ShuffledDecoder(nn.Module):
    """Our small decoder: all maps from the same few channels; each finer cell has channels of its own."""

    def __init__(self, channels: int, hidden: int, upsample: int) -> None:
        """Make the layers: `hidden` channels after the 3 × 3 convolution, `upsample` cells of maps to one of states."""
        super().__init__()
        self._upsample, cells = upsample, upsample**2
        first = cells * _CHANNELS["segmentation"]
        self.layers = _decoder(
            channels, hidden, cells * sum(_CHANNELS.values()), rare=slice(first, first + cells)
        )

    def forward(self, states: Tensor) -> PredictedMotionMaps:
        """Decode states (M, C, H, W) to maps (M, …, H', W') on the finer grid."""
        maps = functional.pixel_shuffle(self.layers(states), self._upsample)
        return PredictedMotionMaps(*maps.split(list(_CHANNELS.values()), dim=1))


def _decoder(channels: int, hidden: int, outputs: int, *, rare: slice | None) -> nn.Sequential:
    """Two convolutions; `rare` says which outputs are centres' logits, if there are any."""
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
