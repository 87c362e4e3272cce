"""All statistics of a release, or of some of its scenarios: counted in runs of scenarios, and added up."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.parallel import Places, in_order, run_unordered
from deepaccident_devkit.statistics import actors
from deepaccident_devkit.statistics import scenarios as whole
from deepaccident_devkit.statistics.collisions import collision_histograms, collision_pairs, count_collisions
from deepaccident_devkit.statistics.interactions import count_interactions, interaction_histograms
from deepaccident_devkit.statistics.report import DatasetStatistics
from deepaccident_devkit.statistics.selected import Selected
from deepaccident_devkit.statistics.tally import Tally

if TYPE_CHECKING:
    from concurrent.futures import Executor

Chosen = RowArgument | Iterable[RowArgument] | None
"""Tokens or records of scenarios, or a single one; None for all."""
RUN_LENGTH = 64
"""Scenarios that are counted at once: some tenths of a second, so that a release of 691 is no work for a pool."""


def dataset_statistics(
    dataset: Dataset,
    scenarios: Chosen = None,
    *,
    interactions: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> DatasetStatistics:
    """Compute the paper's statistics on the tables' columns: no record of an annotation is made.

    Everything is counted for all scenarios and for each split. Scenarios without labels count where calib, meta and
    folders are enough; elsewhere a table's `left_out` says how many there are.

    Args:
        dataset: the release.
        scenarios: tokens or records of its scenarios to count alone, such as `find` gives, or a single one; None for
            all.
        interactions: whether to add how soon moving pairs would collide (`da.interactions`); where these are not kept
            yet, a tenth of a second a scenario.
        workers: processes; None chooses by the amount of work, one for a release of today's size.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        TokenError: something is no scenario of the release.
        ChoiceError: `scenarios` is nothing of this, or `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    rows = chosen_rows(dataset, scenarios)
    tallies = tallies_of(
        dataset, runs_of(rows), interactions=interactions, workers=workers, executor=executor, progress=progress
    )
    return statistics_of(dataset, tallies, selected=scenarios is not None, interactions=interactions)


def chosen_rows(dataset: Dataset, scenarios: Chosen) -> Sequence[int]:
    """The rows of scenarios, ascending; raises TokenError or ChoiceError."""
    if isinstance(scenarios, str | Mapping):
        scenarios = [scenarios]
    if scenarios is None:
        return range(len(dataset.scenario))
    if not isinstance(scenarios, Iterable):
        raise ChoiceError(f"scenarios: expected tokens or records of scenarios, found {scenarios!r}")
    return sorted({dataset.getind("scenario", token) for token in scenarios})


def runs_of(rows: Iterable[int]) -> list[list[int]]:
    """Rows of scenarios in runs of neighbours that are counted together."""
    return [list(run) for _, run in groupby(rows, lambda row: row // RUN_LENGTH)]


def tallies_of(
    dataset: Dataset,
    runs: Sequence[Sequence[int]],
    *,
    interactions: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> Iterable[Tally]:
    """The tally of each run of scenarios, in their order; arguments and errors are those of `dataset_statistics`."""
    return in_order(
        run_unordered(
            partial(tally_of, dataset, interactions=interactions),
            runs,
            workers=workers,
            executor=executor,
            label="counting",
            progress=progress,
            sizes=[len(run) for run in runs],
            places=Places(reads=dataset.places),
        )
    )


def tally_of(dataset: Dataset, rows: Sequence[int], *, interactions: bool = False) -> Tally:
    """What is counted in neighbouring scenarios, with or without interactions."""
    selected, tally = Selected(dataset, rows), Tally()
    whole.count_scenarios(selected, tally)
    whole.count_egos(selected, tally)
    actors.count_actors(selected, tally)
    actors.count_boxes(selected, tally)
    actors.count_speeds(selected, tally)
    count_collisions(selected, tally)
    if interactions:
        count_interactions(dataset, selected, tally)
    return tally


def statistics_of(
    dataset: Dataset, tallies: Iterable[Tally], *, selected: bool, interactions: bool = False
) -> DatasetStatistics:
    """The statistics that the tallies of runs of scenarios add up to.

    Args:
        dataset: the release.
        tallies: of all runs, in any order.
        selected: whether they are of a selection.
        interactions: whether these were counted too.
    """
    tally = Tally()
    for each in tallies:
        tally.add(each)
    distance_histogram, distance_quantiles = actors.distances(tally)
    speed_histogram, speed_quantiles = actors.speeds(tally)
    counts = [*whole.scenario_counts(tally), *actors.actor_counts(tally)]
    histograms = [
        whole.lengths(tally),
        whole.ego_speeds(tally),
        actors.actors(tally),
        distance_histogram,
        speed_histogram,
        *collision_histograms(tally),
        *(interaction_histograms(tally) if interactions else ()),
    ]
    quantiles = [whole.ego_sizes(tally), actors.box_sizes(tally), distance_quantiles, speed_quantiles]
    return DatasetStatistics(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        release_scenarios=len(dataset.scenario),
        selected=selected,
        scenarios=tally.by_group("scenarios"),
        frames=tally.by_group("frames"),
        samples=tally.by_group("samples"),
        unlabelled=tally.by_group("unlabelled"),
        counts={table.name: table for table in counts},
        histograms={table.name: table for table in histograms},
        quantiles={table.name: table for table in quantiles},
        collisions=collision_pairs(tally),
    )
