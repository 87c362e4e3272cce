"""What a scenario is, in words."""

from __future__ import annotations

import math
from collections.abc import Iterator

from deepaccident_devkit.render.replay.recording import Recording
from deepaccident_devkit.render.roles import short_name
from deepaccident_devkit.taxonomy import FRAME_PERIOD


def facts(recording: Recording) -> list[list[str]]:
    """Names and values that say what a scenario is and how it ends; what is not known is left out."""
    return [[name, value] for name, value in (*_setting(recording), *_ending(recording)) if value]


def _setting(recording: Recording) -> Iterator[tuple[str, str]]:
    scenario = recording.scenario
    lights = "with traffic lights" if scenario["signalized"] else "without traffic lights"
    yield "Town", scenario["town"]
    yield "Weather", ", ".join(filter(None, (scenario["weather"], scenario["time_of_day"])))
    yield "Road", ", ".join(filter(None, (scenario["road_type"], lights)))
    yield "Type", scenario["scenario_type"]
    yield "Ego goes", scenario["ego_direction"] or ""
    side = f"comes from {scenario['spawn_side']}" if scenario["spawn_side"] else ""
    yield "Other goes", ", ".join(filter(None, (scenario["other_direction"], side)))
    yield "Recorded", f"{len(recording.frames)} frames, {len(recording.frames) * FRAME_PERIOD:.1f} s at 10 Hz"
    yield "Split", scenario["split"] or ""


def _ending(recording: Recording) -> Iterator[tuple[str, str]]:
    told, contact = recording.scenario["collision"], recording.contact
    if told is None:
        yield "Ends", "without a collision" if recording.scenario["weather"] else ""
        return
    names = [f"{kind} {actor}" for kind, actor in zip(told["classes"], told["ids"], strict=True)]
    agents = told["agents"] or [None, None]
    who = [f"{name} ({short_name(agent)})" if agent else name for name, agent in zip(names, agents, strict=True)]
    kind = recording.scenario["accident_type"]
    yield "Ends", f"{who[0]} and {who[1]} collide"
    yield "Accident type", "" if kind is None else f"{kind} of the paper's 12"
    if contact is not None:
        yield "Speeds", ", ".join(f"{name} {_speed(speed)}" for name, speed in zip(names, contact.speeds, strict=True))
        yield "Closing speed", _speed(contact.closing_speed)
        yield "Angle between", f"{math.degrees(contact.impact_angle):.0f}°"
        yield "Sides", ", ".join(f"{name} {side}" for name, side in zip(names, contact.sides, strict=True))


def _speed(speed: float) -> str:
    return "unknown" if math.isnan(speed) else f"{speed:.1f} m/s ({speed * 3.6:.0f} km/h)"
