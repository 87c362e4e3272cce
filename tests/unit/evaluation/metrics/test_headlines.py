"""The headline numbers stand in the results where they say."""

import copy
import math
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.metrics.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenDict, plain
from deepaccident_devkit.evaluation.metrics.motion import MotionEvaluator
from deepaccident_devkit.evaluation.metrics.numbers import headlines, numbers_of, value_text
from deepaccident_devkit.evaluation.runs.setups import TASK_PROTOCOLS, EvaluationSetup

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


def test_of_a_detections_and_an_accidents_errors_less_is_better_and_lateness_is_neither() -> None:
    errors = SimpleNamespace(
        mean_average_precision=50.0, mean_errors={"ATE": 1.0}, class_average_precision={"car": 2.0}
    )
    found = [(each.name, each.value, each.unit, each.higher_is_better) for each in headlines("detection", errors)]
    assert found == [("mAP", 50.0, "%", True), ("mATE", 1.0, "m", False), ("AP car", 2.0, "%", True)]
    within = {5.0: SimpleNamespace(accuracy=0.25), 10.0: SimpleNamespace()}
    accidents = SimpleNamespace(apa=0.5, within=within, id_error=None, lateness=-0.5)
    found = [(each.name, each.value, each.path, each.higher_is_better) for each in headlines("accident", accidents)]
    assert found == [
        ("apa", 0.5, "apa", True),
        ("accuracy@5", 0.25, "within/5/accuracy", True),
        ("id_error", None, "id_error", False),
        ("lateness", -0.5, "lateness", None),
    ]


def test_the_text_of_a_result_is_its_first_headlines() -> None:
    result = MotionEvaluator("released").compute()
    first = "iou 30x30 0.00 %, iou 100x100 0.00 %, vpq 30x30 0.00 %, vpq 100x100 0.00 %"
    assert repr(result) == f"MotionResult(0 samples: {first}, …)"
    html = result._repr_html_()
    assert html.count("<tr") == 8
    assert "MotionResult, 0 samples" in html
    assert "miss_rate" in html
    few = AccidentEvaluator("released").compute()
    assert repr(few).startswith("AccidentResult(0 samples: apa ")
    assert repr(few).count(", ") == 4


def test_mappings_of_results_are_fixed_have_a_hash_and_survive_a_copy() -> None:
    ranges = MotionEvaluator().compute().ranges
    for change in (lambda: ranges.pop("30x30"), lambda: ranges.update(a=1), ranges.clear, ranges.popitem):
        with pytest.raises(TypeError, match="the mappings of a result cannot be changed"):
            change()
    frozen = FrozenDict({"a": 1, "b": 2.0})
    assert hash(frozen) == hash(FrozenDict({"b": 2.0, "a": 1}))
    assert hash(frozen) != hash(FrozenDict({"a": 1}))
    for again in (pickle.loads(pickle.dumps(frozen)), copy.deepcopy(frozen), copy.copy(frozen)):
        assert (again, type(again)) == (frozen, FrozenDict)
    assert plain({"far": math.inf, "none": math.nan, "all": (1, True, "a", None, [2.5])}) == {
        "far": None,
        "none": None,
        "all": [1, True, "a", None, [2.5]],
    }


def test_an_unknown_task_is_refused() -> None:
    with pytest.raises(ChoiceError, match="task: expected one of motion, accident, detection, warning, found 'maps'"):
        headlines("maps", None)


def test_results_within_others_and_arrays_are_plain_too() -> None:
    result = MotionEvaluator().compute()
    nested = plain({2.0: np.array([1.0, np.nan]), "of": [result]})
    assert nested == {"2": [1.0, None], "of": [result.as_dict()]}
    assert nested["of"][0]["ranges"]
