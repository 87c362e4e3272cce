"""Metrics of predicted motion: IoU, VPQ, minADE, minFDE and miss rate; the task `motion`."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from types import MappingProxyType
from typing import Any, ClassVar, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total
from deepaccident_devkit.evaluation.instances import (
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
)
from deepaccident_devkit.evaluation.predictions import (
    MotionOutput,
    cells_within,
    checked_pair,
    compared_frames,
    compared_labels,
    first_frames,
    labels_at_present,
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

# Name, as the released code prints it → side of the square around the ego in which IoU and VPQ are
# counted, metres.
RANGES: Final[Mapping[str, float]] = MappingProxyType({"30x30": 30.0, "100x100": 100.0})


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionProtocol:
    """The choices of the motion metrics; the defaults are the released ones.

    Sources: docs/released_code.md, Post-processing, IoU and VPQ, and Paths.

    Attributes:
        labels: Name of the protocol of the true labels; other labels are refused. None for any
            labels.
        nothing_is_zero: Whether IoU and VPQ of samples with nothing to count are 0; otherwise NaN.
    """

    labels: str | None = "released"
    nothing_is_zero: bool = True

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError."""
        settle_choices(self, {"labels": (None, *LABEL_PROTOCOLS)})


MOTION_PROTOCOLS: Final[Mapping[str, MotionProtocol]] = MappingProxyType(
    {"released": MotionProtocol(), "paper": MotionProtocol(nothing_is_zero=False)}
)
"""The metrics of the released code. The paper's text only has their names, from FIERY, and the
ranges: so `paper` is the released code, except that a number with nothing to count is NaN and not
0."""


# How instances are read off heads, and off labels, for minADE, minFDE and miss rate. The released
# code has these errors from the accident evaluation, which links and cuts out instances by other
# rules than VPQ's.
_PATH_PROCESSING: Final = replace(POST_PROCESSING["accident"], redraw=False)
_PATH_COUNTS: Final = ("true_positive", "false_positive", "false_negative")
_PATH_SUMS: Final = ("ade", "fde", "missed", "count", *_PATH_COUNTS)
_INSTANCE_MAPS_NOTE: Final = (
    "given as instance maps, and so compared with the labels' own instances, of paths too; those "
    "given as heads have their paths compared with what is read off the labels as if a model had "
    "predicted them"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeResult(ShortRepr):
    """Metrics within one range.

    Attributes:
        iou: Intersection over union of the actors' cells, percent.
        pq: Video panoptic quality, percent.
        sq: Segmentation quality of the instances found, percent.
        rq: Recognition quality, percent.
        true_positive: Instances found, frame by frame.
        false_positive: Instances predicted without a true one.
        false_negative: Instances missed.
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
    """Motion metrics of some samples.

    Attributes:
        ranges: Metrics by range (`30x30`, `100x100`), for the last prediction, which in the
            released order is the mean.
        min_ade: Mean error of the paths over their frames, of the best of all predictions, metres;
            NaN without any.
        min_fde: Error of the paths at the last frame, metres; likewise.
        miss_rate: Share of the paths that end too far away, in [0, 1]; likewise.
        paths: Number of true paths with a partner in some prediction: the three errors are means
            over them.
        path_accuracy: tp / (tp + fp / 2 + fn / 2) of the last prediction's paths, in [0, 1]; NaN
            without any.
        path_true_positive: Paths of the last prediction that have a partner.
        path_false_positive: Paths of the last prediction that have none.
        path_false_negative: True paths without a partner.
        samples: Number of samples.
        frames: Number of compared frames of all samples.
        notes: Sentences that a reader of the numbers should know.
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
    # paths of all predictions
    min_ade: float
    min_fde: float
    miss_rate: float
    paths: int
    # paths of the last prediction
    path_accuracy: float
    path_true_positive: int
    path_false_positive: int
    path_false_negative: int
    # totals
    samples: int
    frames: int
    notes: tuple[str, ...] = ()


class MotionEvaluator(Evaluator[MotionResult]):
    """IoU and VPQ of the last prediction, and errors of the paths over all predictions.

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
        """Start without samples.

        Args:
            protocol: Name of one of `MOTION_PROTOCOLS`, or a protocol with other fields.
            trajectories: Whether paths are compared too. For heads that takes many times as long as
                everything besides, since instances are read off all predictions and the labels for
                it.

        Raises:
            ChoiceError: no protocol has that name.
        """
        super().__init__(protocol)
        self.trajectories = trajectories

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices, and whether paths are compared."""
        return {"protocol": asdict(self.protocol), "trajectories": self.trajectories}

    def truth(
        self, dataset: Dataset, token: str, form: Any, horizon: float, /
    ) -> tuple[MotionLabels | None]:
        """Return the sample's motion labels, on the grid of the results."""
        return (compared_labels(dataset, token, self.protocol, form, horizon),)

    def update(self, token: str, prediction: MotionOutput, label: MotionLabels) -> None:
        """Count one sample.

        Args:
            token: Token of the sample.
            prediction: Prediction of a model, in any orientation.
            label: Labels of the sample, on the same ground; frames in their own frames are warped
                to the present.

        Raises:
            EvaluationError: there is no prediction or label, the labels are of another protocol,
                the prediction has another grid or too few frames, or the sample came before with
                other counts.
        """
        self.add(
            token, motion_counts(prediction, label, self.protocol, trajectories=self.trajectories)
        )

    def result_of(self, counts: Collection[Counts]) -> MotionResult:
        """Return the metrics of some samples' counts, in any order."""
        return motion_result(counts, self.protocol)

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return IoU and PQ (percent), instances and cells by range, then path errors (m)."""
        result = self.compute([token])
        row: dict[str, Any] = {"frames": result.frames}
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
        """Return the counts of one sample of one frame that have the same result."""
        return [_sums(counts)]

    def selected_as_released(self, order: Sequence[str], selected: Collection[str]) -> MotionResult:
        """Return the result that the released code has "by attribute", with its mistake.

        The mistake is reproduced for comparison: VPQ has one entry per *frame*, of all samples one
        after the other, and takes the entries with the numbers of *samples*, so that most of its
        sum belongs to other samples. `compute(selected)` is the correct result.

        Args:
            order: All samples in the order evaluated.
            selected: Some of them.

        Raises:
            EvaluationError: one of them was not counted.
        """
        self.compute(order)  # refuses samples that were not counted
        frames = []
        for token in order:
            counts = self._counts[token]
            for frame in range(counts["frames"]):
                frame_vpq = [[[values[frame]] for values in numbers] for numbers in counts["vpq"]]
                frames.append(frame_vpq)
        released_counts = []
        for number, token in enumerate(order):
            if token in set(selected):
                released_counts.append({**self._counts[token], "vpq": frames[number]})
        return motion_result(released_counts, self.protocol)


def motion_counts(
    prediction: MotionOutput,
    label: MotionLabels,
    protocol: MotionProtocol | None = None,
    *,
    trajectories: bool = True,
) -> Counts:
    """Return what one sample adds, as JSON can hold it.

    Arguments and errors are as in `MotionEvaluator.update`.

    Returns:
        `samples`, 1; `frames` compared; `instance_maps`, 1 if the prediction is instance maps,
        otherwise 0; by range, `cells` [tp, fp, fn] and `vpq`, four lists by frame: the sum of the
        intersections over unions, and the numbers of true positives, false positives and false
        negatives; `paths`, sums by name, or None.
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
    cells = []
    vpq = []
    for extent in RANGES.values():
        within = (slice(None), *cells_within(grid, extent))
        mask = mask_counts(actors[within], true_actors[within])
        cells.append([mask.true_positive, mask.false_positive, mask.false_negative])
        quality = vpq_counts(instance[within], true_instance[within])
        numbers = (
            quality.iou,
            quality.true_positive,
            quality.false_positive,
            quality.false_negative,
        )
        vpq.append([values[:, 1].tolist() for values in numbers])
    return {
        "samples": 1,
        "frames": frames,
        "instance_maps": int(prediction.instances is not None),
        "cells": cells,
        "vpq": vpq,
        "paths": _path_counts(prediction, truth, frames) if trajectories else None,
    }


def _last_maps(prediction: MotionOutput, frames: int) -> tuple[AnyArray, AnyArray]:
    """Return the actors' cells and the instances of the last prediction, shape (T, H, W) each.

    Both are in the orientation of the prediction.
    """
    actors = actor_cells(prediction)[:frames]
    if prediction.instances is not None:
        return actors, prediction.instances[-1, :frames]
    heads = first_frames((prediction.heads or ())[-1], frames)
    return actors, predict_instances(heads, "motion").instance


def actor_cells(prediction: MotionOutput) -> AnyArray:
    """Return which cells are actors in the last prediction, shape (T, H, W), in its orientation."""
    if prediction.instances is not None:
        instances: AnyArray = prediction.instances[-1] > 0
        return instances
    segmentation = (prediction.heads or ())[-1].segmentation
    return segmentation[:, 1] > segmentation[:, 0]


def _path_counts(prediction: MotionOutput, truth: MotionLabels, frames: int) -> dict[str, float]:
    """Return the sums of the path errors of one sample, and the cases of its last prediction."""
    grid = truth.config.grid
    if prediction.instances is not None:
        true = instance_paths(truth.instance[:frames], grid)
        predicted = []
        for maps in prediction.instances:
            predicted.append(instance_paths(maps[:frames], prediction.grid))
    else:
        true = _paths_of(first_frames(MotionHeads.from_labels(truth), frames), grid)
        predicted = []
        for heads in prediction.heads or ():
            predicted.append(_paths_of(first_frames(heads, frames), grid))
    length = longest(true)
    predicted = [padded(paths, length) for paths in predicted]
    true = padded(true, length)
    matches = [match_trajectories(paths, true) for paths in predicted]
    errors = trajectory_errors(predicted, true, matches)
    last = matches[-1]
    return asdict(errors) | {
        "true_positive": len(last.pairs),
        "false_positive": len(last.unmatched_prediction),
        "false_negative": len(last.unmatched_truth),
    }


def _paths_of(heads: MotionHeads, grid: BevGrid) -> dict[int, FloatArray]:
    """Return the paths of the instances of heads."""
    instances = predict_instances(heads, _PATH_PROCESSING)
    return trajectories(instances, grid, half_cell_shift=False)


def _sums(counts: Collection[Counts]) -> dict[str, Any]:
    """Return the samples' counts in the form of one sample of one frame."""
    vpq = []
    for index in range(len(RANGES)):
        sums = []
        for kind in range(4):
            values = chain.from_iterable(sample["vpq"][index][kind] for sample in counts)
            sums.append([math.fsum(values)])
        vpq.append(sums)
    cells = []
    for index in range(len(RANGES)):
        case_columns = list(zip(*(sample["cells"][index] for sample in counts), strict=True))
        cells.append([sum(column) for column in case_columns] or [0, 0, 0])
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
    """Return the metrics of some samples' counts, in any order."""
    sums = _sums(counts)
    ranges = {}
    for name, cells, vpq in zip(RANGES, sums["cells"], sums["vpq"], strict=True):
        ranges[name] = _range_result(cells, vpq, protocol)
    paths = sums["paths"]
    true_positive, false_positive, false_negative = (int(paths[name]) for name in _PATH_COUNTS)
    notes: tuple[str, ...] = ()
    if sums["instance_maps"]:
        predictions = counted(sums["samples"], "prediction")
        notes = (f"{sums['instance_maps']} of {predictions}: {_INSTANCE_MAPS_NOTE}",)
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
    """Return the metrics of one range.

    Args:
        cells: Sums of [tp, fp, fn] cells.
        vpq: Sums of overlaps, found, false and missed instances, each in a list.
        protocol: The rules.
    """
    (overlap,), *numbers = vpq
    matches, alarms, missed = (int(number) for (number,) in numbers)
    quality = panoptic_quality(overlap, matches, alarms, missed)
    absent = 0.0 if protocol.nothing_is_zero else math.nan
    has_instances = matches or alarms or missed
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
        false_positive=alarms,
        false_negative=missed,
    )
