"""Distributions of the latent of each region: of what the present leaves open, and of what the future then was.

As in FIERY and BEVerse (the released `SpatialDistributionModule`): a diagonal normal distribution at each cell of a map
a quarter as fine as the features.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

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
            raise GeometryError(f"noise: expected shape {tuple(self.mu.shape)}, found {tuple(noise.shape)}")
        return self.mu + noise.to(self.mu) * self.log_sigma.exp()

    def noise(self, generator: torch.Generator | None = None) -> Tensor:
        """Standard normal noise of this shape, from a generator on the same device or from torch's own."""
        return torch.randn(self.mu.shape, generator=generator, device=self.mu.device, dtype=self.mu.dtype)


class SpatialDistribution(nn.Module):
    """Features → `LatentDistribution`: two bottlenecks of stride 2, and a 1 × 1 convolution."""

    def __init__(self, inputs: int, hidden: int, latent: int, log_sigma: tuple[float, float]) -> None:
        """Make the layers.

        Args:
            inputs: channels of the features.
            hidden: channels between the bottlenecks and after them.
            latent: channels of the latent.
            log_sigma: the smallest and the largest value of `LatentDistribution.log_sigma`.
        """
        super().__init__()
        self._log_sigma = log_sigma
        self.encoder = nn.Sequential(
            OrderedDict(model=nn.Sequential(_Bottleneck(inputs, hidden), _Bottleneck(hidden, hidden)))
        )
        last = nn.Conv2d(hidden, 2 * latent, 1)
        # two distributions that begin far apart have a divergence of thousands, beside which nothing else is learned
        nn.init.normal_(last.weight, std=0.01)
        self.last_conv = nn.Sequential(last)

    def forward(self, features: Tensor) -> LatentDistribution:
        """Predict the distribution.

        Args:
            features: (N, inputs, H, W).

        Returns:
            Means and log standard deviations, each (N, latent, H / 4, W / 4), rounded up.
        """
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
