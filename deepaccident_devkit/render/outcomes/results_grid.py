"""The truth and several results in one picture: methods in rows, samples in columns."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, EvaluationError
from deepaccident_devkit.evaluation.counting import evaluate_samples
from deepaccident_devkit.evaluation.drawing import Drawing
from deepaccident_devkit.evaluation.results import Results
from deepaccident_devkit.evaluation.runs.setups import (
    EvaluationSetup,
    SampleLoader,
    evaluator_class,
    scenario_of,
)
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.evaluation.truth import RELEASED_HORIZON
from deepaccident_devkit.render.captions import draw_legend, set_scene_title, set_title
from deepaccident_devkit.render.figures import Layer, figure_or_new, lay_out_figure
from deepaccident_devkit.render.outcomes.described import described_sample
from deepaccident_devkit.render.outcomes.drawings import draw_drawing_from_above
from deepaccident_devkit.render.outcomes.evaluation import drawing_layers
from deepaccident_devkit.render.styles import in_own_settings, text_size

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Pick = Literal["worst", "best", "differ"]
"""How samples are picked: by the first method's score, or by the difference of the first two."""
PICKED_SAMPLES: Final = 4
"""Largest number of samples that are picked, each from another scenario."""
# Width and height of a panel with its title, inches.
_PANEL_SIZE_IN = (3.6, 3.9)
# Number of letters in a line of a method's name.
_NAME_WIDTH = 28


def named_results(results: Sequence[tuple[str, Results]], task: str | None) -> dict[str, Results]:
    """Name results by their methods, and check that they can be compared.

    Args:
        results: Name and results of each method; an empty name stands for `method` in the notes of
            the results.
        task: Task that judges all results; None requires that they are of the same task.

    Raises:
        ChoiceError: Results have no name, two have the same name, or they are of different tasks.
    """
    by_name: dict[str, Results] = {}
    for given_name, opened in results:
        name = given_name or opened.meta.get("method", "")
        if len(results) > 1 and (not name or name in by_name):
            problem = f"another method is called {name!r}" if name else "has no method in its notes"
            raise ChoiceError(f"{opened.path}: {problem}; name it, as in NAME={opened.path}")
        by_name[name] = opened
        first = results[0][1]
        if task is None and opened.task != first.task:
            raise ChoiceError(
                f"{opened.path}: contains {opened.task} results, and {first.path} {first.task} "
                "results; give results of one task, or name the task that judges them all"
            )
    return by_name


def shared_samples(results: Mapping[str, Results]) -> list[str]:
    """Return the samples that all methods predict, in the order of the first.

    Raises:
        EvaluationError: There is none.
    """
    first, *others = results.values()
    tokens = [token for token in first.tokens if all(token in other for other in others)]
    if not tokens and others:
        paths = ", ".join(str(opened.path) for opened in results.values())
        raise EvaluationError(f"{paths}: have no sample in common; predict the same samples")
    return tokens


def pick_samples(
    dataset: Dataset,
    results: Mapping[str, Results],
    pick: Pick,
    workers: int | None = None,
    *,
    task: str | None = None,
    protocol: str | None = None,
) -> list[str]:
    """Pick samples that all methods predict by the task's main number of each sample.

    At most `PICKED_SAMPLES` are picked, each from another scenario. Samples where nothing counts
    have no number, and are not picked.

    Args:
        dataset: The release.
        results: Results by the name of the method.
        pick: `worst` or `best` of the first method, or `differ` for the largest differences
            between the first two.
        workers: Number of processes; None for as many as speed up the work.
        task: Task that judges the predictions; None for the one of the results.
        protocol: Protocol of the task; None for the default one.

    Returns:
        Tokens of the samples, the most extreme first.

    Raises:
        ChoiceError: No such task or protocol, or `differ` has only one method.
        EvaluationError: No sample has a number, or samples cannot be evaluated.
    """
    tokens = shared_samples(results)
    loaders = [_loader_of(dataset, opened, task, protocol) for opened in results.values()]
    scores = _badness(loaders[0], tokens, workers)
    if pick == "differ":
        if len(loaders) == 1:
            raise ChoiceError("pick: differ compares two methods; give a second results file")
        others = _badness(loaders[1], tokens, workers)
        scores = {token: abs(scores[token] - others[token]) for token in scores.keys() & others}
    order = sorted(scores, key=lambda token: (scores[token], token), reverse=pick != "best")
    if not order:
        raise EvaluationError("no sample has a score of its own; name the samples to show")
    picked: dict[str, str] = {}
    for token in order:
        picked.setdefault(scenario_of(token), token)
    return list(picked.values())[:PICKED_SAMPLES]


def _badness(loader: SampleLoader, tokens: Sequence[str], workers: int | None) -> dict[str, float]:
    """Return the main number of each sample that has one; its sign makes large numbers bad."""
    empty_evaluator = loader.setup.evaluator()
    samples = {token: token for token in tokens}
    evaluator = evaluate_samples(empty_evaluator, samples, loader, workers=workers)
    badness = {}
    for token in tokens:
        for number in headlines(evaluator.compute([token])):
            is_main = number.path in evaluator.main_numbers[:1]
            if is_main and number.value is not None and np.isfinite(number.value):
                sign = 1.0 if number.higher_is_better is False else -1.0
                badness[token] = sign * number.value
    return badness


def _loader_of(
    dataset: Dataset, results: Results, task: str | None, protocol: str | None
) -> SampleLoader:
    """Return what loads samples to judge them as `render_evaluation` does."""
    task = task or results.task
    protocols = evaluator_class(task).protocols
    default = "released"
    if results.task == task == "accident":
        default = "boxes"
    if default not in protocols:
        default = next(iter(protocols), "")
    horizon = RELEASED_HORIZON
    if results.form is not None:
        horizon = min(horizon, results.form.lookahead)
    setup = EvaluationSetup(task=task, protocol=protocol or default, horizon=horizon)
    return SampleLoader(dataset, results, setup)


@in_own_settings
def render_results(
    dataset: Dataset,
    samples: Sequence[str],
    results: Mapping[str, Results],
    *,
    task: str | None = None,
    protocol: Any = None,
    layers: Sequence[Layer] | None = None,
    fig: Figure | None = None,
) -> Figure:
    """Render the truth and several methods in rows, and samples in columns, from above.

    Args:
        dataset: The release.
        samples: Tokens of the samples.
        results: Results by the name of the method, which stands at the left of its row.
        task: Task that judges the predictions; None for the one of the results.
        protocol: Protocol of the task; None for the one of `render_evaluation`.
        layers: Layers, as for `render_evaluation`.
        fig: Empty figure to render on; a new one if None.

    Returns:
        The figure. All panels of a column show the same square.

    Raises:
        TokenError: No such sample, or a method has no prediction for it.
        NotAvailableError: A sample lacks its label.
        ChoiceError: No such task, protocol or layer.
        EvaluationError: The protocol cannot evaluate such predictions.
    """
    shown_layers = drawing_layers(layers)
    loaders = [_loader_of(dataset, opened, task, protocol) for opened in results.values()]
    width, height = _PANEL_SIZE_IN
    rows = len(results) + 1
    fig = figure_or_new(fig, (width * len(samples), height * rows))
    axes = fig.subplots(rows, len(samples), squeeze=False)
    handles: dict[Any, Artist] = {}
    for sample, column in zip(samples, axes.T, strict=True):
        for handle in _draw_column(loaders, sample, shown_layers, column):
            handles.setdefault(handle.get_label(), handle)
        set_scene_title(column[0], dataset, sample)
        for ax in column:
            ax.set(xlabel="", ylabel="")
    for name, ax in zip(["ground truth", *results], axes[:, 0], strict=True):
        ax.set_ylabel(textwrap.fill(name, _NAME_WIDTH), fontsize=text_size())
    handles.pop("found", None)  # found boxes look like the true ones of the first row
    draw_legend(fig, list(handles.values()))
    return lay_out_figure(fig)


def _draw_column(
    loaders: Sequence[SampleLoader],
    sample: str,
    layers: frozenset[Layer],
    column: Sequence[Axes],
) -> list[Artist]:
    """Draw the truth and all methods of a sample, and return the handles for a legend."""
    described = [described_sample(loader, sample) for loader in loaders]
    drawings = [method.drawing for method in described]
    everything = Drawing(
        paths=tuple(chain.from_iterable(drawing.paths for drawing in drawings)),
        boxes=drawings[0].boxes,
        cells=tuple(chain.from_iterable(drawing.cells for drawing in drawings)),
        places=tuple(chain.from_iterable(drawing.places for drawing in drawings)),
    )
    handles: list[Artist] = []
    for drawing, ax in zip([_true_part(drawings[0]), *drawings], column, strict=True):
        handles += draw_drawing_from_above(
            loaders[0].dataset, sample, drawing, layers, ax, shown=everything
        )
    for method, ax in zip(described, column[1:], strict=True):
        set_title(ax, method.words.partition(": ")[2], fontsize=text_size(), y=None)
    return handles


def _true_part(drawing: Drawing) -> Drawing:
    """Return the truth of a drawing as it is for all methods, without outcomes."""
    truth = drawing.truth
    pair = [drawn for drawn in truth.boxes if drawn.role == "collision"]
    others = [drawn for drawn in truth.boxes if drawn.role != "collision"]
    true_boxes = [replace(drawn, role="truth", label="true box") for drawn in others]
    cells = [replace(drawn, role="truth", label="true instance") for drawn in truth.cells]
    return replace(truth, boxes=(*true_boxes, *pair), cells=tuple(cells))
