"""Observations of agents in a window, under neutral names, as a question shows them.

They contain nothing from the future. A moment depends only on its own labels and poses: its speeds
come from the labels, since displacements would need a later moment.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

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
from deepaccident_devkit.support.values import ReadOnlyValues
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
"""Number of moments per second."""
# Tolerance of times, as a fraction of a step.
_STEP_TOLERANCE = 1e-6
SeenRule = Literal["released", "camera", "annotated"]
_VISIBLE: dict[SeenRule, Visible | None] = {
    "released": "released",
    "camera": "camera",
    "annotated": None,
}
_EGO = "ego"
Facts: TypeAlias = "dict[str, Any]"
"""Facts for JSON by their names."""
# Number of decimals of metres and of metres per second.
_METRE_DECIMALS = 2
_RADIAN_DECIMALS = 3
CONDITIONS: Final = ("weather", "time_of_day", "road_type")
"""Facts of the meta file that a question shows; the others hint at how the recording ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QuestionWindow:
    """The moments of one question, as numbers of recorded frames.

    Attributes:
        frames: Frame numbers in ascending order; the last one is the current frame (t = 0).
    """

    frames: tuple[int, ...]

    @property
    def present(self) -> int:
        """Number of the current frame, from which the question looks ahead."""
        return self.frames[-1]

    @property
    def times(self) -> list[float]:
        """Time of each moment in seconds relative to the current frame; the last one is 0.0."""
        times = []
        for frame in self.frames:
            seconds = (frame - self.present) * FRAME_PERIOD
            times.append(round(seconds, 1) + 0.0)
        return times


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowRules:
    """Rules that select the windows of a recording.

    The current frames of windows are counted back from the last frame, like the samples of
    evaluations. The last frame itself (the impact, in an accident) is never a current frame. The
    rule is the same for recordings with and without an accident.

    Attributes:
        observe: Number of seconds before the present that are shown, with two moments a second; 0
            for only the present. A multiple of 0.5.
        ahead: Whole number of seconds after the present that are asked about.
        stride: Number of seconds between windows of a recording, a multiple of 0.5.

    Raises:
        ConfigError: If a value is impossible.
    """

    observe: float = 5.0
    ahead: int = 3
    stride: float = 1.0

    def __post_init__(self) -> None:
        """Raise ConfigError if a value is impossible."""
        _check_steps("observe", self.observe, min_steps=0)
        _check_steps("stride", self.stride, min_steps=1)
        if checked_whole("ahead", self.ahead, "a whole number from 1", ConfigError) < 1:
            raise ConfigError(f"ahead: expected a whole number from 1, found {self.ahead!r}")

    def windows(self, last: int) -> list[QuestionWindow]:
        """Return the windows of a recording with frames 1 to `last`, in order of time."""
        stride = round(self.stride / FRAME_PERIOD)
        num_past_frames = round(self.observe / FRAME_PERIOD)
        windows = []
        for present in sorted(range(last - stride, num_past_frames, -stride)):
            frames = range(present - num_past_frames, present + 1, KEY_STEP)
            windows.append(QuestionWindow(frames=tuple(frames)))
        return windows


def compute_digest(seed: str, *words: str) -> str:
    """Return 16 hexadecimal digits that reveal nothing about the words without the seed."""
    key = hashlib.blake2b(seed.encode(), digest_size=32).digest()
    text = "\0".join(words)
    return hashlib.blake2b(text.encode(), key=key, digest_size=8).hexdigest()


def _check_steps(name: str, value: float, *, min_steps: int) -> None:
    """Raise ConfigError unless a time is a whole number of steps, and at least `min_steps`."""
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
    """Actors that are visible at moments, one row for each actor and moment; arrays are read-only.

    Attributes:
        boxes: R boxes, with CARLA's ids.
        speed: Speed over the ground, from the label, in m/s, shape (R,); NaN if unknown.
        seen_by: Bit mask over `taxonomy.AGENTS`, shape (R,) uint8.
        moment: Index of the moment in the window, shape (R,) int64.
    """

    boxes: Boxes
    speed: FloatArray
    seen_by: AnyArray
    moment: IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AgentPath(FrozenArrays):
    """The path of an observing agent in a window, in the ego frame at t = 0; read-only."""

    agent: AgentName
    pose: FloatArray
    speed: FloatArray
    category: str | None
    size: tuple[float, float, float] | None


class Observations:
    """Observations of a scenario by some agents; each moment is read once for all its windows.

    Attributes:
        dataset: The release.
        scenario: Token of the scenario.
        agents: Observing agents, the ego first.
        own_ids: Actor id of each agent, by agent; None for the infrastructure.
    """

    def __init__(
        self, dataset: Dataset, scenario: str, agents: tuple[AgentName, ...], seen: SeenRule
    ) -> None:
        """Prepare to read observations of a scenario, by the rule `seen`."""
        self.dataset = dataset
        self.scenario = scenario
        self.agents = agents
        self._visible = _VISIBLE[seen]
        self.own_ids: dict[AgentName, int | None] = {}
        for agent in agents:
            record = dataset.get("agent", agent_token(scenario, agent))
            self.own_ids[agent] = record["actor_id"]
        self._moments: dict[int, tuple[Boxes, FloatArray, AnyArray]] = {}

    def is_labelled(self, window: QuestionWindow) -> bool:
        """Return whether each observing agent has a label at each moment.

        If a label is missing, it is unknown what that agent saw.
        """
        labelled = self.dataset.columns("sample")["labelled"]
        for agent in self.agents:
            for frame in window.frames:
                if not labelled[self._find_row(agent, frame)]:
                    return False
        return True

    def collect_seen_rows(self, window: QuestionWindow) -> SeenRows:
        """Return the actors that at least one agent sees, moment by moment.

        Boxes are in the ego frame of the window's current frame. The observing agents are left out,
        since `collect_paths` returns them.
        """
        moments = list(map(self._read_moment, window.frames))
        all_boxes, speeds, seen_by = zip(*moments, strict=True)
        boxes = concatenate(list(all_boxes), "world")
        counts = list(map(len, all_boxes))
        ego_from_world = self._ego_from_world(window)
        return SeenRows(
            boxes=boxes.transform(ego_from_world, "ego"),
            speed=np.concatenate(speeds),
            seen_by=np.concatenate(seen_by),
            moment=np.repeat(np.arange(len(moments)), counts),
        )

    def collect_paths(self, window: QuestionWindow) -> list[AgentPath]:
        """Return the paths of the observing agents, the ego first."""
        return [self._read_path(agent, window) for agent in self.agents]

    def _read_path(self, agent: AgentName, window: QuestionWindow) -> AgentPath:
        """Return the path of an agent in a window."""
        ego_from_world = self._ego_from_world(window)
        rows = [self._find_row(agent, frame) for frame in window.frames]
        velocity = self.dataset.columns("sample")["velocity"][rows]
        poses = []
        for frame in window.frames:
            ego_from_agent = ego_from_world @ self._world_from_agent(agent, frame)
            poses.append([*ego_from_agent.translation[:2], ego_from_agent.yaw])
        boxes = self.dataset.boxes(sample_token(self.scenario, agent, window.present), "lidar")
        own_rows = np.flatnonzero(boxes.actor_id == OWN_ACTOR_ID).tolist()
        category = None
        size = None
        if own_rows:
            category = boxes.category_names[own_rows[0]]
            size = tuple(boxes.size[own_rows[0]].tolist())
        return AgentPath(
            agent=agent,
            pose=np.array(poses),
            speed=np.linalg.norm(velocity, axis=1),
            category=category,
            size=size,
        )

    def _read_moment(self, frame: int) -> tuple[Boxes, FloatArray, AnyArray]:
        """Return the boxes at a frame in the world frame, their speeds, and masks of observers."""
        if frame not in self._moments:
            ego = sample_token(self.scenario, self.agents[0], frame)
            view = cooperative_view(
                self.dataset, ego, agents=self.agents, frame="world", visible=self._visible
            )
            own_ids = [actor for actor in self.own_ids.values() if actor is not None]
            excluded_ids = [OWN_ACTOR_ID, UNTRACKED_ID, *own_ids]
            is_shown = ~np.isin(view.boxes.actor_id, excluded_ids)
            rows = np.flatnonzero(is_shown)
            boxes = view.boxes.select(rows)
            speeds = self._read_speeds(frame, view.source[rows], boxes.row)
            self._moments[frame] = boxes, speeds, view.seen_by[rows]
        return self._moments[frame]

    def _read_speeds(self, frame: int, source: AnyArray, row: IntArray) -> FloatArray:
        """Return the speeds, in m/s, shape (N,), of boxes in the agents' labels.

        Args:
            frame: Number of the frame.
            source: Index of the agent whose label contains each box, shape (N,).
            row: Row of each box in that label, shape (N,).
        """
        first_rows = np.zeros(len(AGENTS), dtype=np.int64)
        for agent in self.agents:
            rows = self.dataset.annotation_rows(sample_token(self.scenario, agent, frame))
            first_rows[AGENTS.index(agent)] = rows.start
        velocity = self.dataset.columns("annotation")["velocity_label"]
        speed: FloatArray = np.linalg.norm(velocity[first_rows[source] + row], axis=1)
        return speed

    def _ego_from_world(self, window: QuestionWindow) -> SE3:
        world_from_ego = self._world_from_agent(self.agents[0], window.present)
        return world_from_ego.inverse()

    def _world_from_agent(self, agent: AgentName, frame: int) -> SE3:
        sample = sample_token(self.scenario, agent, frame)
        return self.dataset.world_from(sample, "ego")

    def _find_row(self, agent: AgentName, frame: int) -> int:
        sample = sample_token(self.scenario, agent, frame)
        return self.dataset.getind("sample", sample)


@dataclass(frozen=True, slots=True, kw_only=True)
class Names:
    """Meaning of the neutral names in a question.

    Attributes:
        observers: Agent by name.
        actors: Actor id by name, including observers that have an id.
        last_seen: When an agent last observed each actor, in seconds relative to the current frame,
            by actor id.
    """

    observers: Mapping[str, AgentName]
    actors: Mapping[str, int]
    last_seen: Mapping[int, float]


def choose_names(
    seen: SeenRows,
    paths: Sequence[AgentPath],
    own_ids: Mapping[AgentName, int | None],
    times: Sequence[float],
) -> Names:
    """Name everything in a question, depending only on what is observed.

    Partners are numbered by their distance from the ego at t = 0. Actors are numbered by the moment
    at which they were first seen, then by their distance from the ego at that moment.

    Args:
        seen: Actors that are visible at moments.
        paths: Paths of the observing agents, the ego first.
        own_ids: Actor id of each agent, by agent; None for the infrastructure.
        times: Times of the moments, in seconds relative to the current frame.
    """
    ego_positions = paths[0].pose[:, :2]
    partners = [path for path in paths[1:] if path.agent != INFRASTRUCTURE]
    partners.sort(key=_distance_key)
    observers: dict[str, AgentName] = {_EGO: paths[0].agent}
    for number, path in enumerate(partners, start=1):
        observers[f"partner_{number}"] = path.agent
    if any(path.agent == INFRASTRUCTURE for path in paths[1:]):
        observers[INFRASTRUCTURE] = INFRASTRUCTURE
    ids = seen.boxes.actor_id
    position = seen.boxes.center[:, :2]
    distance = np.linalg.norm(position - ego_positions[seen.moment], axis=1)
    x, y = position.T
    order = np.lexsort((y, x, distance, seen.moment))
    actors: dict[str, int] = {}
    for name, agent in observers.items():
        own_id = own_ids[agent]
        if own_id is not None:
            actors[name] = own_id
    last_seen = {}
    for actor, moment in zip(ids.tolist(), seen.moment.tolist(), strict=True):
        last_seen[actor] = times[moment]
    last_seen |= dict.fromkeys(actors.values(), 0.0)
    for number, actor in enumerate(dict.fromkeys(ids[order].tolist()), start=1):
        actors[f"a{number}"] = actor
    return Names(observers=observers, actors=actors, last_seen=last_seen)


def _distance_key(path: AgentPath) -> tuple[float, ...]:
    """Return a key that sorts paths by their distance from the ego at t = 0."""
    pose = path.pose[-1]
    distance = float(np.linalg.norm(pose[:2]))
    return (distance, *pose.tolist())


def describe_window(
    seen: SeenRows,
    paths: Sequence[AgentPath],
    names: Names,
    window: QuestionWindow,
    scenario: ReadOnlyValues,
) -> Facts:
    """Describe a window as the content of a question, without id, seconds and pictures.

    Args:
        seen: Actors that are visible at moments.
        paths: Paths of the observing agents, the ego first.
        names: Names of agents and actors.
        window: Moments of the question.
        scenario: Record of the scenario; only its `CONDITIONS` are used.
    """
    path_by_agent = {path.agent: path for path in paths}
    observer_names = {}
    for bits in np.unique(seen.seen_by).tolist():
        observer_names[bits] = [
            name for name, agent in names.observers.items() if bits >> AGENTS.index(agent) & 1
        ]
    observers = []
    for name, agent in names.observers.items():
        observers.append(_describe_observer(name, path_by_agent[agent]))
    actors = []
    for name, actor in names.actors.items():
        if name not in names.observers:
            rows = np.flatnonzero(seen.boxes.actor_id == actor)
            actors.append(_describe_actor(name, rows, seen, window.times, observer_names))
    return {
        "moments": window.times,
        "conditions": {name: scenario[name] for name in CONDITIONS},
        "observers": observers,
        "actors": actors,
    }


def _describe_observer(name: str, path: AgentPath) -> Facts:
    size = None
    if path.size is not None:
        size = _round_values(np.array(path.size), _METRE_DECIMALS)
    return {
        "name": name,
        "kind": INFRASTRUCTURE if path.agent == INFRASTRUCTURE else "vehicle",
        "class": path.category,
        "size": size,
        "position": _round_values(path.pose[:, :2], _METRE_DECIMALS),
        "heading": _round_values(path.pose[:, 2], _RADIAN_DECIMALS),
        "speed": _replace_nan(path.speed),
    }


def _describe_actor(
    name: str,
    rows: IntArray,
    seen: SeenRows,
    times: Sequence[float],
    observer_names: Mapping[int, list[str]],
) -> Facts:
    """Describe an actor at each moment at which it was seen, with its last known class and size.

    Args:
        name: Name of the actor.
        rows: Rows of the actor in `seen`, shape (n,).
        seen: Actors that are visible at moments.
        times: Times of the moments, in seconds relative to the current frame.
        observer_names: Names of the agents in each bit mask, by bit mask.
    """
    boxes = seen.boxes
    last_row = rows[-1]
    return {
        "name": name,
        "class": boxes.category_names[last_row],
        "size": _round_values(boxes.size[last_row], _METRE_DECIMALS),
        "time": [times[moment] for moment in seen.moment[rows].tolist()],
        "position": _round_values(boxes.center[rows, :2], _METRE_DECIMALS),
        "heading": _round_values(boxes.yaw[rows], _RADIAN_DECIMALS),
        "speed": _replace_nan(seen.speed[rows]),
        "seen_by": [observer_names[bits] for bits in seen.seen_by[rows].tolist()],
    }


def _round_values(values: FloatArray, decimals: int) -> Any:
    """Round values, and return them as nested lists in which zero has no minus sign."""
    return (np.round(values, decimals) + 0.0).tolist()


def _replace_nan(values: FloatArray) -> list[float | None]:
    """Round values, and return them as a list with None instead of NaN."""
    numbers = _round_values(values, _METRE_DECIMALS)
    return [None if math.isnan(number) else number for number in numbers]
