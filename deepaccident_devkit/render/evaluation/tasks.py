"""The panels of each task: quality by time, accuracy, errors and alarms, precision over recall, predictors."""

from __future__ import annotations

import math
from collections.abc import Sequence
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

# Metres: where the axis of the allowed distance ends.
_FARTHEST: Final = 20.0
# Seconds: each bin has half a second, and the middle bin is around no error.
_TIME_EDGES: Final = np.arange(-2.25, 2.3, 0.5)
# Styles that distinguish lines even in print without colours.
_DASHES: Final = ("-", "--", "-.", ":")


@in_own_settings
def render_quality_by_time(
    evaluator: MotionEvaluator, step: float = 0.5, *, ax: Axes | None = None
) -> Axes:
    """Render the panoptic quality of each future frame, one line for each range.

    Args:
        evaluator: with samples counted.
        step: seconds from frame to frame.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in percent over seconds from the present. The quality in the result is computed from the sums over
        all frames.
    """
    ax, counts = axes_or_new(ax, PANEL), evaluator.counts.values()
    set_title(ax, "Panoptic quality by time ahead", fontsize="medium")
    frames = max((each["frames"] for each in counts), default=0)
    if not frames:
        return draw_nothing(ax)
    given = [each["vpq"] for each in counts]
    for index, (name, color) in enumerate(zip(RANGES, cycle(SERIES_COLORS[1:]), strict=False)):
        quality = [_quality([each[index] for each in given], frame) for frame in range(frames)]
        ax.plot(
            [step * frame for frame in range(frames)],
            quality,
            marker="o",
            color=color,
            label=f"{name} m",
        )
    ax.set(xlabel="seconds from the present", ylabel="PQ (%)", ylim=(0, 104))
    ax.set_xticks([step * frame for frame in range(frames)])
    ax.legend(fontsize=text_size(), loc="lower left")
    return with_light_grid(ax, "y")


def _quality(samples: list[list[list[float]]], frame: int) -> float:
    """PQ in percent of one frame, from the four lists by frame of each sample; NaN without any instance."""
    there = [[values[frame] for values in each] for each in samples if frame < len(each[0])]
    overlap, *numbers = (math.fsum(each[kind] for each in there) for kind in range(4))
    found, false, missed = map(int, numbers)
    if not found + false + missed:
        return math.nan
    return 100 * panoptic_quality(overlap, found, false, missed).pq


@in_own_settings
def render_accuracy(evaluator: AccidentEvaluator, *, ax: Axes | None = None) -> Axes:
    """Render the accident accuracy over the distance that a prediction may be off, with the three official distances.

    Args:
        evaluator: with samples counted. If its counts hold how far off each alarm is, there is a curve from 0 to 20 m.
            The released protocol's counts hold only the outcomes at the official distances.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; the title says the mean of the three, the accident prediction accuracy (APA).
    """
    ax, result = axes_or_new(ax, PANEL), evaluator.compute()
    allowed = np.linspace(0, _FARTHEST, 201)
    curve = accuracy_by_distance(evaluator, allowed)
    if curve is not None:
        ax.plot(allowed, curve, drawstyle="steps-post", color=ESTIMATE_COLOR, linewidth=1.6)
        keep_free(ax, np.column_stack([allowed, curve])[:, None])
    for distance, within in result.within.items():
        ax.axvline(distance, color=GRID_COLOR, linewidth=1, linestyle="--", zorder=0)
        if np.isfinite(within.accuracy):
            ax.plot(distance, within.accuracy, "o", color=ESTIMATE_COLOR, markersize=6)
            write_beside(ax, f"{within.accuracy:.3f}", (distance, within.accuracy), GRID_COLOR)
    ax.set(
        xlim=(0, _FARTHEST),
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
    """Render a histogram of how far off the predicted accidents are, for samples before an accident.

    Args:
        evaluator: with samples counted, of a protocol whose counts hold the errors (not the released one).
        error: of `position`, metres; or of `time`, seconds by which the prediction is late.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; values outside the bins are in the first and the last bin.
    """
    from matplotlib.ticker import MaxNLocator

    ax, values = axes_or_new(ax, PANEL), errors_of_first(evaluator, error)
    if error == "position":
        edges, label = (
            np.arange(0, _FARTHEST + 1.1),
            "position errors of the two, sum (m); the last bin: and more",
        )
        for distance in DISTANCES:
            ax.axvline(distance, color=GRID_COLOR, linestyle="--", zorder=0)
    else:
        edges, label = _TIME_EDGES, "predicted moment minus true moment (s): late to the right"
    set_title(
        ax, f"Errors of {error}: {len(values):,} accidents with a prediction", fontsize="medium"
    )
    if not len(values):
        return draw_nothing(ax, "no accident has a prediction")
    middles = (edges[:-1] + edges[1:]) / 2
    counts, _ = np.histogram(np.clip(values, middles[0], middles[-1]), edges)
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
    """Render precision over recall of alarms, beginning with the surest alarm.

    Args:
        evaluator: with samples counted, of a protocol whose alarms have scores (`boxes`).
        ax: axes to render on; new ones if None.

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
    """(D,) tp / (tp + fp / 2 + fn / 2) at D allowed distances in metres; NaN if nothing is counted.

    At the official ones it is the result's. None if the protocol's counts do not hold how far off each alarm is.
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
    """Whether the counts hold how far off each alarm is; the released protocol's counts hold only outcomes."""
    return isinstance(evaluator.protocol, BoxAccidents | PaperAccidents)


def errors_of_first(evaluator: AccidentEvaluator, error: Literal["position", "time"]) -> FloatArray:
    """(N,) how far off (metres, or seconds too late) the most important alarm is, of N samples before an accident.

    They are in the order of their tokens; samples without an alarm are left out.
    """
    firsts = [alarms[0][error] for positive, alarms in _samples(evaluator) if positive and alarms]
    return np.array([value for value in firsts if value is not None], dtype=np.float64)


def alarm_precision_recall(evaluator: AccidentEvaluator) -> tuple[FloatArray, FloatArray]:
    """Recall and precision, (N,) each, of all alarms with at least each score, the highest score first.

    Alarms with equal scores count together. Both are empty if there is no alarm or no accident, or if alarms have no
    scores.
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
    last = np.flatnonzero(np.diff(score[order], append=-np.inf))
    found = np.cumsum(right[order])[last]
    return found / positives, found / (last + 1)


def _samples(evaluator: AccidentEvaluator) -> list[tuple[bool, Sequence[Alarm]]]:
    """For each sample, in the order of tokens: whether an accident comes, and its alarms, the most important first."""
    counts = sorted(evaluator.counts.items())
    return [(bool(sample["positive"]), _alarms(evaluator.protocol, sample)) for _, sample in counts]


def _alarms(protocol: Any, sample: Counts) -> Sequence[Alarm]:
    if isinstance(protocol, PaperAccidents):
        compared = sample[protocol.sample_choice]
        return [compared] if compared else []
    alarms: Sequence[Alarm] = sample["alarms"]
    return alarms


@in_own_settings
def render_precision_recall(
    result: DetectionResult, name: str, *, ring: int = 0, ax: Axes | None = None
) -> Axes:
    """Render precision over recall of one class, one line for each threshold.

    Args:
        result: of `DetectionEvaluator.compute`.
        name: one of its classes.
        ring: which of its ranges.
        ax: axes to render on; new ones if None.

    Returns:
        The axes; a line ends where the recall does, and its label says the average precision.

    Raises:
        ChoiceError: no such class, or no such range.
    """
    name = choice("name", name, result.classes)
    if ring not in range(len(result.ranges)):
        raise ChoiceError(f"ring: expected 0 to {len(result.ranges) - 1}, found {ring!r}")
    ax, row = axes_or_new(ax, PANEL), result.classes.index(name)
    truths, found = int(result.truths[row, ring]), int(result.detections[row, ring])
    set_title(
        ax,
        f"{name}: {truths:,} true, {found:,} detected{_ring_text(result, ring)}",
        fontsize="medium",
    )
    if not truths:
        return draw_nothing(ax, "none in the truth")
    count = result.thresholds.shape[1]
    styles = zip(cycle(SERIES_COLORS), cycle(_DASHES))
    for level, (threshold, (color, dash)) in enumerate(
        zip(result.thresholds[row].tolist(), styles, strict=False)
    ):
        precision, recall = result.precision[row, ring, level], result.recall[row, ring, level]
        reached = np.isfinite(recall) & (precision > 0)
        average = float(result.average_precision[row, ring, level])
        label = (
            f"{threshold:g}: AP {average:.1f} %" if math.isfinite(average) else f"{threshold:g}: –"
        )
        width = 1.2 + 0.8 * (count - 1 - level)  # so that all of several equal curves are seen
        ax.plot(
            recall[reached], precision[reached], dash, color=color, label=label, linewidth=width
        )
    ax.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="recall", ylabel="precision")
    ax.legend(title="threshold", fontsize=text_size(), title_fontsize=text_size(), loc="best")
    return with_light_grid(ax, "both")


def _ring_text(result: DetectionResult, ring: int) -> str:
    """Which range it is, where there are several."""
    if len(result.ranges) == 1:
        return ""
    low, high = result.ranges[ring].tolist()
    return f", {low:g} to {high:g} m"


@in_own_settings
def render_predictors(result: AnticipationResult, *, ax: Axes | None = None) -> Axes:
    """Render how well accidents are distinguished from other recordings before they happen, and reference predictors.

    Args:
        result: of `WarningEvaluator("clean").compute`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, for the first group of recordings: one bar for each predictor, and a line at 0.5, which is chance.
    """
    ax, group = axes_or_new(ax, PANEL), next(iter(result.groups), None)
    if group is None:
        return draw_nothing(ax, "no recording")
    everyone = {
        "given": result.groups[group],
        **{name: each[group] for name, each in result.references.items()},
    }
    bars = [
        Bar(
            label=name,
            value=None if math.isnan(each.auc_ahead) else each.auc_ahead,
            text=f"{each.auc_ahead:.3f}",
            color=ESTIMATE_COLOR if name == "given" else TRUE_PLACE_COLOR,
        )
        for name, each in everyone.items()
    ]
    ax = draw_bars(bars, ax, 1.0)
    ax.axvline(0.5, color="black", linestyle="--", linewidth=1)
    ax.set(
        xlabel="chance that an accident's score is above\nanother recording's at the same moment"
    )
    set_title(ax, f"Accidents distinguished from other recordings\n{group}", fontsize="medium")
    return ax


@in_own_settings
def render_plans(result: PlanningResult, *, ax: Axes | None = None) -> Axes:
    """Render how many accidents plans avoid over what that costs, at the leads of the protocol `clean`.

    Args:
        result: of `PlanningEvaluator("clean").compute`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, with a line for each plan, the trivial ones among them: from the longest lead, where it is named, to
        the shortest.
    """
    ax, tables = (
        axes_or_new(ax, PANEL),
        [table for name, table in result.means.items() if name in BY_LEAD],
    )
    lines = {
        row: [
            (table[row].get("lost_twins", math.nan), table[row].get("avoided", math.nan))
            for table in tables
        ]
        for row in (tables[0] if tables else ())
    }
    if not any(
        math.isfinite(lost + avoided) for points in lines.values() for lost, avoided in points
    ):
        return draw_nothing(ax, "no accident with a twin")
    for (row, points), dash in zip(lines.items(), cycle(_DASHES), strict=False):
        color = ESTIMATE_COLOR if row == GIVEN else TRUE_PLACE_COLOR
        ax.plot(*zip(*points, strict=True), color=color, linestyle=dash, marker="o", markersize=4)
        place_chips(ax, [(row, points[0])])
    ax.set(
        xlabel="progress lost in twins (%)",
        ylabel="accidents avoided (%)",
        ymargin=0.1,
        xmargin=0.1,
    )
    set_title(
        ax,
        f"Accidents avoided, and what that costs\n{BY_LEAD[0]} (named) to {BY_LEAD[-1]}",
        fontsize="medium",
    )
    return with_light_grid(ax, "both")
