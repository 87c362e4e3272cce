"""`Accident`: the recorded motion of two that collide; masses; `each_scenario`: one computation on many scenarios."""

from __future__ import annotations

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
"""Kilograms of a road user of its class's median size, with load or rider: an assumption of this devkit."""
MASS_UNCERTAINTY: Final = 0.3
"""Share by which these masses may be wrong; figures that depend on them are also given for that much more and less."""
# Length, width, height in metres: medians of 250,378 real boxes (docs/format.md).
_MEDIAN_SIZES: Final[Mapping[str, tuple[float, float, float]]] = {
    "car": (4.60, 1.93, 1.52),
    "truck": (8.47, 2.89, 3.83),
    "van": (4.48, 1.99, 2.04),
    "cyclist": (1.64, 0.37, 1.77),
    "motorcycle": (2.21, 0.86, 1.53),
    "pedestrian": (0.38, 0.38, 1.86),
}
# Frames that show both of a pair, with which there is a motion.
_FEWEST: Final = 2
# How much lighter or heavier than its class a road user can be by its size.
_LEAST, _MOST = 0.5, 2.0


def masses_of(
    categories: ArrayLike, sizes: ArrayLike, class_masses: Mapping[str, float] = CLASS_MASSES
) -> FloatArray:
    """The assumed masses (N,) of road users in kilograms: their class's, times their volume over the class's median.

    The factor is kept between 0.5 and 2.

    Args:
        categories: (N,) positions in `taxonomy.CATEGORIES`.
        sizes: (N, 3) length, width, height, metres.
        class_masses: class → kilograms at its median size.

    Raises:
        GeometryError: the sizes have another shape.
        ConfigError: a class has no mass, or none above 0.
    """
    codes = np.asarray(categories, dtype=np.int64)
    volumes = checked("sizes", sizes, (len(codes), 3)).prod(axis=1)
    masses = np.array(_masses_in_order(class_masses))
    medians = np.array([np.prod(_MEDIAN_SIZES[name]) for name in CATEGORIES])
    return np.asarray(masses[codes] * np.clip(volumes / medians[codes], _LEAST, _MOST))


def _masses_in_order(class_masses: Mapping[str, float]) -> Sequence[float]:
    missing = [name for name in CATEGORIES if not class_masses.get(name, 0) > 0]
    if missing:
        raise ConfigError(
            f"class_masses: expected kilograms above 0 for each class; {', '.join(missing)} has none"
        )
    return [float(class_masses[name]) for name in CATEGORIES]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accident(FrozenArrays):
    """Two actors up to the moment at which they collide; world, right-handed, metres, seconds, radians.

    The pair is in the meta file's order. Time 0 is `first_frame`, the first that shows both; the impact counts as at
    the last frame that does, though the outlines may touch before (`touching`). Arrays are read-only.

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

    @property
    def touching(self) -> float | None:
        """Seconds from the frame at which the outlines begin to touch (as `Contact.contact_frame`) to the last one."""
        flat = np.broadcast_to(self.sizes[:, None, :2], (*self.paths.shape[:2], 2))
        begin = contact_begin(
            signed_gaps(*np.concatenate([self.paths[..., :2], flat, self.paths[..., 2:]], axis=2))
        )
        return None if begin is None else round((self.paths.shape[1] - 1 - begin) * FRAME_PERIOD, 1)


def counted_text(touching: Sequence[float | None]) -> str:
    """What seconds before impacts are counted to; `touching` is each accident's (`Accident.touching`)."""
    early = [seconds for seconds in touching if seconds]
    text = "seconds count to the last frame; the impact is at most 0.1 s after it"
    if early:
        text += f", or before it where outlines touch: {len(early)} of {len(touching)} accidents, up to {max(early):.1f} s"
    return text


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
        raise NotAvailableError(
            f"{token} has no labels (the test split ships without), which say where actors are"
        )
    rows = [np.flatnonzero(tracks.actor_id == actor) for actor in (first, second)]
    common, _ = labelled_together(tracks, token, named)
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
    found = [
        tried(accident_of, dataset, dataset.scenario[row])
        for row in rows_of_scenarios(dataset, scenarios)
    ]
    return [*those_of(Accident, found)], [*those_of(Skipped, found)]


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


_Result = TypeVar("_Result")
# Scenarios that are looked at together: some tenths of a second.
_RUN_LENGTH: Final = 64


def skipped_rows(skipped: Iterable[Skipped]) -> list[Row]:
    """The table of what is left out."""
    return [("scenario", "reason"), *((each.scenario, each.reason) for each in skipped)]


def reasons_text(title: str, skipped: Iterable[Skipped]) -> str:
    """A line a reason under a title."""
    return "\n".join([f"{title}:", *(f"  {each.reason}" for each in skipped)])


def each_scenario(
    work: Callable[[Dataset, Any], _Result | None],
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    *,
    label: str,
    at_once: int = _RUN_LENGTH,
    **how: Unpack[Engine],
) -> list[_Result | Skipped | None]:
    """Apply a computation to scenarios, each once, in the order of the release.

    Args:
        work: an importable function of the devkit (or a `functools.partial` of one) of a release and a scenario's
            record. It returns None for a scenario that it does not concern, and raises NotAvailableError for one that
            lacks what it needs: then there is a Skipped.
        dataset: the release.
        scenarios: tokens or records; None for all. Raises TokenError.
        label: text of the progress bar.
        at_once: scenarios of a piece of work; 1 where one takes tenths of a second.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.
    """
    rows = sorted(set(rows_of_scenarios(dataset, scenarios)))
    runs = [rows[first : first + at_once] for first in range(0, len(rows), at_once)]
    sizes, places = [len(run) for run in runs], Places(reads=dataset.places)
    parts = run_unordered(
        partial(_run, work, dataset), runs, sizes=sizes, places=places, label=label, **how
    )
    return [each for part in in_order(parts) for each in part]


def _run(
    work: Callable[[Dataset, Any], _Result | None], dataset: Dataset, rows: Sequence[int]
) -> list[_Result | Skipped | None]:
    return [tried(work, dataset, dataset.scenario[row]) for row in rows]


def tried(
    work: Callable[[Dataset, Any], _Result | None], dataset: Dataset, scenario: ScenarioRecord
) -> _Result | Skipped | None:
    """What a computation, as `each_scenario` takes it, finds in one scenario, or why it finds nothing."""
    try:
        return work(dataset, scenario)
    except NotAvailableError as error:
        return Skipped(scenario=scenario["token"], reason=str(error))


def those_of(kind: type[_Result], found: Iterable[object]) -> tuple[_Result, ...]:
    """Of what `each_scenario` found, what is of a kind: results, or Skipped."""
    return tuple(each for each in found if isinstance(each, kind))
