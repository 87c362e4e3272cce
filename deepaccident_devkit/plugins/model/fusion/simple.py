"""What every way of fusion takes and gives, and those without attention: mean, maximum, the released one, DiscoNet.

DiscoNet is after Li et al., Learning Distilled Collaboration Graph (NeurIPS 2021); the layers' sizes are those of its
version in CoBEVT's code. The DeepAccident paper names it; the released code has none. There is no distillation from a
teacher that sees all sensors.
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


class Fusion(nn.Module, ABC):
    """Several agents' BEV maps in the ego's frame → one map of the ego.

    Every module gives exactly the result of the ego alone where no partner has anything to say, and does not depend on
    the partners' order, except with options that say so. What the mask hides has no effect, in training neither.

    Attributes:
        hides_outside: whether masks are to hide the cells outside a partner's own map, beside agents that are missing.
    """

    hides_outside: ClassVar[bool] = True

    @abstractmethod
    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:
        """Fuse.

        Args:
            x: (B, A, C, H, W) maps, already in the ego's frame (`warps.features_to_ego`); slot 0 is the ego.
            mask: (B, A, H, W) bool, where an agent has something to say (`warps.agents_mask`); the ego has everywhere.
            agent_is_infra: (B, A) bool, whether the agent is infrastructure, not a vehicle.
            delay: (B, A) integer steps by which an agent's map is older than the ego's; not negative.

        Returns:
            (B, C, H, W).
        """


def visible(x: Tensor, mask: Tensor) -> Tensor:
    """Maps (B, A, C, H, W) with 0 where the mask (B, A, H, W) hides an agent."""
    return x.masked_fill(~mask[:, :, None], 0)


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean (B, C, H, W) of the agents that a mask (B, A, H, W) does not hide, of maps (B, A, C, H, W)."""
    return visible(x, mask).sum(1) / mask.sum(1)[:, None].to(x.dtype)


# Channels that a relative pose takes: a 6-vector, the same in all cells.
POSE = 6


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
            raise ConfigError(
                f"agents: expected at least 2, found {self.agents}; one agent has nothing to fuse"
            )


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
            nn.Conv2d(config.agents * width, width, 3, padding=1, bias=False),
            nn.BatchNorm2d(width),
            nn.ReLU(),
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
        pose = torch.cat([torch.zeros_like(relative_pose[:, :1]), relative_pose[:, 1:]], 1).to(
            x.dtype
        )
        maps = torch.cat([x, pose[..., None, None].expand(-1, -1, -1, *x.shape[-2:])], 2)
        return self.model(maps.transpose(1, 2)).transpose(1, 2)


# Of 64, found by eye on one checkpoint of the released code's authors, and without meaning for any other.
RELEASED_EGO_CHANNELS: Final = (31, 41, 42, 43, 44, 53, 57, 60)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoolFusionConfig:
    """The mean, or the maximum (F-Cooper), of the agents that have something to say.

    Attributes:
        by: which of the two.
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
        """As `Fusion.forward`; kinds of agents and delays do not count."""
        if self.config.by == "mean":
            return masked_mean(x, mask)
        return x.masked_fill(~mask[:, :, None], -torch.inf).amax(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasedFusionConfig:
    """The fusion of the released code.

    Attributes:
        channels: C.
        ego_channels: channels that are the ego's own, not the mean; none gives a plain mean of filled maps.
        fill_below: a partner's cell whose channels' mean absolute value is smaller is filled with the ego's.
        agent3d: the released code's unused layers, so that all keys of its checkpoints have a place; None for none.
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
    """The released V2X_fusion as far as its early return: fill, mean over all slots, then channels of the ego's.

    The release knows no masks: it takes cells outside a partner's map for those with almost nothing in them, fills them
    with the ego's and counts them in the mean. So this module is to be given masks of whole agents
    (`hides_outside`). Masked cells are filled, too, and count; an agent that is masked everywhere is not there, and not
    in the mean. The release is right for batches of one sample alone; here each sample of a batch is treated so.

    With `agent3d` there are the released unused layers as well; no gradient is asked of them.
    """

    hides_outside = False
    from_ego: Tensor

    def __init__(self, config: ReleasedFusionConfig) -> None:
        super().__init__()
        self.config = config
        own = torch.zeros(config.channels, dtype=torch.bool)
        own[list(config.ego_channels)] = True
        self.register_buffer("from_ego", own, persistent=False)
        if config.agent3d is not None:
            unused = Agent3D(config.agent3d).requires_grad_(requires_grad=False)
            self.model, self.compression = unused.model, unused.compression

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:  # noqa: ARG002
        """As `Fusion.forward`; kinds of agents and delays do not count."""
        ego, there = x[:, :1], mask.flatten(2).any(2)[:, :, None, None, None]
        filled = ~mask[:, :, None] | (x.abs().mean(2, keepdim=True) < self.config.fill_below)
        mean = torch.where(filled, ego, x).masked_fill(~there, 0).sum(1) / there.sum(1)
        return torch.where(self.from_ego[:, None, None], ego[:, 0], mean)


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
