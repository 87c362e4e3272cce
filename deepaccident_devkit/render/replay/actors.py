"""Where actors, agents and cameras are at each moment, and who sees whom."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from deepaccident_devkit.arrays import AnyArray, IntArray
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.render.colors import AGENT_COLORS
from deepaccident_devkit.render.replay.recording import Recording
from deepaccident_devkit.render.roles import actor_color
from deepaccident_devkit.taxonomy import CAMERAS, short_name
from deepaccident_devkit.v2x.cooperation import visible_actors
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks


def agent_entries(recording: Recording) -> list[dict[str, Any]]:
    """The agents as the page has them: names, colour, actor id, and one pose for each frame (cm, cm, mrad)."""
    described = []
    for agent in recording.agents:
        poses = [recording.dataset.world_from(recording.sample(agent, frame), "ego") for frame in recording.frames]
        yaw = quaternions.yaw_of(np.array([pose.quaternion.elements for pose in poses]))
        places = recording.places([pose.translation[:2] for pose in poses])
        described.append(
            {
                "name": agent,
                "title": short_name(agent),
                "short": _letters(agent),
                "color": AGENT_COLORS[agent],
                "actor": recording.actor_of(agent),
                "poses": [[*place, _milliradians(turn)] for place, turn in zip(places, yaw.tolist(), strict=True)],
            }
        )
    return described


def actor_entries(recording: Recording) -> list[dict[str, Any]]:
    """The actors as the page has them: the colliding pair, the agents, then the others by id.

    Each has its name, role and colour, the letters of the agent that it is, length, width and height (cm), one state
    for each frame, and for each frame a bit mask over the page's agents: who sees it by the released rule. A state is
    null if nobody annotated the actor, else x and y of its centre (cm), yaw (mrad), speed (dm/s or null), z of the
    centre in world (cm), and x and y of the box's upward axis (thousandths).
    """
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    recorders = recording.recorders
    ids = np.unique(tracks.actor_id)
    seen = _seen(recording, ids)
    order = sorted(
        range(len(ids)), key=lambda row: (ids[row] not in recording.pair, int(ids[row]) not in recorders, ids[row])
    )
    return [_actor(recording, tracks, int(ids[row]), recorders, seen[row]) for row in order]


def camera_entries(recording: Recording) -> list[list[dict[str, Any]]]:
    """For each agent its cameras as the page has them, so that the page can project boxes into their pictures.

    A camera has its title, its lens (width and height of the image, fx, fy, cx, cy; pixels), and for each frame the
    pose world_from_camera, with optical axes: x, y (cm from the page's origin), z (cm), and a unit quaternion w, x, y,
    z (ten thousandths).
    """
    return [[_camera(recording, agent, channel) for channel in CAMERAS] for agent in recording.agents]


def camera_title(channel: str) -> str:
    """`Front` of `Camera_Front`."""
    return channel.removeprefix("Camera_")


def _camera(recording: Recording, agent: str, channel: str) -> dict[str, Any]:
    samples = [recording.sample(agent, frame) for frame in recording.frames]
    lens = recording.dataset.camera(samples[0], channel)
    poses = [recording.dataset.world_from(sample, channel) for sample in samples]
    (fx, _, cx), (_, fy, cy) = lens.intrinsic[:2].tolist()
    turns = np.rint(np.array([pose.quaternion.elements for pose in poses]) * 10_000).astype(int).tolist()
    places = recording.places([pose.translation[:2] for pose in poses])
    heights = [round(float(pose.translation[2]) * 100) for pose in poses]
    return {
        "title": camera_title(channel),
        "lens": [lens.width, lens.height, *(round(each, 2) for each in (fx, fy, cx, cy))],
        "poses": [[*place, height, *turn] for place, height, turn in zip(places, heights, turns, strict=True)],
    }


def _actor(
    recording: Recording, tracks: ScenarioTracks, actor: int, recorders: Mapping[int, str], seen: AnyArray
) -> dict[str, Any]:
    rows = np.flatnonzero(tracks.actor_id == actor)
    boxes, agent = tracks.boxes.select(rows), recorders.get(actor)
    category = boxes.category_names[0]
    length, width, height = np.rint(boxes.size[0] * 100).astype(int).tolist()
    role = _role(recording, actor, agent)
    states: list[Any] = [None] * len(recording.frames)
    moments = zip(
        tracks.index[rows].tolist(),
        recording.places(boxes.center[:, :2]),
        boxes.yaw.tolist(),
        np.linalg.norm(boxes.velocity[:, :2], axis=1).tolist(),
        np.rint(boxes.center[:, 2] * 100).astype(int).tolist(),
        np.rint(quaternions.to_matrix(boxes.rotation)[:, :2, 2] * 1000).astype(int).tolist(),
        strict=True,
    )
    for frame, place, yaw, speed, z, lean in moments:
        known = None if math.isnan(speed) else round(speed * 10)
        states[frame - 1] = [*place, _milliradians(yaw), known, z, *lean]
    return {
        "id": actor,
        "title": f"{category} {actor}" + (f" ({short_name(agent)})" if agent else ""),
        "category": category,
        "role": role,
        "tag": "" if agent is None else _letters(agent),
        "color": actor_color(category, agent, collides=role == "pair"),
        "length": length,
        "width": width,
        "height": height,
        "states": states,
        "seen": seen.tolist(),
    }


def _role(recording: Recording, actor: int, agent: str | None) -> str:
    """`pair`, `agent` for an agent that does not collide, or `other`."""
    if actor in recording.pair:
        return "pair"
    return "other" if agent is None else "agent"


def _letters(agent: str) -> str:
    """An agent in one or two letters: E, EB, O, OB or I."""
    return "".join(word[0] for word in short_name(agent).split()).upper()


def _seen(recording: Recording, ids: IntArray) -> AnyArray:
    """(actors, frames) uint8: bit masks over the recording's agents."""
    seen = np.zeros((len(ids), len(recording.frames)), dtype=np.uint8)
    for bit, agent in enumerate(recording.agents):
        for column, frame in enumerate(recording.frames):
            visible = visible_actors(recording.dataset, recording.sample(agent, frame), agents=[agent])
            seen[np.isin(ids, visible), column] |= 1 << bit
    return seen


def _milliradians(angle: float) -> int:
    return round(angle * 1000)
