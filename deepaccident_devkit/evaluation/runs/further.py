"""Further results of a run: numbers that a plug-in computes from the task's counts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import MissingPluginError
from deepaccident_devkit.evaluation.breakdowns import EVERYTHING, breakdown
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun
from deepaccident_devkit.support.plugins import offers
from deepaccident_devkit.support.reports import Table

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

Json = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtraResult:
    """Further result that a plug-in offers; its name is in `Plugin.extra_results` and in summaries.

    Attributes:
        title: Heading of its numbers.
        evaluator: Function that takes the dataset, the evaluator of a run, and the arguments of
            `parallel.Engine`, and returns the evaluator of the further result.
        tables: Function that converts the numbers in a summary to tables.
        figures: Function that draws the computed result; it imports the drawing library when it is
            called.
    """

    title: str
    evaluator: Callable[..., Evaluator[Any]]
    tables: Callable[[Json], list[Table]]
    figures: Callable[[Any], Iterable[Any]]

    def text(self, numbers: Json) -> str:
        """Format the numbers in a summary as tables and notes, in aligned lines."""
        blocks = [table.to_text() for table in self.tables(numbers)]
        notes = numbers["notes"]
        if notes:
            blocks.append("\n".join(notes))
        return "\n\n".join(blocks)


def extra_result(name: str) -> ExtraResult:
    """Return the further result with a name; raise MissingPluginError if no plug-in has it."""
    loaders = offers(lambda plugin: plugin.extra_results, own=True).by_name
    if name not in loaders:
        loaders = offers(lambda plugin: plugin.extra_results).by_name
    if name not in loaders:
        raise MissingPluginError(
            f"{name}: needs a plug-in that is not installed; install it, or the whole devkit"
        )
    return loaders[name]()


def with_further(
    run: EvaluationRun,
    name: str,
    dataset: Dataset,
    resampling: Resampling | None = None,
    **engine: Unpack[Engine],
) -> EvaluationRun:
    """Return a copy of the run with a further result, including intervals of its numbers.

    Raises:
        MissingPluginError: If the plug-in that computes the result is not installed.
        EvaluationError: If the result needs a task or protocol other than the run's.
        WorkerError: If a worker was killed, or cannot do its work.
    """
    evaluator = extra_result(name).evaluator(dataset, run.evaluator, **{"workers": 1, **engine})
    table = breakdown(evaluator, run.attributes, EVERYTHING, resampling)
    groups = tuple(replace(group, result=evaluator.compute()) for group in table.groups)
    complete_table = replace(table, groups=groups, without_infrastructure=())
    return replace(run, further={**run.further, name: complete_table})


def further_results(summary: Json) -> Iterator[tuple[ExtraResult, Json]]:
    """Yield each further result of a summary with its numbers.

    Raise MissingPluginError if the plug-in of one is not installed.
    """
    for name in further_names(summary):
        yield extra_result(name), summary[name]


def further_names(summary: Json) -> list[str]:
    """Return the names of the further results in a summary."""
    installed = offers(lambda plugin: plugin.extra_results, own=True).by_name
    names = []
    for name, value in summary.items():
        has_intervals = isinstance(value, Mapping) and "interval_notes" in value
        if has_intervals or (name in installed and value is not None):
            names.append(name)
    return names
