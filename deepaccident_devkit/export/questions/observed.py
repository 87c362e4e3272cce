"""Observations of agents in a window, under neutral names, as a question shows them.

They contain nothing of the future. A moment depends only on its own labels and poses: speeds are
taken from its labels, since displacements would need a later moment.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.frames import KEY_STEP
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.support.arrays import (
    AnyArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked_number,
    checked_whole,
)
from deepaccident_devkit.tables.tokens import agent_token, sample_token
from deepaccident_devkit.taxonomy import (
    AGENTS,
    FRAME_PERIOD,
    INFRASTRUCTURE,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
    AgentName,
)
from deepaccident_devkit.v2x.cooperation import cooperative_view

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset, Visible

# Seconds between moments of a window.
_STEP_S = KEY_STEP * FRAME_PERIOD
RATE: Final = round(1 / _STEP_S)
"""Number of moments a second."""
# Tolerance of seconds in steps.
_STEP_TOLERANCE = 1e-6
SeenRule = Literal["released", "camera", "annotated"]
_VISIBLE: Final[dict[SeenRule, Visible | None]] = {
    "released": "released",
    "camera": "camera",
    "annotated": None,
}
_EGO: Final = "ego"
# Number of decimals of metres and metres a second, and of radians.
_METRE_DECIMALS: Final = 2
_RADIAN_DECIMALS: Final = 3
CONDITIONS: Final = ("weather", "time_of_day", "road_type")
"""Facts of the meta file in a question; other facts reveal, or hint at, how the recording ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QuestionWindow:
    """The moments of one question, as numbers of recorded frames.

    Attributes:
        frames: Numbers of frames, ascending; the last one is the present.
    """

    frames: tuple[int, ...]

    @property
    def present(self) -> int:
        """The frame from which the question looks ahead."""
        return self.frames[-1]

    @property
    def times(self) -> list[float]:
        """Seconds of each moment relative to the present, from the earliest to 0.0."""
        return [round((frame - self.present) * FRAME_PERIOD, 1) + 0.0 for frame in self.frames]


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowRules:
    """Rules that select the windows of a recording.

    Presents are counted back from the last frame, like the samples of evaluations; the last frame
    itself, which in an accident is the impact, is no present. The rule is the same for recordings
    with and without an accident.

    Attributes:
        observe: Seconds before the present that are shown, two moments a second; 0 for only the
            present. A multiple of 0.5.
        ahead: Whole seconds after the present that are asked about.
        stride: Seconds between windows of a recording, a multiple of 0.5.

    Raises:
        ConfigError: an impossible value.
    """

    observe: float = 5.0
    ahead: int = 3
    stride: float = 1.0

    def __post_init__(self) -> None:
        """Check the values."""
        _check_steps("observe", self.observe, min_steps=0)
        _check_steps("stride", self.stride, min_steps=1)
        if checked_whole("ahead", self.ahead, "a whole number from 1", ConfigError) < 1:
            raise ConfigError(f"ahead: expected a whole number from 1, found {self.ahead!r}")

    def windows(self, last: int) -> list[QuestionWindow]:
        """Return the windows of a recording of frames 1 to `last`, in the order of time."""
        stride, past = round(self.stride / FRAME_PERIOD), round(self.observe / FRAME_PERIOD)
        windows = []
        for present in sorted(range(last - stride, past, -stride)):
            frames = range(present - past, present + 1, KEY_STEP)
            windows.append(QuestionWindow(frames=tuple(frames)))
        return windows


def digest(seed: str, *words: str) -> str:
    """Return sixteen hexadecimal digits, which reveal nothing about the words without the seed."""
    key = hashlib.blake2b(seed.encode(), digest_size=32).digest()
    return hashlib.blake2b("\0".join(words).encode(), key=key, digest_size=8).hexdigest()


def _check_steps(name: str, value: float, *, min_steps: int) -> None:
    """Raise ConfigError unless seconds are a whole number of steps, and at least a minimum."""
    seconds = checked_number(name, value, "a number of seconds", ConfigError)
    steps = seconds / _STEP_S
    is_enough = math.isfinite(steps) and steps >= min_steps - _STEP_TOLERANCE
    if not is_enough or abs(steps - round(steps)) > _STEP_TOLERANCE:
        raise ConfigError(
            f"{name}: expected seconds from {min_steps * _STEP_S:g} in steps of {_STEP_S:g}, found "
            f"{value!r}"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenRows(FrozenArrays):
    """Visible actors at moments, one row for each pair of both; arrays are read-only.

    Attributes:
        boxes: R boxes, with CARLA's ids.
        speed: Speed over the ground by the label in m/s, shape (R,); NaN if unknown.
        seen_by: Bit mask over `taxonomy.AGENTS`, shape (R,) uint8.
        moment: Index of the window's moment, shape (R,) int64.
    """

    boxes: Boxes
    speed: FloatArray
    seen_by: AnyArray
    moment: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AgentPath(FrozenArrays):
    """An agent of the set over a window, in the ego frame of its present; arrays are read-only.

    Attributes:
        agent: Name of the agent.
        pose: x forward, y left, yaw of its ego frame in metres and radians, shape (M, 3).
        speed: Speed by its label in m/s, shape (M,); NaN if unknown.
        category: Class of its own row in the label of the present; None without one, as for the
            infrastructure.
        size: Length, width, height in metres; likewise.
    """

    agent: AgentName
    pose: FloatArray
    speed: FloatArray
    category: str | None
    size: tuple[float, float, float] | None


class Observations:
    """Observations of a scenario by some agents; each moment is read once, for all its windows.

    Attributes:
        dataset: The release.
        scenario: Token of the scenario.
        agents: The set of agents, the ego first.
        own_ids: Agent → its actor id; None for the infrastructure.
    """

    def __init__(
        self, dataset: Dataset, scenario: str, agents: tuple[AgentName, ...], seen: SeenRule
    ) -> None:
        """Store the arguments; nothing is read yet."""
        self.dataset, self.scenario, self.agents, self._seen = dataset, scenario, agents, seen
        self.own_ids: dict[AgentName, int | None] = {
            agent: dataset.get("agent", agent_token(scenario, agent))["actor_id"]
            for agent in agents
        }
        self._moments: dict[int, tuple[Boxes, FloatArray, AnyArray]] = {}

    def is_labelled(self, window: QuestionWindow) -> bool:
        """Return whether each agent of the set has a label at each moment.

        Without a label it is unknown what an agent saw.
        """
        labelled = self.dataset.columns("sample")["labelled"]
        for agent in self.agents:
            for frame in window.frames:
                if not labelled[self._row(agent, frame)]:
                    return False
        return True

    def seen_rows(self, window: QuestionWindow) -> SeenRows:
        """Return the actors that at least one agent sees, by moment.

        Boxes are in the ego frame of the window's present. The agents of the set are left out:
        `paths` has them.
        """
        moments = list(map(self._moment, window.frames))
        all_boxes = [boxes for boxes, _, _ in moments]
        boxes = concatenate(all_boxes, "world")
        return SeenRows(
            boxes=boxes.transform(self._ego_from_world(window), "ego"),
            speed=np.concatenate([speed for _, speed, _ in moments]),
            seen_by=np.concatenate([seen_by for _, _, seen_by in moments]),
            moment=np.repeat(np.arange(len(moments)), list(map(len, all_boxes))),
        )

    def paths(self, window: QuestionWindow) -> list[AgentPath]:
        """Return the paths of the agents of the set, the ego first."""
        return [self._path(agent, window) for agent in self.agents]

    def _path(self, agent: AgentName, window: QuestionWindow) -> AgentPath:
        """Return the path of an agent."""
        ego_from_world = self._ego_from_world(window)
        rows = [self._row(agent, frame) for frame in window.frames]
        poses = [ego_from_world @ self._world_from_agent(agent, frame) for frame in window.frames]
        labelled = self.dataset.boxes(sample_token(self.scenario, agent, window.present), "lidar")
        own_rows = np.flatnonzero(labelled.actor_id == OWN_ACTOR_ID)
        own_box = labelled.select(own_rows[:1])
        return AgentPath(
            agent=agent,
            pose=np.array([[*pose.translation[:2], pose.yaw] for pose in poses]),
            speed=np.linalg.norm(self.dataset.columns("sample")["velocity"][rows], axis=1),
            category=own_box.category_names[0] if len(own_box) else None,
            size=tuple(own_box.size[0].tolist()) if len(own_box) else None,
        )

    def _moment(self, frame: int) -> tuple[Boxes, FloatArray, AnyArray]:
        """Return boxes in the world frame, their speeds, and bit masks of their observers."""
        if frame not in self._moments:
            ego = sample_token(self.scenario, self.agents[0], frame)
            view = cooperative_view(
                self.dataset, ego, agents=self.agents, frame="world", visible=_VISIBLE[self._seen]
            )
            own_ids = [actor for actor in self.own_ids.values() if actor is not None]
            is_own = np.isin(view.boxes.actor_id, [OWN_ACTOR_ID, UNTRACKED_ID, *own_ids])
            rows = np.flatnonzero(~is_own)
            boxes = view.boxes.select(rows)
            speeds = self._speeds(frame, view.source[rows], boxes.row)
            self._moments[frame] = boxes, speeds, view.seen_by[rows]
        return self._moments[frame]

    def _speeds(self, frame: int, source: AnyArray, row: IntArray) -> FloatArray:
        """Return the speeds (N,) in rows of the agents' labels, in m/s.

        Args:
            frame: Number of the frame.
            source: Index of the agent with the label, shape (N,).
            row: Row in the label, shape (N,).
        """
        first = np.zeros(len(AGENTS), dtype=np.int64)
        for agent in self.agents:
            rows = self.dataset.annotation_rows(sample_token(self.scenario, agent, frame))
            first[AGENTS.index(agent)] = rows.start
        velocity = self.dataset.columns("annotation")["velocity_label"]
        speed: FloatArray = np.linalg.norm(velocity[first[source] + row], axis=1)
        return speed

    def _ego_from_world(self, window: QuestionWindow) -> SE3:
        return self._world_from_agent(self.agents[0], window.present).inverse()

    def _world_from_agent(self, agent: AgentName, frame: int) -> SE3:
        return self.dataset.world_from(sample_token(self.scenario, agent, frame), "ego")

    def _row(self, agent: AgentName, frame: int) -> int:
        return self.dataset.getind("sample", sample_token(self.scenario, agent, frame))


@dataclass(frozen=True, slots=True, kw_only=True)
class Names:
    """Meaning of the neutral names of a question.

    Attributes:
        observers: Name → agent.
        actors: Name → actor id, including observers that have one.
        last_seen: Actor id → seconds relative to the present at which the set last observed it.
    """

    observers: Mapping[str, AgentName]
    actors: Mapping[str, int]
    last_seen: Mapping[int, float]

    def of_actor(self, actor: int) -> str | None:
        """Return the name of an actor; None if the question does not show it."""
        for name, named_actor in self.actors.items():
            if named_actor == actor:
                return name
        return None


def names_of(
    seen: SeenRows,
    paths: Sequence[AgentPath],
    own_ids: Mapping[AgentName, int | None],
    times: Sequence[float],
) -> Names:
    """Name everything in a question; only observations decide the names.

    The partners have numbers by their distance from the ego at the present. The actors have numbers
    by the moment at which they were first seen, then by their distance from the ego at that moment.
    """
    ego = paths[0].pose
    partners = [path for path in paths[1:] if path.agent != INFRASTRUCTURE]
    partners.sort(key=_distance_key)
    observers: dict[str, AgentName] = {_EGO: paths[0].agent}
    for number, path in enumerate(partners, start=1):
        observers[f"partner_{number}"] = path.agent
    if any(path.agent == INFRASTRUCTURE for path in paths[1:]):
        observers[INFRASTRUCTURE] = INFRASTRUCTURE
    ids = seen.boxes.actor_id
    position = seen.boxes.center[:, :2]
    distance = np.linalg.norm(position - ego[seen.moment, :2], axis=1)
    order = np.lexsort((position[:, 1], position[:, 0], distance, seen.moment))
    actors: dict[str, int] = {}
    for name, agent in observers.items():
        own_id = own_ids[agent]
        if own_id is not None:
            actors[name] = own_id
    last_seen = dict(
        zip(ids.tolist(), [times[moment] for moment in seen.moment.tolist()], strict=True)
    )
    last_seen |= dict.fromkeys(actors.values(), 0.0)
    for number, actor in enumerate(dict.fromkeys(ids[order].tolist()), start=1):
        actors[f"a{number}"] = actor
    return Names(observers=observers, actors=actors, last_seen=last_seen)


def _distance_key(path: AgentPath) -> tuple[float, ...]:
    """Return a key that sorts paths by their distance from the ego at the present."""
    pose = path.pose[-1]
    return (float(np.linalg.norm(pose[:2])), *pose.tolist())


def question_facts(
    seen: SeenRows,
    paths: Sequence[AgentPath],
    names: Names,
    window: QuestionWindow,
    scenario: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of a question, except its id, its seconds, and pictures.

    Only `CONDITIONS` of the scenario are used.
    """
    path_of_agent = {path.agent: path for path in paths}
    name_of_agent = {agent: name for name, agent in names.observers.items()}
    observer_names = {}
    for bits in np.unique(seen.seen_by).tolist():
        observer_names[bits] = [name_of_agent[agent] for agent in _agents_in(bits, name_of_agent)]
    observers = []
    for name, agent in names.observers.items():
        observers.append(_observer(name, path_of_agent[agent]))
    actors = []
    for name, actor in names.actors.items():
        if name not in names.observers:
            rows = np.flatnonzero(seen.boxes.actor_id == actor)
            actors.append(_actor(name, rows, seen, window.times, observer_names))
    return {
        "moments": window.times,
        "conditions": {name: scenario[name] for name in CONDITIONS},
        "observers": observers,
        "actors": actors,
    }


def _agents_in(bits: int, names: Mapping[AgentName, str]) -> list[AgentName]:
    """Return the agents of a bit mask, in the order of their names in the question."""
    return [agent for agent in names if bits >> AGENTS.index(agent) & 1]


def _observer(name: str, path: AgentPath) -> dict[str, Any]:
    size = None if path.size is None else _rounded(np.array(path.size), _METRE_DECIMALS)
    return {
        "name": name,
        "kind": INFRASTRUCTURE if path.agent == INFRASTRUCTURE else "vehicle",
        "class": path.category,
        "size": size,
        "position": _rounded(path.pose[:, :2], _METRE_DECIMALS),
        "heading": _rounded(path.pose[:, 2], _RADIAN_DECIMALS),
        "speed": _nan_as_none(path.speed),
    }


def _actor(
    name: str,
    rows: IntArray,
    seen: SeenRows,
    times: Sequence[float],
    observer_names: Mapping[int, list[str]],
) -> dict[str, Any]:
    """Return an actor at the moments at which it was seen, with its last class and size.

    Args:
        name: Name of the actor.
        rows: Rows of the actor, shape (n,).
        seen: Actors at moments.
        times: Seconds of the moments.
        observer_names: Bit mask of agents → their names.
    """
    boxes = seen.boxes
    return {
        "name": name,
        "class": boxes.category_names[rows[-1]],
        "size": _rounded(boxes.size[rows[-1]], _METRE_DECIMALS),
        "time": [times[moment] for moment in seen.moment[rows].tolist()],
        "position": _rounded(boxes.center[rows, :2], _METRE_DECIMALS),
        "heading": _rounded(boxes.yaw[rows], _RADIAN_DECIMALS),
        "speed": _nan_as_none(seen.speed[rows]),
        "seen_by": [observer_names[bits] for bits in seen.seen_by[rows].tolist()],
    }


def _rounded(values: FloatArray, decimals: int) -> Any:
    """Return lists of numbers without a sign on zero."""
    return (np.round(values, decimals) + 0.0).tolist()


def _nan_as_none(values: FloatArray) -> list[float | None]:
    """Return rounded numbers, with None for NaN."""
    numbers = _rounded(values, _METRE_DECIMALS)
    return [None if math.isnan(number) else number for number in numbers]
