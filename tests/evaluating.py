"""An evaluator and loaders for tests of whole runs: in a module that a spawned process can import
by name.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total

BROKEN = -1.0


class Sums(Evaluator[float]):
    """The sum of a number."""

    def __init__(self, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale

    @property
    def settings(self) -> dict[str, Any]:
        return {"scale": self.scale}

    def update(self, token: str, prediction: float, truth: float = 0.0) -> None:
        self.add(token, {"value": prediction + truth})

    def result_of(self, counts: Collection[Counts]) -> float:
        return self.scale * total(counts, "value")


def number(task: float) -> Sequence[Any]:
    if task == BROKEN:
        raise FileNotFoundError("predictions/7.npz")
    return (task,)


def labels_as_maps(dataset: DeepAccident, token: str) -> Sequence[Any]:
    """What MotionEvaluator takes: the labels of another moment, and the labels."""
    label = dataset.motion_labels(token).to_present("bilinear")
    moved = label.instance[:, ::-1]
    return instances_of(moved, label.config.grid), label


@dataclass(frozen=True)
class Ratio:
    ratio: float
    nothing: float = field(
        default=math.nan, compare=False
    )  # from Python 3.13 on, equal fields only make equal records
    median_of_all: float = 0.5


class Ratios(Evaluator[Ratio]):
    """The ratio of two sums."""

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    def update(self, token: str, *arguments: Any) -> None:
        self.add(token, {"above": arguments[0], "below": arguments[1]})

    def result_of(self, counts: Collection[Counts]) -> Ratio:
        return Ratio(ratio(total(counts, "above"), total(counts, "below")))
