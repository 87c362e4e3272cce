"""Agents, actors, cameras and foreseen accidents of a scenario in the form of a replay page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation import (
    Accident,
    AccidentContext,
    BoxAccidents,
    MotionOutput,
    accident_context,
)
from deepaccident_devkit.evaluation.accident import Prediction
from deepaccident_devkit.evaluation.accident.scoring import ERRORS_AT, hit_of
from deepaccident_devkit.evaluation.alarms import Pair, named_alarms
from deepaccident_devkit.evaluation.predictions import checked_prediction
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.evaluation.truth import RELEASED_HORIZON
from deepaccident_devkit.geometry import SE3, Boxes, quaternions, time_to_collision
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.boxes import actor_color, agent_letters, camera_name, recorders_of
from deepaccident_devkit.render.outcomes.above import count_words
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
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

# A results file of motion or accidents, or predictions by sample token.
ReplayPrediction = Results | Mapping[str, MotionOutput | Iterable[Accident]]
_PROTOCOL: Final = BoxAccidents()
# Maximum number of shown alarms of a sample: right alarms first, then the most confident ones.
_MAX_ALARMS: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayRecording(FrozenArrays):
    """A scenario and the agents with a view on the page.

    Attributes:
        dataset: The release.
        scenario: Record of the scenario.
        agents: Names in the order of `taxonomy.AGENTS`.
        contact: How the accident happened; None if nobody collides, or if it is not known.
        unknown: Sentence on why the contact is not known; empty if it is known, or if nobody
            collides.
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
        return range(1, self.scenario["num_frames"] + 1)

    @property
    def pair(self) -> tuple[int, ...]:
        """Actor ids of the colliding pair; empty if nobody collides."""
        collision = self.scenario["collision"]
        if collision is None:
            return ()
        return tuple(collision["ids"])

    def sample(self, agent: str, frame: int) -> str:
        """Return the token of a sample."""
        return sample_token(self.scenario["token"], agent, frame)

    @property
    def recorders(self) -> dict[int, AgentName]:
        """Actor id → agent, for all agents in the release that are vehicles with a known id."""
        return recorders_of(self.dataset, self.scenario["token"])

    def actor_of(self, agent: str) -> int | None:
        """Return the actor id of an agent; None for the infrastructure, or if meta lacks it."""
        token = f"{self.scenario['token']}/{agent}"
        actor: int | None = self.dataset.get("agent", token)["actor_id"]
        return actor

    def page_coordinates(self, xy: ArrayLike) -> list[Any]:
        """Return positions (…, 2) in world, metres, as whole centimetres from the page's origin."""
        centimetres = np.rint((as_floats(xy) - self.origin) * 100)
        return list(centimetres.astype(np.int64).tolist())


def recording_of(dataset: Dataset, scenario: RowArgument | None, agents: Agents) -> ReplayRecording:
    """Return the recording of a scenario, by default the first that ends in an accident.

    Without any accident the default is the first scenario. Agents are as for `cooperating_agents`,
    from the view of the first agent that is present; its errors are raised.

    Raises:
        NotAvailableError: The release has no scenario.
    """
    if scenario is None:
        scenario = default_scenario(dataset)
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    sample = sample_token(record["token"], agents_of(dataset, record)[0], 1)
    names = cooperating_agents(dataset, sample, agents)
    contact, unknown = None, ""
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
        origin=_origin(dataset, record, contact),
    )


def _origin(dataset: Dataset, record: ScenarioRecord, contact: Contact | None) -> FloatArray:
    """Return the point of impact, or the centre of the agents at the end, in whole metres."""
    if contact is not None:
        return as_floats(np.round(contact.point[:2]))
    samples = dataset.samples_of(record["last_frame_token"])
    positions = [dataset.world_from(sample, "ego").translation for sample in samples]
    return as_floats(np.round(np.mean(positions, axis=0)[:2]))


def agent_entries(recording: ReplayRecording) -> list[dict[str, Any]]:
    """Return the agents' names, colours, actor ids and poses at each frame (cm, cm, mrad)."""
    entries = []
    for agent in recording.agents:
        samples = [recording.sample(agent, frame) for frame in recording.frames]
        poses = [recording.dataset.world_from(sample, "ego") for sample in samples]
        yaws = quaternions.yaw_of(np.array([pose.quaternion.elements for pose in poses]))
        positions = recording.page_coordinates([pose.translation[:2] for pose in poses])
        coded_poses = []
        for position, yaw in zip(positions, yaws.tolist(), strict=True):
            coded_poses.append([*position, _milliradians(yaw)])
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

    Each has its name, role and colour, the letters of the agent that it is, length, width and
    height (cm), one state for each frame, and for each frame a bit mask over the page's agents:
    which of them see it by the released rule. A state is null if nobody annotated the actor.
    Otherwise it is x and y of its centre (cm), yaw (mrad), speed (dm/s or null), z of the centre in
    world (cm), and x and y of the box's upward axis (thousandths).
    """
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    recorders = recording.recorders
    ids = np.unique(tracks.actor_id)
    seen = _seen_masks(recording, ids)

    def priority(row: int) -> tuple[bool, bool, int]:
        return ids[row] not in recording.pair, int(ids[row]) not in recorders, ids[row]

    rows = sorted(range(len(ids)), key=priority)
    return [_actor(recording, tracks, int(ids[row]), recorders, seen[row]) for row in rows]


def pair_entries(recording: ReplayRecording) -> dict[str, list[int | None]] | None:
    """Return how near the colliding pair is at each frame; None if nobody collides.

    The values are its gap (cm), and its time to collision if both go on (ds), as `interactions`
    computes them from above; null where one of the two is not annotated or has no known velocity,
    and where they would never touch.
    """
    if not recording.pair:
        return None
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    boxes = np.full((2, len(recording.frames), 5), np.nan)
    velocity = np.full((2, len(recording.frames), 2), np.nan)
    for member, actor in enumerate(recording.pair):
        rows = np.flatnonzero(tracks.actor_id == actor)
        track, frame = tracks.boxes.select(rows), tracks.index[rows] - 1
        columns = [track.center[:, :2], track.size[:, :2], track.yaw]
        boxes[member, frame] = np.column_stack(columns)
        velocity[member, frame] = track.velocity[:, :2]
    return {
        "gap": _rounded_or_null(gaps_of_pairs(*boxes) * 100),
        "ttc": _rounded_or_null(time_to_collision(*boxes, *velocity) * 10),
    }


def _rounded_or_null(values: AnyArray) -> list[int | None]:
    return [round(value) if math.isfinite(value) else None for value in values.tolist()]


def camera_entries(recording: ReplayRecording) -> list[list[dict[str, Any]]]:
    """Return the cameras of each agent, so that the page can project boxes into their pictures.

    A camera has its title, its lens (width and height of the image, fx, fy, cx, cy; pixels), and
    for each frame the pose world_from_camera, with optical axes: x, y (cm from the page's origin),
    z (cm), and a unit quaternion w, x, y, z (ten thousandths).
    """
    entries = []
    for agent in recording.agents:
        entries.append([_camera(recording, agent, channel) for channel in CAMERAS])
    return entries


def _camera(recording: ReplayRecording, agent: str, channel: str) -> dict[str, Any]:
    samples = [recording.sample(agent, frame) for frame in recording.frames]
    lens = recording.dataset.camera(samples[0], channel)
    poses = [recording.dataset.world_from(sample, channel) for sample in samples]
    (fx, _, cx), (_, fy, cy) = lens.intrinsic[:2].tolist()
    quaternion = np.array([pose.quaternion.elements for pose in poses])
    rotations = np.rint(quaternion * 10_000).astype(int).tolist()
    positions = recording.page_coordinates([pose.translation[:2] for pose in poses])
    coded_poses = []
    for pose, position, rotation in zip(poses, positions, rotations, strict=True):
        height = round(float(pose.translation[2]) * 100)
        coded_poses.append([*position, height, *rotation])
    return {
        "title": camera_name(channel),
        "lens": [lens.width, lens.height, *(round(pixels, 2) for pixels in (fx, fy, cx, cy))],
        "poses": coded_poses,
    }


def _actor(
    recording: ReplayRecording,
    tracks: ScenarioTracks,
    actor: int,
    recorders: Mapping[int, str],
    seen: AnyArray,
) -> dict[str, Any]:
    rows = np.flatnonzero(tracks.actor_id == actor)
    boxes, agent = tracks.boxes.select(rows), recorders.get(actor)
    category = boxes.category_names[0]
    length, width, height = np.rint(boxes.size[0] * 100).astype(int).tolist()
    title, tag, role = f"{category} {actor}", "", "other"
    if agent:
        title += f" ({short_name(agent)})"
    if agent is not None:
        tag, role = agent_letters(agent), "agent"
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
        states[frame - 1] = [*position, _milliradians(yaw), coded_speed, height, *axis]
    return states


def _seen_masks(recording: ReplayRecording, ids: IntArray) -> AnyArray:
    """Return bit masks over the recording's agents, (actors, frames) uint8."""
    masks = np.zeros((len(ids), len(recording.frames)), dtype=np.uint8)
    for bit, agent in enumerate(recording.agents):
        for column, frame in enumerate(recording.frames):
            sample = recording.sample(agent, frame)
            visible = visible_actors(recording.dataset, sample, agents=[agent])
            masks[np.isin(ids, visible), column] |= 1 << bit
    return masks


def _milliradians(angle: float) -> int:
    return round(angle * 1000)


def prediction_entries(recording: ReplayRecording, prediction: ReplayPrediction) -> dict[str, Any]:
    """Return the rule in words, and the foreseen accidents of each sample with a prediction.

    Instance maps by token have the orientation of the released labels.

    Raises:
        NotAvailableError: No prediction is of this scenario and these agents, or a sample has no
            label.
    """
    horizon = _horizon(prediction)
    samples = []
    for frame in recording.frames:
        for agent in recording.agents:
            if recording.sample(agent, frame) in prediction:
                samples.append(_sample(recording, prediction, agent, frame, horizon))
    if not samples:
        raise NotAvailableError(
            f"prediction: has no sample of {recording.scenario['token']} "
            f"and {', '.join(recording.agents)}; "
            "choose a scenario and agents that it has, or replay without it"
        )
    rule = (
        f"Protocol boxes: an accident within {horizon:g} s counts as foreseen "
        f"if the errors of the two places are less than {ERRORS_AT:g} m in sum."
    )
    return {"rule": rule, "samples": samples}


def _horizon(prediction: ReplayPrediction) -> float:
    if not isinstance(prediction, Results) or prediction.form is None:
        return RELEASED_HORIZON
    return min(RELEASED_HORIZON, (prediction.form.frames - 1) * prediction.form.step)


def _sample(
    recording: ReplayRecording,
    prediction: ReplayPrediction,
    agent: str,
    frame: int,
    horizon: float,
) -> dict[str, Any]:
    token = recording.sample(agent, frame)
    foreseen, label, context = _loaded(recording, prediction, token, horizon)
    truth = context.truth
    if truth is None:  # only for the type checker: a context with a horizon has a truth
        raise NotAvailableError(f"{token}: has no truth to compare with; choose a labelled sample")
    world_from_ego = recording.dataset.world_from(token, "ego")
    alarms = []
    for accident, ids in named_alarms(foreseen, label, truth, _PROTOCOL.reading):
        alarms.append(_alarm(recording, accident, ids, context, world_from_ego))
    return {
        "frame": frame - 1,
        "agent": recording.agents.index(agent),
        "verdict": _verdict(foreseen, label, context),
        "text": f"{short_name(agent)} at frame {frame}: {_truth_text(context)}",
        "alarms": sorted(alarms, key=lambda alarm: not alarm["right"])[:_MAX_ALARMS],
        "more": max(0, len(alarms) - _MAX_ALARMS),
    }


def _loaded(
    recording: ReplayRecording, prediction: ReplayPrediction, token: str, horizon: float
) -> tuple[MotionOutput | list[Accident], MotionLabels | None, AccidentContext]:
    if isinstance(prediction, Results):
        setup = EvaluationSetup(task="accident", protocol="boxes", horizon=horizon)
        foreseen, label, context = SampleLoader(recording.dataset, prediction, setup)(token)
        return checked_prediction(foreseen), label, context
    checked = checked_prediction(prediction[token])
    return checked, None, accident_context(recording.dataset, token, horizon)


def _verdict(foreseen: Prediction, label: MotionLabels | None, context: AccidentContext) -> str:
    """Return what the sample counts as, or `not judged`."""
    counts = _PROTOCOL.counts(foreseen, label, context)
    if counts["unjudged"] and not (counts["positive"] or counts["alarms"]):
        return "not judged"
    return count_words(_PROTOCOL.result([counts]).within[ERRORS_AT])


def _alarm(
    recording: ReplayRecording,
    accident: Accident,
    ids: Pair | None,
    context: AccidentContext,
    world_from_ego: SE3,
) -> dict[str, Any]:
    counts = _PROTOCOL.counts([accident], None, context)
    error = None
    if counts["alarms"]:
        error = counts["alarms"][0]
    text = f"foreseen in {accident.time:.1f} s, score {accident.score:.2g}"
    if error and error["position"] is not None:
        text += f": places off by {error['position']:.1f} m, time by {error['time']:+.1f} s"
    elif error is None:
        text += ": it would be after the end of the recording"
    if ids is not None:
        names = ["an unknown actor" if actor is None else str(actor) for actor in ids]
        text += f"; names {' and '.join(names)}"
        if context.pair is not None and set(ids) == set(context.pair):
            text += ", who collide"
    points = [[x, y, 0.0] for x, y in accident.positions.tolist()]
    return {
        "places": recording.page_coordinates(world_from_ego.apply(points)[:, :2]),
        "right": bool(error and hit_of([error], ERRORS_AT)),
        "time": round(accident.time, 1),
        "text": text,
        "actors": [actor for actor in ids or () if actor is not None],
    }


def _truth_text(context: AccidentContext) -> str:
    truth = context.truth
    if truth is None or truth.accident is None:
        return "no accident comes within the horizon"
    return f"an accident comes in {truth.accident.time:.1f} s"
