"""`check_sanity`: do the predictions fit the labels much better once a classic mistake is undone?

A mistake is a transform that undoes it. Of each sample it says which part of the truth the predictions hit once it is
undone, and which part as they are given. These parts are summed over the samples; the mistake is suspected if the
first share is large enough, and clearly larger than the second. If none is, but sizes, heights or headings of what is
in the right place are mostly wrong, that is said instead.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, permutations
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import AccidentContext, BoxAccidents
from deepaccident_devkit.evaluation.alarms import LABEL_STEP, by_sureness, position_difference
from deepaccident_devkit.evaluation.detection.boxes import columns_of
from deepaccident_devkit.evaluation.forecasting import Forecast, ForecastingTruth
from deepaccident_devkit.evaluation.forecasting.metrics import SAME_TIME
from deepaccident_devkit.evaluation.motion import actor_cells
from deepaccident_devkit.evaluation.planning import Plan, PlanningScene
from deepaccident_devkit.evaluation.predictions import (
    Accident,
    MotionOutput,
    frames_there,
    labels_at_present,
)
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.evaluation.task import FrozenMappings
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, IntArray
from deepaccident_devkit.support.parallel import run_batch
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD, OWN_ACTOR_ID

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

__all__ = ["SanityReport", "check_sanity"]

# Name → the signs of x and y once it is undone, and −1 if the two are swapped before. x right, y forward is turned
# left. If two explain the same, as on a straight way, the first is told.
_AXES: Final = {
    "x mirrored": (-1, 1, 1),
    "y mirrored": (1, -1, 1),
    "turned left": (1, -1, -1),
    "turned right": (-1, 1, -1),
    "x and y mirrored": (-1, -1, 1),
    "x and y swapped": (1, 1, -1),
    "x and y swapped and mirrored": (-1, -1, -1),
}
SAMPLES: Final = 20
# Samples that are looked at, and of accident lists and plans, which are short.
LISTS: Final = 60
# How many times as large the share has to be once a mistake is undone.
_MARGIN: Final = 2.0
# The share that it has to reach, if not one half; in time, slow predictions reach a part, too.
_LEAST: Final[Mapping[str, float]] = {"place": 0.2, "time": 0.4}
# Cells, accidents, boxes, or places of paths that have to be hit.
_EVIDENCE: Final = {
    "motion": 100,
    "accident": 4,
    "detection": 10,
    "planning": 10,
    "forecasting": 10,
}
_THINGS: Final = dict(
    zip(_EVIDENCE, ("cells", "accidents", "true boxes", "places", "places"), strict=True)
)
# Metres: as near on the ground, a box is found, and both places of an accident are hit on average.
_NEAR: Final = 2.0
# Nearer in height, 0.7 m, since LiDAR and ego frame differ by the LiDAR's height alone, some 2 m.
_SCALE: Final = np.array([1, 1, _NEAR / 0.7])
# Seconds, of accidents.
NEAR_IN_TIME: Final = 0.15
# Metres, or a tenth of the way if that is more.
_NEAR_ON_PATH: Final = 1.0
# Share of a box's size, of its height over the ground or of its velocity that may be wrong.
_ALIKE: Final = 0.2
# Boxes of a class from which on its name tells.
_FEWEST: Final = 5
# m/s: within a step, slower actors do not move enough.
MOVING: Final = 4.0
# A heading that is nearer to one of the true box's four directions is right; at random, a third of them are.
STRAIGHT: Final = np.deg2rad(15)
# Name → the order of the given sizes, and by what they are multiplied to undo it.
_SIZES: Final = {
    f"sizes in the order {', '.join(('length', 'width', 'height')[axis] for axis in order)}": (
        order,
        1.0,
    )
    for order in permutations(range(3))
    if order != (0, 1, 2)
} | {"half sizes": ((0, 1, 2), 2.0), "double sizes": ((0, 1, 2), 0.5)}
# Name → how much of the box's height is added to undo it.
_HEIGHTS: Final = {"z of the lower face": 0.5, "z of the upper face": -0.5}
_VELOCITIES: Final = {
    "velocities per frame": 1 / FRAME_PERIOD,
    "velocities per step": 1 / LABEL_STEP,
}
_DEGREES: Final = "yaw in degrees"
# Name → what headings are multiplied by, and what is added to them, to undo it.
_YAWS: Final = {
    "yaw clockwise": (-1.0, 0.0),
    "yaw from y": (1.0, np.pi / 2),
    "yaw from −y": (1.0, -np.pi / 2),
    "yaw clockwise from y": (-1.0, np.pi / 2),
    "yaw backwards": (1.0, np.pi),
}
# Above this a heading may be in degrees; a small one would be near 0, as most are, whatever was wrong with it.
_LARGE_YAW: Final = 4.0
_CLASSES: Final = "classes swapped"
# Seconds at which paths are compared.
_STEPS: Final = np.arange(1, 7) * LABEL_STEP
# The same in frames from the present on.
_FRAMES: Final = slice(5, 31, 5)
# In so few frames, slow predictions look late.
FEWEST_FRAMES: Final = 3
_SECONDS: Final = "times are in seconds after the present"
# Group → mistakes that are undone on trial → what is right.
_SAYS: Final[Mapping[str, Mapping[str, str]]] = {
    "place": {
        **dict.fromkeys(
            _AXES, "x is forward and y to the left; of maps, state the orientation that they have"
        ),
        "world frame for ego frame": "places are given in the world frame; give them in the present ego frame",
        "ego frame for world frame": 'boxes are given in the ego frame; move them by da.world_from(token, "ego")',
        "LiDAR frame for world frame": 'boxes are given in the LiDAR frame; move them by da.world_from(token, "lidar")',
        "LiDAR frame for ego frame": "boxes of the LiDAR frame were moved by the ego pose; take the LiDAR's pose",
        "ego frame for LiDAR frame": "boxes of the ego frame were moved by the LiDAR's pose; take the ego pose",
    },
    "time": {
        "frames reversed": "the first frame of a prediction is the present, and times are counted from there",
        "one step late": "earlier moments are shown; the first frame, or time 0, is the sample's own: no past",
        "one step early": "later moments are shown; the first frame, or time 0, is the sample's own",
        "steps for places": "a path holds places; add up the steps",
        "places from the actor": "a path begins where the actor is in the present ego frame, not at 0, 0",
        "times in frames": _SECONDS,
        "times in milliseconds": _SECONDS,
    },
    "height": dict.fromkeys(_HEIGHTS, "z is that of the middle of the box"),
    "size": dict.fromkeys(
        _SIZES,
        "Boxes and DetectedBoxes hold whole lengths, widths, heights; results files hold width, length, height",
    ),
    "heading": dict.fromkeys(
        (_DEGREES, *_YAWS), "yaw is in radians, counter-clockwise from x of the present ego frame"
    ),
    "velocity": dict.fromkeys(_VELOCITIES, "velocities are in m/s"),
    "class": {_CLASSES: f"the classes are, counted from 0, {', '.join(CATEGORIES)}"},
}
# Group → what is said if most of what is found in its place is wrong, and no mistake explains it.
_UNFIT: Final[Mapping[str, str]] = {
    "height": "heights do not fit: {} of {} are right; z is that of the middle of the box, in the world frame",
    "size": "sizes do not fit: {} of {} are right; sizes are whole lengths, widths and heights in metres",
    "heading": "headings look random: {} of {} are right, of boxes apart from quarters of a turn; are they degrees "
    "instead of radians, or not predicted? They are counted counter-clockwise from x, of boxes from that of the world",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SanityReport(FrozenMappings):
    """What a few samples say on predictions as a whole.

    Attributes:
        samples: how many were looked at.
        warnings: sentences; none if nothing looks wrong.
        compared: how much of the truth was compared, and is hit by the predictions as they are given.
        sought: the mistakes that there was enough evidence to notice; if there are none, nothing can be said.
    """

    samples: int
    warnings: tuple[str, ...]
    compared: str = ""
    sought: tuple[str, ...] = ()

    def to_text(self) -> str:
        """Say how much was compared, which mistakes were looked for, and what was found."""
        lines = (
            f"Sanity check of {counted(self.samples, 'sample')}: {self.compared}",
            self.warnings_text(),
            self.verdict,
        )
        return "\n".join(filter(None, lines))

    @property
    def verdict(self) -> str:
        """Which mistakes were not made, or that nothing can be said; empty beside warnings of mistakes."""
        if not self.sought:
            return "Cannot say whether a mistake was made: there is too little to compare."
        return (
            "" if self.warnings else f"None of these mistakes was found: {', '.join(self.sought)}."
        )

    def warnings_text(self) -> str:
        """Return the warnings alone, a line each; empty if there is none."""
        return "\n".join(f"WARNING: {warning}" for warning in self.warnings)


def check_sanity(
    dataset: Dataset,
    results: Results,
    setup: EvaluationSetup,
    tokens: Collection[str],
    **how: Unpack[Engine],
) -> SanityReport:
    """Whether predictions look as if a classic mistake was made in all of them; or empty, or constant.

    Correct predictions raise no suspicion, nor do bad ones that make none of these mistakes. Looked at are 20 samples,
    or 60 of accident lists and plans, always the same.

    Args:
        dataset: the release.
        results: the predictions.
        setup: the rules that they are evaluated by.
        tokens: the samples that are evaluated, each with a prediction.
        **how: `workers` (1 if not given), `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        EvaluationError: the results are not of a kind that the task takes, or there is no sample.
    """
    if not tokens:
        raise EvaluationError(
            f"{results.path}: there is no sample to look at, so that nothing can be compared"
        )
    lists = results.task == "accident"
    alarmed = [token for token in tokens if lists and results.prediction(token)]  # few may be
    most = LISTS if results.task in ("accident", "planning") else SAMPLES
    drawn = np.random.default_rng(0).permutation(sorted(alarmed or tokens))[:most].tolist()
    loader = SampleLoader(dataset, results, setup)
    how = {"workers": 1, **how}
    seen = run_batch(partial(_seen, loader), drawn, places=loader.places, **how)
    ranked = not lists or setup.task == "warning" or isinstance(setup.rules, BoxAccidents)
    sums = summed(one.tallies for one in seen)
    hit, whole = sums.get("place", np.zeros((4, 1)))[2:].sum(axis=1)
    evidence = _EVIDENCE[results.task]
    return SanityReport(
        samples=len(seen),
        warnings=(*mistakes_of(sums, results.task), *facts_of(seen, ranked=ranked)),
        compared=f"{hit:,.0f} of {whole:,.0f} {_THINGS[results.task]} are hit as they are given",
        sought=tuple(
            name
            for name in filter(sums.__contains__, chain(*_SAYS.values()))
            if sums[name][:2].max() >= evidence
        ),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """What one sample says.

    Attributes:
        tallies: mistake → (4, N) what is hit once it is undone and how much there is, then both as given. Of N such
            measurements, the worst one counts. Of classes, (C, C) how many of the true boxes of each class (rows)
            are found under the name of each (columns). A group's name → the same of all its things as given.
        empty: whether nothing is predicted.
        scores: of all boxes or accidents.
        probabilities: whether all logits are in [0, 1].
    """

    tallies: Mapping[str, FloatArray]
    empty: bool = False
    scores: Sequence[float] = ()
    probabilities: bool = False


def _seen(loader: SampleLoader, token: str) -> Seen:
    """Look at a sample."""
    return _LOOKS[loader.results.task](loader, token, *loader(token))


def summed(tallies: Iterable[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Add up the tallies of each name."""
    sums: dict[str, FloatArray] = {}
    for one in tallies:
        sums |= {name: sums.get(name, 0.0) + tally for name, tally in one.items()}
    return sums


def mistakes_of(sums: Mapping[str, FloatArray], task: str) -> Iterator[str]:
    """What undoing a mistake shows: of a group at most the best one, and nothing beside a wrong place or time."""
    for group, says in _SAYS.items():
        suspected = []
        for name in filter(sums.__contains__, says):
            tally = class_tally(sums[name]) if name == _CLASSES else sums[name]
            score, given = map(_worst, tally[::2], tally[1::2])
            if (
                score >= max(_LEAST.get(group, 0.5), _MARGIN * given)
                and tally[0].sum() >= _EVIDENCE[task]
            ):
                suspected.append((score, given, name))
        if suspected:
            score, given, name = max(suspected, key=itemgetter(0))
            yield f"{name}: {says[name]} ({score:.0%} of the truth is hit once that is undone, {given:.0%} as it is)"
            if group in ("place", "time"):
                return
        elif group in _UNFIT and group in sums:
            right, whole = sums[group][2:, 0].astype(int).tolist()
            if (
                whole >= max(_EVIDENCE[task], _LEAST["place"] * sums["place"][1].sum())
                and right < whole / 2
            ):
                yield _UNFIT[group].format(right, whole)


def _worst(part: FloatArray, whole: FloatArray) -> float:
    tells = whole > 0
    return float((part[tells] / whole[tells]).min(initial=1.0))


def facts_of(seen: Sequence[Seen], *, ranked: bool) -> Iterator[str]:
    """What shows without the labels."""
    if all(each.empty for each in seen):
        yield f"all {len(seen)} predictions looked at are empty: nothing is predicted in them"
    scores = [score for each in seen for score in each.scores]
    if ranked and len(scores) > 1 and len(set(scores)) == 1:
        yield (
            f"all {len(scores)} scores are {scores[0]:g}: numbers that depend on their order, such as an average "
            "precision, then say little; give surer predictions higher scores"
        )
    if any(each.probabilities for each in seen) and all(
        each.probabilities or each.empty for each in seen
    ):
        yield (
            "all values of the heads' segmentation are between 0 and 1: write logits and not probabilities, which the "
            "released accident rule takes for actors everywhere"
        )


def _distance(first: FloatArray, second: FloatArray) -> Any:
    return np.linalg.norm(first - second, axis=-1)


def _difference(first: Any, second: Any) -> Any:
    return np.abs(first - second)


def _turn(first: FloatArray, second: FloatArray, period: float = 2 * np.pi) -> Any:
    return np.abs((first - second + period / 2) % period - period / 2)


def tally_of(undone: ArrayLike, given: ArrayLike, whole: ArrayLike) -> FloatArray:
    """(4, 1) of which of some things are hit."""
    return np.array([[np.sum(undone)], [whole], [np.sum(given)], [whole]], dtype=np.float64)


def tallies_of(
    group: str,
    undone: Mapping[str, Any],
    given: Any,
    true: Any,
    near: ArrayLike,
    apart: Callable[[Any, Any], Any] = _difference,
) -> dict[str, FloatArray]:
    """Tally which of N things are right, as they are given and once each mistake is undone.

    Only things tell that cannot be right in both ways.

    Args:
        group: of the mistakes.
        undone: name of a mistake → the things without it.
        given: the things as they are predicted.
        true: what they should be; NaN where that is not known.
        near: how far a right thing may be off.
        apart: says how far things are from others.
    """
    off = apart(given, true)
    tallies = {group: tally_of(0, off <= near, np.isfinite(off).sum())}
    for name, things in undone.items():
        tells = np.isfinite(off) & (apart(things, given) > 2 * np.asarray(near))
        tallies[name] = tally_of(
            tells & (apart(things, true) <= near), tells & (off <= near), tells.sum()
        )
    return tallies


def _motion_seen(
    _: SampleLoader, __: str, prediction: MotionOutput, label: MotionLabels, *___: object
) -> Seen:
    """Compare the cells of actors: for places in the present frame, for times where the frames differ."""
    frames, grid = frames_there(label), label.config.grid
    true = grid.reorient(labels_at_present(label).segmentation[:frames] == 1, "devkit")
    every = prediction.grid.reorient(actor_cells(prediction), "devkit")
    given = every[:frames]
    axes_of = {name: axes for name, axes in _AXES.items() if grid.x == grid.y or axes[2] == 1} | {
        "place": (1, 1, 1)
    }
    tallies = {
        name: _overlap(_turned_maps(given[:1], *axes), true[:1], given[:1])
        for name, axes in axes_of.items()
    }
    changing = true.any(axis=0) & ~true.all(axis=0)
    true, given, backwards = true & changing, given & changing, every[::-1][:frames] & changing
    times = {"frames reversed": _overlap(backwards, true, given)}
    if frames > FEWEST_FRAMES:
        times["one step late"] = _overlap(given[1:], true[:-1], given[:-1])
    tallies |= {
        name: np.pad(each, ((0, 0), (0, len(every) - each.shape[1])))
        for name, each in times.items()
    }
    values, empty = [heads.segmentation for heads in (prediction.heads or ())[-1:]], not every.any()
    probabilities = not empty and any(each.min() >= 0 and each.max() <= 1 for each in values)
    return Seen(tallies=tallies, empty=empty, probabilities=probabilities)


def _turned_maps(maps: AnyArray, x: int, y: int, order: int) -> AnyArray:
    """Maps (T, rows, columns) in the devkit's orientation with other axes."""
    return (maps if order == 1 else maps.swapaxes(1, 2))[:, ::y, ::x]


def _turned(points: FloatArray, x: int, y: int, order: int) -> FloatArray:
    """Points (N, 2) or (N, 3) with other axes."""
    return np.column_stack([points[:, :2][:, ::order] * (x, y), points[:, 2:]])


def _overlap(undone: AnyArray, true: AnyArray, given: AnyArray) -> FloatArray:
    """(4, T) cells of the intersections and unions, frame by frame."""
    cells = (undone & true, undone | true, given & true, given | true)
    return np.array([each.sum(axis=(1, 2)) for each in cells], dtype=np.float64)


def _detection_seen(loader: SampleLoader, token: str, _: object, truth: Boxes) -> Seen:
    """Compare detections with the boxes of others, both in the world frame: first their places."""
    found: Any = loader.results.prediction(token)  # in the world
    world = loader.dataset.boxes(token, "world")
    true = world.select(np.isin(world.actor_id, truth.actor_id) & (world.actor_id != OWN_ACTOR_ID))
    if not len(found) or not len(true):
        return Seen(tallies={}, empty=not len(found), scores=found.scores.tolist())
    boxes = found.boxes.select(columns_of(found.boxes, found.scores).surest_first[: 2 * len(true)])
    center, at = boxes.center, true.center
    rows, moved = _nearest(center, at), _moved_back(loader.dataset, token, center)
    undone = {name: each[_nearest(each, at)] * _SCALE for name, each in moved.items()}
    way = LABEL_STEP * true.velocity
    length = _distance(way, np.zeros(3))
    moving = np.where(length[:, None] >= LABEL_STEP * MOVING, at, np.nan)
    late = {"one step late": center[_nearest(center, at - way)] + way}
    is_found = _distance(center[rows, :2], at[:, :2]) < _NEAR
    tallies = {
        **tallies_of("place", undone, center[rows] * _SCALE, at * _SCALE, _NEAR, _distance),
        **tallies_of("time", late, center[rows], moving, length / 4, _distance),
        **_pair_tallies(boxes.select(rows[is_found]), true.select(is_found)),
        "place": tally_of(0, is_found, len(true)),
    }
    return Seen(tallies=tallies, scores=found.scores.tolist())


def _nearest(found: FloatArray, true: FloatArray) -> IntArray:
    """(N,) rows of what is found (K, 3) nearest to true places (N, 3) on the ground."""
    return np.asarray(_distance(true[:, None, :2], found[:, :2]).argmin(axis=1))


def _pair_tallies(found: Boxes, true: Boxes) -> dict[str, FloatArray]:
    """Compare N true boxes with those found at their places on the ground."""
    z, height, size, velocity = (
        found.center[:, 2],
        true.size[:, 2],
        found.size,
        found.velocity[:, :2],
    )
    heights = {name: z + part * height for name, part in _HEIGHTS.items()}
    sizes = {name: factor * size[:, np.argsort(order)] for name, (order, factor) in _SIZES.items()}
    velocities = {name: factor * velocity for name, factor in _VELOCITIES.items()}
    speed = np.hypot(*true.velocity[:, :2].T)
    moving = np.where(speed[:, None] >= MOVING, true.velocity[:, :2], np.nan)
    turn = _turn(found.yaw, true.yaw, np.pi / 2)
    names = np.zeros((len(CATEGORIES), len(CATEGORIES)))
    np.add.at(names, (true.category, found.category), 1)
    return {
        **tallies_of("height", heights, z, true.center[:, 2], _ALIKE * height),
        **tallies_of("size", sizes, size, true.size, _ALIKE * true.size),
        **tallies_of("velocity", velocities, velocity, moving, _ALIKE * speed, _distance),
        "heading": tally_of(0, turn <= STRAIGHT, len(true)),
        _CLASSES: names,
    }


def _moved_back(dataset: Dataset, token: str, center: FloatArray) -> dict[str, FloatArray]:
    """Mistake → the centres (N, 3) in the world where they should be."""
    ego, lidar = (dataset.world_from(token, name) for name in ("ego", "lidar"))
    in_ego = ego.inverse().apply(center)
    return {
        **{name: ego.apply(_turned(in_ego, *axes)) for name, axes in _AXES.items()},
        "ego frame for world frame": ego.apply(center),
        "LiDAR frame for world frame": lidar.apply(center),
        "LiDAR frame for ego frame": lidar.apply(in_ego),
        "ego frame for LiDAR frame": ego.apply(lidar.inverse().apply(center)),
    }


def class_tally(names: FloatArray) -> FloatArray:
    """(4, N) of the N classes that are mostly found under the name of another one, each of a different one."""
    number = names.sum(axis=1)
    other = names.argmax(axis=1)
    changed = np.flatnonzero((other != np.arange(len(names))) & (number >= _FEWEST))
    alone = len(changed) == 1 and 2 * number[changed].sum() < number.sum()
    if alone or len(set(other[changed])) < len(changed):
        changed = changed[
            :0
        ]  # a rare class, or several, that are taken for another: no mistake of order
    whole = number[changed]
    return np.array([names[changed, other[changed]], whole, names[changed, changed], whole])


def _accidents_seen(
    loader: SampleLoader,
    token: str,
    alarms: Sequence[Accident],
    _: object,
    context: AccidentContext,
) -> Seen:
    """Compare the surest accident with the true one: its places, and its time."""
    tallies: dict[str, FloatArray] = {}
    true = context.truth and context.truth.accident
    if alarms and true:
        surest = min(alarms, key=by_sureness)
        time, places = surest.time, _places_undone(loader.dataset, token, surest.positions)
        times = {
            "one step late": time - LABEL_STEP,
            "frames reversed": loader.setup.horizon - time,
            "times in frames": time * FRAME_PERIOD,
        }
        tallies |= tallies_of(
            "place", places, surest.positions, true.positions, 2 * _NEAR, position_difference
        )
        tallies |= tallies_of("time", times, time, true.time, NEAR_IN_TIME)
    return Seen(tallies=tallies, empty=not alarms, scores=[each.score for each in alarms])


def _places_undone(dataset: Dataset, token: str, places: FloatArray) -> dict[str, FloatArray]:
    """Mistake → places (N, 2) in the present ego frame where they should be."""
    in_world = np.column_stack([places, np.zeros(len(places))])
    in_ego = dataset.world_from(token, "ego").inverse().apply(in_world)[:, :2]
    return {name: _turned(places, *axes) for name, axes in _AXES.items()} | {
        "world frame for ego frame": in_ego
    }


def _plan_seen(
    loader: SampleLoader, token: str, plans: Sequence[Plan], scene: PlanningScene
) -> Seen:
    """Compare the best plan with the recorded path, and its headings with the recorded ones."""
    plan = max(plans, key=lambda plan: plan.score)
    tallies = _path_tallies(
        loader, token, plan.times, plan.path, np.zeros(2), scene.recorded[_FRAMES, :2]
    )
    if plan.yaw is not None:
        undone = {name: factor * plan.yaw + offset for name, (factor, offset) in _YAWS.items()}
        undone[_DEGREES] = np.where(np.abs(plan.yaw) > _LARGE_YAW, np.deg2rad(plan.yaw), plan.yaw)
        times = np.arange(len(scene.recorded)) * FRAME_PERIOD
        yaw = np.interp(plan.times, times, scene.recorded[:, 2], right=np.nan)
        tallies |= tallies_of("heading", undone, plan.yaw, yaw, STRAIGHT, _turn)
    return Seen(tallies=tallies)


def _forecasts_seen(
    loader: SampleLoader, token: str, forecasts: Sequence[Forecast], truth: ForecastingTruth
) -> Seen:
    """Compare the most probable path of each actor with the recorded one."""
    tallies = []
    for forecast in forecasts:
        for row in np.flatnonzero(truth.actor_id == forecast.actor_id):
            path, present = forecast.paths[np.argmax(forecast.probabilities)], truth.present[row]
            true = np.vstack([present, truth.path[row]])[_FRAMES]
            tallies.append(_path_tallies(loader, token, forecast.times, path, present, true))
    return Seen(tallies=summed(tallies), empty=not forecasts)


def _path_tallies(
    loader: SampleLoader,
    token: str,
    times: FloatArray,
    path: FloatArray,
    present: FloatArray,
    true: FloatArray,
) -> dict[str, FloatArray]:
    """Compare a path (T, 2) from a present place (2,) with the first true places (S, 2) at `_STEPS`."""
    places = _places_undone(loader.dataset, token, path)
    paths = {name: (times, each) for name, each in places.items()} | {
        "steps for places": (times, present + path.cumsum(axis=0)),
        "places from the actor": (times, present + path),
        "one step late": (times - LABEL_STEP, path),
        "one step early": (times + LABEL_STEP, path),
        "times in frames": (times * FRAME_PERIOD, path),
        "times in milliseconds": (times / 1000, path),
        "": (times, path),
    }
    true = true[: np.count_nonzero(times[-1] + SAME_TIME >= _STEPS)]
    undone = {
        name: _places_at(when, where, present)[: len(true)] for name, (when, where) in paths.items()
    }
    given = undone.pop("")
    near = np.maximum(_NEAR_ON_PATH, _distance(true, present) / 10)
    return tallies_of("place", undone, given, true, near, _distance)


def _places_at(times: FloatArray, path: FloatArray, present: FloatArray) -> FloatArray:
    """(S, 2) where a path (T, 2) is at `_STEPS`: from the present place on, and in the end where it ends."""
    if times[0] > 0:
        times, path = np.append(0.0, times), np.vstack([present, path])
    return np.column_stack([np.interp(_STEPS, times, values) for values in path.T])


# Kind of results → what looks at a sample, by its token, prediction and truth.
_LOOKS: Final[Mapping[str, Callable[..., Seen]]] = {
    "motion": _motion_seen,
    "accident": _accidents_seen,
    "detection": _detection_seen,
    "planning": _plan_seen,
    "forecasting": _forecasts_seen,
}
