"""Panels for each task: quality by time, accuracy, errors, alarms, precision, predictors, plans."""

from __future__ import annotations

import math
from itertools import cycle
from typing import TYPE_CHECKING, Literal

import numpy as np

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents, is_skipped
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.scoring import DISTANCES, ERRORS_AT, Alarm, hit_of
from deepaccident_devkit.evaluation.detection import DetectionResult
from deepaccident_devkit.evaluation.evaluator import ratio
from deepaccident_devkit.evaluation.instances import panoptic_quality
from deepaccident_devkit.evaluation.motion import RANGES, MotionEvaluator
from deepaccident_devkit.evaluation.planning import PlanningResult
from deepaccident_devkit.evaluation.planning.evaluator import BY_LEAD, PLAN_ROW
from deepaccident_devkit.evaluation.warning import AnticipationResult
from deepaccident_devkit.render.boxes import write_beside
from deepaccident_devkit.render.captions import draw_legend_outside
from deepaccident_devkit.render.chips import DOT_MARGIN_PT, keep_free, keep_line_free, place_chips
from deepaccident_devkit.render.evaluation.panels import (
    PANEL,
    Bar,
    draw_bars,
    draw_nothing,
    title_panel,
)
from deepaccident_devkit.render.figures import axes_or_new, with_light_grid
from deepaccident_devkit.render.styles import (
    ESTIMATE_COLOR,
    GRID_COLOR,
    SERIES_COLORS,
    TRUE_PLACE_COLOR,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.human_names import human_name, metric_name
from deepaccident_devkit.support.text import choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Upper end of the axis for the allowed distance, metres.
_MAX_DISTANCE_M = 20.0
# Edges of the bins for time errors, seconds; the middle bin is centred on zero.
_TIME_EDGES_S = np.arange(-2.25, 2.3, 0.5)
# Styles that distinguish lines even in print without colours.
_LINE_STYLES = ("-", "--", "-.", ":")


@in_own_settings
def render_quality_by_time(
    evaluator: MotionEvaluator, step: float = 0.5, *, ax: Axes | None = None
) -> Axes:
    """Render the panoptic quality of each future frame, one line for each range.

    Args:
        evaluator: Evaluator to which samples have been added.
        step: Seconds from frame to frame.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in percent over seconds from t = 0. (The quality in the result is not the mean of
        these values; it is computed from sums over all frames.)
    """
    ax = axes_or_new(ax, PANEL)
    counts_of_samples = evaluator.counts.values()
    title_panel(ax, "Video panoptic quality by time ahead")
    frames = max((counts["frames"] for counts in counts_of_samples), default=0)
    if not frames:
        return draw_nothing(ax)
    seconds = [step * frame for frame in range(frames)]
    colors = cycle(SERIES_COLORS[1:])
    for index, (name, color) in enumerate(zip(RANGES, colors, strict=False)):
        range_counts = [counts["vpq"][index] for counts in counts_of_samples]
        quality = [_frame_quality(range_counts, frame) for frame in range(frames)]
        ax.plot(seconds, quality, marker="o", color=color, label=human_name(name))
    ax.set(xlabel="time ahead (s)", ylabel="VPQ (%)", ylim=(0, 104))
    ax.set_xticks(seconds)
    draw_legend_outside(ax, ax.get_legend_handles_labels()[0])
    return with_light_grid(ax, "y")


def _frame_quality(counts_of_samples: list[list[list[float]]], frame: int) -> float:
    """Return the PQ of one frame in percent; NaN if there is no instance.

    The counts of a sample are four lists, each with one entry per frame: overlap, true positives,
    false positives and false negatives.
    """
    frame_counts = []
    for counts in counts_of_samples:
        overlaps = counts[0]
        if frame < len(overlaps):
            frame_counts.append([values[frame] for values in counts])
    overlap, *totals = map(math.fsum, zip([0.0] * 4, *frame_counts, strict=True))
    matched, false, missed = map(int, totals)
    if not matched + false + missed:
        return math.nan
    quality = panoptic_quality(overlap, matched, false, missed)
    return 100 * quality.pq


@in_own_settings
def render_accuracy(evaluator: AccidentEvaluator, *, ax: Axes | None = None) -> Axes:
    """Render the accident accuracy over the allowed position error.

    The three official distances are marked.

    Args:
        evaluator: Evaluator to which samples have been added. If its counts contain the error of
            each alarm, there is a curve from 0 to 20 m. The released protocol's counts only contain
            the outcomes at the official distances.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes. The title states the accident prediction accuracy (APA), which is the mean over
        the three distances.
    """
    ax = axes_or_new(ax, PANEL)
    result = evaluator.compute()
    distances = np.linspace(0, _MAX_DISTANCE_M, 201)
    curve = accuracy_by_distance(evaluator, distances)
    if curve is not None:
        ax.plot(distances, curve, drawstyle="steps-post", color=ESTIMATE_COLOR, linewidth=1.6)
        points = np.column_stack([distances, curve])
        keep_free(ax, points[:, None])
    for distance, within in result.within.items():
        ax.axvline(distance, color=GRID_COLOR, linewidth=1, linestyle="--", zorder=0)
        if np.isfinite(within.accuracy):
            ax.plot(distance, within.accuracy, "o", color=ESTIMATE_COLOR, markersize=6)
            write_beside(ax, f"{within.accuracy:.3f}", (distance, within.accuracy), GRID_COLOR)
    ax.set(
        xlim=(0, _MAX_DISTANCE_M),
        ylim=(0, 1.04),
        xlabel="allowed position error (m)",
        ylabel="TP / (TP + FP/2 + FN/2)",
    )
    apa = "nothing to count"
    if not np.isnan(result.apa):
        apa = f"APA {result.apa:.3f}, the mean of the three dots"
    positives = f"an accident follows in {result.positives:,} of {result.samples:,} samples"
    title_panel(ax, f"{apa}; {positives}")
    return with_light_grid(ax, "y")


@in_own_settings
def render_errors(
    evaluator: AccidentEvaluator, error: Literal["position", "time"], *, ax: Axes | None = None
) -> Axes:
    """Render a histogram of the errors of predicted accidents, for samples before an accident.

    Args:
        evaluator: Evaluator to which samples have been added, with a protocol whose counts contain
            errors (not the released one).
        error: `position` (metres), or `time` (seconds by which the prediction is late).
        ax: Axes to render on; new ones if None.

    Returns:
        The axes; values outside the bins are counted in the first and the last bin.
    """
    from matplotlib.ticker import MaxNLocator

    ax = axes_or_new(ax, PANEL)
    values = errors_of_first(evaluator, error)
    if error == "position":
        edges = np.arange(0, _MAX_DISTANCE_M + 1.1)
        label = "position errors of both actors, summed (m)\nlast bin: over 20 m"
        for distance in DISTANCES:
            ax.axvline(distance, color=GRID_COLOR, linestyle="--", zorder=0)
    else:
        edges = _TIME_EDGES_S
        label = "predicted minus true time (s); positive is late"
    title_panel(ax, f"{error.capitalize()} error (n = {len(values):,} predicted accidents)")
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
        evaluator: Evaluator to which samples have been added, with a protocol whose alarms have
            scores (`boxes`).
        ax: Axes to render on; new ones if None.

    Returns:
        The axes; each point of the curve is for all alarms with at least a certain score.
    """
    ax = axes_or_new(ax, PANEL)
    title_panel(ax, "Precision–recall curve of alarms")
    recall, precision = alarm_precision_recall(evaluator)
    if not len(recall):
        return draw_nothing(ax, "no alarms, or no accidents")
    ax.step(recall, precision, where="pre", color=ESTIMATE_COLOR, marker="o", markersize=4)
    ax.set(
        xlim=(0, 1.02),
        ylim=(0, 1.04),
        xlabel="recall: share of the accidents that are predicted",
        ylabel="precision: share of right alarms",
    )
    return with_light_grid(ax, "both")


def accuracy_by_distance(evaluator: AccidentEvaluator, distances: FloatArray) -> FloatArray | None:
    """Return the accuracy tp / (tp + fp / 2 + fn / 2) at allowed distances (D,), metres.

    At the official distances, the values equal the result's. A value is NaN if nothing is
    counted. Returns None if the protocol's counts do not contain the error of each alarm.
    """
    if not has_alarms(evaluator):
        return None
    samples = _samples(evaluator)
    accuracy = []
    for distance in distances.tolist():
        tp = 0
        fp = 0
        fn = 0
        for positive, alarms in samples:
            hit = positive and hit_of(alarms, distance) is not None
            tp += hit
            fp += len(alarms) - hit
            fn += positive and not hit
        accuracy.append(ratio(tp, tp + fp / 2 + fn / 2))
    return np.array(accuracy)


def has_alarms(evaluator: AccidentEvaluator) -> bool:
    """Return whether the counts contain the error of each alarm.

    The released protocol's counts contain only outcomes.
    """
    return isinstance(evaluator.protocol, BoxAccidents | PaperAccidents)


def errors_of_first(evaluator: AccidentEvaluator, error: Literal["position", "time"]) -> FloatArray:
    """Return the error of the highest-ranked alarm of each sample before an accident, shape (N,).

    Errors are in metres, or in seconds by which the alarm is late. Samples are in the order of
    their tokens; samples without an alarm are left out.
    """
    errors = []
    for positive, alarms in _samples(evaluator):
        if positive and alarms:
            first_alarm = alarms[0]
            errors.append(first_alarm[error])
    errors = [value for value in errors if value is not None]
    return np.array(errors, dtype=np.float64)


def alarm_precision_recall(evaluator: AccidentEvaluator) -> tuple[FloatArray, FloatArray]:
    """Return recall and precision, shape (N,) each, at N falling score thresholds.

    Each value is for all alarms with at least that score; alarms with equal scores count together.
    Both arrays are empty if there is no alarm or no accident, or if alarms have no scores.
    """
    nothing = np.zeros(0)
    if not isinstance(evaluator.protocol, BoxAccidents):
        return nothing, nothing
    scored_alarms = []
    positives = 0
    for positive, alarms in _samples(evaluator):
        hit = hit_of(alarms, ERRORS_AT) if positive else None
        scored_alarms += [(alarm["score"], alarm is hit) for alarm in alarms]
        positives += positive
    if not scored_alarms or not positives:
        return nothing, nothing
    score, is_right = np.array(scored_alarms, dtype=np.float64).T
    order = np.argsort(-score, kind="stable")
    last_of_scores = np.flatnonzero(np.diff(score[order], append=-np.inf))
    hits = np.cumsum(is_right[order])[last_of_scores]
    alarm_counts = last_of_scores + 1
    return hits / positives, hits / alarm_counts


def _samples(evaluator: AccidentEvaluator) -> list[tuple[bool, list[Alarm]]]:
    """Return (whether an accident follows, alarms, the highest-ranked first) by sample that counts.

    Samples are in the order of their tokens.
    """
    protocol = evaluator.protocol
    samples = []
    for _, counts in sorted(evaluator.counts.items()):
        if isinstance(protocol, BoxAccidents) and is_skipped(counts):
            continue
        if isinstance(protocol, PaperAccidents):
            compared = counts[protocol.sample_choice]
            alarms = [compared] if compared else []
        else:
            alarms = counts["alarms"]
        samples.append((bool(counts["positive"]), alarms))
    return samples


@in_own_settings
def render_precision_recall(
    result: DetectionResult, name: str, *, ring: int = 0, ax: Axes | None = None
) -> Axes:
    """Render precision over recall of one class, one line for each threshold.

    Args:
        result: Result of `DetectionEvaluator.compute`.
        name: Class to render.
        ring: Index of the range to render.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes. Each line ends at the highest recall that is reached; its label states the average
        precision.

    Raises:
        ChoiceError: No such class, or no such range.
    """
    name = choice("name", name, result.classes)
    if ring not in range(len(result.ranges)):
        raise ChoiceError(f"ring: expected 0 to {len(result.ranges) - 1}, found {ring!r}")
    ax = axes_or_new(ax, PANEL)
    row = result.classes.index(name)
    truths = int(result.truths[row, ring])
    detections = int(result.detections[row, ring])
    title = f"{human_name(name)}: {truths:,} true and {detections:,} detected boxes"
    if len(result.ranges) > 1:
        low, high = result.ranges[ring].tolist()
        title += f", {low:g} to {high:g} m"
    title_panel(ax, title)
    if not truths:
        return draw_nothing(ax, "no true boxes")
    thresholds = result.thresholds[row].tolist()
    styles = zip(cycle(SERIES_COLORS), cycle(_LINE_STYLES))
    for level, (threshold, (color, line_style)) in enumerate(zip(thresholds, styles, strict=False)):
        precision = result.precision[row, ring, level]
        recall = result.recall[row, ring, level]
        is_reached = np.isfinite(recall) & (precision > 0)
        average = float(result.average_precision[row, ring, level])
        label = f"AP at {threshold:g}: –"
        if math.isfinite(average):
            label = f"AP at {threshold:g}: {average:.1f} %"
        width = 1.2 + 0.8 * (len(thresholds) - 1 - level)  # several equal curves stay visible
        ax.plot(
            recall[is_reached],
            precision[is_reached],
            line_style,
            color=color,
            label=label,
            linewidth=width,
        )
    ax.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", ylabel="precision")
    draw_legend_outside(ax, ax.get_legend_handles_labels()[0])
    return with_light_grid(ax, "both")


@in_own_settings
def render_predictors(result: AnticipationResult, *, ax: Axes | None = None) -> Axes:
    """Render how well predictors can tell, in advance, accidents from other recordings.

    Args:
        result: Result of `WarningEvaluator("clean").compute`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, for the first group of recordings: one bar for each predictor, including the
        reference predictors, and a line at 0.5, the level of chance.
    """
    ax = axes_or_new(ax, PANEL)
    if not result.groups:
        return draw_nothing(ax, "no recording")
    group = next(iter(result.groups))
    predictors = {"given": result.groups[group]}
    for name, reference in result.references.items():
        predictors[name] = reference[group]
    bars = []
    for name, predictor in predictors.items():
        auc = predictor.auc_ahead
        bars.append(
            Bar(
                label=human_name(name),
                value=None if math.isnan(auc) else auc,
                text=f"{auc:.3f}",
                color=ESTIMATE_COLOR if name == "given" else TRUE_PLACE_COLOR,
            )
        )
    ax = draw_bars(bars, ax, 1.0)
    ax.axvline(0.5, color="black", linestyle="--", linewidth=1)
    ax.set(xlabel="chance that an accident scores\nabove another recording\n(dashed: pure chance)")
    title_panel(ax, f"{metric_name('auc_ahead')}:\n{human_name(group)}")
    return ax


@in_own_settings
def render_plans(result: PlanningResult, *, ax: Axes | None = None) -> Axes:
    """Render the accidents that plans avoid over the plans' cost, at the leads of `clean`.

    Args:
        result: Result of `PlanningEvaluator("clean").compute`.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, with a line for each plan, including the trivial ones. A line starts at the
        longest lead, with a large dot and the plan's name, and ends at the shortest.
    """
    ax = axes_or_new(ax, PANEL)
    lines: dict[str, list[tuple[float, float]]] = {}
    has_point = False
    for name, table in result.means.items():
        if name not in BY_LEAD:
            continue
        for plan, means in table.items():
            lost = means.get("lost_twins", math.nan)
            avoided = means.get("avoided", math.nan)
            lines.setdefault(plan, []).append((lost, avoided))
            has_point |= math.isfinite(lost + avoided)
    if not has_point:
        return draw_nothing(ax, "no accident with a twin")
    chips = []
    for (plan, points), line_style in zip(lines.items(), cycle(_LINE_STYLES), strict=False):
        color = ESTIMATE_COLOR if plan == PLAN_ROW else TRUE_PLACE_COLOR
        x, y = zip(*points, strict=True)
        ax.plot(x, y, color=color, linestyle=line_style, marker="o", markersize=3)
        ax.plot(x[0], y[0], "o", color=color, markersize=7)
        known_points = np.array([point for point in points if np.isfinite(point).all()])
        keep_line_free(ax, known_points, margin=DOT_MARGIN_PT)
        chips.append((human_name(plan), points[0]))
    place_chips(ax, chips)
    first_lead, last_lead = (lead.removeprefix("lead ") for lead in (BY_LEAD[0], BY_LEAD[-1]))
    ax.set(
        xlabel=f"progress lost in twins (%)\nlarge dot: lead of {first_lead}; "
        f"the line ends at {last_lead}",
        ylabel="accidents avoided (%)",
        ymargin=0.15,
        xmargin=0.15,
    )
    title_panel(ax, "Accidents avoided vs. progress lost")
    return with_light_grid(ax, "both")
