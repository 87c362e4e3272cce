"""`CleanScores`: figures at any threshold and with any weights, beside counting frame by frame."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit.evaluation.warning import CleanScores, ScoreSeries
from deepaccident_devkit.evaluation.warning.clean import EARLY, SAME_RECALL, WINDOW

Drive = dict[str, Any]
"""Of one recording: scores by column, label, `toa`, its highest score and that of any alarm."""


def drives_of(
    series: ScoreSeries, any_alarm: Sequence[float], weight: Sequence[int]
) -> list[Drive]:
    """Each recording as often as its weight says."""
    return [
        {
            "scores": (
                there := {at: s for at, s in enumerate(row) if not math.isnan(s) and at < toa}
            ),
            "positive": positive,
            "toa": toa,
            "highest": max(there.values(), default=-math.inf),
            "any": alarm,
        }
        for row, positive, toa, alarm, often in zip(
            series.scores.tolist(),
            series.positive.tolist(),
            series.toa.tolist(),
            any_alarm,
            weight,
            strict=True,
        )
        for _ in range(often)
    ]


def mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def area(drives: Sequence[tuple[bool, float]]) -> float:
    """The chance that an accident's score is above another's, ties half."""
    accidents, others = (
        [score for positive, score in drives if positive is kind] for kind in (True, False)
    )
    return mean(
        [(one > other) + (one == other) / 2 for one, other in itertools.product(accidents, others)]
    )


def lead(drive: Drive, threshold: float, fps: float) -> float | None:
    first = next((at for at, score in drive["scores"].items() if score >= threshold), None)
    return None if first is None else (drive["toa"] - first) / fps


def plain_point(drives: Sequence[Drive], threshold: float, fps: float) -> dict[str, float]:
    """The operating point, recording by recording."""
    leads = [(each, lead(each, threshold, fps)) for each in drives]
    seconds = [found for each, found in leads if each["positive"] and found is not None]
    accidents = [each for each in drives if each["positive"]]
    false = sum(found is not None for each, found in leads if not each["positive"])
    misled = sum(
        found is None and each["any"] >= threshold for each, found in leads if each["positive"]
    )
    calm = [
        (score >= threshold, each["scores"].get(at - 1, -math.inf) >= threshold)
        for each in drives
        if not each["positive"]
        for at, score in each["scores"].items()
    ]
    alarmed, begun = sum(now for now, _ in calm), sum(now and not before for now, before in calm)
    warned = len(seconds) + false + misled
    return {
        "threshold": threshold,
        "recall": len(seconds) / len(accidents) if accidents else math.nan,
        "precision": len(seconds) / warned if warned else math.nan,
        "tta_hit": mean(seconds),
        "tta0": sum(seconds) / len(accidents) if accidents else math.nan,
        "time_in_alarm": alarmed / len(calm) if calm else math.nan,
        "alarm_seconds_per_minute": 60 * alarmed / len(calm) if calm else math.nan,
        "episodes_per_minute": begun / (len(calm) / fps / 60) if calm else math.nan,
        "false_recordings": false,
        "early_share": mean(
            [
                score >= threshold
                for each in accidents
                for at, score in each["scores"].items()
                if (each["toa"] - at) / fps > 5 + 1e-9
            ]
        ),
    }


def plain_figures(drives: Sequence[Drive], fps: float) -> dict[str, float]:
    """The figures without a threshold, level by level and moment by moment."""
    moments = []
    for moment in range(1, round(3 * fps) + 1):
        scores = [
            (each, each["scores"].get(math.ceil(each["toa"] - moment - 1e-6))) for each in drives
        ]
        moments.append(
            area([(each["positive"], score) for each, score in scores if score is not None])
        )
    levels = sorted(
        {each["highest"] for each in drives if each["highest"] > -math.inf}, reverse=True
    )
    points = [
        plain_point([each | {"any": -math.inf} for each in drives], level, fps) for level in levels
    ]
    accidents = sum(each["positive"] for each in drives)
    found = [round(each["recall"] * accidents) if accidents else 0 for each in points]
    f1 = [
        2 * hits / (hits + each["false_recordings"] + accidents)
        for hits, each in zip(found, points, strict=True)
    ]
    gains = np.diff(found, prepend=0) / accidents if accidents else [0.0] * len(found)
    good = [at for at, each in enumerate(points) if each["precision"] >= 0.8 - 1e-9]
    quiet = [
        level
        for level, each in zip(levels, points, strict=True)
        if each["alarm_seconds_per_minute"] <= 9 + 1e-9
    ]
    return {
        "area_at_moments": mean([each for each in moments if not math.isnan(each)]),
        "area_under_curve": area([(each["positive"], each["highest"]) for each in drives]),
        "average_precision": sum(
            g * each["precision"] for g, each in zip(gains, points, strict=True) if g
        )
        if accidents
        else math.nan,
        "mean_time": sum(g * each["tta_hit"] for g, each in zip(gains, points, strict=True) if g)
        if accidents
        else math.nan,
        "threshold_of_recall": next(
            (each["threshold"] for each in points if each["recall"] >= 0.8 - 1e-9), math.nan
        ),
        "threshold_of_highest_recall": levels[int(np.argmax(found))] if any(found) else math.inf,
        "threshold_of_precision": levels[max(good, key=lambda at: (found[at], -at))]
        if good
        else math.nan,
        "threshold_of_best_f1": levels[int(np.argmax(f1))] if any(found) else math.nan,
        "threshold_of_alarm_time": min(quiet, default=math.nan),
    }


@pytest.mark.parametrize("seed", range(24))
def test_figures_are_those_of_counting_frame_by_frame(seed: int) -> None:
    source = np.random.default_rng(seed)
    count, columns, fps = 8, 14, (1.0, 2.0)[seed % 2]
    scores = source.integers(0, 12, (count, columns)) / 11
    scores[source.random(scores.shape) < 0.2] = math.nan
    scores[source.random(scores.shape) < 0.5] = -math.inf
    positive = source.random(count) < (0.5, 0.5, 0.0, 1.0)[seed // 2 % 4]
    series = ScoreSeries(
        scores=scores, positive=positive, toa=source.integers(6, 32, count) / 2, fps=fps
    )
    any_alarm = np.where(positive & (source.random(count) < 0.3), 2.0, series.highest())
    weight = source.integers(0, 3, count)
    clean, drives = (
        CleanScores(series, any_alarm),
        drives_of(series, any_alarm.tolist(), weight.tolist()),
    )
    given = weight.astype(np.float64)
    expected = plain_figures(drives, fps)
    found = {
        name: getattr(clean, name)(given, *((9.0,) if name == "threshold_of_alarm_time" else ()))
        for name in expected
    }
    assert found == pytest.approx(expected, nan_ok=True)
    for threshold in (0.0, 4 / 11, 0.5, 1.0, 1.5):
        made = clean.at(threshold, given)
        point = plain_point(drives, threshold, fps)
        assert {name: getattr(made, name) for name in point} == pytest.approx(point, nan_ok=True)
        leads = [lead(each, threshold, fps) for each in drives if each["positive"]]
        for latency in (0.0, 2.0):
            left = [0.0 if each is None else max(each - latency, 0.0) for each in leads]
            assert clean.tta0_after(threshold, given, latency) == pytest.approx(
                mean(left), nan_ok=True
            )


def test_the_windows_are_of_seconds() -> None:
    """Of a frame a second: 3 s and more than 5 s before the impact at 10 s; one second a minute in
    alarm is allowed.
    """
    assert (WINDOW, EARLY, SAME_RECALL) == (3.0, 5.0, 0.8)
    early = ScoreSeries(
        scores=np.eye(10)[[4, 5]], positive=np.ones(2, dtype=bool), toa=np.full(2, 10.0), fps=1.0
    )
    assert (
        CleanScores(early).at(1.0, np.ones(2)).early_share == 0.1
    )  # of 2 · 5 frames, that at 6 s and not that at 5 s
    quiet = np.zeros((2, 60))
    quiet[0, :2], quiet[0, 0] = 0.5, 0.9
    calm = ScoreSeries(
        scores=quiet, positive=np.zeros(2, dtype=bool), toa=np.full(2, 60.0), fps=1.0
    )
    assert math.isnan(CleanScores(calm).threshold_of_alarm_time(np.ones(2), 0.4))
    assert CleanScores(calm).threshold_of_alarm_time(np.ones(2)) == 0.9
    assert repr(CleanScores(calm)) == f"CleanScores({calm!r})"


def test_without_recordings_or_a_threshold_there_is_nothing() -> None:
    empty = CleanScores(
        ScoreSeries(scores=np.zeros((0, 3)), positive=np.zeros(0, bool), toa=np.zeros(0), fps=2.0)
    )
    none = np.zeros(0)
    assert [
        math.isnan(each) for each in (empty.average_precision(none), empty.at(0.5, none).recall)
    ] == [True] * 2
    point = empty.at(math.nan, none)
    assert all(math.isnan(getattr(point, name)) for name in point.__slots__)
    assert math.isnan(empty.tta0_after(math.nan, none, 0.0))
