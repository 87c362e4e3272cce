"""`ForecastingTruth`: where the actors of a sample's present really go, and what is known of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.evaluation.truth import labelled_sample
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, FRAME_PERIOD, OWN_ACTOR_ID
from deepaccident_devkit.v2x.cooperation import seen_actors
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

# Seconds that the truth goes on.
LONGEST: Final = 5.0
# m/s at the present; slower actors stand.
MOVING_SPEED: Final = 0.5
_LAST_SECONDS: Final = 5
EVERYBODY: Final = "all"
CLASSES: Final = tuple(f"class {name}" for name in CATEGORIES)
ROLES: Final = ("collider", "other")
SEEN: Final = ("seen by ego", "seen by a partner alone", "seen by nobody")
TO_IMPACT: Final = (
    *(f"{second}–{second + 1} s to impact" for second in range(_LAST_SECONDS)),
    "normal",
)
MOTIONS: Final = ("moving", "standing")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForecastingTruth(FrozenArrays):
    """The other actors that are annotated at a sample's present; arrays are read-only.

    The agent's own vehicle is not among them: where it goes is its plan.

    Attributes:
        scenario: token.
        actor_id: (A,) int64, ascending.
        present: (A, 2) float64 where their centres are, x forward, y left, metres in the present ego frame.
        path: (A, S, 2) likewise 0.1, 0.2, … s after the present; NaN where nobody annotated the actor.
        groups: names of groups of actors.
        members: (len(groups), A) bool, who belongs to which.
    """

    scenario: str
    actor_id: IntArray
    present: FloatArray
    path: FloatArray
    groups: tuple[str, ...]
    members: BoolArray


def forecasting_truth(
    dataset: Dataset, sample: RowArgument, seconds: float = LONGEST
) -> ForecastingTruth:
    """The truth that forecasts of a sample are compared with, from the labels of all agents of the release.

    Args:
        dataset: the release.
        sample: token or record of the present.
        seconds: how long the paths are.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label.
    """
    there = labelled_sample(dataset, sample)
    number = int(there["token"].rsplit("/", 1)[1])
    tracks = scenario_tracks(dataset, there["scenario_token"])
    last = number + round(seconds / FRAME_PERIOD)
    first, end = tracks.index.searchsorted((number, last + 1))
    rows = np.arange(first, end)
    own = dataset.get("agent", there["agent_token"])["actor_id"]
    now = rows[
        (tracks.index[rows] == number)
        & (tracks.actor_id[rows] != (OWN_ACTOR_ID if own is None else own))
    ]
    actor = tracks.actor_id[now]
    rows = rows[np.isin(tracks.actor_id[rows], actor)]
    path = np.full((len(actor), last - number + 1, 2), np.nan)
    ego_from_world = dataset.world_from(there["token"], "ego").inverse()
    place = actor.searchsorted(tracks.actor_id[rows]), tracks.index[rows] - number
    path[place] = ego_from_world.apply(tracks.boxes.center[rows])[:, :2]
    groups = dict(_groups(dataset, there["token"], tracks, now))
    return ForecastingTruth(
        scenario=there["scenario_token"],
        actor_id=actor,
        present=path[:, 0],
        path=path[:, 1:],
        groups=tuple(groups),
        members=np.stack([*groups.values()]),
    )


def _groups(
    dataset: Dataset, token: str, tracks: ScenarioTracks, now: IntArray
) -> Iterator[tuple[str, BoolArray]]:
    """Groups of the actors at some rows of the tracks, by name; of the groups of one kind each actor is in one."""
    sample, actor = dataset.get("sample", token), tracks.actor_id[now]
    scenario, everybody = (
        dataset.get("scenario", sample["scenario_token"]),
        np.ones(len(now), dtype=bool),
    )
    yield EVERYBODY, everybody
    yield from ((name, tracks.boxes.category[now] == code) for code, name in enumerate(CLASSES))
    if scenario["weather"] is not None:  # else there is no meta file
        ahead, collision = sample["time_to_impact"], scenario["collision"]
        collides = np.isin(actor, [] if collision is None else collision["ids"])
        yield from zip(ROLES, (collides, ~collides), strict=True)
        second = (
            _LAST_SECONDS if ahead is None else max(int(np.ceil(ahead - FRAME_PERIOD / 2)), 1) - 1
        )
        yield from (
            (name, everybody)
            for name in TO_IMPACT[second : second + 1]
            if ahead is None or second < _LAST_SECONDS
        )
    seen = seen_actors(dataset, token, agents=None)
    eyes = np.zeros(len(actor), dtype=np.uint8)
    known = np.isin(actor, seen.boxes.actor_id)
    order = np.argsort(seen.boxes.actor_id)
    eyes[known] = seen.seen_by[order][seen.boxes.actor_id[order].searchsorted(actor[known])]
    by_ego = (eyes & (1 << AGENTS.index(sample["agent"]))) > 0
    yield from zip(SEEN, (by_ego, ~by_ego & (eyes > 0), eyes == 0), strict=True)
    speed = np.linalg.norm(tracks.boxes.velocity[now, :2], axis=1)
    yield from zip(MOTIONS, (speed >= MOVING_SPEED, speed < MOVING_SPEED), strict=True)
