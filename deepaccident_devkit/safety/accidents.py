"""`Accident`: the recorded motion of two actors that collide, from the labels of all agents."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, FrozenArrays, IntArray, ShortRepr
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.interactions import CLASS_MASSES, masses_of
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD, AgentName
from deepaccident_devkit.v2x.collisions import colliding_pair
from deepaccident_devkit.v2x.configurations import agents_of
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

_FEWEST: Final = 2
"""Frames that show both of a pair, with which there is a motion."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accident(FrozenArrays):
    """Two actors up to the moment at which they collide; world, right-handed, metres, seconds, radians.

    The pair is in the meta file's order. Time 0 is `first_frame`, the first that shows both; the impact is at the last
    frame that does. Arrays are read-only.

    Attributes:
        scenario: token.
        actor_ids: their CARLA ids.
        categories: their classes.
        agents: the agents that they are; None for one that records nothing.
        first_frame: number of the first frame.
        num_frames: of the whole recording.
        paths: (2, F, 3) x, y, yaw at each frame.
        sizes: (2, 3) length, width, height: medians over the frames.
        masses: (2,) kilograms, assumed (`interactions.masses_of`).
        interpolated: frames within which a label of one of the two is missing; straight lines fill them.
    """

    scenario: str
    actor_ids: tuple[int, int]
    categories: tuple[str, str]
    agents: tuple[AgentName | None, AgentName | None]
    first_frame: int
    num_frames: int
    paths: FloatArray
    sizes: FloatArray
    masses: FloatArray
    interpolated: int

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the impact."""
        return float((self.paths.shape[1] - 1) * FRAME_PERIOD)

    @property
    def last_frame(self) -> int:
        """Number of the frame of the impact."""
        return int(self.first_frame + self.paths.shape[1] - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Skipped(ShortRepr):
    """A scenario without what a computation needs.

    Attributes:
        scenario: token.
        reason: in words.
    """

    scenario: str
    reason: str


def accident_of(
    dataset: Dataset, scenario: RowArgument, class_masses: Mapping[str, float] = CLASS_MASSES
) -> Accident | None:
    """The motion of the pair that the meta file names; None if it names no collision.

    Args:
        dataset: the release.
        scenario: token or record.
        class_masses: class → kilograms at its median size.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: the scenario has no meta file or no labels, the file names one actor twice, or the labels
            show the two together at fewer than two frames.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    token = record["token"]
    named = colliding_pair(record)
    if named is None:
        return None
    first, second = named
    tracks = scenario_tracks(dataset, token)
    if not len(tracks.index):
        raise NotAvailableError(f"{token} has no labels (the test split ships without), which say where actors are")
    rows = [np.flatnonzero(tracks.actor_id == actor) for actor in (first, second)]
    common = np.intersect1d(tracks.index[rows[0]], tracks.index[rows[1]])
    if len(common) < _FEWEST:
        raise NotAvailableError(
            f"{token}: its labels show the colliding pair {first} and {second} together at {len(common)} frames; a "
            f"motion needs {_FEWEST}"
        )
    frames = np.arange(common[0], common[-1] + 1)
    sizes = np.array([np.median(tracks.boxes.size[each], axis=0) for each in rows])
    agents = agents_by_actor(dataset, token)
    codes = [int(tracks.boxes.category[each[-1]]) for each in rows]
    return Accident(
        scenario=token,
        actor_ids=(first, second),
        categories=(CATEGORIES[codes[0]], CATEGORIES[codes[1]]),
        agents=(agents.get(first), agents.get(second)),
        first_frame=int(common[0]),
        num_frames=record["num_frames"],
        paths=np.stack([recorded_path(tracks, each, frames) for each in rows]),
        sizes=sizes,
        masses=masses_of(codes, sizes, class_masses),
        interpolated=len(frames) - len(common),
    )


def accidents_of(
    dataset: Dataset, scenarios: Iterable[RowArgument] | None = None
) -> tuple[list[Accident], list[Skipped]]:
    """The accidents of scenarios, all by default, and the scenarios of which it cannot be said or which lack labels.

    Scenarios whose meta file names no collision are in neither.

    Raises:
        TokenError: no such scenario.
    """
    found: list[Accident] = []
    skipped: list[Skipped] = []
    for scenario in dataset.scenario if scenarios is None else scenarios:
        try:
            accident = accident_of(dataset, scenario)
        except NotAvailableError as error:
            skipped.append(Skipped(scenario=dataset.get("scenario", scenario)["token"], reason=str(error)))
            continue
        if accident is not None:
            found.append(accident)
    return found, skipped


def recorded_path(tracks: ScenarioTracks, rows: IntArray, frames: IntArray) -> FloatArray:
    """(F, 3) x, y, yaw of an actor's rows at frames; yaw turns the shorter way.

    Straight lines fill gaps; before the first row and after the last one the actor stands there.
    """
    index, boxes = tracks.index[rows], tracks.boxes.select(rows)
    values = [*boxes.center[:, :2].T, np.unwrap(boxes.yaw)]
    return np.column_stack([np.interp(frames, index, each) for each in values])


def agents_by_actor(dataset: Dataset, scenario: str) -> dict[int, AgentName]:
    """The vehicles that recorded a scenario in this release, by their CARLA ids; those that meta does not say lack."""
    names = agents_of(dataset, scenario)
    ids = (dataset.agent.get(f"{scenario}/{name}")["actor_id"] for name in names)
    return {actor: name for actor, name in zip(ids, names, strict=True) if actor is not None}
