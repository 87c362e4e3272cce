"""Which inputs the accident evaluator takes, and which accidents a protocol compares."""

from functools import partial

import numpy as np
import pytest
from support.accident_scenes import (
    motion_labels_of,
    parked_path,
    shift_cars,
    to_heads_output,
    to_instance_output,
)
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import Accident, MotionOutput
from deepaccident_devkit.evaluation.accident import (
    PROTOCOLS,
    AccidentContext,
    AccidentEvaluator,
    BoxTruth,
    compared_accidents,
)

CARS = {1: parked_path(20, 10), 2: [(15.5 - gap, 10) for gap in (4, 3, 2, 0, 0)]}
APPROACH = {1: parked_path(20, 10), 2: [(x, 10.0) for x in (4, 8, 12, 15, 17)]}
CRASH = {1: parked_path(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
PAIR = Accident(positions=np.array([[20.0, 10], [16, 10]]), time=2.0, ids=(1, 2))
TRUTH = BoxTruth(
    time=np.arange(21) / 10,
    actor_id=np.array([1, 2]),
    footprint=np.full((21, 2, 5), np.nan),
    accident=PAIR,
    horizon=2.0,
)
BOX_CONTEXT = AccidentContext(truth=TRUTH)


def test_the_protocols_and_their_choices() -> None:
    choices = {"reading": {"danger_distance": 1.0}}
    settings = {name: AccidentEvaluator(name).settings for name in PROTOCOLS}
    assert settings == {
        "released": {"protocol": "ReleasedAccidents", "choices": {}},
        "paper": {"protocol": "PaperAccidents", "choices": choices | {"sample_choice": "best"}},
        "boxes": {"protocol": "BoxAccidents", "choices": choices},
    }
    released = PROTOCOLS["released"]
    assert released.labels == PROTOCOLS["paper"].labels == "released"
    assert (released.truth_gap, released.prediction_gap) == (0.001, 5.0)
    assert (AccidentEvaluator().protocol, released.maps_alone) == (released, True)


def test_boxes_take_their_truth_from_the_context_and_alarms_from_a_generator() -> None:
    evaluator = AccidentEvaluator(protocol="boxes")
    evaluator.update("alone", [PAIR], None, BOX_CONTEXT)
    evaluator.update(
        "both",
        iter([PAIR]),
        motion_labels_of(CARS),
        BOX_CONTEXT,
    )
    result = evaluator.compute()
    assert (result.apa, result.positives) == (1, 2)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_other_predictions_and_labels_are_refused(protocol: str) -> None:
    label = motion_labels_of(CARS)
    maps = to_instance_output(label)
    evaluator = AccidentEvaluator(protocol=protocol)
    update = partial(evaluator.update, "one")

    assert_raises(
        *(
            (
                partial(update, prediction, label, BOX_CONTEXT),
                EvaluationError,
                "list of Accidents",
            )
            for prediction in (None, label.instance, PAIR, "alarm", [PAIR, None])
        ),
        (
            partial(update, maps, label.instance),
            EvaluationError,
            ("label", "MotionLabels", "ndarray"),
        ),
        (
            partial(update, maps, label, TRUTH),
            EvaluationError,
            ("context", "AccidentContext"),
        ),
    )
    assert len(evaluator) == 0


@pytest.mark.parametrize("protocol", [3, None, "papr"])
def test_an_unknown_protocol_is_refused(protocol) -> None:
    assert_raises(
        (lambda: AccidentEvaluator(protocol=protocol), ChoiceError, ("released, paper, boxes",))
    )


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(("old_id", "new_id"), [(2, 70_000), (2, 2_000_000_000), (0, -1)])
def test_ids_may_be_large_and_below_1_is_background(
    protocol: str, old_id: int, new_id: int
) -> None:
    label = motion_labels_of(CARS)
    renamed = np.where(
        label.instance == old_id,
        new_id,
        label.instance,
    )
    counts = []
    for instances in (label.instance, renamed):
        evaluator = AccidentEvaluator(protocol=protocol)
        evaluator.update(
            "one",
            MotionOutput(grid=label.config.grid, instances=instances[None]),
            label,
            BOX_CONTEXT,
        )
        counts.append(dict(evaluator.counts))
        assert evaluator.compute().positives == 1
    assert counts[0] == counts[1]


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_pooled_counts_are_exact_and_can_be_pooled_again(protocol: str) -> None:
    """The sums of these floats agree only in exact arithmetic."""
    label = motion_labels_of(CARS)
    evaluator = AccidentEvaluator(protocol=protocol)
    for number, shift in enumerate(np.random.default_rng(5).uniform(0, 2, 10)):
        prediction = to_instance_output(motion_labels_of(shift_cars(CARS, y=shift)))
        if protocol == "boxes":
            prediction = [
                Accident(positions=PAIR.positions + shift, time=2.0 - shift, score=round(shift, 1))
            ]
        evaluator.update(str(number), prediction, label, BOX_CONTEXT)

    counts = [*evaluator.counts.values()]
    parts = [
        *evaluator.pooled(counts[:2]),
        *evaluator.pooled(counts[2:6]),
        *evaluator.pooled(counts[6:]),
    ]
    for pooled in (parts, evaluator.pooled(parts), evaluator.pooled(counts)):
        assert len(pooled) < len(counts)
        assert evaluator.result_of(pooled).as_dict() == evaluator.compute().as_dict()
    assert evaluator.result_of(evaluator.pooled([])).as_dict() == evaluator.result_of([]).as_dict()


def test_protocols_that_compare_with_nothing_are_refused() -> None:
    label = motion_labels_of({1: parked_path(20, 10)})
    cases = [
        ("released", [], None, ("compares motion",)),
        ("released", [], label, ("compares motion",)),
        ("released", to_instance_output(label), None, ("compares motion",)),
        ("paper", [], None, ("motion labels",)),
        ("boxes", [], None, ("needs its truth", "accident_context")),
    ]
    for name, prediction, truth, words in cases:
        compare = partial(compared_accidents, prediction, truth, AccidentContext(), PROTOCOLS[name])
        assert_raises((compare, EvaluationError, words))


SURE, LATE, UNSURE = (
    Accident(positions=PAIR.positions, time=time, score=score)
    for time, score in ((2.25, 0.9), (2.26, 1.0), (0.5, 0.2))
)


@pytest.mark.parametrize(
    ("protocol", "form", "predicted", "label", "times"),
    [
        ("paper", to_instance_output, [CRASH, {1: parked_path(20, 10)}], CRASH, [2.0]),
        ("paper", to_instance_output, [{1: parked_path(20, 10)}], {1: parked_path(20, 10)}, []),
        ("paper", None, [UNSURE, LATE, SURE], CRASH, [2.25]),
        ("boxes", None, [UNSURE, LATE, SURE], CRASH, [2.26, 2.25, 0.5]),
        ("released", to_heads_output, [APPROACH, {}, APPROACH], APPROACH, [2.0, 2.0]),
        ("released", to_heads_output, [{}, APPROACH], APPROACH, []),
    ],
)
def test_which_accidents_are_compared(protocol, form, predicted, label, times) -> None:
    """Maps give the accident of each prediction (as released none, if the first is empty). Of
    explicit accidents `paper` compares the surest up to half a step after the labels' end, and
    `boxes` all.
    """
    prediction = form(*map(motion_labels_of, predicted)) if form else predicted
    has_accident = len(label) > 1

    compared = compared_accidents(
        prediction, motion_labels_of(label), BOX_CONTEXT, PROTOCOLS[protocol]
    )

    assert [accident.time for accident in compared.predicted] == times
    assert compared.unplaced is None
    if not has_accident:
        assert compared.true is None
        return
    assert compared.true.time == 2.0
    ends = [path[-1] for path in label.values()]
    for accident in (compared.true, *compared.predicted):
        np.testing.assert_allclose(
            np.sort(accident.positions, axis=0), np.sort(ends, axis=0), atol=1.1
        )
