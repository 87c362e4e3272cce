"""The lead-time ledger: the lead times of all accidents of a release, and what was left out."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.safety.lead_times import lead_times
from deepaccident_devkit.safety.ledger_report import LeadTimeLedger
from deepaccident_devkit.safety.observation import ObservationRule
from deepaccident_devkit.safety.scenarios import each_scenario

if TYPE_CHECKING:
    from concurrent.futures import Executor


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
    found = each_scenario(
        partial(lead_times, rule=rule),
        dataset,
        scenarios,
        label="lead times",
        workers=workers,
        executor=executor,
        progress=progress,
    )
    return LeadTimeLedger(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        rule=rule,
        accidents=found.results,
        skipped=found.skipped,
        without_accident=found.others,
    )
