"""The protocol `boxes`: alarms are compared with the boxes of a truth made by hand."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.accident_scenes import (
    motion_labels_of,
    parked_path,
    read_tallies,
    shift_cars,
    to_heads_output,
    to_instance_output,
)
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import BoxTruth
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.truth import UNPLACED_NOTE, AccidentContext

BOXES = BoxAccidents()
FRAMES = 21
FIRST, SECOND, THIRD = 11, 22, 33
PAIR = (FIRST, SECOND)


def make_truth(gaps, pair=PAIR, seconds=2.0, standing_cars=None, **fields) -> BoxTruth:
    """Make the boxes of a car at (20, 10), of one behind it with these gaps every tenth of a
    second, and of other cars that stand.
    """
    count = len(gaps)
    tracks = {
        FIRST: np.tile([20.0, 10.0], (count, 1)),
        SECOND: np.column_stack([16.0 - np.array(gaps), np.full(count, 10.0)]),
    }
    for actor, position in (standing_cars or {}).items():
        tracks[actor] = np.tile(position, (count, 1))
    centers = np.stack(
        [tracks[actor] for actor in sorted(tracks)],
        axis=1,
    )
    size_and_yaw = np.broadcast_to(
        [4.0, 2.0, 0.0],
        (*centers.shape[:2], 3),
    )
    accident = None
    if pair:
        positions = np.array([tracks[actor][-1] for actor in pair])
        accident = Accident(positions=positions, time=seconds, ids=pair)
    return BoxTruth(
        time=np.arange(count) / 10,
        actor_id=np.array(sorted(tracks)),
        footprint=np.concatenate([centers, size_and_yaw], axis=-1),
        accident=accident,
        **fields,
    )


CRASH = make_truth(np.linspace(10, 0, FRAMES))
BOUNDED = replace(CRASH, horizon=2.0)
PASSING = make_truth(np.linspace(20, 10, FRAMES), pair=None)
IMPACT = make_truth([0.0], seconds=0.0)
SOON = make_truth([0.5, 0.0], seconds=0.1)
LOST = replace(PASSING, unplaced=1.0, horizon=2.0)
WITH_NEIGHBOUR = make_truth(np.linspace(10, 0, FRAMES), standing_cars={THIRD: (16.0, 12.0)})
WITH_LEAVING_CAR = make_truth(np.linspace(10, 0, FRAMES), standing_cars={THIRD: (16.0, 10.0)})
# The third car stands where the second one ends, and has no box in the last frame.
NUM_BOXES = 2 + (WITH_LEAVING_CAR.time[:, None, None] < 1.95)
WITH_LEAVING_CAR = replace(
    WITH_LEAVING_CAR,
    footprint=np.where(np.arange(3)[:, None] < NUM_BOXES, WITH_LEAVING_CAR.footprint, np.nan),
)
WITHOUT_LABELS = replace(CRASH, footprint=np.full_like(CRASH.footprint, np.nan))
META = AccidentContext(pair=(SECOND, FIRST), known=True)


def make_alarm(x=0.0, time=2.0, score=1.0, ids=None) -> Accident:
    """Make an alarm for the crash, with both positions `x` metres farther ahead."""
    return Accident(
        positions=np.array([[16.0 + x, 10.0], [20.0 + x, 10.0]]),
        time=time,
        score=score,
        ids=ids,
    )


def make_lateral_alarm(y: float) -> Accident:
    """Make an alarm for the crash, with the second position `y` metres to the left."""
    return Accident(
        positions=np.array([[20.0, 10.0], [16.0, 10.0 + y]]),
        time=2.0,
    )


def count_alarms(prediction, truth, protocol=BOXES, context=META):
    return protocol.counts(prediction, None, replace(context, truth=truth))


def evaluate(prediction, truth, protocol=BOXES):
    return protocol.result([count_alarms(prediction, truth, protocol)])


THREE = [
    make_alarm(1, time=1.5, score=0.6),
    make_alarm(40, score=0.9),
    make_alarm(2, time=2.5, score=0.7),
]


@pytest.mark.parametrize(
    ("alarms", "truth", "expected"),
    [
        (
            [make_alarm(ids=PAIR)],
            CRASH,
            {"apa": 1, "precision": 1, "recall": 1, "average_precision": 1, "lateness": 0},
        ),
        (
            [],
            CRASH,
            {"recall": 0, "average_precision": 0, "precision": None, "false_alarm_rate": None},
        ),
        (
            [],
            PASSING,
            {"apa": math.nan, "recall": None, "average_precision": None, "false_alarm_rate": 0},
        ),
        (
            THREE,
            CRASH,
            {"position_error": 4, "time_error": 0.5, "lateness": 0.5, "average_precision": 0.5},
        ),
        (
            [*THREE, make_alarm(0, score=-0.1)],
            CRASH,
            {"precision": pytest.approx(1 / 3), "position_error": 4},
        ),
        (
            # equally sure alarms are one step of the curve
            [make_alarm(40, time=1.0, score=0.5), make_alarm(0, score=0.5)],
            CRASH,
            {"average_precision": 0.5},
        ),
        (
            [make_alarm(time=1.0)],
            PASSING,
            {"apa": math.nan, "recall": None, "false_alarm_rate": 1, "unjudged": 0},
        ),
        ([make_alarm(time=2.04)], PASSING, {"unjudged": 0, "false_alarm_rate": 1}),
        (
            # the recording cannot refute it
            [make_alarm(time=2.06)],
            PASSING,
            {"unjudged": 1, "false_alarm_rate": 0},
        ),
        (
            [make_alarm(time=900.0)],
            BOUNDED,
            {"apa": 0, "precision": None, "recall": 0, "beyond": 1},
        ),
        ([make_alarm(time=2.04)], BOUNDED, {"apa": 1, "beyond": 0}),
        ([make_alarm(time=2.06)], BOUNDED, {"apa": 0, "beyond": 1}),
        (
            [make_alarm(time=900.0, score=0.9), make_alarm(score=0.5)],
            BOUNDED,
            {"apa": 1, "beyond": 1},
        ),
        (
            [make_alarm(time=0.0)],
            IMPACT,
            {"samples": 0, "at_impact": 1, "apa": math.nan, "precision": None},
        ),
        ([make_alarm(time=0.1)], SOON, {"samples": 1, "at_impact": 0, "apa": 1}),
        ([make_alarm(time=1.0)], LOST, {"samples": 0, "unplaced": 1, "precision": None}),
        (
            # it comes after the horizon
            [make_alarm(time=1.0)],
            replace(LOST, horizon=0.5),
            {"samples": 1, "unplaced": 0},
        ),
    ],
)
def test_what_alarms_score(alarms, truth, expected) -> None:
    result = evaluate(alarms, truth)
    values = {name: getattr(result, name) for name in expected}
    assert values == pytest.approx(expected, nan_ok=True)
    unknown = [math.isnan(cases.accuracy) for cases in result.within.values()]
    assert unknown == [math.isnan(result.apa)] * 3


@pytest.mark.parametrize(
    ("alarm", "truth", "error"),
    [
        (make_alarm(ids=(SECOND, FIRST)), CRASH, 0),
        (make_alarm(ids=(FIRST, THIRD)), CRASH, 1),
        (make_alarm(), CRASH, 0),
        (make_alarm(x=-1.9), CRASH, 0),
        (make_alarm(), WITH_NEIGHBOUR, 0),
        # the third car is nearer
        (make_lateral_alarm(1.1), WITH_NEIGHBOUR, 1),
        # the third car was still there
        (make_alarm(time=1.9), WITH_LEAVING_CAR, 1),
        (make_alarm(time=2.0), WITH_LEAVING_CAR, 0),
        # after the truth's last moment, which counts instead
        (make_alarm(time=7.0), CRASH, 0),
        # two positions name two actors, though one is nearest to both
        (Accident(positions=np.array([[20.0, 10.0], [18.5, 10.0]]), time=2.0), CRASH, 0),
        (make_alarm(), WITHOUT_LABELS, 1),
    ],
)
def test_actors_that_an_alarm_names(alarm: Accident, truth: BoxTruth, error: int) -> None:
    """An alarm without ids names the nearest boxes at its time."""
    assert evaluate([alarm], truth).id_error == error


def evaluate_plainly(samples: Sequence[tuple[Sequence[Accident], BoxTruth]]) -> dict[str, Any]:
    """Compute the numbers alarm by alarm.

    All alarms have ids, and no two of a sample are equally sure and early.
    """
    totals: Counter[str] = Counter()
    cases_by_distance: dict[int, Counter[str]] = {5: Counter(), 10: Counter(), 15: Counter()}
    lateness, ranked = [], []
    for alarms, truth in samples:
        has_accident = truth.accident is not None
        if has_accident and truth.accident.time == 0:
            totals["at_impact"] += 1
            continue
        totals.update(samples=1, positives=has_accident, negatives=not has_accident)
        raised = sorted(
            (alarm for alarm in alarms if alarm.score >= 0),
            key=lambda alarm: (-alarm.score, alarm.time),
        )
        within = [alarm for alarm in raised if alarm.time <= 2.05]
        judged = [
            alarm
            for alarm in within
            if has_accident or alarm.time <= (len(truth.time) - 1) / 10 + 0.05
        ]
        totals.update(beyond=len(raised) - len(within), unjudged=len(within) - len(judged))
        totals["false"] += not has_accident and len(judged) > 0
        for distance, cases in cases_by_distance.items():
            hit = None
            if has_accident:
                near = [alarm for alarm in judged if position_error(alarm) < distance]
                hit = near[0] if near else None
            cases.update(tp=hit is not None, fp=len(judged) - (hit is not None))
            cases["fn"] += has_accident and hit is None
            if hit is not None:
                late_s = hit.time - truth.accident.time
                cases.update(
                    id=set(hit.ids) != set(PAIR), position=position_error(hit), time=abs(late_s)
                )
            if distance == 10:
                lateness += [] if hit is None else [late_s]
                ranked += [(alarm.score, alarm is hit) for alarm in judged]

    area = 0.0
    for level in {score for score, _ in ranked}:
        at_level = sum(is_right for score, is_right in ranked if score == level)
        is_right_from_level = [is_right for score, is_right in ranked if score >= level]
        area += at_level * sum(is_right_from_level) / len(is_right_from_level)
    accuracy = [
        cases["tp"] / (cases["tp"] + cases["fp"] / 2 + cases["fn"] / 2)
        for cases in cases_by_distance.values()
    ]
    within_10_m = cases_by_distance[10]
    return {
        "samples": totals["samples"],
        "positives": totals["positives"],
        "negatives": totals["negatives"],
        "beyond": totals["beyond"],
        "unjudged": totals["unjudged"],
        "at_impact": totals["at_impact"],
        "tallies": [
            (cases["tp"], cases["fp"], cases["fn"]) for cases in cases_by_distance.values()
        ],
        "errors": [
            [cases[name] / cases["tp"] for name in ("id", "position", "time")]
            for cases in cases_by_distance.values()
        ],
        "accuracy": accuracy,
        "apa": sum(accuracy) / 3,
        "precision": within_10_m["tp"] / (within_10_m["tp"] + within_10_m["fp"]),
        "recall": within_10_m["tp"] / totals["positives"],
        "lateness": sum(lateness) / within_10_m["tp"],
        "average_precision": area / totals["positives"],
        "false_alarm_rate": totals["false"] / totals["negatives"],
    }


def position_error(alarm: Accident) -> float:
    """Return how far an alarm of `make_alarm` is from the crash: both positions are off alike."""
    return 2 * abs(alarm.positions[0, 0] - 16)


@pytest.mark.parametrize("seed", range(3))
def test_the_numbers_are_those_of_counting_alarm_by_alarm(seed: int) -> None:
    """Places and times lie on the bounds and next to them."""
    random = np.random.default_rng(seed)
    truths = [
        BOUNDED,
        replace(PASSING, horizon=2.0),
        make_truth([20.0] * 9, pair=None, horizon=2.0),
        IMPACT,
        SOON,
    ]
    samples = []
    for _ in range(100):
        all_times = random.permutation([0.0, 0.8, 0.84, 0.86, 1.5, 2.0, 2.04, 2.06, 3.0])
        times = all_times[: random.integers(0, 5)]
        places = [random.choice([0, 1, 2, 2.5, 3, 5, 6, 7.5, 9]) for _ in times]
        alarms = [
            make_alarm(
                x,
                time,
                score=random.choice([-0.5, 0.0, 0.25, 0.5]),
                ids=PAIR if random.random() < 0.5 else (FIRST, THIRD),
            )
            for x, time in zip(places, times, strict=True)
        ]
        samples.append((alarms, replace(truths[random.integers(5)], horizon=2.0)))

    result = BOXES.result([count_alarms(alarms, truth) for alarms, truth in samples])

    expected = evaluate_plainly(samples)
    assert read_tallies(result) == expected.pop("tallies")
    within = result.within.values()
    assert [cases.accuracy for cases in within] == pytest.approx(expected.pop("accuracy"))
    for cases, errors in zip(within, expected.pop("errors"), strict=True):
        assert [cases.id_error, cases.position_error, cases.time_error] == pytest.approx(errors)
    assert {name: getattr(result, name) for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("truth", "context", "named"),
    [
        (CRASH, META, "meta"),
        (CRASH, AccidentContext(pair=(FIRST, THIRD), known=True), "another"),
        (CRASH, AccidentContext(), "unknown"),
        (PASSING, META, "none"),
        (make_truth(np.linspace(10, 1, FRAMES)), META, "none"),
        (make_truth(np.linspace(10, 0.9, FRAMES)), META, "meta"),
    ],
)
def test_actors_that_the_boxes_bring_near(
    truth: BoxTruth, context: AccidentContext, named: str
) -> None:
    counts = count_alarms([], truth, context=context)
    assert counts["named"] == named
    assert BOXES.result([counts]).truths[named] == 1


@pytest.mark.parametrize("form", [to_instance_output, to_heads_output])
def test_maps_are_one_alarm_as_sure_as_the_share_of_them_that_see_it(form) -> None:
    cars = {1: parked_path(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
    right = motion_labels_of(cars)
    calm = motion_labels_of({1: cars[1]})
    other = motion_labels_of(shift_cars(cars, y=2))
    far = motion_labels_of(shift_cars(cars, y=20))

    for maps, score, position in (
        ([calm, right, right, calm], 0.5, 0.5),
        ([right, other], 1, 4.5),
        ([other, right], 1, 0.5),
    ):
        alarms = count_alarms(form(*maps), CRASH)["alarms"]
        expected = {
            "score": score,
            "time": 0,
            "id": 0,
            "position": pytest.approx(position, abs=0.5),
        }
        assert alarms == [expected]
    assert count_alarms(form(calm), CRASH)["alarms"] == []
    assert count_alarms(form(far), CRASH)["alarms"][0]["id"] == 1


@pytest.mark.parametrize(
    "follower",
    [
        [(15.0 + 2.5 * frame, 12.5) for frame in range(5)],
        [(16.0 - gap, 10.0) for gap in (10, 7.5, 5, 2.5, 0)],
    ],
)
def test_side_by_side_is_an_accident_in_maps_only_by_the_papers_reading(follower) -> None:
    """Cells of neighbours are 0.5 m apart, as are cells of two cars that touch squarely along the
    grid.
    """
    maps = to_instance_output(motion_labels_of({1: parked_path(20, 10), 2: follower}))
    strict = BoxAccidents(reading=AccidentReading(danger_distance=0.5))
    assert len(count_alarms(maps, PASSING)["alarms"]) == 1
    assert count_alarms(maps, PASSING, strict)["alarms"] == []


def test_maps_are_not_cut_at_the_end_of_the_recording() -> None:
    """The impact is half a second ahead; the model sees it a second ahead."""
    cars = {
        1: parked_path(20, 10),
        2: [(16.0 - gap, 10.5) for gap in (2, 1.0, 0, 1.0, 2)],
    }
    result = evaluate(
        to_instance_output(motion_labels_of(cars)),
        make_truth(np.linspace(2, 0, 6), seconds=0.5),
    )
    assert (result.recall, result.lateness) == (1, 0.5)


def test_what_is_left_out_is_counted_and_noted() -> None:
    complete = [count_alarms([make_alarm()], CRASH), count_alarms([], PASSING)]
    beyond = count_alarms([make_alarm(time=9.0)], BOUNDED)
    assert beyond == {
        "positive": True,
        "named": "meta",
        "alarms": [],
        "unjudged": 0,
        "beyond": 1,
        "at_impact": False,
        "unplaced": False,
    }

    result = BOXES.result(
        [
            *complete,
            count_alarms([make_alarm(time=0.0)], IMPACT),
            count_alarms([make_alarm(time=1.0)], LOST),
            beyond,
        ]
    )
    assert result.notes == (
        UNPLACED_NOTE.format("1 sample"),
        "not counted: 1 alarm of an accident beyond the horizon",
    )
    left_out = {"at_impact": 0, "unplaced": 0, "notes": result.notes[1:]}
    assert replace(result, **left_out) == BOXES.result([*complete, beyond])

    # counts that earlier versions kept do not say what was unplaced
    for counts in (complete, BOXES.pooled(complete)):
        old_counts = []
        for sample in counts:
            old_counts.append({name: sample[name] for name in sample if name != "unplaced"})
        assert BOXES.result(old_counts) == BOXES.result(complete)


def test_what_cannot_be_evaluated() -> None:
    assert_raises(
        (
            lambda: BOXES.counts([make_alarm()], None, META),
            EvaluationError,
            ("accident_context", "horizon=2.0"),
        ),
        (lambda: count_alarms([(1, 2)], CRASH), EvaluationError, ("list of Accidents", "tuple")),
    )
