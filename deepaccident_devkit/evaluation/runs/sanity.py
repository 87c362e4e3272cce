"""`check_sanity`: do the predictions fit the labels much better once a classic mistake is undone?

Each mistake is represented by a transform that undoes it. For each sample, the check counts how
much of the truth the predictions hit once the mistake is undone, and how much they hit unchanged.
These counts are summed over samples. A mistake is suspected if the first share is large enough, and
clearly larger than the second. If no mistake is suspected, but most boxes at the correct position
have a wrong size, height or heading, a warning reports it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, permutations
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import AccidentContext, BoxAccidents
from deepaccident_devkit.evaluation.alarms import LABEL_STEP, alarm_sort_key, position_difference
from deepaccident_devkit.evaluation.detection.boxes import columns_of
from deepaccident_devkit.evaluation.forecasting import Forecast, ForecastingTruth
from deepaccident_devkit.evaluation.forecasting.metrics import SAME_TIME
from deepaccident_devkit.evaluation.motion import actor_cells
from deepaccident_devkit.evaluation.planning import Plan, PlanningScene
from deepaccident_devkit.evaluation.predicted_boxes import Tracks
from deepaccident_devkit.evaluation.predictions import (
    Accident,
    MotionOutput,
    labels_at_present,
    num_recorded_frames,
)
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleLoader
from deepaccident_devkit.evaluation.segmentation import (
    SegmentationOutput,
    compared_masks,
    segmentation_truth,
)
from deepaccident_devkit.evaluation.task import FrozenMappings
from deepaccident_devkit.evaluation.tracking import TrackingTruth
from deepaccident_devkit.geometry import BevGrid, Boxes
from deepaccident_devkit.geometry.bev_grid import Axis
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray
from deepaccident_devkit.support.parallel import run_batch
from deepaccident_devkit.support.text import counted
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD, OWN_ACTOR_ID

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

__all__ = ["SanityReport", "check_sanity"]

# Mistake → factors for x and y that undo it, and −1 if x and y must be swapped first, otherwise 1.
# Coordinates with x to the right and y forward are `turned left`. If two mistakes explain the
# predictions equally well, as on a straight path, the earlier one is reported.
_AXES = {
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
# Number of samples that are examined for accident lists and plans, which are short.
LIST_COUNT: Final = 60
# A mistake is only suspected if undoing it raises the share of hits by at least this factor.
_MIN_GAIN = 2.0
# Group of mistakes → share of hits that must be reached once a mistake is undone, unless it is the
# default. It is higher for times than for places, since predictions for slow actors hit some, too.
_MIN_SHARES = {"place": 0.2, "time": 0.4}
_DEFAULT_MIN_SHARE = 0.5
# Number of cells, accidents, boxes or path positions that must be hit.
_MIN_HITS = {
    "motion": 100,
    "accident": 4,
    "detection": 10,
    "tracking": 10,
    "planning": 10,
    "forecasting": 10,
    "segmentation": 100,
}
_UNIT_NAMES = (
    "cells",
    "accidents",
    "true boxes",
    "true boxes",
    "places",
    "places",
    "cells",
)
_UNITS = dict(zip(_MIN_HITS, _UNIT_NAMES, strict=True))
# Largest distance on the ground of a matched box; for accidents, averaged over both positions.
_POSITION_TOLERANCE_M = 2.0
# Weights of x, y and z. For z the tolerance is only 0.7 m, since LiDAR and ego frame differ only by
# the height of the LiDAR, about 2 m.
_AXIS_WEIGHTS = np.array([1, 1, _POSITION_TOLERANCE_M / 0.7])
# Largest time error of a matched accident.
TIME_TOLERANCE_S: Final = 0.15
# Largest error of a position on a path; a tenth of the distance travelled is allowed if larger.
_PATH_TOLERANCE_M = 1.0
# Largest relative error of a box's size, of its height above the ground, or of its velocity.
_RELATIVE_TOLERANCE = 0.2
# A class needs at least this many true boxes before its name is judged.
_MIN_CLASS_BOXES = 5
# Slower actors do not move far enough in one step.
MIN_SPEED_MPS: Final = 4.0
# Largest angle between a heading and the nearest of the true box's four directions; one third of
# all random headings are within it.
HEADING_TOLERANCE_RAD: Final = np.deg2rad(15)
_SIZE_AXES = ("length", "width", "height")
# Mistake → axes in the order of the predicted sizes, and the factor that undoes the mistake.
_SIZES = {
    f"sizes in the order {', '.join(_SIZE_AXES[axis] for axis in order)}": (order, 1.0)
    for order in permutations(range(3))
    if order != (0, 1, 2)
} | {"half sizes": ((0, 1, 2), 2.0), "double sizes": ((0, 1, 2), 0.5)}
# Mistake → share of the box's height that is added to z to undo it.
_HEIGHTS = {"z of the lower face": 0.5, "z of the upper face": -0.5}
_VELOCITIES = {
    "velocities per frame": 1 / FRAME_PERIOD,
    "velocities per step": 1 / LABEL_STEP,
}
_DEGREES = "yaw in degrees"
# Mistake → factor of headings, and angle in radians added to them, that undo it.
_YAWS = {
    "yaw clockwise": (-1.0, 0.0),
    "yaw from y": (1.0, np.pi / 2),
    "yaw from −y": (1.0, -np.pi / 2),
    "yaw clockwise from y": (-1.0, np.pi / 2),
    "yaw backwards": (1.0, np.pi),
}
# Larger headings may be in degrees. Smaller ones are not converted, since they would end up near 0,
# as most headings are, whatever was wrong with them.
_MAX_YAW_RAD = 4.0
_CLASSES = "classes swapped"
_LAYERS = "layers swapped"
# Mistake → where the contents of a cell come from along x and y, in cells from its own place.
_SHIFTS = {
    f"half a cell too far {forward} and {left}": (x, y)
    for forward, x in (("forward", -0.5), ("back", 0.5))
    for left, y in (("left", -0.5), ("right", 0.5))
}
_NEW_IDS = "ids of single samples"
# Times, in seconds, at which paths are compared.
_STEP_TIMES = np.arange(1, 7) * LABEL_STEP
# Frames after the current one at these times.
_STEP_FRAMES = slice(5, 31, 5)
# If there are at most this many frames, predictions for slow actors look as if they were late.
FEW_FRAMES: Final = 3
_SECONDS = "times are in seconds after the present"
# Group of mistakes → mistake → its remedy.
_REMEDIES = {
    "place": {
        **dict.fromkeys(
            _AXES, "x is forward and y is to the left; for maps, state their orientation"
        ),
        **dict.fromkeys(
            _SHIFTS, "the first cell begins, but is not centred, where the grid begins"
        ),
        "world frame for ego frame": "positions are in the world frame; give them in the "
        "present ego frame",
        "ego frame for world frame": "boxes are in the ego frame; transform them with "
        'da.world_from(token, "ego")',
        "LiDAR frame for world frame": "boxes are in the LiDAR frame; transform them with "
        'da.world_from(token, "lidar")',
        "LiDAR frame for ego frame": "boxes in the LiDAR frame were transformed with the ego "
        "pose; use the LiDAR's pose",
        "ego frame for LiDAR frame": "boxes in the ego frame were transformed with the LiDAR's "
        "pose; use the ego pose",
    },
    "time": {
        "frames reversed": "the first frame of a prediction is the present, and times are counted "
        "from there",
        "one step late": "the predictions show earlier moments; the first frame, or time 0, is "
        "the sample's own moment, so leave out past frames",
        "one step early": "the predictions show later moments; the first frame, or time 0, is "
        "the sample's own moment",
        "steps for places": "a path contains positions, not steps; add up the steps",
        "places from the actor": "a path begins where the actor is in the present ego frame, not "
        "at 0, 0",
        "times in frames": _SECONDS,
        "times in milliseconds": _SECONDS,
    },
    "height": dict.fromkeys(_HEIGHTS, "z is the height of the box's centre"),
    "size": dict.fromkeys(
        _SIZES,
        "Boxes and DetectedBoxes contain full length, width and height; results files contain "
        "width, length and height",
    ),
    "heading": dict.fromkeys(
        (_DEGREES, *_YAWS), "yaw is in radians, counter-clockwise from x of the present ego frame"
    ),
    "velocity": dict.fromkeys(_VELOCITIES, "velocities are in m/s"),
    "identity": {
        _NEW_IDS: "a track keeps its id in all samples of a recording",
    },
    "class": {
        _CLASSES: f"class numbers count from 0: {', '.join(CATEGORIES)}",
        _LAYERS: "name the classes in the order of the layers",
    },
}
# Group of mistakes → warning if most values of matched boxes are wrong, but no mistake explains it.
_UNEXPLAINED = {
    "height": "heights do not fit: only {} of {} are right; z is the height of the box's "
    "centre, in the world frame",
    "size": "sizes do not fit: only {} of {} are right; a size is the full length, width and "
    "height in metres",
    "heading": "headings look random: {} of {} are right (for boxes, up to quarter turns). Are "
    "they in degrees instead of radians, or not predicted? A heading is counted "
    "counter-clockwise from the x axis; a box's heading is counted from the x axis "
    "of the world",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class SanityReport(FrozenMappings):
    """Findings about predictions, based on a few samples.

    Attributes:
        samples: Number of samples that were examined.
        warnings: One sentence per warning; empty if nothing looks wrong.
        compared: Sentence on how much of the truth was compared, and how much of it the
            predictions hit.
        sought: Names of the mistakes for which there was enough evidence to notice them; empty if
            nothing can be concluded.
    """

    samples: int
    warnings: tuple[str, ...]
    compared: str = ""
    sought: tuple[str, ...] = ()

    def to_text(self) -> str:
        """Format as lines how much was compared, the warnings, and the verdict."""
        head = f"Sanity check of {counted(self.samples, 'sample')}: {self.compared}"
        lines = (head, self.warnings_text(), self.verdict)
        return "\n".join(filter(None, lines))

    @property
    def verdict(self) -> str:
        """Sentence that names the mistakes that are ruled out; empty if there are warnings."""
        if not self.sought:
            return "No verdict: there is too little to compare."
        if self.warnings:
            return ""
        return f"No mistake found. Checked: {', '.join(self.sought)}."

    def warnings_text(self) -> str:
        """Return the warnings, one per line; empty if there are none."""
        return "\n".join(f"warning: {warning}" for warning in self.warnings)


def check_sanity(
    dataset: Dataset,
    results: Results,
    setup: EvaluationSetup,
    tokens: Collection[str],
    **engine: Unpack[Engine],
) -> SanityReport:
    """Check whether predictions seem to have a classic mistake, or are empty or constant.

    Neither correct predictions nor bad ones without these mistakes raise suspicion. The check
    always examines the same 20 samples, or 60 for accident lists and plans.

    Maps are compared cell by cell. Other values fit if they are within 2 m for positions (0.7 m in
    height; on paths 1 m, or a tenth of the distance travelled if that is more), 0.15 s for times,
    20 % for sizes, heights above the ground and velocities, and 15° for headings. Plans that are
    much too slow can look late.

    Args:
        dataset: Release with the ground truth.
        results: Predictions to check.
        setup: Task and rules of the evaluation.
        tokens: Tokens of the evaluated samples, each with a prediction.
        **engine: `workers` (1 by default), `executor` and `progress`, see `parallel.Engine`.

    Raises:
        EvaluationError: If the task cannot be evaluated from such results, or there is no sample.
    """
    if not tokens:
        raise EvaluationError(f"{results.path}: there is no sample to compare")
    has_lists = results.task == "accident"
    alarmed = []
    if has_lists:  # few samples may have an alarm
        alarmed = [token for token in tokens if results.prediction(token)]
    sample_count = LIST_COUNT if results.task in ("accident", "planning") else SAMPLE_COUNT
    candidates = np.random.default_rng(0).permutation(sorted(alarmed or tokens))
    drawn_tokens = candidates[:sample_count].tolist()
    loader = SampleLoader(dataset, results, setup)
    examine = partial(_examine_sample, loader)
    engine = {"workers": 1, **engine}
    evidence = run_batch(examine, drawn_tokens, places=loader.places, **engine)
    is_ranked = not has_lists or setup.task == "warning" or isinstance(setup.rules, BoxAccidents)
    sums = sum_tallies(sample.tallies for sample in evidence)
    hits, total = sums.get("place", np.zeros((4, 1)))[2:].sum(axis=1)
    sought = []
    for name in chain(*_REMEDIES.values()):
        if name in sums and sums[name][:2].max() >= _MIN_HITS[results.task]:
            sought.append(name)
    warnings = [
        *suspect_mistakes(sums, results.task),
        *label_free_facts(evidence, ranked=is_ranked),
    ]
    return SanityReport(
        samples=len(evidence),
        warnings=tuple(warnings),
        compared=f"{hits:,.0f} of {total:,.0f} {_UNITS[results.task]} match the predictions",
        sought=tuple(sought),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleEvidence:
    """Evidence from one sample.

    Attributes:
        tallies: Mistake → tally of N measurements; the worst one counts. Its four rows,
            shape (4, N), are hits and total once the mistake is undone, then hits and total as
            predicted. The tally of swapped classes, shape (C, C), is the number of true boxes of
            each class (rows) that are detected as each class (columns). The tally under the name of
            a group counts all its values as predicted.
        empty: Whether nothing is predicted.
        scores: Scores of all predicted boxes or accidents.
        probabilities: Whether all logits are in [0, 1], as if they were probabilities.
    """

    tallies: Mapping[str, FloatArray]
    empty: bool = False
    scores: Sequence[float] = ()
    probabilities: bool = False


def _examine_sample(loader: SampleLoader, token: str) -> SampleEvidence:
    """Load a sample and collect its evidence."""
    examine = _EXAMINERS[loader.results.task]
    return examine(loader, token, *loader(token))


def sum_tallies(tallies: Iterable[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """Sum tallies by name."""
    sums: dict[str, FloatArray] = {}
    for sample_tallies in tallies:
        for name, tally in sample_tallies.items():
            sums[name] = sums.get(name, 0.0) + tally
    return sums


def suspect_mistakes(sums: Mapping[str, FloatArray], task: str) -> Iterator[str]:
    """Yield a sentence for each suspected mistake.

    Only the most likely mistake of each group is reported. After a wrong place or time, no further
    groups are reported.
    """
    for group, remedies in _REMEDIES.items():
        suspected = list(_suspect_group(sums, task, group))
        if suspected:
            share, given_share, name = max(suspected, key=itemgetter(0))
            yield (
                f"{name}: {remedies[name]} ({100 * share:.0f} % of the truth matches when "
                f"corrected, {100 * given_share:.0f} % as given)"
            )
            if group in ("place", "time"):
                return
        elif group in _UNEXPLAINED and group in sums:
            right, total = sums[group][2:, 0].astype(int).tolist()
            min_total = max(_MIN_HITS[task], _MIN_SHARES["place"] * sums["place"][1].sum())
            if total >= min_total and right < total / 2:
                yield _UNEXPLAINED[group].format(right, total)


def _suspect_group(
    sums: Mapping[str, FloatArray], task: str, group: str
) -> Iterator[tuple[float, float, str]]:
    """Yield the suspected mistakes of a group.

    Yields:
        Share of hits once the mistake is undone, share of hits as predicted, and the mistake.
    """
    for name in _REMEDIES[group]:
        if name not in sums:
            continue
        tally = class_tally(sums[name]) if group == "class" else sums[name]
        hits, totals, given_hits, given_totals = tally
        share = _worst_share(hits, totals)
        given_share = _worst_share(given_hits, given_totals)
        min_share = max(_MIN_SHARES.get(group, _DEFAULT_MIN_SHARE), _MIN_GAIN * given_share)
        if share >= min_share and hits.sum() >= _MIN_HITS[task]:
            yield share, given_share, name


def _worst_share(hits: FloatArray, totals: FloatArray) -> float:
    """Return the smallest share of hits of any measurement; 1 if there are no measurements."""
    is_measured = totals > 0
    shares = hits[is_measured] / totals[is_measured]
    return float(shares.min(initial=1.0))


def label_free_facts(evidence: Sequence[SampleEvidence], *, ranked: bool) -> Iterator[str]:
    """Yield sentences about what looks wrong even without labels, such as empty predictions."""
    if all(sample.empty for sample in evidence):
        yield f"all {len(evidence)} examined predictions are empty"
    scores = list(chain.from_iterable(sample.scores for sample in evidence))
    if ranked and len(scores) > 1 and len(set(scores)) == 1:
        yield (
            f"all {len(scores)} scores are {scores[0]:g}, so numbers that depend on their order, "
            "such as an average precision, mean little; give more certain predictions higher scores"
        )
    has_probabilities = any(sample.probabilities for sample in evidence)
    if has_probabilities and all(sample.probabilities or sample.empty for sample in evidence):
        yield (
            "all values of the heads' segmentation are between 0 and 1; write logits instead of "
            "probabilities, because the released accident rule finds actors everywhere in "
            "probabilities"
        )


def _distance(points: FloatArray, true_points: FloatArray) -> Any:
    """Return the distances between points."""
    return np.linalg.norm(points - true_points, axis=-1)


def _difference(values: Any, true_values: Any) -> Any:
    """Return the absolute differences between values."""
    return np.abs(values - true_values)


def _turn(angles: FloatArray, true_angles: FloatArray, period: float = 2 * np.pi) -> Any:
    """Return the smallest angles between angles, which are equal if they differ by a period."""
    half_period = period / 2
    turns = (angles - true_angles + half_period) % period - half_period
    return np.abs(turns)


def tally_of(undone: ArrayLike, predicted: ArrayLike, total: ArrayLike) -> FloatArray:
    """Build a tally, shape (4, 1): hits and total once a mistake is undone, then as predicted.

    Args:
        undone: Hits once the mistake is undone, as flags or as a number.
        predicted: Hits as predicted, as flags or as a number.
        total: Number of values.
    """
    undone_hits = np.sum(undone)
    predicted_hits = np.sum(predicted)
    rows = [[undone_hits], [total], [predicted_hits], [total]]
    return np.array(rows, dtype=np.float64)


def tallies_of(
    group: str,
    undone: ReadOnlyValues,
    predicted: Any,
    true: Any,
    tolerance: ArrayLike,
    error_of: Callable[[Any, Any], Any] = _difference,
) -> dict[str, FloatArray]:
    """Count how many of N values are correct, as predicted and once each mistake is undone.

    A value only counts for a mistake if it cannot be correct both with and without the mistake.

    Args:
        group: Group of the mistakes.
        undone: Name of a mistake → values after it is undone.
        predicted: Values as predicted.
        true: True values; NaN if unknown.
        tolerance: Largest error of a correct value.
        error_of: Function that computes the errors of predicted values from the true ones.
    """
    error = error_of(predicted, true)
    is_known = np.isfinite(error)
    is_right = error <= tolerance
    tallies = {group: tally_of(0, is_right, is_known.sum())}
    for name, values in undone.items():
        is_changed = error_of(values, predicted) > 2 * np.asarray(tolerance)
        counts = is_known & is_changed
        is_right_undone = error_of(values, true) <= tolerance
        tallies[name] = tally_of(counts & is_right_undone, counts & is_right, counts.sum())
    return tallies


def _motion_evidence(
    _loader: SampleLoader,
    _token: str,
    prediction: MotionOutput,
    label: MotionLabels,
    *_context: object,
) -> SampleEvidence:
    """Compare cells of actors: for places in the current frame, for times the ones that change."""
    frame_count = num_recorded_frames(label)
    grid = label.config.grid
    segmentation = labels_at_present(label).segmentation[:frame_count]
    true = grid.reorient(segmentation == 1, "devkit")
    all_frames = prediction.grid.reorient(actor_cells(prediction), "devkit")
    predicted = all_frames[:frame_count]
    true_present = true[:1]
    present = predicted[:1]
    tallies = {"place": _overlap(present, true_present, present)}
    for name, (x, y, order) in _AXES.items():
        keeps_shape = grid.x == grid.y or order == 1
        if keeps_shape:
            turned = _turn_maps(present, x, y, order)
            tallies[name] = _overlap(turned, true_present, present)
    is_changing = true.any(axis=0) & ~true.all(axis=0)
    true = true & is_changing
    predicted = predicted & is_changing
    backwards = all_frames[::-1][:frame_count] & is_changing
    overlaps = {"frames reversed": _overlap(backwards, true, predicted)}
    if frame_count > FEW_FRAMES:
        overlaps["one step late"] = _overlap(predicted[1:], true[:-1], predicted[:-1])
    for name, overlap in overlaps.items():
        missing_frames = len(all_frames) - overlap.shape[1]
        tallies[name] = np.pad(overlap, ((0, 0), (0, missing_frames)))
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
    """Transform maps (T, rows, columns) in the devkit's orientation, with axes as in `_AXES`."""
    if order == -1:
        maps = maps.swapaxes(1, 2)
    return maps[:, ::y, ::x]


def _turn_points(points: FloatArray, x: int, y: int, order: int) -> FloatArray:
    """Transform points (N, 2) or (N, 3), with axes as in `_AXES`."""
    on_ground = points[:, :2]
    turned = on_ground[:, ::order] * (x, y)
    return np.column_stack([turned, points[:, 2:]])


def _overlap(undone: AnyArray, true: AnyArray, predicted: AnyArray) -> FloatArray:
    """Count cells in a tally (4, T): intersection and union after undoing a mistake, then before.

    Args:
        undone: Masks of T frames after the mistake is undone.
        true: True masks.
        predicted: Masks as predicted.
    """
    counts = []
    for masks in (undone, predicted):
        counts.append((masks & true).sum(axis=(1, 2)))
        counts.append((masks | true).sum(axis=(1, 2)))
    return np.array(counts, dtype=np.float64)


def _detection_evidence(
    loader: SampleLoader, token: str, _prediction: object, truth: Boxes
) -> SampleEvidence:
    """Compare detections with the boxes of other actors, in the world frame."""
    detections: Any = loader.results.prediction(token)  # in the world frame
    world_boxes = loader.dataset.boxes(token, "world")
    is_true = np.isin(world_boxes.actor_id, truth.actor_id)
    is_other = world_boxes.actor_id != OWN_ACTOR_ID
    true = world_boxes.select(is_true & is_other)
    scores = detections.scores.tolist()
    if not len(detections) or not len(true):
        return SampleEvidence(tallies={}, empty=not len(detections), scores=scores)
    columns = columns_of(detections.boxes, detections.scores)
    boxes = detections.boxes.select(columns.surest_first[: 2 * len(true)])
    center = boxes.center
    true_center = true.center
    rows = _nearest_rows(center, true_center)
    nearest_center = center[rows]
    weighted_centers = {}
    for name, moved in _undo_frames(loader.dataset, token, center).items():
        weighted_centers[name] = moved[_nearest_rows(moved, true_center)] * _AXIS_WEIGHTS
    step = LABEL_STEP * true.velocity
    step_length = _distance(step, np.zeros(3))
    is_moving = step_length[:, None] >= LABEL_STEP * MIN_SPEED_MPS
    moving_center = np.where(is_moving, true_center, np.nan)
    late_center = center[_nearest_rows(center, true_center - step)] + step
    is_matched = _distance(nearest_center[:, :2], true_center[:, :2]) < _POSITION_TOLERANCE_M
    tallies = tallies_of(
        "place",
        weighted_centers,
        nearest_center * _AXIS_WEIGHTS,
        true_center * _AXIS_WEIGHTS,
        _POSITION_TOLERANCE_M,
        _distance,
    )
    tallies |= tallies_of(
        "time",
        {"one step late": late_center},
        nearest_center,
        moving_center,
        step_length / 4,
        _distance,
    )
    tallies |= _pair_tallies(boxes.select(rows[is_matched]), true.select(is_matched))
    tallies["place"] = tally_of(0, is_matched, len(true))
    return SampleEvidence(tallies=tallies, scores=scores)


def _tracking_evidence(
    loader: SampleLoader, token: str, tracks: Tracks, truth: TrackingTruth
) -> SampleEvidence:
    """Compare boxes as for detections, and count the ids of the preceding sample."""
    evidence = _detection_evidence(loader, token, tracks, truth.boxes)
    if not len(tracks.past_times):
        return evidence
    is_known = np.isfinite(tracks.past[:, -1, 0])
    new_ids = {_NEW_IDS: tally_of(len(tracks), is_known, len(tracks))}
    return replace(evidence, tallies={**evidence.tallies, **new_ids})


def _nearest_rows(predicted: FloatArray, true: FloatArray) -> IntArray:
    """Find the predicted point (K, 3) nearest to each true one (N, 3) on the ground: (N,)."""
    distances = _distance(true[:, None, :2], predicted[:, :2])
    return np.asarray(distances.argmin(axis=1))


def _pair_tallies(detected: Boxes, true: Boxes) -> dict[str, FloatArray]:
    """Compare N true boxes with the detections at their positions, in tallies by mistake."""
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
    """Undo each mistake in centres: mistake → centres (N, 3) in the world frame."""
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
    """Build a tally (4, N) of the N classes that are mostly detected as another class.

    N is 0 if two of these classes are detected as the same class.

    Args:
        class_counts: Number of true boxes of a class (rows) by detected class (columns), (C, C).
    """
    totals = class_counts.sum(axis=1)
    detected = class_counts.argmax(axis=1)
    is_swapped = detected != np.arange(len(class_counts))
    swapped = np.flatnonzero(is_swapped & (totals >= _MIN_CLASS_BOXES))
    is_rare = len(swapped) == 1 and 2 * totals[swapped].sum() < totals.sum()
    if is_rare or len(set(detected[swapped])) < len(swapped):
        # a single rare class, or several detected as the same class: classes are not permuted
        swapped = swapped[:0]
    total = totals[swapped]
    undone_hits = class_counts[swapped, detected[swapped]]
    given_hits = class_counts[swapped, swapped]
    return np.array([undone_hits, total, given_hits, total])


def _accident_evidence(
    loader: SampleLoader,
    token: str,
    alarms: Sequence[Accident],
    _label: object,
    context: AccidentContext,
) -> SampleEvidence:
    """Compare the positions and time of the highest-scoring accident with the true one's."""
    tallies: dict[str, FloatArray] = {}
    true = None
    if context.truth is not None:
        true = context.truth.accident
    if alarms and true is not None:
        surest = min(alarms, key=alarm_sort_key)
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
    """Undo each mistake in positions: mistake → positions (N, 2) in the current ego frame."""
    heights = np.zeros(len(positions))
    in_world = np.column_stack([positions, heights])
    ego_from_world = dataset.world_from(token, "ego").inverse()
    in_ego = ego_from_world.apply(in_world)
    undone = {name: _turn_points(positions, *axes) for name, axes in _AXES.items()}
    undone["world frame for ego frame"] = in_ego[:, :2]
    return undone


def _plan_evidence(
    loader: SampleLoader, token: str, plans: Sequence[Plan], scene: PlanningScene
) -> SampleEvidence:
    """Compare the path and the headings of the best plan with the recorded ones."""
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
        times: (T,) times of the path's positions, seconds after the current frame.
        path: (T, 2) predicted positions in the current ego frame, metres.
        present: (2,) position in the current frame, metres.
        true: (S, 2) true positions, metres.
    """
    timed_paths = {}
    for name, positions in _undo_positions(loader.dataset, token, path).items():
        timed_paths[name] = (times, positions)
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
    """Interpolate a path (T, 2) at `_STEP_TIMES`, shape (S, 2).

    The path begins at the current position, and stays at its last position.
    """
    if times[0] > 0:
        times = np.append(0.0, times)
        path = np.vstack([present, path])
    coordinates = [np.interp(_STEP_TIMES, times, values) for values in path.T]
    return np.column_stack(coordinates)


def _segmentation_evidence(
    loader: SampleLoader,
    token: str,
    prediction: SegmentationOutput,
    truth: SegmentationOutput,
    known: BoolArray,
) -> SampleEvidence:
    """Compare cells of classes: for each mistake, only the cells that it changes."""
    grid = truth.grid
    true = grid.reorient(known & np.asarray(truth.masks), "devkit")
    predicted = grid.reorient(known & compared_masks(prediction, truth), "devkit")
    single_true = true & (true.sum(axis=0) == 1)
    single_predicted = predicted & (predicted.sum(axis=0) == 1)
    tallies = {
        "place": _overlap(predicted, true, predicted).sum(axis=1, keepdims=True),
        _LAYERS: np.einsum("ihw,jhw->ij", single_true.astype(float), single_predicted),
    }
    for name, (x, y, order) in _AXES.items():
        if grid.x == grid.y or order == 1:
            turned = _turn_maps(predicted, x, y, order)
            tallies[name] = _changed_cells(turned == true, turned != predicted)
    for name, (x_shift, y_shift) in _SHIFTS.items():
        shifted_grid = BevGrid(_shift_axis(grid.x, x_shift), _shift_axis(grid.y, y_shift))
        shifted, _ = segmentation_truth(loader.dataset, token, shifted_grid, loader.setup.rules)
        moved = np.asarray(shifted.masks)
        tallies[name] = _changed_cells(moved == predicted, moved != true)
    return SampleEvidence(tallies=tallies, empty=not predicted.any())


def _shift_axis(axis: Axis, shift: float) -> Axis:
    """Return an axis of a grid that begins and ends `shift` cells later."""
    start, end, size = axis
    return start + shift * size, end + shift * size, size


def _changed_cells(is_right: BoolArray, is_changed: BoolArray) -> FloatArray:
    """Tally the cells that a mistake changes; each is right either as predicted or without it.

    Args:
        is_right: Whether each cell is right once the mistake is undone.
        is_changed: Whether the mistake changes each cell.
    """
    total = np.count_nonzero(is_changed)
    hits = np.count_nonzero(is_right & is_changed)
    return tally_of(hits, total - hits, total)


# Task of results → function that takes a sample's token, prediction and truth, and examines them.
_EXAMINERS: Mapping[str, Callable[..., SampleEvidence]] = {
    "motion": _motion_evidence,
    "accident": _accident_evidence,
    "detection": _detection_evidence,
    "tracking": _tracking_evidence,
    "planning": _plan_evidence,
    "forecasting": _forecast_evidence,
    "segmentation": _segmentation_evidence,
}
