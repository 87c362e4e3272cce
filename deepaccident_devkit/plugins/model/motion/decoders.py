"""The motion head's parts: distributions of the latent, future states, and decoders to maps.

As in FIERY and BEVerse (the released `SpatialDistributionModule`), the latent has a diagonal normal
distribution at each cell of a map with a quarter of the features' resolution. Future states follow
from BEVerse's iterative flow and a GRU (the released `ResFuturePrediction`).
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import GeometryError

# Standard deviation of the flow layer's first weights, so that training starts close to no motion.
_FLOW_DEVIATION: Final = 0.02
_CHANNELS: Final = {
    "segmentation": 2,
    "instance_center": 1,
    "instance_offset": 2,
    "instance_flow": 2,
}
# First bias of the centres' logits: one cell in ten, so that empty cells do not dominate the first
# steps (CenterNet, arXiv:1904.07850).
_CENTER_BIAS: Final = -2.19


class LatentDistribution(NamedTuple):
    """A diagonal normal distribution.

    Attributes:
        mu: Means, shape (N, L, h, w).
        log_sigma: Logarithms of the standard deviations, shape (N, L, h, w).
    """

    mu: Tensor
    log_sigma: Tensor

    def sample(self, noise: Tensor) -> Tensor:
        """Return the latent (N, L, h, w) of standard normal noise with that shape.

        Raises GeometryError for another shape.
        """
        if noise.shape != self.mu.shape:
            raise GeometryError(
                f"noise: expected shape {tuple(self.mu.shape)}, found {tuple(noise.shape)}"
            )
        return self.mu + noise.to(self.mu) * self.log_sigma.exp()

    def noise(self, generator: torch.Generator | None = None) -> Tensor:
        """Draw standard normal noise of this shape.

        The generator is on the same device; None stands for torch's own.
        """
        return torch.randn(
            self.mu.shape, generator=generator, device=self.mu.device, dtype=self.mu.dtype
        )


class SpatialDistribution(nn.Module):
    """Encoder of features as a `LatentDistribution`.

    It has two bottlenecks of stride 2 and a 1 × 1 convolution.
    """

    def __init__(
        self, inputs: int, hidden: int, latent: int, log_sigma: tuple[float, float]
    ) -> None:
        """Build the layers, with `hidden` channels between them.

        `log_sigma` is the range of `LatentDistribution.log_sigma`.
        """
        super().__init__()
        self._log_sigma = log_sigma
        bottlenecks = nn.Sequential(_Bottleneck(inputs, hidden), _Bottleneck(hidden, hidden))
        self.encoder = nn.Sequential(OrderedDict(model=bottlenecks))
        final_conv = nn.Conv2d(hidden, 2 * latent, 1)
        # Two distributions that begin far apart have a divergence of thousands, and then nothing
        # else is learned.
        nn.init.normal_(final_conv.weight, std=0.01)
        self.last_conv = nn.Sequential(final_conv)

    def forward(self, features: Tensor) -> LatentDistribution:
        """Encode features (N, inputs, H, W) as means and log deviations.

        Each has shape (N, latent, H / 4, W / 4), rounded up.
        """
        mu, log_sigma = self.last_conv(self.encoder(features)).chunk(2, dim=1)
        return LatentDistribution(mu, log_sigma.clamp(*self._log_sigma))


class _Bottleneck(nn.Module):
    """Half the channels, a 3 × 3 convolution of stride 2, then the output channels.

    A pooled and projected skip is added.
    """

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
        # As released, the padding's zeros count at an edge.
        padded = functional.pad(features, (0, columns % 2, 0, rows % 2))
        return self.layers(features) + self.projection(functional.max_pool2d(padded, 2))


def _norm(channels: int) -> nn.Sequential:
    return nn.Sequential(nn.BatchNorm2d(channels), nn.ReLU(inplace=True))


HiddenWarp = Literal["none", "warped"]
HIDDEN_WARPS: Final[tuple[HiddenWarp, ...]] = ("none", "warped")


def warp_with_flow(features: Tensor, flow: Tensor) -> Tensor:
    """Return features (N, C, H, W) sampled at each cell plus its flow (the released function).

    Sampling is bilinear; features are zero outside the map. The flow leads to the source, in cells,
    along the columns (channel 0) and down the rows (channel 1), shape (N, 2, H, W).
    """
    rows, columns = features.shape[-2:]
    # Half precision cannot distinguish neighbouring cells of a large grid.
    dtype = torch.promote_types(features.dtype, torch.float32)
    x = torch.arange(columns, device=flow.device, dtype=dtype) + flow[:, 0].to(dtype)
    y = torch.arange(rows, device=flow.device, dtype=dtype)[:, None] + flow[:, 1].to(dtype)
    scaled_x = 2 * x / max(columns - 1, 1) - 1
    scaled_y = 2 * y / max(rows - 1, 1) - 1
    points = torch.stack([scaled_x, scaled_y], dim=-1)
    return functional.grid_sample(features.to(dtype), points, align_corners=True).to(features.dtype)


class FlowGru(nn.Module):
    """Prediction of future states from a latent and the present state.

    It is the released `ResFuturePrediction`.
    """

    def __init__(
        self, channels: int, latent: int, frames: int, *, hidden_warp: HiddenWarp, detach: bool
    ) -> None:
        """Build the layers for a number of future frames.

        The GRU updates the previous state in its old place (`none`, as released), or warped with
        the flow like its input (`warped`). With `detach`, gradients stop between a frame and the
        next, as released.
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
        """Return future states (N, frames, C, H, W) of a latent (N, L, H, W) and the present state.

        The present state has shape (N, C, H, W).
        """
        states = []
        for _ in range(self._frames):
            flow = self.offset_pred(self.offset_conv(torch.cat([latent, state], dim=1)))
            warped = warp_with_flow(state, flow)
            hidden = state if self._hidden_warp == "none" else warped
            inputs = torch.cat([warped, latent], dim=1)
            state = self.spatial_conv(self.gru_cells[0](inputs, hidden))
            states.append(state)
            if self._detach:
                state = state.detach()
        return torch.stack(states, dim=1)


class _GruCell(nn.Module):
    """A GRU of convolutions with a reset gate that is the *forgotten* share, as in FIERY."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.conv_update = nn.Conv2d(inputs + channels, channels, 3, padding=1)
        self.conv_reset = nn.Conv2d(inputs + channels, channels, 3, padding=1)
        self.conv_state_tilde = _ConvNorm(inputs + channels, channels)

    def forward(self, inputs: Tensor, state: Tensor) -> Tensor:
        joint = torch.cat([inputs, state], dim=1)
        update = self.conv_update(joint).sigmoid()
        reset = self.conv_reset(joint).sigmoid()
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


class PredictedMotionMaps(NamedTuple):
    """The maps of a motion prediction, in the orientation of the features.

    Vectors are in cells of these maps.

    Attributes:
        segmentation: Logits of background and foreground, shape (…, T, 2, H, W).
        instance_center: Logits of a centre, shape (…, T, 1, H, W).
        instance_offset: Offset to the centre, down the rows and along the columns, shape (…, T, 2,
            H, W).
        instance_flow: Offset to the centre in the next frame, down the rows and along the columns,
            shape (…, T, 2, H, W).
    """

    segmentation: Tensor
    instance_center: Tensor
    instance_offset: Tensor
    instance_flow: Tensor


class SeparateDecoders(nn.ModuleDict):
    """The released task heads: a 3 × 3 and a 1 × 1 convolution for each map.

    Maps have the resolution of the states.
    """

    def __init__(self, channels: int) -> None:
        """Build the layers for states with a number of channels."""
        decoders = {}
        for name, count in _CHANNELS.items():
            centers = slice(0, 1) if name == "instance_center" else None
            decoders[name] = _decoder(channels, channels, count, centers=centers)
        super().__init__(decoders)

    def forward(self, states: Tensor) -> PredictedMotionMaps:
        """Decode states (M, C, H, W) to maps (M, …, H, W)."""
        return PredictedMotionMaps(**{name: decoder(states) for name, decoder in self.items()})


class ShuffledDecoder(nn.Module):
    """Our small decoder: all maps from a few channels; each finer cell has its own channels."""

    def __init__(self, channels: int, hidden: int, upsample: int) -> None:
        """Build the layers.

        `hidden` is the number of channels after the 3 × 3 convolution, and `upsample` the number of
        the maps' cells along a cell of the states.
        """
        super().__init__()
        self._upsample, cells = upsample, upsample**2
        start = cells * _CHANNELS["segmentation"]
        outputs = cells * sum(_CHANNELS.values())
        self.layers = _decoder(channels, hidden, outputs, centers=slice(start, start + cells))

    def forward(self, states: Tensor) -> PredictedMotionMaps:
        """Decode states (M, C, H, W) to maps (M, …, H', W') on the finer grid."""
        maps = functional.pixel_shuffle(self.layers(states), self._upsample)
        return PredictedMotionMaps(*maps.split(list(_CHANNELS.values()), dim=1))


def _decoder(channels: int, hidden: int, outputs: int, *, centers: slice | None) -> nn.Sequential:
    """Return two convolutions; `centers` are the outputs with centres' logits, None without any."""
    output_conv = nn.Conv2d(hidden, outputs, 1)
    if centers is not None:
        with torch.no_grad():
            output_conv.get_parameter("bias")[centers] = _CENTER_BIAS
    return nn.Sequential(
        nn.Conv2d(channels, hidden, 3, padding=1, bias=False),
        nn.BatchNorm2d(hidden),
        nn.ReLU(inplace=True),
        output_conv,
    )
