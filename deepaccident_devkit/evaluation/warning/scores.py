"""From tallies of recordings to the warning metrics."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.evaluation.evaluator import ratio
from deepaccident_devkit.evaluation.warning.protocol import WarningProtocol
from deepaccident_devkit.evaluation.warning.recordings import KINDS, Tally, kind_united
from deepaccident_devkit.evaluation.warning.result import WarningCurve, WarningResult
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_PER_SECOND: Final = round(1 / FRAME_PERIOD)
_PER_MINUTE: Final = 60 * _PER_SECOND


def warning_result(tally: Tally, protocol: WarningProtocol) -> WarningResult:
    """The metrics of what `recordings.tally_of` gives."""
    by_kind: Mapping[str, Tally] = {
        "accident": tally["accident"],
        "normal": kind_united([tally["twins"], tally["others"]]),
        "twins": tally["twins"],
        "others": tally["others"],
    }
    accidents = by_kind["accident"]["recordings"]
    minutes = {kind: _minutes(each, tally["step"]) for kind, each in by_kind.items()}
    false = {kind: len(each["false"]) - len(each["lasting"]) for kind, each in by_kind.items()}
    leads = list(enumerate(protocol.leads))
    return WarningResult(
        samples=tally["samples"],
        recordings={kind: each["recordings"] for kind, each in by_kind.items()},
        minutes=minutes,
        warned_share=ratio(len(tally["first"]), accidents),
        mean_warning=_mean_seconds(tally["first"]),
        median_warning=_median_seconds(tally["first"]),
        warning_seconds=np.sort(np.array(tally["first"], dtype=np.float64)) / _PER_SECOND,
        lasting_share=ratio(len(tally["steady"]), accidents),
        mean_lasting=_mean_seconds(tally["steady"]),
        median_lasting=_median_seconds(tally["steady"]),
        mean_reach=_mean_seconds(tally["reach"]),
        detection_rate={lead: ratio(len(tally["in_time"][at]), tally["reached"][at]) for at, lead in leads},
        detection_recordings={lead: tally["reached"][at] for at, lead in leads},
        false_alarms=false,
        false_alarms_per_minute={kind: ratio(false[kind], minutes[kind]) for kind in by_kind},
        alarms=tally["alarms"],
        precision=ratio(tally["right"], tally["alarms"]),
        unjudged=tally["unjudged"],
        curve=_curve(tally, by_kind, minutes, protocol.curve_rows),
        notes=tuple(_notes(tally, protocol)),
    )


def _minutes(kind: Tally, step: int | None) -> float:
    """What the samples cover; NaN if a recording has one alone, and nothing says how far apart samples are."""
    if kind["lone"] and step is None:
        return math.nan
    return float((kind["frames"] + kind["lone"] * (step or 0)) / _PER_MINUTE)


def _mean_seconds(frames: Sequence[int]) -> float:
    return ratio(sum(frames), len(frames) * _PER_SECOND)


def _median_seconds(frames: Sequence[int]) -> float:
    return median(frames) / _PER_SECOND if frames else math.nan


def _curve(tally: Tally, by_kind: Mapping[str, Tally], minutes: Mapping[str, float], most: int) -> WarningCurve:
    gains = np.array(tally["gains"], dtype=np.float64).reshape(-1, 3)
    gains = gains[np.argsort(-gains[:, 0], kind="stable")]
    false = [by_kind[kind]["false"] for kind in ("accident", "normal")]
    threshold = _thresholds(np.concatenate([gains[:, 0], tally["in_time"][-1], *false]), most)
    raised = np.searchsorted(-gains[:, 0], -threshold, side="right")
    frames, warned = (np.append(0.0, np.cumsum(column))[raised] for column in gains[:, 1:].T)
    in_accidents, normal = (
        _over(_raised(by_kind[kind]["false"], threshold) - _raised(by_kind[kind]["lasting"], threshold), minutes[kind])
        for kind in ("accident", "normal")
    )
    return WarningCurve(
        threshold=threshold,
        detection_rate=_over(_raised(tally["in_time"][-1], threshold), tally["reached"][-1]),
        mean_warning=_over(frames, warned * _PER_SECOND),
        false_alarms_per_minute=normal,
        false_alarms_in_accidents=in_accidents,
    )


def _thresholds(scores: FloatArray, most: int) -> FloatArray:
    """(R,) different scores, falling: all, or as many as there may be, the first and the last among them."""
    there = np.unique(scores)[::-1]
    if len(there) <= most:
        return there
    return there[np.linspace(0, len(there) - 1, most).round().astype(np.int64)]


def _raised(scores: Sequence[float], threshold: FloatArray) -> FloatArray:
    """(R,) how many scores are at least each threshold."""
    ordered = np.sort(np.array(scores, dtype=np.float64))
    return (len(ordered) - np.searchsorted(ordered, threshold, side="left")).astype(np.float64)


def _over(part: FloatArray, whole: FloatArray | float) -> FloatArray:
    """`part / whole`; NaN where there is nothing to count."""
    below = np.broadcast_to(np.asarray(whole, dtype=np.float64), part.shape)
    shares: FloatArray = np.divide(part, below, out=np.full(part.shape, np.nan), where=below > 0)
    return shares


def _notes(tally: Tally, protocol: WarningProtocol) -> Iterator[str]:
    recordings = {kind: tally[kind]["recordings"] for kind in KINDS}
    accidents, normal = recordings["accident"], recordings["twins"] + recordings["others"]
    if accidents and not normal:
        yield "no recording without an accident was evaluated; give normal scenarios too for false alarms a minute"
    if normal and not accidents:
        yield "no recording of an accident was evaluated; give accident scenarios too for warnings"
    for lead, reached in zip(protocol.leads, tally["reached"], strict=False):
        if reached < accidents:
            yield f"only {reached} of {accidents} accident recordings have samples {lead:g} s before the impact"
    if tally["unjudged"]:
        yield f"{tally['unjudged']} alarms are for later than their recording goes on and were left out"
    lone = sum(tally[kind]["lone"] for kind in KINDS)
    if lone:
        yield f"{lone} recordings have a single sample, which says nothing of how far apart samples are"
