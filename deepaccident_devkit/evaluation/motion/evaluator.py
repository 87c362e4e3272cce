"""`MotionEvaluator`: the motion metrics of any number of samples."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import asdict
from typing import Any, Final

from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total
from deepaccident_devkit.evaluation.motion.counts import motion_counts
from deepaccident_devkit.evaluation.motion.protocol import MotionProtocol, motion_protocol
from deepaccident_devkit.evaluation.motion.result import MotionResult, RangeResult
from deepaccident_devkit.evaluation.panoptic import panoptic_quality
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.segmentation import SegmentationCounts, iou
from deepaccident_devkit.motion import MotionLabels

_PATH_COUNTS: Final = ("true_positive", "false_positive", "false_negative")
_PATHS: Final = ("ade", "fde", "missed", "count", *_PATH_COUNTS)
_INSTANCE_MAPS: Final = (
    "given as instance maps, and so compared with the labels' own instances, of paths too; those given as heads have "
    "their paths compared with what is read off the labels as though a model had predicted them"
)


class MotionEvaluator(Evaluator[MotionResult]):
    """IoU and VPQ of the last prediction, and errors of the paths over all of them.

    >>> evaluator = MotionEvaluator()
    >>> evaluator.compute().ranges["30x30"].iou
    0.0
    """

    def __init__(self, protocol: str | MotionProtocol = "released", *, trajectories: bool = True) -> None:
        """Start without samples.

        Args:
            protocol: of `MOTION_PROTOCOLS` by name, or your own.
            trajectories: whether paths are compared too. Of heads that takes many times as long as all the rest, since
                instances are read off all predictions and the labels for it.

        Raises:
            ChoiceError: no protocol has that name.
        """
        super().__init__()
        self.protocol = motion_protocol(protocol)
        self.trajectories = trajectories

    @property
    def settings(self) -> dict[str, Any]:
        """The protocol's choices, and whether paths are compared."""
        described = asdict(self.protocol) | {"ranges": list(self.protocol.ranges)}
        return {"protocol": described, "trajectories": self.trajectories}

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
        self.add(token, motion_counts(prediction, label, self.protocol, trajectories=self.trajectories))

    def result_of(self, counts: Collection[Counts]) -> MotionResult:
        """The metrics of some samples' counts, in any order."""
        return self._result(counts, [each["vpq"] for each in counts])

    def pooled(self, counts: Collection[Counts]) -> list[Counts]:
        """The samples' counts as those of one sample of one frame, which have the same result."""
        sums = {name: sum(each[name] for each in counts) for name in ("samples", "frames", "instance_maps")}
        ranges = range(len(self.protocol.ranges))
        cells = [[sum(each["cells"][index][kind] for each in counts) for kind in range(3)] for index in ranges]
        vpq = [
            [[math.fsum(value for each in counts for value in each["vpq"][index][kind])] for kind in range(4)]
            for index in ranges
        ]
        return [{**sums, "cells": cells, "vpq": vpq, "paths": _path_sums(counts)}]

    def selected_as_released(self, order: Sequence[str], selected: Collection[str]) -> MotionResult:
        """The result of some samples as the released code has it "by attribute": with the VPQ of other frames.

        See `panoptic.separate_selected_as_released`, whose mistake this is; `compute(selected)` is the correct result.

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
        numbers = [number for number, token in enumerate(order) if token in set(selected)]
        return self._result([self._counts[order[number]] for number in numbers], [frames[number] for number in numbers])

    def _result(self, counts: Collection[Counts], vpq: Sequence[Any]) -> MotionResult:
        names = self.protocol.range_names
        paths = _path_sums(counts)
        found, alarms, lost = (int(paths[name]) for name in _PATH_COUNTS)
        samples, number = (sum(each[name] for each in counts) for name in ("samples", "instance_maps"))
        return MotionResult(
            ranges={
                name: self._range_result([each["cells"][index] for each in counts], [each[index] for each in vpq])
                for index, name in enumerate(names)
            },
            min_ade=ratio(paths["ade"], paths["count"]),
            min_fde=ratio(paths["fde"], paths["count"]),
            miss_rate=ratio(paths["missed"], paths["count"]),
            paths=int(paths["count"]),
            path_accuracy=ratio(found, found + alarms / 2 + lost / 2),
            path_true_positive=found,
            path_false_positive=alarms,
            path_false_negative=lost,
            samples=samples,
            frames=sum(each["frames"] for each in counts),
            notes=(f"{number} of {samples} predictions: {_INSTANCE_MAPS}",) if number else (),
        )

    def _range_result(self, cells: Sequence[Any], vpq: Sequence[Any]) -> RangeResult:
        """Of samples' [tp, fp, fn] cells, and of their four lists by frame."""
        overlap, *numbers = (math.fsum(value for each in vpq for value in each[index]) for index in range(4))
        found, alarms, missed = (int(number) for number in numbers)
        quality = panoptic_quality(overlap, found, alarms, missed)
        absent = 0.0 if self.protocol.nothing_is_zero else math.nan
        percent = 100.0 if found or alarms or missed or self.protocol.nothing_is_zero else math.nan
        classes = [
            SegmentationCounts(true_positive=both, false_positive=mine, false_negative=true)
            for both, mine, true in cells
        ]
        return RangeResult(
            iou=100 * iou(classes, absent=absent),
            pq=percent * quality.pq,
            sq=percent * quality.sq,
            rq=percent * quality.rq,
            true_positive=found,
            false_positive=alarms,
            false_negative=missed,
        )


def _path_sums(counts: Collection[Counts]) -> dict[str, float]:
    return {name: total((each["paths"] for each in counts if each["paths"]), name) for name in _PATHS}
