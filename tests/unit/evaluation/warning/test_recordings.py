"""Scores of recordings, a column a step, of counts made by hand; where `clean` has nothing to count."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.errors import EvaluationError
from deepaccident_devkit.evaluation.warning import CleanScores, ScoreSeries
from deepaccident_devkit.evaluation.warning.clean import EARLY, SAME_RECALL, WINDOW
from deepaccident_devkit.evaluation.warning.recordings import REFERENCES, recordings_of, series_of


def counts(frame: int, kind: str = "accident", name: str = "t_accident/s/a", **more: Any) -> dict[str, Any]:
    return {
        "recording": name,
        "frame": frame,
        "kind": kind,
        "involvement": "ego_involved",
        "ahead": None,
        "to_end": None,
        "alarms": [],
        "unjudged": [],
        "beyond": 0,
        "references": [],
        **more,
    }


CRASH = [
    counts(7, to_end=16, alarms=[[0.9, 0], [0.4, 1]], references=[[0.2, 0.6], [None, 0.5]]),
    counts(2, to_end=21, alarms=[[0.3, 1]], unjudged=[0.7]),
    counts(17, to_end=6),
]
TWIN = [
    counts(frame, "twins", "t_normal/s/a", to_end=26 - frame, alarms=[[0.5, 0]]) for frame in (6, 11, 16, 21, 26, 31)
]
ALONE = [counts(frame, "others", "n/o/a", unjudged=[0.8], beyond=2) for frame in (1, 11, 31)]
ALL = [*TWIN, *CRASH, *ALONE]
LOW = -math.inf


def test_columns_are_steps_from_the_first_sample() -> None:
    recordings = recordings_of([ALL])
    assert [(each.name, each.kind, each.end) for each in recordings] == [
        ("n/o/a", "others", 32),
        ("t_accident/s/a", "accident", 23),
        ("t_normal/s/a", "twins", 26),
    ]
    pair, whole = (series_of(recordings, "given", scores_of) for scores_of in ("pair", "recording"))
    gap = math.nan
    assert_array_equal(pair.scores[0], [0.8, gap, 0.8, gap, gap, gap, 0.8])
    assert_array_equal(pair.scores[1], [0.3, 0.4, gap, LOW, gap, gap, gap])
    assert_array_equal(whole.scores[1], [0.7, 0.9, gap, LOW, gap, gap, gap])
    assert_array_equal(pair.scores[2], [0.5] * 6 + [gap])
    assert pair.positive.tolist() == [False, True, False]
    assert pair.toa.tolist() == [(23 - 2) / 5, (23 - 2) / 5, (26 - 6) / 5]  # the first is cut at the accident's length
    assert pair.fps == pytest.approx(2.0)
    assert pair.valid.sum(axis=1).tolist() == [2, 3, 4]
    assert pair.highest().tolist() == [0.8, 0.4, 0.5]
    references = [series_of(recordings, name, scores_of) for name in REFERENCES for scores_of in ("pair", "recording")]
    assert [each.scores[1, 1] for each in references] == [0.2, 0.6, LOW, 0.5]
    assert [each.scores[1, 0] for each in references] == [LOW] * 4


def test_others_end_by_themselves_where_nobody_collides_or_sooner() -> None:
    assert series_of(recordings_of([ALONE]), "given", "pair").toa.tolist() == [3.1]  # steps of ten frames
    alone = [*ALONE[:1], counts(2, "others", "n/o/a")]
    series = series_of(recordings_of([[*alone, *CRASH]]), "given", "pair")
    assert series.toa.tolist() == [2.0, 21.0]
    assert series.fps == pytest.approx(10)
    longer = [counts(each["frame"], name="t_accident/z/a", to_end=101 - each["frame"]) for each in CRASH]
    assert series_of(recordings_of([[*ALONE, *CRASH, *longer]]), "given", "pair").toa[0] == pytest.approx(31 / 5)
    single = series_of(recordings_of([ALONE[:1]]), "given", "pair")
    assert (single.scores.tolist(), single.toa.tolist(), single.fps) == ([[0.8]], [1.0], pytest.approx(10))
    assert series_of(recordings_of([CRASH]), "given", "pair").fps == pytest.approx(2.0)
    uneven = recordings_of([[counts(frame, "others") for frame in (1, 4, 9)]])
    assert np.isfinite(series_of(uneven, "always", "pair").scores).tolist() == [[True, True, False, True]]
    assert series_of([], "given", "pair").scores.shape == (0, 1)


def test_a_recording_has_ten_thousand_frames_at_most() -> None:
    assert recordings_of([[counts(0), counts(10_000)]])[0].end == 10_001
    for frame in (10_001, -1):
        with pytest.raises(
            EvaluationError, match=f"^t_accident/s/a: expected frames up to 10,000, found {min(0, frame)} to"
        ):
            recordings_of([[counts(0), counts(frame)]])


def test_first_scores_and_leads_at_the_threshold_itself() -> None:
    series = ScoreSeries(
        scores=np.array([[0.1, 0.5, math.nan, 0.5, 0.9]]), positive=np.array([True]), toa=np.array([4.0]), fps=2.0
    )
    thresholds = np.array([0.1, 0.1001, 0.5, 0.5001, 0.9])
    assert series.first(thresholds).tolist() == [[0, 1, 1, 5, 5]]
    assert_array_equal(series.leads(thresholds), [[2.0, 1.5, 1.5, math.nan, math.nan]])
    assert_array_equal(series.before(2.5), [[0.5, math.nan, 0.5, 0.1, math.nan]])
    assert_array_equal(series.before(0.5), [[0.5]])
    assert series.before(0.9).shape == (1, 2)
    assert repr(CleanScores(series)) == f"CleanScores({series!r})"


def test_the_windows_are_of_seconds() -> None:
    """Of a frame a second: 3 s and more than 5 s before the impact at 10 s; one second a minute in alarm is allowed."""
    assert (WINDOW, EARLY, SAME_RECALL) == (3.0, 5.0, 0.8)
    early = ScoreSeries(scores=np.eye(10)[[4, 5]], positive=np.ones(2, dtype=bool), toa=np.full(2, 10.0), fps=1.0)
    assert CleanScores(early).at(1.0, np.ones(2)).early_share == 0.1  # of 2 · 5 frames, that at 6 s and not that at 5 s
    quiet = np.zeros((2, 60))
    quiet[0, :2], quiet[0, 0] = 0.5, 0.9
    calm = ScoreSeries(scores=quiet, positive=np.zeros(2, dtype=bool), toa=np.full(2, 60.0), fps=1.0)
    assert math.isnan(CleanScores(calm).threshold_of_alarm_time(np.ones(2), 0.4))
    assert CleanScores(calm).threshold_of_alarm_time(np.ones(2)) == 0.9
