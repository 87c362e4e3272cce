"""Which accidents a protocol compares."""

import numpy as np
import pytest
from accident_scenes import as_heads, as_maps, scene, standing

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import PROTOCOLS, AccidentContext, BoxTruth, compared_accidents
from deepaccident_devkit.evaluation.predictions import Accident


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


def test_explicit_accidents_are_compared_by_the_paper_and_by_boxes() -> None:
    """The paper takes the surest up to the labels' end and half a step; boxes take all."""
    label = scene({1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]})
    sure, late, unsure = (
        Accident(positions=np.array([[20.0, 10], [16, 10]]), time=time, score=score)
        for time, score in ((2.25, 0.9), (2.26, 1.0), (0.5, 0.2))
    )
    paper = compared_accidents([unsure, late, sure], label, AccidentContext(), PROTOCOLS["paper"])
    assert (paper.predicted, paper.true.time, paper.unplaced) == ((sure,), 2.0, None)
    truth = BoxTruth(
        time=np.arange(21) / 10, actor_id=np.zeros(0, int), footprint=np.zeros((21, 0, 5)), accident=sure, horizon=2.0
    )
    boxes = compared_accidents([unsure, late, sure], None, AccidentContext(truth=truth), PROTOCOLS["boxes"])
    assert (boxes.predicted, boxes.true, boxes.unplaced) == ((late, sure, unsure), sure, None)
