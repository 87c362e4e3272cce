"""What a sample adds, recordings made of samples by hand, scores by column, and how long alarms
last.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from accident_scenes import as_heads, as_maps, scene, standing
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal
from refusals import assert_refused

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.evaluation.accident import AccidentContext, BoxTruth
from deepaccident_devkit.evaluation.warning import ScoreSeries
from deepaccident_devkit.evaluation.warning.recordings import (
    REFERENCES,
    AlarmRuns,
    left_out_notes,
    recordings_of,
    sample_counts,
    series_of,
    surest,
    twin_pairs,
)

PAIR = (11, 22)
MEETING = np.array([[20.0, 10.0], [16.0, 10.0]])
LAST = 61
"""The recorded frame of the impact, or of the recording's end; samples are half a second apart."""


def alarm(x=0.0, score=1.0, time=1.0, ids=None) -> Accident:
    """At the meeting place, both positions `x` metres farther ahead."""
    return Accident(positions=MEETING + np.array([x, 0.0]), time=time, score=score, ids=ids)


RIGHT, FALSE = alarm(ids=PAIR), alarm(x=50, ids=(33, 44))


def context(frame, kind="accident", horizon=math.inf, **more) -> AccidentContext:
    """Two stand apart where they will meet; the boxes are known for 2 s."""
    ahead, moments = (LAST - frame) / 10, min(20, LAST - frame) + 1
    boxes = np.concatenate([MEETING, [[4.0, 2.0, 0.0]] * 2], axis=1)
    impact = Accident(positions=MEETING, time=ahead, ids=PAIR) if kind == "accident" else None
    truth = BoxTruth(
        time=np.arange(moments) / 10,
        actor_id=np.array(PAIR),
        footprint=np.tile(boxes, (moments, 1, 1)),
        accident=impact if ahead <= 2 else None,
        impact=impact,
        horizon=horizon,
        unplaced=ahead if kind == "unplaced" else None,
    )
    facts = {
        "pair": PAIR if impact else None,
        "time_to_impact": ahead if kind in ("accident", "unplaced") else None,
        "twin": {"accident": False, "twins": True}.get(kind),
    }
    return AccidentContext(known=True, truth=truth, time_to_end=ahead, **facts | more)


def counted(prediction, known, label=None):
    return sample_counts("t/s/ego_vehicle/041", prediction, label, known)


COUNTS = {
    "recording": "t/s/ego_vehicle",
    "frame": 41,
    "kind": "accident",
    "involvement": None,
    "ahead": 10,
    "to_end": 10,
    "alarms": [],
    "unjudged": [],
    "beyond": 0,
    "references": [],
}
MAPS = {1: standing(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
HIT, CALM = scene(MAPS), scene({1: MAPS[1]})
TWIN = {"kind": "twins", "ahead": None}


@pytest.mark.parametrize(
    ("raised", "known", "expected"),
    [
        ([alarm(ids=(22, 11))], context(51), {"alarms": [[1, 1]]}),
        ([alarm(x=50, ids=PAIR)], context(51), {"alarms": [[1, 1]]}),
        ([alarm(ids=(11, 33))], context(51), {"alarms": [[1, 1]]}),  # the place
        ([alarm(x=50, ids=(11, 33))], context(51), {"alarms": [[1, 0]]}),
        ([alarm(x=4.5)], context(51), {"alarms": [[1, 1]]}),  # without ids: the boxes at that time
        (
            [alarm(x=5)],
            context(51),
            {"alarms": [[1, 0]]},
        ),  # the differences of the two add up to 10 m
        ([alarm(x=4.9999, ids=(11, 33))], context(51), {"alarms": [[1, 1]]}),
        ([alarm(x=5, ids=(11, 33))], context(51), {"alarms": [[1, 0]]}),
        ([alarm(time=1.6, ids=PAIR)], context(51), {"alarms": [[1, 1]]}),  # at any time
        (
            [alarm(time=2.0)],
            context(21),
            {"ahead": 40, "to_end": 40, "alarms": [[1, 1]]},
        ),  # later than one looks ahead
        (
            [replace(FALSE, score=0.5), RIGHT],
            context(41, "twins", time_to_twin_impact=1.5),
            TWIN | {"to_end": 15, "alarms": [[1, 0], [0.5, 0]]},
        ),
        ([], context(41, "twins", time_to_twin_impact=-0.5), TWIN | {"to_end": -5}),
        ([], context(41, "others"), {"kind": "others", "ahead": None, "to_end": None}),
        (
            [
                replace(FALSE, time=1.04),
                replace(FALSE, time=1.06, score=0.25),
            ],  # within half a recorded frame
            context(51, "others", involvement="bystander"),
            {
                "kind": "others",
                "ahead": None,
                "to_end": None,
                "alarms": [[1, 0]],
                "unjudged": [0.25],
                "involvement": "bystander",
            },
        ),
        ([replace(FALSE, time=9.0)], context(51), {"alarms": [[1, 0]]}),
        ([RIGHT], context(51, "unplaced"), {"kind": "unplaced", "alarms": [[1, 0]]}),
        (
            [alarm(time=900.0, ids=PAIR)],
            context(31),
            {"ahead": 30, "to_end": 30, "alarms": [[1, 1]]},
        ),  # no bound
        ([alarm(time=2.04, ids=PAIR)], context(51, horizon=2.0), {"alarms": [[1, 1]]}),
        (
            [alarm(time=2.06, ids=PAIR), RIGHT],
            context(51, horizon=2.0),
            {"alarms": [[1, 1]], "beyond": 1},
        ),
        (
            [],
            context(51, references={"one": (FALSE, replace(RIGHT, score=0.5)), "none": ()}),
            {"references": [[0.5, 1.0], [None, None]]},
        ),
        (
            as_maps(CALM, HIT),
            context(51),
            {"alarms": [[0.5, 1]]},
        ),  # as sure as the share of them that see it
        (as_heads(HIT, CALM), context(51), {"alarms": [[0.5, 1]]}),
    ],
)
def test_what_a_sample_adds(raised, known, expected) -> None:
    assert counted(raised, known, HIT) == COUNTS | expected


def test_what_cannot_be_counted() -> None:
    known = context(41)
    assert_refused(
        *(
            (
                lambda token=token: sample_counts(token, [], None, known),
                EvaluationError,
                ("token", repr(token)),
            )
            for token in ("s/ego_vehicle/x", 41, "041")
        ),
        (lambda: counted(RIGHT, known), EvaluationError, ("wrap a single Accident in a list",)),
        (
            lambda: counted([], AccidentContext()),
            EvaluationError,
            ("accident_context", "horizon=2.0"),
        ),
        (
            lambda: counted([], replace(known, time_to_end=None)),
            EvaluationError,
            ("accident_context",),
        ),
    )


def test_the_surest_right_alarm_and_the_surest() -> None:
    alarms = [[0.2, True], [0.9, False], [0.6, True]]
    assert [surest(alarms, "accident"), surest(alarms[1:2], "accident")] == [
        [0.6, 0.9],
        [None, 0.9],
    ]
    assert [surest(alarms, "twins"), surest([], "accident")] == [[0.9, 0.9], [None, None]]


def counts(
    frame: int, kind: str = "accident", name: str = "t_accident/s/a", **more: Any
) -> dict[str, Any]:
    return (
        COUNTS
        | {
            "recording": name,
            "frame": frame,
            "kind": kind,
            "to_end": None,
            "involvement": "ego_involved",
        }
        | more
    )


CRASH = [
    counts(7, to_end=16, alarms=[[0.9, 0], [0.4, 1]], references=[[0.2, 0.6], [None, 0.5]]),
    counts(2, to_end=21, alarms=[[0.3, 1]], unjudged=[0.7]),
    counts(17, to_end=6),
]
TWINS = [
    counts(frame, "twins", "t_normal/s/a", to_end=26 - frame, alarms=[[0.5, 0]])
    for frame in (6, 11, 16, 21, 26, 31)
]
ALONE = [
    counts(frame, "others", "n/o/a", unjudged=[0.8], beyond=2, involvement=None)
    for frame in (1, 11, 31)
]
LOST = [counts(3, "unplaced", "t_accident/z/a")]
ALL = [*TWINS, *CRASH, *ALONE, *LOST]
LOW, GAP = -math.inf, math.nan


def test_columns_are_steps_from_the_first_sample() -> None:
    recordings = recordings_of([ALL])
    assert [
        (each.name, each.story, each.group, each.kind, each.part, each.end) for each in recordings
    ] == [
        ("n/o/a", "n/o/a", "unknown", "others", 0, 32),
        ("t_accident/s/a", "t/s/a", "ego_involved", "accident", 0, 23),
        ("t_normal/s/a", "t/s/a", "ego_involved", "twins", 0, 26),
    ]
    rows = {
        ("given", "pair"): [
            [0.8, GAP, 0.8, GAP, GAP, GAP, 0.8],
            [0.3, 0.4, GAP, LOW, GAP, GAP, GAP],
            [0.5] * 6 + [GAP],
        ],
        ("given", "recording"): [
            [0.8, GAP, 0.8, GAP, GAP, GAP, 0.8],
            [0.7, 0.9, GAP, LOW, GAP, GAP, GAP],
            [0.5] * 6 + [GAP],
        ],
        (REFERENCES[0], "pair"): [LOW, 0.2, GAP, LOW, GAP, GAP, GAP],
        (REFERENCES[0], "recording"): [LOW, 0.6, GAP, LOW, GAP, GAP, GAP],
        (REFERENCES[1], "pair"): [LOW, LOW, GAP, LOW, GAP, GAP, GAP],
        (REFERENCES[1], "recording"): [LOW, 0.5, GAP, LOW, GAP, GAP, GAP],
        ("always", "pair"): [1.0, 1.0, GAP, 1.0, GAP, GAP, GAP],
        ("never", "pair"): [LOW, LOW, GAP, LOW, GAP, GAP, GAP],
    }
    for (predictor, scores_of), expected in rows.items():
        found = series_of(recordings, predictor, scores_of).scores
        assert_array_equal(found if predictor == "given" else found[1], expected)
    pair = series_of(recordings, "given", "pair")
    assert pair.positive.tolist() == [False, True, False]
    assert pair.toa.tolist() == [
        (23 - 2) / 5,
        (23 - 2) / 5,
        (26 - 6) / 5,
    ]  # the first is cut at the accident's length
    assert (pair.fps, pair.valid.sum(axis=1).tolist()) == (pytest.approx(2.0), [2, 3, 4])
    assert pair.highest().tolist() == [0.8, 0.4, 0.5]


def test_random_predictors_draw_anew_for_each_recording_and_draw_and_frame() -> None:
    recordings = recordings_of([ALL])
    frames, whole, again = (
        series_of(recordings, f"random per {what}", "pair", draw).scores
        for what, draw in (("frame", 1), ("recording", 1), ("frame", 2))
    )
    there = np.isfinite(frames)
    assert len(np.unique(np.concatenate([frames[there], again[there]]))) == 2 * there.sum()
    assert [len(np.unique(row[np.isfinite(row)])) for row in whole] == [1, 1, 1]
    assert len(np.unique(whole[there])) == 3
    assert_array_equal(series_of(recordings, "random per frame", "pair", 1).scores, frames)


def test_twins_are_paired_within_their_part() -> None:
    recordings = recordings_of([ALL, [*CRASH, *ALONE], TWINS])
    assert [each.part for each in recordings] == [0, 0, 0, 1, 1, 2]
    assert twin_pairs(recordings).tolist() == [[1, 2]]
    assert twin_pairs([]).shape == (0, 2)


def test_what_is_left_out_is_said() -> None:
    lost, beyond = left_out_notes(ALL)
    assert lost.startswith("left out: 1 sample of accidents of which no label shows both")
    assert beyond == "not counted: 6 alarms for later than the horizon"
    assert list(left_out_notes(CRASH)) == []


def test_others_end_by_themselves_where_nobody_collides_or_sooner() -> None:
    assert series_of(recordings_of([ALONE]), "given", "pair").toa.tolist() == [
        3.1
    ]  # steps of ten frames
    alone = [*ALONE[:1], counts(2, "others", "n/o/a")]
    series = series_of(recordings_of([[*alone, *CRASH]]), "given", "pair")
    assert (series.toa.tolist(), series.fps) == ([2.0, 21.0], pytest.approx(10))
    longer = [
        counts(each["frame"], name="t_accident/z/a", to_end=101 - each["frame"]) for each in CRASH
    ]
    assert series_of(recordings_of([[*ALONE, *CRASH, *longer]]), "given", "pair").toa[
        0
    ] == pytest.approx(31 / 5)
    single = series_of(recordings_of([ALONE[:1]]), "given", "pair")
    assert (single.scores.tolist(), single.toa.tolist(), single.fps) == (
        [[0.8]],
        [1.0],
        pytest.approx(10),
    )
    assert series_of(recordings_of([CRASH]), "given", "pair").fps == pytest.approx(2.0)
    uneven = recordings_of([[counts(frame, "others") for frame in (1, 4, 9)]])
    assert np.isfinite(series_of(uneven, "always", "pair").scores).tolist() == [
        [True, True, False, True]
    ]
    assert series_of([], "given", "pair").scores.shape == (0, 1)


def test_a_recording_has_ten_thousand_frames_at_most() -> None:
    assert recordings_of([[counts(0), counts(10_000)]])[0].end == 10_001
    assert_refused(
        *(
            (
                lambda frame=frame: recordings_of([[counts(0), counts(frame)]]),
                EvaluationError,
                ("t_accident/s/a", *words),
            )
            for frame, words in ((10_001, ("10,000", "0 to 10001")), (-1, ("10,000", "-1 to 0")))
        )
    )


def test_first_scores_and_leads_at_the_threshold_itself() -> None:
    series = ScoreSeries(
        scores=np.array([[0.1, 0.5, GAP, 0.5, 0.9]]),
        positive=np.array([True]),
        toa=np.array([4.0]),
        fps=2.0,
    )
    thresholds = np.array([0.1, 0.1001, 0.5, 0.5001, 0.9])
    assert series.first(thresholds).tolist() == [[0, 1, 1, 5, 5]]
    assert_array_equal(series.leads(thresholds), [[2.0, 1.5, 1.5, GAP, GAP]])
    assert_array_equal(series.before(2.5), [[0.5, GAP, 0.5, 0.1, GAP]])
    assert_array_equal(series.before(0.5), [[0.5]])
    assert series.before(0.9).shape == (1, 2)


ALARMS = arrays(bool, st.tuples(st.integers(0, 4), st.integers(0, 9)))
ROWS = np.array([[1, 1, 0, 1, 1, 1], [0, 0, 0, 0, 0, 0], [1, 0, 1, 0, 1, 1]]) > 0


def test_runs_last_and_cost_what_is_left_of_them_after_the_reaction() -> None:
    runs = AlarmRuns.of(ROWS, 2.0)
    assert (runs.row.tolist(), runs.begin.tolist(), runs.length.tolist()) == (
        [0, 0, 2, 2, 2],
        [0, 3, 0, 2, 4],
        [2, 3, 1, 1, 2],
    )
    assert [runs.braking_seconds(reaction).tolist() for reaction in (0.5, 1.0)] == [
        [1.5, 0, 0.5],
        [0.5, 0, 0],
    ]
    assert [runs.first_lasting(reaction).tolist() for reaction in (0.5, 1.0)] == [
        [0, 6, 4],
        [3, 6, 6],
    ]


@given(ALARMS, ALARMS, st.sampled_from((0.0, 0.5, 1.0)))
def test_alarms_that_last_cost_something_and_fewer_never_more(
    alarm: np.ndarray, other: np.ndarray, reaction: float
) -> None:
    """So the cost never rises with the threshold, and the lowest within a budget can be
    bisected.
    """
    costs = AlarmRuns.of(alarm, 2.0).braking_seconds(reaction)
    assert (
        (costs > 0) == (AlarmRuns.of(alarm, 2.0).first_lasting(reaction) < alarm.shape[1])
    ).all()
    if alarm.shape == other.shape:
        assert (AlarmRuns.of(alarm & other, 2.0).braking_seconds(reaction) <= costs).all()
