"""`ForecastingTruth`: recorded paths of the actors in a sample's frame, and their groups."""

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
# Lowest current speed at which an actor counts as moving, m/s; slower actors count as standing.
MOVING_SPEED: Final = 0.5
# Each of the last seconds before the impact, this many, has a group of its own.
_SECONDS_TO_IMPACT = 5
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
    """Paths of the other actors that are annotated in a sample's frame; arrays are read-only.

    The agent's own vehicle is left out, since its path is its plan.

    Attributes:
        scenario: Token of the scenario.
        actor_id: (A,) int64 CARLA ids, ascending.
        present: (A, 2) float64 current centres, x forward, y left, metres in the current ego frame.
        path: (A, S, 2) float64 centres at 0.1, 0.2, … s after the current frame, in the current ego
            frame; NaN where no agent annotated the actor.
        groups: Names of the G groups of actors.
        members: (G, A) bool, True if the actor is in the group.
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
    """Collect the recorded paths that forecasts of a sample are compared with.

    They come from the labels of all agents in the release.

    Args:
        dataset: Release with the sample.
        sample: Token or record of the sample.
        seconds: Duration of the paths, seconds.

    Raises:
        TokenError: If the release does not have the sample.
        NotAvailableError: If the sample has no label.
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
    is_other = tracks.actor_id[rows] != own_id
    present_rows = rows[is_present & is_other]
    actor_ids = tracks.actor_id[present_rows]
    path_rows = rows[np.isin(tracks.actor_id[rows], actor_ids)]
    actor_index = actor_ids.searchsorted(tracks.actor_id[path_rows])
    frame_index = tracks.index[path_rows] - frame
    ego_from_world = dataset.world_from(token, "ego").inverse()
    centers = ego_from_world.apply(tracks.boxes.center[path_rows])
    path = np.full((len(actor_ids), last_frame - frame + 1, 2), np.nan)
    path[actor_index, frame_index] = centers[:, :2]
    groups = dict(_groups(dataset, token, tracks, present_rows))
    return ForecastingTruth(
        scenario=record["scenario_token"],
        actor_id=actor_ids,
        present=path[:, 0],
        path=path[:, 1:],
        groups=tuple(groups),
        members=np.stack([*groups.values()]),
    )


def _groups(
    dataset: Dataset, token: str, tracks: ScenarioTracks, rows: IntArray
) -> Iterator[tuple[str, BoolArray]]:
    """Yield each group's name and its mask (A,) of the actors at `rows` of the tracks.

    Each actor is in at most one group of each kind.
    """
    sample = dataset.get("sample", token)
    actor_ids = tracks.actor_id[rows]
    scenario = dataset.get("scenario", sample["scenario_token"])
    everybody = np.ones(len(rows), dtype=bool)
    yield EVERYBODY, everybody
    for code, name in enumerate(CLASS_LABELS):
        yield name, tracks.boxes.category[rows] == code
    # without the meta file, it is unknown whether there is an accident
    if scenario["weather"] is not None:
        collision = scenario["collision"]
        colliding_ids = [] if collision is None else collision["ids"]
        collides = np.isin(actor_ids, colliding_ids)
        yield from zip(ROLES, (collides, ~collides), strict=True)
        group = _time_to_impact_group(sample["time_to_impact"])
        if group is not None:
            yield group, everybody
    seen_by = _seen_by(dataset, token, actor_ids)
    own_bit = 1 << AGENTS.index(sample["agent"])
    is_seen = seen_by > 0
    is_seen_by_ego = (seen_by & own_bit) > 0
    viewer_masks = is_seen_by_ego, is_seen & ~is_seen_by_ego, ~is_seen
    yield from zip(VIEWERS, viewer_masks, strict=True)
    speed = np.linalg.norm(tracks.boxes.velocity[rows, :2], axis=1)
    yield from zip(MOTIONS, (speed >= MOVING_SPEED, speed < MOVING_SPEED), strict=True)


def _time_to_impact_group(time_to_impact: float | None) -> str | None:
    """Return the group in `TO_IMPACT` for a time to impact; None if the impact is too far ahead."""
    if time_to_impact is None:
        return TO_IMPACT[_SECONDS_TO_IMPACT]
    last_second = int(np.ceil(time_to_impact - FRAME_PERIOD / 2))
    second = max(last_second, 1) - 1
    if second >= _SECONDS_TO_IMPACT:
        return None
    return TO_IMPACT[second]


def _seen_by(dataset: Dataset, token: str, actor_ids: IntArray) -> AnyArray:
    """Find the agents that see each actor, (A,) uint8 with one bit per agent."""
    visible = seen_actors(dataset, token, agents=None)
    visible_ids = visible.boxes.actor_id
    seen_by = np.zeros(len(actor_ids), dtype=np.uint8)
    is_visible = np.isin(actor_ids, visible_ids)
    order = np.argsort(visible_ids)
    index = visible_ids[order].searchsorted(actor_ids[is_visible])
    seen_by[is_visible] = visible.seen_by[order][index]
    return seen_by
