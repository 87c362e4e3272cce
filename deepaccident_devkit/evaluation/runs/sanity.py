"""`check_sanity`: do the predictions fit the labels much better once a classic mistake is undone?

A mistake is a transform that undoes it. Each sample shows which part of the truth the predictions
hit once the mistake is undone, and which part they hit unchanged. These parts are summed over the
samples. A mistake is suspected if the first share is large enough, and clearly larger than the
second. If no mistake is suspected, but most sizes, heights or headings of boxes at the right
position are wrong, a warning reports that instead.
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

# Mistake → the signs of x and y that undo it, and −1 if x and y are swapped before. x right,
# y forward is `turned left`. If two mistakes explain the same, as on a straight path, the earlier
# one is reported.
_AXES: Final = {
    "x mirrored": (-1, 1, 1),
    "y mirrored": (1, -1, 1),
    "turned left": (1, -1, -1),
    "turned right": (-1, 1, -1),
    "x and y mirrored": (-1, -1, 1),
    "x and y swapped": (1, 1, -1),
    "x and y swapped and mirrored": (-1, -1, -1),
}
# Number of samples that are examined.
SAMPLE_COUNT: Final = 20
# The same for accident lists and plans, which are short.
LIST_COUNT: Final = 60
# Factor by which undoing a mistake has to raise the share.
_MIN_GAIN: Final = 2.0
# Share that has to be reached, by default one half. For times, slow predictions reach a part, too.
_MIN_SHARES: Final[Mapping[str, float]] = {"place": 0.2, "time": 0.4}
_DEFAULT_MIN_SHARE: Final = 0.5
# Number of cells, accidents, boxes, or positions of paths that have to be hit.
_MIN_HITS: Final = {
    "motion": 100,
    "accident": 4,
    "detection": 10,
    "planning": 10,
    "forecasting": 10,
}
_UNITS: Final = dict(
    zip(_MIN_HITS, ("cells", "accidents", "true boxes", "places", "places"), strict=True)
)
# Within this distance on the ground a box matches; of an accident, the mean over both positions.
_POSITION_TOLERANCE_M: Final = 2.0
# In height the tolerance is smaller, 0.7 m, since LiDAR and ego frame differ only by the height of
# the LiDAR, about 2 m.
_AXIS_WEIGHTS: Final = np.array([1, 1, _POSITION_TOLERANCE_M / 0.7])
# Tolerance of the time of an accident.
TIME_TOLERANCE_S: Final = 0.15
# Tolerance of positions on a path, or a tenth of the distance travelled if that is more.
_PATH_TOLERANCE_M: Final = 1.0
# Tolerated error of a box's size, of its height above the ground or of its velocity, as a share.
_RELATIVE_TOLERANCE: Final = 0.2
# Number of true boxes that a class needs before its name is judged.
_MIN_CLASS_BOXES: Final = 5
# Slower actors do not move enough within a step.
MIN_SPEED_MPS: Final = 4.0
# Within this angle (radians) to one of the true box's four directions a heading is right; of random
# headings, one third is.
HEADING_TOLERANCE_RAD: Final = np.deg2rad(15)
_SIZE_AXES: Final = ("length", "width", "height")
# Mistake → the order of the predicted sizes, and the factor that undoes it.
_SIZES: Final = {
    f"sizes in the order {', '.join(_SIZE_AXES[axis] for axis in order)}": (order, 1.0)
    for order in permutations(range(3))
    if order != (0, 1, 2)
} | {"half sizes": ((0, 1, 2), 2.0), "double sizes": ((0, 1, 2), 0.5)}
# Mistake → share of the box's height that is added to undo it.
_HEIGHTS: Final = {"z of the lower face": 0.5, "z of the upper face": -0.5}
_VELOCITIES: Final = {
    "velocities per frame": 1 / FRAME_PERIOD,
    "velocities per step": 1 / LABEL_STEP,
}
_DEGREES: Final = "yaw in degrees"
# Mistake → the factor of headings and the angle added to them that undo it.
_YAWS: Final = {
    "yaw clockwise": (-1.0, 0.0),
    "yaw from y": (1.0, np.pi / 2),
    "yaw from −y": (1.0, -np.pi / 2),
    "yaw clockwise from y": (-1.0, np.pi / 2),
    "yaw backwards": (1.0, np.pi),
}
# A larger heading may be in degrees. A small one would be near 0 after the change, as most headings
# are, whatever was wrong with it.
_MAX_YAW_RAD: Final = 4.0
_CLASSES: Final = "classes swapped"
# Times, in seconds, at which paths are compared.
_STEP_TIMES: Final = np.arange(1, 7) * LABEL_STEP
# The same times in frames after the present one.
_STEP_FRAMES: Final = slice(5, 31, 5)
# Slow predictions look late in this number of frames or fewer.
FEW_FRAMES: Final = 3
_SECONDS: Final = "times are in seconds after the present"
# Group → mistakes that are undone on trial → the remedy.
_REMEDIES: Final[Mapping[str, Mapping[str, str]]] = {
    "place": {
        **dict.fromkeys(
            _AXES, "x is forward and y to the left; of maps, state the orientation that they have"
        ),
        "world frame for ego frame": "places are given in the world frame; give them in the "
        "present ego frame",
        "ego frame for world frame": "boxes are given in the ego frame; move them by "
        'da.world_from(token, "ego")',
        "LiDAR frame for world frame": "boxes are given in the LiDAR frame; move them by "
        'da.world_from(token, "lidar")',
        "LiDAR frame for ego frame": "boxes of the LiDAR frame were moved by the ego pose; take "
        "the LiDAR's pose",
        "ego frame for LiDAR frame": "boxes of the ego frame were moved by the LiDAR's pose; take "
        "the ego pose",
    },
    "time": {
        "frames reversed": "the first frame of a prediction is the present, and times are counted "
        "from there",
        "one step late": "earlier moments are shown; the first frame, or time 0, is the sample's "
        "own: no past",
        "one step early": "later moments are shown; the first frame, or time 0, is the sample's "
        "own",
        "steps for places": "a path holds places; add up the steps",
        "places from the actor": "a path begins where the actor is in the present ego frame, not "
        "at 0, 0",
        "times in frames": _SECONDS,
        "times in milliseconds": _SECONDS,
    },
    "height": dict.fromkeys(_HEIGHTS, "z is that of the middle of the box"),
    "size": dict.fromkeys(
        _SIZES,
        "Boxes and DetectedBoxes hold whole lengths, widths, heights; results files hold width, "
        "length, height",
    ),
    "heading": dict.fromkeys(
        (_DEGREES, *_YAWS), "yaw is in radians, counter-clockwise from x of the present ego frame"
    ),
    "velocity": dict.fromkeys(_VELOCITIES, "velocities are in m/s"),
    "class": {_CLASSES: f"the classes are, counted from 0, {', '.join(CATEGORIES)}"},
}
# Group → warning if most values of matched boxes are wrong, and no mistake explains it.
_UNEXPLAINED: Final[Mapping[str, str]] = {
    "height": "heights do not fit: {} of {} are right; z is that of the middle of the box, in the "
    "world frame",
    "size": "sizes do not fit: {} of {} are right; sizes are whole lengths, widths and heights in "
    "metres",
    "heading": "headings look random: {} of {} are right, of boxes apart from quarters of a turn; "
    "are they degrees instead of radians, or not predicted? They are counted "
    "counter-clockwise from x, of boxes from that of the world",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SanityReport(FrozenMappings):
    """Findings of a few samples on the predictions in general.

    Attributes:
        samples: Number of samples that were examined.
        warnings: Sentences; empty if nothing looks wrong.
        compared: Sentence on how much of the truth was compared, and how much the predictions hit.
        sought: Names of the mistakes that there was enough evidence to notice; empty if nothing can
            be concluded.
    """

    samples: int
    warnings: tuple[str, ...]
    compared: str = ""
    sought: tuple[str, ...] = ()

    def to_text(self) -> str:
        """State how much was compared, which mistakes were looked for, and what was found."""
        head = f"Sanity check of {counted(self.samples, 'sample')}: {self.compared}"
        lines = (head, self.warnings_text(), self.verdict)
        return "\n".join(filter(None, lines))

    @property
    def verdict(self) -> str:
        """The mistakes that were ruled out, or that nothing can be said; empty beside warnings."""
        if not self.sought:
            return "Cannot say whether a mistake was made: there is too little to compare."
        if self.warnings:
            return ""
        return f"None of these mistakes was found: {', '.join(self.sought)}."

    def warnings_text(self) -> str:
        """Return only the warnings, one a line; empty without any."""
        return "\n".join(f"WARNING: {warning}" for warning in self.warnings)


def check_sanity(
    dataset: Dataset,
    results: Results,
    setup: EvaluationSetup,
    tokens: Collection[str],
    **engine: Unpack[Engine],
) -> SanityReport:
    """Check whether predictions look as if all had a classic mistake, or are empty or constant.

    Correct predictions raise no suspicion, nor do bad ones without any of these mistakes. The check
    examines 20 samples, or 60 of accident lists and plans, always the same.

    Args:
        dataset: The release.
        results: The predictions.
        setup: Rules that they are evaluated by.
        tokens: Samples that are evaluated, each with a prediction.
        **engine: `workers` (1 by default), `executor` and `progress`, see `parallel.Engine`.

    Raises:
        EvaluationError: the results are not of a kind that the task takes, or there is no sample.
    """
    if not tokens:
        raise EvaluationError(
            f"{results.path}: there is no sample to look at, so that nothing can be compared"
        )
    has_lists = results.task == "accident"
    alarmed = [token for token in tokens if has_lists and results.prediction(token)]  # may be few
    sample_count = LIST_COUNT if results.task in ("accident", "planning") else SAMPLE_COUNT
    candidates = np.random.default_rng(0).permutation(sorted(alarmed or tokens))
    drawn = candidates[:sample_count].tolist()
    loader = SampleLoader(dataset, results, setup)
    engine = {"workers": 1, **engine}
    evidence = run_batch(partial(_sample_evidence, loader), drawn, places=loader.places, **engine)
    is_ranked = not has_lists or setup.task == "warning" or isinstance(setup.rules, BoxAccidents)
    sums = sum_tallies(sample.tallies for sample in evidence)
    hits, total = sums.get("place", np.zeros((4, 1)))[2:].sum(axis=1)
    sought = [
        name
        for name in filter(sums.__contains__, chain(*_REMEDIES.values()))
        if sums[name][:2].max() >= _MIN_HITS[results.task]
    ]
    return SanityReport(
        samples=len(evidence),
        warnings=(
            *suspect_mistakes(sums, results.task),
            *label_free_facts(evidence, ranked=is_ranked),
        ),
        compared=f"{hits:,.0f} of {total:,.0f} {_UNITS[results.task]} are hit as they are given",
        sought=tuple(sought),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleEvidence:
    """Evidence of one sample.

    Attributes:
        tallies: Mistake → tally, shape (4, N): hits and total once it is undone, then hits and
            total as given. Of the N measurements, the worst one counts. For classes, shape (C, C):
            number of true boxes of each class (rows) that are detected under each class name
            (columns). A group's name → the same of all its values as given.
        empty: Whether nothing is predicted.
        scores: Scores of all boxes or accidents.
        probabilities: Whether all logits are in [0, 1].
    """

    tallies: Mapping[str, FloatArray]
    empty: bool = False
    scores: Sequence[float] = ()
    probabilities: bool = False


def _sample_evidence(loader: SampleLoader, token: str) -> SampleEvidence:
    """Return the evidence of a sample."""
    return _EXAMINERS[loader.results.task](loader, token, *loader(token))


def sum_tallies(tallies: Iterable[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Add up the tallies of each name."""
    sums: dict[str, FloatArray] = {}
    for sample_tallies in tallies:
        for name, tally in sample_tallies.items():
            sums[name] = sums.get(name, 0.0) + tally
    return sums


def suspect_mistakes(sums: Mapping[str, FloatArray], task: str) -> Iterator[str]:
    """Yield a sentence for each suspected mistake.

    Of a group, only the best mistake is reported. After a wrong place or time nothing else is.
    """
    for group, remedies in _REMEDIES.items():
        suspected = list(_suspected(sums, task, group))
        if suspected:
            share, given_share, name = max(suspected, key=itemgetter(0))
            yield (
                f"{name}: {remedies[name]} ({share:.0%} of the truth is hit once that is undone, "
                f"{given_share:.0%} as it is)"
            )
            if group in ("place", "time"):
                return
        elif group in _UNEXPLAINED and group in sums:
            right, total = sums[group][2:, 0].astype(int).tolist()
            min_total = max(_MIN_HITS[task], _MIN_SHARES["place"] * sums["place"][1].sum())
            if total >= min_total and right < total / 2:
                yield _UNEXPLAINED[group].format(right, total)


def _suspected(
    sums: Mapping[str, FloatArray], task: str, group: str
) -> Iterator[tuple[float, float, str]]:
    """Yield the suspected mistakes of a group: share once undone, share as given, name."""
    for name in filter(sums.__contains__, _REMEDIES[group]):
        tally = class_tally(sums[name]) if name == _CLASSES else sums[name]
        share = _min_share(tally[0], tally[1])
        given_share = _min_share(tally[2], tally[3])
        min_share = max(_MIN_SHARES.get(group, _DEFAULT_MIN_SHARE), _MIN_GAIN * given_share)
        if share >= min_share and tally[0].sum() >= _MIN_HITS[task]:
            yield share, given_share, name


def _min_share(hits: FloatArray, totals: FloatArray) -> float:
    is_measured = totals > 0
    return float((hits[is_measured] / totals[is_measured]).min(initial=1.0))


def label_free_facts(evidence: Sequence[SampleEvidence], *, ranked: bool) -> Iterator[str]:
    """Yield sentences on what shows without the labels."""
    if all(sample.empty for sample in evidence):
        yield f"all {len(evidence)} predictions looked at are empty: nothing is predicted in them"
    scores = [score for sample in evidence for score in sample.scores]
    if ranked and len(scores) > 1 and len(set(scores)) == 1:
        yield (
            f"all {len(scores)} scores are {scores[0]:g}: numbers that depend on their order, such "
            "as an average precision, then say little; give surer predictions higher scores"
        )
    has_probabilities = any(sample.probabilities for sample in evidence)
    if has_probabilities and all(sample.probabilities or sample.empty for sample in evidence):
        yield (
            "all values of the heads' segmentation are between 0 and 1: write logits and not "
            "probabilities, which the released accident rule takes for actors everywhere"
        )


def _distance(points: FloatArray, true_points: FloatArray) -> Any:
    return np.linalg.norm(points - true_points, axis=-1)


def _difference(values: Any, true_values: Any) -> Any:
    return np.abs(values - true_values)


def _turn(angles: FloatArray, true_angles: FloatArray, period: float = 2 * np.pi) -> Any:
    half = period / 2
    turns = (angles - true_angles + half) % period - half
    return np.abs(turns)


def tally_of(undone: ArrayLike, predicted: ArrayLike, total: ArrayLike) -> FloatArray:
    """Return a tally, shape (4, 1): hits and total once a mistake is undone, then as given.

    Args:
        undone: Hits once the mistake is undone, as flags or a number.
        predicted: Hits of the values as predicted, likewise.
        total: Number of values.
    """
    rows = [[np.sum(undone)], [total], [np.sum(predicted)], [total]]
    return np.array(rows, dtype=np.float64)


def tallies_of(
    group: str,
    undone: Mapping[str, Any],
    predicted: Any,
    true: Any,
    tolerance: ArrayLike,
    error_of: Callable[[Any, Any], Any] = _difference,
) -> dict[str, FloatArray]:
    """Tally which of N values are right, as given and once each mistake is undone.

    Only values count that cannot be right in both ways.

    Args:
        group: Group of the mistakes.
        undone: Name of a mistake → the values without it.
        predicted: The values as predicted.
        true: Their true values; NaN where unknown.
        tolerance: Largest error of a right value.
        error_of: Function that returns the distances between values.
    """
    error = error_of(predicted, true)
    is_known = np.isfinite(error)
    tallies = {group: tally_of(0, error <= tolerance, is_known.sum())}
    for name, values in undone.items():
        counts = is_known & (error_of(values, predicted) > 2 * np.asarray(tolerance))
        is_right = counts & (error_of(values, true) <= tolerance)
        tallies[name] = tally_of(is_right, counts & (error <= tolerance), counts.sum())
    return tallies


def _motion_evidence(
    _: SampleLoader, __: str, prediction: MotionOutput, label: MotionLabels, *___: object
) -> SampleEvidence:
    """Compare cells of actors: for places in the present frame, for times where frames differ."""
    frame_count, grid = frames_there(label), label.config.grid
    true = grid.reorient(labels_at_present(label).segmentation[:frame_count] == 1, "devkit")
    all_frames = prediction.grid.reorient(actor_cells(prediction), "devkit")
    predicted = all_frames[:frame_count]
    tallies = {}
    for name, axes in (_AXES | {"place": (1, 1, 1)}).items():
        keeps_shape = grid.x == grid.y or axes[2] == 1
        if keeps_shape:
            present = predicted[:1]
            tallies[name] = _overlap(_turn_maps(present, *axes), true[:1], present)
    is_changing = true.any(axis=0) & ~true.all(axis=0)
    true, predicted = true & is_changing, predicted & is_changing
    backwards = all_frames[::-1][:frame_count] & is_changing
    overlaps = {"frames reversed": _overlap(backwards, true, predicted)}
    if frame_count > FEW_FRAMES:
        overlaps["one step late"] = _overlap(predicted[1:], true[:-1], predicted[:-1])
    for name, overlap in overlaps.items():
        tallies[name] = np.pad(overlap, ((0, 0), (0, len(all_frames) - overlap.shape[1])))
    is_empty = not all_frames.any()
    return SampleEvidence(
        tallies=tallies,
        empty=is_empty,
        probabilities=not is_empty and _holds_probabilities(prediction),
    )


def _holds_probabilities(prediction: MotionOutput) -> bool:
    """Return whether all segmentation logits of the last heads are in [0, 1]."""
    if not prediction.heads:
        return False
    logits = prediction.heads[-1].segmentation
    return bool(logits.min() >= 0 and logits.max() <= 1)


def _turn_maps(maps: AnyArray, x: int, y: int, order: int) -> AnyArray:
    """Return maps (T, rows, columns) in the devkit's orientation with other axes."""
    ordered = maps if order == 1 else maps.swapaxes(1, 2)
    return ordered[:, ::y, ::x]


def _turn_points(points: FloatArray, x: int, y: int, order: int) -> FloatArray:
    """Return points (N, 2) or (N, 3) with other axes."""
    ordered = points[:, :2][:, ::order]
    return np.column_stack([ordered * (x, y), points[:, 2:]])


def _overlap(undone: AnyArray, true: AnyArray, predicted: AnyArray) -> FloatArray:
    """Count cells of intersections and unions frame by frame, shape (4, T)."""
    cell_sets = (undone & true, undone | true, predicted & true, predicted | true)
    counts = [cells.sum(axis=(1, 2)) for cells in cell_sets]
    return np.array(counts, dtype=np.float64)


def _detection_evidence(
    loader: SampleLoader, token: str, _: object, truth: Boxes
) -> SampleEvidence:
    """Compare detections with the boxes of other actors in the world frame: first the positions."""
    detections: Any = loader.results.prediction(token)  # in the world frame
    world_boxes = loader.dataset.boxes(token, "world")
    true = world_boxes.select(
        np.isin(world_boxes.actor_id, truth.actor_id) & (world_boxes.actor_id != OWN_ACTOR_ID)
    )
    scores = detections.scores.tolist()
    if not len(detections) or not len(true):
        return SampleEvidence(tallies={}, empty=not len(detections), scores=scores)
    columns = columns_of(detections.boxes, detections.scores)
    boxes = detections.boxes.select(columns.surest_first[: 2 * len(true)])
    center, true_center = boxes.center, true.center
    rows = _nearest_rows(center, true_center)
    undone = {}
    for name, moved in _undo_frames(loader.dataset, token, center).items():
        undone[name] = moved[_nearest_rows(moved, true_center)] * _AXIS_WEIGHTS
    step = LABEL_STEP * true.velocity
    step_length = _distance(step, np.zeros(3))
    is_moving = step_length[:, None] >= LABEL_STEP * MIN_SPEED_MPS
    late = {"one step late": center[_nearest_rows(center, true_center - step)] + step}
    is_matched = _distance(center[rows, :2], true_center[:, :2]) < _POSITION_TOLERANCE_M
    tallies = {
        **tallies_of(
            "place",
            undone,
            center[rows] * _AXIS_WEIGHTS,
            true_center * _AXIS_WEIGHTS,
            _POSITION_TOLERANCE_M,
            _distance,
        ),
        **tallies_of(
            "time",
            late,
            center[rows],
            np.where(is_moving, true_center, np.nan),
            step_length / 4,
            _distance,
        ),
        **_pair_tallies(boxes.select(rows[is_matched]), true.select(is_matched)),
        "place": tally_of(0, is_matched, len(true)),
    }
    return SampleEvidence(tallies=tallies, scores=scores)


def _nearest_rows(predicted: FloatArray, true: FloatArray) -> IntArray:
    """Return the rows (N,) of predicted points (K, 3) nearest on the ground to true ones (N, 3)."""
    distances = _distance(true[:, None, :2], predicted[:, :2])
    return np.asarray(distances.argmin(axis=1))


def _pair_tallies(detected: Boxes, true: Boxes) -> dict[str, FloatArray]:
    """Compare N true boxes with the detections at their positions on the ground."""
    z = detected.center[:, 2]
    height = true.size[:, 2]
    velocity = detected.velocity[:, :2]
    heights = {name: z + share * height for name, share in _HEIGHTS.items()}
    sizes = {}
    for name, (order, factor) in _SIZES.items():
        sizes[name] = factor * detected.size[:, np.argsort(order)]
    velocities = {name: factor * velocity for name, factor in _VELOCITIES.items()}
    speed = np.hypot(*true.velocity[:, :2].T)
    moving_velocity = np.where(speed[:, None] >= MIN_SPEED_MPS, true.velocity[:, :2], np.nan)
    turn = _turn(detected.yaw, true.yaw, np.pi / 2)
    class_counts = np.zeros((len(CATEGORIES), len(CATEGORIES)))
    np.add.at(class_counts, (true.category, detected.category), 1)
    return {
        **tallies_of("height", heights, z, true.center[:, 2], _RELATIVE_TOLERANCE * height),
        **tallies_of("size", sizes, detected.size, true.size, _RELATIVE_TOLERANCE * true.size),
        **tallies_of(
            "velocity",
            velocities,
            velocity,
            moving_velocity,
            _RELATIVE_TOLERANCE * speed,
            _distance,
        ),
        "heading": tally_of(0, turn <= HEADING_TOLERANCE_RAD, len(true)),
        _CLASSES: class_counts,
    }


def _undo_frames(dataset: Dataset, token: str, center: FloatArray) -> dict[str, FloatArray]:
    """Return for each mistake the centres (N, 3) in the world frame without it."""
    ego = dataset.world_from(token, "ego")
    lidar = dataset.world_from(token, "lidar")
    in_ego = ego.inverse().apply(center)
    return {
        **{name: ego.apply(_turn_points(in_ego, *axes)) for name, axes in _AXES.items()},
        "ego frame for world frame": ego.apply(center),
        "LiDAR frame for world frame": lidar.apply(center),
        "LiDAR frame for ego frame": lidar.apply(in_ego),
        "ego frame for LiDAR frame": ego.apply(lidar.inverse().apply(center)),
    }


def class_tally(class_counts: FloatArray) -> FloatArray:
    """Return a tally (4, N) of the N classes that are mostly detected under another class's name.

    Each of them is detected under a different name.

    Args:
        class_counts: Number of true boxes of a class (rows) by detected class (columns), (C, C).
    """
    totals = class_counts.sum(axis=1)
    detected = class_counts.argmax(axis=1)
    changed = np.flatnonzero(
        (detected != np.arange(len(class_counts))) & (totals >= _MIN_CLASS_BOXES)
    )
    is_rare = len(changed) == 1 and 2 * totals[changed].sum() < totals.sum()
    if is_rare or len(set(detected[changed])) < len(changed):
        # one rare class, or several that are taken for the same one: no mistake of their order
        changed = changed[:0]
    total = totals[changed]
    undone = class_counts[changed, detected[changed]]
    return np.array([undone, total, class_counts[changed, changed], total])


def _accident_evidence(
    loader: SampleLoader,
    token: str,
    alarms: Sequence[Accident],
    _: object,
    context: AccidentContext,
) -> SampleEvidence:
    """Compare the surest accident with the true one: its positions, and its time."""
    tallies: dict[str, FloatArray] = {}
    true = context.truth and context.truth.accident
    if alarms and true:
        surest = min(alarms, key=by_sureness)
        positions = _undo_positions(loader.dataset, token, surest.positions)
        times = {
            "one step late": surest.time - LABEL_STEP,
            "frames reversed": loader.setup.horizon - surest.time,
            "times in frames": surest.time * FRAME_PERIOD,
        }
        tallies |= tallies_of(
            "place",
            positions,
            surest.positions,
            true.positions,
            2 * _POSITION_TOLERANCE_M,
            position_difference,
        )
        tallies |= tallies_of("time", times, surest.time, true.time, TIME_TOLERANCE_S)
    scores = [alarm.score for alarm in alarms]
    return SampleEvidence(tallies=tallies, empty=not alarms, scores=scores)


def _undo_positions(dataset: Dataset, token: str, positions: FloatArray) -> dict[str, FloatArray]:
    """Return for each mistake the positions (N, 2) in the present ego frame without it."""
    in_world = np.column_stack([positions, np.zeros(len(positions))])
    in_ego = dataset.world_from(token, "ego").inverse().apply(in_world)[:, :2]
    undone = {name: _turn_points(positions, *axes) for name, axes in _AXES.items()}
    return undone | {"world frame for ego frame": in_ego}


def _plan_evidence(
    loader: SampleLoader, token: str, plans: Sequence[Plan], scene: PlanningScene
) -> SampleEvidence:
    """Compare the best plan with the recorded path, and its headings with the recorded ones."""
    plan = max(plans, key=lambda plan: plan.score)
    tallies = _path_tallies(
        loader, token, plan.times, plan.path, np.zeros(2), scene.recorded[_STEP_FRAMES, :2]
    )
    if plan.yaw is not None:
        undone = {}
        for name, (factor, offset) in _YAWS.items():
            undone[name] = factor * plan.yaw + offset
        undone[_DEGREES] = np.where(np.abs(plan.yaw) > _MAX_YAW_RAD, np.deg2rad(plan.yaw), plan.yaw)
        times = np.arange(len(scene.recorded)) * FRAME_PERIOD
        yaw = np.interp(plan.times, times, scene.recorded[:, 2], right=np.nan)
        tallies |= tallies_of("heading", undone, plan.yaw, yaw, HEADING_TOLERANCE_RAD, _turn)
    return SampleEvidence(tallies=tallies)


def _forecast_evidence(
    loader: SampleLoader, token: str, forecasts: Sequence[Forecast], truth: ForecastingTruth
) -> SampleEvidence:
    """Compare the most probable path of each actor with the recorded one."""
    tallies = []
    for forecast in forecasts:
        for row in np.flatnonzero(truth.actor_id == forecast.actor_id):
            path = forecast.paths[np.argmax(forecast.probabilities)]
            present = truth.present[row]
            true = np.vstack([present, truth.path[row]])[_STEP_FRAMES]
            tallies.append(_path_tallies(loader, token, forecast.times, path, present, true))
    return SampleEvidence(tallies=sum_tallies(tallies), empty=not forecasts)


def _path_tallies(
    loader: SampleLoader,
    token: str,
    times: FloatArray,
    path: FloatArray,
    present: FloatArray,
    true: FloatArray,
) -> dict[str, FloatArray]:
    """Compare a path with the earliest true positions at `_STEP_TIMES`.

    Args:
        loader: Loader of the sample.
        token: Token of the sample.
        times: Seconds of the path's positions after the present, (T,).
        path: Predicted positions in the present ego frame, (T, 2).
        present: Position at present, (2,).
        true: True positions, (S, 2).
    """
    timed_paths = {
        name: (times, positions)
        for name, positions in _undo_positions(loader.dataset, token, path).items()
    }
    timed_paths |= {
        "steps for places": (times, present + path.cumsum(axis=0)),
        "places from the actor": (times, present + path),
        "one step late": (times - LABEL_STEP, path),
        "one step early": (times + LABEL_STEP, path),
        "times in frames": (times * FRAME_PERIOD, path),
        "times in milliseconds": (times / 1000, path),
    }
    true = true[: np.count_nonzero(times[-1] + SAME_TIME >= _STEP_TIMES)]
    undone = {}
    for name, (path_times, positions) in timed_paths.items():
        undone[name] = _positions_at_steps(path_times, positions, present)[: len(true)]
    predicted = _positions_at_steps(times, path, present)[: len(true)]
    tolerance = np.maximum(_PATH_TOLERANCE_M, _distance(true, present) / 10)
    return tallies_of("place", undone, predicted, true, tolerance, _distance)


def _positions_at_steps(times: FloatArray, path: FloatArray, present: FloatArray) -> FloatArray:
    """Return the positions (S, 2) of a path (T, 2) at `_STEP_TIMES`.

    The path begins at the present position and stays at its end.
    """
    if times[0] > 0:
        times, path = np.append(0.0, times), np.vstack([present, path])
    coordinates = [np.interp(_STEP_TIMES, times, values) for values in path.T]
    return np.column_stack(coordinates)


# Kind of results → function that examines a sample: its token, prediction and truth.
_EXAMINERS: Final[Mapping[str, Callable[..., SampleEvidence]]] = {
    "motion": _motion_evidence,
    "accident": _accident_evidence,
    "detection": _detection_evidence,
    "planning": _plan_evidence,
    "forecasting": _forecast_evidence,
}
