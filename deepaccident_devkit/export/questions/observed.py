"""What a question shows of a window: what some agents observed, under neutral names, and nothing of the future.

A moment depends on the labels and the poses of that moment alone: speeds are those of its labels, since displacements
would need a moment after it.
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

# Seconds from one moment of a window to the next.
_STEP = KEY_STEP * FRAME_PERIOD
RATE: Final = round(1 / _STEP)
"""Moments a second."""
_SAME = 1e-6
SeenRule = Literal["released", "camera", "annotated"]
_VISIBLE: Final[dict[SeenRule, Visible | None]] = {
    "released": "released",
    "camera": "camera",
    "annotated": None,
}
_EGO: Final = "ego"
_PLACES: Final = 2
# Decimals of metres and metres a second, and of radians.
_ANGLES: Final = 3
CONDITIONS: Final = ("weather", "time_of_day", "road_type")
"""Facts of the meta file that stand in a question: the others say, or hint at, how the recording ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class QuestionWindow:
    """The moments of one question, as numbers of recorded frames.

    Attributes:
        frames: ascending; the last one is the present.
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
    """Which windows a recording has.

    Presents are counted back from the last frame, as the samples of evaluations are; the last frame itself, which in an
    accident is the impact, is none. The rule is the same for recordings with and without an accident.

    Attributes:
        observe: seconds before the present that are shown, two moments a second; 0 for the present alone. A multiple of
            0.5.
        ahead: whole seconds after the present that are asked about.
        stride: seconds from one window of a recording to the next, a multiple of 0.5.

    Raises:
        ConfigError: a value that this cannot be.
    """

    observe: float = 5.0
    ahead: int = 3
    stride: float = 1.0

    def __post_init__(self) -> None:
        """Check the values."""
        _check_steps("observe", self.observe, least=0)
        _check_steps("stride", self.stride, least=1)
        if checked_whole("ahead", self.ahead, "a whole number from 1", ConfigError) < 1:
            raise ConfigError(f"ahead: expected a whole number from 1, found {self.ahead!r}")

    def windows(self, last: int) -> list[QuestionWindow]:
        """The windows of a recording of frames 1 to `last`, in the order of time."""
        stride, past = round(self.stride / FRAME_PERIOD), round(self.observe / FRAME_PERIOD)
        presents = sorted(range(last - stride, past, -stride))
        return [
            QuestionWindow(frames=tuple(range(present - past, present + 1, KEY_STEP)))
            for present in presents
        ]


def digest(seed: str, *words: str) -> str:
    """Sixteen hexadecimal digits for some words, which tell nothing about these without the seed."""
    key = hashlib.blake2b(seed.encode(), digest_size=32).digest()
    return hashlib.blake2b("\0".join(words).encode(), key=key, digest_size=8).hexdigest()


def _check_steps(name: str, value: float, *, least: int) -> None:
    seconds = checked_number(name, value, "a number of seconds", ConfigError)
    steps = seconds / _STEP
    if not math.isfinite(steps) or steps < least - _SAME or abs(steps - round(steps)) > _SAME:
        raise ConfigError(
            f"{name}: expected seconds from {least * _STEP:g} in steps of {_STEP:g}, found {value!r}"
        )


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

    def __init__(
        self, dataset: Dataset, scenario: str, agents: tuple[AgentName, ...], seen: SeenRule
    ) -> None:
        """Look at nothing yet."""
        self.dataset, self.scenario, self.agents, self._seen = dataset, scenario, agents, seen
        self.own_ids: dict[AgentName, int | None] = {
            agent: dataset.get("agent", agent_token(scenario, agent))["actor_id"]
            for agent in agents
        }
        self._moments: dict[int, tuple[Boxes, FloatArray, AnyArray]] = {}

    def is_labelled(self, window: QuestionWindow) -> bool:
        """Whether each agent of the set has a label at each moment: without one it is not known what it saw."""
        labelled = self.dataset.columns("sample")["labelled"]
        return all(
            labelled[self._row(agent, frame)] for agent in self.agents for frame in window.frames
        )

    def seen(self, window: QuestionWindow) -> SeenRows:
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

    def paths(self, window: QuestionWindow) -> list[AgentPath]:
        """Where the agents of the set were, the ego first."""
        return [self._path(agent, window) for agent in self.agents]

    def _path(self, agent: AgentName, window: QuestionWindow) -> AgentPath:
        ego_from_world, rows = (
            self._ego_from_world(window),
            [self._row(agent, frame) for frame in window.frames],
        )
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
            view = cooperative_view(
                self.dataset, ego, agents=self.agents, frame="world", visible=_VISIBLE[self._seen]
            )
            members = [
                OWN_ACTOR_ID,
                UNTRACKED_ID,
                *(each for each in self.own_ids.values() if each is not None),
            ]
            kept = np.flatnonzero(~np.isin(view.boxes.actor_id, members))
            boxes, source = view.boxes.select(kept), view.source[kept]
            self._moments[frame] = boxes, self._speeds(frame, source, boxes.row), view.seen_by[kept]
        return self._moments[frame]

    def _speeds(self, frame: int, source: AnyArray, row: IntArray) -> FloatArray:
        """The speeds (N,) in rows of the labels of some agents."""
        first = np.zeros(len(AGENTS), dtype=np.int64)
        for agent in self.agents:
            first[AGENTS.index(agent)] = self.dataset.annotation_rows(
                sample_token(self.scenario, agent, frame)
            ).start
        said = self.dataset.columns("annotation")["velocity_label"]
        speed: FloatArray = np.linalg.norm(said[first[source] + row], axis=1)
        return speed

    def _ego_from_world(self, window: QuestionWindow) -> SE3:
        return self._world_from_agent(self.agents[0], window.present).inverse()

    def _world_from_agent(self, agent: AgentName, frame: int) -> SE3:
        return self.dataset.world_from(sample_token(self.scenario, agent, frame), "ego")

    def _row(self, agent: AgentName, frame: int) -> int:
        return self.dataset.getind("sample", sample_token(self.scenario, agent, frame))


@dataclass(frozen=True, slots=True, kw_only=True)
class Names:
    """Whom the neutral names of a question mean.

    Attributes:
        observers: name → agent.
        actors: name → actor id, observers that have one among them.
        last_seen: actor id → seconds relative to the present at which the set last observed it.
    """

    observers: Mapping[str, AgentName]
    actors: Mapping[str, int]
    last_seen: Mapping[int, float]

    def of_actor(self, actor: int) -> str | None:
        """The name of an actor; None if the question does not show it."""
        return next((name for name, each in self.actors.items() if each == actor), None)


def names_of(
    seen: SeenRows,
    paths: Sequence[AgentPath],
    own_ids: Mapping[AgentName, int | None],
    times: Sequence[float],
) -> Names:
    """Name those that a question shows: nothing but what was observed decides the names.

    The partners have numbers by their distance from the ego at the present. The actors have numbers by the moment at
    which they were first seen, then by their distance from the ego at that moment.
    """
    ego = paths[0].pose
    partners = sorted(
        (path for path in paths[1:] if path.agent != INFRASTRUCTURE),
        key=lambda path: (float(np.linalg.norm(path.pose[-1, :2])), *path.pose[-1].tolist()),
    )
    observers: dict[str, AgentName] = {_EGO: paths[0].agent}
    observers |= {f"partner_{number}": path.agent for number, path in enumerate(partners, start=1)}
    if any(path.agent == INFRASTRUCTURE for path in paths[1:]):
        observers[INFRASTRUCTURE] = INFRASTRUCTURE
    ids = seen.boxes.actor_id
    place = seen.boxes.center[:, :2]
    apart = np.linalg.norm(place - ego[seen.moment, :2], axis=1)
    order = np.lexsort((place[:, 1], place[:, 0], apart, seen.moment))
    first_seen = dict.fromkeys(ids[order].tolist())
    named = {f"a{number}": actor for number, actor in enumerate(first_seen, start=1)}
    members = {name: own_ids[agent] for name, agent in observers.items()}
    own = {name: actor for name, actor in members.items() if actor is not None}
    last = {
        actor: times[moment]
        for actor, moment in zip(ids.tolist(), seen.moment.tolist(), strict=True)
    }
    return Names(
        observers=observers,
        actors={**own, **named},
        last_seen={**last, **dict.fromkeys(own.values(), 0.0)},
    )


def question_facts(
    seen: SeenRows,
    paths: Sequence[AgentPath],
    names: Names,
    window: QuestionWindow,
    scenario: Mapping[str, Any],
) -> dict[str, Any]:
    """What a question says, but its id, what it asks, and pictures; of a scenario only `CONDITIONS` are taken."""
    of_agent = {path.agent: path for path in paths}
    of_name = {agent: name for name, agent in names.observers.items()}
    sets = {
        bits: [of_name[agent] for agent in _agents_in(bits, of_name)]
        for bits in np.unique(seen.seen_by).tolist()
    }
    members = set(names.observers)
    return {
        "moments": window.times,
        "conditions": {name: scenario[name] for name in CONDITIONS},
        "observers": [_observer(name, of_agent[agent]) for name, agent in names.observers.items()],
        "actors": [
            _actor(name, np.flatnonzero(seen.boxes.actor_id == actor), seen, window.times, sets)
            for name, actor in names.actors.items()
            if name not in members
        ],
    }


def _agents_in(bits: int, of_name: Mapping[AgentName, str]) -> list[AgentName]:
    """The agents of a bit mask, in the order of their names in the question."""
    return [agent for agent in of_name if bits >> AGENTS.index(agent) & 1]


def _observer(name: str, path: AgentPath) -> dict[str, Any]:
    return {
        "name": name,
        "kind": INFRASTRUCTURE if path.agent == INFRASTRUCTURE else "vehicle",
        "class": path.category,
        "size": None if path.size is None else _rounded(np.array(path.size), _PLACES),
        "position": _rounded(path.pose[:, :2], _PLACES),
        "heading": _rounded(path.pose[:, 2], _ANGLES),
        "speed": _known(path.speed),
    }


def _actor(
    name: str, rows: IntArray, seen: SeenRows, times: Sequence[float], sets: Mapping[int, list[str]]
) -> dict[str, Any]:
    """An actor at the moments at which it was seen; class and size are those of the last one."""
    boxes = seen.boxes
    return {
        "name": name,
        "class": boxes.category_names[rows[-1]],
        "size": _rounded(boxes.size[rows[-1]], _PLACES),
        "time": [times[moment] for moment in seen.moment[rows].tolist()],
        "position": _rounded(boxes.center[rows, :2], _PLACES),
        "heading": _rounded(boxes.yaw[rows], _ANGLES),
        "speed": _known(seen.speed[rows]),
        "seen_by": [sets[bits] for bits in seen.seen_by[rows].tolist()],
    }


def _rounded(values: FloatArray, decimals: int) -> Any:
    """Lists of numbers without a sign on zero."""
    return (np.round(values, decimals) + 0.0).tolist()


def _known(values: FloatArray) -> list[float | None]:
    """Numbers, None in place of NaN."""
    return [None if value != value else value for value in _rounded(values, _PLACES)]  # noqa: PLR0124 - NaN
