"""What the accident evaluator takes, and what it says of what it does not."""

import numpy as np
import pytest
from accident_scenes import as_maps, scene, standing

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError, NotAvailableError
from deepaccident_devkit.evaluation import Accident, MotionOutput
from deepaccident_devkit.evaluation.accident import (
    PROTOCOLS,
    AccidentContext,
    AccidentEvaluator,
    BoxTruth,
    accident_context,
    box_truth,
)

CARS = {1: standing(20, 10), 2: [(15.5 - gap, 10) for gap in (4, 3, 2, 0, 0)]}
PAIR = Accident(positions=np.array([[20.0, 10], [16, 10]]), time=2.0, ids=(1, 2))
TRUTH = BoxTruth(
    time=np.arange(21) / 10, actor_id=np.array([1, 2]), footprint=np.full((21, 2, 5), np.nan), accident=PAIR
)


KNOWN = AccidentContext(truth=TRUTH)


def test_boxes_take_their_truth_from_the_context() -> None:
    evaluator = AccidentEvaluator(protocol="boxes")
    evaluator.update("alone", [PAIR], None, KNOWN)
    evaluator.update("both", [PAIR], scene(CARS), KNOWN)
    result = evaluator.compute()
    assert (result.apa, result.positives) == (1, 2)
    with pytest.raises(EvaluationError, match=r"give accident_context\(dataset, sample, horizon=2.0\)"):
        evaluator.update("nothing", [PAIR], scene(CARS))


def test_a_generator_of_alarms_counts_like_a_list() -> None:
    evaluator = AccidentEvaluator(protocol="boxes")
    evaluator.update("one", (each for each in [PAIR]), None, KNOWN)
    assert evaluator.compute().apa == 1


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_other_predictions_and_labels_are_refused(protocol) -> None:
    label = scene(CARS)
    evaluator = AccidentEvaluator(protocol=protocol)
    for prediction in (None, label.instance, PAIR, "alarm", [PAIR, None]):
        with pytest.raises(EvaluationError, match="a MotionOutput or a list of Accidents"):
            evaluator.update("one", prediction, label, KNOWN)
    with pytest.raises(EvaluationError, match="label: expected MotionLabels"):
        evaluator.update("one", as_maps(label), label.instance)
    with pytest.raises(EvaluationError, match="context: expected AccidentContext"):
        evaluator.update("one", as_maps(label), label, TRUTH)
    assert len(evaluator) == 0


@pytest.mark.parametrize("protocol", [3, None, "papr"])
def test_a_protocol_that_is_none(protocol) -> None:
    with pytest.raises(ChoiceError, match="released, paper, boxes"):
        AccidentEvaluator(protocol=protocol)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("largest", [70_000, 2_000_000_000])
def test_ids_may_be_large(protocol, largest) -> None:
    label = scene(CARS)
    maps = np.where(label.instance == 2, largest, label.instance)
    evaluator = AccidentEvaluator(protocol=protocol)
    output = MotionOutput(grid=label.config.grid, instances=maps[None])
    evaluator.update("one", output, label, KNOWN)
    assert evaluator.compute().positives == 1


def test_below_0_is_background() -> None:
    label = scene(CARS)
    maps = np.where(label.instance == 0, -1, label.instance)
    for protocol in PROTOCOLS:
        expected, found = AccidentEvaluator(protocol=protocol), AccidentEvaluator(protocol=protocol)
        for evaluator, each in ((expected, label.instance), (found, maps)):
            output = MotionOutput(grid=label.config.grid, instances=each[None])
            evaluator.update("one", output, label, KNOWN)
        assert dict(found.counts) == dict(expected.counts)


def test_samples_without_labels_have_no_truth(da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    token = da_motion.samples("train", "evaluate")[0]
    given = da_motion.get

    def get(table, row):
        return given(table, row) | ({"labelled": False} if table == "sample" else {})

    monkeypatch.setattr(da_motion, "get", get)
    for made in (box_truth, accident_context):
        with pytest.raises(NotAvailableError, match="choose a labelled sample"):
            made(da_motion, token)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_pooled_counts_are_exact_and_can_be_pooled_again(protocol) -> None:
    """Sums of floats that only add up to the same in exact arithmetic."""
    evaluator = AccidentEvaluator(protocol=protocol)
    label = scene(CARS)
    for number, shift in enumerate(np.random.default_rng(5).uniform(0, 2, 30)):
        if protocol == "boxes":
            alarm = Accident(positions=PAIR.positions + shift, time=2.0 - shift, score=round(shift, 1))
            evaluator.update(str(number), [alarm], None, KNOWN)
        else:
            cars = {name: [(x, y + shift) for x, y in path] for name, path in CARS.items()}
            evaluator.update(str(number), as_maps(scene(cars)), label)
    counts = [*evaluator.counts.values()]
    parts = [each for part in (counts[:7], counts[7:20], counts[20:]) for each in evaluator.pooled(part)]
    again = evaluator.pooled(parts)
    for pooled in (parts, again, evaluator.pooled(counts)):
        assert len(pooled) < len(counts)
        assert evaluator.result_of(pooled).as_dict() == evaluator.compute().as_dict()
    assert evaluator.result_of(evaluator.pooled([])).as_dict() == evaluator.result_of([]).as_dict()
