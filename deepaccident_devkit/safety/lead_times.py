"""`LeadTimes`: how long before an accident's impact each set of agents first observes both colliders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.safety.accidents import accident_of
from deepaccident_devkit.safety.leads import coalition_members, first_together, leads_from, shapley_values
from deepaccident_devkit.safety.observation import ObservationRule, observed_actors
from deepaccident_devkit.taxonomy import AGENTS, AgentName

EGO: Final = AGENTS[0]
PARTNERS: Final = AGENTS[1:]
"""The agents that can join `ego_vehicle`."""
_MEMBERS: Final = coalition_members(len(PARTNERS))
COALITIONS: Final[tuple[tuple[AgentName, ...], ...]] = tuple(
    (EGO, *(name for name, joins in zip(PARTNERS, row, strict=True) if joins)) for row in _MEMBERS.tolist()
)
"""The sixteen sets of agents with the ego; partner i belongs to those whose number has bit i."""
_ALONE: Final = [1 << partner for partner in range(len(PARTNERS))]
"""Numbers of the sets of the ego and one partner."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LeadTimes(FrozenArrays):
    """When sets of agents first observe both colliders of an accident; arrays are read-only.

    What is seen bounds a warning from above. It is no prediction: who sees both need not see that they will collide.

    Attributes:
        scenario: token.
        rule: when an actor counts as observed.
        actor_ids: CARLA ids of the colliders, in the meta file's order.
        categories: their classes.
        colliding_agents: the agents that they are; None for one that records nothing.
        missing: agents without labels in this release.
        num_frames: of the recording; the last one is the impact.
        first_frames: (16,) int64 for each of `COALITIONS`, the number (from 1) of the first frame at which it observes
            both; 0 for one that never does, and for one with a missing agent.
        leads: (16,) seconds from that frame to the last one; 0 for one that never does, NaN with a missing agent.
        shapley: (4,) seconds: of each of `PARTNERS` its Shapley value of the gain over the ego alone, among the
            partners that are there; NaN for a missing one.
    """

    scenario: str
    rule: ObservationRule
    actor_ids: tuple[int, int]
    categories: tuple[str, str]
    colliding_agents: tuple[AgentName | None, AgentName | None]
    missing: tuple[AgentName, ...]
    num_frames: int
    first_frames: IntArray
    leads: FloatArray
    shapley: FloatArray

    @property
    def ego_collides(self) -> bool:
        """Whether the ego is one of the colliders."""
        return EGO in self.colliding_agents

    @property
    def alone(self) -> float:
        """Seconds of the ego alone."""
        return float(self.leads[0])

    @property
    def together(self) -> float:
        """Seconds of all agents that are there."""
        return float(self.leads[self._everyone])

    @property
    def never_alone(self) -> bool:
        """Whether the ego alone never observes both at the same frame."""
        return not self.first_frames[0]

    @property
    def never_together(self) -> bool:
        """Whether all agents that are there never observe both at the same frame."""
        return not self.first_frames[self._everyone]

    @property
    def from_the_start(self) -> bool:
        """Whether all agents that are there observe both as early as the rule lets them: the recording may cut it."""
        return 0 < int(self.first_frames[self._everyone]) <= self.rule.sustained

    @property
    def gains(self) -> FloatArray:
        """(4,) seconds that each of `PARTNERS` adds to the ego alone; NaN for a missing one."""
        gains: FloatArray = self.leads[_ALONE] - self.leads[0]
        return gains

    @property
    def losses(self) -> FloatArray:
        """(4,) seconds that all agents lose without each of `PARTNERS`; NaN for a missing one."""
        without = [self._everyone & ~bit for bit in _ALONE]
        losses: FloatArray = np.where(np.isnan(self.gains), np.nan, self.together - self.leads[without])
        return losses

    def to_dict(self) -> dict[str, Any]:
        """For JSON; None for what is not known, and for the first frame of a set that never observes both."""
        names = ["+".join(members) for members in COALITIONS]
        frames = [number or None for number in self.first_frames.tolist()]
        return {
            "scenario": self.scenario,
            "actor_ids": list(self.actor_ids),
            "categories": list(self.categories),
            "colliding_agents": list(self.colliding_agents),
            "ego_collides": self.ego_collides,
            "missing": list(self.missing),
            "num_frames": self.num_frames,
            "lead_seconds": dict(zip(names, _known(self.leads), strict=True)),
            "first_frames": dict(zip(names, frames, strict=True)),
            "gain_seconds": dict(zip(PARTNERS, _known(self.gains), strict=True)),
            "loss_seconds": dict(zip(PARTNERS, _known(self.losses), strict=True)),
            "shapley_seconds": dict(zip(PARTNERS, _known(self.shapley), strict=True)),
        }

    @property
    def _everyone(self) -> int:
        return sum(bit for bit, name in zip(_ALONE, PARTNERS, strict=True) if name not in self.missing)


def lead_times(dataset: Dataset, scenario: RowArgument, rule: ObservationRule | None = None) -> LeadTimes | None:
    """When each set of agents with `ego_vehicle` first observes both colliders of an accident.

    Args:
        dataset: the release.
        scenario: token or record.
        rule: when an actor counts as observed; None for `ObservationRule()`.

    Returns:
        None if the meta file names no collision.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: as of `accident_of`, or `ego_vehicle` has no labels in this release.
    """
    accident = accident_of(dataset, scenario)
    if accident is None:
        return None
    rule = rule or ObservationRule()
    there, observed = observed_actors(dataset, accident.scenario, accident.actor_ids, rule)
    if EGO not in there:
        raise NotAvailableError(f"{accident.scenario}: has no labels of {EGO}, whose lead time is asked; unpack them")
    first, leads, shapley = _whole_ledger(observed, there[1:])
    return LeadTimes(
        scenario=accident.scenario,
        rule=rule,
        actor_ids=accident.actor_ids,
        categories=accident.categories,
        colliding_agents=accident.agents,
        missing=tuple(name for name in AGENTS if name not in there),
        num_frames=accident.num_frames,
        first_frames=first,
        leads=leads,
        shapley=shapley,
    )


def _whole_ledger(observed: BoolArray, partners: tuple[AgentName, ...]) -> tuple[IntArray, FloatArray, FloatArray]:
    """First frames (16,), leads (16,) and Shapley values (4,), of which those of missing partners are not known."""
    places = np.array([PARTNERS.index(name) for name in partners], dtype=np.int64)
    numbers = coalition_members(len(partners)) @ (1 << places)
    first = first_together(observed)
    leads = leads_from(first, observed.shape[-1])
    every_frame, every_lead = np.zeros(len(COALITIONS), dtype=np.int64), np.full(len(COALITIONS), np.nan)
    every_frame[numbers], every_lead[numbers] = first + 1, leads
    shapley = np.full(len(PARTNERS), np.nan)
    shapley[places] = shapley_values(leads)
    return every_frame, every_lead, shapley


def _known(values: FloatArray) -> list[float | None]:
    return [None if np.isnan(value) else value for value in values.tolist()]
