"""Extra results of a run: numbers beside those of its task, which a plug-in computes from the same counts."""

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
    """What a plug-in adds to runs, under its name in `Plugin.extra_results` and in summaries.

    Attributes:
        title: heading of its numbers.
        evaluator: what computes them: of a dataset, a run's evaluator, and `parallel.Engine`.
        tables: of the numbers as a summary holds them.
        figures: Draws the computed result; imports what draws when it is called.
    """

    title: str
    evaluator: Callable[..., Evaluator[Any]]
    tables: Callable[[Json], list[Table]]
    figures: Callable[[Any], Iterable[Any]]

    def text(self, told: Json) -> str:
        """All tables and the notes of what a summary holds, as aligned lines."""
        notes = ["\n".join(told["notes"])] if told["notes"] else []
        return "\n\n".join([*(each.to_text() for each in self.tables(told)), *notes])


def extra_result(name: str) -> ExtraResult:
    """Return the extra result of a name; raises MissingPluginError."""
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
    **how: Unpack[Engine],
) -> EvaluationRun:
    """The same run with a further result, and intervals of its numbers.

    Raises:
        MissingPluginError: its plug-in is not installed.
        EvaluationError: the run is of another task or protocol than it needs.
        WorkerError: a worker was killed, or cannot do the work.
    """
    evaluator = extra_result(name).evaluator(dataset, run.evaluator, **{"workers": 1, **how})
    found = breakdown(evaluator, run.attributes, EVERYTHING, resampling)
    groups = tuple(replace(each, result=evaluator.compute()) for each in found.groups)
    made = replace(found, groups=groups, without_infrastructure=())
    return replace(run, further={**run.further, name: made})


def further_results(summary: Json) -> Iterator[tuple[ExtraResult, Json]]:
    """The further results that a summary holds, and their numbers; raises MissingPluginError."""
    for name in further_names(summary):
        yield extra_result(name), summary[name]


def further_names(summary: Json) -> list[str]:
    """The names of the further results that a summary holds."""
    own = offers(lambda plugin: plugin.extra_results, own=True).by_name
    found = {
        name
        for name, value in summary.items()
        if isinstance(value, Mapping) and "interval_notes" in value
    }
    return [
        name for name in summary if name in found or (name in own and summary[name] is not None)
    ]
