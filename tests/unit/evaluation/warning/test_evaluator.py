"""Warnings: what samples add, by hand-made ones with known answers, and what a synthetic release knows of them."""

from dataclasses import replace

import numpy as np
import pytest
from accident_scenes import as_heads, as_maps, scene, standing
from numpy.testing import assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.evaluation.accident import AccidentContext, BoxTruth, accident_context, box_truth
from deepaccident_devkit.evaluation.warning import WarningEvaluator

PAIR = (11, 22)
MEETING = np.array([[20.0, 10.0], [16.0, 10.0]])
LAST = 61
"""The recorded frame of the impact, or of the recording's end; samples are half a second apart."""


def alarm(x=0.0, score=1.0, time=1.0, ids=None) -> Accident:
    """At the meeting place, both positions `x` metres farther ahead."""
    return Accident(positions=MEETING + np.array([x, 0.0]), time=time, score=score, ids=ids)


RIGHT = alarm(ids=PAIR)
FALSE = alarm(x=50, ids=(33, 44))


def context(frame, kind="accident", last=LAST) -> AccidentContext:
    """Two stand apart where they will meet; the boxes are known for 2 s."""
    ahead = (last - frame) / 10
    moments = min(20, last - frame) + 1
    boxes = np.concatenate([MEETING, [[4.0, 2.0, 0.0]] * 2], axis=1)
    impact = Accident(positions=MEETING, time=ahead, ids=PAIR) if kind == "accident" else None
    truth = BoxTruth(
        time=np.arange(moments) / 10,
        actor_id=np.array(PAIR),
        footprint=np.tile(boxes, (moments, 1, 1)),
        accident=impact if ahead <= 2 else None,
        impact=impact,
    )
    return AccidentContext(
        pair=PAIR if impact else None,
        known=True,
        truth=truth,
        time_to_impact=ahead if impact else None,
        time_to_end=ahead,
        twin={"accident": False, "twins": True, "others": None}[kind],
    )


def counted(prediction, known, label=None):
    """What a sample adds."""
    evaluator = WarningEvaluator()
    evaluator.update("t/s/ego_vehicle/041", prediction, label, known)
    return evaluator.counts["t/s/ego_vehicle/041"]


@pytest.mark.parametrize(
    ("raised", "right"),
    [
        (alarm(ids=(22, 11)), 1),
        (alarm(x=50, ids=PAIR), 1),
        (alarm(ids=(11, 33)), 1),  # the place
        (alarm(x=50, ids=(11, 33)), 0),
        (alarm(x=1), 1),  # without ids: the boxes at that time
        (alarm(x=4.5), 1),
        (alarm(x=5), 0),  # the differences of the two add up to 10 m
        (alarm(time=1.6, ids=PAIR), 1),  # at any time
    ],
)
def test_what_makes_an_alarm_right(raised, right) -> None:
    assert counted([raised], context(51))["alarms"] == [[1.0, right]]


def test_where_nobody_collides_no_alarm_is_right() -> None:
    found = counted([RIGHT, replace(FALSE, score=0.5)], context(41, "twins"))
    assert (found["kind"], found["ahead"], found["alarms"]) == ("twins", None, [[1.0, 0], [0.5, 0]])


def test_the_impact_may_be_later_than_the_model_looks_ahead() -> None:
    found = counted([alarm(time=2.0)], context(21))
    assert (found["ahead"], found["alarms"]) == (40, [[1.0, 1]])


def test_what_the_recording_cannot_refute_stands_apart() -> None:
    def found(time):
        counts = counted([replace(FALSE, time=time)], context(51, "others"))
        return len(counts["alarms"]), len(counts["unjudged"])

    assert found(1.0) == (1, 0)
    assert found(1.04) == (1, 0)  # within half a recorded frame
    assert found(1.06) == (0, 1)
    both = counted([FALSE, replace(FALSE, time=1.5, score=0.25)], context(51, "others"))
    assert (both["alarms"], both["unjudged"]) == ([[1.0, 0]], [0.25])


def test_an_alarm_for_later_than_the_horizon_is_none() -> None:
    there, late = context(31), [alarm(time=900.0, ids=PAIR)]
    assert counted(late, there)["alarms"] == [[1.0, 1]]  # nothing bounds this context
    bounded = counted(late, replace(there, truth=replace(there.truth, horizon=2.0)))
    assert (bounded["alarms"], bounded["beyond"]) == ([], 1)


def test_maps_are_one_alarm_as_sure_as_the_share_of_them_that_see_it() -> None:
    cars = {1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
    hit, calm = scene(cars), scene({1: standing(20, 10)})
    for output in (as_maps(calm, hit), as_heads(hit, calm)):
        assert counted(output, context(41), hit)["alarms"] == [[0.5, 1]]


def test_other_protocols_are_refused() -> None:
    with pytest.raises(ChoiceError, match="protocol: expected one of clean, field, found"):
        WarningEvaluator("boxes")


@pytest.mark.parametrize(
    ("token", "prediction", "label", "known", "message"),
    [
        ("s/ego_vehicle/x", [], None, context(41), "token: expected a sample's.*found 's/ego_vehicle/x'"),
        (41, [], None, context(41), "token: expected a sample's"),
        ("t/s/ego_vehicle/041", RIGHT, None, context(41), "wrap a single Accident in a list"),
        ("t/s/ego_vehicle/041", [], context(41), None, "label: expected MotionLabels or None, found AccidentContext"),
        ("t/s/ego_vehicle/041", [], None, None, "context: warnings need to know what happens"),
        ("t/s/ego_vehicle/041", [], None, AccidentContext(), "give accident_context.dataset, sample, horizon=2.0."),
    ],
)
def test_what_cannot_be_evaluated(token, prediction, label, known, message) -> None:
    with pytest.raises(EvaluationError, match=message):
        WarningEvaluator().update(token, prediction, label, known)


def test_what_a_release_knows_of_a_sample(da_motion: DeepAccident) -> None:
    accident, normal = sorted(da_motion.scenario, key=lambda each: each["collision"] is None)
    token = f"{accident['token']}/ego_vehicle/{accident['num_frames'] - 30:03d}"
    known = accident_context(da_motion, token, 2.0)
    assert (known.time_to_impact, known.time_to_end, known.twin) == (pytest.approx(3), pytest.approx(3), False)
    assert known.truth.accident is None  # later than the horizon
    assert known.truth.impact.ids == known.pair
    farther = box_truth(da_motion, token, horizon=3.0)
    assert_array_equal(farther.accident.positions, known.truth.impact.positions)
    calm = accident_context(da_motion, f"{normal['token']}/ego_vehicle/005", 2.0)
    assert (calm.time_to_impact, calm.time_to_end, calm.twin) == (None, pytest.approx(3), True)
    assert calm.truth.impact is None


def test_twins_that_are_not_there_or_not_known(da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    accident, normal = sorted(da_motion.scenario, key=lambda each: each["collision"] is None)
    token, found = f"{normal['token']}/ego_vehicle/005", da_motion.scenario.get

    def with_twin(**changed):
        def get(asked):
            assert asked == accident["token"]
            return {**found(asked), **changed}

        table = type("Table", (), {"get": staticmethod(get)})()
        monkeypatch.setattr(type(da_motion), "scenario", table, raising=False)
        return accident_context(da_motion, token).twin

    assert with_twin() is True
    assert with_twin(collision=None) is False
    assert with_twin(weather=None) is None


def test_the_notes_say_what_was_not_evaluated() -> None:
    def notes(kind: str) -> str:
        evaluator = WarningEvaluator()
        evaluator.update("t/s/ego_vehicle/041", [RIGHT], None, context(41, kind))
        return "\n".join(evaluator.compute().notes)

    assert "no recording of an accident was evaluated" in notes("twins")
    assert "no recording of an accident was evaluated" not in notes("accident")
    assert "no recording without an accident was evaluated" in notes("accident")
