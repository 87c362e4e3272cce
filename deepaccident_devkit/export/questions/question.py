"""The JSON of a question: what was observed, under neutral names; and whom these names mean, for the truth alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, IntArray
from deepaccident_devkit.export.questions.observed import AgentPath, SeenRows
from deepaccident_devkit.export.questions.windows import Window
from deepaccident_devkit.taxonomy import AGENTS, INFRASTRUCTURE, AgentName

EGO: Final = "ego"
_PLACES: Final = 2
_ANGLES: Final = 3
"""Decimals of metres and metres a second, and of radians."""
CONDITIONS: Final = ("weather", "time_of_day", "road_type")
"""Facts of the meta file that stand in a question: the others say, or hint at, how the recording ends."""


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
    seen: SeenRows, paths: Sequence[AgentPath], own_ids: Mapping[AgentName, int | None], times: Sequence[float]
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
    observers: dict[str, AgentName] = {EGO: paths[0].agent}
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
    last = {actor: times[moment] for actor, moment in zip(ids.tolist(), seen.moment.tolist(), strict=True)}
    return Names(observers=observers, actors={**own, **named}, last_seen={**last, **dict.fromkeys(own.values(), 0.0)})


def question_facts(
    seen: SeenRows, paths: Sequence[AgentPath], names: Names, window: Window, scenario: Mapping[str, Any]
) -> dict[str, Any]:
    """What a question says, but its id, what it asks, and pictures.

    Args:
        seen: the actors.
        paths: of the agents.
        names: of all of them.
        window: the moments.
        scenario: its record, of which only `CONDITIONS` are taken.
    """
    of_agent = {path.agent: path for path in paths}
    of_name = {agent: name for name, agent in names.observers.items()}
    sets = {bits: [of_name[agent] for agent in _agents_in(bits, of_name)] for bits in np.unique(seen.seen_by).tolist()}
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
