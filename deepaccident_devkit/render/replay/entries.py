"""Agents, actors and cameras of a scenario, as data for a replay page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.render.boxes import actor_color, agent_letters, camera_name, recorders_of
from deepaccident_devkit.render.styles import AGENT_COLORS
from deepaccident_devkit.support.arrays import (
    AnyArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    as_floats,
)
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, AgentName, short_name
from deepaccident_devkit.v2x import Agents, Contact, collision, cooperating_agents
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import default_scenario
from deepaccident_devkit.v2x.cooperation import visible_actors
from deepaccident_devkit.v2x.tracks import ScenarioTracks, pair_approach, scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayRecording(FrozenArrays):
    """A scenario and the agents whose views the page shows.

    Attributes:
        dataset: The release.
        scenario: Record of the scenario.
        agents: Names in the order of `taxonomy.AGENTS`.
        contact: How the two actors collide; None without a collision, or if this is not known.
        unknown: Sentence that states why the contact is not known; empty if it is known, or
            without a collision.
        origin: Origin of the page's coordinates in world, (2,) float64 x and y, metres.
    """

    dataset: Dataset
    scenario: ScenarioRecord
    agents: tuple[AgentName, ...]
    contact: Contact | None
    unknown: str
    origin: FloatArray

    @property
    def frames(self) -> range:
        """Frame numbers, from 1."""
        last_frame = self.scenario["num_frames"]
        return range(1, last_frame + 1)

    @property
    def pair(self) -> tuple[int, ...]:
        """Actor ids of the colliding pair; empty without a collision."""
        collision = self.scenario["collision"]
        if collision is None:
            return ()
        return tuple(collision["ids"])

    def sample(self, agent: str, frame: int) -> str:
        """Return the token of an agent's sample in a frame."""
        scenario_token = self.scenario["token"]
        return sample_token(scenario_token, agent, frame)

    def actor_of(self, agent: str) -> int | None:
        """Return the actor id of an agent; None for the infrastructure, or if meta lacks it."""
        token = f"{self.scenario['token']}/{agent}"
        actor: int | None = self.dataset.get("agent", token)["actor_id"]
        return actor

    def page_coordinates(self, xy: ArrayLike) -> list[Any]:
        """Convert positions (…, 2) in world from metres to whole centimetres from the origin."""
        metres = as_floats(xy) - self.origin
        centimetres = np.rint(metres * 100).astype(np.int64)
        return list(centimetres.tolist())


def recording_of(dataset: Dataset, scenario: RowArgument | None, agents: Agents) -> ReplayRecording:
    """Return the recording of a scenario, by default the first that ends in an accident.

    If no scenario has an accident, the default is the first scenario. `agents` is as for
    `cooperating_agents`, whose errors are raised; the ego is the first agent that is present.

    Raises:
        NotAvailableError: The release has no scenario.
    """
    if scenario is None:
        scenario = default_scenario(dataset)
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    sample = sample_token(record["token"], agents_of(dataset, record)[0], 1)
    names = cooperating_agents(dataset, sample, agents)
    contact = None
    unknown = ""
    try:
        contact = collision(dataset, record)
    except NotAvailableError as error:
        unknown = str(error)
    return ReplayRecording(
        dataset=dataset,
        scenario=record,
        agents=tuple(agent for agent in AGENTS if agent in names),
        contact=contact,
        unknown=unknown,
        origin=_page_origin(dataset, record, contact),
    )


def _page_origin(dataset: Dataset, record: ScenarioRecord, contact: Contact | None) -> FloatArray:
    """Return the point of contact, or the centre of the agents at the end, in whole metres."""
    if contact is not None:
        return as_floats(np.round(contact.point[:2]))
    samples = dataset.samples_of(record["last_frame_token"])
    positions = [dataset.world_from(sample, "ego").translation for sample in samples]
    center = np.mean(positions, axis=0)[:2]
    return as_floats(np.round(center))


def agent_entries(recording: ReplayRecording) -> list[dict[str, Any]]:
    """Return each agent's name, colour, actor id, and pose in each frame (cm, cm, mrad)."""
    entries = []
    for agent in recording.agents:
        samples = [recording.sample(agent, frame) for frame in recording.frames]
        poses = [recording.dataset.world_from(sample, "ego") for sample in samples]
        rotations = np.array([pose.quaternion.elements for pose in poses])
        yaws = quaternions.yaw_of(rotations)
        positions = recording.page_coordinates([pose.translation[:2] for pose in poses])
        coded_poses = []
        for position, yaw in zip(positions, yaws.tolist(), strict=True):
            coded_poses.append([*position, round(yaw * 1000)])
        entries.append(
            {
                "name": agent,
                "title": short_name(agent),
                "short": agent_letters(agent),
                "color": AGENT_COLORS[agent],
                "actor": recording.actor_of(agent),
                "poses": coded_poses,
            }
        )
    return entries


def actor_entries(recording: ReplayRecording) -> list[dict[str, Any]]:
    """Return the entries of the actors: the colliding pair, the agents, then the others by id.

    An entry has the actor's name, role and colour, its letters if it is an agent, its length, width
    and height (cm), one state per frame, and one bit mask per frame: which of the page's agents see
    the actor by the released rule. A state is null if no agent annotated the actor. Otherwise it
    contains x and y of the centre (cm), yaw (mrad), speed (dm/s or null), z of the centre in world
    (cm), and x and y of the box's upward axis (thousandths).
    """
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    recorders = recorders_of(recording.dataset, recording.scenario["token"])
    ids = np.unique(tracks.actor_id)
    seen = _seen_masks(recording, ids)

    def priority(row: int) -> tuple[bool, bool, int]:
        actor = int(ids[row])
        return actor not in recording.pair, actor not in recorders, actor

    rows = sorted(range(len(ids)), key=priority)
    return [_actor_entry(recording, tracks, int(ids[row]), recorders, seen[row]) for row in rows]


def pair_entries(recording: ReplayRecording) -> dict[str, list[int | None]] | None:
    """Return how close the two colliding actors are in each frame; None without a collision.

    The values are the gap between them (cm) and their time to collision (ds), computed from above
    as by `interactions`. A value is null if one of the two is not annotated or its velocity is
    unknown, or if they would never touch.
    """
    if not recording.pair:
        return None
    actor, other_actor = recording.pair
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    gap, ttc = pair_approach(tracks, (actor, other_actor), len(recording.frames))
    return {"gap": _round_finite(gap * 100), "ttc": _round_finite(ttc * 10)}


def _round_finite(values: AnyArray) -> list[int | None]:
    """Round values (N,) to whole numbers; NaN and infinite values become None."""
    rounded: list[int | None] = []
    for value in values.tolist():
        if math.isfinite(value):
            rounded.append(round(value))
        else:
            rounded.append(None)
    return rounded


def camera_entries(recording: ReplayRecording) -> list[list[dict[str, Any]]]:
    """Return the cameras of each agent, so that the page can project boxes into their pictures.

    A camera has a title, a lens (width and height of the image, fx, fy, cx, cy; pixels), and for
    each frame the pose world_from_camera, with optical axes: x, y (cm from the page's origin), z
    (cm), and a unit quaternion w, x, y, z (ten-thousandths).
    """
    entries = []
    for agent in recording.agents:
        entries.append([_camera_entry(recording, agent, channel) for channel in CAMERAS])
    return entries


def _camera_entry(recording: ReplayRecording, agent: str, channel: str) -> dict[str, Any]:
    samples = [recording.sample(agent, frame) for frame in recording.frames]
    camera = recording.dataset.camera(samples[0], channel)
    world_from_camera = [recording.dataset.world_from(sample, channel) for sample in samples]
    translations = np.array([pose.translation for pose in world_from_camera])
    unit_quaternions = np.array([pose.quaternion.elements for pose in world_from_camera])
    positions = recording.page_coordinates(translations[:, :2])
    heights = translations[:, 2].tolist()
    rotations = np.rint(unit_quaternions * 10_000).astype(int).tolist()
    coded_poses = []
    for position, height, rotation in zip(positions, heights, rotations, strict=True):
        coded_poses.append([*position, round(height * 100), *rotation])
    (fx, _, cx), (_, fy, cy) = camera.intrinsic[:2].tolist()
    intrinsics = [round(pixels, 2) for pixels in (fx, fy, cx, cy)]
    return {
        "title": camera_name(channel),
        "lens": [camera.width, camera.height, *intrinsics],
        "poses": coded_poses,
    }


def _actor_entry(
    recording: ReplayRecording,
    tracks: ScenarioTracks,
    actor: int,
    recorders: Mapping[int, str],
    seen: AnyArray,
) -> dict[str, Any]:
    rows = np.flatnonzero(tracks.actor_id == actor)
    boxes = tracks.boxes.select(rows)
    agent = recorders.get(actor)
    category = boxes.category_names[0]
    length, width, height = np.rint(boxes.size[0] * 100).astype(int).tolist()
    title = f"{category} {actor}"
    tag = ""
    role = "other"
    if agent is not None:
        title += f" ({short_name(agent)})"
        tag = agent_letters(agent)
        role = "agent"
    if actor in recording.pair:
        role = "pair"
    return {
        "id": actor,
        "title": title,
        "category": category,
        "role": role,
        "tag": tag,
        "color": actor_color(category, agent, collides=role == "pair"),
        "length": length,
        "width": width,
        "height": height,
        "states": _states(recording, boxes, tracks.index[rows]),
        "seen": seen.tolist(),
    }


def _states(recording: ReplayRecording, boxes: Boxes, frames: IntArray) -> list[Any]:
    """Return the states of an actor for `actor_entries`, from its boxes at frames (N,)."""
    heights = np.rint(boxes.center[:, 2] * 100)
    upward_axes = quaternions.to_matrix(boxes.rotation)[:, :2, 2]
    states: list[Any] = [None] * len(recording.frames)
    moments = zip(
        frames.tolist(),
        recording.page_coordinates(boxes.center[:, :2]),
        boxes.yaw.tolist(),
        np.linalg.norm(boxes.velocity[:, :2], axis=1).tolist(),
        heights.astype(int).tolist(),
        np.rint(upward_axes * 1000).astype(int).tolist(),
        strict=True,
    )
    for frame, position, yaw, speed, height, axis in moments:
        coded_speed = None
        if not math.isnan(speed):
            coded_speed = round(speed * 10)
        states[frame - 1] = [*position, round(yaw * 1000), coded_speed, height, *axis]
    return states


def _seen_masks(recording: ReplayRecording, ids: IntArray) -> AnyArray:
    """Return which agents see each actor in each frame, shape (actors, frames), uint8.

    Each value is a bit mask over the recording's agents.
    """
    masks = np.zeros((len(ids), len(recording.frames)), dtype=np.uint8)
    for bit, agent in enumerate(recording.agents):
        for column, frame in enumerate(recording.frames):
            sample = recording.sample(agent, frame)
            visible = visible_actors(recording.dataset, sample, agents=[agent])
            is_visible = np.isin(ids, visible)
            masks[is_visible, column] |= 1 << bit
    return masks
