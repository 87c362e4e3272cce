"""What `WarningEvaluator` takes, refuses and leaves to its protocols."""

import pytest
from accident_scenes import scene, standing
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation.accident import AccidentContext
from deepaccident_devkit.evaluation.warning import WARNING_PROTOCOLS, WarningEvaluator


@pytest.mark.parametrize("protocol", WARNING_PROTOCOLS)
def test_without_samples_there_is_nothing(protocol: str) -> None:
    evaluator = WarningEvaluator(protocol)
    assert (evaluator.compute().samples, evaluator.has_intervals) == (0, protocol == "clean")


def test_the_protocols_and_their_choices() -> None:
    choices = {"clean": {"scores_of": "pair", "threshold": None}, "field": {}}
    assert {name: WarningEvaluator(name).settings for name in WARNING_PROTOCOLS} == choices
    assert WarningEvaluator().protocol == WARNING_PROTOCOLS["clean"]
    facts = (
        WarningEvaluator.needs_whole_recordings,
        WarningEvaluator.needs_meta,
        WarningEvaluator.result_kinds,
    )
    assert facts == (True, True, ("motion", "accident"))


def test_what_cannot_be_evaluated() -> None:
    update, label = WarningEvaluator().update, scene({1: standing(20, 10)})
    assert_refused(
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
