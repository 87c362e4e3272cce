"""`describe`: what happens in a scenario, as facts and as two or three sentences.

Each clause of a sentence says one fact, and goes where that is unknown.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.collisions.recorded import (
    Accident,
    Skipped,
    accident_of,
    agents_by_actor,
    each_scenario,
    those_of,
    tried,
)
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.descriptions.avoidability import BRAKERS, Avoidability, avoidability
from deepaccident_devkit.descriptions.observation import observed_actors
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.support.arrays import ShortRepr, known
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import Contact, collision, contact_words
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord

_AGENTS: Final = {
    "ego_vehicle": "the ego",
    "ego_vehicle_behind": "the vehicle behind the ego",
    "other_vehicle": "the other vehicle",
    "other_vehicle_behind": "the vehicle behind the other one",
    "infrastructure": "the infrastructure",
}
_TURN_WORDS: Final = {
    "straight": "going straight",
    "left": "turning left",
    "right": "turning right",
}
_SIDES: Final = {
    "front": "at its front",
    "rear": "from behind",
    "left": "on its left side",
    "right": "on its right side",
}
DECELERATION: Final = 6.0
"""m/s² of the braking that a story tells of: the middle one of `BRAKINGS`."""
_EGO: Final = "ego_vehicle"
# Agent → the column of the scenario table that tells its way.
_TURNS: Final = {_EGO: "ego_direction", "other_vehicle": "other_direction"}


def story_text(facts: Mapping[str, Any]) -> str:
    """The sentences that facts (`safety.scenario_facts`) come to; None among them leaves its clause out."""
    accident = facts["accident"]
    if accident is not None:
        avoidance = None if accident["apart"] else _avoidance(accident)
        sentences = [_collision(facts, accident), _seen_text(accident), avoidance]
    else:
        sentences = [_no_accident(facts), _nearest_text(facts["nearest"])]
    return " ".join(f"{each[0].upper()}{each[1:]}." for each in sentences if each)


def actor_words(actor: Mapping[str, Any]) -> str:
    """What an actor is called: an agent by its role, any other road user by its class."""
    kind = f"a {actor['category']}" if actor["category"] else "a road user"
    return _AGENTS.get(actor["agent"] or "", kind)


def _collision(facts: Mapping[str, Any], accident: Mapping[str, Any]) -> str:
    """Where it is, and who hits whom on which side, how fast, or that the two are apart; and when outlines touch."""
    first, second = accident["pair"]
    if first["side"] == "front" and second["side"] != "front":
        first, second = second, first  # the first is hit, by the front of the second
    mine, others = first["side"], second["side"]
    actors = [_with_motion(first, closes=True), _with_motion(second)]
    details = [_number(accident["closing_speed"], "closing at {:.1f} m/s"), _delta_v(first, second)]
    if accident["touching"] != 0 and accident["gap"] is not None:
        details.append(contact_words(accident["touching"], accident["gap"]))
    if accident["apart"]:
        sentence = f"meta lets {actors[0]} collide with {actors[1]}, but they are {accident['gap']:.1f} m apart at the end"
        details = details[2:] if accident["touching"] else []
    elif mine == others == "front":
        sentence = f"{actors[0]} collides head-on with {actors[1]}"
    elif others == "front":
        sentence = " ".join(
            part for part in (actors[0], "is hit", _SIDES.get(mine), "by", actors[1]) if part
        )
    else:
        sentence = f"{actors[0]} collides with {actors[1]}"
        details.insert(0, f"{mine} side to {others} side" if mine and others else None)
    return ", ".join(part for part in (_place(facts), sentence, *details) if part)


def _delta_v(first: Mapping[str, Any], second: Mapping[str, Any]) -> str | None:
    values = [f"{each:.1f}" for each in (first["delta_v"], second["delta_v"]) if each is not None]
    return (
        f"with a delta-v of {' and '.join(values)} m/s if masses are as assumed" if values else None
    )


def _with_motion(actor: Mapping[str, Any], *, closes: bool = False) -> str:
    """An actor, what it is, and how it moves."""
    words = actor_words(actor)
    kind = f"a {actor['category']}" if actor["agent"] and actor["category"] else None
    motion = " ".join(
        part
        for part in (_TURN_WORDS.get(actor["turn"] or ""), _number(actor["speed"], "at {:.1f} m/s"))
        if part
    )
    more = " ".join(part for part in (kind, motion) if part)
    if not more:
        return words
    return f"{words}, {more}{',' if closes else ''}"


def _place(facts: Mapping[str, Any]) -> str | None:
    lights = {True: "with traffic lights", False: "without traffic lights", None: None}[
        facts["signalized"]
    ]
    road = facts["road_type"] or ("junction" if lights else None)
    town = f"in {facts['town']}" if facts["town"] else None
    sky = _listed([facts["weather"], facts["time_of_day"]])
    words = [f"at a {road}" if road else None, lights, town, f"({sky})" if sky else None]
    return " ".join(word for word in words if word) or None


def _seen_text(accident: Mapping[str, Any]) -> str | None:
    """Who saw both first, and what the ego saw alone; `seen` is agent → seconds before the impact, 0 for never."""
    seen: Mapping[str, float | None] = accident["seen"]
    leads = {agent: lead for agent, lead in seen.items() if lead is not None}
    if not leads:
        return None
    best = max(leads, key=lambda agent: (leads[agent], agent == "ego_vehicle"))
    if not leads[best]:
        return "no agent alone saw both at one moment"
    text = f"{_AGENTS[best]} saw both {leads[best]:.1f} s before"
    ego = leads.get("ego_vehicle")
    if ego is None or best == "ego_vehicle":
        return text
    return f"{text}; the ego alone {f'{ego:.1f} s before' if ego else 'never did'}"


def _avoidance(accident: Mapping[str, Any]) -> str | None:
    braking = accident["braking"]
    if braking is None or None in (braking["by"], braking["deceleration"], braking["avoidable"]):
        return None
    who = _listed([_AGENTS.get(agent, "the other road user") for agent in braking["by"]], " and ")
    how = f"braking at {braking['deceleration']:g} m/s² by {who}"
    if not braking["avoidable"]:
        return f"{how} would not have avoided it at any time"
    return (
        None
        if braking["slack"] is None
        else f"{how} until {braking['slack']:.1f} s before would have avoided it"
    )


def _no_accident(facts: Mapping[str, Any]) -> str:
    overlap = (facts["nearest"] or {}).get("min_gap") == 0
    what, more = {
        None: ("it is not known whether anybody collides", ""),
        False: ("meta names no collision" if overlap else "nobody collides", ""),
        True: (
            f"{_partners_text(facts.get('partners')) or 'two'} collide",
            ", but the labels do not show how",
        ),
    }[facts["collision"]]
    return (
        " ".join(
            part
            for part in (_place(facts), what, _number(facts["duration"], "in {:.1f} s"))
            if part
        )
        + more
    )


def _partners_text(partners: Iterable[Mapping[str, Any]] | None) -> str | None:
    """The two that meta names; of one that no label shows, that it is so."""
    unseen = {True: "", False: " that no label shows"}
    return _listed(
        [actor_words(each) + unseen[each["labelled"]] for each in partners or ()], " and "
    )


def _nearest_text(nearest: Mapping[str, Any] | None) -> str | None:
    """The most critical pair."""
    if nearest is None:
        return None
    who = " and ".join(actor_words(each) for each in nearest["pair"])
    if nearest["min_gap"] == 0:
        return f"the outlines of {who} overlap"
    details = _listed(
        [
            _number(nearest["min_ttc"], "a least time to collision of {:.1f} s"),
            _number(nearest["min_gap"], "a least gap of {:.1f} m"),
        ],
        " and ",
    )
    return f"{who} come nearest to a collision, with {details}" if details else None


def _number(value: float | None, form: str) -> str | None:
    return None if value is None else form.format(value)


def _listed(parts: Iterable[str | None], by: str = ", ") -> str | None:
    return by.join(part for part in parts if part) or None


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
    **how: Unpack[Engine],
) -> tuple[Story, ...]:
    """The stories of scenarios, in the order of the release.

    Args:
        dataset: the release.
        scenarios: tokens or records; None for all.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        TokenError: no such scenario.
    """
    return those_of(
        Story, each_scenario(describe, dataset, scenarios, label="stories", at_once=1, **how)
    )


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
        unknown.append(
            f"{record['token']} has no meta file, which says whether two collide; unpack meta"
        )
    accident = _accident(dataset, record, unknown, replayed) if collides else None
    return {
        "scenario": record["token"],
        **{
            name: record[name]
            for name in ("town", "road_type", "signalized", "weather", "time_of_day")
        },
        "duration": round((record["num_frames"] - 1) * FRAME_PERIOD, 1),
        "collision": collides,
        "accident": accident,
        "partners": _partners(dataset, record) if accident is None else None,
        "nearest": None if collides else _nearest(dataset, record, unknown),
        "unknown": unknown,
    }


def _accident(
    dataset: Dataset,
    record: ScenarioRecord,
    unknown: list[str],
    replayed: Avoidability | Skipped | None,
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
        "touching": contact.touching,
        "apart": contact.apart,
        "closing_speed": known(contact.closing_speed, 2),
        "impact_angle": round(math.degrees(contact.impact_angle)),
        "seen": _seen(dataset, accident),
        "braking": None if braked is None else _braking(accident, braked),
    }


def _partners(dataset: Dataset, record: ScenarioRecord) -> list[dict[str, Any]] | None:
    """Whom meta names as the pair, and whether labels show them."""
    told, labelled = record["collision"], scenario_tracks(dataset, record).actor_id
    if told is None or told["ids"][0] == told["ids"][1]:
        return None
    agents = agents_by_actor(dataset, record["token"])
    return [
        {
            "actor_id": actor,
            "category": word if word in CATEGORIES else None,
            "agent": agents.get(actor),
            "labelled": bool(np.isin(actor, labelled)),
        }
        for actor, word in zip(told["ids"], told["classes"], strict=True)
    ]


def _collider(
    record: ScenarioRecord,
    accident: Accident,
    contact: Contact,
    braked: Avoidability | None,
    which: int,
) -> dict[str, Any]:
    agent = accident.agents[which]
    turn = _TURNS.get(agent or "")
    return {
        "actor_id": accident.actor_ids[which],
        "category": accident.categories[which],
        "agent": agent,
        "turn": record[turn] if turn else None,  # type: ignore[literal-required]
        "speed": known(contact.speeds[which], 2),
        "side": contact.sides[which],
        "delta_v": None if braked is None else known(braked.check.delta_v[which], 2),
    }


def _seen(dataset: Dataset, accident: Accident) -> dict[str, float]:
    """Agent → seconds before the impact at which it alone first observes both; 0 if it never does."""
    there, observed = observed_actors(dataset, accident.scenario, accident.actor_ids)
    return {
        agent: round((both.size - 1 - int(np.argmax(both))) * FRAME_PERIOD, 1)
        if both.any()
        else 0.0
        for agent, both in zip(there, observed[:, 0] & observed[:, 1], strict=True)
    }


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
        "slack": known(slack, 2),
    }


def _nearest(dataset: Dataset, record: ScenarioRecord, unknown: list[str]) -> dict[str, Any] | None:
    """The pair with the least time to collision: of those of which one moves into the other, or of moving ones."""
    pairs = interactions(dataset, record).pairs
    overlap = pairs.min_gap == 0
    rows = np.flatnonzero(overlap if overlap.any() else pairs.moving & np.isfinite(pairs.min_ttc))
    if not len(rows):
        if not any(
            dataset.get_sample(record["token"], agent, 1)["labelled"]
            for agent in agents_of(dataset, record)
        ):
            unknown.append(f"{record['token']} has no labels, which say where actors are")
        return None
    row = rows[np.argmin(pairs.min_ttc[rows])]
    return {
        "pair": [
            _actor(dataset, record["token"], actor) for actor in pairs.actor_ids[row].tolist()
        ],
        "min_ttc": known(pairs.min_ttc[row], 2),
        "min_gap": known(pairs.min_gap[row], 2),
    }


def _actor(dataset: Dataset, scenario: str, actor_id: int) -> dict[str, Any]:
    category = dataset.get("instance", f"{scenario}/actor/{actor_id}")["category"]
    return {
        "actor_id": actor_id,
        "category": category,
        "agent": agents_by_actor(dataset, scenario).get(actor_id),
    }
