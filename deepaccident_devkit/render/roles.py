"""The roles of actors in a picture: the colliding pair, the other agents, the recording agent."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.colors import CATEGORY_COLORS, COLLIDER_COLOR, COMPANION_COLOR
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, AgentName
from deepaccident_devkit.v2x import Contact
from deepaccident_devkit.v2x.configurations import agents_of


def collider_ids(dataset: Dataset, sample: RowArgument) -> set[int]:
    """The label ids, in this sample, of the pair that meta says collided: −100 where the agent is one of them."""
    record = dataset.get("sample", sample)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    if collision is None:
        return set()
    agent_id = dataset.get("agent", record["agent_token"])["actor_id"]
    return {OWN_ACTOR_ID if actor_id == agent_id else actor_id for actor_id in collision["ids"]}


def companion_ids(dataset: Dataset, sample: RowArgument) -> set[int]:
    """The label ids, in this sample, of the recording vehicles that do not collide: −100 where the agent is one.

    In an accident of the paper's design these are the two vehicles behind the colliding pair.
    """
    record = dataset.get("sample", sample)
    actors = agent_actors(dataset, record["scenario_token"])
    label_ids = {OWN_ACTOR_ID if agent == record["agent"] else actor for agent, actor in actors.items()}
    return label_ids - collider_ids(dataset, record)


def agent_actors(dataset: Dataset, scenario: str) -> dict[AgentName, int]:
    """The recording vehicles of a scenario (a token) → their actor ids, if meta names them."""
    actors = {agent: dataset.agent.get(f"{scenario}/{agent}")["actor_id"] for agent in agents_of(dataset, scenario)}
    return {agent: actor for agent, actor in actors.items() if actor is not None}


def box_colors(boxes: Boxes, colliders: Collection[int] = (), companions: Collection[int] = ()) -> list[str]:
    """One colour for each box: the colliding pair red, their companions green, the others by category."""
    colors = []
    for actor_id, name in zip(boxes.actor_id.tolist(), boxes.category_names, strict=True):
        other = COMPANION_COLOR if actor_id in companions else CATEGORY_COLORS[name]
        colors.append(COLLIDER_COLOR if actor_id in colliders else other)
    return colors


def role_colors(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[str]:
    """The colours of boxes that are a sample's own (its agent has −100) or several agents' (it has CARLA's id)."""
    record = dataset.get("sample", sample)
    own = dataset.get("agent", record["agent_token"])["actor_id"]
    colliders, companions = collider_ids(dataset, record), companion_ids(dataset, record)
    for ids in (colliders, companions):
        if OWN_ACTOR_ID in ids and own is not None:
            ids.add(own)
    return box_colors(boxes, colliders, companions)


def short_name(agent: str) -> str:
    """An agent's short name for pictures: `ego`, `ego behind`, `other`, `other behind`, `infrastructure`."""
    return agent.replace("_vehicle", "").replace("_", " ")


def actor_tags(dataset: Dataset, contact: Contact) -> dict[int, str]:
    """Short names of the two that collide: the initials of agents, such as `E` and `OB`, else the category."""
    agents = {actor: agent for agent, actor in agent_actors(dataset, contact.frame.rsplit("/", 1)[0]).items()}
    return {
        actor: "".join(word[0].upper() for word in short_name(agents[actor]).split())
        if actor in agents
        else dataset.instance.get(instance)["category"]
        for actor, instance in zip(contact.actor_ids, contact.instances, strict=True)
    }


def camera_name(channel: str) -> str:
    """A camera's short name for pictures: `front`, `back left`."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", channel.removeprefix("Camera_")).lower()


def in_drawing_order(agents: Collection[str]) -> list[str]:
    """Agents in the order of `taxonomy.AGENTS`, as in panels and legends."""
    return sorted(agents, key=AGENTS.index)


def at_once(sample: Mapping[str, Any], agent: str) -> str:
    """The token of an agent's sample at the moment of another agent's sample, given by its record."""
    scenario, _, number = sample["token"].rsplit("/", 2)
    return sample_token(scenario, agent, int(number))
