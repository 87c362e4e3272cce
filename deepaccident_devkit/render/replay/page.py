"""`render_replay`: a scenario as one HTML file, with the facts about it in words."""

import base64
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, SensorFileError
from deepaccident_devkit.render.boxes import camera_name
from deepaccident_devkit.render.captions import scenario_words
from deepaccident_devkit.render.replay.drawn import ReplayPrediction, drawing_entries
from deepaccident_devkit.render.replay.entries import (
    ReplayRecording,
    actor_entries,
    agent_entries,
    camera_entries,
    pair_entries,
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
    cloud_size,
    follow_pair,
    lidar_points,
    max_cloud_points,
)
from deepaccident_devkit.render.styles import (
    CATEGORY_MARKERS,
    COLLIDER_COLOR,
    COLORS,
    GRID_COLOR,
    HEIGHT_COLORS,
    POINT_COLOR,
)
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.support.pages import document, part, source_hash
from deepaccident_devkit.support.scripts import bundled
from deepaccident_devkit.support.text import PathType, path_of
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, FRAME_PERIOD, LIDAR, short_name
from deepaccident_devkit.v2x import Agents
from deepaccident_devkit.v2x.collisions import contact_words

# Maximum bytes of a page, so that it can be sent by mail.
SIZE_LIMIT: Final = 15_000_000
# Endings of a page's file.
_SUFFIXES = (".html", ".htm")
# Characters of base64 per byte.
_BASE64_RATIO = 4 / 3
# Bytes of a picture in JSON in addition to its base64: quotes, a comma and padding.
_JSON_BYTES_PER_PICTURE = 8
# Bytes of a cloud in JSON in addition to its base64: quotes and a comma; and of all notes.
_JSON_BYTES_PER_CLOUD = 4
_NOTES_BYTES = 20_000


def render_replay(
    dataset: Dataset,
    scenario: RowArgument | None,
    path: PathType,
    *,
    prediction: ReplayPrediction | None = None,
    task: str | None = None,
    agents: Agents = None,
    progress: bool = False,
) -> Path:
    """Write a scenario as one HTML file that plays in any browser.

    The page needs no server and no network, and is small enough to be sent by e-mail. It shows:

    - the agents' cameras with the actors' boxes; one of them is large, by default the one that
      shows the colliding pair best;
    - the scene in three dimensions, which can be rotated, with the agents' LiDAR points;
    - the scene from above, with the road, all actors and their trails;
    - which agent sees which actor by the released rule, the countdown to the impact, and how close
      the pair is.

    The road is what the agents' BEV cameras saw. If they have no files, it comes from the stored
    town map (`town_map`), if there is one. Front cameras, and any camera while it shows the pair
    best, have larger pictures than the others. All pictures are as large as `SIZE_LIMIT` allows.
    What the release lacks (images, points, labels) is left out, and the page mentions it.

    Args:
        dataset: The release.
        scenario: Token or record; None for the first that ends in an accident, or if there is no
            accident, for the first one.
        path: Path of the file to write.
        prediction: Results of a model, or predictions by sample token; boxes in a mapping are in
            the frame of the task's protocol. None for no prediction.
        task: Name of the task that draws the predictions, also of a plug-in, such as `accident` for
            motion; None for the kind of the predictions.
        agents: Agents whose cameras, views and predictions the page shows, as in
            `v2x.cooperating_agents`; None for all present agents.
        progress: Whether to show a progress bar.

    Returns:
        The path of the file; it has the same bytes for the same release, arguments and stored town
        map.

    Raises:
        TokenError: No such scenario.
        ChoiceError: No such agent or task, the predictions are for another task, or `path` is a
            folder or does not end in `.html` or `.htm`.
        NotAvailableError: The release has no scenario, lacks one of the agents, or the prediction
            is of other samples.
        SensorFileError: An image or a point cloud cannot be read.
    """
    target = path_of(path)
    if target.is_dir():
        raise ChoiceError(
            f"{target}: is a folder; name a file in it, such as {target / 'replay.html'}"
        )
    if target.suffix.lower() not in _SUFFIXES:
        raise ChoiceError(f"{target}: expected a file that ends in {', '.join(_SUFFIXES)}")
    recording = recording_of(dataset, scenario, agents)
    files = camera_files(recording)
    clouds = lidar_files(recording)
    data, followed = _page_data(recording, prediction, task, files, clouds)
    cloud_count = sum(map(sum, clouds))
    cloud_bytes = PAGE_CLOUD_BYTES if cloud_count else 0
    page_without_sensors = replay_page("", data).encode()
    free_bytes = SIZE_LIMIT - len(page_without_sensors) - _NOTES_BYTES
    free_bytes -= _JSON_BYTES_PER_CLOUD * cloud_count
    picture_bytes = (free_bytes - cloud_bytes) / _BASE64_RATIO
    picture_bytes -= _JSON_BYTES_PER_PICTURE * len(recording.frames) * len(files)
    settings, jpegs = camera_pictures(files, followed, picture_bytes, progress=progress)
    data["cameras"] = _add_pictures(recording, data["cameras"], jpegs)
    page_with_pictures = replay_page("", data).encode()
    free_bytes -= len(page_with_pictures) - len(page_without_sensors)
    max_points = max_cloud_points(cloud_count, free_bytes)
    data["points"] = lidar_points(recording, max_points)
    data["notes"] = notes(recording, files, settings, clouds, data["points"], max_points)
    title = scenario_words(recording.scenario)
    write_bytes(target, replay_page(title, data).encode())
    return target


def tried_replay(
    dataset: Dataset,
    scenario: str,
    path: Path,
    *,
    prediction: ReplayPrediction | None = None,
    task: str | None = None,
) -> str | None:
    """Try to write the replay of a scenario; return None, or the reason if this failed.

    Possible reasons are that a file cannot be read, or that the prediction cannot be shown.
    """
    try:
        render_replay(dataset, scenario, path, prediction=prediction, task=task)
    except (ChoiceError, NotAvailableError, SensorFileError) as error:
        return str(error)
    return None


def served_replay(
    dataset: Dataset,
    scenario: RowArgument,
    folder: str,
    *,
    prediction: ReplayPrediction | None = None,
    task: str | None = None,
) -> dict[str, Any]:
    """Return the data for a page that loads all agents' pictures and points from a server.

    The page's scripts request `images/AGENT/CHANNEL/FRAME?width=PIXELS` (JPEG) and
    `points/AGENT/FRAME`, which answers with `cloud_text`, below `folder`, an address that ends in a
    slash. Other arguments and errors are as for `render_replay`.
    """
    recording = recording_of(dataset, scenario, None)
    files = camera_files(recording)
    clouds = lidar_files(recording)
    data, _ = _page_data(recording, prediction, task, files, clouds)
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
    """Return whether each agent's LiDAR file is present in each frame."""
    present = recording.dataset.sensor_frames(recording.scenario["token"])
    files = []
    for agent in recording.agents:
        frames = present[agent, LIDAR]
        files.append([frame in frames for frame in recording.frames])
    return files


def _page_data(
    recording: ReplayRecording,
    prediction: ReplayPrediction | None,
    task: str | None,
    files: CameraFiles,
    clouds: list[list[bool]],
) -> tuple[dict[str, Any], Followed]:
    """Return the page's data without pictures and points, and the cameras that follow the pair.

    In the data, `automatic` has the index, per frame, of the agent that shows the pair best, and
    the best camera of each agent. `files` has the number, per frame, of camera and LiDAR files that
    are present.
    """
    token = recording.scenario["token"]
    countdown = []
    for frame in recording.frames:
        record = recording.dataset.get("frame", f"{token}/{frame:03d}")
        countdown.append(record["time_to_impact"])
    impact = None
    if recording.contact is not None:
        impact = recording.page_coordinates(recording.contact.point[:2])
    predicted = None
    if prediction is not None:
        predicted = drawing_entries(recording, prediction, task)
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


def _add_pictures(
    recording: ReplayRecording, cameras: list[list[dict[str, Any]]], jpegs: Jpegs
) -> list[list[dict[str, Any]]]:
    """Return for each agent the entries of the cameras that have pictures, with their pictures.

    A camera has a picture in base64 for each frame; a missing picture is null.
    """
    pictured_cameras = []
    for agent, entries in zip(recording.agents, cameras, strict=True):
        pictured_entries = []
        for channel, entry in zip(CAMERAS, entries, strict=True):
            pictures = jpegs.get(agent, {}).get(channel)
            if pictures is not None:
                texts = [_encode_base64(picture) for picture in pictures]
                pictured_entries.append({**entry, "pictures": texts})
        pictured_cameras.append(pictured_entries)
    return pictured_cameras


def _encode_base64(picture: bytes | None) -> str | None:
    if picture is None:
        return None
    return base64.b64encode(picture).decode("ascii")


def replay_page(title: str, data: Mapping[str, Any]) -> str:
    """Return a complete HTML page with a window title and the data that its scripts play.

    The page's content security policy lets a browser run only this script, use only this style, and
    load nothing else. The script shows all text in the data as text, never as HTML.
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
    """Encode the data as JSON in which nothing can close the surrounding HTML element."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def replay_style() -> str:
    """Return the style rules of a replay, except the colours."""
    return part("replay/replay.css")


def replay_script() -> str:
    """Return the modules of a replay as one script."""
    return bundled(lambda name: part(f"replay/{name}"), "replay")


def facts(recording: ReplayRecording) -> list[list[str]]:
    """Return the names and values of the facts that are known about a scenario and its end."""
    facts_and_gaps = [*_setting(recording), *_ending(recording)]
    return [[name, value] for name, value in facts_and_gaps if value]


def notes(
    recording: ReplayRecording,
    files: CameraFiles,
    settings: PictureSettings | None,
    clouds: list[list[bool]],
    points: list[list[str | None] | None] | None,
    max_points: int,
) -> list[str]:
    """Return sentences about what is missing in the release or was left out.

    Args:
        recording: Scenario and shown agents.
        files: Image files of the cameras.
        settings: Settings of the pictures; None if there is no picture.
        clouds: Whether each agent's LiDAR file is present at each frame.
        points: Encoded clouds of the page, from `lidar_points`.
        max_points: Maximum number of points of a cloud.
    """
    full_bytes = cloud_size(max_points)
    texts = [text for row in points or () for text in row or () if text is not None]
    is_thinned = any(len(text) >= full_bytes for text in texts)
    return [
        *_label_notes(recording),
        *_missing_picture_notes(files),
        *_picture_notes(files, settings),
        *_cloud_notes(clouds, max_points if is_thinned else None),
    ]


def served_notes(
    recording: ReplayRecording, files: CameraFiles, clouds: list[list[bool]]
) -> list[str]:
    """Return sentences about what the release lacks, for a page without embedded pictures."""
    return [
        *_label_notes(recording),
        *_missing_picture_notes(files),
        *_cloud_notes(clouds, None),
    ]


def _setting(recording: ReplayRecording) -> Iterator[tuple[str, str]]:
    """Yield the names and values of facts about a scenario; unknown values are empty."""
    scenario = recording.scenario
    lights = "without traffic lights"
    if scenario["signalized"]:
        lights = "with traffic lights"
    side = ""
    if scenario["spawn_side"]:
        side = f"comes from {scenario['spawn_side']}"
    frames = len(recording.frames)
    yield "Town", scenario["town"]
    sky = [human_name(word) for word in (scenario["weather"], scenario["time_of_day"]) if word]
    yield "Weather", ", ".join(sky)
    yield "Road", _join_words(scenario["road_type"], lights)
    yield "Type", scenario["scenario_type"]
    yield "Ego goes", scenario["ego_direction"] or ""
    yield "Other goes", _join_words(scenario["other_direction"], side)
    yield "Recorded", f"{frames} frames, {frames * FRAME_PERIOD:.1f} s at 10 Hz"
    yield "Split", scenario["split"] or ""


def _join_words(*words: str | None) -> str:
    return ", ".join(filter(None, words))


def _ending(recording: ReplayRecording) -> Iterator[tuple[str, str]]:
    """Yield the names and values of facts about the end of a scenario; unknown values are empty."""
    scenario = recording.scenario
    contact = recording.contact
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
    if accident_type is not None:
        yield "Accident type", f"{accident_type} of the paper's 12"
    if contact is not None:
        first, second = names
        first_speed, second_speed = map(_speed_text, contact.speeds)
        first_side, second_side = contact.sides
        yield "Contact", contact_words(contact.touching, contact.gap)
        yield "Speeds", f"{first} {first_speed}, {second} {second_speed}"
        yield "Closing speed", _speed_text(contact.closing_speed)
        yield "Angle between", f"{math.degrees(contact.impact_angle):.0f}°"
        yield "Sides", f"{first} {first_side}, {second} {second_side}"


def _speed_text(speed: float) -> str:
    """Format a speed in m/s in both units, or as `unknown`."""
    if math.isnan(speed):
        return "unknown"
    return f"{speed:.1f} m/s ({speed * 3.6:.0f} km/h)"


def _label_notes(recording: ReplayRecording) -> Iterator[str]:
    """Yield sentences about absent agents, missing labels, and doubts about the contact."""
    absent_agents = [short_name(agent) for agent in AGENTS if agent not in recording.agents]
    if absent_agents:
        yield f"Agents not shown: {', '.join(absent_agents)}."
    samples = len(recording.agents) * len(recording.frames)
    unlabelled = 0
    for agent in recording.agents:
        for frame in recording.frames:
            record = recording.dataset.sample.get(recording.sample(agent, frame))
            unlabelled += not record["labelled"]
    if unlabelled == samples:
        yield (
            "The release has no labels of this scenario, so the page shows neither boxes nor who "
            "sees whom."
        )
    elif unlabelled:
        yield (
            f"{unlabelled} of {samples} samples have no label, so it is unknown what the agents "
            "see there."
        )
    if recording.unknown:
        yield f"It is unknown how the accident happened: {recording.unknown}."
    elif recording.contact is not None and recording.contact.disagreements:
        yield f"Meta and the recording disagree: {'; '.join(recording.contact.disagreements)}."


def _picture_notes(files: CameraFiles, settings: PictureSettings | None) -> Iterator[str]:
    if settings is None:
        if any(map(any, files.values())):
            yield "No images: the file would be too large with them."
        return
    yield f"Images: up to {settings.width} px wide, JPEG quality {settings.quality}."
    if settings.frame_step > 1:
        yield f"1 of every {settings.frame_step} frames has images, to keep the file small."
    step = settings.other_frame_step
    if not step:
        yield (
            "Only the front cameras, and cameras while they follow the pair, have images, to keep "
            "the file small."
        )
    elif settings.other_width < settings.width or step > 1:
        frames = ""
        if step > 1:
            frames = f", for 1 of every {step} frames"
        yield f"Images of the other cameras: up to {settings.other_width} px wide{frames}."


def _cloud_notes(clouds: list[list[bool]], max_points: int | None) -> Iterator[str]:
    """Yield sentences about missing clouds, and about points left out beyond `max_points`."""
    present = sum(map(sum, clouds))
    total = sum(map(len, clouds))
    if not present:
        yield f"No LiDAR points: all {total} files are missing; unpack the archives of lidar01."
        return
    if present < total:
        yield (
            f"{total - present} of {total} LiDAR files are missing in the release; "
            "unpack the archives of lidar01."
        )
    if max_points is not None:
        yield (
            f"LiDAR: up to {max_points:,} points per cloud, spread over the cloud; points on the "
            "road are left out first."
        )


def _missing_picture_notes(files: CameraFiles) -> Iterator[str]:
    present = sum(path is not None for paths in files.values() for path in paths)
    total = sum(map(len, files.values()))
    if not present:
        yield f"No images: all {total} camera files are missing; unpack the cameras' archives."
    elif present < total:
        yield (
            f"{total - present} of {total} camera files are missing in the release; "
            "unpack the cameras' archives."
        )
