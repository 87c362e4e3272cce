"""`FieldWarnings`: the protocol `field`, what four published codes of anticipation compute, with all of their quirks.

UString (Bao et al. 2020), DSTA (Karim et al. 2022), DRIVE (Bao et al. 2021) and DAD (Chan et al. 2016) print numbers of
one name that are not comparable with each other; docs/protocols.md says what is odd in each. They are here so that a
number can be put beside a published one. To rank predictors take the protocol `clean`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.warning.recordings import (
    GIVEN,
    PREDICTORS,
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
_NUDGE: Final = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldFigures(ShortRepr):
    """What one of the four prints; NaN where it raises an error or divides by 0.

    Attributes:
        average_precision: area under precision over recall; of recordings, of DRIVE of frames.
        mean_time: mTTA, seconds: mean over the recalls.
        time_at_r80: TTA@R80, seconds: at the recall nearest to 0.8.
        precision_at_r80: at the first recall of at least 0.8; None except for DSTA.
        precision_at_half: at the threshold 0.5, of frames; None except for DRIVE.
        recall_at_half: likewise.
        time_at_half: likewise, seconds.
        note: why numbers are NaN; empty if none is.
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
    """The numbers that a published evaluation has for these scores, NaN in place of recalls and precisions above 1.

    Args:
        series: the recordings; missing scores are as their recording's lowest, and no alarm at all is 0. Of recordings
            without an accident all T columns count, as in these codes.
        code: whose evaluation. DAD knows no `toa`: it takes the array's length, and so does this where they are equal.

    Raises:
        ChoiceError: no such code.
    """
    figures, highest_recall = _printed(series, choice("code", code, FIELD_CODES))
    if max(highest_recall, figures.average_precision) > 1 + 1e-9:
        return _nothing(
            code,
            f"recall {highest_recall:.3g}, AP {figures.average_precision:.3g}: at the threshold 0 recordings without "
            "an accident count as true positives",
        )
    return figures


def printed_figures(series: ScoreSeries, code: FieldCode) -> FieldFigures:
    """The same as the published code prints them, recalls and precisions above 1 too; see `field_figures`."""
    return _printed(series, choice("code", code, FIELD_CODES))[0]


def _printed(series: ScoreSeries, code: FieldCode) -> tuple[FieldFigures, float]:
    """What a published code prints, and its highest recall."""
    if not series.valid.any():
        return _nothing(code, "there is no score"), math.nan
    try:
        figures, highest_recall = _FIGURES[code](_filled(series), code)
    except IndexError as error:
        return _nothing(code, f"the published code raises an error here: {error}"), math.nan
    if math.isnan(figures.average_precision) or math.isnan(figures.mean_time):
        note = "the published code divides 0 by 0: no accident, or thresholds at which none is warned of"
        figures = replace(figures, note=note)
    return figures, highest_recall


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Of K thresholds, as a published code keeps them; unused places are 0."""

    precision: FloatArray
    recall: FloatArray
    time: FloatArray


def _recordings(series: ScoreSeries, code: FieldCode) -> tuple[FieldFigures, float]:
    """UString and DSTA: recordings are counted, at thresholds 0.001 apart from the lowest score on.

    There is room for one threshold a frame, and more are an error. Unused places are 0: to drop them the lowest recall
    is left out. Shares of `toa` become seconds by the length of the array.
    """
    valid = series.valid
    lowest = float(np.min(series.scores, initial=np.inf, where=valid))
    thresholds = np.arange(max(lowest, 0.0), 1.0, 0.001)
    points, raised = _counted(series, thresholds, series.scores.shape[1] / series.fps)
    there = raised & np.isfinite(points.time) & np.isfinite(points.recall)
    room, used = int(valid.sum()), np.cumsum(there, dtype=np.int64) - there
    if (raised & (used >= room)).any():
        raise IndexError("more thresholds than frames")
    kept = np.flatnonzero(there)
    padded = [np.zeros(max(room, len(kept))) for _ in range(3)]
    for column, values in zip(padded, (points.precision, points.recall, points.time), strict=True):
        column[: len(kept)] = values[kept]
    levels = _levels(_Points(*padded), drop_lowest=True)
    high = np.flatnonzero(levels.recall >= 0.8)
    if code == "dsta" and not len(high):
        raise IndexError("no recall of 0.8")
    return _of_levels(
        levels, precision_at_r80=float(levels.precision[high[0]]) if code == "dsta" else None
    )


def _dad(series: ScoreSeries, _code: FieldCode) -> tuple[FieldFigures, float]:
    """DAD: recordings are counted, at every score of every frame but 0; shares of `toa` become seconds as of 5 s."""
    thresholds = np.sort(series.scores, axis=None)
    thresholds = thresholds[thresholds != 0]
    points, _ = _counted(series, thresholds, _DAD_SECONDS)
    unused = np.zeros(series.scores.size - len(thresholds))
    columns = (
        np.concatenate([each, unused]) for each in (points.precision, points.recall, points.time)
    )
    levels = _levels(_Points(*columns), drop_lowest=False)
    known = np.isfinite(levels.precision)
    if not known.any():
        return _nothing("dad", "no alarm at any threshold"), math.nan
    return _of_levels(_Points(levels.precision[known], levels.recall[known], levels.time[known]))


def _drive(series: ScoreSeries, _code: FieldCode) -> tuple[FieldFigures, float]:
    """DRIVE: frames are counted, at eleven thresholds, and the lowest recall is left out; times are of recordings."""
    thresholds = np.arange(0, 1.1, 0.1)
    thresholds[[0, -1]] += (_NUDGE, -_NUDGE)
    counted = _frames(series, np.append(thresholds, 0.5))
    precision, recall, time = (
        each[-1].item() for each in (counted.precision, counted.recall, counted.time)
    )
    points = _Points(counted.precision[:-1], counted.recall[:-1], counted.time[:-1])
    levels = _levels(points, drop_lowest=len(np.unique(points.recall)) > 1)
    return _of_levels(levels, precision_at_half=precision, recall_at_half=recall, time_at_half=time)


_FIGURES: Final = {"ustring": _recordings, "dsta": _recordings, "drive": _drive, "dad": _dad}


def _filled(series: ScoreSeries) -> ScoreSeries:
    """The same with numbers everywhere, since these codes know no missing score; negatives count to the array's end."""
    given = np.where(np.isneginf(series.scores), 0.0, series.scores)
    lowest = np.min(given, axis=1, initial=np.inf, where=~np.isnan(given))
    lowest = np.where(np.isfinite(lowest), lowest, 0.0)
    columns = series.scores.shape[1]
    return ScoreSeries(
        scores=np.where(np.isnan(given), lowest[:, None], given),
        positive=series.positive,
        toa=np.where(series.positive, series.toa, columns + 1.0),
        fps=series.fps,
    )


def _counted(
    series: ScoreSeries, thresholds: FloatArray, seconds: float
) -> tuple[_Points, BoolArray]:
    """Recordings counted at each threshold, NaN for 0 / 0; and (K,) whether any recording raises an alarm.

    Times are shares of `toa` before the impact times `seconds`, missed accidents left out. At the threshold 0 a
    recording without an accident is a true positive: its scores are multiplied by its label, and 0 ≥ 0.
    """
    share = series.leads(thresholds) * series.fps / series.toa[:, None]
    alarmed = np.isfinite(share)
    by_zero = alarmed & ~series.positive[:, None] & (thresholds <= 0)
    share[by_zero] = 1.0  # their first frame is one already
    warned = (alarmed & series.positive[:, None]) | by_zero
    count = warned.sum(axis=0)
    accidents = int(series.positive.sum())
    time = np.where(warned, share * seconds, 0.0).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        points = _Points(count / alarmed.sum(axis=0), count / np.float64(accidents), time / count)
    points.time[count == 0] = np.nan
    if not accidents:
        points.recall[:] = np.nan
    return points, np.asarray(alarmed.any(axis=0))


def _frames(series: ScoreSeries, thresholds: FloatArray) -> _Points:
    """Frames counted at each threshold, 0 for 0 / 0; times are of the accidents that are warned of."""
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
    """One point a recall: the best precision and time of its thresholds, in the codes' order (a stable sort).

    Of the thresholds of the highest recall the lowest one counts.

    Raises:
        IndexError: no recall is left.
    """
    order = np.argsort(points.recall, kind="stable")
    precision, recall, time = (
        each[order] for each in (points.precision, points.recall, points.time)
    )
    starts = np.unique(recall, return_index=True)[1]
    starts = starts[1:] if drop_lowest else starts
    if not len(starts):
        raise IndexError("no threshold has another recall than the others")
    best = [np.maximum.reduceat(each, starts) for each in (precision, time)]
    for levels, each in zip(best, (precision, time), strict=True):
        levels[-1] = each[starts[-1]]
    return _Points(best[0], recall[starts], best[1])


def _area(levels: _Points) -> float:
    first = levels.precision[0] * levels.recall[0] if levels.recall[0] != 0 else 0.0
    between = (levels.precision[1:] + levels.precision[:-1]) * np.diff(levels.recall) / 2
    return float(first + between.sum())


def _of_levels(levels: _Points, **more: float | None) -> tuple[FieldFigures, float]:
    """The figures of all codes, with those of one alone; and the highest recall."""
    figures = FieldFigures(
        average_precision=_area(levels),
        mean_time=float(np.mean(levels.time)),
        time_at_r80=float(levels.time[np.argmin(np.abs(levels.recall - 0.8))]),
        **more,  # type: ignore[arg-type]  # none of them is `note`
    )
    return figures, float(levels.recall[-1])


def _nothing(code: FieldCode, why: str) -> FieldFigures:
    known: Mapping[str, float] = {
        "dsta": {"precision_at_r80": math.nan},
        "drive": dict.fromkeys(("precision_at_half", "recall_at_half", "time_at_half"), math.nan),
    }.get(code, {})
    return FieldFigures(
        average_precision=math.nan, mean_time=math.nan, time_at_r80=math.nan, note=why, **known
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldResult(WarningResult):
    """The result of the protocol `field`: not comparable between codes, and predictors that know nothing can win.

    Attributes:
        samples: how many.
        figures: code and involvement of the agent, such as `ustring ego_involved` → what that code prints.
        references: predictor (of `PREDICTORS` but the given one) → the same.
        beyond: alarms for later than the horizon, which do not count.
        notes: sentences that a reader of the numbers should know: why numbers are NaN.
    """

    samples: int
    figures: Mapping[str, FieldFigures]
    references: Mapping[str, Mapping[str, FieldFigures]]
    beyond: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldWarnings:
    """Published anticipation metrics, for numbers beside published ones.

    A recording's score is as of `CleanWarnings`, of all its alarms, since dash-cam sets know recordings alone.
    """

    def result(self, counts: Collection[Counts], *, references: bool = False) -> FieldResult:
        """The metrics of some samples' counts, with those of the reference predictors or without."""
        parts = parts_of(counts)
        groups, samples = (
            dict(by_group(recordings_of(parts))),
            [sample for part in parts for sample in part],
        )
        made = {
            predictor: {
                f"{code} {group}": field_figures(series_of(those, predictor, "recording"), code)
                for group, those in groups.items()
                for code in FIELD_CODES
            }
            for predictor in (PREDICTORS if references else PREDICTORS[:1])
        }
        given = made.pop(GIVEN)
        notes = [
            *left_out_notes(samples),
            *(f"{name}: {each.note}" for name, each in given.items() if each.note),
        ]
        return FieldResult(
            samples=len(samples),
            figures=given,
            references=made,
            beyond=sum(each["beyond"] for each in samples),
            notes=(
                *notes,
                "times and precisions of different codes are not comparable; the protocol clean ranks",
            ),
        )
