"""`ForecastingTruth`: recorded paths of the actors at a sample's present, and their groups."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.truth import labelled_sample
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
)
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, FRAME_PERIOD, OWN_ACTOR_ID
from deepaccident_devkit.v2x.cooperation import seen_actors
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

# Duration of the recorded paths, seconds.
PATH_SECONDS: Final = 5.0
# m/s at the present; slower actors stand.
MOVING_SPEED: Final = 0.5
# Number of seconds before the impact that have a group each.
_SECONDS_TO_IMPACT: Final = 5
EVERYBODY: Final = "all"
CLASS_LABELS: Final = tuple(f"class {name}" for name in CATEGORIES)
ROLES: Final = ("collider", "other")
VIEWERS: Final = ("seen by ego", "seen by a partner alone", "seen by nobody")
TO_IMPACT: Final = (
    *(f"{second}–{second + 1} s to impact" for second in range(_SECONDS_TO_IMPACT)),
    "normal",
)
MOTIONS: Final = ("moving", "standing")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForecastingTruth(FrozenArrays):
    """The other actors that are annotated at a sample's present; arrays are read-only.

    The agent's own vehicle is not among them: its path is its plan.

    Attributes:
        scenario: Token of the scenario.
        actor_id: (A,) int64, ascending.
        present: (A, 2) float64 centres, x forward, y left, metres in the present ego frame.
        path: (A, S, 2) float64 centres at 0.1, 0.2, … s after the present, in the same frame; NaN
            where nobody annotated the actor.
        groups: Names of groups of actors.
        members: (len(groups), A) bool, the actors of each group.
    """

    scenario: str
    actor_id: IntArray
    present: FloatArray
    path: FloatArray
    groups: tuple[str, ...]
    members: BoolArray


def forecasting_truth(
    dataset: Dataset, sample: RowArgument, seconds: float = PATH_SECONDS
) -> ForecastingTruth:
    """Return the recorded paths that forecasts of a sample are compared with.

    They are from the labels of all agents of the release.

    Args:
        dataset: The release.
        sample: Token or record of the present.
        seconds: Duration of the paths.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label.
    """
    record = labelled_sample(dataset, sample)
    token = record["token"]
    frame = int(token.rsplit("/", 1)[1])
    tracks = scenario_tracks(dataset, record["scenario_token"])
    last_frame = frame + round(seconds / FRAME_PERIOD)
    start, end = tracks.index.searchsorted((frame, last_frame + 1))
    rows = np.arange(start, end)
    own_id = dataset.get("agent", record["agent_token"])["actor_id"]
    if own_id is None:
        own_id = OWN_ACTOR_ID
    is_present = tracks.index[rows] == frame
    present_rows = rows[is_present & (tracks.actor_id[rows] != own_id)]
    actor = tracks.actor_id[present_rows]
    rows = rows[np.isin(tracks.actor_id[rows], actor)]
    path = np.full((len(actor), last_frame - frame + 1, 2), np.nan)
    ego_from_world = dataset.world_from(token, "ego").inverse()
    actor_index = actor.searchsorted(tracks.actor_id[rows])
    step = tracks.index[rows] - frame
    path[actor_index, step] = ego_from_world.apply(tracks.boxes.center[rows])[:, :2]
    groups = dict(_groups(dataset, token, tracks, present_rows))
    return ForecastingTruth(
        scenario=record["scenario_token"],
        actor_id=actor,
        present=path[:, 0],
        path=path[:, 1:],
        groups=tuple(groups),
        members=np.stack([*groups.values()]),
    )


def _groups(
    dataset: Dataset, token: str, tracks: ScenarioTracks, rows: IntArray
) -> Iterator[tuple[str, BoolArray]]:
    """Yield groups of the actors at some rows of the tracks, by name.

    Among the groups of one kind each actor is in exactly one.
    """
    sample = dataset.get("sample", token)
    actor = tracks.actor_id[rows]
    scenario = dataset.get("scenario", sample["scenario_token"])
    everybody = np.ones(len(rows), dtype=bool)
    yield EVERYBODY, everybody
    for code, name in enumerate(CLASS_LABELS):
        yield name, tracks.boxes.category[rows] == code
    # without the meta file nothing is known about accidents
    if scenario["weather"] is not None:
        collision = scenario["collision"]
        collides = np.isin(actor, [] if collision is None else collision["ids"])
        yield from zip(ROLES, (collides, ~collides), strict=True)
        group = _time_to_impact_group(sample["time_to_impact"])
        if group is not None:
            yield group, everybody
    eyes = _seen_by(dataset, token, actor)
    by_ego = (eyes & (1 << AGENTS.index(sample["agent"]))) > 0
    yield from zip(VIEWERS, (by_ego, ~by_ego & (eyes > 0), eyes == 0), strict=True)
    speed = np.linalg.norm(tracks.boxes.velocity[rows, :2], axis=1)
    yield from zip(MOTIONS, (speed >= MOVING_SPEED, speed < MOVING_SPEED), strict=True)


def _time_to_impact_group(ahead: float | None) -> str | None:
    """Return the group of `TO_IMPACT` of a time to impact; None if it is too far ahead."""
    if ahead is None:
        return TO_IMPACT[_SECONDS_TO_IMPACT]
    second = max(int(np.ceil(ahead - FRAME_PERIOD / 2)), 1) - 1
    return TO_IMPACT[second] if second < _SECONDS_TO_IMPACT else None


def _seen_by(dataset: Dataset, token: str, actor: IntArray) -> AnyArray:
    """Return the agents that see each actor (A,), one bit per agent."""
    visible = seen_actors(dataset, token, agents=None)
    eyes = np.zeros(len(actor), dtype=np.uint8)
    is_visible = np.isin(actor, visible.boxes.actor_id)
    order = np.argsort(visible.boxes.actor_id)
    sorted_ids = visible.boxes.actor_id[order]
    eyes[is_visible] = visible.seen_by[order][sorted_ids.searchsorted(actor[is_visible])]
    return eyes
