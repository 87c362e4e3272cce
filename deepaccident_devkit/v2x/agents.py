"""Cooperating agents, and whether they see an accident coming: the released rule.

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
"""The role of a partner: the vehicle behind the ego, the two vehicles of the other side, or the
infrastructure."""
VehicleSide = Literal["ego_vehicle", "other_vehicle"]
SHEER_CURTAINS: Final = (
    "Town05_type001_subtype0002_scenario00035",
    "Town05_type001_subtype0002_scenario00004",
)
"""Names of scenarios in which a CARLA bug marks vehicles as invisible; the released code never
counts their samples as unseen."""
VISIBILITIES: Final = ("visible", "partial", "invisible")
# Frames between two observations: the released code works at 2 Hz.
_OBSERVATION_STEP_FRAMES: Final = 5
# The released rule looks at the present observation and the two before it.
_NUM_OBSERVATIONS: Final = 3
# The released code evaluates 0.5, 1, 1.5 and 2 s before the last frame.
_NUM_EVALUATED_MOMENTS: Final = 4
# `hidden_collider` looks at the frames from 20 to 10 before the last one, that is from 2 to 1 s.
_HIDDEN_WINDOW_FRAMES: Final = (20, 10)
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
        name: Name of the configuration, as in `AGENT_CONFIGS`.
        partners: Roles of the partners.
    """

    name: str
    partners: tuple[PartnerRole, ...] = ()

    def __post_init__(self) -> None:
        """Check the roles; raises ChoiceError."""
        partners = choices("partners", self.partners, get_args(PartnerRole), empty=True)
        object.__setattr__(self, "partners", partners)

    def agents_for(self, ego: str, *, side: VehicleSide = "ego_vehicle") -> tuple[AgentName, ...]:
        """Return the agents of this configuration by their own names, the ego first.

        For a vehicle as the ego, `behind` is the other vehicle of its side (for a vehicle behind,
        the one in front), and `other` the front vehicle of the other side. For the infrastructure
        as the ego, `infrastructure` is the front vehicle of `side`, `behind` the one behind it, and
        `other` and `other_behind` are the vehicles of the other side. So `vehicles` always means
        four agents, three of them partners.

        The released code shuffles the vehicles and draws the infrastructure's side at random. Here
        the agents have the order of the roles, and the caller chooses the side.

        Args:
            ego: Name of the agent that receives the data of its partners.
            side: Side that the infrastructure takes; ignored for a vehicle.

        Raises:
            ChoiceError: There is no such agent or side.
        """
        agent = choice("agent", ego, AGENTS)
        side = choice("side", side, get_args(VehicleSide))
        agents_by_role: Mapping[PartnerRole, AgentName]
        if agent == INFRASTRUCTURE:
            agents_by_role = {**_PARTNERS[side], "infrastructure": side}
        else:
            agents_by_role = _PARTNERS[agent]
        return (agent, *(agents_by_role[role] for role in self.partners))


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
"""The name, equivalent to None, of all agents that a (partial) release has of a scenario."""
AGENT_SETS: Final = (*AGENT_CONFIGS, AVAILABLE)
"""The names that `agents=` takes besides names of agents."""
Agents = AgentConfig | str | Sequence[str] | None
"""What `agents=` can be: the name of an agent or several such names, a configuration or its name
relative to the sample's agent, or None or `available` for all available agents."""


def checked_agents(agents: Agents) -> AgentConfig | str | tuple[AgentName, ...] | None:
    """Return an `agents=` argument in its own spelling, with names of agents as a tuple.

    Raises:
        ChoiceError: There is no such agent or configuration.
    """
    if agents is None or isinstance(agents, AgentConfig):
        return agents
    if isinstance(agents, str):
        agents = choice("agents", agents, (*AGENT_SETS, *AGENTS))
        if agents in AGENT_SETS:
            return agents
    return choices("agents", agents, AGENTS)


def agents_note(agents: Agents) -> str | list[str] | None:
    """Return an `agents=` argument for JSON, as results and training runs record it.

    Raises:
        ChoiceError: There is no such agent or configuration.
    """
    checked = checked_agents(agents)
    if isinstance(checked, AgentConfig):
        return checked.name
    if isinstance(checked, tuple):
        return list(checked)
    return checked


def cooperating_agents(
    dataset: Dataset, sample: RowArgument, agents: Agents = None
) -> tuple[AgentName, ...]:
    """Return the agents that an `agents=` argument means at a sample, without repetitions.

    The sample's own agent comes first if it is among them.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego.
        agents: Names of agents, a configuration or its name, or None or `available` for all
            available agents.

    Raises:
        TokenError: There is no such sample.
        ChoiceError: There is no such agent or configuration, or `agents` is empty.
        NotAvailableError: An agent is not in this (partial) release of the scenario.
    """
    scenario, ego, _ = dataset.get("sample", sample)["token"].rsplit("/", 2)
    available_agents = agents_of(dataset, scenario)
    named_agents = _agents_by_name(agents, ego, available_agents)
    for agent in named_agents:
        if agent not in available_agents:
            raise NotAvailableError(
                f"agents: {agent} is not in this release of {scenario}, "
                f"which has {', '.join(available_agents)}; "
                "unpack its archive, name the agents that are there, or use "
                f"agents='{AVAILABLE}' (--agents {AVAILABLE}) for all that are there"
            )
    unique_agents = dict.fromkeys(named_agents)
    return tuple(sorted(unique_agents, key=ego.__ne__))


def is_available(agents: object) -> bool:
    """Return whether an `agents=` argument is `available`, the text equivalent to None."""
    return isinstance(agents, str) and agents.lower() == AVAILABLE


def agents_of(dataset: Dataset, scenario: RowArgument) -> tuple[AgentName, ...]:
    """Return the agents that a scenario has in this release, in the order of `taxonomy.AGENTS`.

    Raises:
        TokenError: There is no such scenario.
    """
    scenario_row = dataset.getind("scenario", scenario)
    columns = dataset.columns("agent")
    start, stop = columns["scenario_row"].searchsorted((scenario_row, scenario_row + 1))
    return tuple([AGENTS[code] for code in columns["name"][start:stop].tolist()])


def _agents_by_name(
    agents: Agents, ego: str, available_agents: tuple[AgentName, ...]
) -> tuple[AgentName, ...]:
    """Return the names of the agents that an `agents=` argument means for an ego agent."""
    checked = checked_agents(agents)
    if checked in (None, AVAILABLE):
        return available_agents
    if isinstance(checked, str):
        checked = AGENT_CONFIGS[checked]
    if isinstance(checked, AgentConfig):
        return checked.agents_for(ego)
    return checked


def accident_visibility(dataset: Dataset, scenario: RowArgument) -> str | None:
    """Return how well `ego_vehicle` sees a scenario's accident at the released code's four moments.

    The moments are 0.5, 1, 1.5 and 2 s before the last frame, as far as the recording reaches back.

    Returns:
        `visible` if `accident_visible` holds at all of them, `invisible` if at none, `partial`
        otherwise; None if meta names no collision or is missing, or where one of the moments cannot
        be judged.

    Raises:
        TokenError: There is no such scenario.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    if record["collision"] is None:
        return None
    ego = _ego_of(dataset, record)
    if ego is None:
        return None
    steps = range(1, _NUM_EVALUATED_MOMENTS + 1)
    indices = [record["num_frames"] - _OBSERVATION_STEP_FRAMES * step for step in steps]
    verdicts = {_accident_visible(dataset, record, ego, index) for index in indices if index > 0}
    if None in verdicts or not verdicts:
        return None
    if len(verdicts) == 2:
        return "partial"
    return "visible" if True in verdicts else "invisible"


def hidden_collider(dataset: Dataset, scenario: RowArgument) -> bool | None:
    """Return whether one of the colliding pair is hidden from `ego_vehicle` before the impact.

    The window reaches from 2 to 1 s before the last frame, at ten frames a second, as far as the
    recording reaches back. A collider is hidden if the ego itself sees it at none of these frames,
    by the released rule (docs/released_code.md, Visibility and attributes). No collider of the
    scenarios `SHEER_CURTAINS` counts as hidden.

    Returns:
        None if meta names no collision or is missing, or where it cannot be judged: meta does not
        name the actor of the ego, or one of the frames, or all of them, are missing.

    Raises:
        TokenError: There is no such scenario.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    collision = record["collision"]
    ego = _ego_of(dataset, record)
    start, end = (record["num_frames"] - frames for frames in _HIDDEN_WINDOW_FRAMES)
    if collision is None or ego is None or ego["actor_id"] is None or end < 1:
        return None
    if record["name"] in SHEER_CURTAINS:
        return False
    pair_seen = _has_in_view(dataset, ego, range(max(start, 1), end + 1), collision["ids"])
    return None if pair_seen is None else not pair_seen


def accident_visible(dataset: Dataset, sample: RowArgument) -> bool | None:
    """Return the released attribute `accident_visibility`: whether an agent sees the accident.

    The agent has the accident in view at a moment if it sees by itself (the released rule without
    the other agents) the colliding pair, itself excepted. The sample counts as unseen if this fails
    now and at one or two of the moments 0.5 s and 1 s ago, where a moment before the recording
    counts as failed. Scenarios without a collision and the two of `SHEER_CURTAINS` always count as
    seen.

    Returns:
        None where it is unknown: without meta, without labels, or if meta does not name the actor
        of the agent.

    Raises:
        TokenError: There is no such sample.
    """
    record = dataset.sample[dataset.getind("sample", sample)]
    scenario = dataset.scenario.get(record["scenario_token"])
    index = dataset.frame.get(record["frame_token"])["index"]
    agent = dataset.agent.get(record["agent_token"])
    return _accident_visible(dataset, scenario, agent, index)


def accident_visible_mask(
    in_view: ArrayLike, *, collision: ArrayLike = True, exempt: ArrayLike = False
) -> BoolArray:
    """Apply the released rule by itself: return which samples count as seeing the accident.

    See docs/released_code.md, Visibility and attributes. A sample does not see it if its agent does
    not have the accident in view now and at one or two of the two moments before.

    Args:
        in_view: Truth values, shape (…, 3): whether the agent has the colliding pair, except
            itself, in view (`pair_in_view`) 1 s ago, 0.5 s ago and now; False for a moment before
            the recording.
        collision: Truth values, shape (…): whether meta names a collision; a sample without one
            counts as seeing it.
        exempt: Truth values, shape (…): whether the scenario is one of `SHEER_CURTAINS`, which
            always count as seen.

    Returns:
        Truth values, shape (…).

    Raises:
        GeometryError: `in_view` has another shape.
    """
    views = as_numbers("in_view", in_view, f"truth values (…, {_NUM_OBSERVATIONS})", np.bool_)
    if views.shape[-1:] != (_NUM_OBSERVATIONS,):
        raise GeometryError(
            f"in_view: expected shape (…, {_NUM_OBSERVATIONS}), found {views.shape}"
        )
    num_unseen = (~views).sum(axis=-1)
    unseen = (num_unseen > _NUM_OBSERVATIONS / 2) & ~views[..., -1]
    judged = np.asarray(collision, dtype=bool) & ~np.asarray(exempt, dtype=bool)
    return np.asarray(~(unseen & judged))


def pair_in_view(
    mask: ArrayLike, actor_ids: ArrayLike, pair: Collection[int], own_id: int | None = None
) -> bool:
    """Return whether an agent sees the colliding pair, itself excepted, at one moment.

    See docs/released_code.md, Visibility and attributes.

    Args:
        mask: Truth values, shape (N,): which boxes of its label the agent sees
            (`tables.visible_mask`).
        actor_ids: Actor ids of the label, shape (N,); −1 and −100 are never seen, so that a pair of
            −1 (no collision) is not.
        pair: Actor ids of the pair.
        own_id: Actor id of the agent; None for an agent that is no vehicle.
    """
    other_ids = set(map(int, pair)) - {own_id}
    seen_ids = visible_ids([mask], [actor_ids])
    return other_ids <= set(seen_ids.tolist())


def _ego_of(dataset: Dataset, scenario: ScenarioRecord) -> AgentRecord | None:
    """Return the agent `ego_vehicle` of a scenario; None in a partial download without it."""
    try:
        return dataset.agent.get(f"{scenario['token']}/{VEHICLE_AGENTS[0]}")
    except TokenError:
        return None


def _accident_visible(
    dataset: Dataset, scenario: ScenarioRecord, agent: AgentRecord, index: int
) -> bool | None:
    """Return whether an agent sees the accident at frame number `index`; None if unknown."""
    if scenario["weather"] is None:  # there is no meta
        return None
    collision = scenario["collision"]
    exempt = scenario["name"] in SHEER_CURTAINS
    if collision is None or exempt:
        # The views make no difference then, so that no label is read.
        unknown_views = [False] * _NUM_OBSERVATIONS
        has_collision = collision is not None
        return bool(accident_visible_mask(unknown_views, collision=has_collision, exempt=exempt))
    if agent["actor_id"] is None and agent["name"] != INFRASTRUCTURE:
        return None
    views = []
    for steps_back in reversed(range(_NUM_OBSERVATIONS)):
        moment = index - _OBSERVATION_STEP_FRAMES * steps_back
        if moment > 0:
            views.append(_has_in_view(dataset, agent, [moment], collision["ids"]))
        else:
            views.append(False)
    known_views = [view for view in views if view is not None]
    if len(known_views) < _NUM_OBSERVATIONS:
        return None
    return bool(accident_visible_mask(known_views))


def _has_in_view(
    dataset: Dataset, agent: AgentRecord, indices: Iterable[int], pair: Collection[int]
) -> bool | None:
    """Return whether an agent by itself sees each other actor of a pair in some of the frames.

    Args:
        dataset: The release.
        agent: Record of the agent.
        indices: Frame numbers; an actor counts as seen if the agent sees it at one of them.
        pair: Actor ids of the colliding pair.

    Returns:
        None if one of the frames has no label.
    """
    scenario = agent["scenario_token"]
    name = agent["name"]
    samples = [dataset.get_sample(scenario, name, index) for index in indices]
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
