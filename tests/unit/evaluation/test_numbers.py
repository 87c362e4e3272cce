"""The numbers of results: their paths, and what each can be."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from deepaccident_devkit.evaluation.intervals import has_interval, numbers_of, range_of
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.runs.setups import TASK_PROTOCOLS, EvaluationSetup
from deepaccident_devkit.evaluation.task import HEADLINE_UNITS

NOWHERE = np.array([math.nan])


@dataclass(frozen=True)
class Share:
    hits: int
    share: float


def test_the_numbers_of_a_result() -> None:
    numbers = numbers_of(MotionEvaluator().compute())
    assert numbers["ranges/30x30/iou"] == 0.0
    assert {"min_ade", "min_fde", "miss_rate", "path_accuracy", "ranges/100x100/pq"} <= set(numbers)
    assert "samples" not in numbers
    assert numbers_of({5.0: [Share(1, 0.5)]}) == {"5/0/share": 0.5}


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("ranges/30x30/iou", (0, 100)),
        ("ranges/30x30/sq", (0, 100)),
        ("iou/road", (0, 100)),
        ("class_average_precision/car", (0, 100)),
        ("within/5/accuracy", (0, 1)),
        ("beside/sample_choice=mean_first/within/5/accuracy", (0, 1)),
        ("mean_errors/ASE", (0, 1)),
        ("mean_errors/ATE", (0, math.inf)),
        ("episodes_per_minute", (0, math.inf)),
        ("lateness", (-math.inf, math.inf)),
        ("beside/time/lateness", (-math.inf, math.inf)),
        ("groups/all/tta0_after/2", (0, math.inf)),
        ("precision_at_5", (0, 1)),
    ],
)
def test_a_unit_tells_what_a_number_can_be(path: str, expected: tuple[float, float]) -> None:
    assert range_of(path, np.array([-0.5, 0.5])) == expected


@pytest.mark.parametrize(
    ("alone", "expected"),
    [
        ([0.0, 0.5, 1.0, math.nan], (0, 1)),
        ([0.0, 1.5], (0, math.inf)),
        ([-0.1, 0.5], (-math.inf, math.inf)),
        ([math.nan], (0, 1)),
        ([0.2, math.inf], (0, 1)),
        ([1.001], (0, math.inf)),
        ([-0.001, 3.0], (-math.inf, math.inf)),
    ],
)
def test_a_number_of_others_is_what_its_clusters_are(alone: list[float], expected: tuple[float, float]) -> None:
    assert range_of("theirs", np.array(alone)) == expected


def test_totals_settings_and_medians_have_no_interval() -> None:
    for path in ("false_recordings", "within/5/distance", "median_warning", "beside/a=b/within/5/distance"):
        assert not has_interval(path)
    assert all(has_interval(path.replace("*", "5")) for path in HEADLINE_UNITS)


@pytest.mark.parametrize("task", TASK_PROTOCOLS)
def test_every_number_of_the_devkits_own_has_a_unit(task: str) -> None:
    """Else it would be taken for what its clusters are, and change with them."""
    for protocol in TASK_PROTOCOLS[task]:  # type: ignore[index]
        for path in numbers_of(EvaluationSetup(task=task, protocol=protocol).evaluator().compute()):  # type: ignore[arg-type]
            guesses = {range_of(path, np.array(alone)) for alone in ([0.5], [2.0], [-1.0])}
            assert len(guesses) == 1 or not has_interval(path), path
