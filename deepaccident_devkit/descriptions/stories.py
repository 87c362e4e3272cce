"""`describe`: what happens in a scenario, as facts and as two or three sentences.

Each clause of a sentence states one fact, and is omitted if the fact is unknown.
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
    map_scenarios,
    select_results,
    try_scenario,
)
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.descriptions.avoidability import BRAKERS, Avoidability, avoidability
from deepaccident_devkit.descriptions.observation import observed_actors
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.support.arrays import ShortRepr, json_numbers
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import Contact, collision, contact_words
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord

# Facts that can be written as JSON.
_Facts = Mapping[str, Any]
_NewFacts = dict[str, Any]
# Agent, direction, side or presence of traffic lights → its wording.
_AGENTS = {
    "ego_vehicle": "the ego",
    "ego_vehicle_behind": "the vehicle behind the ego",
    "other_vehicle": "the other vehicle",
    "other_vehicle_behind": "the vehicle behind the other one",
    "infrastructure": "the infrastructure",
}
_TURN_WORDS = {
    "straight": "going straight",
    "left": "turning left",
    "right": "turning right",
}
_SIDES = {
    "front": "at its front",
    "rear": "from behind",
    "left": "on its left side",
    "right": "on its right side",
}
_LIGHTS = {True: "with traffic lights", False: "without traffic lights"}
_RECORD_FACTS: Final = ("town", "road_type", "signalized", "weather", "time_of_day")
DECELERATION = 6.0
"""Deceleration in m/s² of the braking in a story: the middle one of `BRAKINGS`."""
_EGO = "ego_vehicle"
# Agent → column of the scenario table that contains its direction.
_DIRECTION_COLUMNS = {_EGO: "ego_direction", "other_vehicle": "other_direction"}


def story_text(facts: Mapping[str, Any]) -> str:
    """Write sentences from facts (`scenario_facts`); clauses whose fact is None are omitted."""
    accident = facts["accident"]
    if accident is None:
        sentences = [_no_accident_text(facts), _nearest_text(facts["nearest"])]
    else:
        sentences = [_collision_text(facts, accident), _seen_text(accident)]
        if not accident["apart"]:
            sentences.append(_avoidance_text(accident))
    known_sentences = [sentence for sentence in sentences if sentence]
    return " ".join(f"{sentence[0].upper()}{sentence[1:]}." for sentence in known_sentences)


def actor_words(actor: _Facts) -> str:
    """Name an actor: an agent by its role, any other road user by its class."""
    words = "a road user"
    if actor["category"]:
        words = f"a {actor['category']}"
    return _AGENTS.get(actor["agent"] or "", words)


def _collision_text(facts: _Facts, accident: _Facts) -> str:
    """Describe a collision: place, actors, sides hit, speeds and first contact.

    If the two actors are apart in the last frame, the text states their distance.
    """
    first, second = accident["pair"]
    if first["side"] == "front" and second["side"] != "front":
        first, second = second, first  # so that the second's front hits the first
    side = first["side"]
    other_side = second["side"]
    actor = _motion_text(first, closes=True)
    other = _motion_text(second)
    details = [
        _number_text(accident["closing_speed"], "closing at {:.1f} m/s"),
        _delta_v_text(first, second),
    ]
    if accident["touching"] != 0 and accident["gap"] is not None:
        details.append(contact_words(accident["touching"], accident["gap"]))
    if accident["apart"]:
        sentence = (
            f"meta lets {actor} collide with {other}, "
            f"but they are {accident['gap']:.1f} m apart at the end"
        )
        details = details[2:] if accident["touching"] else []
    elif side == other_side == "front":
        sentence = f"{actor} collides head-on with {other}"
    elif other_side == "front":
        sentence = _join_parts([actor, "is hit", _SIDES.get(side), "by", other])
    else:
        sentence = f"{actor} collides with {other}"
        if side and other_side:
            details.insert(0, f"{side} side to {other_side} side")
    return _join_parts([_place_text(facts), sentence, *details], ", ")


def _delta_v_text(first: _Facts, second: _Facts) -> str | None:
    values = [actor["delta_v"] for actor in (first, second)]
    words = [f"{value:.1f}" for value in values if value is not None]
    if not words:
        return None
    return f"with a delta-v of {' and '.join(words)} m/s if masses are as assumed"


def _motion_text(actor: _Facts, *, closes: bool = False) -> str:
    """Describe an actor by name, class and motion; if `closes`, the clause ends with a comma."""
    words = actor_words(actor)
    turn = _TURN_WORDS.get(actor["turn"] or "")
    details = [turn, _number_text(actor["speed"], "at {:.1f} m/s")]
    if actor["agent"] and actor["category"]:
        details.insert(0, f"a {actor['category']}")
    motion = _join_parts(details)
    if not motion:
        return words
    if closes:
        return f"{words}, {motion},"
    return f"{words}, {motion}"


def _place_text(facts: _Facts) -> str | None:
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
    sky = _list_parts([facts["weather"], facts["time_of_day"]])
    if sky:
        words.append(f"({sky})")
    return _list_parts(words, " ")


def _seen_text(accident: _Facts) -> str | None:
    """Name the agent that was first to see both colliders, and say what the ego saw by itself.

    The fact `seen` maps an agent to seconds before the impact; 0 if it never saw both.
    """
    seen: Mapping[str, float | None] = accident["seen"]
    leads = {agent: lead for agent, lead in seen.items() if lead is not None}
    if not leads:
        return None
    best_agent = max(leads, key=lambda agent: (leads[agent], agent == _EGO))
    if not leads[best_agent]:
        return "no agent alone saw both at one moment"
    text = f"{_AGENTS[best_agent]} saw both {leads[best_agent]:.1f} s before"
    ego_lead = leads.get(_EGO)
    if ego_lead is None or best_agent == _EGO:
        return text
    if ego_lead:
        return f"{text}; the ego alone {ego_lead:.1f} s before"
    return f"{text}; the ego alone never did"


def _avoidance_text(accident: _Facts) -> str | None:
    braking = accident["braking"]
    if braking is None or None in (braking["by"], braking["deceleration"], braking["avoidable"]):
        return None
    brakers = [_AGENTS.get(agent, "the other road user") for agent in braking["by"]]
    action = f"braking at {braking['deceleration']:g} m/s² by {_list_parts(brakers, ' and ')}"
    if not braking["avoidable"]:
        return f"{action} would not have avoided it at any time"
    if braking["slack"] is None:
        return None
    return f"{action} until {braking['slack']:.1f} s before would have avoided it"


def _no_accident_text(facts: _Facts) -> str:
    ending = ""
    if facts["collision"] is None:
        statement = "it is not known whether anybody collides"
    elif facts["collision"]:
        partners = _partners_text(facts.get("partners")) or "two"
        statement = f"{partners} collide"
        ending = ", but the labels do not show how"
    elif facts["nearest"] and facts["nearest"].get("min_gap") == 0:
        statement = "meta names no collision"
    else:
        statement = "nobody collides"
    duration = _number_text(facts["duration"], "in {:.1f} s")
    return _join_parts([_place_text(facts), statement, duration]) + ending


def _partners_text(partners: Iterable[_Facts] | None) -> str | None:
    """Describe the two actors that meta names, and say which of them has no label."""
    descriptions = []
    for actor in partners or ():
        name = actor_words(actor)
        if not actor["labelled"]:
            name += " that no label shows"
        descriptions.append(name)
    return _list_parts(descriptions, " and ")


def _nearest_text(nearest: _Facts | None) -> str | None:
    """Describe the most critical pair in a sentence."""
    if nearest is None:
        return None
    actors = " and ".join(actor_words(actor) for actor in nearest["pair"])
    if nearest["min_gap"] == 0:
        return f"the outlines of {actors} overlap"
    time = _number_text(nearest["min_ttc"], "a least time to collision of {:.1f} s")
    gap = _number_text(nearest["min_gap"], "a least gap of {:.1f} m")
    details = _list_parts([time, gap], " and ")
    if details is None:
        return None
    return f"{actors} come nearest to a collision, with {details}"


def _number_text(value: float | None, form: str) -> str | None:
    """Format a number with the format string `form`; None for an unknown number."""
    if value is None:
        return None
    return form.format(value)


def _join_parts(parts: Iterable[str | None], separator: str = " ") -> str:
    """Join the parts that are not None."""
    return separator.join(filter(None, parts))


def _list_parts(parts: Iterable[str | None], separator: str = ", ") -> str | None:
    """Join the parts that are not None; return None if all are."""
    return _join_parts(parts, separator) or None


@dataclass(frozen=True, slots=True, kw_only=True)
class Story(ShortRepr):
    """A scenario in words.

    The facts are:

    - always `scenario`, `town`, `road_type`, `signalized`, `weather`, `time_of_day`, `duration`
      (s), `collision`, and `unknown` (reasons);
    - with a collision, `accident`, or `partners` if the labels do not show it: for each actor that
      meta names, `actor_id`, `category`, `agent`, and `labelled` (whether a label shows it);
    - without a collision, `nearest`: the `pair` (`actor_id`, `category`, `agent`), `min_ttc` (s)
      and `min_gap` (m).

    An `accident` has:

    - `pair`: for each collider, `actor_id`, `category`, `agent`, `turn`, `speed` and `delta_v`
      (m/s), and `side`, the one that faces the other;
    - `time`: seconds from the first frame to the last one that shows both;
    - `gap`: metres between the outlines there;
    - `touching`: seconds before the end from when the outlines touch, to 0.1 s; None if never;
    - `apart`: whether the two are too far apart to collide;
    - `closing_speed`, in m/s, and `impact_angle`, in degrees;
    - `seen`: for each agent, seconds before the impact from when it observes both by itself; 0 if
      never;
    - `braking`: which agents brake (`by`), `deceleration` (m/s²), whether that avoids the accident
      (`avoidable`), and until when before the impact (`slack`, s).

    Attributes:
        facts: Facts that can be written as JSON; None for unknown ones.
        text: English sentences; each clause states one of the facts.
    """

    facts: Mapping[str, Any]
    text: str

    def __str__(self) -> str:
        """Return the text."""
        return self.text

    def to_json(self) -> str:
        """Return facts and text as a JSON object."""
        content = {**self.facts, "text": self.text}
        return json.dumps(content, indent=2, allow_nan=False)


def describe(dataset: Dataset, scenario: RowArgument) -> Story:
    """Describe a scenario: its collision, which agents saw it coming, and what would avoid it.

    Everything is computed from labels and meta. What these do not contain is omitted from the text
    and None in the facts; `facts["unknown"]` lists the reasons.

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.

    Raises:
        TokenError: If the release has no such scenario.

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
    """Describe several scenarios, in the order of the release.

    Args:
        dataset: The release.
        scenarios: Tokens or records; None for all.
        **engine: `workers`, `executor` and `progress`; see `parallel.Engine`.

    Raises:
        TokenError: If the release has no such scenario.
    """
    results = map_scenarios(
        describe, dataset, scenarios, label="Describing scenarios", at_once=1, **engine
    )
    return select_results(Story, results)


def scenario_facts(
    dataset: Dataset, scenario: RowArgument, replayed: Avoidability | Skipped | None = None
) -> dict[str, Any]:
    """Compute the facts of `describe`, which raises the same errors.

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.
        replayed: Result of `avoidability` for the scenario, or the reason for not having one; None
            to compute it.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    unknown_facts = []
    collides = None
    if record["weather"] is not None:
        collides = record["collision"] is not None
    if collides is None:
        unknown_facts.append(
            f"{record['token']} has no meta file, which says whether two road users "
            "collide; unpack meta"
        )
    accident = None
    partners = None
    nearest_pair = None
    if collides:
        accident = _accident_facts(dataset, record, unknown_facts, replayed)
    if accident is None:
        partners = _partner_facts(dataset, record)
    if not collides:
        nearest_pair = _nearest_facts(dataset, record, unknown_facts)
    return {
        "scenario": record["token"],
        **{name: record[name] for name in _RECORD_FACTS},
        "duration": round((record["num_frames"] - 1) * FRAME_PERIOD, 1),
        "collision": collides,
        "accident": accident,
        "partners": partners,
        "nearest": nearest_pair,
        "unknown": unknown_facts,
    }


def _accident_facts(
    dataset: Dataset,
    record: ScenarioRecord,
    unknown: list[str],
    replayed: Avoidability | Skipped | None,
) -> _NewFacts | None:
    """Collect the facts about a collision: actors, observers, and the braking that avoids it.

    Reasons for missing facts are appended to `unknown`.
    """
    try:
        accident = accident_of(dataset, record)
        contact = collision(dataset, record)
    except NotAvailableError as error:
        unknown.append(str(error))
        return None
    if accident is None or contact is None:  # only for the type checker: meta names a collision
        return None
    if replayed is None:
        replayed = try_scenario(avoidability, dataset, record)
    braked: Avoidability | None = None
    braking = None
    if isinstance(replayed, Skipped):
        unknown.append(replayed.reason)
    else:
        braked = replayed
    if braked is not None:
        braking = _braking_facts(accident, braked)
    pair = [_collider_facts(record, accident, contact, braked, member) for member in range(2)]
    return {
        "pair": pair,
        "time": round((accident.last_frame - 1) * FRAME_PERIOD, 1),
        "gap": round(contact.gap, 2),
        "touching": contact.touching,
        "apart": contact.apart,
        "closing_speed": json_numbers(contact.closing_speed, 2),
        "impact_angle": round(math.degrees(contact.impact_angle)),
        "seen": _seen_facts(dataset, accident),
        "braking": braking,
    }


def _partner_facts(dataset: Dataset, record: ScenarioRecord) -> list[_NewFacts] | None:
    """Return facts about the two actors that meta names, such as whether labels show them."""
    named_pair = record["collision"]
    labelled_ids = scenario_tracks(dataset, record).actor_id
    if named_pair is None or named_pair["ids"][0] == named_pair["ids"][1]:
        return None
    agents = agents_by_actor(dataset, record["token"])
    partners = []
    for actor, word in zip(named_pair["ids"], named_pair["classes"], strict=True):
        partner: _NewFacts = {
            "actor_id": actor,
            "category": word if word in CATEGORIES else None,
            "agent": agents.get(actor),
            "labelled": bool(np.isin(actor, labelled_ids)),
        }
        partners.append(partner)
    return partners


def _collider_facts(
    record: ScenarioRecord,
    accident: Accident,
    contact: Contact,
    braked: Avoidability | None,
    member: int,
) -> _NewFacts:
    """Collect the facts about one of the two colliders."""
    agent = accident.agents[member]
    turn = None
    column = _DIRECTION_COLUMNS.get(agent or "")
    if column is not None:
        turn = record[column]  # type: ignore[literal-required]
    delta_v = None
    if braked is not None:
        delta_v = json_numbers(braked.check.delta_v[member], 2)
    return {
        "actor_id": accident.actor_ids[member],
        "category": accident.categories[member],
        "agent": agent,
        "turn": turn,
        "speed": json_numbers(contact.speeds[member], 2),
        "side": contact.sides[member],
        "delta_v": delta_v,
    }


def _seen_facts(dataset: Dataset, accident: Accident) -> dict[str, float]:
    """Return agent → seconds before the impact when it, by itself, first observes both colliders.

    The value is 0 if it never does.
    """
    agents, observed = observed_actors(dataset, accident.scenario, accident.actor_ids)
    is_pair_seen = observed[:, 0] & observed[:, 1]
    leads: dict[str, float] = {}
    for agent, is_seen in zip(agents, is_pair_seen, strict=True):
        leads[agent] = 0.0
        if is_seen.any():
            num_frames_before = is_seen.size - 1 - int(np.argmax(is_seen))
            leads[agent] = round(num_frames_before * FRAME_PERIOD, 1)
    return leads


def _braking_facts(accident: Accident, braked: Avoidability) -> _NewFacts:
    """Collect the facts about the last braking that would have avoided the accident.

    If the ego is a collider, only it brakes; otherwise both colliders brake.
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
        "slack": json_numbers(slack, 2),
    }


def _nearest_facts(
    dataset: Dataset, record: ScenarioRecord, unknown: list[str]
) -> _NewFacts | None:
    """Collect the facts about the pair, touching or moving, with the smallest time to collision."""
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
    actor_ids = pairs.actor_ids[row].tolist()
    return {
        "pair": [_actor_facts(dataset, token, actor) for actor in actor_ids],
        "min_ttc": json_numbers(pairs.min_ttc[row], 2),
        "min_gap": json_numbers(pairs.min_gap[row], 2),
    }


def _actor_facts(dataset: Dataset, scenario: str, actor_id: int) -> _NewFacts:
    category = dataset.get("instance", f"{scenario}/actor/{actor_id}")["category"]
    return {
        "actor_id": actor_id,
        "category": category,
        "agent": agents_by_actor(dataset, scenario).get(actor_id),
    }
