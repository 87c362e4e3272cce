"""Which accidents a protocol compares."""

import pytest

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import AccidentEvaluator
from deepaccident_devkit.evaluation.metrics.accident import PROTOCOLS, AccidentContext, compared_accidents


def test_protocols_that_compare_with_nothing_are_refused() -> None:
    for name, words in (("released", "compares motion"), ("paper", "motion labels"), ("boxes", "needs its truth")):
        with pytest.raises(EvaluationError, match=words):
            compared_accidents([], None, AccidentContext(), PROTOCOLS[name])


def test_a_protocol_of_ones_own_has_its_accidents_as_given() -> None:
    class Own:
        """Not one of the devkit's."""

        settings = counts = result = pooled = variants = lambda *_: {}

    assert AccidentEvaluator(Own()).protocol is not None
    compared = compared_accidents([], None, AccidentContext(), Own())
    assert (compared.true, compared.predicted) == (None, ())
