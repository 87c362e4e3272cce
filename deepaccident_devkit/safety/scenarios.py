"""`each_scenario`: one computation on many scenarios, in processes or on executors, and what was left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.parallel import Places, in_order, run_unordered
from deepaccident_devkit.reports import Row
from deepaccident_devkit.safety.accidents import Skipped

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine
    from deepaccident_devkit.tables.records import ScenarioRecord

Result = TypeVar("Result")
_RUN_LENGTH: Final = 64
"""Scenarios that are looked at together: some tenths of a second."""


def skipped_rows(skipped: Iterable[Skipped]) -> list[Row]:
    """The table of what is left out."""
    return [("scenario", "reason"), *((each.scenario, each.reason) for each in skipped)]


def reasons_text(title: str, skipped: Iterable[Skipped]) -> str:
    """A line a reason under a title."""
    return "\n".join([f"{title}:", *(f"  {each.reason}" for each in skipped)])


def each_scenario(
    work: Callable[[Dataset, Any], Result | None],
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    *,
    label: str,
    at_once: int = _RUN_LENGTH,
    **how: Unpack[Engine],
) -> list[Result | Skipped | None]:
    """Apply a computation to scenarios, each once, in the order of the release.

    Args:
        work: an importable function of the devkit (or a `functools.partial` of one) of a release and a scenario's
            record. It returns None for a scenario that it does not concern, and raises NotAvailableError for one that
            lacks what it needs: then there is a Skipped.
        dataset: the release.
        scenarios: tokens or records; None for all. Raises TokenError.
        label: text of the progress bar.
        at_once: scenarios of a piece of work; 1 where one takes tenths of a second.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.
    """
    chosen = range(len(dataset.scenario)) if scenarios is None else [dataset.getind("scenario", s) for s in scenarios]
    rows = sorted(set(chosen))
    runs = [rows[first : first + at_once] for first in range(0, len(rows), at_once)]
    sizes, places = [len(run) for run in runs], Places(reads=dataset.places)
    parts = run_unordered(partial(_run, work, dataset), runs, sizes=sizes, places=places, label=label, **how)
    return [each for part in in_order(parts) for each in part]


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


def those_of(kind: type[Result], found: Iterable[object]) -> tuple[Result, ...]:
    """Of what `each_scenario` found, what is of a kind: results, or Skipped."""
    return tuple(each for each in found if isinstance(each, kind))
