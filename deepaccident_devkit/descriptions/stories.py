"""`describe`: what happens in a scenario, as facts and as two or three sentences.

Each clause of a sentence states one fact, and is dropped where the fact is unknown.
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
_LIGHTS: Final = {True: "with traffic lights", False: "without traffic lights"}
_RECORD_FACTS: Final = ("town", "road_type", "signalized", "weather", "time_of_day")
DECELERATION: Final = 6.0
"""m/s² of the braking in a story: the middle one of `BRAKINGS`."""
_EGO: Final = "ego_vehicle"
# Agent → the column of the scenario table with its direction.
_DIRECTION_COLUMNS: Final = {_EGO: "ego_direction", "other_vehicle": "other_direction"}


def story_text(facts: Mapping[str, Any]) -> str:
    """Return the sentences for facts (`safety.scenario_facts`); a fact of None drops its clause."""
    accident = facts["accident"]
    if accident is None:
        sentences = [_no_accident(facts), _nearest_text(facts["nearest"])]
    else:
        sentences = [_collision(facts, accident), _seen_text(accident)]
        if not accident["apart"]:
            sentences.append(_avoidance(accident))
    known_sentences = [sentence for sentence in sentences if sentence]
    return " ".join(f"{sentence[0].upper()}{sentence[1:]}." for sentence in known_sentences)


def actor_words(actor: Mapping[str, Any]) -> str:
    """Return an actor's name: an agent's role, or the class of any other road user."""
    if actor["category"]:
        kind = f"a {actor['category']}"
    else:
        kind = "a road user"
    return _AGENTS.get(actor["agent"] or "", kind)


def _collision(facts: Mapping[str, Any], accident: Mapping[str, Any]) -> str:
    """Return the sentence on the place of a collision, its actors, sides, speeds and first contact.

    If the two actors are apart at the end, the sentence states the distance.
    """
    first, second = accident["pair"]
    if first["side"] == "front" and second["side"] != "front":
        first, second = second, first  # the first is hit, by the front of the second
    side, other_side = first["side"], second["side"]
    actors = [_with_motion(first, closes=True), _with_motion(second)]
    details = [_number(accident["closing_speed"], "closing at {:.1f} m/s"), _delta_v(first, second)]
    if accident["touching"] != 0 and accident["gap"] is not None:
        details.append(contact_words(accident["touching"], accident["gap"]))
    if accident["apart"]:
        sentence = (
            f"meta lets {actors[0]} collide with {actors[1]}, "
            f"but they are {accident['gap']:.1f} m apart at the end"
        )
        if accident["touching"]:
            details = details[2:]
        else:
            details = []
    elif side == other_side == "front":
        sentence = f"{actors[0]} collides head-on with {actors[1]}"
    elif other_side == "front":
        sentence = _joined([actors[0], "is hit", _SIDES.get(side), "by", actors[1]])
    else:
        sentence = f"{actors[0]} collides with {actors[1]}"
        if side and other_side:
            details.insert(0, f"{side} side to {other_side} side")
    return _joined([_place(facts), sentence, *details], ", ")


def _delta_v(first: Mapping[str, Any], second: Mapping[str, Any]) -> str | None:
    values = [actor["delta_v"] for actor in (first, second)]
    words = [f"{value:.1f}" for value in values if value is not None]
    if not words:
        return None
    return f"with a delta-v of {' and '.join(words)} m/s if masses are as assumed"


def _with_motion(actor: Mapping[str, Any], *, closes: bool = False) -> str:
    """Return an actor's name, class and motion; `closes` ends the motion with a comma."""
    words = actor_words(actor)
    details = [_TURN_WORDS.get(actor["turn"] or ""), _number(actor["speed"], "at {:.1f} m/s")]
    if actor["agent"] and actor["category"]:
        details.insert(0, f"a {actor['category']}")
    motion = _joined(details)
    if not motion:
        return words
    if closes:
        return f"{words}, {motion},"
    return f"{words}, {motion}"


def _place(facts: Mapping[str, Any]) -> str | None:
    lights = None
    if facts["signalized"] is not None:
        lights = _LIGHTS[facts["signalized"]]
    words: list[str | None] = []
    if facts["road_type"]:
        words.append(f"at a {facts['road_type']}")
    elif lights:
        words.append("at a junction")
    words.append(lights)
    if facts["town"]:
        words.append(f"in {facts['town']}")
    sky = _listed([facts["weather"], facts["time_of_day"]])
    if sky:
        words.append(f"({sky})")
    return _listed(words, " ")


def _seen_text(accident: Mapping[str, Any]) -> str | None:
    """Return which agent saw both actors first, and what the ego saw by itself.

    `seen` maps an agent to seconds before the impact, 0 for never.
    """
    seen: Mapping[str, float | None] = accident["seen"]
    leads = {agent: lead for agent, lead in seen.items() if lead is not None}
    if not leads:
        return None
    best = max(leads, key=lambda agent: (leads[agent], agent == _EGO))
    if not leads[best]:
        return "no agent alone saw both at one moment"
    text = f"{_AGENTS[best]} saw both {leads[best]:.1f} s before"
    ego_lead = leads.get(_EGO)
    if ego_lead is None or best == _EGO:
        return text
    if ego_lead:
        return f"{text}; the ego alone {ego_lead:.1f} s before"
    return f"{text}; the ego alone never did"


def _avoidance(accident: Mapping[str, Any]) -> str | None:
    braking = accident["braking"]
    if braking is None or None in (braking["by"], braking["deceleration"], braking["avoidable"]):
        return None
    brakers = [_AGENTS.get(agent, "the other road user") for agent in braking["by"]]
    action = f"braking at {braking['deceleration']:g} m/s² by {_listed(brakers, ' and ')}"
    if not braking["avoidable"]:
        return f"{action} would not have avoided it at any time"
    if braking["slack"] is None:
        return None
    return f"{action} until {braking['slack']:.1f} s before would have avoided it"


def _no_accident(facts: Mapping[str, Any]) -> str:
    ending = ""
    if facts["collision"] is None:
        statement = "it is not known whether anybody collides"
    elif facts["collision"]:
        partners = _partners_text(facts.get("partners")) or "two"
        statement = f"{partners} collide"
        ending = ", but the labels do not show how"
    elif (facts["nearest"] or {}).get("min_gap") == 0:
        statement = "meta names no collision"
    else:
        statement = "nobody collides"
    duration = _number(facts["duration"], "in {:.1f} s")
    return _joined([_place(facts), statement, duration]) + ending


def _partners_text(partners: Iterable[Mapping[str, Any]] | None) -> str | None:
    """Return the two actors that meta names, each with a remark if no label shows it."""
    words = []
    for partner in partners or ():
        name = actor_words(partner)
        if not partner["labelled"]:
            name += " that no label shows"
        words.append(name)
    return _listed(words, " and ")


def _nearest_text(nearest: Mapping[str, Any] | None) -> str | None:
    """Return the sentence on the most critical pair."""
    if nearest is None:
        return None
    actors = " and ".join(actor_words(actor) for actor in nearest["pair"])
    if nearest["min_gap"] == 0:
        return f"the outlines of {actors} overlap"
    time = _number(nearest["min_ttc"], "a least time to collision of {:.1f} s")
    gap = _number(nearest["min_gap"], "a least gap of {:.1f} m")
    details = _listed([time, gap], " and ")
    if details is None:
        return None
    return f"{actors} come nearest to a collision, with {details}"


def _number(value: float | None, form: str) -> str | None:
    if value is None:
        return None
    return form.format(value)


def _joined(parts: Iterable[str | None], separator: str = " ") -> str:
    return separator.join(part for part in parts if part)


def _listed(parts: Iterable[str | None], separator: str = ", ") -> str | None:
    return _joined(parts, separator) or None


@dataclass(frozen=True, slots=True, kw_only=True)
class Story(ShortRepr):
    """A scenario in words.

    Attributes:
        facts: Facts as JSON holds them (docs/safety.md lists them); None for unknown values.
        text: English sentences; each clause states one of the facts.
    """

    facts: Mapping[str, Any]
    text: str

    def __str__(self) -> str:
        """Return the text."""
        return self.text

    def to_json(self) -> str:
        """Return facts and text as one JSON object."""
        return json.dumps({**self.facts, "text": self.text}, indent=2, allow_nan=False)


def describe(dataset: Dataset, scenario: RowArgument) -> Story:
    """Describe a scenario: the collision, its speeds, earlier observers, and what would avoid it.

    Everything is computed from labels and meta. What these do not contain is missing in the text
    and None in the facts, and `facts["unknown"]` states why.

    Args:
        dataset: The release.
        scenario: Token or record.

    Raises:
        TokenError: No such scenario.

    Examples:
        >>> print(da.describe(da.find(collision=True)[0]).text)  # doctest: +SKIP
    """
    facts = scenario_facts(dataset, scenario)
    return Story(facts=facts, text=story_text(facts))


def stories(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    **engine: Unpack[Engine],
) -> tuple[Story, ...]:
    """Return the stories of scenarios, in the order of the release.

    Args:
        dataset: The release.
        scenarios: Tokens or records; None for all.
        **engine: Options `workers`, `executor` and `progress` of `parallel.Engine`.

    Raises:
        TokenError: No such scenario.
    """
    results = each_scenario(describe, dataset, scenarios, label="stories", at_once=1, **engine)
    return those_of(Story, results)


def scenario_facts(
    dataset: Dataset, scenario: RowArgument, replayed: Avoidability | Skipped | None = None
) -> dict[str, Any]:
    """Return the facts of `describe`; errors are the same.

    Args:
        dataset: The release.
        scenario: Token or record.
        replayed: Result of `avoidability` for it, or the reason why there is none, if known; None
            to compute it.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    unknown: list[str] = []
    collides = None
    if record["weather"] is not None:
        collides = record["collision"] is not None
    if collides is None:
        unknown.append(
            f"{record['token']} has no meta file, which says whether two collide; unpack meta"
        )
    accident, partners, nearest = None, None, None
    if collides:
        accident = _accident(dataset, record, unknown, replayed)
    if accident is None:
        partners = _partners(dataset, record)
    if not collides:
        nearest = _nearest(dataset, record, unknown)
    return {
        "scenario": record["token"],
        **{name: record[name] for name in _RECORD_FACTS},
        "duration": round((record["num_frames"] - 1) * FRAME_PERIOD, 1),
        "collision": collides,
        "accident": accident,
        "partners": partners,
        "nearest": nearest,
        "unknown": unknown,
    }


def _accident(
    dataset: Dataset,
    record: ScenarioRecord,
    unknown: list[str],
    replayed: Avoidability | Skipped | None,
) -> dict[str, Any] | None:
    """Return the facts on a collision: its actors, observers, and the braking that would avoid it.

    Reasons for missing facts are appended to `unknown`.
    """
    try:
        accident, contact = accident_of(dataset, record), collision(dataset, record)
    except NotAvailableError as error:
        unknown.append(str(error))
        return None
    if accident is None or contact is None:  # only for the type checker: meta names a collision
        return None
    if replayed is None:
        replayed = tried(avoidability, dataset, record)
    braked: Avoidability | None = None
    braking = None
    if isinstance(replayed, Skipped):
        unknown.append(replayed.reason)
    else:
        braked = replayed
    if braked is not None:
        braking = _braking(accident, braked)
    return {
        "pair": [_collider(record, accident, contact, braked, member) for member in range(2)],
        "time": round((accident.last_frame - 1) * FRAME_PERIOD, 1),
        "gap": round(contact.gap, 2),
        "touching": contact.touching,
        "apart": contact.apart,
        "closing_speed": known(contact.closing_speed, 2),
        "impact_angle": round(math.degrees(contact.impact_angle)),
        "seen": _seen(dataset, accident),
        "braking": braking,
    }


def _partners(dataset: Dataset, record: ScenarioRecord) -> list[dict[str, Any]] | None:
    """Return the pair that meta names, and whether labels show its actors."""
    named, labelled = record["collision"], scenario_tracks(dataset, record).actor_id
    if named is None or named["ids"][0] == named["ids"][1]:
        return None
    agents = agents_by_actor(dataset, record["token"])
    partners = []
    for actor, word in zip(named["ids"], named["classes"], strict=True):
        partners.append(
            {
                "actor_id": actor,
                "category": word if word in CATEGORIES else None,
                "agent": agents.get(actor),
                "labelled": bool(np.isin(actor, labelled)),
            }
        )
    return partners


def _collider(
    record: ScenarioRecord,
    accident: Accident,
    contact: Contact,
    braked: Avoidability | None,
    member: int,
) -> dict[str, Any]:
    agent = accident.agents[member]
    column = _DIRECTION_COLUMNS.get(agent or "")
    delta_v = None
    if braked is not None:
        delta_v = known(braked.check.delta_v[member], 2)
    return {
        "actor_id": accident.actor_ids[member],
        "category": accident.categories[member],
        "agent": agent,
        "turn": record[column] if column else None,  # type: ignore[literal-required]
        "speed": known(contact.speeds[member], 2),
        "side": contact.sides[member],
        "delta_v": delta_v,
    }


def _seen(dataset: Dataset, accident: Accident) -> dict[str, float]:
    """Return agent → seconds before the impact at which it first observes both by itself.

    The value is 0 if it never does.
    """
    agents, observed = observed_actors(dataset, accident.scenario, accident.actor_ids)
    leads: dict[str, float] = {}
    for agent, both in zip(agents, observed[:, 0] & observed[:, 1], strict=True):
        leads[agent] = 0.0
        if both.any():
            leads[agent] = round((both.size - 1 - int(np.argmax(both))) * FRAME_PERIOD, 1)
    return leads


def _braking(accident: Accident, braked: Avoidability) -> dict[str, Any]:
    """Return until when braking would have avoided the accident.

    The ego brakes if it is one of the pair; otherwise both brake.
    """
    if _EGO in accident.agents:
        row = accident.agents.index(_EGO)
        brakers = [row]
    else:
        row = BRAKERS.index("both")
        brakers = [0, 1]
    column = int(np.argmin(np.abs(braked.decelerations - DECELERATION)))
    slack = braked.slack[row, column]
    return {
        "by": [accident.agents[member] for member in brakers],
        "deceleration": float(braked.decelerations[column]),
        "avoidable": bool(np.isfinite(slack)),
        "slack": known(slack, 2),
    }


def _nearest(dataset: Dataset, record: ScenarioRecord, unknown: list[str]) -> dict[str, Any] | None:
    """Return the pair with the least time to collision, among overlapping pairs or moving ones."""
    token = record["token"]
    pairs = interactions(dataset, record).pairs
    candidates = pairs.min_gap == 0
    if not candidates.any():
        candidates = pairs.moving & np.isfinite(pairs.min_ttc)
    rows = np.flatnonzero(candidates)
    if not len(rows):
        samples = (dataset.get_sample(token, agent, 1) for agent in agents_of(dataset, record))
        if not any(sample["labelled"] for sample in samples):
            unknown.append(f"{token} has no labels, which say where actors are")
        return None
    row = rows[np.argmin(pairs.min_ttc[rows])]
    return {
        "pair": [_actor(dataset, token, actor) for actor in pairs.actor_ids[row].tolist()],
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
