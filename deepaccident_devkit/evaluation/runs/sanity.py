"""`check_sanity`: do the predictions fit the labels much better once a classic mistake is undone?

A mistake is a transform that undoes it. Of each sample it says which part of the truth the predictions hit once it is
undone, and which part as they are given. These parts are summed over the samples; the mistake is suspected if the
first share is large enough, and clearly larger than the second.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import AccidentContext, BoxAccidents
from deepaccident_devkit.evaluation.accident_truth import LABEL_STEP, by_sureness, position_difference
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.detection.boxes import columns_of
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput, frames_there, labels_at_present
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.evaluation.task import FrozenMappings
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine

__all__ = ["SanityReport", "check_sanity"]

Group = Literal["place", "time", "size", "class"]
NOTHING_WRONG: Final = "Nothing looks wrong with the predictions."
_AXES: Final = {
    "x mirrored": (-1, 2),
    "y mirrored": (1, -2),
    "x and y mirrored": (-1, -2),
    "x and y swapped": (2, 1),
    "x and y swapped and mirrored": (-2, -1),
    "turned left": (2, -1),
    "turned right": (-2, 1),
}
"""Name → what x and y are once it is undone: 1 is the given x, 2 the given y, −2 its negative."""
SAMPLES: Final = 20
LISTS: Final = 60
"""Samples that are looked at, of maps and boxes, and of accident lists, which are short."""
_MARGIN: Final = 2.0
"""How many times as large the share has to be once a mistake is undone."""
_LEAST: Final[Mapping[Group, float]] = {"place": 0.2, "time": 0.4, "size": 0.5, "class": 0.5}
"""The share that it has to reach; in time, slow predictions reach a part, too."""
_EVIDENCE: Final = {"motion": 100, "accident": 4, "detection": 10}
"""Cells, accidents or boxes that have to be hit."""
CHECKED: Final = tuple(_EVIDENCE)
"""Kinds of results that can be checked."""
_NEAR: Final = 2.0
"""Metres: as near on the ground, a box is found, and both places of an accident are hit on average."""
_NEAR_IN_HEIGHT: Final = 0.7
"""Metres: nearer, since LiDAR and ego frame differ by the LiDAR's height alone, some 2 m."""
NEAR_IN_TIME: Final = 0.15
"""Seconds, of accidents."""
_ALIKE: Final = 0.25
"""A size is right that differs from the true one by at most this share."""
_FEWEST: Final = 5
"""Boxes of a class from which on its name tells."""
MOVING: Final = 4.0
"""m/s: within a step, slower actors do not move enough."""
STRAIGHT: Final = np.deg2rad(15)
"""A heading that is nearer to one of the true box's four directions is right; at random, a third of them are."""
_RANDOM: Final = 0.5
"""Share of right headings below which they look random."""
_ORDERS: Final = {
    f"sizes in the order {', '.join(('length', 'width', 'height')[axis] for axis in order)}": order
    for order in permutations(range(3))
    if order != (0, 1, 2)
}
_CLASSES: Final = "classes swapped"
FEWEST_FRAMES: Final = 3
"""In so few frames, slow predictions look late."""
_SAYS: Final[Mapping[Group, Mapping[str, str]]] = {
    "place": {
        **dict.fromkeys(_AXES, "x is forward and y to the left; of maps, state the orientation that they have"),
        "world frame for ego frame": "places are given in the world frame; give them in the present ego frame",
        "ego frame for world frame": 'boxes are given in the ego frame; move them by da.world_from(token, "ego")',
        "LiDAR frame for world frame": 'boxes are given in the LiDAR frame; move them by da.world_from(token, "lidar")',
        "LiDAR frame for ego frame": "boxes of the LiDAR frame were moved by the ego pose; take the LiDAR's pose",
        "ego frame for LiDAR frame": "boxes of the ego frame were moved by the LiDAR's pose; take the ego pose",
    },
    "time": {
        "frames reversed": "the first frame of a prediction is the present, and times are counted from there",
        "one step late": "frames and boxes show earlier moments; the first frame is the sample's own: no past",
    },
    "size": dict.fromkeys(
        _ORDERS, "Boxes and DetectedBoxes hold length, width, height; results files hold width, length, height"
    ),
    "class": {_CLASSES: f"the classes are, counted from 0, {', '.join(CATEGORIES)}"},
}
"""Group → mistakes that are undone on trial → what is right."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SanityReport(FrozenMappings):
    """What a few samples say on predictions as a whole.

    Attributes:
        samples: how many were looked at.
        warnings: sentences; none if nothing looks wrong.
    """

    samples: int
    warnings: tuple[str, ...]

    def to_text(self) -> str:
        """How much was looked at, and the warnings."""
        return f"Sanity check of {self.samples} samples.\n{self.warnings_text() or NOTHING_WRONG}"

    def warnings_text(self) -> str:
        """The warnings alone, a line each; empty if there is none."""
        return "\n".join(f"WARNING: {each}" for each in self.warnings)


def check_sanity(
    dataset: Dataset,
    results: Results,
    setup: EvaluationSetup,
    tokens: Collection[str],
    **how: Unpack[Engine],
) -> SanityReport:
    """Whether predictions look as if a classic mistake was made in all of them; or empty, or constant.

    Correct predictions raise no suspicion, nor do bad ones that make none of these mistakes. Looked at are 20 samples,
    or 60 of accident lists, always the same.

    Args:
        dataset: the release.
        results: the predictions.
        setup: the rules that they are evaluated by.
        tokens: the samples that are evaluated, each with a prediction.
        **how: `workers` (1 if not given), `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        EvaluationError: the results are not of a kind that the task takes, or there is no sample.
    """
    if results.task not in CHECKED:
        raise EvaluationError(
            f"{results.path}: {results.task} results have no sanity check; only {', '.join(CHECKED)} do"
        )
    lists = results.task == "accident"
    if not tokens:
        raise EvaluationError("tokens: there is no sample to look at")
    alarmed = [token for token in tokens if lists and results.prediction(token)]  # few may be
    listed = sorted(alarmed or tokens)
    drawn = np.random.default_rng(0).permutation(len(listed))[: LISTS if lists else SAMPLES]
    loader = SampleLoader(dataset, results, setup)
    how = {"workers": 1, **how}
    seen = run_batch(partial(_seen, loader), [listed[each] for each in drawn], places=loader.places, **how)
    ranked = not lists or setup.task == "warning" or isinstance(setup.rules, BoxAccidents)
    warnings = (*mistakes_of(seen, results.task), *facts_of(seen, ranked=ranked))
    return SanityReport(samples=len(seen), warnings=warnings)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """What one sample says.

    Attributes:
        tallies: mistake → (4, N) what is hit once it is undone and how much there is, then both as given. Of N such
            measurements, the worst one counts. Of classes, (C, C) how many of the true boxes of each class (rows)
            are found under the name of each (columns).
        empty: whether nothing is predicted.
        scores: of all boxes or accidents.
        probabilities: whether all logits are in [0, 1].
        headings: of the boxes found, those that are right, and all.
    """

    tallies: Mapping[str, FloatArray]
    empty: bool = False
    scores: Sequence[float] = ()
    probabilities: bool = False
    headings: tuple[int, int] = (0, 0)


def _seen(loader: SampleLoader, token: str) -> Seen:
    """Look at a sample."""
    prediction, truth, *more = loader(token)
    if isinstance(prediction, MotionOutput):
        return _motion_seen(prediction, truth)
    raw = loader.results.prediction(token)  # of boxes, in the world
    if isinstance(raw, DetectedBoxes):
        world_boxes = truth.transform(loader.dataset.world_from(token, truth.frame), "world")
        others = world_boxes.select(world_boxes.actor_id != OWN_ACTOR_ID)
        return _detection_seen(loader.dataset, token, raw, others)
    return _accidents_seen(loader, token, prediction, more[0])


def mistakes_of(seen: Sequence[Seen], task: str) -> Iterator[str]:
    """What undoing a mistake shows: of a group at most the best one, and nothing beside a wrong place."""
    sums: dict[str, FloatArray] = {}
    for name, tally in (each for one in seen for each in one.tallies.items()):
        sums[name] = sums.get(name, 0.0) + tally
    if _CLASSES in sums:
        sums[_CLASSES] = class_tally(sums[_CLASSES])
    for group, says in _SAYS.items():
        suspected = []
        for name in (each for each in says if each in sums):
            score, given = map(_worst, sums[name][::2], sums[name][1::2])
            if score >= max(_LEAST[group], _MARGIN * given) and sums[name][0].sum() >= _EVIDENCE[task]:
                suspected.append((score, given, name))
        if suspected:
            score, given, name = max(suspected, key=lambda each: each[0])
            yield f"{name}: {says[name]} ({score:.0%} of the truth is hit once that is undone, {given:.0%} as it is)"
            if group == "place":
                return
    right, every = (sum(each.headings[index] for each in seen) for index in (0, 1))
    if every >= _EVIDENCE["detection"] and right < _RANDOM * every:
        yield (
            f"headings look random: {right} of {every} are right, apart from quarters of a turn; are they degrees in "
            "place of radians, or not predicted? A heading is counted counter-clockwise from x of the world"
        )


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
    if any(each.probabilities for each in seen) and all(each.probabilities or each.empty for each in seen):
        yield (
            "all values of the heads' segmentation are between 0 and 1: write logits and not probabilities, which the "
            "released accident rule takes for actors everywhere"
        )


def tally_of(undone: ArrayLike, given: ArrayLike, whole: float) -> FloatArray:
    """(4, 1) of which of some things are hit."""
    return np.array([[np.sum(undone)], [whole], [np.sum(given)], [whole]], dtype=np.float64)


def _motion_seen(prediction: MotionOutput, label: MotionLabels) -> Seen:
    """Compare the cells of actors: for places in the present frame, for times where the frames differ."""
    frames, grid = frames_there(label), label.config.grid
    true = grid.reorient(labels_at_present(label).segmentation[:frames] == 1, "devkit")
    every = prediction.grid.reorient(_actor_cells(prediction), "devkit")
    given = every[:frames]
    places = {
        name: _turned_maps(given[:1], axes) for name, axes in _AXES.items() if grid.x == grid.y or abs(axes[0]) == 1
    }
    tallies = {name: _overlap(undone, true[:1], given[:1], true[:1]) for name, undone in places.items()}
    changing = np.asarray(true.any(axis=0) & ~true.all(axis=0))
    true, given, backwards = true & changing, given & changing, every[::-1][:frames] & changing
    times = {"frames reversed": _overlap(backwards, true, given, true)}
    if frames > FEWEST_FRAMES:
        times["one step late"] = _overlap(given[1:], true[:-1], given[1:], true[1:])
    tallies |= {name: np.pad(each, ((0, 0), (0, len(every) - each.shape[1]))) for name, each in times.items()}
    values = (prediction.heads or ())[-1].segmentation if prediction.instances is None else None
    empty = not every.any()
    probabilities = values is not None and not empty and bool(values.min() >= 0 and values.max() <= 1)
    return Seen(tallies=tallies, empty=empty, probabilities=probabilities)


def _actor_cells(prediction: MotionOutput) -> BoolArray:
    """(T, H, W) which cells are actors in the last prediction, as it lies."""
    if prediction.instances is not None:
        return np.asarray(prediction.instances[-1] > 0)
    segmentation = (prediction.heads or ())[-1].segmentation
    return np.asarray(segmentation[:, 1] > segmentation[:, 0])


def _turned_maps(maps: AnyArray, axes: tuple[int, int]) -> AnyArray:
    """Maps (T, rows, columns) in the devkit's orientation with other axes."""
    x, y = axes
    laid = maps if abs(x) == 1 else maps.swapaxes(1, 2)
    return laid[:, :: np.sign(y), :: np.sign(x)]


def _turned(points: FloatArray, axes: tuple[int, int]) -> FloatArray:
    """Points (N, 2) or (N, 3) with other axes."""
    x, y = (np.sign(axis) * points[:, abs(axis) - 1] for axis in axes)
    return np.column_stack([x, y, points[:, 2:]])


def _overlap(undone: AnyArray, true: AnyArray, given: AnyArray, given_true: AnyArray) -> FloatArray:
    """(4, T) cells of the intersections and unions, frame by frame."""
    cells = (undone & true, undone | true, given & given_true, given | given_true)
    return np.array([each.sum(axis=(1, 2)) for each in cells], dtype=np.float64)


def _detection_seen(dataset: Dataset, token: str, found: DetectedBoxes, truth: Boxes) -> Seen:
    """Compare detections with the boxes of others, both in the world frame: first their places."""
    scores: list[float] = found.scores.tolist()
    if not len(found) or not len(truth):
        return Seen(tallies={}, empty=not len(found), scores=scores)
    boxes = found.boxes.select(columns_of(found.boxes, found.scores).surest_first[: 2 * len(truth)])
    near = are_near(boxes.center, truth.center)
    hits = near.any(axis=1)
    tallies = {
        name: tally_of(are_near(center, truth.center).any(axis=1), hits, len(truth))
        for name, center in _moved_back(dataset, token, boxes.center).items()
    }
    world = dataset.boxes(token, "world")  # the velocities of some protocols are in another frame
    moving = world.select(
        np.isin(world.actor_id, truth.actor_id) & (np.linalg.norm(world.velocity[:, :2], axis=1) >= MOVING)
    )
    way = LABEL_STEP * moving.velocity[:, :2]
    late, there = (are_followed(boxes.center, moving.center[:, :2] - off, way) for off in (way, 0))
    tallies["one step late"] = tally_of(late, there, len(moving))
    nearest = np.linalg.norm(truth.center[:, None] - boxes.center, axis=-1).argmin(axis=1)
    return _pairs_seen(boxes.select(nearest[hits]), truth.select(hits), Seen(tallies=tallies, scores=scores))


def _pairs_seen(found: Boxes, true: Boxes, seen: Seen) -> Seen:
    """Compare the sizes, headings and classes of true boxes with those of the boxes found there."""
    sizes = {}
    for name, order in _ORDERS.items():
        tells = ~are_of_one_size(true.size[:, order], true.size)
        given, undone = (
            are_of_one_size(size, true.size)[tells] for size in (found.size, found.size[:, np.argsort(order)])
        )
        sizes[name] = tally_of(undone, given, int(tells.sum()))
    turn = np.abs((found.yaw - true.yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    names = np.zeros((len(CATEGORIES), len(CATEGORIES)))
    np.add.at(names, (true.category, found.category), 1)
    right = int(np.count_nonzero(turn <= STRAIGHT))
    return replace(seen, tallies={**seen.tallies, **sizes, _CLASSES: names}, headings=(right, len(true)))


def are_near(found: FloatArray, true: FloatArray) -> BoolArray:
    """(M, N) whether true centres and found ones are near each other."""
    apart = true[:, None] - found
    return np.asarray(np.hypot(apart[..., 0], apart[..., 1]) < _NEAR) & (np.abs(apart[..., 2]) < _NEAR_IN_HEIGHT)


def are_followed(found: FloatArray, places: FloatArray, way: FloatArray) -> BoolArray:
    """(M,) whether anything found is at places (M, 2), as near as a quarter of the way from there."""
    apart = np.linalg.norm(places[:, None] - found[:, :2], axis=-1)
    return np.asarray(apart.min(axis=1) < np.linalg.norm(way, axis=-1) / 4)


def _moved_back(dataset: Dataset, token: str, center: FloatArray) -> dict[str, FloatArray]:
    """Mistake → the centres (N, 3) in the world where they should be."""
    ego, lidar = (dataset.world_from(token, name) for name in ("ego", "lidar"))
    in_ego = ego.inverse().apply(center)
    return {
        **{name: ego.apply(_turned(in_ego, axes)) for name, axes in _AXES.items()},
        "ego frame for world frame": ego.apply(center),
        "LiDAR frame for world frame": lidar.apply(center),
        "LiDAR frame for ego frame": lidar.apply(in_ego),
        "ego frame for LiDAR frame": ego.apply(lidar.inverse().apply(center)),
    }


def are_of_one_size(found: FloatArray, true: FloatArray) -> BoolArray:
    """(N,) whether sizes (N, 3) are alike."""
    return np.asarray((np.abs(found - true) <= _ALIKE * true).all(axis=1))


def class_tally(names: FloatArray) -> FloatArray:
    """(4, N) of the N classes that are mostly found under the name of another one, each of a different one."""
    number = names.sum(axis=1)
    other = names.argmax(axis=1)
    changed = np.flatnonzero((other != np.arange(len(names))) & (number >= _FEWEST))
    alone = len(changed) == 1 and 2 * number[changed].sum() < number.sum()
    if alone or len(set(other[changed])) < len(changed):
        changed = changed[:0]  # a rare class, or several, that are taken for another: no mistake of order
    whole = number[changed]
    return np.array([names[changed, other[changed]], whole, names[changed, changed], whole])


def _accidents_seen(loader: SampleLoader, token: str, alarms: Sequence[Accident], context: AccidentContext) -> Seen:
    """Compare the surest accident with the true one: its places, and its time."""
    scores = [each.score for each in alarms]
    if not alarms:
        return Seen(tallies={}, empty=True)
    surest = min(alarms, key=by_sureness)
    if context.truth is None or context.truth.accident is None:
        return Seen(tallies={}, scores=scores)
    true, given = context.truth.accident, surest.positions
    world = np.column_stack([given, np.zeros(2)])
    places = {name: _turned(given, axes) for name, axes in _AXES.items()}
    places["world frame for ego frame"] = loader.dataset.world_from(token, "ego").inverse().apply(world)[:, :2]
    tallies = {
        name: accident_tally(
            position_difference(undone, true.positions),
            position_difference(given, true.positions),
            position_difference(undone, given),
            2 * _NEAR,
        )
        for name, undone in places.items()
    }
    times = {"one step late": surest.time - LABEL_STEP, "frames reversed": loader.setup.horizon - surest.time}
    tallies |= {
        name: accident_tally(
            abs(undone - true.time), abs(surest.time - true.time), abs(undone - surest.time), NEAR_IN_TIME
        )
        for name, undone in times.items()
    }
    return Seen(tallies=tallies, scores=scores)


def accident_tally(undone: float, given: float, change: float, near: float) -> FloatArray:
    """Whether the truth is as near, where both cannot be."""
    tells = change > 2 * near
    return tally_of(tells and undone <= near, tells and given <= near, tells)
