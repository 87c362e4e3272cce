"""What a set of agents observed in a recording: actors that they see, and themselves; nothing of the future.

A moment depends on the labels and the poses of that moment alone: speeds are those of its labels, since displacements
would need a moment after it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.tables.tokens import agent_token, sample_token
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, UNTRACKED_ID, AgentName
from deepaccident_devkit.v2x.cooperation import cooperative_view

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset, Visible
    from deepaccident_devkit.export.questions.windows import Window

Seen = Literal["released", "camera", "annotated"]
_VISIBLE: Final[dict[Seen, Visible | None]] = {"released": "released", "camera": "camera", "annotated": None}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenRows(FrozenArrays):
    """Actors at moments, one row for each of both; arrays are read-only.

    Attributes:
        boxes: R boxes, with CARLA's ids.
        speed: (R,) m/s over the ground, by the label; NaN if it does not say.
        seen_by: (R,) uint8, bit mask over `taxonomy.AGENTS`.
        moment: (R,) int64, index into the window's moments.
    """

    boxes: Boxes
    speed: FloatArray
    seen_by: AnyArray
    moment: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AgentPath(FrozenArrays):
    """An agent of the set over a window, in the ego frame of its present; arrays are read-only.

    Attributes:
        agent: its name.
        pose: (M, 3) x forward, y left, yaw of its ego frame: metres, radians.
        speed: (M,) m/s, by its label; NaN if it does not say.
        category: by its own row in the label of the present; None without one, as for the infrastructure.
        size: length, width, height, metres; likewise.
    """

    agent: AgentName
    pose: FloatArray
    speed: FloatArray
    category: str | None
    size: tuple[float, float, float] | None


class Observations:
    """What some agents observed of a scenario; each moment is read once, for all windows that have it.

    Attributes:
        dataset: the release.
        scenario: token.
        agents: the set, the ego first.
        own_ids: agent → its actor id; None for the infrastructure.
    """

    def __init__(self, dataset: Dataset, scenario: str, agents: tuple[AgentName, ...], seen: Seen) -> None:
        """Look at nothing yet."""
        self.dataset, self.scenario, self.agents, self._seen = dataset, scenario, agents, seen
        self.own_ids: dict[AgentName, int | None] = {
            agent: dataset.get("agent", agent_token(scenario, agent))["actor_id"] for agent in agents
        }
        self._moments: dict[int, tuple[Boxes, FloatArray, AnyArray]] = {}

    def is_labelled(self, window: Window) -> bool:
        """Whether each agent of the set has a label at each moment: without one it is not known what it saw."""
        labelled = self.dataset.columns("sample")["labelled"]
        return all(labelled[self._row(agent, frame)] for agent in self.agents for frame in window.frames)

    def seen(self, window: Window) -> SeenRows:
        """The actors that at least one agent sees, by moment, in the ego frame of the window's present.

        The agents of the set are not among them: `paths` has these.
        """
        moments = [self._moment(frame) for frame in window.frames]
        boxes = concatenate([each[0] for each in moments], "world")
        return SeenRows(
            boxes=boxes.transform(self._ego_from_world(window), "ego"),
            speed=np.concatenate([each[1] for each in moments]),
            seen_by=np.concatenate([each[2] for each in moments]),
            moment=np.repeat(np.arange(len(moments)), [len(each[0]) for each in moments]),
        )

    def paths(self, window: Window) -> list[AgentPath]:
        """Where the agents of the set were, the ego first."""
        return [self._path(agent, window) for agent in self.agents]

    def _path(self, agent: AgentName, window: Window) -> AgentPath:
        ego_from_world, rows = self._ego_from_world(window), [self._row(agent, frame) for frame in window.frames]
        poses = [ego_from_world @ self._world_from_agent(agent, frame) for frame in window.frames]
        labelled = self.dataset.boxes(sample_token(self.scenario, agent, window.present), "lidar")
        own = labelled.select(np.flatnonzero(labelled.actor_id == OWN_ACTOR_ID)[:1])
        return AgentPath(
            agent=agent,
            pose=np.array([[*pose.translation[:2], pose.yaw] for pose in poses]),
            speed=np.linalg.norm(self.dataset.columns("sample")["velocity"][rows], axis=1),
            category=own.category_names[0] if len(own) else None,
            size=tuple(own.size[0].tolist()) if len(own) else None,
        )

    def _moment(self, frame: int) -> tuple[Boxes, FloatArray, AnyArray]:
        """Boxes in world, speeds, and by whom they are seen."""
        if frame not in self._moments:
            ego = sample_token(self.scenario, self.agents[0], frame)
            view = cooperative_view(self.dataset, ego, agents=self.agents, frame="world", visible=_VISIBLE[self._seen])
            members = [OWN_ACTOR_ID, UNTRACKED_ID, *(each for each in self.own_ids.values() if each is not None)]
            kept = np.flatnonzero(~np.isin(view.boxes.actor_id, members))
            boxes, source = view.boxes.select(kept), view.source[kept]
            self._moments[frame] = boxes, self._speeds(frame, source, boxes.row), view.seen_by[kept]
        return self._moments[frame]

    def _speeds(self, frame: int, source: AnyArray, row: IntArray) -> FloatArray:
        """The speeds (N,) in rows of the labels of some agents."""
        first = np.zeros(len(AGENTS), dtype=np.int64)
        for agent in self.agents:
            rows = self.dataset.annotation_rows(sample_token(self.scenario, agent, frame))
            first[AGENTS.index(agent)] = rows.start
        said = self.dataset.columns("annotation")["velocity_label"]
        speed: FloatArray = np.linalg.norm(said[first[source] + row], axis=1)
        return speed

    def _ego_from_world(self, window: Window) -> SE3:
        return self._world_from_agent(self.agents[0], window.present).inverse()

    def _world_from_agent(self, agent: AgentName, frame: int) -> SE3:
        return self.dataset.world_from(sample_token(self.scenario, agent, frame), "ego")

    def _row(self, agent: AgentName, frame: int) -> int:
        return self.dataset.getind("sample", sample_token(self.scenario, agent, frame))
