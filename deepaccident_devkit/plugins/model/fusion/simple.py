"""The interface of all fusions, and mean, maximum, the released fusion and DiscoNet.

DiscoNet follows Li et al., Learning Distilled Collaboration Graph (NeurIPS 2021); the sizes of the
layers are from its version in CoBEVT's code. The DeepAccident paper names it; the released code has
none. There is no distillation from a teacher that sees all sensors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import torch
from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.temporal import Bottleneck3d, TemporalBlock
from deepaccident_devkit.support.text import settle_choices

# Channels that a relative pose takes: a 6-vector, the same in all cells.
POSE_CHANNELS = 6
# Of 64, found by eye on one checkpoint of the released code's authors, and without meaning for any
# other.
RELEASED_EGO_CHANNELS: Final = (31, 41, 42, 43, 44, 53, 57, 60)


class Fusion(nn.Module, ABC):
    """Fusion of several agents' BEV maps in the ego's frame into one map of the ego.

    In cells without a visible partner every module returns exactly the result of the ego without
    partners, and does not depend on the partners' order, except with options that document it.
    Hidden cells have no effect, not even in training.

    Attributes:
        hides_outside: Whether masks should also hide the cells outside a partner's own map, in
            addition to missing agents.
    """

    hides_outside: ClassVar[bool] = True

    @abstractmethod
    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:
        """Fuse the agents' maps; return the ego's map (B, C, H, W).

        Args:
            x: Maps in the ego's frame (`warps.features_to_ego`), shape (B, A, C, H, W); slot 0 is
                the ego.
            mask: Cells that each agent covers (`warps.agents_mask`), (B, A, H, W) bool; the ego
                covers all cells.
            agent_is_infra: Whether each agent is infrastructure instead of a vehicle, (B, A) bool.
            delay: Steps by which each agent's map is older than the ego's, (B, A) int; not
                negative.
        """


def visible(x: Tensor, mask: Tensor) -> Tensor:
    """Return maps (B, A, C, H, W) with 0 in cells that the mask (B, A, H, W) hides."""
    return x.masked_fill(~mask[:, :, None], 0)


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Return the mean (B, C, H, W) of maps (B, A, C, H, W) over the agents that the mask shows.

    The mask has shape (B, A, H, W).
    """
    agent_counts = mask.sum(1)[:, None]
    return visible(x, mask).sum(1) / agent_counts.to(x.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class Agent3DConfig:
    """The unused layers of the released code.

    Attributes:
        channels: Number C of channels.
        agents: Number A of agents, the ego and its partners.
        bottlenecks: Number of bottlenecks after each block.
    """

    channels: int
    agents: int = 5
    bottlenecks: int = 2

    def __post_init__(self) -> None:
        """Check the number of agents; raises ConfigError."""
        if self.agents < 2:
            raise ConfigError(
                f"agents: expected at least 2, found {self.agents}; one agent has nothing to fuse"
            )


class Agent3D(nn.Module):
    """A − 1 blocks over the sequence of agents, then one 3×3 convolution over all their channels.

    State-dict keys are the released ones (`v2x_fusion.` and these). The order of the partners
    matters, and nothing that was trained through these layers was published.
    """

    def __init__(self, config: Agent3DConfig) -> None:
        super().__init__()
        width = config.channels
        layers: list[nn.Module] = []
        for block in range(config.agents - 1):
            layers.append(TemporalBlock(width + POSE_CHANNELS if block == 0 else width, width))
            layers.extend(Bottleneck3d(width) for _ in range(config.bottlenecks))
        self.model = nn.Sequential(*layers)
        self.compression = nn.Sequential(
            nn.Conv2d(config.agents * width, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.ReLU(),
        )

    def forward(self, x: Tensor, relative_pose: Tensor) -> Tensor:
        """Fuse maps that are already in the ego's frame; return one map (B, C, H, W).

        Args:
            x: Maps, shape (B, A, C, H, W); slot 0 is the ego.
            relative_pose: 6-vectors `ego_from_agent`, shape (B, A, 6); slot 0 is not used.
        """
        return self.compression(self.over_agents(x, relative_pose).flatten(1, 2))

    def over_agents(self, x: Tensor, relative_pose: Tensor) -> Tensor:
        """Return the maps (B, A, C, H, W) after the 3D convolutions; arguments as in `forward`."""
        ego_pose = torch.zeros_like(relative_pose[:, :1])
        poses = torch.cat([ego_pose, relative_pose[:, 1:]], 1).to(x.dtype)
        pose_maps = poses[..., None, None].expand(-1, -1, -1, *x.shape[-2:])
        maps = torch.cat([x, pose_maps], 2)
        return self.model(maps.transpose(1, 2)).transpose(1, 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoolFusionConfig:
    """The mean, or the maximum (F-Cooper), over the agents that the mask shows.

    Attributes:
        by: `mean` or `max`.
    """

    by: Literal["mean", "max"] = "mean"

    def __post_init__(self) -> None:
        """Check the word; raises ConfigError."""
        settle_choices(self, {"by": ("mean", "max")}, error=ConfigError)


class PoolFusion(Fusion):
    """Mean or maximum over agents, cell by cell; without parameters."""

    def __init__(self, config: PoolFusionConfig) -> None:
        super().__init__()
        self.config = config

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:  # noqa: ARG002
        """Fuse as `Fusion.forward`; kinds of agents and delays have no effect."""
        if self.config.by == "mean":
            return masked_mean(x, mask)
        return x.masked_fill(~mask[:, :, None], -torch.inf).amax(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasedFusionConfig:
    """The fusion of the released code.

    Attributes:
        channels: Number C of channels.
        ego_channels: Channels that are copied from the ego instead of averaged; none gives a plain
            mean of filled maps.
        fill_below: A partner's cell with a smaller mean absolute value over its channels is filled
            with the ego's.
        agent3d: The released code's unused layers, so that all keys of its checkpoints have a
            target; None for none.
    """

    channels: int
    ego_channels: tuple[int, ...] = RELEASED_EGO_CHANNELS
    fill_below: float = 0.001
    agent3d: Agent3DConfig | None = None

    def __post_init__(self) -> None:
        """Check the channels' numbers; raises ConfigError."""
        wrong = [number for number in self.ego_channels if not 0 <= number < self.channels]
        if wrong:
            raise ConfigError(
                f"ego_channels: expected numbers from 0 to {self.channels - 1}, found {wrong}; "
                "choose channels that the maps have, or () for none"
            )


class ReleasedFusion(Fusion):
    """The released V2X_fusion up to its early return: fill, mean over slots, the ego's channels.

    The release has no masks: it treats cells outside a partner's map as almost empty cells, fills
    them with the ego's and counts them in the mean. So this module needs masks of complete agents
    (`hides_outside`). Masked cells are filled, too, and count; an agent that is masked everywhere
    is missing, and not in the mean. The release is only correct for batches of one sample; here
    each sample of a batch is treated as its own batch.

    With `agent3d` it also has the released unused layers; they need no gradient.
    """

    hides_outside = False
    from_ego: Tensor

    def __init__(self, config: ReleasedFusionConfig) -> None:
        super().__init__()
        self.config = config
        is_ego_channel = torch.zeros(config.channels, dtype=torch.bool)
        is_ego_channel[list(config.ego_channels)] = True
        self.register_buffer("from_ego", is_ego_channel, persistent=False)
        if config.agent3d is not None:
            unused = Agent3D(config.agent3d).requires_grad_(requires_grad=False)
            self.model, self.compression = unused.model, unused.compression

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:  # noqa: ARG002
        """Fuse as `Fusion.forward`; kinds of agents and delays have no effect."""
        ego = x[:, :1]
        is_present = mask.flatten(2).any(2)[:, :, None, None, None]
        is_empty = x.abs().mean(2, keepdim=True) < self.config.fill_below
        is_filled = ~mask[:, :, None] | is_empty
        filled = torch.where(is_filled, ego, x)
        mean = filled.masked_fill(~is_present, 0).sum(1) / is_present.sum(1)
        return torch.where(self.from_ego[:, None, None], ego[:, 0], mean)


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscoNetConfig:
    """Sizes of DiscoNet's weighting of agents.

    Attributes:
        channels: Number C of channels.
        hidden: Channels of the layers that compute a weight.
        last_relu: Whether the weights have the original's ReLU before the `softmax`. It removes the
            gradient from all negative weights, and makes them equal.
    """

    channels: int
    hidden: tuple[int, ...] = (128, 32, 8)
    last_relu: bool = False


class DiscoNetFusion(Fusion):
    """Linear(Σ w_k x_k), with a `softmax` w over the agents' scores.

    A small network computes a score from an agent's cell and the ego's. It only sees cells that the
    mask shows, so the batch statistics depend on no others.
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
        """Fuse as `Fusion.forward`; kinds of agents and delays have no effect."""
        weighted = (self.weights(x, mask)[:, :, None] * visible(x, mask)).sum(1)
        return self.out(weighted.movedim(1, -1)).movedim(-1, 1)

    def weights(self, x: Tensor, mask: Tensor) -> Tensor:
        """Return the weights of the agents, (B, A, H, W); arguments as in `forward`.

        Their sum is 1, and masked weights are 0.
        """
        cells = x.movedim(2, -1)
        pairs = torch.cat([cells, cells[:, :1].expand_as(cells)], -1)[mask]
        score = self.score(pairs)[:, 0]
        masked_scores = torch.full(mask.shape, -torch.inf, dtype=score.dtype, device=score.device)
        return masked_scores.masked_scatter(mask, score).softmax(1)
