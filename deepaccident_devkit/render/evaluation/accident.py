"""Accident results as pictures: accuracy over the allowed distance, errors, and alarms by their score."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deepaccident_devkit.evaluation.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.accident.boxes import BoxAccidents
from deepaccident_devkit.evaluation.accident.paper import PaperAccidents
from deepaccident_devkit.evaluation.accident.scoring import DISTANCES, ERRORS_AT, Alarm, hit_of
from deepaccident_devkit.evaluation.evaluator import Counts, ratio
from deepaccident_devkit.render.axes import axes_or_new, with_light_grid
from deepaccident_devkit.render.boxes import write_beside
from deepaccident_devkit.render.chips import keep_free
from deepaccident_devkit.render.colors import ESTIMATE_COLOR, GRID_COLOR
from deepaccident_devkit.render.evaluation.panels import PANEL, draw_nothing
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_title
from deepaccident_devkit.support.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FARTHEST: Final = 20.0
"""Metres: where the axis of the allowed distance ends."""
_TIME_EDGES: Final = np.arange(-2.25, 2.3, 0.5)
"""Seconds: each bin has half a second, and the middle bin is around no error."""


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
    ax.set(xlim=(0, _FARTHEST), ylim=(0, 1.04), xlabel="distance allowed (m)", ylabel="tp / (tp + fp/2 + fn/2)")
    apa = "nothing to count" if np.isnan(result.apa) else f"APA {result.apa:.3f}"
    positives = f"{result.positives:,} of {result.samples:,} samples have an accident"
    set_title(ax, f"{apa}: mean of the three distances; {positives}", fontsize="medium")
    return with_light_grid(ax, "y")


@in_own_settings
def render_errors(evaluator: AccidentEvaluator, error: Literal["position", "time"], *, ax: Axes | None = None) -> Axes:
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
        edges, label = np.arange(0, _FARTHEST + 1.1), "position errors of the two, sum (m); the last bin: and more"
        for distance in DISTANCES:
            ax.axvline(distance, color=GRID_COLOR, linestyle="--", zorder=0)
    else:
        edges, label = _TIME_EDGES, "predicted moment minus true moment (s): late to the right"
    set_title(ax, f"Errors of {error}: {len(values):,} accidents with a prediction", fontsize="medium")
    if not len(values):
        return draw_nothing(ax, "no accident has a prediction")
    middles = (edges[:-1] + edges[1:]) / 2
    counts, _ = np.histogram(np.clip(values, middles[0], middles[-1]), edges)
    ax.bar(edges[:-1], counts, np.diff(edges), align="edge", color=ESTIMATE_COLOR, edgecolor="white", linewidth=0.5)
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
        xlim=(0, 1.02), ylim=(0, 1.04), xlabel="recall: accidents foreseen", ylabel="precision: alarms that are true"
    )
    return with_light_grid(ax, "both")


def accuracy_by_distance(evaluator: AccidentEvaluator, distances: FloatArray) -> FloatArray | None:
    """The accident accuracy at each of some allowed distances; at the official ones it is the result's.

    Args:
        evaluator: with samples counted.
        distances: (D,) metres.

    Returns:
        (D,) tp / (tp + fp / 2 + fn / 2), NaN if nothing is counted; None if the protocol's counts do not hold how
        far off each alarm is.
    """
    protocol = evaluator.protocol
    if not isinstance(protocol, BoxAccidents | PaperAccidents):
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
    """How far off the most important alarm of each sample before an accident is, without a limit.

    Args:
        evaluator: with samples counted.
        error: of `position`, metres, or of `time`, seconds, positive if the alarm is for later.

    Returns:
        (N,) in the order of the samples' tokens; samples without an alarm are left out.
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
