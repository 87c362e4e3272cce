"""DiscoNet's fusion: for each cell, learned weights of the agents.

After Li et al., Learning Distilled Collaboration Graph (NeurIPS 2021); the layers' sizes are those of its version in
CoBEVT's code. The DeepAccident paper names it; the released code has none. There is no
distillation from a teacher that sees all sensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from deepaccident_devkit.model.fusion.interface import Fusion, visible


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoNetConfig:
    """Weights of agents.

    Attributes:
        channels: C.
        hidden: channels of the layers that find a weight.
        last_relu: the original's ReLU on the weights before the `softmax`. Off: it takes the gradient away from all
            negative ones, and makes them equal.
    """

    channels: int
    hidden: tuple[int, ...] = (128, 32, 8)
    last_relu: bool = False


class DiscoNetFusion(Fusion):
    """Linear(Σ w_k x_k); w is a `softmax` over agents of what a small network finds in an agent's cell and the ego's.

    The network sees only cells that the mask shows, so the batch statistics depend on no others.
    """

    def __init__(self, config: DiscoNetConfig) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = 2 * config.channels
        for hidden in config.hidden:
            layers += [nn.Linear(width, hidden), nn.BatchNorm1d(hidden), nn.ReLU()]
            width = hidden
        layers.append(nn.Linear(width, 1))
        if config.last_relu:
            layers.append(nn.ReLU())
        self.score = nn.Sequential(*layers)
        self.out = nn.Linear(config.channels, config.channels)

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:  # noqa: ARG002
        """As `Fusion.forward`; kinds of agents and delays do not count."""
        weighted = (self.weights(x, mask)[:, :, None] * visible(x, mask)).sum(1)
        return self.out(weighted.movedim(1, -1)).movedim(-1, 1)

    def weights(self, x: Tensor, mask: Tensor) -> Tensor:
        """(B, A, H, W) weights of the agents, in sum 1 and 0 where masked; arguments as `forward`."""
        cells = x.movedim(2, -1)
        pairs = torch.cat([cells, cells[:, :1].expand_as(cells)], -1)[mask]
        score = self.score(pairs)[:, 0]
        hidden = torch.full(mask.shape, -torch.inf, dtype=score.dtype, device=score.device)
        return hidden.masked_scatter(mask, score).softmax(1)
