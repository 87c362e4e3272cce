"""The figures of a run, including its worst and best samples, and their files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.accident import AccidentEvaluator
from deepaccident_devkit.evaluation.breakdowns import EVERYTHING, WITHIN_RECORDINGS, Breakdown
from deepaccident_devkit.evaluation.detection import DetectionEvaluator
from deepaccident_devkit.evaluation.motion import MotionEvaluator
from deepaccident_devkit.evaluation.planning.evaluator import BY_LEAD
from deepaccident_devkit.evaluation.predictions import (
    MotionOutput,
    labels_at_present,
    num_recorded_frames,
)
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.evaluation.runs.further import extra_result
from deepaccident_devkit.evaluation.runs.setups import SampleLoader
from deepaccident_devkit.evaluation.task import Headline, headlines
from deepaccident_devkit.evaluation.warning import AnticipationResult
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.captions import (
    INSIDE,
    draw_legend,
    draw_legend_of_fills,
    set_scene_title,
    set_title,
    titled_from_above,
)
from deepaccident_devkit.render.evaluation import tasks
from deepaccident_devkit.render.evaluation.panels import PANEL, render_breakdown
from deepaccident_devkit.render.figures import (
    axes_or_new,
    detached_figure,
    write_report_figure,
)
from deepaccident_devkit.render.outcomes.described import described_sample
from deepaccident_devkit.render.outcomes.drawings import draw_drawing_from_above
from deepaccident_devkit.render.outcomes.evaluation import drawing_layers
from deepaccident_devkit.render.styles import (
    MUTED_COLOR,
    OUTCOME_COLORS,
    WARNING_COLOR,
    current_style,
    in_own_settings,
    size_in_style,
)
from deepaccident_devkit.support.arrays import BoolArray
from deepaccident_devkit.support.human_names import human_name, metric_name, rules_name
from deepaccident_devkit.support.text import with_minus
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 160
# Height of a bar, and of a title, ticks and labels, in lines of letters.
_BAR_LINES = 2.2
_FRAME_LINES = 7.5
# Minimum height of curves with a legend below, in lines of letters.
_CURVE_LINES = 20
# Label of the words about a figure's origin. They are for copying rather than reading, so they may
# be small.
_ORIGIN_GID = "token"
_TIME_ATTRIBUTE = "time_to_impact"
# How many of the worst samples, and of the best, have a figure.
_SAMPLES_PER_KIND = 3
# Height of a view from above including its title, in inches.
_VIEW_HEIGHT_IN = 5.6


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFigure:
    """One figure of a run.

    Attributes:
        name: Name of its file, without the suffix.
        caption: Description of the figure, for the reader of the report.
        alt: Content of the figure in words and numbers, for readers who cannot see it.
        draw: Function that renders the figure on the axes `ax`.
        height: Height in inches.
        lines: Minimum height, in lines of the figure's smallest letters.
    """

    name: str
    caption: str
    alt: str
    draw: Callable[..., Axes]
    height: float = PANEL[1]
    lines: float = 0


def save_figure(run: EvaluationRun, run_figure: RunFigure, folder: Path) -> Path:
    """Write a figure of a run into a PNG file in a folder, as `write_report_figure` does.

    An existing file is replaced.
    """
    description = f"{_partial_text(run)} {_origin_text(run)}".strip()
    words = {"Title": run_figure.name, "Description": description}
    path = folder / f"{run_figure.name}.png"
    draw = partial(complete_figure, run, run_figure)
    return write_report_figure(draw, path, dpi=_DPI, words=words)


@in_own_settings
def complete_figure(run: EvaluationRun, run_figure: RunFigure) -> Figure:
    """Render a complete figure; for a partial run, its title states what the run lacks.

    The task, protocol, devkit and release are named at the bottom, except in papers and on slides.
    """
    size = (PANEL[0], run_figure.height)
    figure = detached_figure(size_in_style(size, panels="one", lines=run_figure.lines))
    ax = figure.add_subplot()
    run_figure.draw(ax=ax)
    if not current_style().shows_few_panels:
        figure.supxlabel(_origin_text(run), fontsize=6, color=MUTED_COLOR, gid=_ORIGIN_GID)
    partial_text = _partial_text(run)
    if partial_text:
        set_title(figure, partial_text, color=WARNING_COLOR, fontsize=10, fontweight="bold")
    return figure


def _origin_text(run: EvaluationRun) -> str:
    return (
        f"{rules_name(run.setup.task, run.setup.protocol)}, "
        f"devkit {__version__}, release {run.release.fingerprint}"
    )


def _partial_text(run: EvaluationRun) -> str:
    if run.partial is None:
        return ""
    return run.partial.text()


def run_figures(run: EvaluationRun) -> tuple[RunFigure, ...]:
    """Return the figures of a run's task, of its further results, and of its breakdowns.

    A breakdown only has a figure if it has several groups and a number to draw.
    """
    figures: list[RunFigure] = []
    if run.setup.task in _FIGURES:
        figures += _FIGURES[run.setup.task](run)
    for name, further in run.further.items():
        figures += extra_result(name).figures(further.groups[0].result)
    for path, broken in _breakdown_numbers(run):
        for group in broken.groups:
            headline = _find_headline(group.result, path)
            if headline is not None and headline.value is not None:
                figures.append(_breakdown_figure(broken, path))
                break
    return tuple(figures)


def _breakdown_numbers(run: EvaluationRun) -> list[tuple[str, Breakdown[Any]]]:
    """Return (path of a main number, breakdown) for each breakdown to draw.

    The first number is drawn for each attribute; the other numbers are only drawn by time, after
    the first number's first breakdown.
    """
    evaluator = run.evaluator
    left_out = [EVERYTHING]
    if evaluator.needs_whole_recordings:
        left_out += WITHIN_RECORDINGS
    breakdowns = {}
    for broken in run.breakdowns:
        if broken.by not in left_out and len(broken.groups) > 1:
            breakdowns[broken.by] = broken
    paths = [
        path for path in evaluator.main_numbers if _find_headline(run.result, path) is not None
    ]
    pairs = [(path, broken) for path in paths[:1] for broken in breakdowns.values()]
    if _TIME_ATTRIBUTE in breakdowns:
        pairs[1:1] = [(path, breakdowns[_TIME_ATTRIBUTE]) for path in paths[1:]]
    return pairs


def _accident_figures(run: EvaluationRun) -> Iterator[RunFigure]:
    evaluator = run.evaluator
    result = run.result
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
        caption="Timing errors of the predictions in samples before an accident; late is positive.",
        alt="Histogram of time errors in seconds.",
        draw=partial(tasks.render_errors, evaluator, "time"),
    )
    if hasattr(result, "average_precision"):
        average = listed([("average precision", result.average_precision)])
        yield RunFigure(
            name="alarms",
            caption="Precision–recall curve of the alarms, beginning with the highest score.",
            alt=f"Precision over recall of alarms; {average}.",
            draw=partial(tasks.render_alarms, evaluator),
        )


def _detection_figures(run: EvaluationRun) -> Iterator[RunFigure]:
    result = run.result
    if not isinstance(run.evaluator, DetectionEvaluator):
        return
    unit = "share of overlap"
    if run.setup.rules.measure.startswith("distance"):
        unit = "metres"
    for row, ring in np.argwhere(result.truths).tolist():
        name = result.classes[row]
        suffix = ""
        range_text = ""
        if len(result.ranges) > 1:
            low, high = result.ranges[ring].tolist()
            suffix = f"_{low:g}_{high:g}m"
            range_text = f" from {low:g} to {high:g} m"
        thresholds = [f"{threshold:g}" for threshold in result.thresholds[row].tolist()]
        averages = result.average_precision[row, ring].tolist()
        values = listed(zip(thresholds, averages, strict=True))
        yield RunFigure(
            name=f"precision_recall_{name}{suffix}",
            caption=(
                f"Precision over recall of {human_name(name)}{range_text}, with one line for each "
                f"threshold ({unit})."
            ),
            alt=f"{human_name(name)}{range_text}, average precision in percent: {values}.",
            draw=partial(tasks.render_precision_recall, result, name, ring=ring),
            lines=_CURVE_LINES,
        )


def _motion_figures(run: EvaluationRun) -> Iterator[RunFigure]:
    if not isinstance(run.evaluator, MotionEvaluator):
        return
    form = run.results.form or {}
    yield RunFigure(
        name="quality_by_time",
        caption="Panoptic quality frame by frame, from the present to the horizon.",
        alt="Panoptic quality in percent over seconds from the present.",
        draw=partial(tasks.render_quality_by_time, run.evaluator, form.get("step", 0.5)),
        lines=_CURVE_LINES,
    )


def _warning_figures(run: EvaluationRun) -> Iterator[RunFigure]:
    result = run.result
    if isinstance(result, AnticipationResult):
        yield RunFigure(
            name="predictors",
            caption=(
                "How well accidents are distinguished from other recordings, by this model and by "
                "predictors that know nothing or only the present."
            ),
            alt=(
                "Chance that an accident's score is above another recording's at the same moment, "
                "by predictor."
            ),
            draw=partial(tasks.render_predictors, result),
        )


def _planning_figures(run: EvaluationRun) -> Iterator[RunFigure]:
    if BY_LEAD[0] in run.result.means:
        yield RunFigure(
            name="plans",
            caption=(
                "Accidents avoided vs. progress lost in normal twins, for this model's plans and "
                "for plans that need no planner. Each line goes from the longest lead (large dot) "
                "to the shortest."
            ),
            alt=(
                "Share of accidents avoided over the share of progress lost in twins, "
                "by plan and lead."
            ),
            draw=partial(tasks.render_plans, run.result),
        )


_FIGURES: dict[str, Callable[[EvaluationRun], Iterator[RunFigure]]] = {
    "accident": _accident_figures,
    "detection": _detection_figures,
    "motion": _motion_figures,
    "planning": _planning_figures,
    "warning": _warning_figures,
}


def _breakdown_figure(broken: Breakdown[Any], path: str) -> RunFigure:
    """Return the figure that shows one number (by its path) for each group of a breakdown."""
    name = path
    values = []
    for group in broken.groups:
        headline = _find_headline(group.result, path)
        text = "–"
        if headline is not None:
            name = metric_name(headline.name)
            text = with_minus(headline.text())
        values.append(f"{human_name(group.value)} {text}")
    attribute = human_name(broken.by, "attributes")
    percent = 100 * broken.resampling.confidence
    return RunFigure(
        name=f"{path.rsplit('/', 1)[-1]}_by_{broken.by}",
        caption=(
            f"{name} by {attribute}; whiskers: {percent:g} % intervals over clusters of scenarios, "
            "if there are enough."
        ),
        alt=f"{name} by {attribute}: {', '.join(values)}.",
        draw=partial(render_breakdown, broken, path),
        lines=_BAR_LINES * len(broken.groups) + _FRAME_LINES,
    )


def _find_headline(result: Any, path: str) -> Headline | None:
    """Return the headline number that a result has at a path; None if it has none there."""
    for headline in headlines(result):
        if headline.path == path:
            return headline
    return None


def listed(values: Iterable[tuple[str, float | None]]) -> str:
    """List names and their values (three digits) in words that describe a figure."""
    words = []
    for name, value in values:
        text = "–"
        if value is not None and not math.isnan(value):
            text = f"{value:.3g}"
        words.append(f"{name} {text}")
    return ", ".join(words)


def sample_figures(run: EvaluationRun, dataset: Dataset, results: Results) -> tuple[RunFigure, ...]:
    """Return figures of the worst and the best samples by the main number, the worst first.

    Samples in which nothing is counted are left out.
    """
    ranked = _ranked(run)
    count = min(_SAMPLES_PER_KIND, len(ranked) // 2)
    # no sample is among the worst if all numbers are equal
    worst_samples = [sample for sample in ranked[:count] if sample[1] != ranked[-1][1]]
    best_samples = ranked[max(len(ranked) - _SAMPLES_PER_KIND, len(worst_samples)) :]
    load = SampleLoader(dataset, results, run.setup)
    figures = []
    for kind, samples in (("worst", worst_samples), ("best", best_samples[::-1])):
        for number, (token, text) in enumerate(samples, 1):
            figures.append(
                RunFigure(
                    name=f"sample_{kind}_{number}",
                    caption=f"One of the {kind} samples: {token}, {text}.",
                    alt=(
                        f"Seen from above: the prediction for sample {token} over the truth; "
                        f"{text}."
                    ),
                    draw=partial(_draw_sample, load, token, text),
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
    """Render the cells of a frame: correctly predicted, falsely predicted and missed actors.

    Args:
        prediction: Output of a model; the last of several predictions is rendered.
        label: Ground truth, on the same grid; frames that are in the ego frames of their own times
            are warped to t = 0.
        frame: Index of the frame, 0 for the current one; None for the last recorded one.
        ax: Axes to render on; new ones if None.

    Returns:
        The axes, in metres, in the ego frame at t = 0: forward to the right, left up.

    Raises:
        EvaluationError: The current frame is not recorded.
    """
    from matplotlib.colors import to_rgba

    ax = axes_or_new(ax, PANEL)
    truth = labels_at_present(label)
    grid = label.config.grid
    if frame is None:
        frame = num_recorded_frames(label) - 1
    predicted = prediction.grid.reorient(_actor_cells(prediction, frame), "devkit")
    true = grid.reorient(truth.segmentation[frame] == 1, "devkit")
    picture = np.zeros((*true.shape, 4))  # transparent where there is no actor
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


def _draw_sample(load: SampleLoader, token: str, text: str, *, ax: Axes) -> Axes:
    """Draw a sample's prediction over the truth, with `text` (its main number) in the title."""
    described = described_sample(load, token)
    layers = drawing_layers(None)
    handles = draw_drawing_from_above(load.dataset, token, described.drawing, layers, ax)
    draw_legend(ax, handles, columns=1, **INSIDE)
    set_scene_title(ax, load.dataset, token, below=text)
    return ax


def _ranked(run: EvaluationRun) -> list[tuple[str, str]]:
    """Return (token, main number in words) for each sample, the worst first.

    It is empty for tasks without main numbers.
    """
    if not run.evaluator.main_numbers:
        return []
    numbers = []
    path = run.evaluator.main_numbers[0]
    for token in sorted(run.evaluator.tokens):
        result = run.evaluator.compute([token])
        headline = _find_headline(result, path)
        if headline is not None and headline.value is not None:
            text = f"{metric_name(headline.name)} {with_minus(headline.text())}"
            numbers.append((headline.value, token, text))
    return [(token, text) for _, token, text in sorted(numbers)]


def _actor_cells(prediction: MotionOutput, frame: int) -> BoolArray:
    """Return which cells contain an actor in the last prediction, shape (H, W).

    The cells are in the prediction's own orientation.
    """
    if prediction.instances is not None:
        return np.asarray(prediction.instances[-1, frame] > 0)
    last_heads = (prediction.heads or ())[-1]
    background, actor = last_heads.segmentation[frame]
    return np.asarray(actor > background)
