"""`Recording`: the scenario that is replayed, and where its actors, agents and cameras are at each moment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.render.colors import AGENT_COLORS
from deepaccident_devkit.render.roles import actor_color, agent_letters, recorders_of
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, FrozenArrays, IntArray, as_floats
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, AgentName, short_name
from deepaccident_devkit.v2x import Agents, Contact, collision, cooperating_agents
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import default_scenario
from deepaccident_devkit.v2x.cooperation import visible_actors
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording(FrozenArrays):
    """A scenario and the agents whose view is shown.

    Attributes:
        dataset: the release.
        scenario: its record.
        agents: in the order of `taxonomy.AGENTS`.
        contact: how the accident happened; None if nobody collides, or if that is not known.
        unknown: a sentence that says why it is not known; empty if it is known, or if nobody collides.
        origin: (2,) float64 x and y in world, metres: the origin of the page's coordinates.
    """

    dataset: Dataset
    scenario: ScenarioRecord
    agents: tuple[AgentName, ...]
    contact: Contact | None
    unknown: str
    origin: FloatArray

    @property
    def frames(self) -> range:
        """The frame numbers, from 1."""
        return range(1, self.scenario["num_frames"] + 1)

    @property
    def pair(self) -> tuple[int, ...]:
        """The actor ids of the two that collide; empty if nobody does."""
        told = self.scenario["collision"]
        return () if told is None else tuple(told["ids"])

    def sample(self, agent: str, frame: int) -> str:
        """The token of a sample."""
        return sample_token(self.scenario["token"], agent, frame)

    @property
    def recorders(self) -> dict[int, AgentName]:
        """Actor id → agent, for all agents in the release that are vehicles with a known id, shown or not."""
        return recorders_of(self.dataset, self.scenario["token"])

    def actor_of(self, agent: str) -> int | None:
        """The actor id of an agent; None for the infrastructure, and if meta does not give it."""
        actor: int | None = self.dataset.get("agent", f"{self.scenario['token']}/{agent}")["actor_id"]
        return actor

    def places(self, xy: ArrayLike) -> list[Any]:
        """Places (…, 2) in world, metres, as the page has them: whole centimetres from the origin."""
        return list(np.rint((as_floats(xy) - self.origin) * 100).astype(np.int64).tolist())


def recording_of(dataset: Dataset, scenario: RowArgument | None, agents: Agents) -> Recording:
    """A scenario of a release.

    Args:
        dataset: the release.
        scenario: token or record; None for the first that ends in an accident, or if there is no accident, for the
            first one.
        agents: whose view is shown, as `cooperating_agents` takes them, seen from the first agent that is there.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: the release has no scenario, or lacks one of the agents.
        ChoiceError: no such agent or configuration.
    """
    record = dataset.scenario[dataset.getind("scenario", default_scenario(dataset) if scenario is None else scenario)]
    first = sample_token(record["token"], agents_of(dataset, record)[0], 1)
    chosen = cooperating_agents(dataset, first, agents)
    contact, unknown = None, ""
    try:
        contact = collision(dataset, record)
    except NotAvailableError as error:
        unknown = str(error)
    return Recording(
        dataset=dataset,
        scenario=record,
        agents=tuple(agent for agent in AGENTS if agent in chosen),
        contact=contact,
        unknown=unknown,
        origin=_origin(dataset, record, contact),
    )


def _origin(dataset: Dataset, record: ScenarioRecord, contact: Contact | None) -> FloatArray:
    """The place of the impact or, without one, the middle of the agents at the end; in whole metres."""
    if contact is not None:
        return as_floats(np.round(contact.point[:2]))
    poses = [dataset.world_from(sample, "ego").translation for sample in dataset.samples_of(record["last_frame_token"])]
    return as_floats(np.round(np.mean(poses, axis=0)[:2]))


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
                "short": agent_letters(agent),
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
    role = "pair" if actor in recording.pair else "other" if agent is None else "agent"
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
        "tag": "" if agent is None else agent_letters(agent),
        "color": actor_color(category, agent, collides=role == "pair"),
        "length": length,
        "width": width,
        "height": height,
        "states": states,
        "seen": seen.tolist(),
    }


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
