"""The protocol `paper` on scenes whose accidents are known."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from accident_scenes import FRAMES, as_heads, as_maps, scene, standing
from numpy.testing import assert_allclose
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.map_accidents import AccidentReading, map_accident
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.truth import AccidentContext
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS

PAPER, UNKNOWN = PaperAccidents(), AccidentContext()


def follower(*gaps: float, y: float = 10.0):
    """A car whose front is so far behind the rear of one that stands at (20, y)."""
    return [(20.0 - 4.0 - gap, y) for gap in gaps]


HIT = {1: standing(20, 10), 2: follower(4, 3, 2, 0.5, 1.5)}
"""0.5 m apart 1.5 s ahead, at (20, 10) and (15.5, 10)."""
CALM = {1: standing(20, 10), 2: follower(9, 8, 7, 6, 5)}
SOON = {1: standing(20, 10), 2: follower(4, 0.5, 1.5, 9, 9)}
ASIDE = {3: standing(20, 30)}
NEXT_TO_IT = HIT | {3: standing(15.5, 13)}
LATE_SWAP = {1: standing(20, 10), 2: follower(20, 20, 20, 0.5), 3: follower(1.5, 1.5, 1.5, 20)}

PASSED = {1: standing(20, 10), 2: follower(20, 20, 20, 0.5, 20), 3: [(15, 10), *[(15, -20)] * 4]}


def moved(cars, x: float = 0.0, y: float = 0.0):
    return {actor: [at and (at[0] + x, at[1] + y) for at in path] for actor, path in cars.items()}


def alarm(x=0.0, score=1.0, time=1.5, ids=None, aside=0.0) -> Accident:
    """Of HIT, both positions `x` metres farther ahead, the second car's `aside` to the left."""
    return Accident(
        positions=np.array([[15.5 + x, 10.0 + aside], [20.0 + x, 10.0]]),
        time=time,
        score=score,
        ids=ids,
    )


def read(label, reading=PAPER.reading):
    return map_accident(label.instance, label.config.grid, label.config.rules, reading)


def result(prediction, label, protocol=PAPER, context=UNKNOWN):
    return protocol.result([protocol.counts(prediction, label, context)])


def shown(made) -> tuple[list[tuple[int, int, int]], tuple[Any, ...]]:
    """Tallies by distance, and the errors within 10 m."""
    tallies = [(each.tp, each.fp, each.fn) for each in made.within.values()]
    return tallies, (made.id_error, made.position_error, made.time_error)


TRUE, FALSE, MISSED, NEITHER, ELSEWHERE = (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0), (0, 1, 1)
UNSEEN = (None, None, None)


@pytest.mark.parametrize(
    ("form", "predicted", "true", "tallies", "errors"),
    [
        (as_maps, [HIT] * 2, HIT, [TRUE] * 3, (0, 0, 0)),
        (as_heads, [HIT] * 2, HIT, [TRUE] * 3, (0, 0, 0)),
        (as_maps, [{}] * 2, HIT, [MISSED] * 3, UNSEEN),
        (as_heads, [{}], HIT, [MISSED] * 3, UNSEEN),
        (
            as_maps,
            [{2: HIT[2], 1: HIT[1]}],
            HIT,
            [TRUE] * 3,
            (0, 0, 0),
        ),  # the better pairing of positions
        (as_maps, [moved(HIT, y=2)], HIT, [TRUE] * 3, (0, 4, 0)),  # each of the two is 2 m off
        (
            as_maps,
            [moved(HIT, y=2.5)],
            HIT,
            [ELSEWHERE, TRUE, TRUE],
            (0, 5, 0),
        ),  # 5 m is not less than 5 m
        (as_maps, [moved(HIT, y=4)], HIT, [ELSEWHERE, TRUE, TRUE], (0, 8, 0)),
        (
            as_maps,
            [moved(HIT, y=4.5)],
            HIT,
            [ELSEWHERE, TRUE, TRUE],
            (1, 9, 0),
        ),  # instances beyond the gate
        (as_maps, [moved(HIT, y=5)], HIT, [ELSEWHERE, ELSEWHERE, TRUE], UNSEEN),
        (as_maps, [moved(HIT, y=7.5)], HIT, [ELSEWHERE] * 3, UNSEEN),
        (
            as_maps,
            [{1: standing(20, 10), 2: follower(4, 3, 0.5, 1.5, 2)}],
            HIT,
            [TRUE] * 3,
            (0, 0, 0.5),
        ),  # early
        (as_maps, [CALM, moved(HIT, y=1), CALM], HIT, [TRUE] * 3, (0, 2, 0)),
        (as_heads, [CALM, moved(HIT, y=1), CALM], HIT, [TRUE] * 3, (0, 2, 0)),
        (as_maps, [CALM, CALM, HIT, CALM], CALM, [FALSE] * 3, UNSEEN),
        (as_heads, [CALM, HIT, CALM], CALM, [FALSE] * 3, UNSEEN),
        (as_maps, [CALM] * 2, CALM, [NEITHER] * 3, UNSEEN),
        (as_maps, [{}], {}, [NEITHER] * 3, UNSEEN),
        (as_maps, [{7: HIT[2], 8: ASIDE[3], 9: HIT[1]}], HIT | ASIDE, [TRUE] * 3, (0, 0, 0)),
        (list, [alarm()], HIT, [TRUE] * 3, (0, 0, 0)),
        (list, [alarm(x=3)], HIT, [ELSEWHERE, TRUE, TRUE], (0, 6, 0)),
        (list, [alarm(time=1.2)], HIT, [TRUE] * 3, (0, 0, 0.3)),
        (list, [], HIT, [MISSED] * 3, UNSEEN),
        (list, [alarm()], CALM, [FALSE] * 3, UNSEEN),
        (list, [], CALM, [NEITHER] * 3, UNSEEN),
        (list, [alarm(score=0.5), alarm(x=40)], HIT, [ELSEWHERE] * 3, UNSEEN),  # the surest counts
        (list, [alarm(x=40), alarm(score=0.5)], HIT, [ELSEWHERE] * 3, UNSEEN),
        (
            list,
            [alarm(), alarm(x=1, time=1.0)],
            HIT,
            [TRUE] * 3,
            (0, 2, 0.5),
        ),  # of equally sure ones the earliest
        (list, [alarm(ids=(2, 1))], NEXT_TO_IT, [TRUE] * 3, (0, 0, 0)),
        (list, [alarm(ids=(2, 3))], NEXT_TO_IT, [TRUE] * 3, (1, 0, 0)),
        (list, [alarm(aside=1.6)], NEXT_TO_IT, [TRUE] * 3, (1, 1.6, 0)),  # the third is nearer
        (list, [alarm(aside=1.4)], NEXT_TO_IT, [TRUE] * 3, (0, 1.4, 0)),
        (
            list,
            [alarm(time=0.2)],
            NEXT_TO_IT,
            [TRUE] * 3,
            (1, 0, 1.3),
        ),  # the second is still 3.5 m behind
        (list, [alarm(x=4.1)], NEXT_TO_IT, [ELSEWHERE, TRUE, TRUE], (1, 8.2, 0)),
    ],
)
def test_what_predictions_score(form, predicted, true, tallies, errors) -> None:
    made = result(predicted if form is list else form(*map(scene, predicted)), scene(true))
    assert shown(made) == (tallies, errors if None in errors else pytest.approx(errors))


@pytest.mark.parametrize(
    ("form", "predicted", "true", "frames", "tallies", "time"),
    [
        (
            as_maps,
            [HIT],
            HIT,
            3,
            [NEITHER] * 3,
            None,
        ),  # the accident that is predicted later is not seen
        (as_heads, [HIT], HIT, 3, [NEITHER] * 3, None),
        (list, [alarm(time=1.25)], SOON, 3, [TRUE] * 3, 0.75),
        (list, [alarm(time=1.3), alarm(score=0.5, time=1.0)], SOON, 3, [TRUE] * 3, 0.5),
        (list, [alarm(time=1.3)], SOON, 3, [MISSED] * 3, None),
        (list, [alarm(time=1.75)], LATE_SWAP, 4, [TRUE] * 3, 0.25),
        (list, [alarm(time=1.76)], LATE_SWAP, 4, [MISSED] * 3, None),
    ],
)
def test_only_frames_that_are_recorded_count_and_half_a_step(
    form, predicted, true, frames, tallies, time
) -> None:
    made = result(
        predicted if form is list else form(*map(scene, predicted)), scene(true, frames=frames)
    )
    assert (shown(made)[0], made.time_error) == (tallies, time)


@pytest.mark.parametrize(("time", "error"), [(1.74, 0), (1.75, 0), (1.26, 0), (1.24, 1), (1.2, 1)])
def test_an_explicit_accident_names_who_is_there_at_the_nearest_frame(
    time: float, error: int
) -> None:
    """Of four frames the last one is the nearest up to the end of their time; before, another was
    there.
    """
    assert (
        PAPER.counts([alarm(time=time)], scene(LATE_SWAP, frames=4), UNKNOWN)["best"]["id"] == error
    )


@pytest.mark.parametrize(
    ("off", "best", "mean_first"),
    [
        ([None, None, 1, None, None, None], 2, 2),
        ([3, 1, None, 4], 2, 8),
        ([3, 1, 4, None], 2, 6),  # the mean has none, so the first that has one
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
    off: list[float | None], best: float, mean_first: float
) -> None:
    """By how far each is off; None for one without an accident."""
    label = scene(HIT)
    output = as_maps(*(scene(CALM if y is None else moved(HIT, y=y)) for y in off))
    for choice, other, expected in (
        ("best", "mean_first", (best, mean_first)),
        ("mean_first", "best", (mean_first, best)),
    ):
        made = result(output, label, replace(PAPER, sample_choice=choice))
        assert set(made.beside) == {f"sample_choice={other}"}
        assert (
            made.position_error,
            made.beside[f"sample_choice={other}"].position_error,
        ) == expected


def test_others_that_collide_are_an_id_error() -> None:
    calm = {2: follower(4, 3, 2, 1.5, 1.5), 1: standing(20, 10), 3: standing(20, 12.5)}
    wrong = result(as_maps(scene(calm)), scene(HIT | {3: standing(20, 15)}))
    assert [(each.tp, each.id_error) for each in wrong.within.values()] == [
        (0, None),
        (1, 1),
        (1, 1),
    ]


def ahead(gap: float, y: float):
    return [(0.0, y), (4.0 + gap, y)]


def beside(gap: float, y: float):
    return [(0.0, y), (0.0, y + 2 + gap)]


def pairs_of(*pairs) -> dict[int, list[tuple[float, float]]]:
    """Cars 1 and 2, 3 and 4, …"""
    both = [[[at[which] for at in path] for which in (0, 1)] for path in pairs]
    return dict(enumerate((path for pair in both for path in pair), start=1))


EARLY = [ahead(gap, 0) for gap in (2, 2, 0.5, 2, 0.5)]


@pytest.mark.parametrize(
    ("cars", "contact"),
    [
        (HIT, (3, (1, 2), 0.5)),
        ({1: standing(20, 10), 2: follower(4, 3, 2, 1, 1.5)}, None),  # a metre apart
        (
            {1: standing(20, 10), 2: follower(4, 3, 2, 0, 1.5)},
            (3, (1, 2), 0.5),
        ),  # the outermost cells are shared
        (
            pairs_of([ahead(gap, -20) for gap in (2, 2, 2, 2, 0.5)], EARLY),
            (2, (3, 4), 0.5),
        ),  # the earlier
        (
            pairs_of(EARLY, [beside(gap, 20) for gap in (2, 2, 0.5, 2, 2)]),
            (2, (3, 4), 0.5),
        ),  # with nearer centres
        (
            pairs_of([ahead(gap, -40) for gap in (2, 2, 0.5, 2, 2)], EARLY),
            (2, (1, 2), 0.5),
        ),  # with lower ids
    ],
)
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_who_collides(cars, contact, orientation) -> None:
    found = read(scene(cars, orientation=orientation))
    assert (
        found.contact and (found.contact.frame, found.contact.ids, found.contact.distance)
    ) == contact
    if cars is HIT:
        assert_allclose(found.positions, [[20, 10], [15.5, 10]])


def test_positions_of_labels_without_the_half_cell_shift() -> None:
    """Corners on cell edges belong to the cell beyond, so that a car lies a quarter metre ahead and
    to the right.
    """
    assert_allclose(read(scene(HIT, protocol="clean")).positions, [[20.25, 9.75], [15.75, 9.75]])


def test_an_instance_that_leaves_the_grid() -> None:
    """It is half out when it collides, so that its mean cell is nearer; beyond it is nowhere, and
    matched before.
    """
    leaving = [(46.0, 0.0), (48.0, 0.0), (50.0, 0.0), None, None]
    cars = {
        1: leaving,
        2: [(x - 4.5 + 0.5 * (t != 2) * -4, 0.0) for t, (x, _) in enumerate(leaving[:3])]
        + [None] * 2,
    }
    label = scene(cars)
    found = read(label)
    assert (found.contact.frame, found.contact.distance) == (2, 0.5)
    assert found.positions[0, 0] == pytest.approx((48.0 + 49.5) / 2)
    assert np.isnan(found.tracks.center[3:]).all()
    assert shown(result(as_maps(label), label)) == ([TRUE] * 3, (0, 0, 0))
    assert read(scene({1: standing(100, 0), 2: standing(20, 0)})).tracks.identity.tolist() == [2]


def test_orientations_of_prediction_and_label_may_differ() -> None:
    label, predicted = scene(HIT), moved(HIT, y=1)
    expected = PAPER.counts(as_maps(scene(predicted)), label, UNKNOWN)
    for orientation in ORIENTATIONS:
        assert (
            PAPER.counts(as_maps(scene(predicted, orientation=orientation)), label, UNKNOWN)
            == expected
        )


def test_whom_the_truth_names() -> None:
    known = partial(AccidentContext, known=True)
    cases = [
        *(
            (HIT | ASIDE, context)
            for context in (known(pair=(2, 1)), known(pair=(1, 3)), known(), UNKNOWN)
        ),
        (CALM, known(pair=(2, 1))),
        (PASSED, known(pair=(2, 1))),  # a third car was where one of the two is in the end
    ]
    counts = [PAPER.counts(as_maps(scene(cars)), scene(cars), context) for cars, context in cases]
    assert [each["named"] for each in counts] == [
        "meta",
        "another",
        "another",
        "unknown",
        "none",
        "meta",
    ]
    made = PAPER.result(counts)
    assert made.truths == {"meta": 2, "another": 2, "none": 1, "unknown": 1}
    assert (made.samples, made.positives, made.negatives) == (6, 5, 1)


@pytest.mark.parametrize(
    ("own", "named", "error"), [(77, "meta", 0), (76, "another", 1), (None, "unknown", None)]
)
def test_the_egos_own_box_is_the_agent_itself(
    own: int | None, named: str, error: int | None
) -> None:
    label = scene({5: [(20 - 4 * t, 0.0) for t in range(4)] + [(4.5, 0.0)]}, draw_ego=True)
    context = AccidentContext(pair=(5, 77), known=True, own_actor_id=own)
    predicted = [Accident(positions=np.array([[4.5, 0.0], [0.0, 0.0]]), time=2.0, ids=(77, 5))]
    for output in (as_maps(label), as_heads(label), predicted):
        assert PAPER.counts(output, label, context)["named"] == named
    assert result(predicted, label, context=context).id_error == error


def test_what_results_hold() -> None:
    label = scene(HIT)
    outputs = [as_maps(scene(moved(HIT, y=3)), label), as_heads(label), [alarm(time=1.0)], []]
    counts = [PAPER.counts(each, label, UNKNOWN) for each in outputs]
    assert counts[0] == {
        "positive": True,
        "named": "unknown",
        "instance_maps": True,
        "explicit": False,
        "best": {"position": 0, "time": 0, "id": 0},
        "mean_first": {"position": 0, "time": 0, "id": 0},
    }
    assert [(each["instance_maps"], each["explicit"]) for each in counts[1:]] == [
        (False, False),
        *[(False, True)] * 2,
    ]
    errors = {"id_error": 0, "position_error": 0, "time_error": pytest.approx(0.5 / 3)}
    numbers = {
        "within": {
            f"{distance}": {
                "distance": distance,
                "tp": 3,
                "fp": 0,
                "fn": 1,
                "accuracy": 3 / 3.5,
                **errors,
            }
            for distance in (5, 10, 15)
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
        "their truth is the labels' instance map, not the released grouping "
        "and linking of the labels"
    )
    notes = [
        f"1 of 4 predictions were given as instance maps: {truth}",
        f"2 of 4 predictions were given as explicit accidents: {truth}",
    ]
    assert PAPER.result(counts).as_dict() == numbers | {"notes": notes, "beside": beside}
    assert math.isnan(PAPER.result([]).apa)


def test_what_cannot_be_compared() -> None:
    label, other = scene(HIT), BevGrid(x=(-25, 25, 0.25), y=(-25, 25, 0.25))
    few, elsewhere = (
        MotionOutput(grid=grid, instances=label.instance[None, :frames])
        for grid, frames in ((label.config.grid, 3), (other, FRAMES))
    )
    assert_refused(
        *(
            (partial(PAPER.counts, given, beside, UNKNOWN), EvaluationError, words)
            for given, beside, words in (
                ([(20.0, 10.0)], label, ("a MotionOutput or a list of Accidents", "tuple")),
                ([alarm()], None, ("motion labels",)),
                (as_maps(label), None, ("motion labels",)),
                (as_maps(label), scene(HIT, protocol="clean"), ("protocol 'released'",)),
                (few, label, ("at least 5 frames", "found 3")),
                (elsewhere, label, ("make both with the same grid",)),
                (as_maps(label), scene(HIT, frames=0), ("present frame",)),
            )
        ),
        (
            lambda: PaperAccidents(sample_choice="worst"),
            ChoiceError,
            ("sample_choice", "best, mean_first", "worst"),
        ),
        (lambda: AccidentReading(danger_distance=0), ConfigError, ("danger_distance", "above 0")),
        (
            lambda: AccidentReading(danger_distance=math.inf),
            ConfigError,
            ("danger_distance", "inf"),
        ),
    )
    assert read(label, AccidentReading(danger_distance=0.5)).contact is None
