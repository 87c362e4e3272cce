"""`describe`: what happens in a scenario, as facts and as two or three sentences."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, ShortRepr
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.safety.accidents import Accident, Skipped, accident_of, agents_by_actor
from deepaccident_devkit.safety.avoidability import BRAKERS, Avoidability, avoidability
from deepaccident_devkit.safety.observation import observed_actors
from deepaccident_devkit.safety.scenarios import each_scenario, tried
from deepaccident_devkit.safety.story_text import story_text
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.collisions import Contact, collision
from deepaccident_devkit.v2x.configurations import agents_of

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from deepaccident_devkit.tables.records import ScenarioRecord

DECELERATION: Final = 6.0
"""m/s² of the braking that a story tells of: the middle one of `BRAKINGS`."""
_EGO: Final = "ego_vehicle"
_TURNS: Final = {_EGO: "ego_direction", "other_vehicle": "other_direction"}
"""Agent → the column of the scenario table that tells its way."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Story(ShortRepr):
    """A scenario in words.

    Attributes:
        facts: as JSON holds them (docs/safety.md lists them); None for what is not known.
        text: English sentences of which each clause tells one of the facts.
    """

    facts: Mapping[str, Any]
    text: str

    def __str__(self) -> str:
        """The text."""
        return self.text

    def to_json(self) -> str:
        """Facts and text as one JSON object."""
        return json.dumps({**self.facts, "text": self.text}, indent=2, allow_nan=False)


def describe(dataset: Dataset, scenario: RowArgument) -> Story:
    """Tell a scenario: who collides, how fast, who saw it before, and what would have avoided it.

    All of it is computed from labels and meta. What these do not tell is missing in the text and None in the facts,
    and `facts["unknown"]` says why.

    Args:
        dataset: the release.
        scenario: token or record.

    Raises:
        TokenError: no such scenario.

    Examples:
        >>> print(da.describe(da.find(collision=True)[0]).text)  # doctest: +SKIP
    """
    facts = scenario_facts(dataset, scenario)
    return Story(facts=facts, text=story_text(facts))


def stories(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> tuple[Story, ...]:
    """The stories of scenarios, in the order of the release.

    Args:
        dataset: the release.
        scenarios: tokens or records; None for all.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        TokenError: no such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    how: dict[str, Any] = {"workers": workers, "executor": executor, "progress": progress}
    return each_scenario(describe, dataset, scenarios, label="stories", at_once=1, **how).results


def scenario_facts(
    dataset: Dataset, scenario: RowArgument, replayed: Avoidability | Skipped | None = None
) -> dict[str, Any]:
    """The facts of `describe`; errors as there.

    Args:
        dataset: the release.
        scenario: token or record.
        replayed: what `avoidability` gives for it, or why that gives nothing, where it is known; None to compute it.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    unknown: list[str] = []
    collides = None if record["weather"] is None else record["collision"] is not None
    if collides is None:
        unknown.append(f"{record['token']} has no meta file, which says whether two collide; unpack meta")
    return {
        "scenario": record["token"],
        **{name: record[name] for name in ("town", "road_type", "signalized", "weather", "time_of_day")},
        "duration": round((record["num_frames"] - 1) * FRAME_PERIOD, 1),
        "collision": collides,
        "accident": _accident(dataset, record, unknown, replayed) if collides else None,
        "nearest": None if collides else _nearest(dataset, record, unknown),
        "unknown": unknown,
    }


def _accident(
    dataset: Dataset, record: ScenarioRecord, unknown: list[str], replayed: Avoidability | Skipped | None
) -> dict[str, Any] | None:
    """Who collides, how, who saw it, and what would have avoided it."""
    try:
        accident, contact = accident_of(dataset, record), collision(dataset, record)
    except NotAvailableError as error:
        unknown.append(str(error))
        return None
    if accident is None or contact is None:  # only for the type checker: meta names a collision
        return None
    found = tried(avoidability, dataset, record) if replayed is None else replayed
    braked = None if isinstance(found, Skipped) else found
    if isinstance(found, Skipped):
        unknown.append(found.reason)
    return {
        "pair": [_collider(record, accident, contact, braked, which) for which in range(2)],
        "time": round((accident.last_frame - 1) * FRAME_PERIOD, 1),
        "gap": round(contact.gap, 2),
        "closing_speed": _known(contact.closing_speed),
        "impact_angle": round(math.degrees(contact.impact_angle)),
        "seen": _seen(dataset, accident),
        "braking": None if braked is None else _braking(accident, braked),
    }


def _collider(
    record: ScenarioRecord, accident: Accident, contact: Contact, braked: Avoidability | None, which: int
) -> dict[str, Any]:
    agent = accident.agents[which]
    turn = _TURNS.get(agent or "")
    return {
        "actor_id": accident.actor_ids[which],
        "category": accident.categories[which],
        "agent": agent,
        "turn": record[turn] if turn else None,  # type: ignore[literal-required]
        "speed": _known(contact.speeds[which]),
        "side": contact.sides[which],
        "delta_v": None if braked is None else _known(braked.check.delta_v[which]),
    }


def _seen(dataset: Dataset, accident: Accident) -> dict[str, float]:
    """Agent → seconds before the impact at which it alone first observes both; 0 if it never does."""
    there, observed = observed_actors(dataset, accident.scenario, accident.actor_ids)
    leads: dict[str, float] = {}
    for agent, of_both in zip(there, observed, strict=True):
        both = of_both.all(axis=0)
        leads[agent] = round((both.size - 1 - int(np.argmax(both))) * FRAME_PERIOD, 1) if both.any() else 0.0
    return leads


def _braking(accident: Accident, braked: Avoidability) -> dict[str, Any]:
    """Of the ego alone if it is one of the two, of both else: until when it would have avoided the accident."""
    by = [accident.agents.index(_EGO)] if _EGO in accident.agents else [0, 1]
    row = BRAKERS.index("both") if len(by) == 2 else by[0]
    column = int(np.argmin(np.abs(braked.decelerations - DECELERATION)))
    slack = braked.slack[row, column]
    return {
        "by": [accident.agents[which] for which in by],
        "deceleration": float(braked.decelerations[column]),
        "avoidable": bool(np.isfinite(slack)),
        "slack": _known(slack),
    }


def _nearest(dataset: Dataset, record: ScenarioRecord, unknown: list[str]) -> dict[str, Any] | None:
    """The pair of moving actors with the least time to collision."""
    pairs = interactions(dataset, record).pairs
    rows = np.flatnonzero(pairs.moving & np.isfinite(pairs.min_ttc))
    if not len(rows):
        if not _labelled(dataset, record):
            unknown.append(f"{record['token']} has no labels, which say where actors are")
        return None
    row = rows[np.argmin(pairs.min_ttc[rows])]
    return {
        "pair": [_actor(dataset, record["token"], actor) for actor in pairs.actor_ids[row].tolist()],
        "min_ttc": _known(pairs.min_ttc[row]),
        "min_gap": _known(pairs.min_gap[row]),
    }


def _labelled(dataset: Dataset, record: ScenarioRecord) -> bool:
    return any(dataset.get_sample(record["token"], agent, 1)["labelled"] for agent in agents_of(dataset, record))


def _actor(dataset: Dataset, scenario: str, actor_id: int) -> dict[str, Any]:
    category = dataset.get("instance", f"{scenario}/actor/{actor_id}")["category"]
    return {"actor_id": actor_id, "category": category, "agent": agents_by_actor(dataset, scenario).get(actor_id)}


def _known(value: float | FloatArray, digits: int = 2) -> float | None:
    number = float(value)
    return round(number, digits) if math.isfinite(number) else None
