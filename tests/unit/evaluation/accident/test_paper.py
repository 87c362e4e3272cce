"""The protocol `paper` on scenes with known accidents."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support.accident_scenes import (
    FRAMES,
    motion_labels_of,
    parked_path,
    read_tallies,
    shift_cars,
    to_heads_output,
    to_instance_output,
)
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.map_accidents import AccidentReading, map_accident
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS

PAPER = PaperAccidents()
UNKNOWN = AccidentContext()


def make_follower(*gaps: float):
    """Return the path of a car with these gaps to the rear of one that stands at (20, 10)."""
    return [(20.0 - 4.0 - gap, 10.0) for gap in gaps]


# In 1.5 s the cars are 0.5 m apart, at (20, 10) and (15.5, 10).
HIT = {1: parked_path(20, 10), 2: make_follower(4, 3, 2, 0.5, 1.5)}
CALM = {1: parked_path(20, 10), 2: make_follower(9, 8, 7, 6, 5)}
SOON = {1: parked_path(20, 10), 2: make_follower(4, 0.5, 1.5, 9, 9)}
FAR_CAR = {3: parked_path(20, 30)}
NEXT_TO_IT = HIT | {3: parked_path(15.5, 13)}
LATE_SWAP = {
    1: parked_path(20, 10),
    2: make_follower(20, 20, 20, 0.5),
    3: make_follower(1.5, 1.5, 1.5, 20),
}
PASSED = {
    1: parked_path(20, 10),
    2: make_follower(20, 20, 20, 0.5, 20),
    3: [(15, 10), *[(15, -20)] * 4],
}


def make_alarm(x=0.0, score=1.0, time=1.5, ids=None, aside=0.0) -> Accident:
    """Make an alarm for HIT, `x` metres farther ahead; the second car is `aside` to the left."""
    return Accident(
        positions=np.array([[15.5 + x, 10.0 + aside], [20.0 + x, 10.0]]),
        time=time,
        score=score,
        ids=ids,
    )


def find_accident(label, reading=PAPER.reading):
    return map_accident(
        label.instance,
        label.config.grid,
        label.config.rules,
        reading,
    )


def evaluate(prediction, label, protocol=PAPER, context=UNKNOWN):
    return protocol.result([protocol.counts(prediction, label, context)])


def read_errors(result) -> tuple[float | None, float | None, float | None]:
    return (
        result.id_error,
        result.position_error,
        result.time_error,
    )


def to_prediction(form, predicted):
    return predicted if form is list else form(*map(motion_labels_of, predicted))


# True positives, false positives and missed accidents.
TRUE, FALSE, MISSED, NEITHER, ELSEWHERE = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0), (0, 1, 1)
NO_ERRORS = (None, None, None)


@pytest.mark.parametrize(
    ("form", "predicted", "true", "tallies", "errors"),
    [
        (to_instance_output, [HIT] * 2, HIT, [TRUE] * 3, (0, 0, 0)),
        (to_heads_output, [HIT] * 2, HIT, [TRUE] * 3, (0, 0, 0)),
        (to_instance_output, [{}] * 2, HIT, [MISSED] * 3, NO_ERRORS),
        (to_heads_output, [{}], HIT, [MISSED] * 3, NO_ERRORS),
        (
            to_instance_output,
            # positions are paired so that they are nearest to each other
            [{2: HIT[2], 1: HIT[1]}],
            HIT,
            [TRUE] * 3,
            (0, 0, 0),
        ),
        # both cars are 2 m off
        (to_instance_output, [shift_cars(HIT, y=2)], HIT, [TRUE] * 3, (0, 4, 0)),
        # 5 m is not less than 5 m
        (to_instance_output, [shift_cars(HIT, y=2.5)], HIT, [ELSEWHERE, TRUE, TRUE], (0, 5, 0)),
        (to_instance_output, [shift_cars(HIT, y=4)], HIT, [ELSEWHERE, TRUE, TRUE], (0, 8, 0)),
        # instances beyond the gate
        (to_instance_output, [shift_cars(HIT, y=4.5)], HIT, [ELSEWHERE, TRUE, TRUE], (1, 9, 0)),
        (to_instance_output, [shift_cars(HIT, y=5)], HIT, [ELSEWHERE, ELSEWHERE, TRUE], NO_ERRORS),
        (to_instance_output, [shift_cars(HIT, y=7.5)], HIT, [ELSEWHERE] * 3, NO_ERRORS),
        (
            # half a second early
            to_instance_output,
            [{1: parked_path(20, 10), 2: make_follower(4, 3, 0.5, 1.5, 2)}],
            HIT,
            [TRUE] * 3,
            (0, 0, 0.5),
        ),
        (to_instance_output, [CALM, shift_cars(HIT, y=1), CALM], HIT, [TRUE] * 3, (0, 2, 0)),
        (to_heads_output, [CALM, shift_cars(HIT, y=1), CALM], HIT, [TRUE] * 3, (0, 2, 0)),
        (to_instance_output, [CALM, CALM, HIT, CALM], CALM, [FALSE] * 3, NO_ERRORS),
        (to_heads_output, [CALM, HIT, CALM], CALM, [FALSE] * 3, NO_ERRORS),
        (to_instance_output, [CALM] * 2, CALM, [NEITHER] * 3, NO_ERRORS),
        (to_instance_output, [{}], {}, [NEITHER] * 3, NO_ERRORS),
        (
            to_instance_output,
            [{7: HIT[2], 8: FAR_CAR[3], 9: HIT[1]}],
            HIT | FAR_CAR,
            [TRUE] * 3,
            (0, 0, 0),
        ),
        (list, [make_alarm()], HIT, [TRUE] * 3, (0, 0, 0)),
        (list, [make_alarm(x=3)], HIT, [ELSEWHERE, TRUE, TRUE], (0, 6, 0)),
        (list, [make_alarm(time=1.2)], HIT, [TRUE] * 3, (0, 0, 0.3)),
        (list, [], HIT, [MISSED] * 3, NO_ERRORS),
        (list, [make_alarm()], CALM, [FALSE] * 3, NO_ERRORS),
        (list, [], CALM, [NEITHER] * 3, NO_ERRORS),
        # the surest counts
        (list, [make_alarm(score=0.5), make_alarm(x=40)], HIT, [ELSEWHERE] * 3, NO_ERRORS),
        (list, [make_alarm(x=40), make_alarm(score=0.5)], HIT, [ELSEWHERE] * 3, NO_ERRORS),
        # the earliest of equally sure alarms counts
        (list, [make_alarm(), make_alarm(x=1, time=1.0)], HIT, [TRUE] * 3, (0, 2, 0.5)),
        (list, [make_alarm(ids=(2, 1))], NEXT_TO_IT, [TRUE] * 3, (0, 0, 0)),
        (list, [make_alarm(ids=(2, 3))], NEXT_TO_IT, [TRUE] * 3, (1, 0, 0)),
        # the third car is nearer
        (list, [make_alarm(aside=1.6)], NEXT_TO_IT, [TRUE] * 3, (1, 1.6, 0)),
        (list, [make_alarm(aside=1.4)], NEXT_TO_IT, [TRUE] * 3, (0, 1.4, 0)),
        # the second car is still 3.5 m behind
        (list, [make_alarm(time=0.2)], NEXT_TO_IT, [TRUE] * 3, (1, 0, 1.3)),
        (list, [make_alarm(x=4.1)], NEXT_TO_IT, [ELSEWHERE, TRUE, TRUE], (1, 8.2, 0)),
    ],
)
def test_what_predictions_score(form, predicted, true, tallies, errors) -> None:
    result = evaluate(to_prediction(form, predicted), motion_labels_of(true))
    assert read_tallies(result) == tallies
    assert read_errors(result) == (errors if None in errors else pytest.approx(errors))


@pytest.mark.parametrize(
    ("form", "predicted", "true", "frames", "tallies", "time"),
    [
        # the predicted accident comes after the end of the recording
        (to_instance_output, [HIT], HIT, 3, [NEITHER] * 3, None),
        (to_heads_output, [HIT], HIT, 3, [NEITHER] * 3, None),
        (list, [make_alarm(time=1.25)], SOON, 3, [TRUE] * 3, 0.75),
        (list, [make_alarm(time=1.3), make_alarm(score=0.5, time=1.0)], SOON, 3, [TRUE] * 3, 0.5),
        (list, [make_alarm(time=1.3)], SOON, 3, [MISSED] * 3, None),
        (list, [make_alarm(time=1.75)], LATE_SWAP, 4, [TRUE] * 3, 0.25),
        (list, [make_alarm(time=1.76)], LATE_SWAP, 4, [MISSED] * 3, None),
    ],
)
def test_only_frames_that_are_recorded_count_and_half_a_step(
    form, predicted, true, frames, tallies, time
) -> None:
    result = evaluate(
        to_prediction(form, predicted),
        motion_labels_of(true, frames=frames),
    )
    assert (read_tallies(result), result.time_error) == (tallies, time)


@pytest.mark.parametrize(("time", "error"), [(1.74, 0), (1.75, 0), (1.26, 0), (1.24, 1), (1.2, 1)])
def test_an_explicit_accident_names_who_is_there_at_the_nearest_frame(
    time: float, error: int
) -> None:
    """The last of four frames is the nearest up to the end of their time; before it another car was
    there.
    """
    label = motion_labels_of(LATE_SWAP, frames=4)
    assert PAPER.counts([make_alarm(time=time)], label, UNKNOWN)["best"]["id"] == error


@pytest.mark.parametrize(
    ("offsets", "best", "mean_first"),
    [
        ([None, None, 1, None, None, None], 2, 2),
        ([3, 1, None, 4], 2, 8),
        # the mean has no accident, so that the first with one counts
        ([3, 1, 4, None], 2, 6),
        ([3, None, None, None], 6, 6),
        ([None, 3, None, None], 6, 6),
        ([None, None, 3, None], 6, 6),
        ([None, None, None, 3], 6, 6),
        ([1, 3, None, None], 2, 2),
        ([None, 3, 1, None], 2, 6),
        ([1, 1, 1, 3], 2, 6),
    ],
)
def test_which_of_several_predictions_is_compared(
    offsets: list[float | None], best: float, mean_first: float
) -> None:
    """Offsets say how far each prediction is off, metres; None for one without an accident."""
    label = motion_labels_of(HIT)
    predictions = [CALM if y is None else shift_cars(HIT, y=y) for y in offsets]
    output = to_prediction(to_instance_output, predictions)
    for choice, other, errors in (
        ("best", "mean_first", (best, mean_first)),
        ("mean_first", "best", (mean_first, best)),
    ):
        result = evaluate(output, label, replace(PAPER, sample_choice=choice))
        [(name, place_side_by_side)] = result.beside.items()
        assert name == f"sample_choice={other}"
        assert (result.position_error, place_side_by_side.position_error) == errors


def test_others_that_collide_are_an_id_error() -> None:
    true = HIT | {3: parked_path(20, 15)}
    predicted = {
        2: make_follower(4, 3, 2, 1.5, 1.5),
        1: parked_path(20, 10),
        3: parked_path(20, 12.5),
    }
    result = evaluate(to_instance_output(motion_labels_of(predicted)), motion_labels_of(true))
    errors = [(cases.tp, cases.id_error) for cases in result.within.values()]
    assert errors == [(0, None), (1, 1), (1, 1)]


def place_in_line(gap: float, y: float):
    return [(0.0, y), (4.0 + gap, y)]


def place_side_by_side(gap: float, y: float):
    return [
        (0.0, y),
        (0.0, y + 2 + gap),
    ]


def number_cars(*pairs) -> dict[int, list[tuple[float, float]]]:
    """Name the first pair of cars 1 and 2, the second 3 and 4, …"""
    paths = [path for positions in pairs for path in zip(*positions, strict=True)]
    return dict(enumerate(paths, start=1))


EARLY = [place_in_line(gap, 0) for gap in (2, 2, 0.5, 2, 0.5)]


@pytest.mark.parametrize(
    ("cars", "contact"),
    [
        (HIT, (3, (1, 2), 0.5)),
        # a metre apart
        ({1: parked_path(20, 10), 2: make_follower(4, 3, 2, 1, 1.5)}, None),
        # the outermost cells are shared
        ({1: parked_path(20, 10), 2: make_follower(4, 3, 2, 0, 1.5)}, (3, (1, 2), 0.5)),
        (
            # the earlier pair collides
            number_cars([place_in_line(gap, -20) for gap in (2, 2, 2, 2, 0.5)], EARLY),
            (2, (3, 4), 0.5),
        ),
        (
            # the pair with nearer centres collides
            number_cars(EARLY, [place_side_by_side(gap, 20) for gap in (2, 2, 0.5, 2, 2)]),
            (2, (3, 4), 0.5),
        ),
        (
            # the pair with lower ids collides
            number_cars([place_in_line(gap, -40) for gap in (2, 2, 0.5, 2, 2)], EARLY),
            (2, (1, 2), 0.5),
        ),
    ],
)
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_who_collides(cars, contact, orientation) -> None:
    accident = find_accident(motion_labels_of(cars, orientation=orientation))
    result = accident.contact
    if result is not None:
        result = (result.frame, result.ids, result.distance)
    assert result == contact
    if cars is HIT:
        assert_allclose(accident.positions, [[20, 10], [15.5, 10]])


def test_positions_of_labels_without_the_half_cell_shift() -> None:
    """Corners on cell edges belong to the cell beyond, so that a car lies a quarter metre ahead and
    to the right.
    """
    accident = find_accident(motion_labels_of(HIT, protocol="clean"))
    assert_allclose(accident.positions, [[20.25, 9.75], [15.75, 9.75]])


def test_an_instance_that_leaves_the_grid() -> None:
    """When it collides, half of it is outside, so that its mean cell is nearer; beyond the grid it
    is nowhere, and it is matched before.
    """
    label = motion_labels_of(
        {
            1: [(46.0, 0.0), (48.0, 0.0), (50.0, 0.0), None, None],
            2: [(39.5, 0.0), (41.5, 0.0), (45.5, 0.0), None, None],
        }
    )
    accident = find_accident(label)
    assert (accident.contact.frame, accident.contact.distance) == (2, 0.5)
    assert accident.positions[0, 0] == pytest.approx((48.0 + 49.5) / 2)
    assert np.isnan(accident.tracks.center[3:]).all()

    result = evaluate(to_instance_output(label), label)
    assert (read_tallies(result), read_errors(result)) == ([TRUE] * 3, (0, 0, 0))

    outside = find_accident(motion_labels_of({1: parked_path(100, 0), 2: parked_path(20, 0)}))
    assert outside.tracks.identity.tolist() == [2]


def test_orientations_of_prediction_and_label_may_differ() -> None:
    label = motion_labels_of(HIT)
    predicted = shift_cars(HIT, y=1)
    expected = PAPER.counts(
        to_instance_output(motion_labels_of(predicted)),
        label,
        UNKNOWN,
    )
    for orientation in ORIENTATIONS:
        output = to_instance_output(motion_labels_of(predicted, orientation=orientation))
        assert PAPER.counts(output, label, UNKNOWN) == expected


def test_actors_that_the_truth_names() -> None:
    known = partial(AccidentContext, known=True)
    cases = [
        (HIT | FAR_CAR, known(pair=(2, 1)), "meta"),
        (HIT | FAR_CAR, known(pair=(1, 3)), "another"),
        (HIT | FAR_CAR, known(), "another"),
        (HIT | FAR_CAR, UNKNOWN, "unknown"),
        (CALM, known(pair=(2, 1)), "none"),
        # a third car was at the present where one of the two is in the end
        (PASSED, known(pair=(2, 1)), "meta"),
    ]
    counts = []
    for cars, context, named in cases:
        label = motion_labels_of(cars)
        counts.append(PAPER.counts(to_instance_output(label), label, context))
        assert counts[-1]["named"] == named

    result = PAPER.result(counts)
    assert result.truths == {"meta": 2, "another": 2, "none": 1, "unknown": 1}
    assert (result.samples, result.positives, result.negatives) == (6, 5, 1)


@pytest.mark.parametrize(
    ("own_id", "named", "error"), [(77, "meta", 0), (76, "another", 1), (None, "unknown", None)]
)
def test_the_egos_own_box_is_the_agent_itself(
    own_id: int | None, named: str, error: int | None
) -> None:
    label = motion_labels_of(
        {5: [(20.0, 0.0), (16.0, 0.0), (12.0, 0.0), (8.0, 0.0), (4.5, 0.0)]},
        draw_ego=True,
    )
    context = AccidentContext(pair=(5, 77), known=True, own_actor_id=own_id)
    alarm = Accident(
        positions=np.array([[4.5, 0.0], [0.0, 0.0]]),
        time=2.0,
        ids=(77, 5),
    )
    for prediction in (to_instance_output(label), to_heads_output(label), [alarm]):
        assert PAPER.counts(prediction, label, context)["named"] == named
    assert evaluate([alarm], label, context=context).id_error == error


def test_what_results_hold() -> None:
    label = motion_labels_of(HIT)
    predictions = [
        to_instance_output(motion_labels_of(shift_cars(HIT, y=3)), label),
        to_heads_output(label),
        [make_alarm(time=1.0)],
        [],
    ]
    counts = [PAPER.counts(prediction, label, UNKNOWN) for prediction in predictions]
    assert counts[0] == {
        "positive": True,
        "named": "unknown",
        "instance_maps": True,
        "explicit": False,
        "best": {"position": 0, "time": 0, "id": 0},
        "mean_first": {"position": 0, "time": 0, "id": 0},
    }
    forms = [(sample["instance_maps"], sample["explicit"]) for sample in counts[1:]]
    assert forms == [(False, False), (False, True), (False, True)]

    errors = {"id_error": 0, "position_error": 0, "time_error": pytest.approx(0.5 / 3)}
    cases = {"tp": 3, "fp": 0, "fn": 1, "accuracy": 3 / 3.5, **errors}
    numbers = {
        "within": {
            "5": {"distance": 5, **cases},
            "10": {"distance": 10, **cases},
            "15": {"distance": 15, **cases},
        },
        "apa": 3 / 3.5,
        **errors,
        "samples": 4,
        "positives": 4,
        "negatives": 0,
        "truths": {"meta": 0, "another": 0, "none": 0, "unknown": 4},
    }
    beside = {"sample_choice=mean_first": numbers | {"notes": [], "beside": {}}}
    truth = (
        "Their truth is the labels' instance map, not the released grouping "
        "and linking of the labels"
    )
    notes = [
        f"given as instance maps: 1 of 4 predictions. {truth}",
        f"given as explicit accidents: 2 of 4 predictions. {truth}",
    ]
    assert PAPER.result(counts).as_dict() == numbers | {"notes": notes, "beside": beside}
    assert math.isnan(PAPER.result([]).apa)


def test_what_cannot_be_compared() -> None:
    label = motion_labels_of(HIT)
    clean = motion_labels_of(HIT, protocol="clean")
    other_grid = BevGrid(x=(-25, 25, 0.25), y=(-25, 25, 0.25))
    few = MotionOutput(grid=label.config.grid, instances=label.instance[None, :3])
    elsewhere = MotionOutput(grid=other_grid, instances=label.instance[None, :FRAMES])
    cases = [
        ([(20.0, 10.0)], label, ("a MotionOutput or a list of Accidents", "tuple")),
        ([make_alarm()], None, ("motion labels",)),
        (to_instance_output(label), None, ("motion labels",)),
        (to_instance_output(label), clean, ("protocol 'released'",)),
        (few, label, ("at least 5 frames", "found 3")),
        (elsewhere, label, ("Make both with the same grid",)),
        (to_instance_output(label), motion_labels_of(HIT, frames=0), ("present frame",)),
    ]
    assert_raises(
        *(
            (partial(PAPER.counts, prediction, truth, UNKNOWN), EvaluationError, words)
            for prediction, truth, words in cases
        ),
        (
            lambda: PaperAccidents(sample_choice="worst"),
            ChoiceError,
            ("sample_choice", "best, mean_first", "worst"),
        ),
        (
            lambda: AccidentReading(danger_distance=0),
            ConfigError,
            ("danger_distance", "above 0"),
        ),
        (
            lambda: AccidentReading(danger_distance=math.inf),
            ConfigError,
            ("danger_distance", "inf"),
        ),
    )
    assert find_accident(label, AccidentReading(danger_distance=0.5)).contact is None
