"""Metrics of predicted motion (task `motion`): IoU, VPQ, minADE, minFDE and miss rate."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.drawing import Drawing, DrawnCells, DrawnPath, Role, drawn_pair
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total
from deepaccident_devkit.evaluation.instances import (
    CLASSES,
    PanopticQuality,
    SegmentationCounts,
    instance_paths,
    iou,
    longest,
    mask_counts,
    match_trajectories,
    padded,
    panoptic_quality,
    prediction_accuracy,
    trajectory_errors,
    vpq_counts,
    vpq_matches,
)
from deepaccident_devkit.evaluation.predictions import (
    MotionOutput,
    cells_within,
    checked_pair,
    compared_frames,
    compared_labels,
    first_frames,
    labels_at_present,
    num_recorded_frames,
)
from deepaccident_devkit.evaluation.task import Row, TaskResult
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    POST_PROCESSING,
    MotionHeads,
    MotionLabels,
    predict_instances,
    trajectories,
)
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, ShortRepr
from deepaccident_devkit.support.text import counted, settle_choices
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD

__all__ = [
    "MOTION_PROTOCOLS",
    "MotionEvaluator",
    "MotionProtocol",
    "MotionResult",
    "PanopticQuality",
    "RangeResult",
    "SegmentationCounts",
    "iou",
    "mask_counts",
    "motion_counts",
    "panoptic_quality",
]

# Name of a range, as the released code prints it → side length, in metres, of the square around the
# ego in which IoU and VPQ are counted.
RANGES: Final[Mapping[str, float]] = MappingProxyType({"30x30": 30.0, "100x100": 100.0})


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionProtocol:
    """Options of the motion metrics; the defaults match the released code.

    Sources: docs/released_code.md, sections "Post-processing", "IoU and VPQ" and "Paths".

    Attributes:
        labels: Name of the protocol that the labels must follow; None for any protocol.
        nothing_is_zero: Whether IoU and VPQ are 0 (True) or NaN (False) if there is nothing to
            count.
    """

    labels: str | None = "released"
    nothing_is_zero: bool = True

    def __post_init__(self) -> None:
        """Check the fields; raise ChoiceError if `labels` is not the name of a protocol."""
        settle_choices(self, {"labels": (None, *LABEL_PROTOCOLS)})


MOTION_PROTOCOLS: Final[Mapping[str, MotionProtocol]] = MappingProxyType(
    {"released": MotionProtocol(), "paper": MotionProtocol(nothing_is_zero=False)}
)
"""The metrics of the released code. The paper only states the ranges and the names of the metrics,
which it takes from FIERY. So `paper` is the same as `released`, except that a metric is NaN instead
of 0 if there is nothing to count."""


# Rules for extracting instances from heads and labels for minADE, minFDE and miss rate. The
# released code computes these errors in the accident evaluation, which links and crops instances
# differently than VPQ does.
_PATH_PROCESSING = replace(POST_PROCESSING["accident"], redraw=False)
_PATH_COUNTS = ("true_positive", "false_positive", "false_negative")
_PATH_SUMS = ("ade", "fde", "missed", "count", *_PATH_COUNTS)
_INSTANCE_MAPS_NOTE = (
    "These maps and the paths in them are compared with the labels' own instances. The paths in "
    "heads are compared with paths that are extracted from the labels as from a model's heads"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeResult(ShortRepr):
    """Metrics in one range, the square around the ego.

    Attributes:
        iou: Intersection over union of the actors' cells, percent.
        pq: Video panoptic quality, percent.
        sq: Segmentation quality of the true positives, percent.
        rq: Recognition quality, percent.
        true_positive: Number of matched instances, summed over frames.
        false_positive: Number of predicted instances without a match, summed over frames.
        false_negative: Number of true instances without a match, summed over frames.
    """

    iou: float
    pq: float
    sq: float
    rq: float
    true_positive: int
    false_positive: int
    false_negative: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionResult(TaskResult):
    """Motion metrics of a set of samples.

    Attributes:
        ranges: Metrics by range (`30x30`, `100x100`) of the last prediction, which in the released
            order is the mean.
        min_ade: Error of a path averaged over its frames, for the best of all predictions, metres;
            NaN if there are no paths.
        min_fde: Error of a path in the last frame, for the best of all predictions, metres; NaN if
            there are no paths.
        miss_rate: Share of the paths whose final error is too large, in [0, 1]; NaN if there are no
            paths.
        paths: Number of true paths that are matched in at least one prediction; `min_ade`,
            `min_fde` and `miss_rate` are averaged over these paths.
        path_accuracy: tp / (tp + fp / 2 + fn / 2) of the last prediction's paths, in [0, 1]; NaN
            if there are no paths.
        path_true_positive: Number of matched paths of the last prediction.
        path_false_positive: Number of unmatched paths of the last prediction.
        path_false_negative: Number of true paths that the last prediction does not match.
        samples: Number of samples.
        frames: Number of compared frames, summed over samples.
        notes: Caveats that belong next to the numbers, one sentence each.
    """

    rows: ClassVar[tuple[Row, ...]] = (
        Row("ranges/*/iou", "%", "higher", name="iou *"),
        Row("ranges/*/pq", "%", "higher", name="vpq *"),
        Row("min_ade", "m"),
        Row("min_fde", "m"),
        Row("miss_rate", "share"),
        Row("ranges/*/sq", "%", "higher", is_headline=False),
        Row("ranges/*/rq", "%", "higher", is_headline=False),
        Row("path_accuracy", "share", "higher", is_headline=False),
    )
    ranges: Mapping[str, RangeResult]
    # averaged over the paths of all predictions
    min_ade: float
    min_fde: float
    miss_rate: float
    paths: int
    # counted in the last prediction
    path_accuracy: float
    path_true_positive: int
    path_false_positive: int
    path_false_negative: int
    # totals
    samples: int
    frames: int
    notes: tuple[str, ...] = ()


def predicted_instances(output: MotionOutput) -> Any:
    """Return the instance maps (T, H, W) of the last prediction, in the orientation of the grid."""
    if output.heads is not None:
        return predict_instances(output.heads[-1], "motion").instance
    maps = np.asarray(output.instances)
    return maps[-1]


def _drawn_paths(
    paths: Mapping[int, FloatArray], step: float, role: Role, label: str
) -> list[DrawnPath]:
    """Describe the paths (T, 2) of instances for a picture; `step` is in seconds.

    Instances with one position have no path.
    """
    drawn_paths = []
    for path in paths.values():
        times = np.arange(len(path), dtype=np.float64) * step
        if len(path) > 1:
            drawn_paths.append(DrawnPath(xy=path, times=times, role=role, label=label))
    return drawn_paths


def _drawn_cells(
    predicted: AnyArray, true: AnyArray, grid: BevGrid, step: float
) -> tuple[DrawnCells, ...]:
    """Describe instances (T, H, W) by their outcome in each frame; `step` is in seconds."""
    within = (slice(None), *cells_within(grid, max(RANGES.values())))
    matches = vpq_matches(predicted[within], true[within])
    frames, predicted_ids, true_ids = matches.T
    times = np.arange(len(true), dtype=np.float64) * step
    kinds = []
    sides: tuple[tuple[AnyArray, AnyArray, tuple[tuple[Role, str], ...]], ...] = (
        (true, true_ids, (("truth", "found"), ("missed", "missed"))),
        (predicted, predicted_ids, (("right", "right"), ("false", "false"))),
    )
    for maps, ids, roles in sides:
        matched = np.zeros_like(maps)
        unmatched = np.zeros_like(maps)
        for frame, instance in enumerate(maps):
            is_matched = np.isin(instance, ids[frames == frame])
            is_counted = np.isin(instance, instance[within[1:]])
            matched[frame] = np.where(is_matched, instance, 0)
            unmatched[frame] = np.where(is_counted & ~is_matched, instance, 0)
        for instance, (role, kind) in zip((matched, unmatched), roles, strict=True):
            kinds.append(
                DrawnCells(instance=instance, grid=grid, times=times, role=role, label=kind)
            )
    return tuple(kinds)


class MotionEvaluator(Evaluator[MotionResult]):
    """Evaluator of motion: IoU and VPQ of the last prediction, path errors of all predictions.

    >>> evaluator = MotionEvaluator()
    >>> evaluator.compute().ranges["30x30"].iou
    0.0
    """

    task = "motion"
    description = "Evaluate predicted motion: IoU, VPQ and path errors."
    result_kinds: ClassVar[tuple[str, ...]] = ("motion",)
    protocols = MOTION_PROTOCOLS
    result_class = MotionResult
    main_numbers: ClassVar[tuple[str, ...]] = ("ranges/100x100/pq", "ranges/100x100/iou")

    def __init__(
        self, protocol: str | MotionProtocol = "released", *, trajectories: bool = True
    ) -> None:
        """Create an evaluator without samples.

        Args:
            protocol: Name of one of `MOTION_PROTOCOLS`, or a `MotionProtocol`.
            trajectories: Whether to compare paths, too. For heads this takes many times as long as
                the rest, since instances are extracted from all predictions and from the labels.

        Raises:
            ChoiceError: If no protocol has this name.
        """
        super().__init__(protocol)
        self.trajectories = trajectories

    @property
    def settings(self) -> dict[str, Any]:
        """Names and values of the settings: the protocol's fields, and whether to compare paths."""
        protocol = asdict(self.protocol)
        return {"protocol": protocol, "trajectories": self.trajectories}

    def truth(
        self, dataset: Dataset, token: str, form: Any, horizon: float, /
    ) -> tuple[MotionLabels | None]:
        """Return the sample's motion labels on the grid of the predictions."""
        return (compared_labels(dataset, token, self.protocol, form, horizon),)

    def update(self, token: str, prediction: MotionOutput, label: MotionLabels) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            prediction: Prediction of a model, in any orientation.
            label: Labels of the sample for the same area; if each of their frames is in its own ego
                frame, they are warped to the current one.

        Raises:
            EvaluationError: If the prediction or the label is missing, the labels follow another
                protocol, the prediction has another grid or too few frames, or the sample was
                counted before with other counts.
        """
        counts = motion_counts(prediction, label, self.protocol, trajectories=self.trajectories)
        self.add(token, counts)

    def drawing(self, dataset: Dataset, token: str, prediction: Any, /, *truth: Any) -> Drawing:
        """Describe the cells and paths of predicted instances (the last prediction) and true ones.

        Instances are matched frame by frame, as VPQ does within the largest range; instances
        outside it have no cells in the picture.
        """
        (label,) = truth
        present = labels_at_present(label)
        step = label.config.step * FRAME_PERIOD
        grid = label.config.grid
        true_maps = np.where(present.label_valid[:, None, None], present.instance, 0)
        true = grid.reorient(true_maps, "devkit")
        predicted = prediction.grid.reorient(predicted_instances(prediction), "devkit")
        grid = grid.with_orientation("devkit")
        paths = [
            *_drawn_paths(instance_paths(predicted, grid), step, "predicted", "predicted path"),
            *_drawn_paths(instance_paths(true, grid), step, "truth", "true path"),
        ]
        frames = num_recorded_frames(label)
        cells = _drawn_cells(predicted[:frames], true[:frames], grid, step)
        return Drawing(paths=tuple(paths), boxes=drawn_pair(dataset, token), cells=cells)

    def result_of(self, counts: Collection[Counts]) -> MotionResult:
        """Compute the metrics from the counts of samples, in any order."""
        return motion_result(counts, self.protocol)

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return a sample's row: IoU and PQ (%), instances, cells by range; path errors (m)."""
        result = self.compute([token])
        row: NamedValues = {"frames": result.frames}
        cells_by_range = self._counts[token]["cells"]
        for (name, metrics), cells in zip(result.ranges.items(), cells_by_range, strict=True):
            row[f"iou_{name}"] = metrics.iou
            row[f"pq_{name}"] = metrics.pq
            row[f"tp_{name}"] = metrics.true_positive
            row[f"fp_{name}"] = metrics.false_positive
            row[f"fn_{name}"] = metrics.false_negative
            for case, count in zip(("tp", "fp", "fn"), cells, strict=True):
                row[f"cells_{case}_{name}"] = count
        paths = ("paths", "path_true_positive", "path_false_positive", "path_false_negative")
        for name in (*paths, "min_ade", "min_fde", "miss_rate"):
            row[name] = getattr(result, name)
        return row

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """Sum the counts; the list has a single entry that looks like a sample with one frame."""
        return [_sum_counts(counts)]

    def selected_as_released(self, order: Sequence[str], selected: Collection[str]) -> MotionResult:
        """Compute the result that the released code prints "by attribute", including its mistake.

        The mistake is reproduced for comparison. The released code stores one entry of VPQ per
        *frame*, one sample after the other, but selects entries by the indices of *samples*, so
        most of the summed entries belong to other samples. For the correct result, call
        `compute(selected)`.

        Args:
            order: Tokens of all samples, in the order in which they were evaluated.
            selected: Tokens of the selected samples.

        Raises:
            EvaluationError: If a sample was not counted.
        """
        self.compute(order)  # raises for samples that were not counted
        vpq_by_frame = []
        for token in order:
            counts = self._counts[token]
            for frame in range(counts["frames"]):
                frame_vpq = []
                for numbers in counts["vpq"]:
                    frame_vpq.append([[values[frame]] for values in numbers])
                vpq_by_frame.append(frame_vpq)
        released_counts = []
        for number, token in enumerate(order):
            if token in set(selected):
                released_counts.append({**self._counts[token], "vpq": vpq_by_frame[number]})
        return motion_result(released_counts, self.protocol)


def motion_counts(
    prediction: MotionOutput,
    label: MotionLabels,
    protocol: MotionProtocol | None = None,
    *,
    trajectories: bool = True,
) -> Counts:
    """Count one sample; the counts can be stored as JSON.

    Arguments and errors are as in `MotionEvaluator.update`.

    Returns:
        `samples`: 1. `frames`: number of compared frames. `instance_maps`: 1 if the prediction
        consists of instance maps, otherwise 0. `cells`: [tp, fp, fn] for each range. `vpq`: for
        each range, four lists with one entry per frame: the summed intersections over unions, and
        the numbers of true positives, false positives and false negatives. `paths`: sums by name;
        None if paths are not compared.
    """
    rules = protocol or MotionProtocol()
    prediction, label = checked_pair(prediction, label)
    frames = compared_frames(prediction, label, rules.labels)
    truth = labels_at_present(label)
    grid = label.config.grid
    maps = _last_maps(prediction, frames)
    actors, instance = (prediction.grid.reorient(raster, grid.orientation) for raster in maps)
    true_actors = truth.segmentation[:frames] == 1
    true_instance = truth.instance[:frames]
    instances_column = CLASSES.index("instances")
    cells = []
    vpq = []
    for extent in RANGES.values():
        in_range = (slice(None), *cells_within(grid, extent))
        mask = mask_counts(actors[in_range], true_actors[in_range])
        cells.append([mask.true_positive, mask.false_positive, mask.false_negative])
        quality = vpq_counts(instance[in_range], true_instance[in_range])
        numbers = (
            quality.iou,
            quality.true_positive,
            quality.false_positive,
            quality.false_negative,
        )
        vpq.append([values[:, instances_column].tolist() for values in numbers])
    return {
        "samples": 1,
        "frames": frames,
        "instance_maps": int(prediction.instances is not None),
        "cells": cells,
        "vpq": vpq,
        "paths": _path_counts(prediction, truth, frames) if trajectories else None,
    }


def _last_maps(prediction: MotionOutput, frames: int) -> tuple[AnyArray, AnyArray]:
    """Return the actor mask and the instance map of the last prediction, shape (T, H, W) each.

    Both have the orientation of the prediction.
    """
    actors = actor_cells(prediction)[:frames]
    if prediction.instances is not None:
        return actors, prediction.instances[-1, :frames]
    heads = first_frames((prediction.heads or ())[-1], frames)
    return actors, predict_instances(heads, "motion").instance


def actor_cells(prediction: MotionOutput) -> AnyArray:
    """Return the mask of the last prediction's actor cells (T, H, W), in its orientation."""
    if prediction.instances is not None:
        instances: AnyArray = prediction.instances[-1] > 0
        return instances
    segmentation = (prediction.heads or ())[-1].segmentation
    background = segmentation[:, 0]
    actor = segmentation[:, 1]
    return actor > background


def _path_counts(
    prediction: MotionOutput, truth: MotionLabels, num_frames: int
) -> dict[str, float]:
    """Sum a sample's path errors over all predictions, and count TP/FP/FN of the last (the mean).

    Only the first `num_frames` frames are compared.
    """
    grid = truth.config.grid
    if prediction.instances is not None:
        true_paths = instance_paths(truth.instance[:num_frames], grid)
        predicted_paths = []
        for maps in prediction.instances:
            predicted_paths.append(instance_paths(maps[:num_frames], prediction.grid))
    else:
        label_heads = MotionHeads.from_labels(truth)
        true_paths = _read_paths(first_frames(label_heads, num_frames), grid)
        predicted_paths = []
        for heads in prediction.heads or ():
            predicted_paths.append(_read_paths(first_frames(heads, num_frames), grid))
    max_path_length = longest(true_paths)
    predicted_paths = [padded(paths, max_path_length) for paths in predicted_paths]
    true_paths = padded(true_paths, max_path_length)
    matches = [match_trajectories(paths, true_paths) for paths in predicted_paths]
    errors = trajectory_errors(predicted_paths, true_paths, matches)
    last_matches = matches[-1]
    return asdict(errors) | {
        "true_positive": len(last_matches.pairs),
        "false_positive": len(last_matches.unmatched_prediction),
        "false_negative": len(last_matches.unmatched_truth),
    }


def _read_paths(heads: MotionHeads, grid: BevGrid) -> dict[int, FloatArray]:
    """Extract instances from heads, and return their paths: id → (n, 2) positions, metres."""
    instances = predict_instances(heads, _PATH_PROCESSING)
    return trajectories(instances, grid, half_cell_shift=False)


def _sum_counts(counts: Collection[Counts]) -> NamedValues:
    """Sum the counts of samples; the sums look like the counts of a sample with one frame."""
    vpq = []
    cells = []
    for range_index in range(len(RANGES)):
        vpq_sums = []
        for number_index in range(4):
            values = [sample["vpq"][range_index][number_index] for sample in counts]
            vpq_sums.append([math.fsum(chain.from_iterable(values))])
        vpq.append(vpq_sums)
        sample_cells = [sample["cells"][range_index] for sample in counts]
        cell_sums = [sum(numbers) for numbers in zip(*sample_cells, strict=True)]
        cells.append(cell_sums or [0, 0, 0])
    paths = [sample["paths"] for sample in counts if sample["paths"]]
    return {
        "samples": sum(sample["samples"] for sample in counts),
        "frames": sum(sample["frames"] for sample in counts),
        "instance_maps": sum(sample["instance_maps"] for sample in counts),
        "cells": cells,
        "vpq": vpq,
        "paths": {name: total(paths, name) for name in _PATH_SUMS},
    }


def motion_result(counts: Collection[Counts], protocol: MotionProtocol) -> MotionResult:
    """Compute the metrics from the counts of samples, in any order."""
    sums = _sum_counts(counts)
    ranges = {}
    for name, cells, vpq in zip(RANGES, sums["cells"], sums["vpq"], strict=True):
        ranges[name] = _range_result(cells, vpq, protocol)
    paths = sums["paths"]
    true_positive, false_positive, false_negative = (int(paths[name]) for name in _PATH_COUNTS)
    notes: tuple[str, ...] = ()
    if sums["instance_maps"]:
        predictions = counted(sums["samples"], "prediction")
        share = f"{sums['instance_maps']} of {predictions}"
        notes = (f"given as instance maps: {share}. {_INSTANCE_MAPS_NOTE}",)
    return MotionResult(
        ranges=ranges,
        min_ade=ratio(paths["ade"], paths["count"]),
        min_fde=ratio(paths["fde"], paths["count"]),
        miss_rate=ratio(paths["missed"], paths["count"]),
        paths=int(paths["count"]),
        path_accuracy=prediction_accuracy(true_positive, false_positive, false_negative),
        path_true_positive=true_positive,
        path_false_positive=false_positive,
        path_false_negative=false_negative,
        samples=sums["samples"],
        frames=sums["frames"],
        notes=notes,
    )


def _range_result(
    cells: Sequence[int], vpq: Sequence[Sequence[float]], protocol: MotionProtocol
) -> RangeResult:
    """Compute the metrics in one range.

    Args:
        cells: Summed [tp, fp, fn] of cells.
        vpq: Four lists with one sum each: overlaps, matched instances, false ones, missed ones.
        protocol: Protocol that decides what a metric is if there is nothing to count.
    """
    (overlap,), *numbers = vpq
    matches, false_alarms, missed = (int(number) for (number,) in numbers)
    quality = panoptic_quality(overlap, matches, false_alarms, missed)
    absent = 0.0 if protocol.nothing_is_zero else math.nan
    has_instances = matches or false_alarms or missed
    percent = 100.0 if has_instances or protocol.nothing_is_zero else math.nan
    true_positive, false_positive, false_negative = cells
    mask = SegmentationCounts(
        true_positive=true_positive, false_positive=false_positive, false_negative=false_negative
    )
    return RangeResult(
        iou=100 * iou([mask], absent=absent),
        pq=percent * quality.pq,
        sq=percent * quality.sq,
        rq=percent * quality.rq,
        true_positive=matches,
        false_positive=false_alarms,
        false_negative=missed,
    )
