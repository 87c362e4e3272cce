"""The contract of each task, the choices of its protocols, and the headlines and text of its
results.
"""

import copy
import json
import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.evaluation_runs import stored_run
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.accident import PaperAccidents
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS
from deepaccident_devkit.evaluation.intervals import numbers_of
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup
from deepaccident_devkit.evaluation.task import (
    FrozenDict,
    headlines,
    switch_names,
    switched,
    value_text,
)

for_every_protocol = pytest.mark.parametrize(
    ("task", "protocol"), [(task, protocol) for task in TASKS for protocol in TASKS[task].protocols]
)


@pytest.mark.parametrize(
    ("task", "protocol"),
    [
        ("motion", "released"),
        ("accident", "boxes"),
        ("detection", "paper"),
        ("warning", "clean"),
        pytest.param("planning", "clean", marks=pytest.mark.slow),
        pytest.param("forecasting", "clean", marks=pytest.mark.slow),
    ],
)
def test_read_truth_update_and_compute_give_the_result_of_a_run(
    task: str, protocol: str, da_motion: DeepAccident, tmp_path: Path
) -> None:
    setup = EvaluationSetup(task=task, protocol=protocol)
    run, results = stored_run(da_motion, setup, tmp_path / "results")
    evaluator = TASKS[task](protocol)

    assert results.task in TASKS[task].result_kinds
    for token in results.tokens:
        prediction = evaluator.read(results, da_motion, token)
        truth = evaluator.truth(da_motion, token, results.form, setup.horizon)
        evaluator.update(token, prediction, *truth)

    assert evaluator.compute().samples == len(results) > 1
    assert evaluator.compute().as_dict() == run.result.as_dict()


@for_every_protocol
def test_every_protocol_makes_an_evaluator_and_its_kind_of_result(task: str, protocol: str) -> None:
    evaluator_class = TASKS[task]
    rules = evaluator_class.protocols[protocol]
    evaluator = evaluator_class(protocol)
    by_rules = evaluator_class(rules)

    assert (evaluator.protocol, by_rules.protocol) == (rules, rules)
    assert isinstance(evaluator.compute(), evaluator_class.result_class)
    assert evaluator.compute().samples == 0
    assert evaluator.settings == by_rules.settings
    assert_raises((lambda: evaluator_class("none"), ChoiceError, ("protocol", protocol, "'none'")))


def test_properties_of_each_task() -> None:
    properties = {
        name: (task.result_kinds, task.needs_whole_recordings, task.needs_meta)
        for name, task in TASKS.items()
    }

    assert properties == {
        "motion": (("motion",), False, False),
        "accident": (("motion", "accident"), False, True),
        "detection": (("detection",), False, False),
        "tracking": (("tracking",), True, False),
        "warning": (("motion", "accident"), True, True),
        "planning": (("planning",), True, True),
        "forecasting": (("forecasting",), True, False),
        "segmentation": (("segmentation",), False, False),
    }
    assert [name for name, task in TASKS.items() if task.vehicles_only] == ["planning"]

    without_horizon = [name for name, task in TASKS.items() if not task.has_horizon]
    assert without_horizon == [
        "detection",
        "tracking",
        "planning",
        "forecasting",
        "segmentation",
    ]


@for_every_protocol
def test_each_choice_of_every_protocol_can_be_given(task: str, protocol: str) -> None:
    rules = TASKS[task].protocols[protocol]
    for name in switch_names(rules):
        value: Any = rules
        for part in name.split("."):
            value = getattr(value, part)
        if value != np.inf:
            value = json.loads(json.dumps(value))
        assert switched(rules, {name: value}) == rules

    assert switched(rules, {}) is rules


def test_choices_may_be_parts_lists_for_tuples_and_null() -> None:
    accidents = switched(
        PaperAccidents(), {"reading.danger_distance": 2, "sample_choice": "mean_first"}
    )
    assert switch_names(accidents) == ["reading.danger_distance", "sample_choice"]
    assert (accidents.reading.danger_distance, accidents.sample_choice) == (2, "mean_first")

    without_area = switched(
        DETECTION_PROTOCOLS["released"], {"area": None, "error_threshold": None}
    )
    assert without_area.error_threshold is None

    # ranges go together only with no error threshold
    by_ranges = switched(
        DETECTION_PROTOCOLS["paper"], {"ranges": [[0, 30], [30, 50]], "error_threshold": None}
    )
    assert by_ranges.ranges == ((0, 30), (30, 50))


@pytest.mark.parametrize(
    ("rules", "switches", "words"),
    [
        (
            PaperAccidents(),
            {"reading.danger_distnce": 1},
            ("did you mean 'reading.danger_distance'", "there are read"),
        ),
        (PaperAccidents(), {"reading": {}}, ("no switch 'reading'",)),
        (
            PaperAccidents(),
            {"reading.danger_distance": "2"},
            ("danger_distance", "a number, such as 1.0", "'2'"),
        ),
        (
            PaperAccidents(),
            {"reading.danger_distance": True},
            ("danger_distance", "a number, such as 1.0", "True"),
        ),
        (PaperAccidents(), {"sample_choice": 3}, ("sample_choice", "a word, such as 'best'", "3")),
        (
            PaperAccidents(),
            {"sample_choice": "all"},
            ("sample_choice", "best, mean_first", "'all'"),
        ),
        (
            DETECTION_PROTOCOLS["paper"],
            {"min_recall": None},
            ("min_recall", "a number, such as 0.1", "None"),
        ),
        (
            DETECTION_PROTOCOLS["paper"],
            {"own_box": 1},
            ("own_box", "true or false, such as False", "1"),
        ),
        (
            DETECTION_PROTOCOLS["paper"],
            {"thresholds": 1},
            ("thresholds", "a list, such as (1.0, 2.0, 4.0)", "found 1"),
        ),
        (
            TASKS["warning"].protocols["field"],
            {"scores_of": "pair"},
            ("no switch 'scores_of'", "it has none"),
        ),
    ],
)
def test_wrong_choices_are_refused(
    rules: Any, switches: dict[str, Any], words: tuple[str, ...]
) -> None:
    assert_raises((lambda: switched(rules, switches), ChoiceError, words))


@for_every_protocol
def test_each_headline_is_a_number_of_the_result_by_its_path(task: str, protocol: str) -> None:
    result = EvaluationSetup(task=task, protocol=protocol).evaluator().compute()
    numbers = numbers_of(result)
    result_headlines = headlines(result)

    names = {headline.name for headline in result_headlines}
    assert len(names) == len(result_headlines)
    # headlines by group: an empty result has no groups
    assert len(names) > 2 or task in ("warning", "planning", "forecasting")
    for headline in result_headlines:
        value = numbers.get(headline.path, math.nan)
        assert headline.value == (None if math.isnan(value) else value)


HEADLINE_TEXTS = {
    "motion": "iou 30x30 %+, iou 100x100 %+, vpq 30x30 %+, vpq 100x100 %+, min_ade m-, "
    "min_fde m-, miss_rate share-",
    "accident": "apa share+, precision share+, recall share+, false_alarm_rate share-, "
    "average_precision share+, "
    "accuracy@5 share+, accuracy@10 share+, accuracy@15 share+, id_error share-, "
    "position_error m-, time_error s-, "
    "lateness s ",
    "detection": "mAP %+, mATE m-, mASE 1 - overlap-, mAOE rad-, mAVE m/s-, AP vehicle %+",
}


@pytest.mark.parametrize(
    ("task", "protocol"), [("motion", "released"), ("accident", "boxes"), ("detection", "opencood")]
)
def test_headlines_have_names_units_and_a_better_side(task: str, protocol: str) -> None:
    result = EvaluationSetup(task=task, protocol=protocol).evaluator().compute()
    sides = {True: "+", False: "-", None: " "}
    texts = []
    for headline in headlines(result):
        texts.append(f"{headline.name} {headline.unit}{sides[headline.higher_is_better]}")

    assert texts == HEADLINE_TEXTS[task].split(", ")


@pytest.mark.parametrize(
    ("value", "unit", "signed", "text"),
    [
        (41.2, "%", False, "41.20 %"),
        (0.5, "%", True, "+0.50"),
        (0.875, "share", False, "0.875"),
        (0.25, "1 - overlap", True, "+0.250"),
        (-1.3, "m", True, "-1.300 m"),
        (None, "m", False, "–"),
    ],
)
def test_texts_of_values(value: float | None, unit: Any, signed: bool, text: str) -> None:
    assert value_text(value, unit, signed=signed) == text
    assert signed or value_text(value, unit) == text


def test_mappings_of_results_are_frozen_and_have_a_hash() -> None:
    frozen = FrozenDict({"a": 1, "b": 2})
    for name in (
        "__setitem__",
        "__delitem__",
        "__ior__",
        "clear",
        "pop",
        "popitem",
        "setdefault",
        "update",
    ):
        assert_raises((getattr(frozen, name), TypeError, ("copy the mapping into a dict",)))

    assert pickle.loads(pickle.dumps(frozen)) == frozen
    assert copy.deepcopy(frozen) == frozen

    result = replace(MotionEvaluator().compute(), ranges={"a": {"b": 1}})
    nested = result.ranges["a"]
    assert (type(nested), nested) == (FrozenDict, {"b": 1})
    assert hash(frozen) == hash(FrozenDict({"b": 2, "a": 1})) != hash(FrozenDict({"a": 1}))
