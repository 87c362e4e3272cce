"""What every fusion module takes and gives, and the two operations on agents that they share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from torch import Tensor, nn


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
            x: (B, A, C, H, W) maps, already in the ego's frame (`warps.agents_to_ego`); slot 0 is the ego.
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
