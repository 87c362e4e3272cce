"""The roles of actors in a picture: the colliding pair, the other agents, the recording agent."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.render.colors import AGENT_COLORS, CATEGORY_COLORS, COLLIDER_COLOR
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, AgentName, short_name
from deepaccident_devkit.v2x import Contact
from deepaccident_devkit.v2x.agents import agents_of


def collider_ids(dataset: Dataset, sample: RowArgument) -> set[int]:
    """The label ids, in this sample, of the pair that meta says collided: −100 where the agent is one of them."""
    record = dataset.get("sample", sample)
    collision = dataset.get("scenario", record["scenario_token"])["collision"]
    if collision is None:
        return set()
    agent_id = dataset.get("agent", record["agent_token"])["actor_id"]
    return {OWN_ACTOR_ID if actor_id == agent_id else actor_id for actor_id in collision["ids"]}


def recorder_ids(dataset: Dataset, sample: RowArgument) -> dict[int, AgentName]:
    """The label ids, in this sample, of the recording vehicles → their agents: −100 is the sample's own."""
    record = dataset.get("sample", sample)
    recorders = recorders_of(dataset, record["scenario_token"])
    return {OWN_ACTOR_ID if agent == record["agent"] else actor: agent for actor, agent in recorders.items()}


def recorders_of(dataset: Dataset, scenario: str) -> dict[int, AgentName]:
    """The actor ids of a scenario's (a token's) recording vehicles, as far as meta names them → their agents."""
    actors = {agent: dataset.agent.get(f"{scenario}/{agent}")["actor_id"] for agent in agents_of(dataset, scenario)}
    return {actor: agent for agent, actor in actors.items() if actor is not None}


def agent_letters(agent: str) -> str:
    """An agent in one or two letters: E, EB, O, OB or I."""
    return "".join(word[0] for word in short_name(agent).split()).upper()


def actor_color(category: str, agent: str | None = None, *, collides: bool = False) -> str:
    """The colour of an actor's box: red if it collides, else the hue of the agent that it is, else its category's."""
    if collides:
        return COLLIDER_COLOR
    return CATEGORY_COLORS[category] if agent is None else AGENT_COLORS[agent]


def role_colors(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[str]:
    """The colours of boxes that are a sample's own (its agent has −100) or several agents' (it has CARLA's id)."""
    record = dataset.get("sample", sample)
    colliders, recorders = collider_ids(dataset, record), recorder_ids(dataset, record)
    return [
        actor_color(category, recorders.get(actor), collides=actor in colliders)
        for actor, category in zip(label_ids(dataset, record, boxes), boxes.category_names, strict=True)
    ]


def label_ids(dataset: Dataset, sample: RowArgument, boxes: Boxes) -> list[int]:
    """The label ids, in this sample, of boxes that may have CARLA's: the agent itself is −100."""
    own = dataset.get("agent", dataset.get("sample", sample)["agent_token"])["actor_id"]
    return list(np.where(boxes.actor_id == own, OWN_ACTOR_ID, boxes.actor_id).tolist())


def actor_tags(dataset: Dataset, contact: Contact) -> dict[int, str]:
    """Short names of the two that collide: the initials of agents, such as `E` and `OB`, else the category."""
    agents = recorders_of(dataset, contact.frame.rsplit("/", 1)[0])
    return {
        actor: agent_letters(agents[actor]) if actor in agents else dataset.instance.get(instance)["category"]
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
