"""Which agents cooperate: the paper's seven configurations, as seen from any agent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.support.text import choice, spelled
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE, AgentName

Role = Literal["behind", "other", "other_behind", "infrastructure"]
"""The role of a partner: the vehicle behind the ego, the two vehicles of the other side, the infrastructure."""
Side = Literal["ego_vehicle", "other_vehicle"]

_PARTNERS: Final[dict[AgentName, dict[Role, AgentName]]] = {
    "ego_vehicle": {
        "behind": "ego_vehicle_behind",
        "other": "other_vehicle",
        "other_behind": "other_vehicle_behind",
        "infrastructure": "infrastructure",
    },
    "ego_vehicle_behind": {
        "behind": "ego_vehicle",
        "other": "other_vehicle",
        "other_behind": "other_vehicle_behind",
        "infrastructure": "infrastructure",
    },
    "other_vehicle": {
        "behind": "other_vehicle_behind",
        "other": "ego_vehicle",
        "other_behind": "ego_vehicle_behind",
        "infrastructure": "infrastructure",
    },
    "other_vehicle_behind": {
        "behind": "other_vehicle",
        "other": "ego_vehicle",
        "other_behind": "ego_vehicle_behind",
        "infrastructure": "infrastructure",
    },
}
"""Ego → role → agent: the released V2X dataset's renaming (docs/released_code.md, Poses)."""


def _names(argument: str, expected: str, given: Iterable[str]) -> tuple[str, ...]:
    """Several names from a caller, checked; raises ChoiceError."""
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ChoiceError(f"{argument}: expected {expected}, found {given!r}")
    return tuple(given)


@dataclass(frozen=True, slots=True)
class AgentConfig:
    """The agents that cooperate with an ego agent, named by their roles.

    Attributes:
        name: as in `AGENT_CONFIGS`.
        partners: the roles of the partners.
    """

    name: str
    partners: tuple[Role, ...] = ()

    def __post_init__(self) -> None:
        """Check the roles; raises ChoiceError."""
        named = _names("partners", "roles", self.partners)
        roles: tuple[Role, ...] = tuple(choice("partners", role, get_args(Role)) for role in named)
        object.__setattr__(self, "partners", roles)

    def agents_for(self, ego: str, *, side: Side = "ego_vehicle") -> tuple[AgentName, ...]:
        """The agents of this configuration by their own names, the ego first.

        Seen from a vehicle, `behind` is the other vehicle of its side (for a vehicle behind: the one in front), and
        `other` the first of the other side. Seen from the infrastructure, `infrastructure` is the first vehicle of
        `side`, `behind` the one behind that, and `other` and `other_behind` those of the other side. So `vehicles`
        always means four agents, three of them partners.

        The released code shuffles the vehicles and draws the infrastructure's side at random. Here the agents have the
        order of the roles, and the caller chooses the side.

        Args:
            ego: the agent that receives the data of the others.
            side: the side that the infrastructure takes; not used for a vehicle.

        Raises:
            ChoiceError: no such agent or side.
        """
        agent = choice("agent", ego, AGENTS)
        side = choice("side", side, get_args(Side))
        if agent == INFRASTRUCTURE:
            named: Mapping[Role, AgentName] = {**_PARTNERS[side], "infrastructure": side}
        else:
            named = _PARTNERS[agent]
        return (agent, *(named[role] for role in self.partners))


AGENT_CONFIGS: Final[dict[str, AgentConfig]] = {
    config.name: config
    for config in (
        AgentConfig("single"),
        AgentConfig("+behind", ("behind",)),
        AgentConfig("+other", ("other",)),
        AgentConfig("+infrastructure", ("infrastructure",)),
        AgentConfig("+behind+other", ("behind", "other")),
        AgentConfig("vehicles", ("behind", "other", "other_behind")),
        AgentConfig("all", ("behind", "other", "other_behind", "infrastructure")),
    )
}
"""The paper's seven configurations, by name."""
AVAILABLE: Final = "available"
"""The name of all agents that a (partial) release has of a scenario, as text for None."""
AGENT_SETS: Final = (*AGENT_CONFIGS, AVAILABLE)
"""The names that `agents=` takes beside agents' own."""

Agents = AgentConfig | str | Sequence[str] | None
"""What `agents=` can be: names of agents, a configuration or its name as seen from the sample's agent, or None or
`available` for all agents that are there."""


def cooperating_agents(dataset: Dataset, sample: RowArgument, agents: Agents = None) -> tuple[AgentName, ...]:
    """The agents that an `agents=` argument means at a sample, each once; the sample's own first if it is among them.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego.
        agents: names of agents, a configuration or its name, or None or `available` for all that are there.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such agent or configuration, or no agent is given.
        NotAvailableError: an agent is not in this (partial) release of the scenario.
    """
    scenario, ego, _ = dataset.get("sample", sample)["token"].rsplit("/", 2)
    there = agents_of(dataset, scenario)
    wanted = there if agents is None or is_available(agents) else _named(agents, ego)
    if not wanted:
        raise ChoiceError("agents: expected at least one agent, found none")
    for agent in wanted:
        if agent not in there:
            raise NotAvailableError(
                f"agents: {agent} is not in this release of {scenario}, which has {', '.join(there)}; "
                "unpack its archive, name the agents that are there, or use "
                f"agents='{AVAILABLE}' (--agents {AVAILABLE}) for all that are there"
            )
    return tuple(sorted(dict.fromkeys(wanted), key=lambda agent: agent != ego))


def is_available(agents: object) -> bool:
    """Whether an `agents=` argument is the text that stands for None, `available`."""
    return isinstance(agents, str) and agents.lower() == AVAILABLE


def agents_of(dataset: Dataset, scenario: RowArgument) -> tuple[AgentName, ...]:
    """The agents that a scenario has in this release, in the order of `taxonomy.AGENTS`; raises TokenError."""
    row, names = dataset.getind("scenario", scenario), dataset.columns("agent")
    first, last = names["scenario_row"].searchsorted((row, row + 1))
    return tuple(AGENTS[code] for code in names["name"][first:last].tolist())


def _named(agents: AgentConfig | str | Sequence[str], ego: str) -> tuple[AgentName, ...]:
    if isinstance(agents, AgentConfig):
        return agents.agents_for(ego)
    if isinstance(agents, str):
        if spelled(agents, AGENTS) in AGENTS:
            raise ChoiceError(
                f"agents: expected one of {', '.join(AGENT_SETS)}, found {agents!r}; for that agent alone give "
                f"[{agents!r}]"
            )
        return AGENT_CONFIGS[choice("agents", agents, AGENT_SETS)].agents_for(ego)
    names = _names("agents", "agents' names or a configuration", agents)
    return tuple(choice("agent", agent, AGENTS) for agent in names)
