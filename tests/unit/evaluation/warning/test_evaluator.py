"""Inputs that `WarningEvaluator` takes and refuses, and what it leaves to its protocols."""

import pytest
from support.accident_scenes import motion_labels_of, parked_path
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation.accident import AccidentContext
from deepaccident_devkit.evaluation.warning import WARNING_PROTOCOLS, WarningEvaluator


@pytest.mark.parametrize("protocol", WARNING_PROTOCOLS)
def test_without_samples_there_is_nothing(protocol: str) -> None:
    evaluator = WarningEvaluator(protocol)
    assert evaluator.compute().samples == 0
    assert evaluator.has_intervals == (protocol == "clean")


def test_the_protocols_and_their_choices() -> None:
    settings = {name: WarningEvaluator(name).settings for name in WARNING_PROTOCOLS}
    assert settings == {"clean": {"scores_of": "pair", "threshold": None}, "field": {}}
    assert WarningEvaluator().protocol == WARNING_PROTOCOLS["clean"]
    assert WarningEvaluator.needs_whole_recordings is True
    assert WarningEvaluator.needs_meta is True
    assert WarningEvaluator.result_kinds == ("motion", "accident")


def test_what_cannot_be_evaluated() -> None:
    update = WarningEvaluator().update
    label = motion_labels_of({1: parked_path(20, 10)})
    assert_raises(
        (lambda: WarningEvaluator("boxes"), ChoiceError, ("protocol", "clean, field", "boxes")),
        (
            lambda: update("a/b/001", [], AccidentContext()),
            EvaluationError,
            ("label", "MotionLabels or None"),
        ),
        (
            lambda: update("a/b/001", [], None, label),
            EvaluationError,
            ("context", "AccidentContext or None"),
        ),
        (
            lambda: update("a/b/001", []),
            EvaluationError,
            ("context", "accident_context", "horizon=2.0"),
        ),
    )
