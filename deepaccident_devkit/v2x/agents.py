"""Cooperating agents, and whether they see an accident coming under the released code's rule.

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
"""The role of a partner.

It is the vehicle behind the ego, one of the two vehicles of the other pair, or the infrastructure.
"""
VehicleSide = Literal["ego_vehicle", "other_vehicle"]
SHEER_CURTAINS = (
    "Town05_type001_subtype0002_scenario00035",
    "Town05_type001_subtype0002_scenario00004",
)
"""Names of scenarios in which a CARLA bug marks vehicles as invisible.

The released code always counts their samples as seeing the accident.
"""
VISIBILITIES = ("visible", "partial", "invisible")
# Frames between two observations: the released code works at 2 Hz.
_OBSERVATION_STEP_FRAMES = 5
# The released rule uses the current observation and the two before it.
_NUM_OBSERVATIONS = 3
# The released code evaluates the moments 0.5, 1, 1.5 and 2 s before the last frame.
_NUM_EVALUATED_MOMENTS = 4
# `hidden_collider` uses the frames from 20 to 10 before the last one, which is 2 s to 1 s.
_HIDDEN_WINDOW_FRAMES = (20, 10)
# Ego → role → agent, as the released V2X dataset renames them (docs/released_code.md, Poses).
_PARTNERS: dict[AgentName, dict[PartnerRole, AgentName]] = {
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
        """Check the roles.

        Raises:
            ChoiceError: A role is unknown.
        """
        partners = choices("partners", self.partners, get_args(PartnerRole), empty=True)
        object.__setattr__(self, "partners", partners)

    def agents_for(self, ego: str, *, side: VehicleSide = "ego_vehicle") -> tuple[AgentName, ...]:
        """Return the names of this configuration's agents for an ego, the ego first.

        If the ego is a vehicle, `behind` is the other vehicle of its pair (for a vehicle that
        follows, the one in front), and `other` is the front vehicle of the other pair. If the ego
        is the infrastructure, `infrastructure` is the front vehicle of the pair `side`, `behind` is
        the one behind it, and `other` and `other_behind` are the vehicles of the other pair. So
        `vehicles` always means four agents, including three partners.

        The released code shuffles the vehicles and draws the infrastructure's `side` at random.
        Here the agents are in the order of the roles, and the caller chooses the `side`.

        Args:
            ego: Name of the agent that receives the data of its partners.
            side: Front vehicle of the pair that the infrastructure belongs to; ignored if the ego
                is a vehicle.

        Raises:
            ChoiceError: The agent or the side is unknown.
        """
        agent = choice("agent", ego, AGENTS)
        side = choice("side", side, get_args(VehicleSide))
        agents_by_role: Mapping[PartnerRole, AgentName]
        if agent == INFRASTRUCTURE:
            agents_by_role = {**_PARTNERS[side], "infrastructure": side}
        else:
            agents_by_role = _PARTNERS[agent]
        partners = [agents_by_role[role] for role in self.partners]
        return (agent, *partners)


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
AVAILABLE = "available"
"""The name (equivalent to None) for all agents of a scenario that a (partial) release has."""
AGENT_SETS = (*AGENT_CONFIGS, AVAILABLE)
"""The values that `agents=` accepts apart from names of agents."""
Agents = AgentConfig | str | Sequence[str] | None
"""What `agents=` can be.

It is one or several names of agents; a configuration or its name, whose roles are relative to the
sample's agent; or None or `available` for all available agents.
"""


def checked_agents(agents: Agents) -> AgentConfig | str | tuple[AgentName, ...] | None:
    """Return an `agents=` argument in canonical spelling, with names of agents as a tuple.

    Raises:
        ChoiceError: An agent or the configuration is unknown.
    """
    if agents is None or isinstance(agents, AgentConfig):
        return agents
    if isinstance(agents, str):
        agents = choice("agents", agents, (*AGENT_SETS, *AGENTS))
        if agents in AGENT_SETS:
            return agents
    return choices("agents", agents, AGENTS)


def agents_note(agents: Agents) -> str | list[str] | None:
    """Convert an `agents=` argument to JSON, as results and training runs record it.

    Raises:
        ChoiceError: An agent or the configuration is unknown.
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
    """Return the distinct agents that an `agents=` argument selects for a sample.

    The sample's own agent comes first if it is one of them.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego.
        agents: Names of agents, a configuration or its name, or None or `available` for all
            available agents (see `Agents`).

    Raises:
        TokenError: The sample is unknown.
        ChoiceError: An agent or the configuration is unknown, or `agents` is empty.
        NotAvailableError: An agent of the scenario is not in this (partial) release.
    """
    scenario, ego, _ = dataset.get("sample", sample)["token"].rsplit("/", 2)
    available_agents = agents_of(dataset, scenario)
    checked = checked_agents(agents)
    if isinstance(checked, str) and checked != AVAILABLE:
        checked = AGENT_CONFIGS[checked]
    if isinstance(checked, AgentConfig):
        named_agents = checked.agents_for(ego)
    elif isinstance(checked, tuple):
        named_agents = checked
    else:
        named_agents = available_agents
    for agent in named_agents:
        if agent not in available_agents:
            raise NotAvailableError(
                f"agents: {agent} is not in this release of {scenario}, "
                f"which has {', '.join(available_agents)}; "
                "unpack its archive, name agents that the release has, or use "
                f"agents='{AVAILABLE}' (--agents {AVAILABLE}) for all agents in the release"
            )
    unique_agents = dict.fromkeys(named_agents)
    return tuple(sorted(unique_agents, key=ego.__ne__))


def is_available(agents: object) -> bool:
    """Return whether an `agents=` argument is the text `available`, which is equivalent to None."""
    if not isinstance(agents, str):
        return False
    return agents.lower() == AVAILABLE


def agents_of(dataset: Dataset, scenario: RowArgument) -> tuple[AgentName, ...]:
    """Return a scenario's agents in this release, in the order of `taxonomy.AGENTS`.

    Raises:
        TokenError: The scenario is unknown.
    """
    scenario_row = dataset.getind("scenario", scenario)
    columns = dataset.columns("agent")
    bounds = (scenario_row, scenario_row + 1)
    start, stop = columns["scenario_row"].searchsorted(bounds)
    codes = columns["name"][start:stop].tolist()
    return tuple([AGENTS[code] for code in codes])


def accident_visibility(dataset: Dataset, scenario: RowArgument) -> str | None:
    """Return whether `ego_vehicle` sees the accident always, sometimes or never before the impact.

    The released code's four moments are tested: 0.5, 1, 1.5 and 2 s before the last frame. Moments
    before the recording began are left out.

    Returns:
        `visible` if `accident_visible` is True at all of them, `invisible` if at none, otherwise
            `partial`. None if meta is missing or names no collision, or if one of the moments
            cannot be judged.

    Raises:
        TokenError: The scenario is unknown.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    if record["collision"] is None:
        return None
    ego = _find_ego(dataset, record)
    if ego is None:
        return None
    verdicts = set()
    for step in range(1, _NUM_EVALUATED_MOMENTS + 1):
        index = record["num_frames"] - _OBSERVATION_STEP_FRAMES * step
        if index > 0:
            verdicts.add(_judge_accident_visible(dataset, record, ego, index))
    if None in verdicts or not verdicts:
        return None
    if len(verdicts) == 2:
        return "partial"
    if True in verdicts:
        return "visible"
    return "invisible"


def hidden_collider(dataset: Dataset, scenario: RowArgument) -> bool | None:
    """Return whether one of the colliding actors is hidden from `ego_vehicle` before the impact.

    The frames from 2 s to 1 s before the last one are tested, at 10 Hz, as far as the recording
    reaches back. A collider is hidden if the ego, without its partners, sees it in none of them
    under the released code's rule (docs/released_code.md, Visibility and attributes). No collider
    counts as hidden in the scenarios `SHEER_CURTAINS`.

    Returns:
        None if unknown: meta is missing, names no collision or does not name the ego's actor; or
            frames of the window are missing or not labelled.

    Raises:
        TokenError: The scenario is unknown.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    collision = record["collision"]
    ego = _find_ego(dataset, record)
    start, end = (record["num_frames"] - frames for frames in _HIDDEN_WINDOW_FRAMES)
    if collision is None or ego is None or ego["actor_id"] is None or end < 1:
        return None
    if record["name"] in SHEER_CURTAINS:
        return False
    indices = range(max(start, 1), end + 1)
    is_seen = _sees_pair(dataset, ego, indices, collision["ids"])
    if is_seen is None:
        return None
    return not is_seen


def accident_visible(dataset: Dataset, sample: RowArgument) -> bool | None:
    """Return the released attribute `accident_visibility`: whether the agent sees the accident.

    An agent has the accident in view if it sees both colliding actors (apart from itself) under the
    released rule without the other agents. The result is False if the accident is not in view now
    and was not in view 0.5 s ago, 1 s ago or both. A moment before the recording counts as not
    in view. Scenarios without a collision, and the two of `SHEER_CURTAINS`, always count as seen.

    Returns:
        None if unknown: there is no meta or no label, or meta does not name the agent's actor.

    Raises:
        TokenError: The sample is unknown.
    """
    record = dataset.sample[dataset.getind("sample", sample)]
    scenario = dataset.scenario.get(record["scenario_token"])
    index = dataset.frame.get(record["frame_token"])["index"]
    agent = dataset.agent.get(record["agent_token"])
    return _judge_accident_visible(dataset, scenario, agent, index)


def accident_visible_mask(
    in_view: ArrayLike, *, collision: ArrayLike = True, exempt: ArrayLike = False
) -> BoolArray:
    """Return which samples count as seeing the accident, from what their agents have in view.

    This is the released rule (docs/released_code.md, Visibility and attributes). A sample does not
    see the accident if its agent does not have it in view now and did not at one or both of the two
    earlier moments.

    Args:
        in_view: Truth values, shape (…, 3): whether the agent had the colliding pair, except
            itself, in view (`pair_in_view`) 1 s ago, 0.5 s ago and now; False for moments before
            the recording.
        collision: Truth values, shape (…): whether meta names a collision; without one the result
            is True.
        exempt: Truth values, shape (…): whether the scenario is one of `SHEER_CURTAINS`, for which
            the result is True.

    Returns:
        Truth values, shape (…).

    Raises:
        GeometryError: `in_view` has the wrong shape.
    """
    views = as_numbers("in_view", in_view, f"truth values (…, {_NUM_OBSERVATIONS})", np.bool_)
    if views.shape[-1:] != (_NUM_OBSERVATIONS,):
        raise GeometryError(
            f"in_view: expected shape (…, {_NUM_OBSERVATIONS}), found {views.shape}"
        )
    num_unseen = (~views).sum(axis=-1)
    is_unseen = (num_unseen > _NUM_OBSERVATIONS / 2) & ~views[..., -1]
    has_collision = np.asarray(collision, dtype=bool)
    is_exempt = np.asarray(exempt, dtype=bool)
    is_judged = has_collision & ~is_exempt
    return np.asarray(~(is_unseen & is_judged))


def pair_in_view(
    mask: ArrayLike, actor_ids: ArrayLike, pair: Collection[int], own_id: int | None = None
) -> bool:
    """Return whether an agent sees both colliding actors, apart from itself, in one frame.

    See docs/released_code.md, Visibility and attributes.

    Args:
        mask: Truth values, shape (N,): which boxes of its label the agent sees
            (`tables.visible_mask`).
        actor_ids: Actor ids of the label, shape (N,); −1 and −100 never count as seen, so a pair
            that contains −1 (no collision) does not either.
        pair: Actor ids of the pair.
        own_id: Actor id of the agent; None if the agent is not a vehicle.
    """
    other_ids = set(map(int, pair)) - {own_id}
    seen_ids = visible_ids([mask], [actor_ids])
    return other_ids <= set(seen_ids.tolist())


def _find_ego(dataset: Dataset, scenario: ScenarioRecord) -> AgentRecord | None:
    """Return the agent `ego_vehicle` of a scenario; None in a partial download without it."""
    try:
        return dataset.agent.get(f"{scenario['token']}/{VEHICLE_AGENTS[0]}")
    except TokenError:
        return None


def _judge_accident_visible(
    dataset: Dataset, scenario: ScenarioRecord, agent: AgentRecord, index: int
) -> bool | None:
    """Return whether an agent sees the accident at frame number `index`; None if unknown."""
    if scenario["weather"] is None:  # meta is missing
        return None
    collision = scenario["collision"]
    is_exempt = scenario["name"] in SHEER_CURTAINS
    if collision is None or is_exempt:
        # The views make no difference here, so no label is read.
        unknown_views = [False] * _NUM_OBSERVATIONS
        has_collision = collision is not None
        mask = accident_visible_mask(unknown_views, collision=has_collision, exempt=is_exempt)
        return bool(mask)
    if agent["actor_id"] is None and agent["name"] != INFRASTRUCTURE:
        return None
    views = []
    for steps_back in reversed(range(_NUM_OBSERVATIONS)):
        moment = index - _OBSERVATION_STEP_FRAMES * steps_back
        is_in_view: bool | None = False
        if moment > 0:
            is_in_view = _sees_pair(dataset, agent, [moment], collision["ids"])
        views.append(is_in_view)
    known_views = [view for view in views if view is not None]
    if len(known_views) < _NUM_OBSERVATIONS:
        return None
    return bool(accident_visible_mask(known_views))


def _sees_pair(
    dataset: Dataset, agent: AgentRecord, indices: Iterable[int], pair: Collection[int]
) -> bool | None:
    """Return whether an agent, without partners, sees each actor of a pair in at least one frame.

    If the agent is one of the pair, it need not see itself.

    Args:
        dataset: The release.
        agent: Record of the agent.
        indices: Frame numbers; an actor counts as seen if the agent sees it in one of them.
        pair: Actor ids of the colliding pair.

    Returns:
        None if one of the frames has no label.
    """
    samples = []
    for index in indices:
        samples.append(dataset.get_sample(agent["scenario_token"], agent["name"], index))
    if not all(sample["labelled"] for sample in samples):
        return None
    labels = [dataset.boxes(sample, "lidar") for sample in samples]
    boxes = concatenate(labels, "lidar")
    mask = visible_mask(
        boxes.center[:, :2],
        boxes.category,
        boxes.num_lidar_pts,
        boxes.camera_visible,
        infrastructure=agent["is_infrastructure"],
    )
    return pair_in_view(mask, boxes.actor_id, pair, agent["actor_id"])
