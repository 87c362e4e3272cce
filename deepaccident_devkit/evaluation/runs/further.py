"""Further results of a run: numbers beside those of its task, which a room of the ring makes of the same counts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.breakdowns import EVERYTHING, breakdown
from deepaccident_devkit.evaluation.evaluator import Evaluator
from deepaccident_devkit.evaluation.intervals import Resampling
from deepaccident_devkit.evaluation.runs.evaluation_run import EvaluationRun
from deepaccident_devkit.reports import Table
from deepaccident_devkit.rooms import ADDED, added

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine

Json = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class FurtherResult:
    """What a room adds to runs, by its name in `rooms.ADDED["result"]` (pictures: `"figures"`) and in summaries.

    Attributes:
        title: heading of its numbers.
        evaluator: what computes them: of a dataset, a run's evaluator, and `parallel.Engine`.
        tables: of the numbers as a summary holds them.
    """

    title: str
    evaluator: Callable[..., Evaluator[Any]]
    tables: Callable[[Json], list[Table]]

    def text(self, told: Json) -> str:
        """All tables and the notes of what a summary holds, as aligned lines."""
        notes = ["\n".join(told["notes"])] if told["notes"] else []
        return "\n\n".join([*(each.to_text() for each in self.tables(told)), *notes])


def with_further(
    run: EvaluationRun, name: str, dataset: Dataset, resampling: Resampling | None = None, **how: Unpack[Engine]
) -> EvaluationRun:
    """The same run with a further result, and intervals of its numbers.

    Raises:
        MissingRoomError: its room is not installed.
        EvaluationError: the run is of another task or protocol than it needs.
        WorkerError: a worker was killed, or cannot do the work.
    """
    evaluator = added("result", name).evaluator(dataset, run.evaluator, **{"workers": 1, **how})
    found = breakdown(evaluator, run.attributes, EVERYTHING, resampling)
    groups = tuple(replace(each, result=evaluator.compute()) for each in found.groups)
    made = replace(found, groups=groups, without_infrastructure=())
    return replace(run, further={**run.further, name: made})


def further_results(summary: Json) -> Iterator[tuple[FurtherResult, Json]]:
    """The further results that a summary holds, and their numbers; raises MissingRoomError."""
    for name in filter(summary.get, further_names(summary)):
        yield added("result", name), summary[name]


def further_names(summary: Json) -> list[str]:
    """The names of the further results that a summary holds."""
    return [name for name in ADDED["result"] if summary.get(name) is not None]
