"""The lead-time ledger: the lead times of all accidents of a release, their means, and what was left out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.parallel import Places, in_order, run_unordered
from deepaccident_devkit.safety.accidents import Skipped
from deepaccident_devkit.safety.lead_times import LeadTimes, lead_times
from deepaccident_devkit.safety.ledger_report import LeadTimeLedger
from deepaccident_devkit.safety.observation import ObservationRule

if TYPE_CHECKING:
    from concurrent.futures import Executor

_RUN_LENGTH: Final = 64
"""Scenarios that are looked at together: some tenths of a second."""


def lead_time_ledger(
    dataset: Dataset,
    scenarios: Iterable[RowArgument] | None = None,
    rule: ObservationRule | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> LeadTimeLedger:
    """The lead times of every accident, and the scenarios of which they cannot be told.

    Args:
        dataset: the release.
        scenarios: tokens or records of those to look at, such as `find` gives; None for all.
        rule: when an actor counts as observed; None for `ObservationRule()`.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        TokenError: no such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    rule = rule or ObservationRule()
    chosen = range(len(dataset.scenario)) if scenarios is None else [dataset.getind("scenario", s) for s in scenarios]
    rows = sorted(set(chosen))
    runs = [rows[first : first + _RUN_LENGTH] for first in range(0, len(rows), _RUN_LENGTH)]
    results = in_order(
        run_unordered(
            partial(_lead_times_of, dataset, rule),
            runs,
            workers=workers,
            executor=executor,
            label="lead times",
            progress=progress,
            sizes=[len(run) for run in runs],
            places=Places(reads=dataset.places),
        )
    )
    found = [each for run in results for each in run]
    accidents = tuple(each for each in found if isinstance(each, LeadTimes))
    skipped = tuple(each for each in found if isinstance(each, Skipped))
    return LeadTimeLedger(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        rule=rule,
        accidents=accidents,
        skipped=skipped,
        without_accident=len(rows) - len(found),
    )


def _lead_times_of(dataset: Dataset, rule: ObservationRule, rows: Sequence[int]) -> list[LeadTimes | Skipped]:
    """Of scenarios by row; those without a collision are in neither form."""
    result: list[LeadTimes | Skipped] = []
    for row in rows:
        scenario = dataset.scenario[row]
        try:
            found = lead_times(dataset, scenario, rule)
        except NotAvailableError as error:
            result.append(Skipped(scenario=scenario["token"], reason=str(error)))
            continue
        if found is not None:
            result.append(found)
    return result
