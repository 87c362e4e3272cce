"""`render_replay`: a scenario as one HTML file, with the facts about it in words."""

from __future__ import annotations

import base64
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, SensorFileError
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.captions import scenario_words
from deepaccident_devkit.render.replay.entries import (
    ReplayPrediction,
    ReplayRecording,
    actor_entries,
    agent_entries,
    camera_entries,
    pair_entries,
    prediction_entries,
    recording_of,
)
from deepaccident_devkit.render.replay.road import road_picture
from deepaccident_devkit.render.replay.sensors import (
    PAGE_CLOUD_BYTES,
    CameraFiles,
    Followed,
    Jpegs,
    PictureSettings,
    camera_files,
    camera_pictures,
    follow_pair,
    lidar_points,
    max_cloud_points,
    max_served_points,
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

# Maximum bytes of a page, so that it can be sent by mail.
SIZE_LIMIT: Final = 15_000_000
# Characters of base64 per byte.
_BASE64_RATIO: Final = 4 / 3
# Bytes of a picture in JSON in addition to its base64: quotes, a comma and padding.
_JSON_BYTES_PER_PICTURE: Final = 8


def render_replay(
    dataset: Dataset,
    scenario: RowArgument | None,
    path: str | os.PathLike[str],
    *,
    prediction: ReplayPrediction | None = None,
    agents: Agents = None,
    progress: bool = False,
) -> Path:
    """Write a scenario as one HTML file that plays in any browser.

    It needs no server and no network, and is small enough for a mail.

    It shows the agents' cameras with the actors' boxes, one of them large, by default the one that
    shows the colliding pair best; the scene in three dimensions, which can be turned, with the
    agents' LiDAR, and from above with the road, all actors and their trails; which agent sees which
    actor by the released rule, the countdown to the impact, and how near the pair is. The road is
    what the agents' BEV cameras saw; where they have no files, it is that of a town map
    (`town_map`), if one is stored. The front cameras, and the cameras while they show the pair
    best, have the larger pictures; all are as large as the page's limit, `SIZE_LIMIT`, allows. What
    the release lacks (images, points, labels) is left out, and the page reports it.

    Args:
        dataset: The release.
        scenario: Token or record; None for the first that ends in an accident, or if there is no
            accident, for the first one.
        path: Path of the file to write.
        prediction: Results of a model for motion or accidents, or predictions by sample token: the
            page shows the foreseen accidents and whether they are right by the accident protocol
            `boxes`. None for no prediction.
        agents: Agents with cameras, views and predictions on the page, as in
            `v2x.cooperating_agents`; None for all present agents.
        progress: Whether to show a bar.

    Returns:
        The path of the file; it has the same bytes for the same release, arguments and stored town
        map.

    Raises:
        TokenError: No such scenario.
        ChoiceError: No such agent, or `path` is a folder.
        NotAvailableError: The release has no scenario, lacks one of the agents, or the prediction
            is of other samples.
        EvaluationError: The prediction is neither of motion nor of accidents.
        SensorFileError: An image or a point cloud cannot be read.
    """
    target = path_of(path)
    if target.is_dir():
        raise ChoiceError(
            f"{target}: is a folder; name a file in it, such as {target / 'replay.html'}"
        )
    recording = recording_of(dataset, scenario, agents)
    files, clouds = camera_files(recording), lidar_files(recording)
    data, followed = _page_data(recording, prediction, files, clouds)
    max_points = max_cloud_points(sum(map(sum, clouds)), PAGE_CLOUD_BYTES)
    data["points"] = lidar_points(recording, max_points)
    free_bytes = (SIZE_LIMIT - len(replay_page("", data).encode())) / _BASE64_RATIO
    free_bytes -= _JSON_BYTES_PER_PICTURE * len(recording.frames) * len(files)
    settings, jpegs = camera_pictures(files, followed, free_bytes, progress=progress)
    data["notes"] = notes(recording, files, settings, clouds, max_points)
    data["cameras"] = _with_pictures(recording, data["cameras"], jpegs)
    write_bytes(target, replay_page(scenario_words(recording.scenario), data).encode())
    return target


def tried_replay(
    dataset: Dataset, scenario: str, path: Path, *, prediction: ReplayPrediction | None = None
) -> str | None:
    """Write a scenario's replay and return None, or the reason why there is none.

    Reasons are that a file cannot be read, or that the prediction cannot be shown.
    """
    try:
        render_replay(dataset, scenario, path, prediction=prediction)
    except (NotAvailableError, SensorFileError) as error:
        return str(error)
    return None


def served_replay(
    dataset: Dataset,
    scenario: RowArgument,
    folder: str,
    *,
    prediction: ReplayPrediction | None = None,
) -> dict[str, Any]:
    """Return the data of a page that loads pictures and points from a server, for all agents.

    The page's scripts request `images/AGENT/CHANNEL/FRAME?width=PIXELS` (JPEG) and
    `points/AGENT/FRAME`, which answers with `cloud_text`, below `folder`, an address that ends in a
    slash. Errors are as for `render_replay`.
    """
    recording = recording_of(dataset, scenario, None)
    files, clouds = camera_files(recording), lidar_files(recording)
    data, _ = _page_data(recording, prediction, files, clouds)
    for agent, cameras in zip(recording.agents, data["cameras"], strict=True):
        for channel, camera in zip(CAMERAS, cameras, strict=True):
            camera["channel"] = channel
            camera["pictures"] = [None if path is None else 1 for path in files[agent, channel]]
    data["points"] = None
    data["notes"] = served_notes(recording, files, clouds)
    served_clouds = [row if any(row) else None for row in clouds]
    data["served"] = {"folder": folder, "points": served_clouds}
    return data


def lidar_files(recording: ReplayRecording) -> list[list[bool]]:
    """Return for each agent and frame whether the LiDAR file is present."""
    present = recording.dataset.sensor_frames(recording.scenario["token"])
    frames_of_agents = [present[agent, LIDAR] for agent in recording.agents]
    return [[frame in frames for frame in recording.frames] for frames in frames_of_agents]


def _page_data(
    recording: ReplayRecording,
    prediction: ReplayPrediction | None,
    files: CameraFiles,
    clouds: list[list[bool]],
) -> tuple[dict[str, Any], Followed]:
    """Return the page's data without pictures and points, and the cameras that follow the pair.

    `automatic` has for each frame the number of the agent that shows the pair best, and for each
    agent its camera; `files` has for each frame how many of its sensors' files are present, of the
    cameras and the LiDAR.
    """
    token, contact = recording.scenario["token"], recording.contact
    countdown = []
    for frame in recording.frames:
        record = recording.dataset.get("frame", f"{token}/{frame:03d}")
        countdown.append(record["time_to_impact"])
    impact, predicted = None, None
    if contact is not None:
        impact = recording.page_coordinates(contact.point[:2])
    if prediction is not None:
        predicted = prediction_entries(recording, prediction)
    data: dict[str, Any] = {
        "scenario": token,
        "facts": facts(recording),
        "period": FRAME_PERIOD,
        "countdown": countdown,
        "impact": impact,
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
        "prediction": predicted,
        "cameras": camera_entries(recording),
    }
    seen = {actor["id"]: actor["seen"] for actor in data["actors"]}
    present = {key: [path is not None for path in paths] for key, paths in files.items()}
    data["files"] = np.sum([*present.values(), *clouds], axis=0).tolist()
    data["sensors"] = len(present) + len(clouds)
    followed = follow_pair(recording, seen, present)
    cameras = []
    for agent in recording.agents:
        cameras.append([camera_name(channel) for channel in followed.channels[agent]])
    data["automatic"] = {
        "agents": [recording.agents.index(agent) for agent in followed.agents],
        "cameras": cameras,
    }
    return data, followed


def _with_pictures(
    recording: ReplayRecording, cameras: list[list[dict[str, Any]]], jpegs: Jpegs
) -> list[list[dict[str, Any]]]:
    """Return for each agent its cameras that have pictures, with one for each frame in base64.

    A missing picture is null.
    """
    pictured = []
    for agent, entries in zip(recording.agents, cameras, strict=True):
        pictures = {}
        for channel, row in jpegs.get(agent, {}).items():
            pictures[camera_name(channel)] = [*map(_base64, row)]
        pictured.append(
            [
                {**entry, "pictures": pictures[entry["title"]]}
                for entry in entries
                if entry["title"] in pictures
            ]
        )
    return pictured


def _base64(jpeg: bytes | None) -> str | None:
    if jpeg is None:
        return None
    return base64.b64encode(jpeg).decode("ascii")


def replay_page(title: str, data: Mapping[str, Any]) -> str:
    """Return a complete HTML page with a window title and the data that its scripts play.

    By its policy a browser runs only this script, uses only this style, and loads nothing. The
    script shows all text of the data as text, never as HTML.
    """
    style = COLORS + replay_style()
    policy = (
        f"default-src 'none'; img-src data:; style-src '{source_hash(style)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    return document(
        "replay/replay.html",
        style=style,
        policy=policy,
        script=replay_script(),
        title=title,
        data=script_json(data),
    )


def script_json(data: Mapping[str, Any]) -> str:
    """Return JSON that cannot end the HTML element around it."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def replay_style() -> str:
    """Return the style rules of a replay, without the rules of the colours."""
    return part("replay/replay.css")


def replay_script() -> str:
    """Return the modules of a replay as one script."""
    return bundled(lambda name: part(f"replay/{name}"), "replay")


def facts(recording: ReplayRecording) -> list[list[str]]:
    """Return names and values of the known facts about a scenario and its end."""
    pairs = [*_setting(recording), *_ending(recording)]
    return [[name, value] for name, value in pairs if value]


def notes(
    recording: ReplayRecording,
    files: CameraFiles,
    settings: PictureSettings | None,
    clouds: list[list[bool]],
    max_points: int,
) -> list[str]:
    """Return sentences on what is missing in the release or was left out.

    Args:
        recording: Scenario and shown agents.
        files: Image files of the cameras.
        settings: Settings of the pictures; None if there is no picture.
        clouds: Whether each agent's LiDAR file is present at each frame.
        max_points: Maximum number of points of a cloud.
    """
    return [
        *_label_notes(recording),
        *_missing_picture_notes(files),
        *_picture_notes(files, settings),
        *_cloud_notes(clouds, max_points),
    ]


def served_notes(
    recording: ReplayRecording, files: CameraFiles, clouds: list[list[bool]]
) -> list[str]:
    """Return sentences on what is missing in the release, for a page without pictures in itself."""
    return [
        *_label_notes(recording),
        *_missing_picture_notes(files),
        *_cloud_notes(clouds, max_served_points(recording)),
    ]


def _setting(recording: ReplayRecording) -> Iterator[tuple[str, str]]:
    scenario = recording.scenario
    lights = "without traffic lights"
    if scenario["signalized"]:
        lights = "with traffic lights"
    side = ""
    if scenario["spawn_side"]:
        side = f"comes from {scenario['spawn_side']}"
    frames = len(recording.frames)
    yield "Town", scenario["town"]
    yield "Weather", _listed(scenario["weather"], scenario["time_of_day"])
    yield "Road", _listed(scenario["road_type"], lights)
    yield "Type", scenario["scenario_type"]
    yield "Ego goes", scenario["ego_direction"] or ""
    yield "Other goes", _listed(scenario["other_direction"], side)
    yield "Recorded", f"{frames} frames, {frames * FRAME_PERIOD:.1f} s at 10 Hz"
    yield "Split", scenario["split"] or ""


def _listed(*parts: str | None) -> str:
    return ", ".join(part for part in parts if part)


def _ending(recording: ReplayRecording) -> Iterator[tuple[str, str]]:
    scenario, contact = recording.scenario, recording.contact
    collision = scenario["collision"]
    if collision is None:
        yield "Ends", "without a collision" if scenario["weather"] else ""
        return
    names = []
    for category, actor in zip(collision["classes"], collision["ids"], strict=True):
        names.append(f"{category} {actor}")
    colliders = []
    for name, agent in zip(names, collision["agents"] or [None, None], strict=True):
        colliders.append(f"{name} ({short_name(agent)})" if agent else name)
    yield "Ends", f"{colliders[0]} and {colliders[1]} collide"
    accident_type = scenario["accident_type"]
    yield "Accident type", "" if accident_type is None else f"{accident_type} of the paper's 12"
    if contact is not None:
        speeds = [_speed(speed) for speed in contact.speeds]
        yield "Contact", contact_words(contact.touching, contact.gap)
        yield "Speeds", _with_names(names, speeds)
        yield "Closing speed", _speed(contact.closing_speed)
        yield "Angle between", f"{math.degrees(contact.impact_angle):.0f}°"
        yield "Sides", _with_names(names, contact.sides)


def _with_names(names: Sequence[str], values: Sequence[str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in zip(names, values, strict=True))


def _speed(speed: float) -> str:
    if math.isnan(speed):
        return "unknown"
    return f"{speed:.1f} m/s ({speed * 3.6:.0f} km/h)"


def _label_notes(recording: ReplayRecording) -> Iterator[str]:
    absent = [short_name(agent) for agent in AGENTS if agent not in recording.agents]
    if absent:
        yield f"Agents not shown: {', '.join(absent)}."
    samples, unlabelled = 0, 0
    for agent in recording.agents:
        for frame in recording.frames:
            record = recording.dataset.sample.get(recording.sample(agent, frame))
            samples += 1
            unlabelled += not record["labelled"]
    if unlabelled == samples:
        yield (
            "The release has no labels of this scenario: "
            "the page has no boxes and does not show who sees whom."
        )
    elif unlabelled:
        yield (
            f"{unlabelled} of {samples} samples have no label: "
            "what the agents see there is not known."
        )
    if recording.unknown:
        yield f"How the accident happened is not known: {recording.unknown}."
    elif recording.contact is not None and recording.contact.disagreements:
        yield f"Meta and the recording disagree: {'; '.join(recording.contact.disagreements)}."


def _picture_notes(files: CameraFiles, settings: PictureSettings | None) -> Iterator[str]:
    if settings is None:
        if any(map(any, files.values())):
            yield "No pictures: the file would be too large with them."
        return
    yield f"Pictures are up to {settings.width} pixels wide, of JPEG quality {settings.quality}."
    if settings.frame_step > 1:
        yield f"One of every {settings.frame_step} frames has pictures, to keep the file small."
    step = settings.other_frame_step
    if not step:
        yield (
            "To keep the file small, only the front cameras and those that follow the pair "
            "have pictures."
        )
    elif settings.other_width < settings.width or step > 1:
        frames = "every frame"
        if step > 1:
            frames = f"one of every {step} frames"
        yield (
            "To keep the file small, cameras other than the front ones and those that follow "
            "the pair have smaller pictures, "
            f"up to {settings.other_width} pixels wide, of {frames}."
        )


def _cloud_notes(clouds: list[list[bool]], max_points: int) -> Iterator[str]:
    present, total = sum(map(sum, clouds)), sum(map(len, clouds))
    if not present:
        yield (
            f"No LiDAR points: none of the {total} files is here; unpack the archives of lidar01."
        )
        return
    if present < total:
        yield (
            f"{total - present} of {total} LiDAR files are missing in the release; "
            "unpack the archives of lidar01."
        )
    yield (
        f"LiDAR clouds are thinned to at most {max_points} points; those of the road are left out."
    )


def _missing_picture_notes(files: CameraFiles) -> Iterator[str]:
    present = sum(path is not None for paths in files.values() for path in paths)
    total = sum(map(len, files.values()))
    if not present:
        yield (
            f"No pictures: none of the {total} camera files is here; unpack the cameras' archives."
        )
    elif present < total:
        yield (
            f"{total - present} of {total} camera files are missing in the release; "
            "unpack the cameras' archives."
        )
