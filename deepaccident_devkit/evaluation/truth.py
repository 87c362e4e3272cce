"""Ground truth after a sample, for predictions of accidents, plans and paths.

`BoxTruth` has the actors' boxes at 10 Hz, `AccidentContext` has all other known facts.
"""

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
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD, INFRASTRUCTURE, OWN_ACTOR_ID
from deepaccident_devkit.v2x.collisions import labelled_pair
from deepaccident_devkit.v2x.cooperation import seen_actors
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

# Seconds that the released models look ahead.
RELEASED_HORIZON: Final = 2.0
# Seconds before the current frame that pictures of paths show.
_PAST_SECONDS = 1.0
# Half a recorded frame; times that differ by less are treated as equal.
TIME_TOLERANCE_S: Final = FRAME_PERIOD / 2
UNPLACED_NOTE: Final = (
    "excluded: {} of accidents in which no label shows both colliders (the meta file names an "
    "actor without a label, or one actor twice)"
)
_BEYOND_NOTE = "not counted: {} of an accident beyond the horizon"
# An actor counts as moving if its path in the window extends at least this far.
_MIN_MOVEMENT_M = 0.5
# Reference predictors, which extrapolate actors at constant velocity: the first all actors, the
# second only those that the agent itself sees by the released rule.
REFERENCES: Final = ("TTC < 3 s, true tracks", "TTC < 3 s, seen")
_DESIGNED_PAIR = ("ego_vehicle", "other_vehicle")
# A time to collision below this raises an alarm, seconds.
ALARM_TIME: Final = 3.0
# Pairs with a lower relative speed, such as parked cars, are not in danger.
_MIN_RELATIVE_SPEED_MPS = 0.1
# Involvement of the recording agent: one of the colliding pair, another vehicle, or the
# infrastructure. If there is no collision, the twin's pair is used. If no twin is known, the pair
# is `ego_vehicle` and `other_vehicle`, which every scenario is designed to make collide.
Involvement = Literal["ego_involved", "bystander", "infrastructure"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxTruth(FrozenArrays):
    """The actors' boxes from a sample's frame to the horizon, or to the recording's end.

    Arrays are read-only.

    Attributes:
        time: (F,) float64 seconds after the current frame, from 0 in steps of 0.1.
        actor_id: (A,) int64 ids of the actors, ascending.
        footprint: (F, A, 5) float64 x forward, y left, length, width, yaw in the current ego frame,
            metres and radians; NaN where no agent annotated the actor.
        accident: Accident within the horizon, from the meta file: the pair at the impact; None if
            there is no accident, or if it is `unplaced`.
        impact: Accident at any time ahead, also beyond the horizon; None as for `accident`.
        horizon: Seconds that predictions look ahead; alarms that predict an accident beyond it do
            not count. Infinite if there is no limit.
        unplaced: Seconds to an impact, at any time ahead, that cannot be compared with predictions,
            since labels do not show both actors; None without such an impact.
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
        if self.unplaced is None:
            return False
        return self.unplaced <= self.horizon + TIME_TOLERANCE_S

    def tracks(self, seconds: float, frames: int) -> InstanceTracks:
        """Return the actors' centres in frames from t = 0 on; NaN after the window's end.

        Args:
            seconds: Seconds from one frame to the next.
            frames: Number of frames.
        """
        recorded_frames = np.arange(frames) * seconds / FRAME_PERIOD
        frame = np.rint(recorded_frames).astype(np.int64)
        is_known = frame < len(self.time)
        center = np.full((frames, len(self.actor_id), 2), np.nan)
        center[is_known] = self.footprint[frame[is_known], :, :2]
        return InstanceTracks(identity=self.actor_id, center=center)

    def nearest_pair(self, danger_distance: float) -> tuple[int, int] | None:
        """Return the ids of the two actors that come nearest to each other; None if none come near.

        If pairs come equally near, the earliest counts, then the one with the lowest ids. Two
        actors that both stand still, such as parked cars, are ignored.

        Args:
            danger_distance: Boxes must come nearer to each other than this, metres.
        """
        pairs = []
        is_moving = self._extents() >= _MIN_MOVEMENT_M
        for frame, footprints in enumerate(self.footprint):
            actors = np.flatnonzero(np.isfinite(footprints[:, 0]))
            positions = footprints[actors, :2]
            length, width = footprints[actors, 2:4].T
            distances = np.linalg.norm(positions[:, None] - positions, axis=-1)
            radius = np.hypot(length, width) / 2
            is_near = np.triu(distances < radius[:, None] + radius + danger_distance, 1)
            is_near &= is_moving[actors, None] | is_moving[actors]
            first, second = np.nonzero(is_near)
            if not len(first):
                continue
            first_actors, first_index = np.unique(actors[first], return_inverse=True)
            second_actors, second_index = np.unique(actors[second], return_inverse=True)
            all_gaps = gaps(footprints[first_actors], footprints[second_actors])
            pair_gaps = all_gaps[first_index, second_index]
            best_row = int(np.argmin(pair_gaps))
            pair = int(actors[first[best_row]]), int(actors[second[best_row]])
            pairs.append((float(pair_gaps[best_row]), frame, *pair))
        if not pairs:
            return None
        distance, _, first_row, second_row = min(pairs)
        if distance >= danger_distance:
            return None
        return int(self.actor_id[first_row]), int(self.actor_id[second_row])

    def _extents(self) -> FloatArray:
        """Return the diagonal of the area that each actor's centres cover, (A,) metres."""
        centers = self.footprint[..., :2]
        is_missing = np.isnan(centers)
        low = np.minimum.reduce(np.where(is_missing, np.inf, centers), axis=0)
        high = np.maximum.reduce(np.where(is_missing, -np.inf, centers), axis=0)
        return np.asarray(np.linalg.norm(high - low, axis=-1))


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentContext(ShortRepr):
    """Facts about a sample that a protocol may need, but that are not in its motion labels.

    Attributes:
        pair: Actor ids of the colliding pair, from the scenario's meta file; None if there is no
            collision, or if the pair is not `known`.
        known: Whether it is known which actors collide, if any; if not, a `pair` of None does not
            mean that there is no collision.
        own_actor_id: Actor id of the sample's agent; None for the infrastructure, or if unknown.
        truth: Boxes for protocols that compare boxes instead of maps; None for other protocols.
        time_to_impact: Seconds to the recorded impact, at any time ahead; None if there is no
            collision, or if unknown.
        time_to_end: Seconds to the recording's last frame; None if unknown.
        twin: Whether there is no collision here, but there is one in the scenario's twin; None if
            unknown, for example if the release does not have the twin.
        time_to_twin_impact: If `twin` is True, seconds to the time of the twin's impact; negative
            after the impact.
        involvement: Involvement of the recording agent; None if unknown.
        references: Name of a reference predictor → accidents that it foresees; empty if not
            requested.
    """

    # facts about the pair and the agent
    pair: tuple[int, int] | None = None
    known: bool = False
    own_actor_id: int | None = None
    truth: BoxTruth | None = None
    # facts about times and the twin
    time_to_impact: float | None = None
    time_to_end: float | None = None
    twin: bool | None = None
    time_to_twin_impact: float | None = None
    # facts for evaluations of warnings
    involvement: Involvement | None = None
    references: Mapping[str, tuple[Accident, ...]] = field(default_factory=dict)


def accident_context(
    dataset: Dataset, sample: RowArgument, horizon: float | None = None, *, references: bool = False
) -> AccidentContext:
    """Collect the facts about a sample that accident metrics need in addition to motion labels.

    Args:
        dataset: Release with the sample.
        sample: Token or record of the sample.
        horizon: Seconds that the protocol `boxes` looks ahead; None leaves out the boxes, which
            only this protocol needs.
        references: Whether to add the accidents that the reference predictors foresee
            (`REFERENCES`), which takes a few milliseconds.

    Raises:
        TokenError: If the release does not have the sample.
        NotAvailableError: If the sample has no label; with a horizon, also if the scenario has no
            meta file.
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
    frame = _frame_number(record)
    truth = None
    reference_alarms: dict[str, tuple[Accident, ...]] = {}
    if horizon is not None or references:
        tracks = scenario_tracks(dataset, scenario)
        if horizon is not None:
            truth = _make_box_truth(dataset, record, scenario, tracks, horizon)
        if references:
            reference_alarms = _foresee_accidents(
                dataset, record, tracks, own_actor_id, involvement
            )
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
    """Load what predictions of accidents are compared with: motion labels and a context.

    See `compared_labels` and `accident_context` for the arguments.
    """
    labels = compared_labels(dataset, token, rules, form, horizon)
    return labels, accident_context(dataset, token, horizon, references=references)


def box_truth(dataset: Dataset, sample: RowArgument, horizon: float = RELEASED_HORIZON) -> BoxTruth:
    """Collect the boxes from a sample's frame on, from the labels of all agents in the release.

    The colliding pair is taken from the meta file, and the impact is in the recording's last frame.
    The positions of the pair are the last annotated ones; they are in the last frame, unless labels
    are incomplete.

    Args:
        dataset: Release with the sample.
        sample: Token or record of the sample.
        horizon: Seconds to look ahead.

    Raises:
        TokenError: If the release does not have the sample.
        NotAvailableError: If the sample has no label, or the scenario has no meta file.
    """
    record = labelled_sample(dataset, sample)
    scenario = dataset.get("scenario", record["scenario_token"])
    tracks = scenario_tracks(dataset, scenario)
    return _make_box_truth(dataset, record, scenario, tracks, horizon)


def _make_box_truth(
    dataset: Dataset,
    record: ReadOnlyValues,
    scenario: ReadOnlyValues,
    tracks: ScenarioTracks,
    horizon: float,
) -> BoxTruth:
    """Build the boxes from a sample's frame on, from its record and its scenario's tracks."""
    if scenario["weather"] is None:
        raise NotAvailableError(
            f"{scenario['token']} has no meta file, which names the colliding pair; unpack meta"
        )
    present = _frame_number(record)
    ego_from_world = dataset.world_from(record["token"], "ego").inverse()
    boxes = tracks.boxes.transform(ego_from_world, "ego")
    footprints = _footprints(boxes)
    last = min(scenario["num_frames"], present + round(horizon / FRAME_PERIOD))
    is_within = (tracks.index >= present) & (tracks.index <= last)
    actors, actor_index = np.unique(tracks.actor_id[is_within], return_inverse=True)
    footprint = np.full((last - present + 1, len(actors), 5), np.nan)
    footprint[tracks.index[is_within] - present, actor_index] = footprints[is_within]
    time_to_impact = record["time_to_impact"]
    pair = labelled_pair(scenario["collision"], tracks.actor_id)
    impact = None
    if time_to_impact is not None and pair is not None:
        rows = [np.flatnonzero(tracks.actor_id == actor)[-1] for actor in pair]
        impact = Accident(positions=footprints[rows, :2], time=time_to_impact, ids=pair)
    accident = impact
    if impact is not None and impact.time > horizon + TIME_TOLERANCE_S:
        accident = None
    return BoxTruth(
        time=np.arange(last - present + 1) * FRAME_PERIOD,
        actor_id=actors,
        footprint=footprint,
        accident=accident,
        impact=impact,
        horizon=horizon,
        unplaced=time_to_impact if impact is None else None,
    )


def _footprints(boxes: Boxes) -> FloatArray:
    """Return x, y, length, width and yaw of N boxes, shape (N, 5)."""
    positions = boxes.center[:, :2]
    length_and_width = boxes.size[:, :2]
    return np.column_stack([positions, length_and_width, boxes.yaw])


def _frame_number(sample: ReadOnlyValues) -> int:
    """Return the number (from 1) of a sample's frame in its scenario."""
    _, _, frame = sample["token"].rpartition("/")
    return int(frame)


def checked_facts(label: object, context: object) -> None:
    """Raise EvaluationError if labels or context have the wrong type; both may be None."""
    facts = (("label", label, MotionLabels), ("context", context, AccidentContext))
    for name, fact, kind in facts:
        if fact is not None and not isinstance(fact, kind):
            raise EvaluationError(
                f"{name}: expected {kind.__name__} or None, found {type(fact).__name__}; as "
                "label, give dataset.motion_labels(token); as context, give "
                "accident_context(dataset, sample, horizon=2.0)"
            )


def not_counted_notes(unplaced: int, beyond: int) -> list[str]:
    """Return notes about what is not counted.

    Args:
        unplaced: Number of samples with an unplaced accident.
        beyond: Number of alarms that predict an accident beyond the horizon.
    """
    notes = []
    if unplaced:
        notes.append(UNPLACED_NOTE.format(counted(unplaced, "sample")))
    if beyond:
        notes.append(_BEYOND_NOTE.format(counted(beyond, "alarm")))
    return notes


def labelled_sample(dataset: Dataset, sample: RowArgument) -> Any:
    """Return a sample's record, and check that the sample has a label.

    Raises:
        TokenError: If the release does not have the sample.
        NotAvailableError: If the sample has no label.
    """
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label (the test split has none), so it cannot be "
            "evaluated; choose a labelled sample"
        )
    return record


def _twin_of(dataset: Dataset, scenario: ReadOnlyValues) -> Any:
    """Return the twin of a scenario, which has the same design and name but ends differently.

    Return None if there is no twin, or if one of the two has no meta file, which states how a
    scenario ends.
    """
    twin = twin_of(dataset, scenario["token"])
    if twin is None or scenario["weather"] is None or twin["weather"] is None:
        return None
    return twin


def _collides(scenario: ReadOnlyValues | None) -> bool:
    """Return whether there is a collision in a scenario; False if the scenario is None."""
    return scenario is not None and scenario["collision"] is not None


def _involvement(
    agent: str,
    own_actor_id: int | None,
    collision: ReadOnlyValues | None,
    twin: ReadOnlyValues | None,
) -> Involvement:
    """Return the involvement of an agent in the accident of its scenario, or of the twin."""
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


def _foresee_accidents(
    dataset: Dataset,
    sample: ReadOnlyValues,
    tracks: ScenarioTracks,
    own_actor_id: int | None,
    involvement: Involvement,
) -> dict[str, tuple[Accident, ...]]:
    """Predict accidents with each reference predictor, in the current ego frame.

    If the agent is involved in the accident, only pairs that include the agent count.
    """
    ego_from_world = dataset.world_from(sample["token"], "ego").inverse()
    seen_boxes = seen_actors(dataset, sample["token"]).boxes
    all_boxes = tracks.at(_frame_number(sample)).transform(ego_from_world, "ego")
    required_actor = None
    if involvement == "ego_involved":
        required_actor = own_actor_id
    names = {OWN_ACTOR_ID: own_actor_id}
    alarms = {}
    for reference, boxes in zip(REFERENCES, (all_boxes, seen_boxes), strict=True):
        alarms[reference] = constant_velocity_alarms(boxes, names, required_actor)
    return alarms


def constant_velocity_alarms(
    boxes: Boxes, names: Mapping[int, int | None], own: int | None
) -> tuple[Accident, ...]:
    """Predict an accident for each pair whose time to collision is below 3 s, soonest first.

    Args:
        boxes: Boxes of N actors in the current ego frame, with velocities over the ground; actors
            with unknown velocities count as standing.
        names: Id in the boxes → actor id, for ids that differ from the actor's, such as −100 for
            the agent itself; None if the actor is unknown.
        own: Id of an actor that must be in the pair; None for any pair.

    Returns:
        Accidents with the positions at the contact. The score decreases from 1 for a contact now to
        0 for a contact in 3 s.
    """
    ids = [names.get(actor, actor) for actor in boxes.actor_id.tolist()]
    velocity = np.nan_to_num(boxes.velocity[:, :2])
    first, second = np.triu_indices(len(ids), 1)
    relative_speed = np.linalg.norm(velocity[second] - velocity[first], axis=1)
    is_candidate = relative_speed >= _MIN_RELATIVE_SPEED_MPS
    if own is not None:
        is_own = np.array([actor == own for actor in ids], dtype=bool)
        is_candidate &= is_own[first] | is_own[second]
    first = first[is_candidate]
    second = second[is_candidate]
    footprint = _footprints(boxes)
    times_to_collision = time_to_collision(
        footprint[first], footprint[second], velocity[first], velocity[second]
    )
    alarmed = np.flatnonzero(times_to_collision < ALARM_TIME)
    soonest_first = alarmed[np.argsort(times_to_collision[alarmed], kind="stable")]
    alarms = []
    for row in soonest_first.tolist():
        seconds = times_to_collision.item(row)
        pair = [first.item(row), second.item(row)]
        first_id = ids[pair[0]]
        second_id = ids[pair[1]]
        pair_ids = None
        if first_id is not None and second_id is not None:
            pair_ids = first_id, second_id
        alarm = Accident(
            positions=boxes.center[pair, :2] + velocity[pair] * seconds,
            time=seconds,
            score=1 - seconds / ALARM_TIME,
            ids=pair_ids,
        )
        alarms.append(alarm)
    return tuple(alarms)


def recorded_past(dataset: Dataset, token: str, actor_ids: IntArray) -> FloatArray:
    """Return where actors were in the last second, for pictures.

    Args:
        dataset: Release with the sample.
        token: Token of the sample.
        actor_ids: (A,) ids of the actors, ascending.

    Returns:
        Centres, shape (A, P, 2), metres in the current ego frame, at steps of 0.1 s up to the
        current frame; NaN where no agent annotated the actor.
    """
    record = dataset.get("sample", token)
    tracks = scenario_tracks(dataset, record["scenario_token"])
    frame = int(token.rsplit("/", 1)[1])
    frame_count = round(_PAST_SECONDS / FRAME_PERIOD) + 1
    first_frame = frame - frame_count + 1
    start, end = tracks.index.searchsorted((first_frame, frame + 1))
    rows = np.arange(start, end)
    rows = rows[np.isin(tracks.actor_id[rows], actor_ids)]
    actor_index = actor_ids.searchsorted(tracks.actor_id[rows])
    ego_from_world = dataset.world_from(token, "ego").inverse()
    past = np.full((len(actor_ids), frame_count, 2), np.nan)
    centers = ego_from_world.apply(tracks.boxes.center[rows])
    past[actor_index, tracks.index[rows] - first_frame] = centers[:, :2]
    return past
