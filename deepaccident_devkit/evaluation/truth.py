"""Ground truth after a sample, for predictions of accidents, plans and paths.

`BoxTruth` has the actors' boxes at 10 Hz, `AccidentContext` all other known facts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation.map_accidents import InstanceTracks
from deepaccident_devkit.evaluation.predictions import Accident, compared_labels
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.box_arrays import gaps, time_to_collision
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.support.arrays import FloatArray, FrozenArrays, IntArray, ShortRepr
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.taxonomy import FRAME_PERIOD, INFRASTRUCTURE, OWN_ACTOR_ID
from deepaccident_devkit.v2x.collisions import labelled_pair
from deepaccident_devkit.v2x.cooperation import seen_actors
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

# Seconds that the released models look ahead.
RELEASED_HORIZON: Final = 2.0
# Half a recorded frame, within which decimal moments compare equal.
TIME_TOLERANCE_S: Final = FRAME_PERIOD / 2
UNPLACED_NOTE: Final = (
    "left out: {} of accidents of which no label shows both actors (meta names one without a "
    "label, or one twice)"
)
_BEYOND_NOTE: Final = "not counted: {} for later than the horizon"
# Metres that an actor must cover in the window to count as moving.
_MIN_MOVEMENT_M: Final = 0.5
# Predictors that foresee what constant velocities lead to: for all actors as they are, and for the
# ones that the agent itself sees by the released rule.
REFERENCES: Final = ("TTC < 3 s, true tracks", "TTC < 3 s, seen")
_DESIGNED_PAIR: Final = ("ego_vehicle", "other_vehicle")
# Seconds of time to collision below which there is an alarm.
ALARM_TIME: Final = 3.0
# Relative speeds below this, in m/s, are no danger, such as between parked cars.
_MIN_RELATIVE_SPEED: Final = 0.1
# Involvement of the recording agent: one of the colliding pair, another vehicle, or the roadside
# pole. Where nobody collides, the pair is that of the twin; without a known twin it is
# `ego_vehicle` and `other_vehicle`, which all designs lead to the impact.
Involvement = Literal["ego_involved", "bystander", "infrastructure"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxTruth(FrozenArrays):
    """The actors' boxes from a sample's present to the horizon or the recording's end; read-only.

    Attributes:
        time: (F,) float64 seconds after the present, from 0 in steps of 0.1.
        actor_id: (A,) int64, ascending.
        footprint: (F, A, 5) float64 x forward, y left, length, width, yaw in the present ego frame,
            metres and radians; NaN where nobody annotated the actor.
        accident: Accident within the horizon, by meta: the pair at the impact; None without one, or
            if it is `unplaced`.
        impact: The same at any time ahead.
        horizon: Seconds that predictions look ahead: a later alarm does not count. Infinite without
            a limit.
        unplaced: Seconds to an impact, at any time ahead, without a label of both actors, so
            that no prediction can be compared with it; None without one.
    """

    time: FloatArray
    actor_id: IntArray
    footprint: FloatArray
    accident: Accident | None
    impact: Accident | None = None
    horizon: float = math.inf
    unplaced: float | None = None

    @property
    def is_unplaced(self) -> bool:
        """Whether an `unplaced` accident comes within the horizon."""
        return self.unplaced is not None and self.unplaced <= self.horizon + TIME_TOLERANCE_S

    def tracks(self, seconds: float, frames: int) -> InstanceTracks:
        """Return the actors' centres at some frames from the present on; NaN beyond the window.

        Args:
            seconds: Seconds from one frame to the next.
            frames: Number of frames.
        """
        frame = np.rint(np.arange(frames) * seconds / FRAME_PERIOD).astype(np.int64)
        is_known = frame < len(self.time)
        center = np.full((frames, len(self.actor_id), 2), np.nan)
        center[is_known] = self.footprint[frame[is_known], :, :2]
        return InstanceTracks(identity=self.actor_id, center=center)

    def nearest_pair(self, danger_distance: float) -> tuple[int, int] | None:
        """Return the two actors that come nearest to each other; None if none come near.

        Of several pairs the earliest counts, then the one of the lowest ids. Two that both stand
        all the time, such as parked cars, do not count.

        Args:
            danger_distance: Metres; boxes must come nearer than this.
        """
        pairs = []
        moves = self._extents() >= _MIN_MOVEMENT_M
        for frame, rows in enumerate(self.footprint):
            actors = np.flatnonzero(np.isfinite(rows[:, 0]))
            positions = rows[actors, :2]
            apart = np.linalg.norm(positions[:, None] - positions, axis=-1)
            radius = np.hypot(rows[actors, 2], rows[actors, 3]) / 2
            is_near = np.triu(apart < radius[:, None] + radius + danger_distance, 1)
            is_near &= moves[actors, None] | moves[actors]
            first, second = (actors[side] for side in np.nonzero(is_near))
            if not len(first):
                continue
            first_actors, first_index = np.unique(first, return_inverse=True)
            second_actors, second_index = np.unique(second, return_inverse=True)
            gap = gaps(rows[first_actors], rows[second_actors])[first_index, second_index]
            best = int(np.argmin(gap))
            pairs.append((float(gap[best]), frame, int(first[best]), int(second[best])))
        if not pairs:
            return None
        distance, _, first_row, second_row = min(pairs)
        if distance >= danger_distance:
            return None
        return int(self.actor_id[first_row]), int(self.actor_id[second_row])

    def _extents(self) -> FloatArray:
        """Return the diagonals of the areas in which the actors' centres lie, (A,) metres."""
        centers = self.footprint[..., :2]
        missing = np.isnan(centers)
        low = np.minimum.reduce(np.where(missing, np.inf, centers), axis=0)
        high = np.maximum.reduce(np.where(missing, -np.inf, centers), axis=0)
        return np.asarray(np.linalg.norm(high - low, axis=-1))


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentContext(ShortRepr):
    """Facts on a sample that its motion labels do not have; a protocol may need some of them.

    Attributes:
        pair: Actor ids of the colliding pair, from the scenario's meta file; None if nobody
            collides, or if the pair is not `known`.
        known: Whether the pair is known; if not, `pair` None does not mean that nobody collides.
        own_actor_id: Actor id of the sample's agent; None for the roadside, or if not known.
        truth: Truth of a protocol without rasters (see `boxes`); None for other protocols.
        time_to_impact: Seconds to the recorded impact, at any time ahead; None if nobody collides,
            or not known.
        time_to_end: Seconds to the recording's last frame; None if not known.
        twin: Whether nobody collides here, but somebody does in the scenario's twin; None if that
            is not known, for example where the release has no twin of it.
        time_to_twin_impact: For a `twin`, seconds to the moment at which the twin ends in its
            accident; negative after it.
        involvement: Involvement of the recording agent; None if not known.
        references: Accidents foreseen by the predictors that every evaluation of warnings is
            compared with, by name; empty if not requested.
    """

    # the pair and the agent
    pair: tuple[int, int] | None = None
    known: bool = False
    own_actor_id: int | None = None
    truth: BoxTruth | None = None
    # times and the twin
    time_to_impact: float | None = None
    time_to_end: float | None = None
    twin: bool | None = None
    time_to_twin_impact: float | None = None
    # for warnings
    involvement: Involvement | None = None
    references: Mapping[str, tuple[Accident, ...]] = field(default_factory=dict)


def accident_context(
    dataset: Dataset, sample: RowArgument, horizon: float | None = None, *, references: bool = False
) -> AccidentContext:
    """Return the facts on a sample that its motion labels do not have, for the accident metrics.

    Args:
        dataset: The release.
        sample: Token or record.
        horizon: Seconds that the protocol `boxes` looks ahead; None leaves out what only that
            protocol needs.
        references: Whether to foresee accidents as the reference predictors do (`REFERENCES`),
            which takes a few milliseconds.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label; with a horizon also as for `box_truth`.
    """
    record = labelled_sample(dataset, sample)
    scenario = dataset.get("scenario", record["scenario_token"])
    collision = scenario["collision"]
    twin = _twin_of(dataset, scenario)
    is_twin = None
    if collision is not None:
        is_twin = False
    elif twin is not None:
        is_twin = _collides(twin)
    own_actor_id = dataset.get("agent", record["agent_token"])["actor_id"]
    involvement = _involvement(record["agent"], own_actor_id, collision, twin)
    frame = int(record["token"].rsplit("/", 1)[1])
    truth = None
    reference_alarms: dict[str, tuple[Accident, ...]] = {}
    if horizon is not None or references:
        tracks = scenario_tracks(dataset, scenario)
        if horizon is not None:
            truth = _box_truth(dataset, record, scenario, tracks, horizon)
        if references:
            reference_alarms = _references(dataset, record, tracks, own_actor_id, involvement)
    time_to_twin_impact = None
    if is_twin and twin is not None:
        time_to_twin_impact = (twin["num_frames"] - frame) * FRAME_PERIOD
    return AccidentContext(
        pair=None if collision is None else (collision["ids"][0], collision["ids"][1]),
        known=scenario["weather"] is not None,
        own_actor_id=own_actor_id,
        truth=truth,
        time_to_impact=record["time_to_impact"],
        time_to_end=record["time_to_end"],
        twin=is_twin,
        time_to_twin_impact=time_to_twin_impact,
        involvement=involvement,
        references=reference_alarms,
    )


def compared_facts(
    dataset: Dataset, token: str, rules: Any, form: Any, horizon: float, *, references: bool = False
) -> tuple[MotionLabels | None, AccidentContext]:
    """Return what predictions of accidents are compared with.

    These are `compared_labels` by the rules, and `accident_context`.
    """
    labels = compared_labels(dataset, token, rules, form, horizon)
    return labels, accident_context(dataset, token, horizon, references=references)


def box_truth(dataset: Dataset, sample: RowArgument, horizon: float = RELEASED_HORIZON) -> BoxTruth:
    """Return the boxes after a sample, from the labels of all agents of the release.

    The pair is meta's, and the moment the recording's last frame, which in an accident scenario is
    the impact. Each of the two is at its last annotated position up to then: at that frame, except
    in partial labels.

    Args:
        dataset: The release.
        sample: Token or record of the present.
        horizon: Seconds to look ahead.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or the scenario has no meta file.
    """
    record = labelled_sample(dataset, sample)
    scenario = dataset.get("scenario", record["scenario_token"])
    return _box_truth(dataset, record, scenario, scenario_tracks(dataset, scenario), horizon)


def _box_truth(
    dataset: Dataset,
    record: Mapping[str, Any],
    scenario: Mapping[str, Any],
    tracks: ScenarioTracks,
    horizon: float,
) -> BoxTruth:
    """Return `box_truth` from a sample's record and its scenario's tracks."""
    if scenario["weather"] is None:
        raise NotAvailableError(
            f"{scenario['token']} has no meta file, which names the colliding pair; unpack meta"
        )
    present = int(record["token"].rsplit("/", 1)[1])
    boxes = tracks.boxes.transform(dataset.world_from(record["token"], "ego").inverse(), "ego")
    footprints = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    last = min(scenario["num_frames"], present + round(horizon / FRAME_PERIOD))
    is_within = (tracks.index >= present) & (tracks.index <= last)
    actors, actor_index = np.unique(tracks.actor_id[is_within], return_inverse=True)
    footprint = np.full((last - present + 1, len(actors), 5), np.nan)
    footprint[tracks.index[is_within] - present, actor_index] = footprints[is_within]
    ahead = record["time_to_impact"]
    pair = labelled_pair(scenario["collision"], tracks.actor_id)
    impact = None
    if ahead is not None and pair is not None:
        rows = [np.flatnonzero(tracks.actor_id == actor)[-1] for actor in pair]
        impact = Accident(positions=footprints[rows, :2], time=ahead, ids=pair)
    is_ahead = impact is not None and not impact.time > horizon + TIME_TOLERANCE_S
    return BoxTruth(
        time=np.arange(last - present + 1) * FRAME_PERIOD,
        actor_id=actors,
        footprint=footprint,
        accident=impact if is_ahead else None,
        impact=impact,
        horizon=horizon,
        unplaced=ahead if impact is None else None,
    )


def checked_facts(label: object, context: object) -> None:
    """Check that a sample's truth is labels and a context, or None; raises EvaluationError."""
    facts = (("label", label, MotionLabels), ("context", context, AccidentContext))
    for name, fact, kind in facts:
        if fact is not None and not isinstance(fact, kind):
            raise EvaluationError(
                f"{name}: expected {kind.__name__} or None, found {type(fact).__name__}; give what "
                "dataset.motion_labels(token) has as label, accident_context(dataset, sample, "
                "horizon=2.0) as context"
            )


def not_counted_notes(unplaced: int, beyond: int) -> list[str]:
    """Return sentences on samples of unplaced accidents and on alarms beyond the horizon."""
    counts = ((UNPLACED_NOTE, unplaced, "sample"), (_BEYOND_NOTE, beyond, "alarm"))
    return [note.format(counted(count, noun)) for note, count, noun in counts if count]


def labelled_sample(dataset: Dataset, sample: RowArgument) -> Any:
    """Return a sample's record.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label.
    """
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label (the test split ships without), so that nothing can "
            "be evaluated; "
            "choose a labelled sample"
        )
    return record


def _twin_of(dataset: Dataset, scenario: Mapping[str, Any]) -> Any:
    """Return the scenario of the same family and name with the other ending.

    None if there is none, or if one of the two has no meta file, so that endings are not known.
    """
    twin = twin_of(dataset, scenario["token"])
    if twin is None or scenario["weather"] is None or twin["weather"] is None:
        return None
    return twin


def _collides(scenario: Mapping[str, Any] | None) -> bool:
    """Return whether somebody collides in a scenario; False for None."""
    return scenario is not None and scenario["collision"] is not None


def _involvement(
    agent: str,
    own_actor_id: int | None,
    collision: Mapping[str, Any] | None,
    twin: Mapping[str, Any] | None,
) -> Involvement:
    """Return the involvement of an agent in its scenario's accident, or in that of the twin."""
    if agent == INFRASTRUCTURE:
        return "infrastructure"
    if collision is not None:
        involved = own_actor_id in collision["ids"]
    else:
        pair: Sequence[str | None] = _DESIGNED_PAIR
        if twin is not None and _collides(twin):
            pair = twin["collision"]["agents"] or _DESIGNED_PAIR
        involved = agent in pair
    return "ego_involved" if involved else "bystander"


def _references(
    dataset: Dataset,
    sample: Mapping[str, Any],
    tracks: ScenarioTracks,
    own_actor_id: int | None,
    involvement: Involvement,
) -> dict[str, tuple[Accident, ...]]:
    """Return the accidents that constant velocities lead to, in the present ego frame.

    For an involved agent only pairs that include it count.
    """
    present = int(sample["token"].rsplit("/", 1)[1])
    ego_from_world = dataset.world_from(sample["token"], "ego").inverse()
    visible = seen_actors(dataset, sample["token"])
    boxes_by_reference = (tracks.at(present).transform(ego_from_world, "ego"), visible.boxes)
    own = own_actor_id if involvement == "ego_involved" else None
    alarms = {}
    for name, boxes in zip(REFERENCES, boxes_by_reference, strict=True):
        alarms[name] = constant_velocity_alarms(boxes, {OWN_ACTOR_ID: own_actor_id}, own)
    return alarms


def constant_velocity_alarms(
    boxes: Boxes, names: Mapping[int, int | None], own: int | None
) -> tuple[Accident, ...]:
    """Return the pairs of actors with a time to collision below 3 s, the soonest first.

    Args:
        boxes: N actors at the present, in its ego frame, with velocities over the ground; actors
            with unknown ones stand.
        names: Actor ids that stand for others: a label's own row, −100; None if the actor is not
            known.
        own: Actor that must be in the pair; None for any pair.

    Returns:
        Accidents with positions at the contact; the score falls from 1 at the contact to 0 at 3 s.
    """
    ids = [names.get(actor, actor) for actor in boxes.actor_id.tolist()]
    velocity = np.nan_to_num(boxes.velocity[:, :2])
    first, second = np.triu_indices(len(ids), 1)
    relative_speed = np.linalg.norm(velocity[second] - velocity[first], axis=1)
    is_candidate = relative_speed >= _MIN_RELATIVE_SPEED
    if own is not None:
        is_own = np.array([actor == own for actor in ids], dtype=bool)
        is_candidate &= is_own[first] | is_own[second]
    first = first[is_candidate]
    second = second[is_candidate]
    footprint = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    seconds = time_to_collision(
        footprint[first], footprint[second], velocity[first], velocity[second]
    )
    alarmed = np.flatnonzero(seconds < ALARM_TIME)
    soonest_first = alarmed[np.argsort(seconds[alarmed], kind="stable")]
    alarms = []
    for row in soonest_first:
        pair = [int(first[row]), int(second[row])]
        first_id = ids[pair[0]]
        second_id = ids[pair[1]]
        alarm = Accident(
            positions=boxes.center[pair, :2] + velocity[pair] * seconds[row],
            time=float(seconds[row]),
            score=1 - float(seconds[row]) / ALARM_TIME,
            ids=None if first_id is None or second_id is None else (first_id, second_id),
        )
        alarms.append(alarm)
    return tuple(alarms)
