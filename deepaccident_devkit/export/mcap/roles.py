"""The roles of actors in a scenario, in words; `render.roles` has the colours."""

from __future__ import annotations

from collections.abc import Mapping

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.render.roles import recorders_of


class Roles:
    """The colliding pair, the vehicles that record, and all others."""

    def __init__(self, dataset: Dataset, scenario: str) -> None:
        """Read the roles of a scenario from its meta."""
        collision = dataset.get("scenario", scenario)["collision"]
        self.pair: frozenset[int] = frozenset() if collision is None else frozenset(collision["ids"])
        self.agents: Mapping[int, str] = recorders_of(dataset, scenario)

    def role(self, actor: int) -> str:
        """The role of an actor, such as `ego_vehicle, collides`; empty for most actors."""
        words = [self.agents[actor]] if actor in self.agents else []
        return ", ".join([*words, "collides"] if actor in self.pair else words)
