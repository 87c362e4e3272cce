"""The interface of all fusions; mean and maximum; the released fusion; and DiscoNet.

DiscoNet follows Li et al., Learning Distilled Collaboration Graph (NeurIPS 2021); the layer sizes
are as in CoBEVT's code. The DeepAccident paper lists DiscoNet, but the released code does not
contain it. There is no distillation from a teacher that sees all sensors.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import torch
from torch import Tensor, nn

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.temporal import Bottleneck3d, TemporalBlock
from deepaccident_devkit.support.text import settle_choices

# Channels that a relative pose occupies: a 6-vector, the same in all cells.
POSE_CHANNELS = 6
# Out of 64. The authors of the released code chose them by eye for one checkpoint; they have no
# meaning for any other.
RELEASED_EGO_CHANNELS: Final = (31, 41, 42, 43, 44, 53, 57, 60)


class Fusion(nn.Module, ABC):
    """Fusion of several agents' BEV maps, all in the ego's frame, into one map for the ego.

    In cells without a visible partner, the result is exactly as for the ego without partners. The
    partners' order does not matter. Hidden cells have no effect, not even in training. Options that
    break one of these rules say so.

    Attributes:
        hides_outside: Whether masks should hide the cells outside a partner's map, in addition to
            missing agents.
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
            delay: Number of steps by which each agent's map is older than the ego's, (B, A) int;
                not negative.
        """


def visible(x: Tensor, mask: Tensor) -> Tensor:
    """Set the cells of maps (B, A, C, H, W) that the mask (B, A, H, W) hides to 0."""
    is_hidden = ~mask[:, :, None]
    return x.masked_fill(is_hidden, 0)


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Return the mean (B, C, H, W) of maps (B, A, C, H, W) over the agents that the mask shows.

    The mask has shape (B, A, H, W).
    """
    agent_counts = mask.sum(1)[:, None]
    sums = visible(x, mask).sum(1)
    return sums / agent_counts.to(x.dtype)


@dataclass(frozen=True, slots=True, kw_only=True)
class Agent3DConfig:
    """Sizes of the released code's unused layers.

    Attributes:
        channels: Number C of channels.
        agents: Number A of agents, the ego and its partners.
        bottlenecks: Number of bottlenecks after each block.
    """

    channels: int
    agents: int = 5
    bottlenecks: int = 2

    def __post_init__(self) -> None:
        """Check the number of agents; raise ConfigError if there is no partner."""
        if self.agents < 2:
            raise ConfigError(
                f"agents: expected at least 2, found {self.agents}; one agent has nothing to fuse"
            )


class Agent3D(nn.Module):
    """A − 1 blocks over the sequence of agents, then one 3×3 convolution over all their channels.

    State-dict keys are the released ones, without the prefix `v2x_fusion.`. The order of the
    partners matters. No published weights were trained with these layers in use.
    """

    def __init__(self, config: Agent3DConfig) -> None:
        super().__init__()
        width = config.channels
        layers: list[nn.Module] = []
        in_channels = width + POSE_CHANNELS
        for _ in range(config.agents - 1):
            layers.append(TemporalBlock(in_channels, width))
            layers.extend(Bottleneck3d(width) for _ in range(config.bottlenecks))
            in_channels = width
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
        maps = self.over_agents(x, relative_pose)
        return self.compression(maps.flatten(1, 2))

    def over_agents(self, x: Tensor, relative_pose: Tensor) -> Tensor:
        """Return the maps (B, A, C, H, W) after the 3D convolutions; arguments as in `forward`."""
        poses = relative_pose.to(x.dtype, copy=True)
        poses[:, 0] = 0
        rows, columns = x.shape[-2:]
        pose_maps = poses[..., None, None].expand(-1, -1, -1, rows, columns)
        maps = torch.cat([x, pose_maps], 2)
        return self.model(maps.transpose(1, 2)).transpose(1, 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoolFusionConfig:
    """The choice between the mean and the maximum (F-Cooper) over the agents that the mask shows.

    Attributes:
        by: `mean` or `max`.
    """

    by: Literal["mean", "max"] = "mean"

    def __post_init__(self) -> None:
        """Check the value; raise ConfigError if it is neither `mean` nor `max`."""
        settle_choices(self, {"by": ("mean", "max")}, error=ConfigError)


class PoolFusion(Fusion):
    """The mean or maximum over agents, cell by cell; it has no parameters."""

    def __init__(self, config: PoolFusionConfig) -> None:
        super().__init__()
        self.config = config

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:  # noqa: ARG002
        """Fuse as described for `Fusion.forward`; kinds of agents and delays have no effect."""
        if self.config.by == "mean":
            return masked_mean(x, mask)
        return x.masked_fill(~mask[:, :, None], -torch.inf).amax(1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleasedFusionConfig:
    """Rules of the fusion in the released code.

    Attributes:
        channels: Number C of channels.
        ego_channels: Channels that are copied from the ego instead of averaged; without any, the
            fusion is a plain mean of filled maps.
        fill_below: Threshold of the mean absolute value over channels: a partner's cell below it is
            filled with the ego's cell.
        agent3d: Sizes of the released code's unused layers, with which every key of its checkpoints
            can be loaded; None to leave these layers out.
    """

    channels: int
    ego_channels: tuple[int, ...] = RELEASED_EGO_CHANNELS
    fill_below: float = 0.001
    agent3d: Agent3DConfig | None = None

    def __post_init__(self) -> None:
        """Check the channel indices; raise ConfigError if one is out of range."""
        wrong_channels = [
            channel for channel in self.ego_channels if not 0 <= channel < self.channels
        ]
        if wrong_channels:
            raise ConfigError(
                f"ego_channels: expected numbers from 0 to {self.channels - 1}, found "
                f"{wrong_channels}; choose channels that the maps have, or () for none"
            )


class ReleasedFusion(Fusion):
    """The released V2X_fusion up to its early return: fill, mean over slots, the ego's channels.

    The release has no masks: it treats cells outside a partner's map as almost empty cells, fills
    them with the ego's and includes them in the mean. So this module needs masks that hide only
    complete agents (`hides_outside`). Other masked cells are filled, too, and included in the mean;
    an agent that is masked everywhere counts as missing, and is left out of the mean. The released
    code is correct only for batches of one sample; here each sample of a batch is treated
    separately.

    With `agent3d`, the module also contains the released code's unused layers, which need no
    gradient.
    """

    hides_outside = False
    is_ego_channel: Tensor

    def __init__(self, config: ReleasedFusionConfig) -> None:
        super().__init__()
        self.config = config
        is_ego_channel = torch.zeros(config.channels, dtype=torch.bool)
        is_ego_channel[list(config.ego_channels)] = True
        self.register_buffer("is_ego_channel", is_ego_channel, persistent=False)
        if config.agent3d is not None:
            unused = Agent3D(config.agent3d).requires_grad_(requires_grad=False)
            self.model = unused.model
            self.compression = unused.compression

    def forward(self, x: Tensor, mask: Tensor, agent_is_infra: Tensor, delay: Tensor) -> Tensor:  # noqa: ARG002
        """Fuse as described for `Fusion.forward`; kinds of agents and delays have no effect."""
        ego = x[:, :1]
        is_present = mask.flatten(2).any(2)[:, :, None, None, None]
        is_empty = x.abs().mean(2, keepdim=True) < self.config.fill_below
        is_filled = ~mask[:, :, None] | is_empty
        filled = torch.where(is_filled, ego, x)
        sums = filled.masked_fill(~is_present, 0).sum(1)
        mean = sums / is_present.sum(1)
        return torch.where(self.is_ego_channel[:, None, None], ego[:, 0], mean)


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
    """A linear layer applied to Σ w_k x_k, where the weights w are a `softmax` over agents' scores.

    A small network computes each score from an agent's cell and the ego's. It sees only cells that
    the mask shows, so no other cell affects the batch statistics.
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
        """Fuse as described for `Fusion.forward`; kinds of agents and delays have no effect."""
        weights = self.weights(x, mask)[:, :, None]
        weighted_sum = (weights * visible(x, mask)).sum(1)
        channels_last = weighted_sum.movedim(1, -1)
        return self.out(channels_last).movedim(-1, 1)

    def weights(self, x: Tensor, mask: Tensor) -> Tensor:
        """Return the agents' weights in each cell, (B, A, H, W); arguments are as in `forward`.

        A cell's weights add up to 1; masked agents have the weight 0.
        """
        cells = x.movedim(2, -1)
        ego_cells = cells[:, :1].expand_as(cells)
        pairs = torch.cat([cells, ego_cells], -1)[mask]
        score = self.score(pairs)[:, 0]
        masked_scores = torch.full(mask.shape, -torch.inf, dtype=score.dtype, device=score.device)
        return masked_scores.masked_scatter(mask, score).softmax(1)
