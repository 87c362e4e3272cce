"""`Moment`: one frame of the agents that are exported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x.configurations import Agents, agents_of, cooperating_agents


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """A frame and its samples.

    Attributes:
        scenario: token.
        index: frame number from 1.
        samples: agent → sample token, in the order of `taxonomy.AGENTS`.
    """

    scenario: str
    index: int
    samples: Mapping[str, str]

    @property
    def first_sample(self) -> str:
        """Token of the first agent's sample."""
        return next(iter(self.samples.values()))


def moment_of(scenario: str, index: int, agents: tuple[str, ...]) -> Moment:
    """Frame number `index` of some agents."""
    samples = {agent: sample_token(scenario, agent, index) for agent in agents}
    return Moment(scenario=scenario, index=index, samples=samples)


def exported_agents(dataset: Dataset, scenario: str, agents: Agents) -> tuple[str, ...]:
    """The agents that an `agents=` argument means, in the order of `taxonomy.AGENTS`.

    Raises:
        ChoiceError: no such agent or configuration, or no agent is given.
        NotAvailableError: an agent is not in this (partial) release of the scenario.
    """
    first = agents_of(dataset, scenario)[0]
    chosen = cooperating_agents(dataset, sample_token(scenario, first, 1), agents)
    return tuple(agent for agent in AGENTS if agent in chosen)
