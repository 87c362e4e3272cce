"""What the accident evaluator takes, what it refuses, and which accidents a protocol compares."""

from functools import partial

import numpy as np
import pytest
from accident_scenes import as_heads, as_maps, scene, standing
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import Accident, MotionOutput
from deepaccident_devkit.evaluation.accident import (
    PROTOCOLS,
    AccidentContext,
    AccidentEvaluator,
    BoxTruth,
    compared_accidents,
)

CARS = {1: standing(20, 10), 2: [(15.5 - gap, 10) for gap in (4, 3, 2, 0, 0)]}
APPROACH = {1: standing(20, 10), 2: [(x, 10.0) for x in (4, 8, 12, 15, 17)]}
CRASH = {1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
PAIR = Accident(positions=np.array([[20.0, 10], [16, 10]]), time=2.0, ids=(1, 2))
TRUTH = BoxTruth(
    time=np.arange(21) / 10,
    actor_id=np.array([1, 2]),
    footprint=np.full((21, 2, 5), np.nan),
    accident=PAIR,
    horizon=2.0,
)
KNOWN = AccidentContext(truth=TRUTH)


def test_the_protocols_and_their_choices() -> None:
    choices = {"reading": {"danger_distance": 1.0}}
    assert {name: AccidentEvaluator(name).settings for name in PROTOCOLS} == {
        "released": {"protocol": "ReleasedAccidents", "choices": {}},
        "paper": {"protocol": "PaperAccidents", "choices": choices | {"sample_choice": "best"}},
        "boxes": {"protocol": "BoxAccidents", "choices": choices},
    }
    released = PROTOCOLS["released"]
    assert (
        released.labels,
        released.truth_gap,
        released.prediction_gap,
        PROTOCOLS["paper"].labels,
    ) == (
        "released",
        0.001,
        5.0,
        "released",
    )
    assert (AccidentEvaluator().protocol, released.maps_alone) == (released, True)


def test_boxes_take_their_truth_from_the_context_and_alarms_from_a_generator() -> None:
    evaluator = AccidentEvaluator(protocol="boxes")
    evaluator.update("alone", [PAIR], None, KNOWN)
    evaluator.update("both", (each for each in [PAIR]), scene(CARS), KNOWN)
    result = evaluator.compute()
    assert (result.apa, result.positives) == (1, 2)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_other_predictions_and_labels_are_refused(protocol: str) -> None:
    label = scene(CARS)
    evaluator, maps = AccidentEvaluator(protocol=protocol), as_maps(label)
    assert_refused(
        *(
            (
                lambda given=given: evaluator.update("one", given, label, KNOWN),
                EvaluationError,
                "list of Accidents",
            )
            for given in (None, label.instance, PAIR, "alarm", [PAIR, None])
        ),
        (
            lambda: evaluator.update("one", maps, label.instance),
            EvaluationError,
            ("label", "MotionLabels", "ndarray"),
        ),
        (
            lambda: evaluator.update("one", maps, label, TRUTH),
            EvaluationError,
            ("context", "AccidentContext"),
        ),
    )
    assert len(evaluator) == 0


@pytest.mark.parametrize("protocol", [3, None, "papr"])
def test_a_protocol_that_is_none(protocol) -> None:
    assert_refused(
        (lambda: AccidentEvaluator(protocol=protocol), ChoiceError, ("released, paper, boxes",))
    )


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("names", [{2: 70_000}, {2: 2_000_000_000}, {0: -1}])
def test_ids_may_be_large_and_below_1_is_background(protocol: str, names: dict[int, int]) -> None:
    label = scene(CARS)
    [(old, new)] = names.items()
    counts = []
    for maps in (label.instance, np.where(label.instance == old, new, label.instance)):
        evaluator = AccidentEvaluator(protocol=protocol)
        evaluator.update(
            "one", MotionOutput(grid=label.config.grid, instances=maps[None]), label, KNOWN
        )
        counts.append(dict(evaluator.counts))
        assert evaluator.compute().positives == 1
    assert counts[0] == counts[1]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_pooled_counts_are_exact_and_can_be_pooled_again(protocol: str) -> None:
    """Sums of floats that only add up to the same in exact arithmetic."""
    evaluator, label = AccidentEvaluator(protocol=protocol), scene(CARS)
    for number, shift in enumerate(np.random.default_rng(5).uniform(0, 2, 10)):
        alarms = [
            Accident(positions=PAIR.positions + shift, time=2.0 - shift, score=round(shift, 1))
        ]
        cars = {name: [(x, y + shift) for x, y in path] for name, path in CARS.items()}
        evaluator.update(
            str(number), alarms if protocol == "boxes" else as_maps(scene(cars)), label, KNOWN
        )
    counts = [*evaluator.counts.values()]
    parts = [
        each for part in (counts[:2], counts[2:6], counts[6:]) for each in evaluator.pooled(part)
    ]
    for pooled in (parts, evaluator.pooled(parts), evaluator.pooled(counts)):
        assert len(pooled) < len(counts)
        assert evaluator.result_of(pooled).as_dict() == evaluator.compute().as_dict()
    assert evaluator.result_of(evaluator.pooled([])).as_dict() == evaluator.result_of([]).as_dict()


def test_protocols_that_compare_with_nothing_are_refused() -> None:
    label = scene({1: standing(20, 10)})
    assert_refused(
        *(
            (
                partial(compared_accidents, given, beside, AccidentContext(), PROTOCOLS[name]),
                EvaluationError,
                words,
            )
            for name, given, beside, words in (
                ("released", [], None, ("compares motion",)),
                ("released", [], label, ("compares motion",)),
                ("released", as_maps(label), None, ("compares motion",)),
                ("paper", [], None, ("motion labels",)),
                ("boxes", [], None, ("needs its truth", "accident_context")),
            )
        )
    )


SURE, LATE, UNSURE = (
    Accident(positions=np.array([[20.0, 10], [16, 10]]), time=time, score=score)
    for time, score in ((2.25, 0.9), (2.26, 1.0), (0.5, 0.2))
)


@pytest.mark.parametrize(
    ("protocol", "form", "predicted", "label", "times"),
    [
        ("paper", as_maps, [CRASH, {1: standing(20, 10)}], CRASH, [2.0]),
        ("paper", as_maps, [{1: standing(20, 10)}], {1: standing(20, 10)}, []),
        ("paper", None, [UNSURE, LATE, SURE], CRASH, [2.25]),
        ("boxes", None, [UNSURE, LATE, SURE], CRASH, [2.26, 2.25, 0.5]),
        ("released", as_heads, [APPROACH, {}, APPROACH], APPROACH, [2.0, 2.0]),
        ("released", as_heads, [{}, APPROACH], APPROACH, []),
    ],
)
def test_which_accidents_are_compared(protocol, form, predicted, label, times) -> None:
    """Of maps those of each prediction (as released none, if the first is empty); explicit ones by
    the paper the surest up to the labels' end and half a step, by boxes all."""
    given = form(*map(scene, predicted)) if form else predicted
    made = compared_accidents(given, scene(label), KNOWN, PROTOCOLS[protocol])
    assert [each.time for each in made.predicted] == times
    assert (made.true and made.true.time, made.unplaced) == (2.0 if len(label) > 1 else None, None)
    for accident in (made.true, *made.predicted) if len(label) > 1 else ():
        ends = [path[-1] for path in label.values()]
        np.testing.assert_allclose(
            np.sort(accident.positions, axis=0), np.sort(ends, axis=0), atol=1.1
        )
