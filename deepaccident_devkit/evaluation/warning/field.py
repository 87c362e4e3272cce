"""`FieldWarnings`: protocol `field`, the numbers of four public implementations, quirks included.

UString (Bao et al. 2020), DSTA (Karim et al. 2022), DRIVE (Bao et al. 2021) and DAD (Chan et al.
2016) print numbers with the same names that are not comparable with each other; docs/protocols.md
lists what is odd in each. Use this protocol to compare a number with a published one. To rank
predictors, use the protocol `clean`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.evaluation.evaluator import Counts
from deepaccident_devkit.evaluation.warning.recordings import (
    GIVEN_SCORES,
    PREDICTORS,
    Recording,
    ScoreSeries,
    group_recordings,
    left_out_notes,
    recordings_of,
    series_of,
    shares,
    split_counts,
)
from deepaccident_devkit.evaluation.warning.result import WarningResult
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, ShortRepr
from deepaccident_devkit.support.human_names import human_name
from deepaccident_devkit.support.text import choice

FieldCode = Literal["ustring", "dsta", "drive", "dad"]
FIELD_CODES: Final[tuple[FieldCode, ...]] = get_args(FieldCode)
# DAD assumes that every recording lasts this many seconds.
_DAD_SECONDS = 5.0
# DRIVE moves its thresholds 0 and 1 inwards by this score.
_DRIVE_THRESHOLD_SHIFT = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldFigures(ShortRepr):
    """Numbers that one public implementation prints; NaN where it raises an error or divides by 0.

    Attributes:
        average_precision: Area under precision over recall, counted by recording (DRIVE: by frame).
        mean_time: mTTA, seconds: warning time averaged over the recalls.
        time_at_r80: TTA@R80, seconds: warning time at the recall nearest to 0.8.
        precision_at_r80: Precision at the lowest recall of at least 0.8; None except for DSTA.
        precision_at_half: Precision of frames at the threshold 0.5; None except for DRIVE.
        recall_at_half: Recall of frames at the threshold 0.5; None except for DRIVE.
        time_at_half: Warning time at the threshold 0.5, seconds; None except for DRIVE.
        note: Why numbers are NaN; empty if none is NaN.
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
    """Compute the numbers that a public implementation prints for these scores.

    All numbers are NaN if a recall or precision exceeds 1.

    Args:
        series: Scores of the recordings. A missing score counts as the lowest score of its
            recording; a frame without an alarm counts as 0. In recordings without an accident all T
            columns count, as in the public implementations.
        code: Name of the implementation. DAD uses the array's length instead of `toa`; if the two
            are equal, the result is the same.

    Raises:
        ChoiceError: If `code` is not one of `FIELD_CODES`.
    """
    figures, highest_recall = _figures_and_recall(series, choice("code", code, FIELD_CODES))
    if max(highest_recall, figures.average_precision) > 1 + 1e-9:
        reason = (
            f"recall {highest_recall:.3g}, AP {figures.average_precision:.3g}: at the threshold 0 "
            "recordings without an accident count as true positives"
        )
        return _nan_figures(code, reason)
    return figures


def printed_figures(series: ScoreSeries, code: FieldCode) -> FieldFigures:
    """Compute the numbers as printed, even if a recall or precision exceeds 1.

    Arguments and errors are as in `field_figures`.
    """
    figures, _ = _figures_and_recall(series, choice("code", code, FIELD_CODES))
    return figures


def _figures_and_recall(series: ScoreSeries, code: FieldCode) -> tuple[FieldFigures, float]:
    """Compute the numbers that a public implementation prints, and its highest recall."""
    if not series.valid.any():
        return _nan_figures(code, "there is no score"), math.nan
    try:
        figures, highest_recall = _FIGURES[code](_filled_series(series), code)
    except IndexError as error:
        reason = f"the published code raises an error here: {error}"
        return _nan_figures(code, reason), math.nan
    if math.isnan(figures.average_precision) or math.isnan(figures.mean_time):
        note = (
            "the published code divides 0 by 0: there is no accident, or no accident is warned "
            "of at some thresholds"
        )
        figures = replace(figures, note=note)
    return figures, highest_recall


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Precision, recall and warning time (seconds) at K thresholds or K recalls.

    Unused entries are 0, as in the public implementations.
    """

    precision: FloatArray
    recall: FloatArray
    time: FloatArray

    def padded(self, length: int) -> _Points:
        """Append zeros to the points, up to a length."""
        padding = (0, length - len(self.recall))
        return _Points(
            np.pad(self.precision, padding),
            np.pad(self.recall, padding),
            np.pad(self.time, padding),
        )

    def __getitem__(self, key: BoolArray | IntArray | slice) -> _Points:
        precision = self.precision[key]
        recall = self.recall[key]
        time = self.time[key]
        return _Points(precision, recall, time)


def _count_recordings(series: ScoreSeries, code: FieldCode) -> tuple[FieldFigures, float]:
    """Count recordings as UString and DSTA do, at thresholds 0.001 apart from the lowest score up.

    Their arrays have room for one threshold per frame; more thresholds are an error. Unused entries
    are 0; the lowest recall is left out to drop them. Warning times are shares of `toa`, and are
    multiplied by the length of the array to get seconds.
    """
    lowest_score = float(np.min(series.scores, initial=np.inf, where=series.valid))
    thresholds = np.arange(max(lowest_score, 0.0), 1.0, 0.001)
    points, has_alarm = _points_of_recordings(
        series, thresholds, series.scores.shape[1] / series.fps
    )
    is_known = has_alarm & np.isfinite(points.time) & np.isfinite(points.recall)
    capacity = int(series.valid.sum())
    stored_before = np.cumsum(is_known, dtype=np.int64) - is_known
    if (has_alarm & (stored_before >= capacity)).any():
        raise IndexError("more thresholds than frames")
    known_points = points[is_known].padded(capacity)
    points_by_recall = _best_by_recall(known_points, drop_lowest=True)
    if code != "dsta":
        return _field_figures(points_by_recall)
    high_recalls = np.flatnonzero(points_by_recall.recall >= 0.8)
    if not len(high_recalls):
        raise IndexError("no recall of 0.8")
    precision = float(points_by_recall.precision[high_recalls[0]])
    return _field_figures(points_by_recall, precision_at_r80=precision)


def _count_recordings_of_dad(series: ScoreSeries, _code: FieldCode) -> tuple[FieldFigures, float]:
    """Count recordings as DAD does, at every score of every frame except 0.

    Warning times are shares of `toa`, converted to seconds as if every recording lasted 5 s.
    """
    scores = np.sort(series.scores, axis=None)
    points, _ = _points_of_recordings(series, scores[scores != 0], _DAD_SECONDS)
    padded_points = points.padded(scores.size)
    points_by_recall = _best_by_recall(padded_points, drop_lowest=False)
    is_known = np.isfinite(points_by_recall.precision)
    if not is_known.any():
        return _nan_figures("dad", "no alarm at any threshold"), math.nan
    return _field_figures(points_by_recall[is_known])


def _count_frames(series: ScoreSeries, _code: FieldCode) -> tuple[FieldFigures, float]:
    """Count frames as DRIVE does, at eleven thresholds, without the lowest recall.

    Warning times are averaged over recordings.
    """
    thresholds = np.arange(0, 1.1, 0.1)
    thresholds[0] += _DRIVE_THRESHOLD_SHIFT
    thresholds[-1] -= _DRIVE_THRESHOLD_SHIFT
    all_points = _points_of_frames(series, np.append(thresholds, 0.5))
    points = all_points[:-1]
    has_several_recalls = len(np.unique(points.recall)) > 1
    return _field_figures(
        _best_by_recall(points, drop_lowest=has_several_recalls),
        precision_at_half=all_points.precision[-1].item(),
        recall_at_half=all_points.recall[-1].item(),
        time_at_half=all_points.time[-1].item(),
    )


_FIGURES = {
    "ustring": _count_recordings,
    "dsta": _count_recordings,
    "drive": _count_frames,
    "dad": _count_recordings_of_dad,
}


def _filled_series(series: ScoreSeries) -> ScoreSeries:
    """Replace missing scores by numbers, since the public implementations do not expect any.

    Recordings without an accident count to the array's end.
    """
    scores = np.where(np.isneginf(series.scores), 0.0, series.scores)
    is_missing = np.isnan(scores)
    lowest = np.min(scores, axis=1, initial=np.inf, where=~is_missing)
    lowest[~np.isfinite(lowest)] = 0.0
    end_column = series.scores.shape[1] + 1.0
    return ScoreSeries(
        scores=np.where(is_missing, lowest[:, None], scores),
        positive=series.positive,
        toa=np.where(series.positive, series.toa, end_column),
        fps=series.fps,
    )


def _points_of_recordings(
    series: ScoreSeries, thresholds: FloatArray, seconds: float
) -> tuple[_Points, BoolArray]:
    """Count recordings at each of K thresholds.

    The warning time is the share of `toa` that is left at the first alarm, multiplied by `seconds`;
    missed accidents are left out. At the threshold 0, a recording without an accident is a true
    positive, because its scores are multiplied by its label and 0 ≥ 0.

    Returns:
        The points, with NaN for 0 / 0, and whether any recording raises an alarm, shape (K,).
    """
    lead_share = series.leads(thresholds) * series.fps / series.toa[:, None]
    has_alarm = np.isfinite(lead_share)
    is_accident = series.positive[:, None]
    counts_as_accident = has_alarm & ~is_accident & (thresholds <= 0)
    lead_share[counts_as_accident] = 1.0  # their first frame is already an alarm
    is_warned = (has_alarm & is_accident) | counts_as_accident
    warned = is_warned.sum(axis=0)
    alarms = has_alarm.sum(axis=0)
    accidents = series.positive.sum()
    times = np.where(is_warned, lead_share * seconds, 0.0).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        points = _Points(warned / alarms, warned / np.float64(accidents), times / warned)
    points.time[warned == 0] = np.nan
    if not accidents:
        points.recall[:] = np.nan
    return points, alarms > 0


def _points_of_frames(series: ScoreSeries, thresholds: FloatArray) -> _Points:
    """Count frames at each threshold, with 0 for 0 / 0.

    Warning times are averaged over the accident recordings with an alarm.
    """
    valid = series.valid
    is_accident = series.positive[:, None]
    accident_scores = np.sort(series.scores[valid & is_accident])
    other_scores = np.sort(series.scores[valid & ~is_accident])
    true = len(accident_scores) - np.searchsorted(accident_scores, thresholds, side="left")
    false = len(other_scores) - np.searchsorted(other_scores, thresholds, side="left")
    leads = series.leads(thresholds)[series.positive]
    warned: IntArray = np.isfinite(leads).sum(axis=0)
    return _Points(
        shares(true, true + false),
        shares(true, np.full(len(thresholds), len(accident_scores))),
        shares(np.nansum(leads, axis=0), warned),
    )


def _best_by_recall(points: _Points, *, drop_lowest: bool) -> _Points:
    """Reduce the points to one per recall, with the best precision and time of its thresholds.

    Points are sorted as in the public implementations (a stable sort). For the highest recall, only
    its lowest threshold counts.

    Args:
        points: One point per threshold.
        drop_lowest: Whether to leave out the lowest recall.

    Raises:
        IndexError: If no recall is left.
    """
    sorted_points = points[np.argsort(points.recall, kind="stable")]
    _, starts = np.unique(sorted_points.recall, return_index=True)
    if drop_lowest:
        starts = starts[1:]
    if not len(starts):
        raise IndexError("all thresholds have the same recall")
    best_points = sorted_points[starts]
    best_points.precision[:-1] = np.maximum.reduceat(sorted_points.precision, starts)[:-1]
    best_points.time[:-1] = np.maximum.reduceat(sorted_points.time, starts)[:-1]
    return best_points


def _area(points: _Points) -> float:
    """Integrate precision over recall with the trapezoidal rule."""
    precision = points.precision
    recall = points.recall
    first_area = precision[0] * recall[0] if recall[0] != 0 else 0.0
    other_areas = (precision[1:] + precision[:-1]) * np.diff(recall) / 2
    return float(first_area + other_areas.sum())


def _field_figures(points: _Points, **special: float) -> tuple[FieldFigures, float]:
    """Build the figures, including an implementation's special ones, and the highest recall."""
    nearest_to_r80 = np.argmin(np.abs(points.recall - 0.8))
    figures = FieldFigures(
        average_precision=_area(points),
        mean_time=float(np.mean(points.time)),
        time_at_r80=float(points.time[nearest_to_r80]),
        **special,  # type: ignore[arg-type]  # none of them is `note`
    )
    return figures, float(points.recall[-1])


def _nan_figures(code: FieldCode, reason: str) -> FieldFigures:
    """Build figures that are all NaN, with the reason as their note."""
    special_names: tuple[str, ...] = ()
    if code == "dsta":
        special_names = ("precision_at_r80",)
    elif code == "drive":
        special_names = ("precision_at_half", "recall_at_half", "time_at_half")
    special = dict.fromkeys(special_names, math.nan)
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

    The numbers of different implementations are not comparable, and predictors that know nothing
    can win.

    Attributes:
        samples: Number of samples.
        figures: Implementation and involvement of the agent, such as `ustring ego_involved` → the
            numbers that the implementation prints.
        references: Figures of each reference predictor (`PREDICTORS` except `GIVEN_SCORES`).
        beyond: Number of alarms that predict an accident beyond the horizon; these are ignored.
        notes: Caveats that belong next to the numbers, such as why numbers are NaN.
    """

    samples: int
    figures: Mapping[str, FieldFigures]
    references: Mapping[str, Mapping[str, FieldFigures]]
    beyond: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldWarnings:
    """Rules of published anticipation metrics, for comparisons with published numbers.

    Recordings are scored as by `CleanWarnings` with `scores_of="recording"`: all alarms count,
    since dash-cam data sets only label whole recordings.
    """

    def result(self, counts: Collection[Counts], *, references: bool = False) -> FieldResult:
        """Compute the metrics from the counts of samples; reference predictors are optional."""
        parts = split_counts(counts)
        groups = dict(group_recordings(recordings_of(parts)))
        samples = [sample for part in parts for sample in part]
        predictors = PREDICTORS if references else (GIVEN_SCORES,)
        figures = {predictor: _figures_by_code(groups, predictor) for predictor in predictors}
        given_figures = figures.pop(GIVEN_SCORES)
        notes = left_out_notes(samples)
        for name, code_figures in given_figures.items():
            if code_figures.note:
                notes.append(f"{human_name(name)}: {code_figures.note}")
        notes.append(
            "do not compare these times and precisions with those of other code; use the "
            "protocol clean to rank models"
        )
        return FieldResult(
            samples=len(samples),
            figures=given_figures,
            references=figures,
            beyond=sum(sample["beyond"] for sample in samples),
            notes=tuple(notes),
        )


def _figures_by_code(
    groups: Mapping[str, Sequence[Recording]], predictor: str
) -> dict[str, FieldFigures]:
    """Compute a predictor's figures for each implementation and group of recordings."""
    figures = {}
    for group, recordings in groups.items():
        for code in FIELD_CODES:
            series = series_of(recordings, predictor, "recording")
            figures[f"{code} {group}"] = field_figures(series, code)
    return figures
