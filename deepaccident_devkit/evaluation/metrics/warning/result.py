"""`WarningResult`: what `WarningEvaluator.compute` returns, made of the tallies of recordings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import ClassVar, Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray, FrozenArrays
from deepaccident_devkit.evaluation.metrics.alarms.truth import UNPLACED_NOTE
from deepaccident_devkit.evaluation.metrics.evaluator import ratio
from deepaccident_devkit.evaluation.metrics.frozen_mappings import FrozenMappings
from deepaccident_devkit.evaluation.metrics.headlines import TaskResult
from deepaccident_devkit.evaluation.metrics.warning.protocol import WarningProtocol
from deepaccident_devkit.evaluation.metrics.warning.recordings import KINDS, UNPLACED, Tally, kind_united
from deepaccident_devkit.taxonomy import FRAME_PERIOD

_PER_SECOND: Final = round(1 / FRAME_PERIOD)
_PER_MINUTE: Final = 60 * _PER_SECOND


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WarningCurve(FrozenArrays):
    """The numbers if only alarms of at least a score are raised, the highest score first; arrays are read-only.

    R scores: all that change something, or if there are more than `WarningProtocol.curve_rows` as many of them, evenly
    by rank. Arrays and not rows of numbers, since row n of a bootstrap's resample is of another score.

    Attributes:
        threshold: (R,) float64 the lowest score that is raised, falling.
        detection_rate: (R,) float64 as `WarningResult` has it, at the protocol's `curve_lead`; NaN without recordings.
        mean_warning: (R,) float64 likewise, seconds; NaN where nobody is warned.
        false_alarms_per_minute: (R,) float64 where nobody collides; NaN without such recordings.
        false_alarms_in_accidents: (R,) float64 a minute of the accident recordings; NaN without them.
    """

    threshold: FloatArray
    detection_rate: FloatArray
    mean_warning: FloatArray
    false_alarms_per_minute: FloatArray
    false_alarms_in_accidents: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WarningResult(TaskResult, FrozenArrays):
    """How early accidents are warned of, and how often alarms are false. NaN: nothing to count.

    A recording is what one agent saw of one scenario. Its kinds: `accident`; `normal` for nobody collides, which is
    `twins`, of which the scenario's twin is an accident, and `others` (those without a twin in the release, too). In
    accident recordings only samples before the impact count.

    Attributes:
        samples: how many.
        recordings: by kind.
        minutes: by kind: what the samples cover. Each stands for the smallest step from a sample to the next in its
            recording (of all recordings, where it has only one), so that a missing sample is not counted.
        warned_share: share of the accident recordings with a right alarm.
        recording_precision: of the recordings with an alarm the share that end in the accident: those with a right
            alarm, of these and of the normal ones with a false alarm.
        tta0: seconds from the first right alarm to the impact, mean over all accident recordings, 0 for those without.
        mean_warning: likewise, mean over the recordings that have one.
        median_warning: likewise.
        warning_seconds: (W,) float64 likewise, of each of them, ascending; read-only.
        lasting_share: share of the accident recordings with a right alarm that lasts: one at every sample to the last,
            none of them missing.
        mean_lasting: seconds from the beginning of such to the impact, mean over the recordings that have it.
        median_lasting: likewise.
        mean_reach: seconds from the first sample to the impact, mean over the accident recordings: no warning can be
            longer.
        detection_rate: seconds before the impact → share of the accident recordings with a right alarm that early or
            earlier, within half a recorded frame.
        detection_recordings: seconds before the impact → the recordings that is a share of: with samples as early.
        time_in_alarm: by kind, share of the samples with a false alarm.
        alarm_seconds_per_minute: likewise, in seconds of each minute.
        false_alarms: by kind. Samples with a false alarm one after another have one together; a missing sample ends it.
        false_alarms_per_minute: by kind.
        alarms: how many alarms are judged.
        precision: share of them that are right.
        unjudged: alarms that nothing can refute: nobody collides, and they are for later than the recording goes on.
        beyond: alarms for later than the horizon, which do not count.
        curve: the same over the score.
        notes: sentences that a reader of the numbers should know.
    """

    task: ClassVar[str] = "warning"
    samples: int
    recordings: Mapping[str, int]
    minutes: Mapping[str, float]
    warned_share: float
    recording_precision: float
    tta0: float
    mean_warning: float
    median_warning: float
    warning_seconds: FloatArray
    lasting_share: float
    mean_lasting: float
    median_lasting: float
    mean_reach: float
    detection_rate: Mapping[float, float]
    detection_recordings: Mapping[float, int]
    time_in_alarm: Mapping[str, float]
    alarm_seconds_per_minute: Mapping[str, float]
    false_alarms: Mapping[str, int]
    false_alarms_per_minute: Mapping[str, float]
    alarms: int
    precision: float
    unjudged: int
    beyond: int
    curve: WarningCurve
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Freeze arrays and mappings."""
        FrozenArrays.__post_init__(self)
        FrozenMappings.__post_init__(self)


def warning_result(tally: Tally, protocol: WarningProtocol) -> WarningResult:
    """The metrics of what `tally_of` gives."""
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
    in_alarm = {kind: ratio(len(each["false"]), each["seen"]) for kind, each in by_kind.items()}
    warned = len(tally["first"])
    return WarningResult(
        samples=tally["samples"],
        recordings={kind: each["recordings"] for kind, each in by_kind.items()},
        minutes=minutes,
        warned_share=ratio(warned, accidents),
        recording_precision=ratio(warned, warned + by_kind["normal"]["alarmed"]),
        tta0=ratio(sum(tally["first"]), accidents * _PER_SECOND),
        mean_warning=_mean_seconds(tally["first"]),
        median_warning=_median_seconds(tally["first"]),
        warning_seconds=np.sort(np.array(tally["first"], dtype=np.float64)) / _PER_SECOND,
        lasting_share=ratio(len(tally["steady"]), accidents),
        mean_lasting=_mean_seconds(tally["steady"]),
        median_lasting=_median_seconds(tally["steady"]),
        mean_reach=_mean_seconds(tally["reach"]),
        detection_rate={lead: ratio(len(tally["in_time"][at]), tally["reached"][at]) for at, lead in leads},
        detection_recordings={lead: tally["reached"][at] for at, lead in leads},
        time_in_alarm=in_alarm,
        alarm_seconds_per_minute={kind: 60 * share for kind, share in in_alarm.items()},
        false_alarms=false,
        false_alarms_per_minute={kind: ratio(false[kind], minutes[kind]) for kind in by_kind},
        alarms=tally["alarms"],
        precision=ratio(tally["right"], tally["alarms"]),
        unjudged=tally["unjudged"],
        beyond=tally["beyond"],
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
    if tally[UNPLACED]:
        yield UNPLACED_NOTE.format(tally[UNPLACED])
    if tally["beyond"]:
        yield f"{tally['beyond']} alarms are for later than the horizon and do not count"
    lone = sum(tally[kind]["lone"] for kind in KINDS)
    if lone:
        yield f"{lone} recordings have a single sample, which says nothing of how far apart samples are"
