"""Recorded motions of colliding pairs, assumed masses, and computations on many scenarios."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.geometry.box_arrays import signed_gaps
from deepaccident_devkit.support.arrays import (
    FloatArray,
    FrozenArrays,
    IntArray,
    ShortRepr,
    checked,
)
from deepaccident_devkit.support.parallel import Places, in_order, run_unordered
from deepaccident_devkit.support.reports import Row
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.tables.tables import rows_of_scenarios
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD, AgentName
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.collisions import colliding_pair, contact_begin, labelled_together
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord

CLASS_MASSES: Final[Mapping[str, float]] = MappingProxyType(
    {
        "car": 1500.0,
        "truck": 9000.0,
        "van": 2400.0,
        "cyclist": 95.0,
        "motorcycle": 280.0,
        "pedestrian": 75.0,
    }
)
"""Mass of a road user that has the median size of its class, with load or rider, kilograms.

The masses are an assumption of this devkit.
"""
MASS_UNCERTAINTY: Final = 0.3
"""Share by which these masses may be wrong.

Figures that depend on them are also stated for masses that are heavier and lighter by this share.
"""
# Length, width, height in metres: medians of 250,378 real boxes (docs/format.md).
_MEDIAN_SIZES = {
    "car": (4.60, 1.93, 1.52),
    "truck": (8.47, 2.89, 3.83),
    "van": (4.48, 1.99, 2.04),
    "cyclist": (1.64, 0.37, 1.77),
    "motorcycle": (2.21, 0.86, 1.53),
    "pedestrian": (0.38, 0.38, 1.86),
}
# Smallest number of frames that must show both actors of a pair for a motion.
_MIN_COMMON_FRAMES = 2
# Factors by which a road user's size can make it lighter or heavier than its class.
_MIN_MASS_FACTOR = 0.5
_MAX_MASS_FACTOR = 2.0
# Number of scenarios of one piece of work, which takes a few tenths of a second.
_SCENARIOS_PER_RUN = 64

_Result = TypeVar("_Result")


def masses_of(
    categories: ArrayLike, sizes: ArrayLike, class_masses: Mapping[str, float] = CLASS_MASSES
) -> FloatArray:
    """Return the assumed masses of road users, shape (N,), kilograms.

    A road user's mass is its class's mass times the ratio of its volume to the class's median
    volume; the ratio is clipped to 0.5 to 2.

    Args:
        categories: Indices into `taxonomy.CATEGORIES`, shape (N,).
        sizes: Lengths, widths, heights, shape (N, 3), metres.
        class_masses: Class → mass at its median size, kilograms.

    Raises:
        GeometryError: The sizes have another shape.
        ConfigError: A class has no mass, or its mass is not above 0.
    """
    codes = np.asarray(categories, dtype=np.int64)
    volumes = checked("sizes", sizes, (len(codes), 3)).prod(axis=1)
    missing = [name for name in CATEGORIES if not class_masses.get(name, 0) > 0]
    if missing:
        raise ConfigError(
            "class_masses: expected kilograms above 0 for each class; "
            f"{', '.join(missing)} has none"
        )
    masses = np.array([float(class_masses[name]) for name in CATEGORIES])
    median_volumes = np.array([math.prod(_MEDIAN_SIZES[name]) for name in CATEGORIES])
    volume_ratios = volumes / median_volumes[codes]
    factors = np.clip(volume_ratios, _MIN_MASS_FACTOR, _MAX_MASS_FACTOR)
    return np.asarray(masses[codes] * factors)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accident(FrozenArrays):
    """Two actors up to the moment at which they collide.

    World frame, right-handed; metres, seconds, radians. The pair is in the meta file's order.
    Time 0 is `first_frame`, the first that shows both actors. The impact is taken to be at the last
    frame that shows both, although the outlines may touch earlier (`touching`). Arrays are
    read-only.

    Attributes:
        scenario: Token.
        actor_ids: CARLA ids of the two actors.
        categories: Classes of the two actors.
        agents: Names of the actors as agents; None for one that records nothing.
        first_frame: Number of the first frame.
        num_frames: Number of frames of the full recording.
        paths: Positions and yaws (x, y, yaw) at each frame, shape (2, F, 3).
        sizes: Lengths, widths, heights, shape (2, 3): medians over the frames.
        masses: Assumed masses, shape (2,), kilograms (`interactions.masses_of`).
        interpolated: Number of frames in which a label of one of the two actors is missing;
            straight lines fill these frames.
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
        """Time from the first frame to the impact, seconds."""
        num_steps = self.paths.shape[1] - 1
        return float(num_steps * FRAME_PERIOD)

    @property
    def last_frame(self) -> int:
        """Number of the frame of the impact."""
        num_steps: int = self.paths.shape[1] - 1
        return self.first_frame + num_steps

    @property
    def touching(self) -> float | None:
        """Time from the frame at which the outlines begin to touch to the last frame, seconds.

        The first of these frames is found as for `Contact.contact_frame`.
        """
        num_frames: int = self.paths.shape[1]
        flat_sizes = np.broadcast_to(self.sizes[:, None, :2], (2, num_frames, 2))
        boxes = np.concatenate([self.paths[..., :2], flat_sizes, self.paths[..., 2:]], axis=2)
        begin = contact_begin(signed_gaps(*boxes))
        if begin is None:
            return None
        return round((num_frames - 1 - begin) * FRAME_PERIOD, 1)


def counted_text(touching: Sequence[float | None]) -> str:
    """Return a note on the moment from which the seconds before impacts are counted back.

    Args:
        touching: `Accident.touching` of each accident.
    """
    early_seconds = [seconds for seconds in touching if seconds]
    text = "seconds count to the last frame; the impact is at most 0.1 s after it"
    if early_seconds:
        text += (
            f", or before it where outlines touch: {len(early_seconds)} of "
            f"{counted(len(touching), 'accident')}, up to {max(early_seconds):.1f} s"
        )
    return text


@dataclass(frozen=True, slots=True, kw_only=True)
class Skipped(ShortRepr):
    """A scenario that lacks what a computation needs.

    Attributes:
        scenario: Token.
        reason: Reason in words.
    """

    scenario: str
    reason: str


def accident_of(
    dataset: Dataset, scenario: RowArgument, class_masses: Mapping[str, float] = CLASS_MASSES
) -> Accident | None:
    """Return the accident of the pair that the meta file names; None if it names no collision.

    Args:
        dataset: The release.
        scenario: Token or record.
        class_masses: Class → mass at its median size, kilograms.

    Raises:
        TokenError: There is no such scenario.
        NotAvailableError: The scenario has no meta file or no labels, the file names one actor
            twice, or the labels show the two actors together in fewer than two frames.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    token = record["token"]
    actor_ids = colliding_pair(record)
    if actor_ids is None:
        return None
    first_id, second_id = actor_ids
    tracks = scenario_tracks(dataset, token)
    if not len(tracks.index):
        raise NotAvailableError(
            f"{token} has no labels, which say where actors are (the test split ships "
            "without labels)"
        )
    actor_rows = [np.flatnonzero(tracks.actor_id == actor_id) for actor_id in actor_ids]
    common_frames, _ = labelled_together(tracks, token, actor_ids)
    if len(common_frames) < _MIN_COMMON_FRAMES:
        raise NotAvailableError(
            f"{token}: its labels show the colliding pair {first_id} and {second_id} together at "
            f"{len(common_frames)} frames; the devkit needs at least {_MIN_COMMON_FRAMES}"
        )
    frames = np.arange(common_frames[0], common_frames[-1] + 1)
    agents = agents_by_actor(dataset, token)
    paths = []
    sizes = []
    codes = []
    for rows in actor_rows:
        paths.append(recorded_path(tracks, rows, frames))
        sizes.append(np.median(tracks.boxes.size[rows], axis=0))
        codes.append(int(tracks.boxes.category[rows[-1]]))
    return Accident(
        scenario=token,
        actor_ids=(first_id, second_id),
        categories=(CATEGORIES[codes[0]], CATEGORIES[codes[1]]),
        agents=(agents.get(first_id), agents.get(second_id)),
        first_frame=int(common_frames[0]),
        num_frames=record["num_frames"],
        paths=np.stack(paths),
        sizes=np.stack(sizes),
        masses=masses_of(codes, sizes, class_masses),
        interpolated=len(frames) - len(common_frames),
    )


def accidents_of(
    dataset: Dataset, scenarios: Iterable[RowArgument] | None = None
) -> tuple[list[Accident], list[Skipped]]:
    """Return the accidents of scenarios, and the scenarios that lack what an accident needs.

    Scenarios with a meta file that names no collision are in neither list. By default all scenarios
    are read.

    Raises:
        TokenError: There is no such scenario.
    """
    results = []
    for row in rows_of_scenarios(dataset, scenarios):
        scenario = dataset.scenario[row]
        results.append(try_scenario(accident_of, dataset, scenario))
    accidents = select_results(Accident, results)
    skipped = select_results(Skipped, results)
    return list(accidents), list(skipped)


def recorded_path(tracks: ScenarioTracks, rows: IntArray, frames: IntArray) -> FloatArray:
    """Return x, y, yaw of an actor's rows at frames, shape (F, 3); yaw turns the shorter way.

    Straight lines fill gaps. Before the first row and after the last one the actor stands still.
    """
    row_frames = tracks.index[rows]
    boxes = tracks.boxes.select(rows)
    x, y, _ = boxes.center.T
    columns = []
    for values in (x, y, np.unwrap(boxes.yaw)):
        columns.append(np.interp(frames, row_frames, values))
    return np.column_stack(columns)


def agents_by_actor(dataset: Dataset, scenario: str) -> dict[int, AgentName]:
    """Return CARLA id → agent, for the vehicles that recorded a scenario in this release.

    Vehicles without an id in the meta file are missing.
    """
    agents = {}
    for name in agents_of(dataset, scenario):
        actor_id = dataset.agent.get(f"{scenario}/{name}")["actor_id"]
        if actor_id is not None:
            agents[actor_id] = name
    return agents


def skipped_rows(skipped: Iterable[Skipped]) -> list[Row]:
    """Return a table, with a header, of the scenarios that are left out."""
    rows: list[Row] = [("scenario", "reason")]
    for skip in skipped:
        rows.append((skip.scenario, skip.reason))
    return rows


def reasons_text(title: str, skipped: Iterable[Skipped]) -> str:
    """Return a title, and a line for each reason."""
    lines = [f"{title}:"]
    for skip in skipped:
        lines.append(f"  {skip.reason}")
    return "\n".join(lines)


def map_scenarios(
    work: Callable[[Dataset, Any], _Result | None],
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    *,
    label: str,
    at_once: int = _SCENARIOS_PER_RUN,
    **engine: Unpack[Engine],
) -> list[_Result | Skipped | None]:
    """Apply a computation once to each scenario, in the order of the release.

    Args:
        work: An importable function of the devkit (or a `functools.partial` of one) that takes a
            release and a scenario's record. It returns None for a scenario that it does not
            concern, and raises NotAvailableError for one that lacks what it needs: the result is
            then a Skipped.
        dataset: The release.
        scenarios: Tokens or records; None for all. Raises TokenError.
        label: Label of the progress bar.
        at_once: Number of scenarios of a piece of work; 1 if one scenario takes tenths of a second.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.
    """
    rows = sorted(set(rows_of_scenarios(dataset, scenarios)))
    runs = [rows[start : start + at_once] for start in range(0, len(rows), at_once)]
    sizes = [len(run) for run in runs]
    places = Places(reads=dataset.places)
    run_work = partial(_compute_rows, work, dataset)
    unordered = run_unordered(run_work, runs, sizes=sizes, places=places, label=label, **engine)
    results: list[_Result | Skipped | None] = []
    for run_results in in_order(unordered):
        results += run_results
    return results


def _compute_rows(
    work: Callable[[Dataset, Any], _Result | None], dataset: Dataset, rows: Sequence[int]
) -> list[_Result | Skipped | None]:
    """Return the result of a computation for each of the selected rows of the scenario table."""
    scenarios = [dataset.scenario[row] for row in rows]
    return [try_scenario(work, dataset, scenario) for scenario in scenarios]


def try_scenario(
    work: Callable[[Dataset, Any], _Result | None], dataset: Dataset, scenario: ScenarioRecord
) -> _Result | Skipped | None:
    """Return the result of a computation for one scenario, or the reason why it has none.

    `map_scenarios` describes the computation.
    """
    try:
        return work(dataset, scenario)
    except NotAvailableError as error:
        return Skipped(scenario=scenario["token"], reason=str(error))


def select_results(kind: type[_Result], results: Iterable[object]) -> tuple[_Result, ...]:
    """Return the results of `map_scenarios` that belong to a class, such as Skipped."""
    return tuple(result for result in results if isinstance(result, kind))
