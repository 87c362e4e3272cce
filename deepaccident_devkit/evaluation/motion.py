"""How well a model foresees where all actors are: IoU, VPQ, minADE, minFDE, miss rate; the task `motion`."""

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
    SegmentationCounts,
    instance_paths,
    iou,
    longest,
    mask_counts,
    match_trajectories,
    padded,
    panoptic_quality,
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
    "RangeResult",
    "motion_counts",
]

# Name, as the released code prints it → metres: side of a square around the ego in which IoU and VPQ are counted.
RANGES: Final[Mapping[str, float]] = MappingProxyType({"30x30": 30.0, "100x100": 100.0})


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionProtocol:
    """The choices of the motion metrics; the defaults are the released ones.

    Sources: docs/released_code.md, Post-processing, IoU and VPQ, and Paths.

    Attributes:
        labels: protocol of the labels that are the truth, by name; others are refused. None for any labels.
        nothing_is_zero: IoU and VPQ of samples with nothing to count are 0; else NaN.
    """

    labels: str | None = "released"
    nothing_is_zero: bool = True

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError."""
        settle_choices(self, {"labels": (None, *LABEL_PROTOCOLS)})


MOTION_PROTOCOLS: Final[Mapping[str, MotionProtocol]] = MappingProxyType(
    {"released": MotionProtocol(), "paper": MotionProtocol(nothing_is_zero=False)}
)
"""What the released code computes. The paper's text says no more of these metrics than their names, FIERY's and the
ranges: so `paper` is the released code, except that a number with nothing to count is NaN and not 0."""


# How instances are read off heads, and off labels, for minADE, minFDE and miss rate. The released code has these
# errors from the accident evaluation, which links and cuts out instances by other rules than VPQ's.
_READ_FOR_PATHS: Final = replace(POST_PROCESSING["accident"], redraw=False)
_PATH_COUNTS: Final = ("true_positive", "false_positive", "false_negative")
_PATHS: Final = ("ade", "fde", "missed", "count", *_PATH_COUNTS)
_INSTANCE_MAPS: Final = (
    "given as instance maps, and so compared with the labels' own instances, of paths too; those given as heads have "
    "their paths compared with what is read off the labels as if a model had predicted them"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeResult(ShortRepr):
    """Metrics within one range.

    Attributes:
        iou: intersection over union of the actors' cells, percent.
        pq: video panoptic quality, percent.
        sq: segmentation quality of the instances found, percent.
        rq: recognition quality, percent.
        true_positive: instances found, frame by frame.
        false_positive: instances predicted without a true one.
        false_negative: instances missed.
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
        ranges: by name (`30x30`, `100x100`), of the last prediction, which in the released order is the mean.
        min_ade: metres: mean error of the paths over their frames, of the best of all predictions; NaN without any.
        min_fde: metres: their error at the last frame; likewise.
        miss_rate: share of the paths that end too far away, in [0, 1]; likewise.
        paths: how many true paths have a partner in some prediction: what the three are means over.
        path_accuracy: tp / (tp + fp / 2 + fn / 2) of the last prediction's paths, in [0, 1]; NaN without any.
        path_true_positive: paths of the last prediction that have a partner.
        path_false_positive: those that have none.
        path_false_negative: true paths without one.
        samples: how many.
        frames: compared, of all samples.
        notes: sentences that a reader of the numbers should know.
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
    min_ade: float
    min_fde: float
    miss_rate: float
    paths: int
    path_accuracy: float
    path_true_positive: int
    path_false_positive: int
    path_false_negative: int
    samples: int
    frames: int
    notes: tuple[str, ...] = ()


class MotionEvaluator(Evaluator[MotionResult]):
    """IoU and VPQ of the last prediction, and errors of the paths over all of them.

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
            protocol: of `MOTION_PROTOCOLS` by name, or one with other fields.
            trajectories: whether paths are compared too. Of heads that takes many times as long as all the rest, since
                instances are read off all predictions and the labels for it.

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
            token: of the sample.
            prediction: what a model says, in any orientation.
            label: the sample's labels, on the same ground; those still in their own frames are warped to the present.

        Raises:
            EvaluationError: there is no prediction or label, the labels are of another protocol, the prediction has
                another grid or too few frames, or the sample came before with another outcome.
        """
        self.add(
            token, motion_counts(prediction, label, self.protocol, trajectories=self.trajectories)
        )

    def result_of(self, counts: Collection[Counts]) -> MotionResult:
        """The metrics of some samples' counts, in any order."""
        return motion_result(counts, self.protocol)

    def sample_row(self, token: str) -> dict[str, Any]:
        """Return IoU and PQ (percent), instances and cells by range, then the paths and their errors (m)."""
        result = self.compute([token])
        row: dict[str, Any] = {"frames": result.frames}
        for (name, part), cells in zip(
            result.ranges.items(), self._counts[token]["cells"], strict=True
        ):
            row |= {f"iou_{name}": part.iou, f"pq_{name}": part.pq}
            row |= {
                f"tp_{name}": part.true_positive,
                f"fp_{name}": part.false_positive,
                f"fn_{name}": part.false_negative,
            }
            row |= {
                f"cells_{case}_{name}": count
                for case, count in zip(("tp", "fp", "fn"), cells, strict=True)
            }
        paths = ("paths", "path_true_positive", "path_false_positive", "path_false_negative")
        return row | {
            name: getattr(result, name) for name in (*paths, "min_ade", "min_fde", "miss_rate")
        }

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """The samples' counts as those of one sample of one frame, which have the same result."""
        return [_sums(counts)]

    def selected_as_released(self, order: Sequence[str], selected: Collection[str]) -> MotionResult:
        """The result of some samples as the released code has it "by attribute": with the VPQ of other frames.

        A mistake that is kept for comparison: it has one entry a *frame*, of all samples one after the other, and takes
        those whose number is a *sample's*, so that most of what it sums up belongs to others. `compute(selected)` is
        the correct result.

        Args:
            order: all samples in the order evaluated.
            selected: some of them.

        Raises:
            EvaluationError: one of them was not counted.
        """
        self.compute(order)  # refuses samples that were not counted
        frames = [
            [[[values[frame]] for values in each] for each in self._counts[token]["vpq"]]
            for token in order
            for frame in range(self._counts[token]["frames"])
        ]
        chosen = [
            {**self._counts[token], "vpq": frames[number]}
            for number, token in enumerate(order)
            if token in set(selected)
        ]
        return motion_result(chosen, self.protocol)


def motion_counts(
    prediction: MotionOutput,
    label: MotionLabels,
    protocol: MotionProtocol | None = None,
    *,
    trajectories: bool = True,
) -> Counts:
    """What one sample adds, as JSON can hold it; arguments and errors as of `MotionEvaluator.update`.

    Returns:
        `samples`, 1; `frames` compared; `instance_maps`, 1 if the prediction was given so, else 0; by range, `cells`
        [tp, fp, fn] and `vpq`, four lists by frame: the sum of the intersections over unions, and the numbers of true
        positives, false positives and false negatives; `paths`, sums by name, or None.
    """
    rules = protocol or MotionProtocol()
    prediction, label = checked_pair(prediction, label)
    frames = compared_frames(prediction, label, rules.labels)
    truth, grid = labels_at_present(label), label.config.grid
    actors, instance = (
        prediction.grid.reorient(each, grid.orientation) for each in _last_maps(prediction, frames)
    )
    true_actors, true_instance = truth.segmentation[:frames] == 1, truth.instance[:frames]
    cells, vpq = [], []
    for extent in RANGES.values():
        within = (slice(None), *cells_within(grid, extent))
        counted = mask_counts(actors[within], true_actors[within])
        cells.append([counted.true_positive, counted.false_positive, counted.false_negative])
        quality = vpq_counts(instance[within], true_instance[within])
        by_name = (
            quality.iou,
            quality.true_positive,
            quality.false_positive,
            quality.false_negative,
        )
        vpq.append([values[:, 1].tolist() for values in by_name])
    return {
        "samples": 1,
        "frames": frames,
        "instance_maps": int(prediction.instances is not None),
        "cells": cells,
        "vpq": vpq,
        "paths": _path_counts(prediction, truth, frames) if trajectories else None,
    }


def _last_maps(prediction: MotionOutput, frames: int) -> tuple[AnyArray, AnyArray]:
    """(T, H, W) which cells are actors, and instances, of the last prediction, as it lies."""
    actors = actor_cells(prediction)[:frames]
    if prediction.instances is not None:
        return actors, prediction.instances[-1, :frames]
    return actors, predict_instances(
        first_frames((prediction.heads or ())[-1], frames), "motion"
    ).instance


def actor_cells(prediction: MotionOutput) -> AnyArray:
    """(T, H, W) which cells are actors in the last prediction, as it lies."""
    if prediction.instances is not None:
        instances: AnyArray = prediction.instances[-1] > 0
        return instances
    segmentation = (prediction.heads or ())[-1].segmentation
    return segmentation[:, 1] > segmentation[:, 0]


def _path_counts(prediction: MotionOutput, truth: MotionLabels, frames: int) -> dict[str, float]:
    grid = truth.config.grid
    if prediction.instances is not None:
        maps = [*((each, prediction.grid) for each in prediction.instances), (truth.instance, grid)]
        *predicted, true = (instance_paths(each[:frames], cells) for each, cells in maps)
    else:
        heads = (*(prediction.heads or ()), MotionHeads.from_labels(truth))
        *predicted, true = (_paths_of(first_frames(each, frames), grid) for each in heads)
    length = longest(true)
    *sides, true = (padded(each, length) for each in (*predicted, true))
    matches = [match_trajectories(paths, true) for paths in sides]
    errors = trajectory_errors(sides, true, matches)
    last = matches[-1]
    return asdict(errors) | {
        "true_positive": len(last.pairs),
        "false_positive": len(last.unmatched_prediction),
        "false_negative": len(last.unmatched_truth),
    }


def _paths_of(heads: MotionHeads, grid: BevGrid) -> dict[int, FloatArray]:
    return trajectories(predict_instances(heads, _READ_FOR_PATHS), grid, half_cell_shift=False)


def _sums(counts: Collection[Counts]) -> dict[str, Any]:
    """The samples' counts as those of one sample of one frame."""
    ranges, kinds = range(len(RANGES)), range(4)
    vpq = [
        [
            [math.fsum(chain.from_iterable(each["vpq"][index][kind] for each in counts))]
            for kind in kinds
        ]
        for index in ranges
    ]
    columns = [[*zip(*(each["cells"][index] for each in counts), strict=True)] for index in ranges]
    paths = [each["paths"] for each in counts if each["paths"]]
    return {
        **{
            name: sum(each[name] for each in counts)
            for name in ("samples", "frames", "instance_maps")
        },
        "cells": [[*map(sum, those or [()] * 3)] for those in columns],
        "vpq": vpq,
        "paths": {name: total(paths, name) for name in _PATHS},
    }


def motion_result(counts: Collection[Counts], protocol: MotionProtocol) -> MotionResult:
    """The metrics of some samples' counts, in any order."""
    sums = _sums(counts)
    paths, samples, number = (sums[name] for name in ("paths", "samples", "instance_maps"))
    ranges = [
        _range_result(*each, protocol) for each in zip(sums["cells"], sums["vpq"], strict=True)
    ]
    found, alarms, lost = (int(paths[name]) for name in _PATH_COUNTS)
    return MotionResult(
        ranges=dict(zip(RANGES, ranges, strict=True)),
        min_ade=ratio(paths["ade"], paths["count"]),
        min_fde=ratio(paths["fde"], paths["count"]),
        miss_rate=ratio(paths["missed"], paths["count"]),
        paths=int(paths["count"]),
        path_accuracy=ratio(found, found + alarms / 2 + lost / 2),
        path_true_positive=found,
        path_false_positive=alarms,
        path_false_negative=lost,
        samples=samples,
        frames=sums["frames"],
        notes=(f"{number} of {counted(samples, 'prediction')}: {_INSTANCE_MAPS}",)
        if number
        else (),
    )


def _range_result(
    cells: Sequence[int], vpq: Sequence[Sequence[float]], protocol: MotionProtocol
) -> RangeResult:
    """Of the sums of [tp, fp, fn] cells, and of overlaps, found, false and missed instances."""
    (overlap,), *numbers = vpq
    found, alarms, missed = (int(number) for (number,) in numbers)
    quality = panoptic_quality(overlap, found, alarms, missed)
    absent = 0.0 if protocol.nothing_is_zero else math.nan
    percent = 100.0 if found or alarms or missed or protocol.nothing_is_zero else math.nan
    both, mine, true = cells
    classes = [SegmentationCounts(true_positive=both, false_positive=mine, false_negative=true)]
    return RangeResult(
        iou=100 * iou(classes, absent=absent),
        pq=percent * quality.pq,
        sq=percent * quality.sq,
        rq=percent * quality.rq,
        true_positive=found,
        false_positive=alarms,
        false_negative=missed,
    )
