"""Fusion without attention: the mean, the maximum, and the released mean with channels of the ego's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import torch
from torch import Tensor

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.model.fusion.agent3d import Agent3D, Agent3DConfig
from deepaccident_devkit.model.fusion.interface import Fusion, masked_mean
from deepaccident_devkit.text import settle_choices

RELEASED_EGO_CHANNELS: Final = (31, 41, 42, 43, 44, 53, 57, 60)
"""Of 64, found by eye on one checkpoint of the released code's authors, and without meaning for any other."""


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
