"""The released fusion's layers that its early return never reaches: 3D convolutions over the agents."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.temporal_blocks import Bottleneck3d, TemporalBlock

POSE = 6
"""Channels that a relative pose takes: a 6-vector, the same in all cells."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Agent3DConfig:
    """The unreached layers.

    Attributes:
        channels: C.
        agents: A, the ego and its partners.
        bottlenecks: after each block.
    """

    channels: int
    agents: int = 5
    bottlenecks: int = 2

    def __post_init__(self) -> None:
        """Check the number of agents; raises ConfigError."""
        if self.agents < 2:
            raise ConfigError(f"agents: expected at least 2, found {self.agents}; one agent has nothing to fuse")


class Agent3D(nn.Module):
    """A − 1 blocks over the sequence of agents, then one 3×3 convolution over all their channels.

    State-dict keys are the released ones (`v2x_fusion.` and these). The order of the partners matters, and nothing was
    published that was trained through these layers.
    """

    def __init__(self, config: Agent3DConfig) -> None:
        super().__init__()
        width = config.channels
        layers: list[nn.Module] = []
        for block in range(config.agents - 1):
            layers.append(TemporalBlock(width + POSE if block == 0 else width, width))
            layers.extend(Bottleneck3d(width) for _ in range(config.bottlenecks))
        self.model = nn.Sequential(*layers)
        self.compression = nn.Sequential(
            nn.Conv2d(config.agents * width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), nn.ReLU()
        )

    def forward(self, x: Tensor, relative_pose: Tensor) -> Tensor:
        """Fuse maps that are already in the ego's frame.

        Args:
            x: (B, A, C, H, W); slot 0 is the ego.
            relative_pose: (B, A, 6) 6-vectors `ego_from_agent`; slot 0 is not used.

        Returns:
            (B, C, H, W).
        """
        return self.compression(self.over_agents(x, relative_pose).flatten(1, 2))

    def over_agents(self, x: Tensor, relative_pose: Tensor) -> Tensor:
        """(B, A, C, H, W) after the 3D convolutions; arguments as `forward`."""
        pose = torch.cat([torch.zeros_like(relative_pose[:, :1]), relative_pose[:, 1:]], 1).to(x.dtype)
        maps = torch.cat([x, pose[..., None, None].expand(-1, -1, -1, *x.shape[-2:])], 2)
        return self.model(maps.transpose(1, 2)).transpose(1, 2)
