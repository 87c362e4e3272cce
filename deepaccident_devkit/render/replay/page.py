"""`render_replay`: a scenario as one HTML file, with the facts about it in words."""

from __future__ import annotations

import base64
import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, SensorFileError
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.captions import scenario_words
from deepaccident_devkit.render.replay.entries import (
    Foreseen,
    ReplayRecording,
    actor_entries,
    agent_entries,
    camera_entries,
    foreseen_entries,
    pair_entries,
    recording_of,
)
from deepaccident_devkit.render.replay.road import road_picture
from deepaccident_devkit.render.replay.sensors import (
    PAGE_POINTS,
    CameraFiles,
    Followed,
    Jpegs,
    PictureSettings,
    camera_files,
    camera_pictures,
    follow_pair,
    lidar_points,
    most_points,
    served_points,
)
from deepaccident_devkit.render.styles import (
    CATEGORY_MARKERS,
    COLLIDER_COLOR,
    COLORS,
    GRID_COLOR,
    HEIGHT_COLORS,
    OUTCOME_COLORS,
    POINT_COLOR,
)
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.pages import document, part, source_hash
from deepaccident_devkit.support.scripts import bundled
from deepaccident_devkit.support.text import path_of
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, FRAME_PERIOD, LIDAR, short_name
from deepaccident_devkit.v2x import Agents
from deepaccident_devkit.v2x.collisions import contact_words

# The most bytes of a page, so that it can be sent by mail.
SIZE_LIMIT: Final = 15_000_000
_BASE64: Final = 4 / 3
# Bytes of a picture in JSON in addition to its base64: quotes, a comma and padding.
_BESIDE: Final = 8


def render_replay(
    dataset: Dataset,
    scenario: RowArgument | None,
    path: str | os.PathLike[str],
    *,
    prediction: Foreseen | None = None,
    agents: Agents = None,
    progress: bool = False,
) -> Path:
    """Write a scenario as one HTML file that plays in any browser: no server, no network, small enough for a mail.

    It shows the agents' cameras with the actors' boxes, one of them large, by default the one that shows the colliding
    pair best; the scene in three dimensions, which can be turned, with the agents' LiDAR, and from above with the road,
    all actors and their trails; who sees whom by the released rule, the countdown to the impact, and how near the pair
    is. The road is what the agents' BEV cameras saw; where they have no files, that of a town map (`town_map`), if one
    is kept. The front cameras, and the cameras while they show the pair best, have the larger pictures; all are as
    large as the page's limit, `SIZE_LIMIT`, lets them be. What the release lacks (images, points, labels) is left out,
    and the page says so.

    Args:
        dataset: the release.
        scenario: token or record; None for the first that ends in an accident, or if there is no accident, for the
            first one.
        path: the file to write.
        prediction: a model's results of motion or accidents, or predictions by sample token: the page shows what they
            foresee and whether it is right by the accident protocol `boxes`. None for none.
        agents: whose cameras, views and predictions are shown, as in `v2x.cooperating_agents`; None for all that are
            there.
        progress: whether to show a bar.

    Returns:
        The path written; the same bytes for the same release, arguments and kept town map.

    Raises:
        TokenError: no such scenario.
        ChoiceError: no such agent, or `path` is a folder.
        NotAvailableError: the release has no scenario, lacks one of the agents, or the prediction is of other samples.
        EvaluationError: the prediction is neither of motion nor of accidents.
        SensorFileError: an image or a point cloud cannot be read.
    """
    target = path_of(path)
    if target.is_dir():
        raise ChoiceError(
            f"{target}: is a folder; name a file in it, such as {target / 'replay.html'}"
        )
    recording = recording_of(dataset, scenario, agents)
    files, clouds = camera_files(recording), lidar_files(recording)
    data, followed = _data(recording, prediction, files, clouds)
    most = most_points(sum(map(sum, clouds)), PAGE_POINTS)
    data["points"] = lidar_points(recording, most)
    free = (SIZE_LIMIT - len(replay_page("", data).encode())) / _BASE64
    free -= _BESIDE * len(recording.frames) * len(files)
    settings, jpegs = camera_pictures(files, followed, free, progress=progress)
    said = notes(recording, files, settings, clouds, most)
    data |= {"notes": said, "cameras": _with_pictures(recording, data["cameras"], jpegs)}
    write_bytes(target, replay_page(scenario_words(recording.scenario), data).encode())
    return target


def tried_replay(
    dataset: Dataset, scenario: str, path: Path, *, prediction: Foreseen | None = None
) -> str | None:
    """Write a scenario's replay; None, or why there is none: a file cannot be read, or the prediction not be shown."""
    try:
        render_replay(dataset, scenario, path, prediction=prediction)
    except (NotAvailableError, SensorFileError) as error:
        return str(error)
    return None


def served_replay(
    dataset: Dataset, scenario: RowArgument, folder: str, *, prediction: Foreseen | None = None
) -> dict[str, Any]:
    """What the scripts play on a page whose server has the pictures and points, for all cameras and agents.

    They ask below `folder`, an address that ends in a slash, for `images/AGENT/CHANNEL/FRAME?width=PIXELS` (JPEG) and
    `points/AGENT/FRAME`, which answers with `cloud_text`. Errors are those of `render_replay`.
    """
    recording = recording_of(dataset, scenario, None)
    files, clouds = camera_files(recording), lidar_files(recording)
    data, _ = _data(recording, prediction, files, clouds)
    for agent, cameras in zip(recording.agents, data["cameras"], strict=True):
        for channel, camera in zip(CAMERAS, cameras, strict=True):
            camera["channel"] = channel
            camera["pictures"] = [None if path is None else 1 for path in files[agent, channel]]
    return data | {
        "points": None,
        "notes": served_notes(recording, files, clouds),
        "served": {"folder": folder, "points": [each if any(each) else None for each in clouds]},
    }


def lidar_files(recording: ReplayRecording) -> list[list[bool]]:
    """For each agent and frame whether the LiDAR file is there."""
    there = recording.dataset.sensor_frames(recording.scenario["token"])
    return [
        [frame in there[agent, LIDAR] for frame in recording.frames] for agent in recording.agents
    ]


def _data(
    recording: ReplayRecording,
    prediction: Foreseen | None,
    files: CameraFiles,
    clouds: list[list[bool]],
) -> tuple[dict[str, Any], Followed]:
    """The page's data, except pictures and points, and the cameras that follow the pair.

    `automatic` has for each frame the number of the agent that shows the pair best, and for each agent its camera;
    `files` has for each frame how many of its sensors' files are there, of the cameras and the LiDAR.
    """
    contact = recording.contact
    moments = [
        recording.dataset.get("frame", f"{recording.scenario['token']}/{frame:03d}")
        for frame in recording.frames
    ]
    data: dict[str, Any] = {
        "scenario": recording.scenario["token"],
        "facts": facts(recording),
        "period": FRAME_PERIOD,
        "countdown": [moment["time_to_impact"] for moment in moments],
        "impact": None if contact is None else recording.places(contact.point[:2]),
        "colors": {
            "pair": COLLIDER_COLOR,
            "points": POINT_COLOR,
            "grid": GRID_COLOR,
            "heights": HEIGHT_COLORS,
            **OUTCOME_COLORS,
        },
        "markers": dict(CATEGORY_MARKERS),
        "agents": agent_entries(recording),
        "actors": actor_entries(recording),
        "pair": pair_entries(recording),
        "road": road_picture(recording),
        "prediction": None if prediction is None else foreseen_entries(recording, prediction),
        "cameras": camera_entries(recording),
    }
    seen = {actor["id"]: actor["seen"] for actor in data["actors"]}
    there = {key: [path is not None for path in paths] for key, paths in files.items()}
    data["files"] = np.sum([*there.values(), *clouds], axis=0).tolist()
    data["sensors"] = len(there) + len(clouds)
    followed = follow_pair(recording, seen, there)
    data["automatic"] = {
        "agents": [recording.agents.index(agent) for agent in followed.agents],
        "cameras": [
            [camera_name(channel) for channel in followed.channels[agent]]
            for agent in recording.agents
        ],
    }
    return data, followed


def _with_pictures(
    recording: ReplayRecording, cameras: list[list[dict[str, Any]]], jpegs: Jpegs
) -> list[list[dict[str, Any]]]:
    """For each agent its cameras that have pictures, with one for each frame in base64; null where there is none."""
    shown = []
    for agent, entries in zip(recording.agents, cameras, strict=True):
        own = {camera_name(channel): each for channel, each in jpegs.get(agent, {}).items()}
        shown.append(
            [
                {**entry, "pictures": [*map(_coded, own[entry["title"]])]}
                for entry in entries
                if entry["title"] in own
            ]
        )
    return shown


def _coded(jpeg: bytes | None) -> str | None:
    return None if jpeg is None else base64.b64encode(jpeg).decode("ascii")


def replay_page(title: str, data: Mapping[str, Any]) -> str:
    """A complete HTML page with the title of its window and the data that its scripts play.

    By its policy a browser runs only this script, uses only this style, and loads nothing. The script shows all text
    of the data as text, never as HTML.
    """
    style = COLORS + replay_style()
    policy = f"default-src 'none'; img-src data:; style-src '{source_hash(style)}'; base-uri 'none'; form-action 'none'"
    written = script_json(data)
    return document(
        "replay/replay.html",
        style=style,
        policy=policy,
        script=replay_script(),
        title=title,
        data=written,
    )


def script_json(data: Mapping[str, Any]) -> str:
    """JSON that cannot end the HTML element around it."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def replay_style() -> str:
    """The rules of a replay, beside those of the colours."""
    return part("replay/replay.css")


def replay_script() -> str:
    """Return the modules of a replay as one script."""
    return bundled(lambda name: part(f"replay/{name}"), "replay")


def facts(recording: ReplayRecording) -> list[list[str]]:
    """Names and values of the facts about a scenario and its end; unknown values are left out."""
    return [[name, value] for name, value in (*_setting(recording), *_ending(recording)) if value]


def notes(
    recording: ReplayRecording,
    files: CameraFiles,
    settings: PictureSettings | None,
    clouds: list[list[bool]],
    most: int,
) -> list[str]:
    """Sentences on what is missing in the release or was left out.

    The settings are None if there is no picture; `most` is how many points a cloud may have.
    """
    return [
        *_labels(recording),
        *_missing_pictures(files),
        *_pictures(files, settings),
        *_clouds(clouds, most),
    ]


def served_notes(
    recording: ReplayRecording, files: CameraFiles, clouds: list[list[bool]]
) -> list[str]:
    """Sentences on what is missing in the release, for a page that has no pictures itself."""
    return [
        *_labels(recording),
        *_missing_pictures(files),
        *_clouds(clouds, served_points(recording)),
    ]


def _setting(recording: ReplayRecording) -> Iterator[tuple[str, str]]:
    scenario = recording.scenario
    lights = "with traffic lights" if scenario["signalized"] else "without traffic lights"
    yield "Town", scenario["town"]
    yield "Weather", ", ".join(filter(None, (scenario["weather"], scenario["time_of_day"])))
    yield "Road", ", ".join(filter(None, (scenario["road_type"], lights)))
    yield "Type", scenario["scenario_type"]
    yield "Ego goes", scenario["ego_direction"] or ""
    side = f"comes from {scenario['spawn_side']}" if scenario["spawn_side"] else ""
    yield "Other goes", ", ".join(filter(None, (scenario["other_direction"], side)))
    yield (
        "Recorded",
        f"{len(recording.frames)} frames, {len(recording.frames) * FRAME_PERIOD:.1f} s at 10 Hz",
    )
    yield "Split", scenario["split"] or ""


def _ending(recording: ReplayRecording) -> Iterator[tuple[str, str]]:
    told, contact = recording.scenario["collision"], recording.contact
    if told is None:
        yield "Ends", "without a collision" if recording.scenario["weather"] else ""
        return
    names = [f"{kind} {actor}" for kind, actor in zip(told["classes"], told["ids"], strict=True)]
    agents = told["agents"] or [None, None]
    who = [
        f"{name} ({short_name(agent)})" if agent else name
        for name, agent in zip(names, agents, strict=True)
    ]
    kind = recording.scenario["accident_type"]
    yield "Ends", f"{who[0]} and {who[1]} collide"
    yield "Accident type", "" if kind is None else f"{kind} of the paper's 12"
    if contact is not None:
        yield "Contact", contact_words(contact.touching, contact.gap)
        yield (
            "Speeds",
            ", ".join(
                f"{name} {_speed(speed)}" for name, speed in zip(names, contact.speeds, strict=True)
            ),
        )
        yield "Closing speed", _speed(contact.closing_speed)
        yield "Angle between", f"{math.degrees(contact.impact_angle):.0f}°"
        yield (
            "Sides",
            ", ".join(f"{name} {side}" for name, side in zip(names, contact.sides, strict=True)),
        )


def _speed(speed: float) -> str:
    return "unknown" if math.isnan(speed) else f"{speed:.1f} m/s ({speed * 3.6:.0f} km/h)"


def _labels(recording: ReplayRecording) -> Iterator[str]:
    absent = [short_name(agent) for agent in AGENTS if agent not in recording.agents]
    if absent:
        yield f"Agents not shown: {', '.join(absent)}."
    samples = [
        recording.sample(agent, frame) for agent in recording.agents for frame in recording.frames
    ]
    unlabelled = sum(not recording.dataset.sample.get(sample)["labelled"] for sample in samples)
    if unlabelled == len(samples):
        yield "The release has no labels of this scenario: the page has no boxes and does not show who sees whom."
    elif unlabelled:
        yield f"{unlabelled} of {len(samples)} samples have no label: what the agents see there is not known."
    if recording.unknown:
        yield f"How the accident happened is not known: {recording.unknown}."
    elif recording.contact is not None and recording.contact.disagreements:
        yield f"Meta and the recording disagree: {'; '.join(recording.contact.disagreements)}."


def _pictures(files: CameraFiles, settings: PictureSettings | None) -> Iterator[str]:
    if settings is None:
        yield from ["No pictures: the file would be too large with them."] * any(
            map(any, files.values())
        )
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


def _clouds(clouds: list[list[bool]], most: int) -> Iterator[str]:
    found, wanted = sum(map(sum, clouds)), sum(map(len, clouds))
    if not found:
        yield f"No LiDAR points: none of the {wanted} files is here; unpack the archives of lidar01."
        return
    if found < wanted:
        yield f"{wanted - found} of {wanted} LiDAR files are missing in the release; unpack the archives of lidar01."
    yield f"LiDAR clouds are thinned to at most {most} points; those of the road are left out."


def _missing_pictures(files: CameraFiles) -> Iterator[str]:
    paths = [path for each in files.values() for path in each]
    found, wanted = sum(path is not None for path in paths), len(paths)
    if not found:
        yield f"No pictures: none of the {wanted} camera files is here; unpack the cameras' archives."
    elif found < wanted:
        yield f"{wanted - found} of {wanted} camera files are missing in the release; unpack the cameras' archives."
