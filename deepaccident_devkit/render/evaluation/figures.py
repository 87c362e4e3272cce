"""The figures of a run, its worst and best samples among them, and their files."""

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
# The least height of a bar in inches.
_ROW: Final = 0.38
# Inches of a title, ticks and labels.
_AROUND_BARS: Final = 1.1
# Marks what a figure is made of: words to be copied, not to be read, may be small.
_GID: Final = "token"
_BY_TIME: Final = "time_to_impact"
# How many of the worst, and of the best, samples are shown.
_EACH: Final = 3
# Inches of a view from above with its title.
_HEIGHT: Final = 5.6


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFigure:
    """One figure of a run.

    Attributes:
        name: of its file, without the ending.
        caption: what the figure shows, for the reader of the report.
        alt: the same in words and numbers, for readers who cannot see it.
        draw: renders it on `ax=`, axes.
        height: in inches.
    """

    name: str
    caption: str
    alt: str
    draw: Callable[..., Axes]
    height: float = PANEL[1]


def save_figure(run: EvaluationRun, drawn: RunFigure, folder: Path) -> Path:
    """Render a figure of a run into a PNG file of a folder, over one that is there, as `write_report_figure` does."""
    said = {"Title": drawn.name, "Description": " ".join(filter(None, (_mark(run), _made_of(run))))}
    return write_report_figure(
        complete_figure(run, drawn), folder / f"{drawn.name}.png", dpi=_DPI, words=said
    )


@in_own_settings
def complete_figure(run: EvaluationRun, drawn: RunFigure) -> Figure:
    """A figure that names its task, protocol, devkit and release (not for papers), and what a partial run lacks."""
    figure = report_figure((PANEL[0], drawn.height), panels="one")
    drawn.draw(ax=figure.add_subplot())
    if not current_style().few:
        figure.supxlabel(_made_of(run), fontsize=6, color=MUTED_COLOR, gid=_GID)
    if _mark(run):
        set_title(figure, _mark(run), color=WARNING_COLOR, fontsize=10, fontweight="bold")
    return figure


def _made_of(run: EvaluationRun) -> str:
    return f"{run.setup.task}, protocol {run.setup.protocol}, devkit {__version__}, release {run.release.fingerprint}"


def _mark(run: EvaluationRun) -> str:
    return "" if run.partial is None else run.partial.text()


def run_figures(run: EvaluationRun) -> tuple[RunFigure, ...]:
    """All figures of a run: of its task, of further results, and of breakdowns with several groups and a number."""
    own = [*_FIGURES[run.setup.task](run)] if run.setup.task in _FIGURES else []
    for name, told in run.further.items():
        own += extra_result(name).figures(told.groups[0].result)
    left_out = (EVERYTHING, *(WITHIN_RECORDINGS if run.evaluator.needs_whole_recordings else ()))
    broken = {
        each.by: each for each in run.breakdowns if each.by not in left_out and len(each.groups) > 1
    }
    numbers = [
        path for path in run.evaluator.main_numbers if _headline(run.result, path) is not None
    ]
    pairs = [(path, each) for path in numbers[:1] for each in broken.values()]
    pairs[1:1] = [(path, broken[_BY_TIME]) for path in numbers[1:] if _BY_TIME in broken]
    shown = [(path, each) for path, each in pairs if _has_numbers(each, path)]
    return (*own, *(_by(each, path) for path, each in shown))


def _accident(run: EvaluationRun) -> Iterator[RunFigure]:
    evaluator, result = run.evaluator, run.result
    if not isinstance(evaluator, AccidentEvaluator):
        return
    curve = (
        ""
        if tasks.has_alarms(evaluator)
        else " The released protocol counts only at these three distances."
    )
    yield RunFigure(
        name="accuracy",
        caption=f"Accident prediction accuracy over the allowed distance; APA is the mean of the three points.{curve}",
        alt=f"Accuracy {listed((f'within {d:g} m', x.accuracy) for d, x in result.within.items())}.",
        draw=partial(tasks.render_accuracy, evaluator),
    )
    if not tasks.has_alarms(evaluator):
        return
    yield RunFigure(
        name="position_errors",
        caption="Errors of the predicted positions, the sum over the two actors, in samples before an accident.",
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
        yield RunFigure(
            name="alarms",
            caption="Precision over recall of the alarms, beginning with the surest alarm.",
            alt=f"Precision over recall of alarms; {listed([('average precision', result.average_precision)])}.",
            draw=partial(tasks.render_alarms, evaluator),
        )


def _detection(run: EvaluationRun) -> Iterator[RunFigure]:
    result = run.result
    if not isinstance(run.evaluator, DetectionEvaluator):
        return
    unit = "metres" if run.setup.rules.measure.startswith("distance") else "share of overlap"
    several = len(result.ranges) > 1
    for row, ring in np.argwhere(result.truths).tolist():
        name, (low, high) = result.classes[row], result.ranges[ring].tolist()
        where = f" from {low:g} to {high:g} m" if several else ""
        limits = zip(
            result.thresholds[row].tolist(),
            result.average_precision[row, ring].tolist(),
            strict=True,
        )
        yield RunFigure(
            name=f"precision_recall_{name}" + f"_{low:g}_{high:g}m" * several,
            caption=f"Precision over recall: {name}{where}, one line for each threshold ({unit}).",
            alt=f"{name}{where}, average precision in percent: {listed((f'{t:g}', x) for t, x in limits)}.",
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
            caption="How well accidents are distinguished from other recordings, also by predictors that know nothing "
            "or only the present.",
            alt="Chance that an accident's score is above another recording's at the same moment, by predictor.",
            draw=partial(tasks.render_predictors, result),
        )


def _planning(run: EvaluationRun) -> Iterator[RunFigure]:
    if BY_LEAD[0] in run.result.means:
        yield RunFigure(
            name="plans",
            caption="Accidents that plans avoid, over the progress that they lose in twins, where nothing happens, "
            "with those that need no planner. Each line goes from the longest lead to the shortest.",
            alt="Share of accidents avoided over the share of progress lost in twins, by plan and lead.",
            draw=partial(tasks.render_plans, run.result),
        )


_FIGURES: Final[dict[str, Callable[[EvaluationRun], Iterator[RunFigure]]]] = {
    "accident": _accident,
    "detection": _detection,
    "motion": _motion,
    "planning": _planning,
    "warning": _warning,
}


def _by(broken: Breakdown[Any], path: str) -> RunFigure:
    values = [(group.value or UNKNOWN, _headline(group.result, path)) for group in broken.groups]
    name = next(headline.name for _, headline in values if headline is not None)
    words = ", ".join(
        f"{value} {'–' if headline is None else headline.text()}" for value, headline in values
    )
    by, percent = broken.by.replace("_", " "), 100 * broken.resampling.confidence
    return RunFigure(
        name=f"{path.rsplit('/', 1)[-1]}_by_{broken.by}",
        caption=f"{name} by {by}; whiskers: {percent:g} % intervals over clusters of scenarios, if there are enough.",
        alt=f"{name} by {by}: {words}.",
        draw=partial(render_breakdown, broken, path),
        height=max(PANEL[1], _ROW * len(broken.groups) + _AROUND_BARS),
    )


def _has_numbers(broken: Breakdown[Any], path: str) -> bool:
    shown = [_headline(group.result, path) for group in broken.groups]
    return any(each is not None and each.value is not None for each in shown)


def _headline(result: Any, path: str) -> Headline | None:
    return next((each for each in headlines(result) if each.path == path), None)


def listed(values: Iterable[tuple[str, float | None]]) -> str:
    """Names with their values, with three digits, as the words of a figure."""
    known = [
        (name, None if value is None or math.isnan(value) else value) for name, value in values
    ]
    return ", ".join(f"{name} {'–' if value is None else f'{value:.3g}'}" for name, value in known)


def sample_figures(run: EvaluationRun, dataset: Dataset, results: Results) -> tuple[RunFigure, ...]:
    """The worst and the best samples of a run by its task's main number, the worst first.

    Samples with nothing to count are left out. Only motion, accidents and detections can be seen from above.
    """
    if not isinstance(run.evaluator, (MotionEvaluator, AccidentEvaluator, DetectionEvaluator)):
        return ()
    ranked = _ranked(run)
    count = min(_EACH, len(ranked) // 2)
    worst = [
        each for each in ranked[:count] if each[1] != ranked[-1][1]
    ]  # none where all are alike
    best = ranked[max(len(ranked) - _EACH, len(worst)) :]
    load = SampleLoader(dataset, results, run.setup)
    return tuple(
        RunFigure(
            name=f"sample_{kind}_{number}",
            caption=f"One of the {kind} samples: {token}, {text}.",
            alt=f"Seen from above: the prediction for sample {token} over the truth; {text}.",
            draw=partial(_draw, load, token, text),
            height=_HEIGHT,
        )
        for kind, chosen in (("worst", worst), ("best", best[::-1]))
        for number, (token, text) in enumerate(chosen, 1)
    )


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
        prediction: of a model; the last of several predictions is rendered.
        label: the truth, on the same grid; frames in their own ego frames are warped to the present.
        frame: which one, 0 for the present; None for the last that is recorded.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of the present ego frame: forward to the right, left up.

    Raises:
        EvaluationError: the present is not recorded.
    """
    from matplotlib.colors import to_rgba

    ax, truth, grid = axes_or_new(ax, PANEL), labels_at_present(label), label.config.grid
    frame = frames_there(label) - 1 if frame is None else frame
    there = prediction.grid.reorient(_actors(prediction, frame), "devkit")
    true = grid.reorient(truth.segmentation[frame] == 1, "devkit")
    picture = np.zeros((*true.shape, 4))  # transparent where nobody is
    for kind, cells in (
        ("right", there & true),
        ("false", there & ~true),
        ("missed", true & ~there),
    ):
        picture[cells] = to_rgba(OUTCOME_COLORS[kind])
    ax.imshow(
        picture,
        origin="lower",
        extent=(*grid.x[:2], *grid.y[:2]),
        interpolation="nearest",
        zorder=0.5,
    )
    draw_legend_of_fills(ax, OUTCOME_COLORS)
    seconds = frame * label.config.step * FRAME_PERIOD
    return titled_from_above(
        ax, f"actors {seconds:g} s ahead" if frame else "actors now", grid=True
    )


def _draw(load: SampleLoader, token: str, text: str, *, ax: Axes) -> Axes:
    prediction, truth, *more = load(token)
    if isinstance(prediction, MotionOutput):
        draw_motion_outcome(prediction, truth, ax=ax)
    elif isinstance(prediction, DetectedBoxes):
        draw_detection_outcome(prediction, truth, load.setup.rules, ax=ax)
    else:
        compared = compared_accidents(prediction, truth, more[0], load.setup.rules)
        draw_accident_outcome(compared, more[0].truth, ax=ax)
    set_scene_title(ax, load.dataset, token, below=f"{text}: {ax.get_title()}")
    return ax


def _ranked(run: EvaluationRun) -> list[tuple[str, str]]:
    """Tokens with their main number in words, the worst first."""
    found: list[tuple[float, str, str]] = []
    path = run.evaluator.main_numbers[0]
    for token in sorted(run.evaluator.tokens):
        number = _headline(run.evaluator.compute([token]), path)
        if number is not None and number.value is not None:
            found.append((number.value, token, f"{number.name} {number.text()}"))
    return [(token, text) for _, token, text in sorted(found)]


def _actors(prediction: MotionOutput, frame: int) -> BoolArray:
    """(H, W) which cells have an actor by the last prediction, in its own orientation."""
    if prediction.instances is not None:
        return np.asarray(prediction.instances[-1, frame] > 0)
    background, actor = (prediction.heads or ())[-1].segmentation[frame]
    return np.asarray(actor > background)
