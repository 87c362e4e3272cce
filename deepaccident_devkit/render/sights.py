"""Who sees whom by the released rule: `Sights` of all at a moment, `Sightings` of one actor over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, FrozenArrays, IntArray, as_floats
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import FRAME_PERIOD, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.v2x import Agents, cooperating_agents, cooperative_boxes
from deepaccident_devkit.v2x.cooperation import visible_actors

_FRAME_SLASHES: Final = 2
"""The slashes of a frame's token, `<scenario_type>/<name>/<NNN>`; a sample's token has one more, for the agent."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sights(FrozenArrays):
    """N tracked actors of a moment and the A agents that may see them; arrays are read-only.

    Attributes:
        sample: token of the sample whose agent is the ego.
        agents: the agents that look, the ego first if it is one of them.
        boxes: the actors in one frame, by ascending id; an agent's own has the agent's actor id.
        place: (A, 2) x and y of the agents in that frame, metres.
        actor: (A,) int64 the agents' own actor ids; −1 for the infrastructure, and if meta does not give it.
        seen: (N, A) bool: whether the agent counts as seeing the actor.
        annotated: (N, A) bool: whether its label has the actor at all.
        points: (N, A) int64: LiDAR points of the agent in the box that its label has.
        pair: actor ids of the two that collide; empty if nobody does.
    """

    sample: str
    agents: tuple[str, ...]
    boxes: Boxes
    place: FloatArray
    actor: IntArray
    seen: BoolArray
    annotated: BoolArray
    points: IntArray
    pair: frozenset[int]

    @property
    def ego(self) -> str:
        """The name of the sample's agent."""
        return self.sample.rsplit("/", 2)[1]

    @property
    def own(self) -> BoolArray:
        """(N, A) whether the actor is the agent itself."""
        own: BoolArray = self.boxes.actor_id[:, None] == self.actor
        return own

    @property
    def collides(self) -> BoolArray:
        """(N,) whether the actor is one of the colliding pair."""
        return np.isin(self.boxes.actor_id, [*self.pair])

    @property
    def records(self) -> BoolArray:
        """(N,) whether the actor is one of the agents."""
        return np.isin(self.boxes.actor_id, self.actor[self.actor >= 0])

    def hidden_from(self, agent: str) -> BoolArray:
        """(N,) which actors of the accident (the pair and the agents, without itself) an agent does not see.

        All are False if the agent is not one of those that look, or if nobody collides.
        """
        if agent not in self.agents or not self.pair:
            return np.zeros(len(self.boxes), dtype=bool)
        column = self.agents.index(agent)
        hidden: BoolArray = (self.collides | self.records) & ~self.seen[:, column] & ~self.own[:, column]
        return hidden


def sights(dataset: Dataset, moment: RowArgument, agents: Agents = None, frame: str = "ego") -> Sights:
    """Which of some agents see which of the actors that any agent annotated.

    Args:
        dataset: the release.
        moment: token or record of a sample, or of a frame: then its first agent's sample is taken.
        agents: the agents that look, as `visible_instances` takes them; None for all that are there.
        frame: coordinate frame of the result, of the sample.

    Raises:
        TokenError: no such sample or frame.
        ChoiceError: no such agent, configuration or frame.
        NotAvailableError: an agent is not in this (partial) release.
    """
    sample = sample_at(dataset, moment)
    scenario, _, number = sample.rsplit("/", 2)
    looking = cooperating_agents(dataset, sample, agents)
    there = cooperative_boxes(dataset, sample, frame=frame)
    boxes = there.select(there.actor_id != UNTRACKED_ID)
    frame_from_world = dataset.world_from(sample, frame).inverse()
    shape = len(boxes), len(looking)
    seen, annotated = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    points, place = np.zeros(shape, dtype=np.int64), np.zeros((len(looking), 2))
    for column, agent in enumerate(looking):
        own = sample_token(scenario, agent, int(number))
        seen[:, column] = np.isin(boxes.actor_id, visible_actors(dataset, own, agents=[agent]))
        label, ids = dataset.boxes(own, "lidar"), dataset.actor_ids(own)
        ids = np.where(label.actor_id == OWN_ACTOR_ID, UNTRACKED_ID, ids)
        _, row, label_row = np.intersect1d(boxes.actor_id, ids, return_indices=True)
        annotated[row, column], points[row, column] = True, label.num_lidar_pts[label_row]
        place[column] = (frame_from_world @ dataset.world_from(own, "ego")).translation[:2]
    collision = dataset.get("scenario", scenario)["collision"]
    actors = (dataset.agent.get(f"{scenario}/{agent}")["actor_id"] for agent in looking)
    return Sights(
        sample=sample,
        agents=tuple(looking),
        boxes=boxes,
        place=place,
        actor=np.array([UNTRACKED_ID if actor is None else actor for actor in actors], dtype=np.int64),
        seen=seen,
        annotated=annotated,
        points=points,
        pair=frozenset() if collision is None else frozenset(collision["ids"]),
    )


def sample_at(dataset: Dataset, moment: RowArgument) -> str:
    """Token of a sample, or of a frame's first sample; raises TokenError if `moment` is neither."""
    token = str(moment["token"]) if isinstance(moment, Mapping) else moment
    if token.count("/") == _FRAME_SLASHES:
        first: str = dataset.samples_of(token)[0]["token"]
        return first
    sample: str = dataset.get("sample", token)["token"]
    return sample


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings(FrozenArrays):
    """The moments at which an agent annotated an actor from outside; arrays are read-only.

    Attributes:
        agent: name of the agent.
        index: (T,) int64, frame numbers from 1, ascending.
        points: (T,) int64, points of the agent's LiDAR in the box.
        camera: (T,) bool, whether a camera of the agent sees it.
        seen: (T,) bool, whether the agent counts as seeing it by the released rule (docs/released_code.md, Visibility
            and attributes).
    """

    agent: str
    index: IntArray
    points: IntArray
    camera: BoolArray
    seen: BoolArray

    @property
    def timestamp(self) -> FloatArray:
        """(T,) seconds since the scenario's first frame."""
        return as_floats((self.index - 1) * FRAME_PERIOD)


def sightings(dataset: Dataset, scenario: str, agent: str, actor_id: int) -> Sightings:
    """The moments at which an agent of a scenario (tokens) annotated an actor; its row of itself does not count."""
    rows: list[tuple[int, int, bool, bool]] = []
    for index in range(1, dataset.get("scenario", scenario)["num_frames"] + 1):
        sample = sample_token(scenario, agent, index)
        boxes = dataset.boxes(sample, "lidar")
        found = np.flatnonzero((dataset.actor_ids(sample) == actor_id) & (boxes.actor_id != OWN_ACTOR_ID))
        if len(found):
            row = int(found[0])
            seen = actor_id in visible_actors(dataset, sample, agents=[agent])
            rows.append((index, int(boxes.num_lidar_pts[row]), bool(boxes.camera_visible[row]), seen))
    table = np.array(rows, dtype=np.int64).reshape(-1, 4)
    return Sightings(
        agent=agent,
        index=table[:, 0],
        points=table[:, 1],
        camera=table[:, 2].astype(bool),
        seen=table[:, 3].astype(bool),
    )
