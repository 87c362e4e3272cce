"""The worst and the best samples of a run, as pictures: the prediction over the truth, seen from above."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.arrays import BoolArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.metrics.accident import compared_accidents
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.numbers import headlines
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput, frames_there, labels_at_present
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs import EvaluationRun
from deepaccident_devkit.evaluation.runs.setups import SampleLoader
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.axes import axes_or_new, titled_from_above
from deepaccident_devkit.render.colors import OUTCOME_COLORS
from deepaccident_devkit.render.evaluation.figures import MAIN_NUMBERS, RunFigure
from deepaccident_devkit.render.evaluation.panels import PANEL
from deepaccident_devkit.render.legends import draw_legend_of_fills
from deepaccident_devkit.render.outcomes import draw_accident_outcome, draw_detection_outcome
from deepaccident_devkit.render.styles import in_own_settings
from deepaccident_devkit.render.titles import set_scene_title
from deepaccident_devkit.taxonomy import FRAME_PERIOD

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EACH: Final = 3
"""How many of the worst, and of the best, samples are shown."""
_HEIGHT: Final = 5.6
"""Inches of a view from above with its title."""


def sample_figures(run: EvaluationRun, dataset: Dataset, results: Results) -> tuple[RunFigure, ...]:
    """The worst and the best samples of a run by its task's main number, the worst first.

    Samples with nothing to count are left out. The task `warning` has none, because it is about whole recordings.

    Args:
        run: of `evaluate_results`.
        dataset: the release.
        results: the predictions that were evaluated.
    """
    if run.setup.task == "warning":
        return ()
    ranked = _ranked(run)
    worst = ranked[: min(_EACH, len(ranked) // 2)]
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
    prediction: MotionOutput, label: MotionLabels, *, frame: int | None = None, ax: Axes | None = None
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
    from matplotlib.colors import to_rgb

    ax, truth, grid = axes_or_new(ax, PANEL), labels_at_present(label), label.config.grid
    frame = frames_there(label) - 1 if frame is None else frame
    there = prediction.grid.reorient(_actors(prediction, frame), "devkit")
    true = grid.reorient(truth.segmentation[frame] == 1, "devkit")
    picture = np.ones((*true.shape, 3))
    for kind, cells in (("right", there & true), ("false", there & ~true), ("missed", true & ~there)):
        picture[cells] = to_rgb(OUTCOME_COLORS[kind])
    ax.imshow(picture, origin="lower", extent=(*grid.x[:2], *grid.y[:2]), interpolation="nearest")
    draw_legend_of_fills(ax, OUTCOME_COLORS)
    seconds = frame * label.config.step * FRAME_PERIOD
    return titled_from_above(ax, f"actors {seconds:g} s ahead" if frame else "actors now", grid=True)


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
    path = MAIN_NUMBERS[run.setup.task][0]
    for token in sorted(run.evaluator.tokens):
        shown = headlines(run.setup.task, run.evaluator.compute([token]))
        found += [
            (each.value, token, f"{each.name} {each.text()}")
            for each in shown
            if each.path == path and each.value is not None
        ]
    return [(token, text) for _, token, text in sorted(found)]


def _actors(prediction: MotionOutput, frame: int) -> BoolArray:
    """(H, W) which cells have an actor by the last prediction, in its own orientation."""
    if prediction.instances is not None:
        cells: BoolArray = prediction.instances[-1, frame] > 0
        return cells
    background, actor = (prediction.heads or ())[-1].segmentation[frame]
    return np.asarray(actor > background)
