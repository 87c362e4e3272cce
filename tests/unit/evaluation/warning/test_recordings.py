"""Counts of a sample, recordings made of samples by hand, scores by column, and how long alarms
last.
"""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal
from support.accident_scenes import (
    motion_labels_of,
    parked_path,
    to_heads_output,
    to_instance_output,
)
from support.expected_errors import assert_raises

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
    surest_scores,
    twin_pairs,
)

PAIR = (11, 22)
COLLISION_POSITIONS = np.array([[20.0, 10.0], [16.0, 10.0]])
# The recorded frame of the impact, or of the recording's end; samples are half a second apart.
LAST_FRAME = 61


def make_alarm(x=0.0, score=1.0, time=1.0, ids=None) -> Accident:
    """Make an alarm for the collision, with both positions `x` metres farther ahead."""
    return Accident(
        positions=COLLISION_POSITIONS + np.array([x, 0.0]),
        time=time,
        score=score,
        ids=ids,
    )


RIGHT = make_alarm(ids=PAIR)
FALSE = make_alarm(x=50, ids=(33, 44))


def make_context(frame, kind="accident", horizon=math.inf, **changes) -> AccidentContext:
    """Make the context of two cars that stand where they collide; their boxes are known for 2 s."""
    seconds = (LAST_FRAME - frame) / 10
    moments = min(20, LAST_FRAME - frame) + 1
    boxes = np.concatenate([COLLISION_POSITIONS, [[4.0, 2.0, 0.0]] * 2], axis=1)
    impact = None
    if kind == "accident":
        impact = Accident(positions=COLLISION_POSITIONS, time=seconds, ids=PAIR)
    truth = BoxTruth(
        time=np.arange(moments) / 10,
        actor_id=np.array(PAIR),
        footprint=np.tile(boxes, (moments, 1, 1)),
        accident=impact if seconds <= 2 else None,
        impact=impact,
        horizon=horizon,
        unplaced=seconds if kind == "unplaced" else None,
    )
    fields = {
        "pair": PAIR if impact else None,
        "time_to_impact": seconds if kind in ("accident", "unplaced") else None,
        "time_to_end": seconds,
        "twin": {"accident": False, "twins": True}.get(kind),
        **changes,
    }
    return AccidentContext(known=True, truth=truth, **fields)


def count_sample(prediction, context, label=None):
    return sample_counts("t/s/ego_vehicle/041", prediction, label, context)


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
CARS = {1: parked_path(20, 10), 2: [(16.0 - gap, 10.5) for gap in (10, 7.5, 5, 2.5, 0)]}
HIT = motion_labels_of(CARS)
CALM = motion_labels_of({1: CARS[1]})
TWIN = {"kind": "twins", "ahead": None}


@pytest.mark.parametrize(
    ("prediction", "context", "expected"),
    [
        ([make_alarm(ids=(22, 11))], make_context(51), {"alarms": [[1, 1]]}),
        ([make_alarm(x=50, ids=PAIR)], make_context(51), {"alarms": [[1, 1]]}),
        # the place is right
        ([make_alarm(ids=(11, 33))], make_context(51), {"alarms": [[1, 1]]}),
        ([make_alarm(x=50, ids=(11, 33))], make_context(51), {"alarms": [[1, 0]]}),
        # without ids the boxes at that time count
        ([make_alarm(x=4.5)], make_context(51), {"alarms": [[1, 1]]}),
        # the differences of both positions add up to 10 m
        ([make_alarm(x=5)], make_context(51), {"alarms": [[1, 0]]}),
        ([make_alarm(x=4.9999, ids=(11, 33))], make_context(51), {"alarms": [[1, 1]]}),
        ([make_alarm(x=5, ids=(11, 33))], make_context(51), {"alarms": [[1, 0]]}),
        # the time of the alarm does not matter
        ([make_alarm(time=1.6, ids=PAIR)], make_context(51), {"alarms": [[1, 1]]}),
        (
            # the impact is later than the boxes are known
            [make_alarm(time=2.0)],
            make_context(21),
            {"ahead": 40, "to_end": 40, "alarms": [[1, 1]]},
        ),
        (
            [replace(FALSE, score=0.5), RIGHT],
            make_context(41, "twins", time_to_twin_impact=1.5),
            TWIN | {"to_end": 15, "alarms": [[1, 0], [0.5, 0]]},
        ),
        ([], make_context(41, "twins", time_to_twin_impact=-0.5), TWIN | {"to_end": -5}),
        ([], make_context(41, "others"), {"kind": "others", "ahead": None, "to_end": None}),
        (
            # alarms for up to half a recorded frame after the end can be judged
            [
                replace(FALSE, time=1.04),
                replace(FALSE, time=1.06, score=0.25),
            ],
            make_context(51, "others", involvement="bystander"),
            {
                "kind": "others",
                "ahead": None,
                "to_end": None,
                "alarms": [[1, 0]],
                "unjudged": [0.25],
                "involvement": "bystander",
            },
        ),
        ([replace(FALSE, time=9.0)], make_context(51), {"alarms": [[1, 0]]}),
        ([RIGHT], make_context(51, "unplaced"), {"kind": "unplaced", "alarms": [[1, 0]]}),
        (
            # without a horizon no time is too late
            [make_alarm(time=900.0, ids=PAIR)],
            make_context(31),
            {"ahead": 30, "to_end": 30, "alarms": [[1, 1]]},
        ),
        ([make_alarm(time=2.04, ids=PAIR)], make_context(51, horizon=2.0), {"alarms": [[1, 1]]}),
        (
            [make_alarm(time=2.06, ids=PAIR), RIGHT],
            make_context(51, horizon=2.0),
            {"alarms": [[1, 1]], "beyond": 1},
        ),
        (
            [],
            make_context(51, references={"one": (FALSE, replace(RIGHT, score=0.5)), "none": ()}),
            {"references": [[0.5, 1.0], [None, None]]},
        ),
        # maps are as sure as the share of them with the accident
        (to_instance_output(CALM, HIT), make_context(51), {"alarms": [[0.5, 1]]}),
        (to_heads_output(HIT, CALM), make_context(51), {"alarms": [[0.5, 1]]}),
    ],
)
def test_counts_of_a_sample(prediction, context, expected) -> None:
    assert count_sample(prediction, context, HIT) == COUNTS | expected


def test_what_cannot_be_counted() -> None:
    context = make_context(41)
    assert_raises(
        *(
            (
                partial(sample_counts, token, [], None, context),
                EvaluationError,
                ("token", repr(token)),
            )
            for token in ("s/ego_vehicle/x", 41, "041")
        ),
        (
            lambda: count_sample(RIGHT, context),
            EvaluationError,
            ("wrap a single Accident in a list",),
        ),
        (
            lambda: count_sample([], AccidentContext()),
            EvaluationError,
            ("accident_context", "horizon=2.0"),
        ),
        (
            lambda: count_sample([], replace(context, time_to_end=None)),
            EvaluationError,
            ("accident_context",),
        ),
    )


def test_the_surest_right_alarm_and_the_surest() -> None:
    alarms = [[0.2, True], [0.9, False], [0.6, True]]
    assert surest_scores(alarms, "accident") == [0.6, 0.9]
    assert surest_scores(alarms[1:2], "accident") == [None, 0.9]
    assert surest_scores(alarms, "twins") == [0.9, 0.9]
    assert surest_scores([], "accident") == [None, None]


def make_counts(
    frame: int, kind: str = "accident", name: str = "t_accident/s/a", **changes: Any
) -> dict[str, Any]:
    return {
        **COUNTS,
        "recording": name,
        "frame": frame,
        "kind": kind,
        "to_end": None,
        "involvement": "ego_involved",
        **changes,
    }


CRASH = [
    make_counts(7, to_end=16, alarms=[[0.9, 0], [0.4, 1]], references=[[0.2, 0.6], [None, 0.5]]),
    make_counts(2, to_end=21, alarms=[[0.3, 1]], unjudged=[0.7]),
    make_counts(17, to_end=6),
]
TWINS = [
    make_counts(frame, "twins", "t_normal/s/a", to_end=26 - frame, alarms=[[0.5, 0]])
    for frame in (6, 11, 16, 21, 26, 31)
]
OTHERS = [
    make_counts(frame, "others", "n/o/a", unjudged=[0.8], beyond=2, involvement=None)
    for frame in (1, 11, 31)
]
LOST = [make_counts(3, "unplaced", "t_accident/z/a")]
ALL_SAMPLES = [*TWINS, *CRASH, *OTHERS, *LOST]
NO_ALARM = -math.inf
GAP = math.nan


def test_columns_are_steps_from_the_first_sample() -> None:
    recordings = recordings_of([ALL_SAMPLES])
    descriptions = [
        (
            recording.name,
            recording.story,
            recording.group,
            recording.kind,
            recording.part,
            recording.end,
        )
        for recording in recordings
    ]
    assert descriptions == [
        ("n/o/a", "n/o/a", "unknown", "others", 0, 32),
        ("t_accident/s/a", "t/s/a", "ego_involved", "accident", 0, 23),
        ("t_normal/s/a", "t/s/a", "ego_involved", "twins", 0, 26),
    ]
    other_row = [0.8, GAP, 0.8, GAP, GAP, GAP, 0.8]
    twin_row = [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, GAP]
    rows = {
        ("given", "pair"): [other_row, [0.3, 0.4, GAP, NO_ALARM, GAP, GAP, GAP], twin_row],
        ("given", "recording"): [other_row, [0.7, 0.9, GAP, NO_ALARM, GAP, GAP, GAP], twin_row],
        (REFERENCES[0], "pair"): [NO_ALARM, 0.2, GAP, NO_ALARM, GAP, GAP, GAP],
        (REFERENCES[0], "recording"): [NO_ALARM, 0.6, GAP, NO_ALARM, GAP, GAP, GAP],
        (REFERENCES[1], "pair"): [NO_ALARM, NO_ALARM, GAP, NO_ALARM, GAP, GAP, GAP],
        (REFERENCES[1], "recording"): [NO_ALARM, 0.5, GAP, NO_ALARM, GAP, GAP, GAP],
        ("always", "pair"): [1.0, 1.0, GAP, 1.0, GAP, GAP, GAP],
        ("never", "pair"): [NO_ALARM, NO_ALARM, GAP, NO_ALARM, GAP, GAP, GAP],
    }
    for (predictor, scores_of), expected in rows.items():
        scores = series_of(recordings, predictor, scores_of).scores
        assert_array_equal(scores if predictor == "given" else scores[1], expected)

    series = series_of(recordings, "given", "pair")
    assert series.positive.tolist() == [False, True, False]
    # the first recording is cut at the accident's length
    assert series.toa.tolist() == [(23 - 2) / 5, (23 - 2) / 5, (26 - 6) / 5]
    assert series.fps == pytest.approx(2.0)
    assert series.valid.sum(axis=1).tolist() == [2, 3, 4]
    assert series.highest().tolist() == [0.8, 0.4, 0.5]


def test_random_predictors_draw_anew_for_each_recording_and_draw_and_frame() -> None:
    recordings = recordings_of([ALL_SAMPLES])
    by_frame, by_recording, second_draw = (
        series_of(recordings, f"random per {unit}", "pair", draw).scores
        for unit, draw in (("frame", 1), ("recording", 1), ("frame", 2))
    )
    is_score = np.isfinite(by_frame)
    both_draws = np.concatenate([by_frame[is_score], second_draw[is_score]])
    assert len(np.unique(both_draws)) == 2 * is_score.sum()
    for row in by_recording:
        assert len(np.unique(row[np.isfinite(row)])) == 1
    assert len(np.unique(by_recording[is_score])) == len(by_recording) == 3
    assert_array_equal(
        series_of(recordings, "random per frame", "pair", 1).scores,
        by_frame,
    )


def test_twins_are_paired_within_their_part() -> None:
    recordings = recordings_of([ALL_SAMPLES, [*CRASH, *OTHERS], TWINS])
    assert [recording.part for recording in recordings] == [0, 0, 0, 1, 1, 2]
    assert twin_pairs(recordings).tolist() == [[1, 2]]
    assert twin_pairs([]).shape == (0, 2)


def test_what_is_left_out_is_noted() -> None:
    unplaced, beyond = left_out_notes(ALL_SAMPLES)
    assert unplaced.startswith("excluded: 1 sample of accidents in which no label shows both")
    assert beyond == "not counted: 6 alarms of an accident beyond the horizon"
    assert list(left_out_notes(CRASH)) == []


def test_other_recordings_end_with_the_longest_accident_or_sooner() -> None:
    def make_series(*counts: dict[str, Any]) -> ScoreSeries:
        return series_of(recordings_of([counts]), "given", "pair")

    # without an accident in steps of ten frames
    assert make_series(*OTHERS).toa.tolist() == [3.1]
    series = make_series(
        OTHERS[0],
        make_counts(2, "others", "n/o/a"),
        *CRASH,
    )
    assert series.toa.tolist() == [2.0, 21.0]
    assert series.fps == pytest.approx(10)
    longer = [make_counts(frame, name="t_accident/z/a", to_end=101 - frame) for frame in (7, 2, 17)]
    assert make_series(*OTHERS, *CRASH, *longer).toa[0] == pytest.approx(31 / 5)
    single = make_series(OTHERS[0])
    assert (single.scores.tolist(), single.toa.tolist()) == ([[0.8]], [1.0])
    assert single.fps == pytest.approx(10)
    assert make_series(*CRASH).fps == pytest.approx(2.0)

    uneven = recordings_of([[make_counts(frame, "others") for frame in (1, 4, 9)]])
    is_score = np.isfinite(series_of(uneven, "always", "pair").scores)
    assert is_score.tolist() == [[True, True, False, True]]
    assert series_of([], "given", "pair").scores.shape == (0, 1)


def test_a_recording_has_ten_thousand_frames_at_most() -> None:
    first = make_counts(0)
    assert recordings_of([[first, make_counts(10_000)]])[0].end == 10_001
    assert_raises(
        (
            lambda: recordings_of([[first, make_counts(10_001)]]),
            EvaluationError,
            ("t_accident/s/a", "10,000", "0 to 10001"),
        ),
        (
            lambda: recordings_of([[first, make_counts(-1)]]),
            EvaluationError,
            ("t_accident/s/a", "10,000", "-1 to 0"),
        ),
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
    assert_array_equal(
        series.leads(thresholds),
        [[2.0, 1.5, 1.5, GAP, GAP]],
    )
    assert_array_equal(
        series.before(2.5),
        [[0.5, GAP, 0.5, 0.1, GAP]],
    )
    assert_array_equal(series.before(0.5), [[0.5]])
    assert series.before(0.9).shape == (1, 2)


alarm_arrays = arrays(bool, st.tuples(st.integers(0, 4), st.integers(0, 9)))
ROWS = np.array([[1, 1, 0, 1, 1, 1], [0, 0, 0, 0, 0, 0], [1, 0, 1, 0, 1, 1]]) > 0


def test_runs_last_and_cost_what_is_left_of_them_after_the_reaction() -> None:
    runs = AlarmRuns.of(ROWS, 2.0)
    assert runs.row.tolist() == [0, 0, 2, 2, 2]
    assert runs.begin.tolist() == [0, 3, 0, 2, 4]
    assert runs.length.tolist() == [2, 3, 1, 1, 2]
    assert runs.braking_seconds(0.5).tolist() == [1.5, 0, 0.5]
    assert runs.braking_seconds(1.0).tolist() == [0.5, 0, 0]
    assert runs.first_lasting(0.5).tolist() == [0, 6, 4]
    assert runs.first_lasting(1.0).tolist() == [3, 6, 6]


@given(alarm_arrays, alarm_arrays, st.sampled_from((0.0, 0.5, 1.0)))
def test_alarms_that_last_cost_something_and_fewer_never_more(
    alarm: np.ndarray, other: np.ndarray, reaction: float
) -> None:
    """The cost therefore never rises with the threshold, so that the lowest threshold within a
    budget can be found by bisection.
    """
    runs = AlarmRuns.of(alarm, 2.0)
    costs = runs.braking_seconds(reaction)
    has_lasting_alarm = runs.first_lasting(reaction) < alarm.shape[1]
    assert ((costs > 0) == has_lasting_alarm).all()
    if alarm.shape == other.shape:
        fewer = AlarmRuns.of(alarm & other, 2.0)
        assert (fewer.braking_seconds(reaction) <= costs).all()
