"""Which accidents a protocol compares."""

import pytest
from accident_scenes import as_heads, as_maps, scene, standing

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.metrics.accident import PROTOCOLS, AccidentContext, compared_accidents


def test_protocols_that_compare_with_nothing_are_refused() -> None:
    for name, words in (("released", "compares motion"), ("paper", "motion labels"), ("boxes", "needs its truth")):
        with pytest.raises(EvaluationError, match=words):
            compared_accidents([], None, AccidentContext(), PROTOCOLS[name])
    label = scene({1: standing(20, 10)})
    for given, beside in (([], label), (as_maps(label), None)):
        with pytest.raises(EvaluationError, match="compares motion"):
            compared_accidents(given, beside, AccidentContext(), PROTOCOLS["released"])


def test_accidents_of_the_paper_are_read_off_maps() -> None:
    hit = scene({1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]})
    calm = scene({1: standing(20, 10)})
    made = compared_accidents(as_maps(hit, calm), hit, AccidentContext(), PROTOCOLS["paper"])
    assert (made.true.time, [each.time for each in made.predicted]) == (2.0, [2.0])
    assert compared_accidents(as_maps(calm), calm, AccidentContext(), PROTOCOLS["paper"]).true is None


def test_the_released_protocol_compares_each_prediction_that_foresees_one() -> None:
    approach = [(x, 10.0) for x in (4, 8, 12, 15, 17)]
    hit, nobody = scene({1: standing(20, 10), 2: approach}), scene({})
    made = compared_accidents(as_heads(hit), hit, AccidentContext(), PROTOCOLS["released"])
    assert (made.true.time, [each.time for each in made.predicted]) == (2.0, [2.0])
    ended = compared_accidents(as_heads(nobody, hit), hit, AccidentContext(), PROTOCOLS["released"])
    assert (ended.true.time, ended.predicted) == (2.0, ())
