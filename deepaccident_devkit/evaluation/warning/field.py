"""`FieldWarnings`: protocol `field`, the numbers of four published codes, with all their quirks.

UString (Bao et al. 2020), DSTA (Karim et al. 2022), DRIVE (Bao et al. 2021) and DAD (Chan et al.
2016) print numbers of the same names that are not comparable with each other; docs/protocols.md
lists what is odd in each. They are here so that a number can be put beside a published one. To rank
predictors use the protocol `clean`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.warning.recordings import (
    GIVEN,
    PREDICTORS,
    Recording,
    ScoreSeries,
    by_group,
    left_out_notes,
    parts_of,
    recordings_of,
    series_of,
    shares,
)
from deepaccident_devkit.evaluation.warning.result import WarningResult
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, ShortRepr
from deepaccident_devkit.support.text import choice

FieldCode = Literal["ustring", "dsta", "drive", "dad"]
FIELD_CODES: Final[tuple[FieldCode, ...]] = get_args(FieldCode)
_DAD_SECONDS: Final = 5.0
# DRIVE moves its thresholds 0 and 1 inwards by this.
_DRIVE_THRESHOLD_SHIFT: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldFigures(ShortRepr):
    """Numbers that one of the four codes prints; NaN where it raises an error or divides by 0.

    Attributes:
        average_precision: Area under precision over recall, of recordings; for DRIVE of frames.
        mean_time: mTTA, seconds: mean over the recalls.
        time_at_r80: TTA@R80, seconds: at the recall nearest to 0.8.
        precision_at_r80: Precision at the lowest recall of at least 0.8; None except for DSTA.
        precision_at_half: Precision at the threshold 0.5, of frames; None except for DRIVE.
        recall_at_half: Recall there, of frames; None except for DRIVE.
        time_at_half: Time there, seconds; None except for DRIVE.
        note: Reason why numbers are NaN; empty if none is.
    """

    average_precision: float
    mean_time: float
    time_at_r80: float
    precision_at_r80: float | None = None
    precision_at_half: float | None = None
    recall_at_half: float | None = None
    time_at_half: float | None = None
    note: str = ""


def field_figures(series: ScoreSeries, code: FieldCode) -> FieldFigures:
    """Return the numbers that a published evaluation has for these scores.

    NaN stands for recalls and precisions that exceed 1.

    Args:
        series: Scores of the recordings; missing scores count as their recording's lowest, and no
            alarm as 0. In recordings without an accident all T columns count, as in these codes.
        code: Name of the code. DAD does not use `toa` but the array's length, which gives the same
            result where they are equal.

    Raises:
        ChoiceError: no such code.
    """
    figures, highest_recall = _printed(series, choice("code", code, FIELD_CODES))
    if max(highest_recall, figures.average_precision) > 1 + 1e-9:
        return _nothing(
            code,
            f"recall {highest_recall:.3g}, AP {figures.average_precision:.3g}: at the threshold 0 "
            "recordings without "
            "an accident count as true positives",
        )
    return figures


def printed_figures(series: ScoreSeries, code: FieldCode) -> FieldFigures:
    """Return the numbers as the published code prints them, also recalls and precisions over 1.

    Arguments and errors are as in `field_figures`.
    """
    return _printed(series, choice("code", code, FIELD_CODES))[0]


def _printed(series: ScoreSeries, code: FieldCode) -> tuple[FieldFigures, float]:
    """Return what a published code prints, and its highest recall."""
    if not series.valid.any():
        return _nothing(code, "there is no score"), math.nan
    try:
        figures, highest_recall = _FIGURES[code](_filled(series), code)
    except IndexError as error:
        return _nothing(code, f"the published code raises an error here: {error}"), math.nan
    if math.isnan(figures.average_precision) or math.isnan(figures.mean_time):
        note = (
            "the published code divides 0 by 0: no accident, or thresholds at which none is warned "
            "of"
        )
        figures = replace(figures, note=note)
    return figures, highest_recall


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Points of K thresholds, as a published code keeps them; unused entries are 0."""

    precision: FloatArray
    recall: FloatArray
    time: FloatArray


def _recordings(series: ScoreSeries, code: FieldCode) -> tuple[FieldFigures, float]:
    """Count recordings as UString and DSTA do, at thresholds 0.001 apart from the lowest score on.

    Their arrays hold one threshold per frame, and more are an error. Unused entries are 0: to drop
    them the lowest recall is left out. Shares of `toa` become seconds by the length of the array.
    """
    valid = series.valid
    lowest = float(np.min(series.scores, initial=np.inf, where=valid))
    thresholds = np.arange(max(lowest, 0.0), 1.0, 0.001)
    points, raised = _counted(series, thresholds, series.scores.shape[1] / series.fps)
    is_known = raised & np.isfinite(points.time) & np.isfinite(points.recall)
    capacity = int(valid.sum())
    used = np.cumsum(is_known, dtype=np.int64) - is_known
    if (raised & (used >= capacity)).any():
        raise IndexError("more thresholds than frames")
    known = np.flatnonzero(is_known)
    length = max(capacity, len(known))
    levels = _levels(
        _Points(
            _zero_padded(points.precision[known], length),
            _zero_padded(points.recall[known], length),
            _zero_padded(points.time[known], length),
        ),
        drop_lowest=True,
    )
    high = np.flatnonzero(levels.recall >= 0.8)
    if code != "dsta":
        return _of_levels(levels, precision_at_r80=None)
    if not len(high):
        raise IndexError("no recall of 0.8")
    return _of_levels(levels, precision_at_r80=float(levels.precision[high[0]]))


def _zero_padded(values: FloatArray, length: int) -> FloatArray:
    """Return values with zeros after them, up to a length."""
    padded = np.zeros(length)
    padded[: len(values)] = values
    return padded


def _dad(series: ScoreSeries, _code: FieldCode) -> tuple[FieldFigures, float]:
    """Count recordings as DAD does, at every score of every frame except 0.

    Shares of `toa` become seconds as if every recording lasted 5 s.
    """
    thresholds = np.sort(series.scores, axis=None)
    thresholds = thresholds[thresholds != 0]
    points, _ = _counted(series, thresholds, _DAD_SECONDS)
    length = series.scores.size
    padded = _Points(
        _zero_padded(points.precision, length),
        _zero_padded(points.recall, length),
        _zero_padded(points.time, length),
    )
    levels = _levels(padded, drop_lowest=False)
    known = np.isfinite(levels.precision)
    if not known.any():
        return _nothing("dad", "no alarm at any threshold"), math.nan
    return _of_levels(_Points(levels.precision[known], levels.recall[known], levels.time[known]))


def _drive(series: ScoreSeries, _code: FieldCode) -> tuple[FieldFigures, float]:
    """Count frames as DRIVE does, at eleven thresholds, without the lowest recall.

    Times are of recordings.
    """
    thresholds = np.arange(0, 1.1, 0.1)
    thresholds[[0, -1]] += (_DRIVE_THRESHOLD_SHIFT, -_DRIVE_THRESHOLD_SHIFT)
    counted = _frames(series, np.append(thresholds, 0.5))
    points = _Points(counted.precision[:-1], counted.recall[:-1], counted.time[:-1])
    levels = _levels(points, drop_lowest=len(np.unique(points.recall)) > 1)
    return _of_levels(
        levels,
        precision_at_half=counted.precision[-1].item(),
        recall_at_half=counted.recall[-1].item(),
        time_at_half=counted.time[-1].item(),
    )


_FIGURES: Final = {"ustring": _recordings, "dsta": _recordings, "drive": _drive, "dad": _dad}


def _filled(series: ScoreSeries) -> ScoreSeries:
    """Return the series with numbers everywhere, since these codes know no missing score.

    Recordings without an accident count to the array's end.
    """
    scores = np.where(np.isneginf(series.scores), 0.0, series.scores)
    lowest = np.min(scores, axis=1, initial=np.inf, where=~np.isnan(scores))
    lowest = np.where(np.isfinite(lowest), lowest, 0.0)
    columns = series.scores.shape[1]
    return ScoreSeries(
        scores=np.where(np.isnan(scores), lowest[:, None], scores),
        positive=series.positive,
        toa=np.where(series.positive, series.toa, columns + 1.0),
        fps=series.fps,
    )


def _counted(
    series: ScoreSeries, thresholds: FloatArray, seconds: float
) -> tuple[_Points, BoolArray]:
    """Count recordings at each of K thresholds.

    Times are shares of `toa` before the impact times `seconds`, missed accidents left out. At the
    threshold 0 a recording without an accident is a true positive: its scores are multiplied by its
    label, and 0 ≥ 0.

    Returns:
        Points, NaN for 0 / 0; and whether any recording raises an alarm, shape (K,).
    """
    lead_share = series.leads(thresholds) * series.fps / series.toa[:, None]
    alarmed = np.isfinite(lead_share)
    at_zero = alarmed & ~series.positive[:, None] & (thresholds <= 0)
    lead_share[at_zero] = 1.0  # their first frame is an alarm already
    warned = (alarmed & series.positive[:, None]) | at_zero
    count = warned.sum(axis=0)
    accidents = int(series.positive.sum())
    time = np.where(warned, lead_share * seconds, 0.0).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        points = _Points(count / alarmed.sum(axis=0), count / np.float64(accidents), time / count)
    points.time[count == 0] = np.nan
    if not accidents:
        points.recall[:] = np.nan
    return points, np.asarray(alarmed.any(axis=0))


def _frames(series: ScoreSeries, thresholds: FloatArray) -> _Points:
    """Count frames at each threshold, 0 for 0 / 0; times are of the accidents warned of."""
    valid = series.valid
    right = np.sort(series.scores[valid & series.positive[:, None]])
    wrong = np.sort(series.scores[valid & ~series.positive[:, None]])
    true = len(right) - np.searchsorted(right, thresholds, side="left")
    false = len(wrong) - np.searchsorted(wrong, thresholds, side="left")
    leads = series.leads(thresholds)[series.positive]
    warned: IntArray = np.isfinite(leads).sum(axis=0)
    return _Points(
        shares(true, true + false),
        shares(true, np.full(len(thresholds), len(right))),
        shares(np.nansum(leads, axis=0), warned),
    )


def _levels(points: _Points, *, drop_lowest: bool) -> _Points:
    """Return one point per recall: the best precision and time of its thresholds.

    The order is that of the codes (a stable sort). For the highest recall only its lowest threshold
    counts.

    Raises:
        IndexError: no recall is left.
    """
    order = np.argsort(points.recall, kind="stable")
    precision = points.precision[order]
    recall = points.recall[order]
    time = points.time[order]
    starts = np.unique(recall, return_index=True)[1]
    if drop_lowest:
        starts = starts[1:]
    if not len(starts):
        raise IndexError("no threshold has another recall than the others")
    best_precision = np.maximum.reduceat(precision, starts)
    best_precision[-1] = precision[starts[-1]]
    best_time = np.maximum.reduceat(time, starts)
    best_time[-1] = time[starts[-1]]
    return _Points(best_precision, recall[starts], best_time)


def _area(levels: _Points) -> float:
    """Return the area under precision over recall, by trapezoids."""
    precision = levels.precision
    recall = levels.recall
    start = precision[0] * recall[0] if recall[0] != 0 else 0.0
    between = (precision[1:] + precision[:-1]) * np.diff(recall) / 2
    return float(start + between.sum())


def _of_levels(levels: _Points, **special: float | None) -> tuple[FieldFigures, float]:
    """Return the figures of all codes with a code's special ones, and the highest recall."""
    figures = FieldFigures(
        average_precision=_area(levels),
        mean_time=float(np.mean(levels.time)),
        time_at_r80=float(levels.time[np.argmin(np.abs(levels.recall - 0.8))]),
        **special,  # type: ignore[arg-type]  # none of them is `note`
    )
    return figures, float(levels.recall[-1])


def _nothing(code: FieldCode, reason: str) -> FieldFigures:
    """Return figures of NaN, with the reason as their note."""
    special: dict[str, float] = {}
    if code == "dsta":
        special = {"precision_at_r80": math.nan}
    elif code == "drive":
        names = ("precision_at_half", "recall_at_half", "time_at_half")
        special = dict.fromkeys(names, math.nan)
    return FieldFigures(
        average_precision=math.nan,
        mean_time=math.nan,
        time_at_r80=math.nan,
        note=reason,
        **special,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldResult(WarningResult):
    """The result of the protocol `field`.

    Its numbers are not comparable between codes, and predictors that know nothing can win.

    Attributes:
        samples: Number of samples.
        figures: Code and involvement of the agent, such as `ustring ego_involved` → figures that
            the code prints.
        references: Predictor (of `PREDICTORS` except the given one) → the same figures.
        beyond: Alarms for later than the horizon, which do not count.
        notes: Sentences that a reader of the numbers should know, such as why numbers are NaN.
    """

    samples: int
    figures: Mapping[str, FieldFigures]
    references: Mapping[str, Mapping[str, FieldFigures]]
    beyond: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldWarnings:
    """Published anticipation metrics, for numbers beside published ones.

    A recording's score is that of `CleanWarnings`, from all its alarms, since dash-cam data sets
    only know recordings.
    """

    def result(self, counts: Collection[Counts], *, references: bool = False) -> FieldResult:
        """Return the metrics of some samples' counts, with or without the reference predictors."""
        parts = parts_of(counts)
        groups = dict(by_group(recordings_of(parts)))
        samples = [sample for part in parts for sample in part]
        figures = {}
        for predictor in PREDICTORS:
            if references or predictor == GIVEN:
                figures[predictor] = _figures_by_code(groups, predictor)
        evaluated = figures.pop(GIVEN)
        notes = left_out_notes(samples)
        notes += [f"{name}: {item.note}" for name, item in evaluated.items() if item.note]
        notes.append(
            "times and precisions of different codes are not comparable; the protocol clean ranks"
        )
        return FieldResult(
            samples=len(samples),
            figures=evaluated,
            references=figures,
            beyond=sum(sample["beyond"] for sample in samples),
            notes=tuple(notes),
        )


def _figures_by_code(
    groups: Mapping[str, Sequence[Recording]], predictor: str
) -> dict[str, FieldFigures]:
    """Return a predictor's figures by code and group of recordings."""
    figures = {}
    for group, recordings in groups.items():
        for code in FIELD_CODES:
            series = series_of(recordings, predictor, "recording")
            figures[f"{code} {group}"] = field_figures(series, code)
    return figures
