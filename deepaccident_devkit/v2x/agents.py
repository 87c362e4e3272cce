"""Which agents cooperate, and whether one of them sees an accident coming: the released rule.

See docs/released_code.md, Visibility and attributes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import GeometryError, NotAvailableError, TokenError
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.support.arrays import BoolArray, as_numbers
from deepaccident_devkit.support.text import choice, choices
from deepaccident_devkit.tables import visible_ids, visible_mask
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE, VEHICLE_AGENTS, AgentName

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import AgentRecord, ScenarioRecord

PartnerRole = Literal["behind", "other", "other_behind", "infrastructure"]
"""The role of a partner: the vehicle behind the ego, the two vehicles of the other side, the infrastructure."""
VehicleSide = Literal["ego_vehicle", "other_vehicle"]
SHEER_CURTAINS: Final = (
    "Town05_type001_subtype0002_scenario00035",
    "Town05_type001_subtype0002_scenario00004",
)
"""Names of scenarios whose vehicles a CARLA bug marks invisible: the released code never counts them as unseen."""
VISIBILITIES: Final = ("visible", "partial", "invisible")
# Frames between two observations: the released code works at 2 Hz.
_STEP: Final = 5
# Observations that count, the present one and two before it; and steps before the last frame at which the released
# code evaluates: 0.5, 1, 1.5 and 2 s.
_OBSERVED, _EVALUATED = 3, 4
# Frames before the last one between which `hidden_collider` looks: 2 to 1 s.
_BEFORE: Final = (20, 10)
# Ego → role → agent: the released V2X dataset's renaming (docs/released_code.md, Poses).
_PARTNERS: Final[dict[AgentName, dict[PartnerRole, AgentName]]] = {
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


@dataclass(frozen=True, slots=True)
class AgentConfig:
    """The agents that cooperate with an ego agent, named by their roles.

    Attributes:
        name: as in `AGENT_CONFIGS`.
        partners: the roles of the partners.
    """

    name: str
    partners: tuple[PartnerRole, ...] = ()

    def __post_init__(self) -> None:
        """Check the roles; raises ChoiceError."""
        object.__setattr__(
            self, "partners", choices("partners", self.partners, get_args(PartnerRole), empty=True)
        )

    def agents_for(self, ego: str, *, side: VehicleSide = "ego_vehicle") -> tuple[AgentName, ...]:
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
        side = choice("side", side, get_args(VehicleSide))
        if agent == INFRASTRUCTURE:
            named: Mapping[PartnerRole, AgentName] = {**_PARTNERS[side], "infrastructure": side}
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
"""What `agents=` can be: one agent's name or several, a configuration or its name as seen from the sample's agent, or
None or `available` for all agents that are there."""


def checked_agents(agents: Agents) -> AgentConfig | str | tuple[AgentName, ...] | None:
    """Return an `agents=` argument in its own spelling, with names of agents as a tuple; raises ChoiceError."""
    if agents is None or isinstance(agents, AgentConfig):
        return agents
    if isinstance(agents, str):
        agents = choice("agents", agents, (*AGENT_SETS, *AGENTS))
        if agents in AGENT_SETS:
            return agents
    return choices("agents", agents, AGENTS)


def agents_note(agents: Agents) -> str | list[str] | None:
    """Return an `agents=` argument as the notes of results and trainings have it, for JSON; raises ChoiceError."""
    checked = checked_agents(agents)
    if isinstance(checked, AgentConfig):
        return checked.name
    return list(checked) if isinstance(checked, tuple) else checked


def cooperating_agents(
    dataset: Dataset, sample: RowArgument, agents: Agents = None
) -> tuple[AgentName, ...]:
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
    wanted = _named(agents, ego, there)
    for agent in wanted:
        if agent not in there:
            raise NotAvailableError(
                f"agents: {agent} is not in this release of {scenario}, which has {', '.join(there)}; "
                "unpack its archive, name the agents that are there, or use "
                f"agents='{AVAILABLE}' (--agents {AVAILABLE}) for all that are there"
            )
    return tuple(sorted(dict.fromkeys(wanted), key=ego.__ne__))


def is_available(agents: object) -> bool:
    """Whether an `agents=` argument is the text that stands for None, `available`."""
    return isinstance(agents, str) and agents.lower() == AVAILABLE


def agents_of(dataset: Dataset, scenario: RowArgument) -> tuple[AgentName, ...]:
    """The agents that a scenario has in this release, in the order of `taxonomy.AGENTS`; raises TokenError."""
    row, names = dataset.getind("scenario", scenario), dataset.columns("agent")
    first, last = names["scenario_row"].searchsorted((row, row + 1))
    return tuple([AGENTS[code] for code in names["name"][first:last].tolist()])


def _named(agents: Agents, ego: str, there: tuple[AgentName, ...]) -> tuple[AgentName, ...]:
    checked = checked_agents(agents)
    if checked in (None, AVAILABLE):
        return there
    if isinstance(checked, str):
        checked = AGENT_CONFIGS[checked]
    return checked.agents_for(ego) if isinstance(checked, AgentConfig) else checked


def accident_visibility(dataset: Dataset, scenario: RowArgument) -> str | None:
    """Whether `ego_vehicle` sees the accident of a scenario at the four moments that the released code evaluates.

    The moments are 0.5, 1, 1.5 and 2 s before the last frame, as far as the recording reaches back.

    Returns:
        `visible` if `accident_visible` holds at all of them, `invisible` if at none, `partial` else; None if meta
        names no collision or is missing, or where one of the moments cannot be judged.

    Raises:
        TokenError: no such scenario.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    if record["collision"] is None or (agent := _ego_of(dataset, record)) is None:
        return None
    moments = [record["num_frames"] - _STEP * step for step in range(1, _EVALUATED + 1)]
    seen = {_accident_visible(dataset, record, agent, index) for index in moments if index > 0}
    if None in seen or not seen:
        return None
    if len(seen) == 2:
        return "partial"
    return "visible" if True in seen else "invisible"


def hidden_collider(dataset: Dataset, scenario: RowArgument) -> bool | None:
    """Whether one of the colliding pair is hidden from `ego_vehicle` from 2 to 1 s before the last frame, the impact.

    Ego sees it then at no frame, ten a second, as far as the recording reaches back: itself, by the released rule
    (docs/released_code.md, Visibility and attributes). Those of `SHEER_CURTAINS` are not hidden.

    Returns:
        None if meta names no collision or is missing, or where it cannot be judged: meta does not say who ego is, or
        one of the frames, or all of them, are missing.

    Raises:
        TokenError: no such scenario.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    collision, agent = record["collision"], _ego_of(dataset, record)
    first, last = (record["num_frames"] - before for before in _BEFORE)
    if collision is None or agent is None or agent["actor_id"] is None or last < 1:
        return None
    if record["name"] in SHEER_CURTAINS:
        return False
    seen = _has_in_view(dataset, agent, range(max(first, 1), last + 1), collision["ids"])
    return None if seen is None else not seen


def accident_visible(dataset: Dataset, sample: RowArgument) -> bool | None:
    """The released attribute `accident_visibility` of a sample: whether its agent has the accident in view.

    The agent has it in view at a moment if it sees by itself (the released rule without the other agents) the colliding
    pair, itself excepted. The sample counts as unseen if that fails now and at one or two of the moments
    0.5 s and 1 s ago, where a moment before the recording counts as failed. Scenarios without a collision and the two
    of `SHEER_CURTAINS` always count as seen.

    Returns:
        None where it cannot be told: without meta, without labels, or if meta does not say which actor the agent is.

    Raises:
        TokenError: no such sample.
    """
    record = dataset.sample[dataset.getind("sample", sample)]
    scenario = dataset.scenario.get(record["scenario_token"])
    index = dataset.frame.get(record["frame_token"])["index"]
    return _accident_visible(dataset, scenario, dataset.agent.get(record["agent_token"]), index)


def accident_visible_mask(
    in_view: ArrayLike, *, collision: ArrayLike = True, exempt: ArrayLike = False
) -> BoolArray:
    """The released rule by itself: which samples count as seeing the accident.

    See docs/released_code.md, Visibility and attributes. A sample does not if its agent does not have the accident in
    view now and at one or two of the two moments before.

    Args:
        in_view: (…, 3) bool, whether the agent has all of the colliding pair but itself in view (`pair_in_view`) 1 s
            ago, 0.5 s ago and now; False for a moment before the recording.
        collision: (…) whether meta names a collision; without one a sample counts as seeing it.
        exempt: (…) whether the scenario is one of `SHEER_CURTAINS`, which always count as seen.

    Returns:
        (…) bool.

    Raises:
        GeometryError: `in_view` has another shape.
    """
    views = as_numbers("in_view", in_view, f"truth values (…, {_OBSERVED})", np.bool_)
    if views.shape[-1:] != (_OBSERVED,):
        raise GeometryError(f"in_view: expected shape (…, {_OBSERVED}), found {views.shape}")
    unseen = ((~views).sum(axis=-1) > _OBSERVED / 2) & ~views[..., -1]
    counts = np.asarray(collision, dtype=bool) & ~np.asarray(exempt, dtype=bool)
    return np.asarray(~(unseen & counts))


def pair_in_view(
    mask: ArrayLike, actor_ids: ArrayLike, pair: Collection[int], own_id: int | None = None
) -> bool:
    """Whether an agent sees the others of a colliding pair at one moment.

    See docs/released_code.md, Visibility and attributes.

    Args:
        mask: (N,) which boxes of its label the agent sees (`tables.visible_mask`).
        actor_ids: (N,) the label's ids; −1 and −100 are never seen, so that a pair of −1 (no collision) is not.
        pair: actor ids.
        own_id: the agent's; None for one that is no vehicle.
    """
    others = set(map(int, pair)) - {own_id}
    return others <= set(visible_ids([mask], [actor_ids]).tolist())


def _ego_of(dataset: Dataset, scenario: ScenarioRecord) -> AgentRecord | None:
    """`ego_vehicle` of a scenario; None in a partial download without it."""
    try:
        return dataset.agent.get(f"{scenario['token']}/{VEHICLE_AGENTS[0]}")
    except TokenError:
        return None


def _accident_visible(
    dataset: Dataset, scenario: ScenarioRecord, agent: AgentRecord, index: int
) -> bool | None:
    if scenario["weather"] is None:  # there is no meta
        return None
    collision, exempt = scenario["collision"], scenario["name"] in SHEER_CURTAINS
    if collision is None or exempt:  # whatever is in view
        return bool(
            accident_visible_mask(
                [False] * _OBSERVED, collision=collision is not None, exempt=exempt
            )
        )
    if agent["actor_id"] is None and agent["name"] != INFRASTRUCTURE:
        return None
    moments = [index - _STEP * back for back in reversed(range(_OBSERVED))]
    views = [
        _has_in_view(dataset, agent, [moment], collision["ids"]) if moment > 0 else False
        for moment in moments
    ]
    seen = [view for view in views if view is not None]
    return bool(accident_visible_mask(seen)) if len(seen) == _OBSERVED else None


def _has_in_view(
    dataset: Dataset, agent: AgentRecord, indices: Iterable[int], pair: Collection[int]
) -> bool | None:
    """Whether an agent itself sees each of the others of a pair at one of some frames; None if one has no label."""
    samples = [
        dataset.get_sample(agent["scenario_token"], agent["name"], index) for index in indices
    ]
    if not all(sample["labelled"] for sample in samples):
        return None
    boxes = concatenate([dataset.boxes(sample, "lidar") for sample in samples], "lidar")
    mask = visible_mask(
        boxes.center[:, :2],
        boxes.category,
        boxes.num_lidar_pts,
        boxes.camera_visible,
        infrastructure=agent["is_infrastructure"],
    )
    return pair_in_view(mask, boxes.actor_id, pair, agent["actor_id"])
