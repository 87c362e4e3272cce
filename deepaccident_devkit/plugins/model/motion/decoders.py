"""The motion head's parts: distributions of the latent, future states, and decoders to maps.

As in FIERY and BEVerse (the released `SpatialDistributionModule`), the latent has a diagonal normal
distribution at each cell of a map with a quarter of the features' resolution. Future states follow
from BEVerse's iterative flow and a GRU (the released `ResFuturePrediction`).
"""

from collections import OrderedDict
from typing import Final, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.plugins.model.warps import precise

HiddenWarp = Literal["none", "warped"]
HIDDEN_WARPS: Final[tuple[HiddenWarp, ...]] = ("none", "warped")
# Standard deviation of the flow layer's first weights, so that training starts close to no motion.
_FLOW_DEVIATION = 0.02
_CHANNELS = {
    "segmentation": 2,
    "instance_center": 1,
    "instance_offset": 2,
    "instance_flow": 2,
}
# Rows and columns by which a bottleneck divides the resolution.
_STRIDE = 2
# First bias of the centres' logits: one cell in ten, so that empty cells do not dominate the first
# steps (CenterNet, arXiv:1904.07850).
_CENTER_BIAS = -2.19


class LatentDistribution(NamedTuple):
    """A diagonal normal distribution of the latent at each cell of a map.

    Attributes:
        mu: Means, shape (N, L, h, w).
        log_sigma: Logarithms of the standard deviations, shape (N, L, h, w).
    """

    mu: Tensor
    log_sigma: Tensor

    def sample(self, noise: Tensor) -> Tensor:
        """Transform standard normal noise (N, L, h, w) to a latent of this distribution.

        Raises GeometryError if the noise has another shape.
        """
        if noise.shape != self.mu.shape:
            raise GeometryError(
                f"noise: expected shape {tuple(self.mu.shape)}, found {tuple(noise.shape)}"
            )
        deviation = self.log_sigma.exp()
        scaled_noise = noise.to(self.mu) * deviation
        return self.mu + scaled_noise

    def noise(self, generator: torch.Generator | None = None) -> Tensor:
        """Draw standard normal noise of the distribution's shape, (N, L, h, w).

        The generator must be on the same device; None for torch's default generator.
        """
        mu = self.mu
        return torch.randn(mu.shape, generator=generator, device=mu.device, dtype=mu.dtype)


class SpatialDistribution(nn.Module):
    """Encoder of features into a `LatentDistribution`.

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
        output = self.last_conv(self.encoder(features))
        mu, log_sigma = output.chunk(2, dim=1)
        return LatentDistribution(mu, log_sigma.clamp(*self._log_sigma))


class _Bottleneck(nn.Module):
    """A 3 × 3 convolution of stride 2 with half the channels, between two 1 × 1 convolutions.

    A skip, which is pooled and projected, is added to the result.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        inner = inputs // 2
        self.layers = nn.Sequential(
            OrderedDict(
                conv_down_project=nn.Conv2d(inputs, inner, 1, bias=False),
                abn_down_project=_make_norm(inner),
                conv=nn.Conv2d(inner, inner, 3, stride=_STRIDE, padding=1, bias=False),
                abn=_make_norm(inner),
                conv_up_project=nn.Conv2d(inner, outputs, 1, bias=False),
                abn_up_project=_make_norm(outputs),
            )
        )
        self.projection = nn.Sequential(
            OrderedDict(
                conv_skip_proj=nn.Conv2d(inputs, outputs, 1, bias=False),
                bn_skip_proj=nn.BatchNorm2d(outputs),
            )
        )

    def forward(self, features: Tensor) -> Tensor:
        """Transform features (N, inputs, H, W) to (N, outputs, H / 2, W / 2), rounded up."""
        rows, columns = features.shape[-2:]
        # As released, the padding's zeros count at an edge.
        padded = functional.pad(features, (0, columns % _STRIDE, 0, rows % _STRIDE))
        output = self.layers(features)
        skip = self.projection(functional.max_pool2d(padded, _STRIDE))
        return output + skip


def _make_norm(channels: int) -> nn.Sequential:
    """Return a batch norm with a ReLU."""
    return nn.Sequential(nn.BatchNorm2d(channels), nn.ReLU(inplace=True))


def warp_with_flow(features: Tensor, flow: Tensor) -> Tensor:
    """Return features (N, C, H, W) sampled at each cell plus its flow (the released function).

    Sampling is bilinear; features are zero outside the map. The flow leads to the source, in cells,
    along the columns (channel 0) and down the rows (channel 1), shape (N, 2, H, W).
    """
    rows, columns = features.shape[-2:]
    # Half precision cannot distinguish neighbouring cells of a large grid.
    precise_features = precise(features)
    flow = flow.to(precise_features.dtype)
    x = torch.arange(columns, device=flow.device, dtype=flow.dtype) + flow[:, 0]
    y = torch.arange(rows, device=flow.device, dtype=flow.dtype)[:, None] + flow[:, 1]
    scaled_x = 2 * x / max(columns - 1, 1) - 1
    scaled_y = 2 * y / max(rows - 1, 1) - 1
    points = torch.stack([scaled_x, scaled_y], dim=-1)
    sampled = functional.grid_sample(precise_features, points, align_corners=True)
    return sampled.to(features.dtype)


class FlowGru(nn.Module):
    """Layer that predicts future states from a latent and the present state.

    This is the released `ResFuturePrediction`.
    """

    def __init__(
        self, channels: int, latent: int, frames: int, *, hidden_warp: HiddenWarp, detach: bool
    ) -> None:
        """Build the layers for a number of future frames.

        The GRU updates the previous state either in place (`none`, as released), or warped with the
        flow like its input (`warped`). With `detach`, gradients stop between consecutive frames, as
        released.
        """
        super().__init__()
        self._frames = frames
        self._hidden_warp = hidden_warp
        self._detach = detach
        joint = channels + latent
        self.offset_conv = _ConvNorm(joint, joint)
        self.offset_pred = nn.Conv2d(joint, 2, 1)
        nn.init.normal_(self.offset_pred.weight, std=_FLOW_DEVIATION)
        nn.init.zeros_(self.offset_pred.get_parameter("bias"))
        self.gru_cells = nn.ModuleList([_GruCell(joint, channels)])
        self.spatial_conv = _ConvNorm(channels, channels)

    def forward(self, latent: Tensor, state: Tensor) -> Tensor:
        """Predict the future states (N, frames, C, H, W) from a latent and the present state.

        The latent has shape (N, L, H, W), the present state (N, C, H, W).
        """
        states = []
        for _ in range(self._frames):
            joint = torch.cat([latent, state], dim=1)
            flow = self.offset_pred(self.offset_conv(joint))
            warped = warp_with_flow(state, flow)
            if self._hidden_warp == "warped":
                state = warped
            inputs = torch.cat([warped, latent], dim=1)
            updated = self.gru_cells[0](inputs, state)
            state = self.spatial_conv(updated)
            states.append(state)
            if self._detach:
                state = state.detach()
        return torch.stack(states, dim=1)


class _GruCell(nn.Module):
    """A GRU of convolutions; its reset gate is the share that is *forgotten*, as in FIERY."""

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.conv_update = nn.Conv2d(inputs + channels, channels, 3, padding=1)
        self.conv_reset = nn.Conv2d(inputs + channels, channels, 3, padding=1)
        self.conv_state_tilde = _ConvNorm(inputs + channels, channels)

    def forward(self, inputs: Tensor, state: Tensor) -> Tensor:
        """Compute the next state (N, C, H, W) from the inputs and the state, on the same cells."""
        joint = torch.cat([inputs, state], dim=1)
        update = self.conv_update(joint).sigmoid()
        reset = self.conv_reset(joint).sigmoid()
        retained = (1 - reset) * state
        proposed = self.conv_state_tilde(torch.cat([inputs, retained], dim=1))
        return (1 - update) * state + update * proposed


class _ConvNorm(nn.Module):
    """A 3 × 3 convolution without bias, a batch norm and a ReLU."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, features: Tensor) -> Tensor:
        """Transform features (N, inputs, H, W) to (N, outputs, H, W)."""
        normalised = self.norm(self.conv(features))
        return normalised.relu_()


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
    """The released decoders: a 3 × 3 and a 1 × 1 convolution for each map.

    The maps have the states' resolution.
    """

    def __init__(self, channels: int) -> None:
        """Build the layers for states with a number of channels."""
        decoders = {}
        for name, count in _CHANNELS.items():
            centers = None
            if name == "instance_center":
                centers = slice(0, 1)
            decoders[name] = _make_decoder(channels, channels, count, centers=centers)
        super().__init__(decoders)

    def forward(self, states: Tensor) -> PredictedMotionMaps:
        """Decode states (M, C, H, W) to maps (M, …, H, W)."""
        maps = [self[name](states) for name in PredictedMotionMaps._fields]
        return PredictedMotionMaps(*maps)


class ShuffledDecoder(nn.Module):
    """Our small decoder, which reads all maps from a few channels.

    Each finer cell has its own channels.
    """

    def __init__(self, channels: int, hidden: int, upsample: int) -> None:
        """Build the layers.

        `hidden` is the number of channels after the 3 × 3 convolution, and `upsample` the number of
        the maps' cells along a cell of the states.
        """
        super().__init__()
        self._upsample = upsample
        cells = upsample**2
        start = cells * _CHANNELS["segmentation"]
        outputs = cells * sum(_CHANNELS.values())
        self.layers = _make_decoder(channels, hidden, outputs, centers=slice(start, start + cells))

    def forward(self, states: Tensor) -> PredictedMotionMaps:
        """Decode states (M, C, H, W) to maps (M, …, H', W') on the finer grid."""
        stacked_maps = functional.pixel_shuffle(self.layers(states), self._upsample)
        maps = stacked_maps.split(list(_CHANNELS.values()), dim=1)
        return PredictedMotionMaps(*maps)


def _make_decoder(
    channels: int, hidden: int, outputs: int, *, centers: slice | None
) -> nn.Sequential:
    """Build two convolutions; `centers` are the channels of the centre logits, or None."""
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
