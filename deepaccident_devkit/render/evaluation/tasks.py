"""Panels of each task: quality by time, accuracy, errors, alarms, precision, predictors, plans."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.scoring import DISTANCES, ERRORS_AT, Alarm, hit_of
from deepaccident_devkit.evaluation.detection import DetectionResult
from deepaccident_devkit.evaluation.evaluator import Counts, ratio
from deepaccident_devkit.evaluation.instances import panoptic_quality
from deepaccident_devkit.evaluation.motion import RANGES, MotionEvaluator
from deepaccident_devkit.evaluation.planning import PlanningResult
from deepaccident_devkit.evaluation.planning.evaluator import BY_LEAD, GIVEN
from deepaccident_devkit.evaluation.warning import AnticipationResult
from deepaccident_devkit.render.boxes import write_beside
from deepaccident_devkit.render.captions import set_title
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.evaluation.panels import PANEL, Bar, draw_bars, draw_nothing
from deepaccident_devkit.render.figures import axes_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    ESTIMATE_COLOR,
    GRID_COLOR,
    SERIES_COLORS,
    TRUE_PLACE_COLOR,
    in_own_settings,
    text_size,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.text import choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Metres: end of the axis of the allowed distance.
_MAX_DISTANCE_M: Final = 20.0
# Seconds: each bin has half a second, and the middle bin is around no error.
_TIME_EDGES_S: Final = np.arange(-2.25, 2.3, 0.5)
# Styles that distinguish lines even in print without colours.
_LINE_STYLES: Final = ("-", "--", "-.", ":")


@in_own_settings
def render_quality_by_time(
    evaluator: MotionEvaluator, step: float = 0.5, *, ax: Axes | None = None
) -> Axes:
    """Render the panoptic quality of each future frame, one line for each range.

    Args:
        evaluator: Evaluator with counted samples.
        step: Seconds from frame to frame.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in percent over seconds from the present. The quality in the result is computed
        from the sums over all frames.
    """
    ax, counts = axes_or_new(ax, PANEL), evaluator.counts.values()
    set_title(ax, "Panoptic quality by time ahead", fontsize="medium")
    frames = max((sample["frames"] for sample in counts), default=0)
    if not frames:
        return draw_nothing(ax)
    seconds = [step * frame for frame in range(frames)]
    colors = cycle(SERIES_COLORS[1:])
    for index, (name, color) in enumerate(zip(RANGES, colors, strict=False)):
        sums = [sample["vpq"][index] for sample in counts]
        quality = [_quality(sums, frame) for frame in range(frames)]
        ax.plot(seconds, quality, marker="o", color=color, label=f"{name} m")
    ax.set(xlabel="seconds from the present", ylabel="PQ (%)", ylim=(0, 104))
    ax.set_xticks(seconds)
    ax.legend(fontsize=text_size(), loc="lower left")
    return with_light_grid(ax, "y")


def _quality(samples: list[list[list[float]]], frame: int) -> float:
    """Return the PQ of one frame in percent; NaN without any instance.

    Each sample has four lists by frame: overlap, and numbers of true positives, false positives and
    false negatives.
    """
    present = [sample for sample in samples if frame < len(sample[0])]
    totals = []
    for kind in range(4):
        totals.append(math.fsum(sample[kind][frame] for sample in present))
    overlap = totals[0]
    matched, false, missed = map(int, totals[1:])
    if not matched + false + missed:
        return math.nan
    return 100 * panoptic_quality(overlap, matched, false, missed).pq


@in_own_settings
def render_accuracy(evaluator: AccidentEvaluator, *, ax: Axes | None = None) -> Axes:
    """Render the accident accuracy over the allowed error in distance.

    The three official distances are marked.

    Args:
        evaluator: Evaluator with counted samples. If its counts hold the error of each alarm, there
            is a curve from 0 to 20 m. The released protocol's counts hold only the outcomes at the
            official distances.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes; the title has the mean of the three, the accident prediction accuracy (APA).
    """
    ax, result = axes_or_new(ax, PANEL), evaluator.compute()
    distances = np.linspace(0, _MAX_DISTANCE_M, 201)
    curve = accuracy_by_distance(evaluator, distances)
    if curve is not None:
        ax.plot(distances, curve, drawstyle="steps-post", color=ESTIMATE_COLOR, linewidth=1.6)
        keep_free(ax, np.column_stack([distances, curve])[:, None])
    for distance, within in result.within.items():
        ax.axvline(distance, color=GRID_COLOR, linewidth=1, linestyle="--", zorder=0)
        if np.isfinite(within.accuracy):
            ax.plot(distance, within.accuracy, "o", color=ESTIMATE_COLOR, markersize=6)
            write_beside(ax, f"{within.accuracy:.3f}", (distance, within.accuracy), GRID_COLOR)
    ax.set(
        xlim=(0, _MAX_DISTANCE_M),
        ylim=(0, 1.04),
        xlabel="distance allowed (m)",
        ylabel="tp / (tp + fp/2 + fn/2)",
    )
    apa = "nothing to count" if np.isnan(result.apa) else f"APA {result.apa:.3f}"
    positives = f"{result.positives:,} of {result.samples:,} samples have an accident"
    set_title(ax, f"{apa}: mean of the three distances; {positives}", fontsize="medium")
    return with_light_grid(ax, "y")


@in_own_settings
def render_errors(
    evaluator: AccidentEvaluator, error: Literal["position", "time"], *, ax: Axes | None = None
) -> Axes:
    """Render a histogram of the errors of predicted accidents, for samples before an accident.

    Args:
        evaluator: Evaluator with counted samples, of a protocol with errors in its counts (not the
            released one).
        error: Error of `position`, metres; or of `time`, seconds by which the prediction is late.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes; values outside the bins are in the first and the last bin.
    """
    from matplotlib.ticker import MaxNLocator

    ax, values = axes_or_new(ax, PANEL), errors_of_first(evaluator, error)
    if error == "position":
        edges = np.arange(0, _MAX_DISTANCE_M + 1.1)
        label = "position errors of the two, sum (m); the last bin: and more"
        for distance in DISTANCES:
            ax.axvline(distance, color=GRID_COLOR, linestyle="--", zorder=0)
    else:
        edges = _TIME_EDGES_S
        label = "predicted moment minus true moment (s): late to the right"
    title = f"Errors of {error}: {len(values):,} accidents with a prediction"
    set_title(ax, title, fontsize="medium")
    if not len(values):
        return draw_nothing(ax, "no accident has a prediction")
    centers = (edges[:-1] + edges[1:]) / 2
    counts, _ = np.histogram(np.clip(values, centers[0], centers[-1]), edges)
    ax.bar(
        edges[:-1],
        counts,
        np.diff(edges),
        align="edge",
        color=ESTIMATE_COLOR,
        edgecolor="white",
        linewidth=0.5,
    )
    ax.set(xlabel=label, ylabel="accidents", xlim=(edges[0], edges[-1]))
    ax.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    return with_light_grid(ax, "y")


@in_own_settings
def render_alarms(evaluator: AccidentEvaluator, *, ax: Axes | None = None) -> Axes:
    """Render precision over recall of alarms, beginning with the most confident alarm.

    Args:
        evaluator: Evaluator with counted samples, of a protocol with scores of alarms (`boxes`).
        ax: Axes to render on; new ones if None.

    Returns:
        The axes: each point is all alarms of at least some score.
    """
    ax = axes_or_new(ax, PANEL)
    set_title(ax, "Alarms, the surest first", fontsize="medium")
    recall, precision = alarm_precision_recall(evaluator)
    if not len(recall):
        return draw_nothing(ax, "no alarms, or no accidents")
    ax.step(recall, precision, where="pre", color=ESTIMATE_COLOR, marker="o", markersize=4)
    ax.set(
        xlim=(0, 1.02),
        ylim=(0, 1.04),
        xlabel="recall: accidents foreseen",
        ylabel="precision: alarms that are true",
    )
    return with_light_grid(ax, "both")


def accuracy_by_distance(evaluator: AccidentEvaluator, distances: FloatArray) -> FloatArray | None:
    """Return tp / (tp + fp / 2 + fn / 2) at D allowed distances in metres, shape (D,).

    The value is NaN if nothing is counted, and the result's at the official distances. None if the
    protocol's counts do not hold the error of each alarm.
    """
    if not has_alarms(evaluator):
        return None
    samples = _samples(evaluator)
    accuracy = []
    for distance in distances.tolist():
        tp = fp = fn = 0
        for positive, alarms in samples:
            hit = positive and hit_of(alarms, distance) is not None
            tp += hit
            fp += len(alarms) - hit
            fn += positive and not hit
        accuracy.append(ratio(tp, tp + fp / 2 + fn / 2))
    return np.array(accuracy)


def has_alarms(evaluator: AccidentEvaluator) -> bool:
    """Return whether the counts hold the error of each alarm.

    The released protocol's counts hold only outcomes.
    """
    return isinstance(evaluator.protocol, BoxAccidents | PaperAccidents)


def errors_of_first(evaluator: AccidentEvaluator, error: Literal["position", "time"]) -> FloatArray:
    """Return the errors of the most important alarms of N samples before an accident, shape (N,).

    They are metres, or seconds too late, in the order of their tokens; samples without an alarm are
    left out.
    """
    errors = []
    for positive, alarms in _samples(evaluator):
        if positive and alarms and alarms[0][error] is not None:
            errors.append(alarms[0][error])
    return np.array(errors, dtype=np.float64)


def alarm_precision_recall(evaluator: AccidentEvaluator) -> tuple[FloatArray, FloatArray]:
    """Return recall and precision of all alarms with at least each score, highest score first.

    Each has shape (N,). Alarms with equal scores count together. Both are empty if there is no
    alarm or no accident, or if alarms have no scores.
    """
    if not isinstance(evaluator.protocol, BoxAccidents):
        return np.zeros(0), np.zeros(0)
    scored, positives = [], 0
    for positive, alarms in _samples(evaluator):
        hit = hit_of(alarms, ERRORS_AT) if positive else None
        scored += [(alarm["score"], alarm is hit) for alarm in alarms]
        positives += positive
    if not scored or not positives:
        return np.zeros(0), np.zeros(0)
    score, right = np.array(scored, dtype=np.float64).T
    order = np.argsort(-score, kind="stable")
    ends = np.flatnonzero(np.diff(score[order], append=-np.inf))
    hits = np.cumsum(right[order])[ends]
    return hits / positives, hits / (ends + 1)


def _samples(evaluator: AccidentEvaluator) -> list[tuple[bool, Sequence[Alarm]]]:
    """Return for each sample, by token, whether an accident comes, and its alarms.

    The most important alarm comes first.
    """
    samples = []
    for _, counts in sorted(evaluator.counts.items()):
        samples.append((bool(counts["positive"]), _alarms(evaluator.protocol, counts)))
    return samples


def _alarms(protocol: Any, sample: Counts) -> Sequence[Alarm]:
    if not isinstance(protocol, PaperAccidents):
        alarms: Sequence[Alarm] = sample["alarms"]
        return alarms
    compared = sample[protocol.sample_choice]
    if compared:
        return [compared]
    return []


@in_own_settings
def render_precision_recall(
    result: DetectionResult, name: str, *, ring: int = 0, ax: Axes | None = None
) -> Axes:
    """Render precision over recall of one class, one line for each threshold.

    Args:
        result: Result of `DetectionEvaluator.compute`.
        name: One of its classes.
        ring: Index of one of its ranges.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes; a line ends where the recall does, and its label has the average precision.

    Raises:
        ChoiceError: No such class, or no such range.
    """
    name = choice("name", name, result.classes)
    if ring not in range(len(result.ranges)):
        raise ChoiceError(f"ring: expected 0 to {len(result.ranges) - 1}, found {ring!r}")
    ax, row = axes_or_new(ax, PANEL), result.classes.index(name)
    truths, detections = int(result.truths[row, ring]), int(result.detections[row, ring])
    title = f"{name}: {truths:,} true, {detections:,} detected{_ring_text(result, ring)}"
    set_title(ax, title, fontsize="medium")
    if not truths:
        return draw_nothing(ax, "none in the truth")
    thresholds = result.thresholds[row].tolist()
    styles = zip(cycle(SERIES_COLORS), cycle(_LINE_STYLES))
    for level, (threshold, (color, line_style)) in enumerate(zip(thresholds, styles, strict=False)):
        precision, recall = result.precision[row, ring, level], result.recall[row, ring, level]
        reached = np.isfinite(recall) & (precision > 0)
        average = float(result.average_precision[row, ring, level])
        label = f"{threshold:g}: –"
        if math.isfinite(average):
            label = f"{threshold:g}: AP {average:.1f} %"
        width = 1.2 + 0.8 * (len(thresholds) - 1 - level)  # several equal curves stay visible
        ax.plot(
            recall[reached],
            precision[reached],
            line_style,
            color=color,
            label=label,
            linewidth=width,
        )
    ax.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", ylabel="precision")
    ax.legend(title="threshold", fontsize=text_size(), title_fontsize=text_size(), loc="best")
    return with_light_grid(ax, "both")


def _ring_text(result: DetectionResult, ring: int) -> str:
    """Return the words for a range; empty if there is only one."""
    if len(result.ranges) == 1:
        return ""
    low, high = result.ranges[ring].tolist()
    return f", {low:g} to {high:g} m"


@in_own_settings
def render_predictors(result: AnticipationResult, *, ax: Axes | None = None) -> Axes:
    """Render how well predictors distinguish accidents in advance from other recordings.

    Args:
        result: Result of `WarningEvaluator("clean").compute`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, for the first group of recordings: one bar for each predictor, the reference
        predictors included, and a line at 0.5, which is chance.
    """
    ax, group = axes_or_new(ax, PANEL), next(iter(result.groups), None)
    if group is None:
        return draw_nothing(ax, "no recording")
    predictors = {"given": result.groups[group]}
    for name, reference in result.references.items():
        predictors[name] = reference[group]
    bars = []
    for name, predictor in predictors.items():
        auc = predictor.auc_ahead
        bars.append(
            Bar(
                label=name,
                value=None if math.isnan(auc) else auc,
                text=f"{auc:.3f}",
                color=ESTIMATE_COLOR if name == "given" else TRUE_PLACE_COLOR,
            )
        )
    ax = draw_bars(bars, ax, 1.0)
    ax.axvline(0.5, color="black", linestyle="--", linewidth=1)
    ax.set(
        xlabel="chance that an accident's score is above\nanother recording's at the same moment"
    )
    set_title(ax, f"Accidents distinguished from other recordings\n{group}", fontsize="medium")
    return ax


@in_own_settings
def render_plans(result: PlanningResult, *, ax: Axes | None = None) -> Axes:
    """Render the accidents that plans avoid over their cost, at the leads of the protocol `clean`.

    Args:
        result: Result of `PlanningEvaluator("clean").compute`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, with a line for each plan, the trivial ones included: from the longest lead, where
        it is named, to the shortest.
    """
    ax = axes_or_new(ax, PANEL)
    tables = [table for name, table in result.means.items() if name in BY_LEAD]
    lines = {}
    for row in tables[0] if tables else ():
        lines[row] = [_cost_and_benefit(table[row]) for table in tables]
    points = [point for line in lines.values() for point in line]
    if not any(math.isfinite(lost + avoided) for lost, avoided in points):
        return draw_nothing(ax, "no accident with a twin")
    for (row, line), line_style in zip(lines.items(), cycle(_LINE_STYLES), strict=False):
        color = ESTIMATE_COLOR if row == GIVEN else TRUE_PLACE_COLOR
        lost, avoided = zip(*line, strict=True)
        ax.plot(lost, avoided, color=color, linestyle=line_style, marker="o", markersize=4)
        place_chips(ax, [(row, line[0])])
    ax.set(
        xlabel="progress lost in twins (%)",
        ylabel="accidents avoided (%)",
        ymargin=0.1,
        xmargin=0.1,
    )
    title = f"Accidents avoided, and what that costs\n{BY_LEAD[0]} (named) to {BY_LEAD[-1]}"
    set_title(ax, title, fontsize="medium")
    return with_light_grid(ax, "both")


def _cost_and_benefit(means: Mapping[str, float]) -> tuple[float, float]:
    return means.get("lost_twins", math.nan), means.get("avoided", math.nan)
