"""Define evaluators and loaders that a spawned process can import by name."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.evaluation.evaluator import Counts, Evaluator, ratio, total

BROKEN_NUMBER = -1.0


class SumEvaluator(Evaluator[float]):
    """An evaluator that adds up a number of each sample."""

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


def load_number(task: float) -> Sequence[Any]:
    """Return the number as an evaluator's arguments; fail for `BROKEN_NUMBER`."""
    if task == BROKEN_NUMBER:
        raise FileNotFoundError("predictions/7.npz")
    return (task,)


def load_label_maps(dataset: DeepAccident, token: str) -> Sequence[Any]:
    """Return a mirrored prediction and the labels, as MotionEvaluator takes them."""
    label = dataset.motion_labels(token).to_present("bilinear")
    mirrored = label.instance[:, ::-1]
    return instances_of(mirrored, label.config.grid), label


@dataclass(frozen=True)
class RatioResult:
    ratio: float
    # NaN, so not compared: from Python 3.13 on, records with a NaN are not equal
    nothing: float = field(default=math.nan, compare=False)
    median_of_all: float = 0.5


class RatioEvaluator(Evaluator[RatioResult]):
    """An evaluator that divides the sum of one number by the sum of another."""

    @property
    def settings(self) -> dict[str, Any]:
        return {}

    def update(self, token: str, *arguments: Any) -> None:
        self.add(token, {"above": arguments[0], "below": arguments[1]})

    def result_of(self, counts: Collection[Counts]) -> RatioResult:
        return RatioResult(ratio(total(counts, "above"), total(counts, "below")))
