"""The facts about a scenario in words, and what its page does not show."""

from __future__ import annotations

import math
from collections.abc import Iterator

from deepaccident_devkit.render.replay.recording import Recording
from deepaccident_devkit.render.replay.sensors import CameraFiles, CameraPictures
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, short_name


def facts(recording: Recording) -> list[list[str]]:
    """Names and values of the facts about a scenario and its end; unknown values are left out."""
    return [[name, value] for name, value in (*_setting(recording), *_ending(recording)) if value]


def notes(recording: Recording, pictures: CameraPictures, *, points: bool) -> list[str]:
    """Sentences on what is missing in the release or was left out.

    Args:
        recording: the scenario and the agents.
        pictures: the cameras' pictures.
        points: whether there are LiDAR points.
    """
    return [*_labels(recording), *_pictures(pictures), *_points(recording, points=points)]


def served_notes(recording: Recording, files: CameraFiles) -> list[str]:
    """Sentences on what is missing in the release, for a page that has no pictures itself.

    Args:
        recording: the scenario and the agents.
        files: of all cameras.
    """
    paths = [path for each in files.values() for path in each]
    return [*_labels(recording), *_missing_pictures(sum(path is not None for path in paths), len(paths))]


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


def _labels(recording: Recording) -> Iterator[str]:
    absent = [short_name(agent) for agent in AGENTS if agent not in recording.agents]
    if absent:
        yield f"Agents not shown: {', '.join(absent)}."
    samples = [recording.sample(agent, frame) for agent in recording.agents for frame in recording.frames]
    unlabelled = sum(not recording.dataset.sample.get(sample)["labelled"] for sample in samples)
    if unlabelled == len(samples):
        yield "The release has no labels of this scenario: the page has no boxes and does not show who sees whom."
    elif unlabelled:
        yield f"{unlabelled} of {len(samples)} samples have no label: what the agents see there is not known."
    if recording.unknown:
        yield f"How the accident happened is not known: {recording.unknown}."
    elif recording.contact is not None and recording.contact.disagreements:
        yield f"Meta and the recording disagree: {'; '.join(recording.contact.disagreements)}."


def _pictures(pictures: CameraPictures) -> Iterator[str]:
    settings = pictures.settings
    yield from _missing_pictures(pictures.found, pictures.wanted)
    if not pictures.found:
        return
    if settings is None:
        yield "No pictures: the file would be too large with them."
        return
    yield f"Pictures are up to {settings.width} pixels wide, of JPEG quality {settings.quality}."
    if settings.every > 1:
        yield f"One of every {settings.every} frames has pictures, to keep the file small."
    if not settings.others:
        yield "To keep the file small, only the front cameras and those that follow the pair have pictures."
    elif settings.other_width < settings.width or settings.others > 1:
        each = "every frame" if settings.others == 1 else f"one of every {settings.others} frames"
        yield (
            "To keep the file small, cameras other than the front ones and those that follow the pair have smaller "
            f"pictures, up to {settings.other_width} pixels wide, of {each}."
        )


def _missing_pictures(found: int, wanted: int) -> Iterator[str]:
    if not found:
        yield f"No pictures: none of the {wanted} camera files is here; unpack the cameras' archives."
    elif found < wanted:
        missing = wanted - found
        yield f"{missing} of {wanted} camera files are missing in the release; unpack the cameras' archives."


def _points(recording: Recording, *, points: bool) -> Iterator[str]:
    if not points:
        title = short_name(recording.agents[0])
        yield f"No LiDAR points: no file of {title} is here; unpack the archive of lidar01."
