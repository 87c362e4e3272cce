"""The headline numbers stand in the results where they say."""

import math

import numpy as np
import pytest

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.intervals import numbers_of
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.runs.setups import TASK_PROTOCOLS, EvaluationSetup
from deepaccident_devkit.evaluation.task import headlines, plain, value_text

RUNS = [(task, protocol) for task, protocols in TASK_PROTOCOLS.items() for protocol in protocols]


@pytest.mark.parametrize(("task", "protocol"), RUNS)
def test_each_headline_is_a_number_of_the_result_by_its_path(task: str, protocol: str) -> None:
    result = EvaluationSetup(task=task, protocol=protocol).evaluator().compute()
    known = numbers_of(result)
    found = headlines(task, result)
    assert len({each.name for each in found}) == len(found)
    assert len(found) > 2 or protocol in ("clean", "field")  # by group, of which there is none yet
    for each in found:
        value = known.get(each.path, math.nan)
        assert each.value == (None if math.isnan(value) else value)


def test_names() -> None:
    result = MotionEvaluator().compute()
    names = ["iou 30x30", "iou 100x100", "vpq 30x30", "vpq 100x100", "min_ade", "min_fde", "miss_rate"]
    found = headlines("motion", result)
    assert {each.name: each.value for each in found} == dict(zip(names, [0.0] * 4 + [None] * 3, strict=True))
    assert [each.higher_is_better for each in found] == [True] * 4 + [False] * 3
    assert result._repr_html_().count("<tr") == 8


@pytest.mark.parametrize(
    ("value", "unit", "signed", "text"),
    [
        (41.2, "%", False, "41.20 %"),
        (0.5, "%", True, "+0.50"),
        (0.875, "share", False, "0.875"),
        (-1.3, "m", True, "-1.300 m"),
        (None, "m", False, "–"),
    ],
)
def test_texts(value: float | None, unit: str, signed: bool, text: str) -> None:
    assert value_text(value, unit, signed=signed) == text
    assert signed or value_text(value, unit) == text


def test_the_text_of_a_result_is_its_first_headlines() -> None:
    result = MotionEvaluator("released").compute()
    first = "iou 30x30 0.00 %, iou 100x100 0.00 %, vpq 30x30 0.00 %, vpq 100x100 0.00 %"
    assert repr(result) == f"MotionResult(0 samples: {first}, …)"


def test_an_unknown_task_is_refused() -> None:
    with pytest.raises(ChoiceError, match="task: expected one of motion, accident, detection, warning, found 'maps'"):
        headlines("maps", None)


def test_results_within_others_and_arrays_are_plain_too() -> None:
    result = MotionEvaluator().compute()
    nested = plain({2.0: np.array([1.0, np.nan]), "of": [result]})
    assert nested == {"2": [1.0, None], "of": [result.as_dict()]}
    assert nested["of"][0]["ranges"]
