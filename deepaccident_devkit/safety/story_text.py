"""Facts of a scenario in two or three English sentences: each clause says one fact, and goes where that is unknown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

_AGENTS: Final = {
    "ego_vehicle": "the ego",
    "ego_vehicle_behind": "the vehicle behind the ego",
    "other_vehicle": "the other vehicle",
    "other_vehicle_behind": "the vehicle behind the other one",
    "infrastructure": "the infrastructure",
}
_TURNS: Final = {"straight": "going straight", "left": "turning left", "right": "turning right"}
_SIDES: Final = {
    "front": "at its front",
    "rear": "from behind",
    "left": "on its left side",
    "right": "on its right side",
}


def story_text(facts: Mapping[str, Any]) -> str:
    """The sentences that facts (`safety.scenario_facts`) come to; None among them leaves its clause out."""
    accident = facts["accident"]
    if accident is not None:
        sentences = [_collision(facts, accident), _seen(accident), _avoidance(accident)]
    else:
        sentences = [_no_accident(facts), _nearest(facts["nearest"])]
    return " ".join(f"{each[0].upper()}{each[1:]}." for each in sentences if each)


def actor_words(actor: Mapping[str, Any]) -> str:
    """What an actor is called: an agent by its role, any other road user by its class."""
    known = _AGENTS.get(actor["agent"] or "")
    return known or (f"a {actor['category']}" if actor["category"] else "a road user")


def _collision(facts: Mapping[str, Any], accident: Mapping[str, Any]) -> str:
    """Where it is, and who hits whom on which side, how fast."""
    first, second = accident["pair"]
    if first["side"] == "front" and second["side"] != "front":
        first, second = second, first  # the first is hit, by the front of the second
    head_on = first["side"] == second["side"] == "front"
    verb = "collides head-on with" if head_on else "is hit by"
    if first["side"] and not head_on:
        verb = f"is hit {_SIDES[first['side']]} by"
    sentence = f"{_with_motion(first, closes=True)} {verb} {_with_motion(second)}"
    details = _listed([_number(accident["closing_speed"], "closing at {:.1f} m/s"), _delta_v(first, second)])
    return ", ".join(part for part in (_place(facts), sentence, details) if part)


def _delta_v(first: Mapping[str, Any], second: Mapping[str, Any]) -> str | None:
    values = [f"{each:.1f}" for each in (first["delta_v"], second["delta_v"]) if each is not None]
    return f"with a delta-v of {' and '.join(values)} m/s if masses are as assumed" if values else None


def _with_motion(actor: Mapping[str, Any], *, closes: bool = False) -> str:
    """An actor, what it is, and how it moves."""
    words = actor_words(actor)
    kind = f"a {actor['category']}" if actor["agent"] and actor["category"] else None
    motion = " ".join(
        part for part in (_TURNS.get(actor["turn"] or ""), _number(actor["speed"], "at {:.1f} m/s")) if part
    )
    more = " ".join(part for part in (kind, motion) if part)
    if not more:
        return words
    return f"{words}, {more}{',' if closes else ''}"


def _place(facts: Mapping[str, Any]) -> str | None:
    lights = {True: "with traffic lights", False: "without traffic lights", None: None}[facts["signalized"]]
    road = facts["road_type"] or ("junction" if lights else None)
    town = f"in {facts['town']}" if facts["town"] else None
    sky = _listed([facts["weather"], facts["time_of_day"]])
    words = [f"at a {road}" if road else None, lights, town, f"({sky})" if sky else None]
    return " ".join(word for word in words if word) or None


def _seen(accident: Mapping[str, Any]) -> str | None:
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
    return None if braking["slack"] is None else f"{how} until {braking['slack']:.1f} s before would have avoided it"


def _no_accident(facts: Mapping[str, Any]) -> str:
    what, more = {
        None: ("it is not known whether anybody collides", ""),
        False: ("nobody collides", ""),
        True: ("two collide", ", but the labels do not show how"),
    }[facts["collision"]]
    return " ".join(part for part in (_place(facts), what, _number(facts["duration"], "in {:.1f} s")) if part) + more


def _nearest(nearest: Mapping[str, Any] | None) -> str | None:
    """The most critical pair."""
    if nearest is None:
        return None
    details = _listed(
        [
            _number(nearest["min_ttc"], "a least time to collision of {:.1f} s"),
            _number(nearest["min_gap"] or None, "a least gap of {:.1f} m"),
            "outlines that touch" if nearest["min_gap"] == 0 else None,
        ],
        " and ",
    )
    who = " and ".join(actor_words(each) for each in nearest["pair"])
    return f"{who} come nearest to a collision, with {details}" if details else None


def _number(value: float | None, form: str) -> str | None:
    return None if value is None else form.format(value)


def _listed(parts: Iterable[str | None], by: str = ", ") -> str | None:
    return by.join(part for part in parts if part) or None
