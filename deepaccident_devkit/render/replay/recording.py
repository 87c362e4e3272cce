"""`Recording`: the scenario that is replayed, the agents whose view is shown, and how its numbers are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import FloatArray, FrozenArrays, as_floats
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.render.roles import agent_actors
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, AgentName
from deepaccident_devkit.v2x import Agents, Contact, collision, cooperating_agents
from deepaccident_devkit.v2x.collisions import default_scenario
from deepaccident_devkit.v2x.configurations import agents_of

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording(FrozenArrays):
    """A scenario and the agents whose view is shown.

    Attributes:
        dataset: the release.
        scenario: its record.
        agents: in the order of `taxonomy.AGENTS`.
        contact: how the accident happened; None if nobody collides, or if that is not known.
        unknown: a sentence that says why it is not known; empty if it is known, or if nobody collides.
        origin: (2,) float64 x and y in world, metres: the origin of the page's coordinates.
    """

    dataset: Dataset
    scenario: ScenarioRecord
    agents: tuple[AgentName, ...]
    contact: Contact | None
    unknown: str
    origin: FloatArray

    @property
    def frames(self) -> range:
        """The frame numbers, from 1."""
        return range(1, self.scenario["num_frames"] + 1)

    @property
    def pair(self) -> tuple[int, ...]:
        """The actor ids of the two that collide; empty if nobody does."""
        told = self.scenario["collision"]
        return () if told is None else tuple(told["ids"])

    def sample(self, agent: str, frame: int) -> str:
        """The token of a sample."""
        return sample_token(self.scenario["token"], agent, frame)

    @property
    def recorders(self) -> dict[int, AgentName]:
        """Actor id → agent, for all agents in the release that are vehicles with a known id, shown or not."""
        actors = agent_actors(self.dataset, self.scenario["token"])
        return {actor: agent for agent, actor in actors.items()}

    def actor_of(self, agent: str) -> int | None:
        """The actor id of an agent; None for the infrastructure, and if meta does not give it."""
        actor: int | None = self.dataset.get("agent", f"{self.scenario['token']}/{agent}")["actor_id"]
        return actor

    def places(self, xy: ArrayLike) -> list[Any]:
        """Places (…, 2) in world, metres, as the page has them: whole centimetres from the origin."""
        places: list[Any] = np.rint((as_floats(xy) - self.origin) * 100).astype(np.int64).tolist()
        return places


def recording_of(dataset: Dataset, scenario: RowArgument | None, agents: Agents) -> Recording:
    """A scenario of a release.

    Args:
        dataset: the release.
        scenario: token or record; None for the first that ends in an accident, or if there is no accident, for the
            first one.
        agents: whose view is shown, as `cooperating_agents` takes them, seen from the first agent that is there.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: the release has no scenario, or lacks one of the agents.
        ChoiceError: no such agent or configuration.
    """
    record = dataset.scenario[dataset.getind("scenario", default_scenario(dataset) if scenario is None else scenario)]
    first = sample_token(record["token"], agents_of(dataset, record)[0], 1)
    chosen = cooperating_agents(dataset, first, agents)
    contact, unknown = _contact(dataset, record)
    return Recording(
        dataset=dataset,
        scenario=record,
        agents=tuple(agent for agent in AGENTS if agent in chosen),
        contact=contact,
        unknown=unknown,
        origin=_origin(dataset, record, contact),
    )


def _contact(dataset: Dataset, record: ScenarioRecord) -> tuple[Contact | None, str]:
    try:
        return collision(dataset, record), ""
    except NotAvailableError as error:
        return None, str(error)


def _origin(dataset: Dataset, record: ScenarioRecord, contact: Contact | None) -> FloatArray:
    """The place of the impact or, without one, the middle of the agents at the end; in whole metres."""
    if contact is not None:
        return as_floats(np.round(contact.point[:2]))
    poses = [dataset.world_from(sample, "ego").translation for sample in dataset.samples_of(record["last_frame_token"])]
    return as_floats(np.round(np.mean(poses, axis=0)[:2]))
