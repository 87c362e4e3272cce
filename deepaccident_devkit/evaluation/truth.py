"""What really happens after a sample: what predictions of accidents, plans and paths are compared with.

`BoxTruth` has the actors' boxes at 10 Hz, `AccidentContext` all else that is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np

from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation.map_accidents import (
    InstanceTracks,
)
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
# Seconds: half a recorded frame, so that decimal moments compare as they are meant.
SLACK: Final = FRAME_PERIOD / 2
UNPLACED_NOTE: Final = "left out: {} of accidents of which no label shows both actors (meta names one without a label, or one twice)"
_BEYOND_NOTE: Final = "not counted: {} for later than the horizon"
# Metres that an actor must cover in the window to count as moving.
_MOVES: Final = 0.5
# Of the agent whose recording it is: one of the pair that collides, a vehicle that is not, or the roadside pole.
# Where nobody collides, of the pair of the twin; without a known twin `ego_vehicle` and `other_vehicle`, whom all
# designs lead to the impact, are taken for the pair.
Involvement = Literal["ego_involved", "bystander", "infrastructure"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoxTruth(FrozenArrays):
    """The actors' boxes from a sample's present to the horizon or the recording's end; arrays are read-only.

    Attributes:
        time: (F,) float64 seconds after the present, from 0 in steps of 0.1.
        actor_id: (A,) int64, ascending.
        footprint: (F, A, 5) float64 x forward, y left, length, width, yaw in the present ego frame, metres and radians;
            NaN where nobody annotated the actor.
        accident: the accident within the horizon, by meta: the pair at the impact; None without one, or if it is
            `unplaced`.
        impact: the same at any time ahead.
        horizon: seconds that predictions look ahead: a later alarm does not count. Infinite without a limit.
        unplaced: seconds to an impact, at any time ahead, of which no label shows both actors, so that no prediction
            can be compared with it; None without one.
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
        """Whether an accident comes within the horizon that is `unplaced`."""
        return self.unplaced is not None and self.unplaced <= self.horizon + SLACK

    def tracks(self, seconds: float, frames: int) -> InstanceTracks:
        """The actors' centres at so many frames, so many seconds apart, from the present on; NaN beyond the window."""
        frame = np.rint(np.arange(frames) * seconds / FRAME_PERIOD).astype(np.int64)
        there = frame < len(self.time)
        center = np.full((frames, len(self.actor_id), 2), np.nan)
        center[there] = self.footprint[frame[there], :, :2]
        return InstanceTracks(identity=self.actor_id, center=center)

    def nearest_pair(self, danger_distance: float) -> tuple[int, int] | None:
        """The two whose boxes come nearest to each other, nearer than a distance; the earliest of several, by id.

        Two that both stand all the time, such as parked cars, do not count.
        """
        found = []
        x_and_y = self.footprint[..., :2]
        low, high = (
            edge.reduce(np.where(np.isnan(x_and_y), empty, x_and_y), axis=0)
            for edge, empty in ((np.minimum, np.inf), (np.maximum, -np.inf))
        )
        moves = np.linalg.norm(high - low, axis=-1) >= _MOVES
        for frame, rows in enumerate(self.footprint):
            here = np.flatnonzero(np.isfinite(rows[:, 0]))
            apart = np.linalg.norm(rows[here, None, :2] - rows[here, :2], axis=-1)
            reach = np.hypot(rows[here, 2], rows[here, 3]) / 2
            near = np.triu(apart < reach[:, None] + reach + danger_distance, 1)
            near &= moves[here, None] | moves[here]
            first, second = (here[side] for side in np.nonzero(near))
            if len(first):
                gap = gaps(rows[np.unique(first)], rows[np.unique(second)])
                gap = gap[
                    np.unique(first, return_inverse=True)[1],
                    np.unique(second, return_inverse=True)[1],
                ]
                best = int(np.argmin(gap))
                found.append((float(gap[best]), frame, int(first[best]), int(second[best])))
        if not found or min(found)[0] >= danger_distance:
            return None
        *_, one, other = min(found)
        return int(self.actor_id[one]), int(self.actor_id[other])


# Predictors that foresee what constant velocities lead to: of all actors as they are, and of those that the agent
# itself sees by the released rule.
REFERENCES: Final = ("TTC < 3 s, true tracks", "TTC < 3 s, seen")
_DESIGNED_PAIR: Final = ("ego_vehicle", "other_vehicle")


@dataclass(frozen=True, slots=True, kw_only=True)
class AccidentContext(ShortRepr):
    """Facts on a sample that its motion labels do not have; a protocol may need some of them.

    Attributes:
        pair: actor ids of the two that collide, from the scenario's meta file; None if nobody does, or if it is not
            `known`.
        known: whether the pair is known; if not, `pair` None does not mean that nobody collides.
        own_actor_id: the actor id of the agent whose sample it is; None for the roadside, or if not known.
        truth: what a protocol without rasters compares with (see `boxes`); None for the others.
        time_to_impact: seconds to the recorded impact, at any time ahead; None if nobody collides, or not known.
        time_to_end: seconds to the recording's last frame; None if not known.
        twin: whether nobody collides here, but somebody does in the scenario's twin; None if that is not known, such
            as where the release has no twin of it.
        time_to_twin_impact: where `twin`, seconds to the moment at which the twin ends in its accident; negative after.
        involvement: whose recording it is; None if not known.
        references: what the predictors foresee that every evaluation of warnings is compared with, by name; empty if
            not asked for.
    """

    pair: tuple[int, int] | None = None
    known: bool = False
    own_actor_id: int | None = None
    truth: BoxTruth | None = None
    time_to_impact: float | None = None
    time_to_end: float | None = None
    twin: bool | None = None
    time_to_twin_impact: float | None = None
    involvement: Involvement | None = None
    references: Mapping[str, tuple[Accident, ...]] = field(default_factory=dict)


def accident_context(
    dataset: Dataset, sample: RowArgument, horizon: float | None = None, *, references: bool = False
) -> AccidentContext:
    """The facts on a sample that its motion labels do not have, for the accident metrics.

    Args:
        dataset: the release.
        sample: token or record.
        horizon: seconds that the protocol `boxes` looks ahead; None leaves out what only that protocol needs.
        references: whether to foresee what the reference predictors do (`REFERENCES`), which takes some milliseconds.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label; with a horizon also as of `box_truth`.
    """
    there = labelled_sample(dataset, sample)
    scenario = dataset.get("scenario", there["scenario_token"])
    collision, other = scenario["collision"], _twin_of(dataset, scenario)
    twin = None if collision is None and other is None else collision is None and _collides(other)
    own_actor_id = dataset.get("agent", there["agent_token"])["actor_id"]
    involvement = _involvement(there["agent"], own_actor_id, collision, other)
    present = int(there["token"].rsplit("/", 1)[1])
    tracks = scenario_tracks(dataset, scenario) if horizon is not None or references else None
    return AccidentContext(
        pair=None if collision is None else (collision["ids"][0], collision["ids"][1]),
        known=scenario["weather"] is not None,
        own_actor_id=own_actor_id,
        truth=None
        if horizon is None or tracks is None
        else _box_truth(dataset, there, scenario, tracks, horizon),
        time_to_impact=there["time_to_impact"],
        time_to_end=there["time_to_end"],
        twin=twin,
        time_to_twin_impact=(other["num_frames"] - present) * FRAME_PERIOD
        if twin and other is not None
        else None,
        involvement=involvement,
        references=(
            {}
            if not references or tracks is None
            else _references(dataset, there, tracks, own_actor_id, involvement)
        ),
    )


def compared_facts(
    dataset: Dataset, token: str, rules: Any, form: Any, horizon: float, *, references: bool = False
) -> tuple[MotionLabels | None, AccidentContext]:
    """What predictions of accidents are compared with: `compared_labels` by these rules, and `accident_context`."""
    labels = compared_labels(dataset, token, rules, form, horizon)
    return labels, accident_context(dataset, token, horizon, references=references)


def box_truth(dataset: Dataset, sample: RowArgument, horizon: float = RELEASED_HORIZON) -> BoxTruth:
    """What happens after a sample, from the labels of all agents of the release.

    The pair is meta's, and the moment the recording's last frame, which in an accident scenario is the impact. Each of
    the two is where it was last annotated up to then: at that frame, except in partial labels.

    Args:
        dataset: the release.
        sample: token or record of the present.
        horizon: seconds to look ahead.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or the scenario has no meta file.
    """
    there = labelled_sample(dataset, sample)
    scenario = dataset.get("scenario", there["scenario_token"])
    return _box_truth(dataset, there, scenario, scenario_tracks(dataset, scenario), horizon)


def _box_truth(
    dataset: Dataset,
    there: Mapping[str, Any],
    scenario: Mapping[str, Any],
    tracks: ScenarioTracks,
    horizon: float,
) -> BoxTruth:
    """`box_truth` of a sample whose scenario's tracks are read."""
    if scenario["weather"] is None:
        raise NotAvailableError(
            f"{scenario['token']} has no meta file, which names the colliding pair; unpack meta"
        )
    present = int(there["token"].rsplit("/", 1)[1])
    boxes = tracks.boxes.transform(dataset.world_from(there["token"], "ego").inverse(), "ego")
    footprints = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    last = min(scenario["num_frames"], present + round(horizon / FRAME_PERIOD))
    inside = (tracks.index >= present) & (tracks.index <= last)
    actors, which = np.unique(tracks.actor_id[inside], return_inverse=True)
    footprint = np.full((last - present + 1, len(actors), 5), np.nan)
    footprint[tracks.index[inside] - present, which] = footprints[inside]
    ahead, pair, impact = (
        there["time_to_impact"],
        labelled_pair(scenario["collision"], tracks.actor_id),
        None,
    )
    if ahead is not None and pair is not None:
        rows = [np.flatnonzero(tracks.actor_id == actor)[-1] for actor in pair]
        impact = Accident(positions=footprints[rows, :2], time=ahead, ids=pair)
    return BoxTruth(
        time=np.arange(last - present + 1) * FRAME_PERIOD,
        actor_id=actors,
        footprint=footprint,
        accident=None if impact is None or impact.time > horizon + SLACK else impact,
        impact=impact,
        horizon=horizon,
        unplaced=ahead if impact is None else None,
    )


def checked_facts(label: object, context: object) -> None:
    """Whether a sample's truth is given as labels and context, either of which may be None; raises EvaluationError."""
    for name, given, kind in (
        ("label", label, MotionLabels),
        ("context", context, AccidentContext),
    ):
        if given is not None and not isinstance(given, kind):
            raise EvaluationError(
                f"{name}: expected {kind.__name__} or None, found {type(given).__name__}; give what "
                "dataset.motion_labels(token) has as label, accident_context(dataset, sample, horizon=2.0) as context"
            )


def not_counted_notes(unplaced: int, beyond: int) -> list[str]:
    """Say how many samples of unplaced accidents are left out, and how many alarms are for later than the horizon."""
    counts = ((UNPLACED_NOTE, unplaced, "sample"), (_BEYOND_NOTE, beyond, "alarm"))
    return [note.format(counted(count, noun)) for note, count, noun in counts if count]


def labelled_sample(dataset: Dataset, sample: RowArgument) -> Any:
    """A sample's record; raises TokenError, and NotAvailableError if it has no label."""
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label (the test split ships without), so that nothing can be evaluated; "
            "choose a labelled sample"
        )
    return record


def _twin_of(dataset: Dataset, scenario: Mapping[str, Any]) -> Any:
    """The scenario of the same family and name with the other ending; None if there is none, or it is not known."""
    twin = twin_of(dataset, scenario["token"])
    unknown = twin is None or scenario["weather"] is None or twin["weather"] is None  # no meta file
    return None if unknown else twin


def _collides(scenario: Mapping[str, Any] | None) -> bool:
    return scenario is not None and scenario["collision"] is not None


def _involvement(
    agent: str,
    own_actor_id: int | None,
    collision: Mapping[str, Any] | None,
    twin: Mapping[str, Any] | None,
) -> Involvement:
    if agent == INFRASTRUCTURE:
        return "infrastructure"
    if collision is not None:
        involved = own_actor_id in collision["ids"]
    else:
        there = twin["collision"] if twin is not None and _collides(twin) else None
        involved = agent in ((there and there["agents"]) or _DESIGNED_PAIR)
    return "ego_involved" if involved else "bystander"


def _references(
    dataset: Dataset,
    sample: Mapping[str, Any],
    tracks: ScenarioTracks,
    own_actor_id: int | None,
    involvement: Involvement,
) -> dict[str, tuple[Accident, ...]]:
    """What constant velocities lead to, in the present ego frame; for one who is involved, of its own pairs alone."""
    present = int(sample["token"].rsplit("/", 1)[1])
    ego_from_world = dataset.world_from(sample["token"], "ego").inverse()
    seen = seen_actors(dataset, sample["token"])
    boxes = (tracks.at(present).transform(ego_from_world, "ego"), seen.boxes)
    own = own_actor_id if involvement == "ego_involved" else None
    return {
        name: constant_velocity_alarms(each, {OWN_ACTOR_ID: own_actor_id}, own)
        for name, each in zip(REFERENCES, boxes, strict=True)
    }


# Seconds of time to collision below which there is an alarm.
ALARM_TIME: Final = 3.0
# Relative speeds below this, in m/s, are no danger, such as those of parked cars.
_MOVING: Final = 0.1


def constant_velocity_alarms(
    boxes: Boxes, names: Mapping[int, int | None], own: int | None
) -> tuple[Accident, ...]:
    """The pairs of actors whose time to collision is below 3 s, the soonest first.

    Args:
        boxes: N actors at the present, in its ego frame, with velocities over the ground; unknown ones stand.
        names: actor ids that stand for others: a label's own row, −100; None if it is not known which.
        own: the actor that must be in the pair; None for any pair.

    Returns:
        Positions are those at the contact; the score falls from 1 at the contact to 0 at 3 s.
    """
    ids = [names.get(actor, actor) for actor in boxes.actor_id.tolist()]
    velocity = np.nan_to_num(boxes.velocity[:, :2])
    first, second = np.triu_indices(len(ids), 1)
    near = np.linalg.norm(velocity[second] - velocity[first], axis=1) >= _MOVING
    if own is not None:
        mine = np.array([actor == own for actor in ids], dtype=bool)
        near &= mine[first] | mine[second]
    first, second = first[near], second[near]
    footprint = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    seconds = time_to_collision(
        footprint[first], footprint[second], velocity[first], velocity[second]
    )
    alarms = []
    for row in np.flatnonzero(seconds < ALARM_TIME)[
        np.argsort(seconds[seconds < ALARM_TIME], kind="stable")
    ]:
        pair = [int(first[row]), int(second[row])]
        one, other = (ids[each] for each in pair)
        alarms.append(
            Accident(
                positions=boxes.center[pair, :2] + velocity[pair] * seconds[row],
                time=float(seconds[row]),
                score=1 - float(seconds[row]) / ALARM_TIME,
                ids=None if one is None or other is None else (one, other),
            )
        )
    return tuple(alarms)
