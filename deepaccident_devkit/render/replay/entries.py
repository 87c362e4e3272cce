"""What a replay's page has of a scenario: its agents, actors and cameras at each moment, and what a model foresees."""

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
from deepaccident_devkit.geometry import SE3, quaternions, time_to_collision
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
Foreseen = Results | Mapping[str, MotionOutput | Iterable[Accident]]
_RULES: Final = BoxAccidents()
# The most alarms of a sample that are shown: right alarms first, then the surest ones.
_SHOWN: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReplayRecording(FrozenArrays):
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
        actor: int | None = self.dataset.get("agent", f"{self.scenario['token']}/{agent}")[
            "actor_id"
        ]
        return actor

    def places(self, xy: ArrayLike) -> list[Any]:
        """Places (…, 2) in world, metres, as the page has them: whole centimetres from the origin."""
        return list(np.rint((as_floats(xy) - self.origin) * 100).astype(np.int64).tolist())


def recording_of(dataset: Dataset, scenario: RowArgument | None, agents: Agents) -> ReplayRecording:
    """A scenario of a release: by default the first that ends in an accident or, without any, the first one.

    Agents are as `cooperating_agents` takes them, seen from the first that is there; its errors are raised, and
    NotAvailableError if the release has no scenario.
    """
    record = dataset.scenario[
        dataset.getind("scenario", default_scenario(dataset) if scenario is None else scenario)
    ]
    chosen = cooperating_agents(
        dataset, sample_token(record["token"], agents_of(dataset, record)[0], 1), agents
    )
    contact, unknown = None, ""
    try:
        contact = collision(dataset, record)
    except NotAvailableError as error:
        unknown = str(error)
    return ReplayRecording(
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
    poses = [
        dataset.world_from(sample, "ego").translation
        for sample in dataset.samples_of(record["last_frame_token"])
    ]
    return as_floats(np.round(np.mean(poses, axis=0)[:2]))


def agent_entries(recording: ReplayRecording) -> list[dict[str, Any]]:
    """The agents as the page has them: names, colour, actor id, and one pose for each frame (cm, cm, mrad)."""
    described = []
    for agent in recording.agents:
        poses = [
            recording.dataset.world_from(recording.sample(agent, frame), "ego")
            for frame in recording.frames
        ]
        yaw = quaternions.yaw_of(np.array([pose.quaternion.elements for pose in poses]))
        places = recording.places([pose.translation[:2] for pose in poses])
        described.append(
            {
                "name": agent,
                "title": short_name(agent),
                "short": agent_letters(agent),
                "color": AGENT_COLORS[agent],
                "actor": recording.actor_of(agent),
                "poses": [
                    [*place, _milliradians(turn)]
                    for place, turn in zip(places, yaw.tolist(), strict=True)
                ],
            }
        )
    return described


def actor_entries(recording: ReplayRecording) -> list[dict[str, Any]]:
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
        range(len(ids)),
        key=lambda row: (ids[row] not in recording.pair, int(ids[row]) not in recorders, ids[row]),
    )
    return [_actor(recording, tracks, int(ids[row]), recorders, seen[row]) for row in order]


def pair_entries(recording: ReplayRecording) -> dict[str, list[int | None]] | None:
    """How near the colliding pair is at each frame: its gap (cm), and its time to collision if both go on (ds).

    As `interactions` has them, seen from above; null where one of the two is not annotated or has no known velocity,
    and where they would never touch. None if nobody collides.
    """
    if not recording.pair:
        return None
    tracks = scenario_tracks(recording.dataset, recording.scenario)
    boxes, velocity = (np.full((2, len(recording.frames), width), np.nan) for width in (5, 2))
    for place, actor in enumerate(recording.pair):
        rows = np.flatnonzero(tracks.actor_id == actor)
        own, at = tracks.boxes.select(rows), tracks.index[rows] - 1
        boxes[place, at] = np.column_stack([own.center[:, :2], own.size[:, :2], own.yaw])
        velocity[place, at] = own.velocity[:, :2]
    values = {"gap": gaps_of_pairs(*boxes) * 100, "ttc": time_to_collision(*boxes, *velocity) * 10}
    return {
        name: [round(each) if math.isfinite(each) else None for each in found.tolist()]
        for name, found in values.items()
    }


def camera_entries(recording: ReplayRecording) -> list[list[dict[str, Any]]]:
    """For each agent its cameras as the page has them, so that the page can project boxes into their pictures.

    A camera has its title, its lens (width and height of the image, fx, fy, cx, cy; pixels), and for each frame the
    pose world_from_camera, with optical axes: x, y (cm from the page's origin), z (cm), and a unit quaternion w, x, y,
    z (ten thousandths).
    """
    return [
        [_camera(recording, agent, channel) for channel in CAMERAS] for agent in recording.agents
    ]


def _camera(recording: ReplayRecording, agent: str, channel: str) -> dict[str, Any]:
    samples = [recording.sample(agent, frame) for frame in recording.frames]
    lens = recording.dataset.camera(samples[0], channel)
    poses = [recording.dataset.world_from(sample, channel) for sample in samples]
    (fx, _, cx), (_, fy, cy) = lens.intrinsic[:2].tolist()
    turns = (
        np.rint(np.array([pose.quaternion.elements for pose in poses]) * 10_000)
        .astype(int)
        .tolist()
    )
    places = recording.places([pose.translation[:2] for pose in poses])
    heights = [round(float(pose.translation[2]) * 100) for pose in poses]
    return {
        "title": camera_name(channel),
        "lens": [lens.width, lens.height, *(round(each, 2) for each in (fx, fy, cx, cy))],
        "poses": [
            [*place, height, *turn]
            for place, height, turn in zip(places, heights, turns, strict=True)
        ],
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


def _seen(recording: ReplayRecording, ids: IntArray) -> AnyArray:
    """(actors, frames) uint8: bit masks over the recording's agents."""
    seen = np.zeros((len(ids), len(recording.frames)), dtype=np.uint8)
    for bit, agent in enumerate(recording.agents):
        for column, frame in enumerate(recording.frames):
            visible = visible_actors(
                recording.dataset, recording.sample(agent, frame), agents=[agent]
            )
            seen[np.isin(ids, visible), column] |= 1 << bit
    return seen


def _milliradians(angle: float) -> int:
    return round(angle * 1000)


def foreseen_entries(recording: ReplayRecording, prediction: Foreseen) -> dict[str, Any]:
    """The foreseen accidents as the page has them: the rule in words, and each sample of the agents with a prediction.

    Instance maps given by token have the orientation of the released labels. Raises NotAvailableError if no prediction
    is of this scenario and these agents, or a sample has no label.
    """
    horizon = _horizon(prediction)
    samples = [
        _sample(recording, prediction, agent, frame, horizon)
        for frame in recording.frames
        for agent in recording.agents
        if recording.sample(agent, frame) in prediction
    ]
    if not samples:
        raise NotAvailableError(
            f"prediction: has no sample of {recording.scenario['token']} and {', '.join(recording.agents)}; "
            "choose a scenario and agents that it has, or replay without it"
        )
    rule = (
        f"Protocol boxes: an accident within {horizon:g} s counts as foreseen if the errors of the two places "
        f"are less than {ERRORS_AT:g} m in sum."
    )
    return {"rule": rule, "samples": samples}


def _horizon(prediction: Foreseen) -> float:
    form = prediction.form if isinstance(prediction, Results) else None
    return (
        RELEASED_HORIZON if form is None else min(RELEASED_HORIZON, (form.frames - 1) * form.step)
    )


def _sample(
    recording: ReplayRecording, prediction: Foreseen, agent: str, frame: int, horizon: float
) -> dict[str, Any]:
    token = recording.sample(agent, frame)
    given, label, context = _loaded(recording, prediction, token, horizon)
    truth = context.truth
    if truth is None:  # only for the type checker: a context with a horizon has a truth
        raise NotAvailableError(f"{token}: has no truth to compare with; choose a labelled sample")
    world_from_ego = recording.dataset.world_from(token, "ego")
    alarms = [
        _alarm(recording, accident, ids, context, world_from_ego)
        for accident, ids in named_alarms(given, label, truth, _RULES.reading)
    ]
    return {
        "frame": frame - 1,
        "agent": recording.agents.index(agent),
        "verdict": _verdict(given, label, context),
        "text": f"{short_name(agent)} at frame {frame}: {_truth_text(context)}",
        "alarms": sorted(alarms, key=lambda alarm: not alarm["right"])[:_SHOWN],
        "more": max(0, len(alarms) - _SHOWN),
    }


def _loaded(
    recording: ReplayRecording, prediction: Foreseen, token: str, horizon: float
) -> tuple[MotionOutput | list[Accident], MotionLabels | None, AccidentContext]:
    if isinstance(prediction, Results):
        setup = EvaluationSetup(task="accident", protocol="boxes", horizon=horizon)
        given, label, context = SampleLoader(recording.dataset, prediction, setup)(token)
        return checked_prediction(given), label, context
    return (
        checked_prediction(prediction[token]),
        None,
        accident_context(recording.dataset, token, horizon),
    )


def _verdict(given: Prediction, label: MotionLabels | None, context: AccidentContext) -> str:
    """What the sample counts as, or `not judged`."""
    counts = _RULES.counts(given, label, context)
    if counts["unjudged"] and not (counts["positive"] or counts["alarms"]):
        return "not judged"
    return count_words(_RULES.result([counts]).within[ERRORS_AT])


def _alarm(
    recording: ReplayRecording,
    accident: Accident,
    ids: Pair | None,
    context: AccidentContext,
    world_from_ego: SE3,
) -> dict[str, Any]:
    counts = _RULES.counts([accident], None, context)
    off = counts["alarms"][0] if counts["alarms"] else None
    right = bool(off and hit_of([off], ERRORS_AT))
    text = f"foreseen in {accident.time:.1f} s, score {accident.score:.2g}"
    if off and off["position"] is not None:
        text += f": places off by {off['position']:.1f} m, time by {off['time']:+.1f} s"
    elif off is None:
        text += ": it would be after the end of the recording"
    if ids is not None:
        right_two = context.pair is not None and set(ids) == set(context.pair)
        names = " and ".join("an unknown actor" if each is None else str(each) for each in ids)
        text += f"; names {names}{', who collide' if right_two else ''}"
    return {
        "places": recording.places(
            world_from_ego.apply([[x, y, 0.0] for x, y in accident.positions.tolist()])[:, :2]
        ),
        "right": right,
        "time": round(accident.time, 1),
        "text": text,
        "actors": [each for each in ids or () if each is not None],
    }


def _truth_text(context: AccidentContext) -> str:
    truth = context.truth
    if truth is None or truth.accident is None:
        return "no accident comes within the horizon"
    return f"an accident comes in {truth.accident.time:.1f} s"
