"""`CleanScores`: figures at any threshold and weights, compared with counting frame by frame."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit.evaluation.warning import CleanScores, ScoreSeries
from deepaccident_devkit.evaluation.warning.clean import EARLY, SAME_RECALL, WINDOW

# Of one recording: scores by column, label, `toa`, its highest score and that of any alarm.
Drive = dict[str, Any]


def make_drives(
    series: ScoreSeries, any_alarm: Sequence[float], weights: Sequence[int]
) -> list[Drive]:
    """Make the drives of a series, each repeated by its weight."""
    drives = []
    for row, weight in enumerate(weights):
        toa = series.toa[row]
        scores = {
            column: score
            for column, score in enumerate(series.scores[row].tolist())
            if not math.isnan(score) and column < toa
        }
        drive = {
            "scores": scores,
            "positive": bool(series.positive[row]),
            "toa": float(toa),
            "highest": max(scores.values(), default=-math.inf),
            "any": any_alarm[row],
        }
        drives += [drive] * weight
    return drives


def share(part: float, total: float) -> float:
    return part / total if total else math.nan


def mean(values: Sequence[float]) -> float:
    return share(sum(values), len(values))


def area(scores: Sequence[tuple[bool, float]]) -> float:
    """Return the chance that an accident's score is above another's; ties count half."""
    accidents = [score for is_positive, score in scores if is_positive]
    without_accident = [score for is_positive, score in scores if not is_positive]
    wins = [
        (accident > other) + (accident == other) / 2
        for accident, other in itertools.product(accidents, without_accident)
    ]
    return mean(wins)


def lead_frames(drive: Drive, threshold: float) -> float | None:
    """Return the frames from the first alarm to the impact; None without an alarm."""
    for column, score in drive["scores"].items():
        if score >= threshold:
            return drive["toa"] - column
    return None


def evaluate_at(drives: Sequence[Drive], threshold: float, fps: float) -> dict[str, float]:
    """Evaluate an operating point, recording by recording."""
    accidents = [drive for drive in drives if drive["positive"]]
    without_accident = [drive for drive in drives if not drive["positive"]]
    leads = [lead_frames(drive, threshold) for drive in accidents]
    seconds = [frames / fps for frames in leads if frames is not None]
    misled = sum(
        frames is None and drive["any"] >= threshold
        for drive, frames in zip(accidents, leads, strict=True)
    )
    false = sum(lead_frames(drive, threshold) is not None for drive in without_accident)
    warned = len(seconds) + false + misled

    is_alarm, is_begin = [], []
    for drive in without_accident:
        for column, score in drive["scores"].items():
            before = drive["scores"].get(column - 1, -math.inf)
            is_alarm.append(score >= threshold)
            is_begin.append(score >= threshold and not before >= threshold)
    early = [
        score >= threshold
        for drive in accidents
        for column, score in drive["scores"].items()
        if (drive["toa"] - column) / fps > 5 + 1e-9
    ]
    return {
        "threshold": threshold,
        "recall": share(len(seconds), len(accidents)),
        "precision": share(len(seconds), warned),
        "tta_hit": mean(seconds),
        "tta0": share(sum(seconds), len(accidents)),
        "time_in_alarm": mean(is_alarm),
        "alarm_seconds_per_minute": 60 * mean(is_alarm),
        "episodes_per_minute": 60 * fps * mean(is_begin),
        "false_recordings": false,
        "early_share": mean(early),
    }


def evaluate_plainly(drives: Sequence[Drive], fps: float) -> dict[str, float]:
    """Compute the figures without a threshold, level by level and moment by moment."""
    areas = []
    for frames in range(1, round(3 * fps) + 1):
        scores = []
        for drive in drives:
            column = math.ceil(drive["toa"] - frames - 1e-6)
            if column in drive["scores"]:
                scores.append((drive["positive"], drive["scores"][column]))
        areas.append(area(scores))

    right_drives = [drive | {"any": -math.inf} for drive in drives]
    levels = {drive["highest"] for drive in drives if drive["highest"] > -math.inf}
    points = [evaluate_at(right_drives, level, fps) for level in sorted(levels, reverse=True)]
    accidents = sum(drive["positive"] for drive in drives)
    average_precision = mean_time = 0.0 if accidents else math.nan
    previous_hits = 0
    for point in points:
        point["hits"] = round(point["recall"] * accidents) if accidents else 0
        point["f1"] = 2 * point["hits"] / (point["hits"] + point["false_recordings"] + accidents)
        if point["hits"] > previous_hits:
            gain = (point["hits"] - previous_hits) / accidents
            average_precision += gain * point["precision"]
            mean_time += gain * point["tta_hit"]
        previous_hits = point["hits"]

    def threshold_of_highest(name: str, default: float, candidates: Any = points) -> float:
        """Return the highest threshold with the highest value; `default` if all are 0."""
        best = max(
            candidates,
            key=lambda point: point[name],
            default={name: 0},
        )
        return best["threshold"] if best[name] else default

    recalled = [point["threshold"] for point in points if point["recall"] >= 0.8 - 1e-9]
    precise = [point for point in points if point["precision"] >= 0.8 - 1e-9]
    quiet = [
        point["threshold"] for point in points if point["alarm_seconds_per_minute"] <= 9 + 1e-9
    ]
    return {
        "area_at_moments": mean([value for value in areas if not math.isnan(value)]),
        "area_under_curve": area([(drive["positive"], drive["highest"]) for drive in drives]),
        "average_precision": average_precision,
        "mean_time": mean_time,
        "threshold_of_recall": max(recalled, default=math.nan),
        "threshold_of_highest_recall": threshold_of_highest("hits", math.inf),
        "threshold_of_precision": threshold_of_highest("hits", math.nan, precise),
        "threshold_of_best_f1": threshold_of_highest("f1", math.nan),
        "threshold_of_alarm_time": min(quiet, default=math.nan),
    }


@pytest.mark.parametrize("seed", range(24))
def test_figures_are_those_of_counting_frame_by_frame(seed: int) -> None:
    random = np.random.default_rng(seed)
    count, columns, fps = 8, 14, (1.0, 2.0)[seed % 2]
    scores = random.integers(0, 12, (count, columns)) / 11
    scores[random.random(scores.shape) < 0.2] = math.nan
    scores[random.random(scores.shape) < 0.5] = -math.inf
    positive = random.random(count) < (0.5, 0.5, 0.0, 1.0)[seed // 2 % 4]
    series = ScoreSeries(
        scores=scores,
        positive=positive,
        toa=random.integers(6, 32, count) / 2,
        fps=fps,
    )
    any_alarm = np.where(
        positive & (random.random(count) < 0.3),
        2.0,
        series.highest(),
    )
    int_weights = random.integers(0, 3, count)
    weights = int_weights.astype(np.float64)
    clean = CleanScores(series, any_alarm)
    drives = make_drives(series, any_alarm.tolist(), int_weights.tolist())

    for name, expected in evaluate_plainly(drives, fps).items():
        arguments = (9.0,) if name == "threshold_of_alarm_time" else ()
        figure = getattr(clean, name)(weights, *arguments)
        assert figure == pytest.approx(expected, nan_ok=True), name
    for threshold in (0.0, 4 / 11, 0.5, 1.0, 1.5):
        point = clean.at(threshold, weights)
        expected_point = evaluate_at(drives, threshold, fps)
        values = {name: getattr(point, name) for name in expected_point}
        assert values == pytest.approx(expected_point, nan_ok=True)
        leads = [lead_frames(drive, threshold) for drive in drives if drive["positive"]]
        for latency in (0.0, 2.0):
            seconds = [max((frames or 0.0) / fps - latency, 0.0) for frames in leads]
            tta0 = clean.tta0_after(threshold, weights, latency)
            assert tta0 == pytest.approx(mean(seconds), nan_ok=True)


def test_windows_are_in_seconds() -> None:
    """There is one frame a second: 3 s and more than 5 s before the impact at 10 s count, and one
    second a minute in alarm is allowed.
    """
    assert (WINDOW, EARLY, SAME_RECALL) == (3.0, 5.0, 0.8)
    early = ScoreSeries(
        scores=np.eye(10)[[4, 5]],
        positive=np.ones(2, dtype=bool),
        toa=np.full(2, 10.0),
        fps=1.0,
    )
    # of 2 · 5 frames, the one at 6 s and not the one at 5 s
    assert CleanScores(early).at(1.0, np.ones(2)).early_share == 0.1

    scores = np.zeros((2, 60))
    scores[0, :2] = [0.9, 0.5]
    calm = ScoreSeries(
        scores=scores,
        positive=np.zeros(2, dtype=bool),
        toa=np.full(2, 60.0),
        fps=1.0,
    )
    assert math.isnan(CleanScores(calm).threshold_of_alarm_time(np.ones(2), 0.4))
    assert CleanScores(calm).threshold_of_alarm_time(np.ones(2)) == 0.9
    assert repr(CleanScores(calm)) == f"CleanScores({calm!r})"


def test_without_recordings_or_a_threshold_there_is_nothing() -> None:
    empty = ScoreSeries(
        scores=np.zeros((0, 3)),
        positive=np.zeros(0, bool),
        toa=np.zeros(0),
        fps=2.0,
    )
    clean, weights = CleanScores(empty), np.zeros(0)
    assert math.isnan(clean.average_precision(weights))
    assert math.isnan(clean.at(0.5, weights).recall)
    point = clean.at(math.nan, weights)
    for name in point.__slots__:
        assert math.isnan(getattr(point, name))
    assert math.isnan(clean.tta0_after(math.nan, weights, 0.0))
