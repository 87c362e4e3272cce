"""`each_scenario`: one computation on many scenarios, in processes or on executors, and what was left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.parallel import Places, in_order, run_unordered
from deepaccident_devkit.safety.accidents import Skipped

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from deepaccident_devkit.tables.records import ScenarioRecord

Result = TypeVar("Result")
_RUN_LENGTH: Final = 64
"""Scenarios that are looked at together: some tenths of a second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Found(Generic[Result]):
    """What a computation found in scenarios.

    Attributes:
        results: in the order of the release.
        skipped: scenarios that lack what it needs, and why.
        others: how many scenarios it does not concern.
    """

    results: tuple[Result, ...]
    skipped: tuple[Skipped, ...]
    others: int


def each_scenario(
    work: Callable[[Dataset, Any], Result | None],
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    *,
    label: str,
    at_once: int = _RUN_LENGTH,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> Found[Result]:
    """Apply a computation to scenarios, each once.

    Args:
        work: an importable function of the devkit (or a `functools.partial` of one) of a release and a scenario's
            record. It returns None for a scenario that it does not concern, and raises NotAvailableError for one that
            lacks what it needs.
        dataset: the release.
        scenarios: tokens or records; None for all.
        label: text of the progress bar.
        at_once: scenarios of a piece of work; 1 where one takes tenths of a second.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        TokenError: no such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    chosen = range(len(dataset.scenario)) if scenarios is None else [dataset.getind("scenario", s) for s in scenarios]
    rows = sorted(set(chosen))
    runs = [rows[first : first + at_once] for first in range(0, len(rows), at_once)]
    how: dict[str, Any] = {"workers": workers, "executor": executor, "label": label, "progress": progress}
    sizes, places = [len(run) for run in runs], Places(reads=dataset.places)
    parts = in_order(run_unordered(partial(_run, work, dataset), runs, sizes=sizes, places=places, **how))
    return sorted_out([each for part in parts for each in part])


def _run(
    work: Callable[[Dataset, Any], Result | None], dataset: Dataset, rows: Sequence[int]
) -> list[Result | Skipped | None]:
    return [tried(work, dataset, dataset.scenario[row]) for row in rows]


def tried(
    work: Callable[[Dataset, Any], Result | None], dataset: Dataset, scenario: ScenarioRecord
) -> Result | Skipped | None:
    """What a computation, as `each_scenario` takes it, finds in one scenario, or why it finds nothing."""
    try:
        return work(dataset, scenario)
    except NotAvailableError as error:
        return Skipped(scenario=scenario["token"], reason=str(error))


def sorted_out(found: Sequence[Result | Skipped | None]) -> Found[Result]:
    """The results of `tried`, those of a kind together."""
    return Found(
        results=tuple(each for each in found if each is not None and not isinstance(each, Skipped)),
        skipped=tuple(each for each in found if isinstance(each, Skipped)),
        others=sum(each is None for each in found),
    )
