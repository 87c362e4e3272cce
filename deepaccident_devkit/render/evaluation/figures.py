"""The figures of a run, with its worst and best samples, and their files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.accident import AccidentEvaluator, compared_accidents
from deepaccident_devkit.evaluation.breakdowns import EVERYTHING, WITHIN_RECORDINGS, Breakdown
from deepaccident_devkit.evaluation.detection import DetectedBoxes, DetectionEvaluator
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.planning.evaluator import BY_LEAD
from deepaccident_devkit.evaluation.predictions import MotionOutput, frames_there, labels_at_present
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.evaluation.runs.further import extra_result
from deepaccident_devkit.evaluation.runs.setups import SampleLoader
from deepaccident_devkit.evaluation.task import Headline, headlines
from deepaccident_devkit.evaluation.warning import AnticipationResult
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.captions import draw_legend_of_fills, set_scene_title, set_title
from deepaccident_devkit.render.evaluation import tasks
from deepaccident_devkit.render.evaluation.panels import PANEL, UNKNOWN, render_breakdown
from deepaccident_devkit.render.figures import (
    axes_or_new,
    report_figure,
    titled_from_above,
    write_report_figure,
)
from deepaccident_devkit.render.outcomes import draw_accident_outcome, draw_detection_outcome
from deepaccident_devkit.render.styles import (
    MUTED_COLOR,
    OUTCOME_COLORS,
    WARNING_COLOR,
    current_style,
    in_own_settings,
)
from deepaccident_devkit.support.arrays import BoolArray
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI: Final = 160
# Inches: least height of a bar.
_MIN_BAR_HEIGHT_IN: Final = 0.38
# Inches of a title, ticks and labels.
_FRAME_HEIGHT_IN: Final = 1.1
# Marks the words on a figure's origin. They are for copying and not for reading, so they may be
# small.
_ORIGIN_GID: Final = "token"
_TIME_ATTRIBUTE: Final = "time_to_impact"
# Number of the worst, and of the best, samples with a figure.
_SAMPLES_PER_KIND: Final = 3
# Inches of a view from above with its title.
_VIEW_HEIGHT_IN: Final = 5.6


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFigure:
    """One figure of a run.

    Attributes:
        name: Name of its file, without the ending.
        caption: Description of the figure, for the reader of the report.
        alt: The same in words and numbers, for readers who cannot see it.
        draw: Function that renders it on `ax=`, axes.
        height: Height in inches.
    """

    name: str
    caption: str
    alt: str
    draw: Callable[..., Axes]
    height: float = PANEL[1]


def save_figure(run: EvaluationRun, run_figure: RunFigure, folder: Path) -> Path:
    """Render a figure of a run into a PNG file of a folder, as `write_report_figure` does.

    An existing file is replaced.
    """
    parts = (_partial_text(run), _origin_text(run))
    words = {"Title": run_figure.name, "Description": " ".join(part for part in parts if part)}
    path = folder / f"{run_figure.name}.png"
    return write_report_figure(complete_figure(run, run_figure), path, dpi=_DPI, words=words)


@in_own_settings
def complete_figure(run: EvaluationRun, run_figure: RunFigure) -> Figure:
    """Return a figure with the gaps of a partial run as its title.

    Its task, protocol, devkit and release are below, unless it is for a paper or a slide.
    """
    figure = report_figure((PANEL[0], run_figure.height), panels="one")
    run_figure.draw(ax=figure.add_subplot())
    if not current_style().few:
        figure.supxlabel(_origin_text(run), fontsize=6, color=MUTED_COLOR, gid=_ORIGIN_GID)
    partial_text = _partial_text(run)
    if partial_text:
        set_title(figure, partial_text, color=WARNING_COLOR, fontsize=10, fontweight="bold")
    return figure


def _origin_text(run: EvaluationRun) -> str:
    return (
        f"{run.setup.task}, protocol {run.setup.protocol}, "
        f"devkit {__version__}, release {run.release.fingerprint}"
    )


def _partial_text(run: EvaluationRun) -> str:
    if run.partial is None:
        return ""
    return run.partial.text()


def run_figures(run: EvaluationRun) -> tuple[RunFigure, ...]:
    """Return the figures of a run's task, of further results, and of breakdowns.

    A breakdown has a figure if it has several groups and a number.
    """
    figures: list[RunFigure] = []
    if run.setup.task in _FIGURES:
        figures += _FIGURES[run.setup.task](run)
    for name, further in run.further.items():
        figures += extra_result(name).figures(further.groups[0].result)
    for path, broken in _breakdown_numbers(run):
        if _has_numbers(broken, path):
            figures.append(_breakdown_figure(broken, path))
    return tuple(figures)


def _breakdown_numbers(run: EvaluationRun) -> list[tuple[str, Breakdown[Any]]]:
    """Return the numbers with breakdowns: the first by all attributes, the others only by time.

    The breakdowns by time of the other numbers follow the first breakdown of the first number.
    """
    evaluator = run.evaluator
    left_out = [EVERYTHING]
    if evaluator.needs_whole_recordings:
        left_out += WITHIN_RECORDINGS
    breakdowns = {}
    for broken in run.breakdowns:
        if broken.by not in left_out and len(broken.groups) > 1:
            breakdowns[broken.by] = broken
    paths = [path for path in evaluator.main_numbers if _headline(run.result, path) is not None]
    pairs = [(path, broken) for path in paths[:1] for broken in breakdowns.values()]
    if _TIME_ATTRIBUTE in breakdowns:
        pairs[1:1] = [(path, breakdowns[_TIME_ATTRIBUTE]) for path in paths[1:]]
    return pairs


def _accident(run: EvaluationRun) -> Iterator[RunFigure]:
    evaluator, result = run.evaluator, run.result
    if not isinstance(evaluator, AccidentEvaluator):
        return
    remark = ""
    if not tasks.has_alarms(evaluator):
        remark = " The released protocol counts only at these three distances."
    accuracies = [(f"within {metres:g} m", at.accuracy) for metres, at in result.within.items()]
    yield RunFigure(
        name="accuracy",
        caption=(
            "Accident prediction accuracy over the allowed distance; "
            f"APA is the mean of the three points.{remark}"
        ),
        alt=f"Accuracy {listed(accuracies)}.",
        draw=partial(tasks.render_accuracy, evaluator),
    )
    if not tasks.has_alarms(evaluator):
        return
    yield RunFigure(
        name="position_errors",
        caption=(
            "Errors of the predicted positions, the sum over the two actors, "
            "in samples before an accident."
        ),
        alt="Histogram of position errors in metres.",
        draw=partial(tasks.render_errors, evaluator, "position"),
    )
    yield RunFigure(
        name="time_errors",
        caption="How late the predicted moments are, in samples before an accident.",
        alt="Histogram of time errors in seconds.",
        draw=partial(tasks.render_errors, evaluator, "time"),
    )
    if hasattr(result, "average_precision"):
        average = listed([("average precision", result.average_precision)])
        yield RunFigure(
            name="alarms",
            caption="Precision over recall of the alarms, beginning with the surest alarm.",
            alt=f"Precision over recall of alarms; {average}.",
            draw=partial(tasks.render_alarms, evaluator),
        )


def _detection(run: EvaluationRun) -> Iterator[RunFigure]:
    result = run.result
    if not isinstance(run.evaluator, DetectionEvaluator):
        return
    unit = "share of overlap"
    if run.setup.rules.measure.startswith("distance"):
        unit = "metres"
    several = len(result.ranges) > 1
    for row, ring in np.argwhere(result.truths).tolist():
        name, (low, high) = result.classes[row], result.ranges[ring].tolist()
        suffix, range_text = "", ""
        if several:
            suffix, range_text = f"_{low:g}_{high:g}m", f" from {low:g} to {high:g} m"
        thresholds = [f"{threshold:g}" for threshold in result.thresholds[row].tolist()]
        averages = result.average_precision[row, ring].tolist()
        values = listed(zip(thresholds, averages, strict=True))
        yield RunFigure(
            name=f"precision_recall_{name}{suffix}",
            caption=(
                f"Precision over recall: {name}{range_text}, one line for each threshold ({unit})."
            ),
            alt=f"{name}{range_text}, average precision in percent: {values}.",
            draw=partial(tasks.render_precision_recall, result, name, ring=ring),
        )


def _motion(run: EvaluationRun) -> Iterator[RunFigure]:
    if not isinstance(run.evaluator, MotionEvaluator):
        return
    form = run.results.form or {}
    yield RunFigure(
        name="quality_by_time",
        caption="Panoptic quality frame by frame, from the present to the horizon.",
        alt="Panoptic quality in percent over seconds from the present.",
        draw=partial(tasks.render_quality_by_time, run.evaluator, form.get("step", 0.5)),
    )


def _warning(run: EvaluationRun) -> Iterator[RunFigure]:
    result = run.result
    if isinstance(result, AnticipationResult):
        yield RunFigure(
            name="predictors",
            caption=(
                "How well accidents are distinguished from other recordings, also by predictors "
                "that know nothing or only the present."
            ),
            alt=(
                "Chance that an accident's score is above another recording's at the same moment, "
                "by predictor."
            ),
            draw=partial(tasks.render_predictors, result),
        )


def _planning(run: EvaluationRun) -> Iterator[RunFigure]:
    if BY_LEAD[0] in run.result.means:
        yield RunFigure(
            name="plans",
            caption=(
                "Accidents that plans avoid, over the progress that they lose in twins, where "
                "nothing happens, with those that need no planner. "
                "Each line goes from the longest lead to the shortest."
            ),
            alt=(
                "Share of accidents avoided over the share of progress lost in twins, "
                "by plan and lead."
            ),
            draw=partial(tasks.render_plans, run.result),
        )


_FIGURES: Final[dict[str, Callable[[EvaluationRun], Iterator[RunFigure]]]] = {
    "accident": _accident,
    "detection": _detection,
    "motion": _motion,
    "planning": _planning,
    "warning": _warning,
}


def _breakdown_figure(broken: Breakdown[Any], path: str) -> RunFigure:
    name, values = None, []
    for group in broken.groups:
        headline, text = _headline(group.result, path), "–"
        if headline is not None:
            name, text = name or headline.name, headline.text()
        values.append(f"{group.value or UNKNOWN} {text}")
    by, percent = broken.by.replace("_", " "), 100 * broken.resampling.confidence
    return RunFigure(
        name=f"{path.rsplit('/', 1)[-1]}_by_{broken.by}",
        caption=(
            f"{name} by {by}; whiskers: {percent:g} % intervals over clusters of scenarios, "
            "if there are enough."
        ),
        alt=f"{name} by {by}: {', '.join(values)}.",
        draw=partial(render_breakdown, broken, path),
        height=max(PANEL[1], _MIN_BAR_HEIGHT_IN * len(broken.groups) + _FRAME_HEIGHT_IN),
    )


def _has_numbers(broken: Breakdown[Any], path: str) -> bool:
    for group in broken.groups:
        headline = _headline(group.result, path)
        if headline is not None and headline.value is not None:
            return True
    return False


def _headline(result: Any, path: str) -> Headline | None:
    return next((headline for headline in headlines(result) if headline.path == path), None)


def listed(values: Iterable[tuple[str, float | None]]) -> str:
    """Return names with their values, with three digits, as the words of a figure."""
    words = []
    for name, value in values:
        text = "–" if value is None or math.isnan(value) else f"{value:.3g}"
        words.append(f"{name} {text}")
    return ", ".join(words)


def sample_figures(run: EvaluationRun, dataset: Dataset, results: Results) -> tuple[RunFigure, ...]:
    """Return figures of the worst and the best samples by the main number, the worst first.

    Samples with nothing to count are left out. Only motion, accidents and detections can be drawn
    from above.
    """
    if not isinstance(run.evaluator, (MotionEvaluator, AccidentEvaluator, DetectionEvaluator)):
        return ()
    ranked = _ranked(run)
    count = min(_SAMPLES_PER_KIND, len(ranked) // 2)
    # no sample is among the worst if all numbers are equal
    worst = [sample for sample in ranked[:count] if sample[1] != ranked[-1][1]]
    best = ranked[max(len(ranked) - _SAMPLES_PER_KIND, len(worst)) :]
    load = SampleLoader(dataset, results, run.setup)
    figures = []
    for kind, samples in (("worst", worst), ("best", best[::-1])):
        for number, (token, text) in enumerate(samples, 1):
            figures.append(
                RunFigure(
                    name=f"sample_{kind}_{number}",
                    caption=f"One of the {kind} samples: {token}, {text}.",
                    alt=(
                        f"Seen from above: the prediction for sample {token} over the truth; "
                        f"{text}."
                    ),
                    draw=partial(_draw, load, token, text),
                    height=_VIEW_HEIGHT_IN,
                )
            )
    return tuple(figures)


@in_own_settings
def draw_motion_outcome(
    prediction: MotionOutput,
    label: MotionLabels,
    *,
    frame: int | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Render a frame's cells: actors that are predicted, predicted falsely, and missed.

    Args:
        prediction: Output of a model; the last of several predictions is rendered.
        label: Ground truth, on the same grid; frames in their own ego frames are warped to the
            present.
        frame: Number of the frame, 0 for the present; None for the last recorded one.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres of the present ego frame: forward to the right, left up.

    Raises:
        EvaluationError: The present is not recorded.
    """
    from matplotlib.colors import to_rgba

    ax, truth, grid = axes_or_new(ax, PANEL), labels_at_present(label), label.config.grid
    if frame is None:
        frame = frames_there(label) - 1
    predicted = prediction.grid.reorient(_actors(prediction, frame), "devkit")
    true = grid.reorient(truth.segmentation[frame] == 1, "devkit")
    picture = np.zeros((*true.shape, 4))  # transparent where nobody is
    picture[predicted & true] = to_rgba(OUTCOME_COLORS["right"])
    picture[predicted & ~true] = to_rgba(OUTCOME_COLORS["false"])
    picture[true & ~predicted] = to_rgba(OUTCOME_COLORS["missed"])
    ax.imshow(
        picture,
        origin="lower",
        extent=(*grid.x[:2], *grid.y[:2]),
        interpolation="nearest",
        zorder=0.5,
    )
    draw_legend_of_fills(ax, OUTCOME_COLORS)
    title = "actors now"
    if frame:
        title = f"actors {frame * label.config.step * FRAME_PERIOD:g} s ahead"
    return titled_from_above(ax, title, grid=True)


def _draw(load: SampleLoader, token: str, text: str, *, ax: Axes) -> Axes:
    prediction, truth, *contexts = load(token)
    if isinstance(prediction, MotionOutput):
        draw_motion_outcome(prediction, truth, ax=ax)
    elif isinstance(prediction, DetectedBoxes):
        draw_detection_outcome(prediction, truth, load.setup.rules, ax=ax)
    else:
        context = contexts[0]
        compared = compared_accidents(prediction, truth, context, load.setup.rules)
        draw_accident_outcome(compared, context.truth, ax=ax)
    set_scene_title(ax, load.dataset, token, below=f"{text}: {ax.get_title()}")
    return ax


def _ranked(run: EvaluationRun) -> list[tuple[str, str]]:
    """Return tokens with their main number in words, the worst first."""
    numbers: list[tuple[float, str, str]] = []
    path = run.evaluator.main_numbers[0]
    for token in sorted(run.evaluator.tokens):
        headline = _headline(run.evaluator.compute([token]), path)
        if headline is not None and headline.value is not None:
            numbers.append((headline.value, token, f"{headline.name} {headline.text()}"))
    return [(token, text) for _, token, text in sorted(numbers)]


def _actors(prediction: MotionOutput, frame: int) -> BoolArray:
    """Return which cells have an actor by the last prediction, shape (H, W).

    The orientation is the prediction's own.
    """
    if prediction.instances is not None:
        return np.asarray(prediction.instances[-1, frame] > 0)
    background, actor = (prediction.heads or ())[-1].segmentation[frame]
    return np.asarray(actor > background)
