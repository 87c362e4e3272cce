"""The protocol `boxes`: alarms against the boxes of a truth made by hand, and those of a
release.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from accident_scenes import as_heads, as_maps, scene, standing
from refusals import assert_refused

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.accident import BoxTruth
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.map_accidents import AccidentReading
from deepaccident_devkit.evaluation.predictions import Accident
from deepaccident_devkit.evaluation.truth import UNPLACED_NOTE, AccidentContext

BOXES = BoxAccidents()
STEPS = 21
FIRST, SECOND, THIRD = 11, 22, 33
PAIR = (FIRST, SECOND)


def truth_of(gaps, pair=PAIR, seconds=2.0, at=None, **more) -> BoxTruth:
    """A car at (20, 10), one behind it with these gaps every tenth of a second, and others that
    stand `at` places.
    """
    count = len(gaps)
    rows = {
        FIRST: np.tile([20.0, 10.0], (count, 1)),
        SECOND: np.column_stack([20.0 - 4.0 - np.array(gaps), np.full(count, 10.0)]),
        **{actor: np.tile(place, (count, 1)) for actor, place in (at or {}).items()},
    }
    centers = np.stack([rows[actor] for actor in sorted(rows)], axis=1)
    boxes = np.concatenate(
        [centers, np.broadcast_to([4.0, 2.0, 0.0], (*centers.shape[:2], 3))], axis=-1
    )
    accident = None
    if pair:
        accident = Accident(
            positions=np.array([rows[actor][-1] for actor in pair]), time=seconds, ids=pair
        )
    columns = {
        "time": np.arange(count) / 10,
        "actor_id": np.array(sorted(rows)),
        "footprint": boxes,
    }
    return BoxTruth(**columns, accident=accident, **more)


CRASH = truth_of(np.linspace(10, 0, STEPS))
BOUNDED = replace(CRASH, horizon=2.0)
PASSING = truth_of(np.linspace(20, 10, STEPS), pair=None)
IMPACT = truth_of([0.0], seconds=0.0)
SOON = truth_of([0.5, 0.0], seconds=0.1)
LOST = replace(PASSING, unplaced=1.0, horizon=2.0)
BESIDE = truth_of(np.linspace(10, 0, STEPS), at={THIRD: (16.0, 12.0)})
LEFT = truth_of(np.linspace(10, 0, STEPS), at={THIRD: (16.0, 10.0)})
LEFT = replace(
    LEFT,
    footprint=np.where(
        np.arange(3)[:, None] < 2 + (LEFT.time[:, None, None] < 1.95), LEFT.footprint, np.nan
    ),
)
NOBODY = replace(CRASH, footprint=np.full_like(CRASH.footprint, np.nan))
META = AccidentContext(pair=(SECOND, FIRST), known=True)


def alarm(x=0.0, time=2.0, score=1.0, ids=None) -> Accident:
    """Of the crash, both `x` metres farther ahead than they are."""
    return Accident(
        positions=np.array([[16.0 + x, 10.0], [20.0 + x, 10.0]]), time=time, score=score, ids=ids
    )


def lateral(y: float) -> Accident:
    """Of the crash, the second one so many metres to the left."""
    return Accident(positions=np.array([[20.0, 10.0], [16.0, 10.0 + y]]), time=2.0)


def counted(prediction, truth, protocol=BOXES, context=META):
    return protocol.counts(prediction, None, replace(context, truth=truth))


def result(prediction, truth, protocol=BOXES):
    return protocol.result([counted(prediction, truth, protocol)])


def tallies(made) -> list[tuple[int, int, int]]:
    return [(each.tp, each.fp, each.fn) for each in made.within.values()]


THREE = [alarm(1, time=1.5, score=0.6), alarm(40, score=0.9), alarm(2, time=2.5, score=0.7)]


@pytest.mark.parametrize(
    ("alarms", "truth", "expected"),
    [
        (
            [alarm(ids=PAIR)],
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
            [*THREE, alarm(0, score=-0.1)],
            CRASH,
            {"precision": pytest.approx(1 / 3), "position_error": 4},
        ),
        (
            [alarm(40, time=1.0, score=0.5), alarm(0, score=0.5)],
            CRASH,
            {"average_precision": 0.5},
        ),  # one step
        (
            [alarm(time=1.0)],
            PASSING,
            {"apa": math.nan, "recall": None, "false_alarm_rate": 1, "unjudged": 0},
        ),
        ([alarm(time=2.04)], PASSING, {"unjudged": 0, "false_alarm_rate": 1}),
        (
            [alarm(time=2.06)],
            PASSING,
            {"unjudged": 1, "false_alarm_rate": 0},
        ),  # the recording cannot refute it
        ([alarm(time=900.0)], BOUNDED, {"apa": 0, "precision": None, "recall": 0, "beyond": 1}),
        ([alarm(time=2.04)], BOUNDED, {"apa": 1, "beyond": 0}),
        ([alarm(time=2.06)], BOUNDED, {"apa": 0, "beyond": 1}),
        ([alarm(time=900.0, score=0.9), alarm(score=0.5)], BOUNDED, {"apa": 1, "beyond": 1}),
        (
            [alarm(time=0.0)],
            IMPACT,
            {"samples": 0, "at_impact": 1, "apa": math.nan, "precision": None},
        ),
        ([alarm(time=0.1)], SOON, {"samples": 1, "at_impact": 0, "apa": 1}),
        ([alarm(time=1.0)], LOST, {"samples": 0, "unplaced": 1, "precision": None}),
        (
            [alarm(time=1.0)],
            replace(LOST, horizon=0.5),
            {"samples": 1, "unplaced": 0},
        ),  # it comes later
    ],
)
def test_what_alarms_score(alarms, truth, expected) -> None:
    made = result(alarms, truth)
    assert {name: getattr(made, name) for name in expected} == pytest.approx(expected, nan_ok=True)
    assert [math.isnan(each.accuracy) for each in made.within.values()] == [
        math.isnan(made.apa)
    ] * 3


@pytest.mark.parametrize(
    ("raised", "truth", "error"),
    [
        (alarm(ids=(SECOND, FIRST)), CRASH, 0),
        (alarm(ids=(FIRST, THIRD)), CRASH, 1),
        (alarm(), CRASH, 0),
        (alarm(x=-1.9), CRASH, 0),
        (alarm(), BESIDE, 0),
        (lateral(1.1), BESIDE, 1),  # the other car is nearer
        (alarm(time=1.9), LEFT, 1),  # then the other was there
        (alarm(time=2.0), LEFT, 0),
        (alarm(time=7.0), CRASH, 0),  # later than the truth goes on: at its last moment
        (
            Accident(positions=np.array([[20.0, 10.0], [18.5, 10.0]]), time=2.0),
            CRASH,
            0,
        ),  # two name two
        (alarm(), NOBODY, 1),
    ],
)
def test_whom_an_alarm_names(raised: Accident, truth: BoxTruth, error: int) -> None:
    """Without ids the nearest boxes at its time."""
    assert result([raised], truth).id_error == error


def plain(samples: Sequence[tuple[Sequence[Accident], BoxTruth]]) -> dict[str, Any]:
    """The numbers, alarm by alarm; each has ids, and no two of a sample are equally sure and
    early.
    """
    made: Counter[str] = Counter()
    cases, late, ranked = [Counter() for _ in range(3)], [], []
    for given, truth in samples:
        if truth.accident is not None and truth.accident.time == 0:
            made["at_impact"] += 1
            continue
        made.update(
            samples=1,
            positives=int(truth.accident is not None),
            negatives=int(truth.accident is None),
        )
        raised = sorted(
            (each for each in given if each.score >= 0), key=lambda each: (-each.score, each.time)
        )
        within = [each for each in raised if each.time <= 2.05]
        judged = [
            each
            for each in within
            if truth.accident is not None or each.time <= (len(truth.time) - 1) / 10 + 0.05
        ]
        made.update(beyond=len(raised) - len(within), unjudged=len(within) - len(judged))
        made["false"] += truth.accident is None and len(judged) > 0
        off = [
            np.inf if truth.accident is None else 2 * abs(each.positions[0, 0] - 16)
            for each in judged
        ]
        for counter, distance in zip(cases, (5, 10, 15), strict=True):
            hit = next((at for at, each in enumerate(off) if each < distance), None)
            counter.update(tp=hit is not None, fp=len(judged) - (hit is not None))
            counter["fn"] += truth.accident is not None and hit is None
            if hit is not None:
                apart = judged[hit].time - truth.accident.time
                counter.update(
                    id=set(judged[hit].ids) != set(PAIR), position=off[hit], time=abs(apart)
                )
            if distance == 10:
                late += [] if hit is None else [apart]
                ranked += [(each.score, at == hit) for at, each in enumerate(judged)]
    levels = sorted({score for score, _ in ranked}, reverse=True)
    area = sum(
        sum(right for score, right in ranked if score == level)
        * sum(right for score, right in ranked if score >= level)
        / sum(score >= level for score, _ in ranked)
        for level in levels
    )
    accuracy = [each["tp"] / (each["tp"] + each["fp"] / 2 + each["fn"] / 2) for each in cases]
    at = cases[1]
    return {
        **{
            name: made[name]
            for name in ("samples", "positives", "negatives", "beyond", "unjudged", "at_impact")
        },
        "tallies": [(each["tp"], each["fp"], each["fn"]) for each in cases],
        "errors": [
            [each[name] / each["tp"] for name in ("id", "position", "time")] for each in cases
        ],
        "accuracy": accuracy,
        "apa": sum(accuracy) / 3,
        "precision": at["tp"] / (at["tp"] + at["fp"]),
        "recall": at["tp"] / made["positives"],
        "lateness": sum(late) / at["tp"],
        "average_precision": area / made["positives"],
        "false_alarm_rate": made["false"] / made["negatives"],
    }


@pytest.mark.parametrize("seed", range(3))
def test_the_numbers_are_those_of_counting_alarm_by_alarm(seed: int) -> None:
    """Places and moments at which the bounds are, and next to them."""
    source = np.random.default_rng(seed)
    truths = [
        BOUNDED,
        replace(PASSING, horizon=2.0),
        truth_of([20.0] * 9, pair=None, horizon=2.0),
        IMPACT,
        SOON,
    ]
    samples = []
    for _ in range(100):
        times = source.permutation([0.0, 0.8, 0.84, 0.86, 1.5, 2.0, 2.04, 2.06, 3.0])[
            : source.integers(0, 5)
        ]
        places = [source.choice([0, 1, 2, 2.5, 3, 5, 6, 7.5, 9]) for _ in times]
        alarms = [
            alarm(
                x,
                time,
                source.choice([-0.5, 0.0, 0.25, 0.5]),
                PAIR if source.random() < 0.5 else (FIRST, THIRD),
            )
            for x, time in zip(places, times, strict=True)
        ]
        samples.append((alarms, replace(truths[source.integers(5)], horizon=2.0)))
    made = BOXES.result([counted(*each) for each in samples])
    expected, within = plain(samples), made.within.values()
    assert tallies(made) == expected.pop("tallies")
    assert [each.accuracy for each in within] == pytest.approx(expected.pop("accuracy"))
    for each, errors in zip(within, expected.pop("errors"), strict=True):
        assert [each.id_error, each.position_error, each.time_error] == pytest.approx(errors)
    assert {name: getattr(made, name) for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("truth", "context", "named"),
    [
        (CRASH, META, "meta"),
        (CRASH, AccidentContext(pair=(FIRST, THIRD), known=True), "another"),
        (CRASH, AccidentContext(), "unknown"),
        (PASSING, META, "none"),
        (truth_of(np.linspace(10, 1, STEPS)), META, "none"),
        (truth_of(np.linspace(10, 0.9, STEPS)), META, "meta"),
    ],
)
def test_whom_the_boxes_bring_near(truth: BoxTruth, context: AccidentContext, named: str) -> None:
    assert counted([], truth, context=context)["named"] == named
    assert BOXES.result([counted([], truth, context=context)]).truths[named] == 1


@pytest.mark.parametrize("form", [as_maps, as_heads])
def test_maps_are_one_alarm_as_sure_as_the_share_of_them_that_see_it(form) -> None:
    cars = {1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
    right, calm, other, away = (
        scene(each)
        for each in (
            cars,
            {1: cars[1]},
            *(
                {name: [(x, y + off) for x, y in path] for name, path in cars.items()}
                for off in (2, 20)
            ),
        )
    )
    for maps, score, position in (
        ([calm, right, right, calm], 0.5, 0.5),
        ([right, other], 1, 4.5),
        ([other, right], 1, 0.5),
    ):
        [found] = counted(form(*maps), CRASH)["alarms"]
        assert found == {
            "score": score,
            "time": 0,
            "id": 0,
            "position": pytest.approx(position, abs=0.5),
        }
    assert counted(form(calm), CRASH)["alarms"] == []
    assert counted(form(away), CRASH)["alarms"][0]["id"] == 1


@pytest.mark.parametrize(
    "follower",
    [
        [(15.0 + 2.5 * frame, 12.5) for frame in range(5)],
        [(16.0 - gap, 10.0) for gap in (10, 7.5, 5, 2.5, 0)],
    ],
)
def test_side_by_side_is_an_accident_in_maps_by_the_papers_reading_alone(follower) -> None:
    """Cells of neighbours are 0.5 m apart, and so are those of two that touch squarely along the
    grid.
    """
    maps = as_maps(scene({1: standing(20, 10), 2: follower}))
    stricter = BoxAccidents(reading=AccidentReading(danger_distance=0.5))
    assert [len(counted(maps, PASSING, rules)["alarms"]) for rules in (BOXES, stricter)] == [1, 0]


def test_maps_are_not_cut_at_the_end_of_the_recording() -> None:
    """The impact is half a second ahead; the model sees it a second ahead."""
    cars = {1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (2, 1.0, 0, 1.0, 2)]}
    made = result(as_maps(scene(cars)), truth_of(np.linspace(2, 0, 6), seconds=0.5))
    assert (made.recall, made.lateness) == (1, 0.5)


def test_what_is_left_out_is_counted_and_said() -> None:
    kept = [counted([alarm()], CRASH), counted([], PASSING)]
    counts = [
        *kept,
        *(
            counted([alarm(time=time)], each)
            for time, each in ((0.0, IMPACT), (1.0, LOST), (9.0, BOUNDED))
        ),
    ]
    assert counts[-1] == {
        "positive": True,
        "named": "meta",
        "alarms": [],
        "unjudged": 0,
        "beyond": 1,
        "at_impact": False,
        "unplaced": False,
    }
    made = BOXES.result(counts)
    assert made.notes == (
        UNPLACED_NOTE.format("1 sample"),
        "not counted: 1 alarm for later than the horizon",
    )
    left_out = {"at_impact": 0, "unplaced": 0, "notes": made.notes[1:]}
    assert replace(made, **left_out) == BOXES.result([*kept, counts[-1]])
    for now in (
        kept,
        BOXES.pooled(kept),
    ):  # counts that earlier versions kept do not say what was unplaced
        before = [
            {name: value for name, value in each.items() if name != "unplaced"} for each in now
        ]
        assert BOXES.result(before) == BOXES.result(kept)


def test_what_cannot_be_evaluated() -> None:
    assert_refused(
        (
            lambda: BOXES.counts([alarm()], None, META),
            EvaluationError,
            ("accident_context", "horizon=2.0"),
        ),
        (lambda: counted([(1, 2)], CRASH), EvaluationError, ("list of Accidents", "tuple")),
    )
