"""All statistics of a release, or of some of its scenarios."""

from __future__ import annotations

from collections.abc import Iterable

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.statistics import actors
from deepaccident_devkit.statistics import scenarios as whole
from deepaccident_devkit.statistics.collisions import collision_histograms, collision_pairs
from deepaccident_devkit.statistics.report import DatasetStatistics
from deepaccident_devkit.statistics.selected import Selected, group_counts


def dataset_statistics(
    dataset: Dataset, scenarios: RowArgument | Iterable[RowArgument] | None = None
) -> DatasetStatistics:
    """Compute the paper's statistics on the tables' columns: no record of an annotation is made.

    Everything is counted for all scenarios and for each split. Scenarios without labels count where calib, meta and
    folders are enough; elsewhere a table's `left_out` says how many there are.

    Args:
        dataset: the release.
        scenarios: tokens or records of its scenarios to count alone, such as `find` gives, or a single one; None for
            all.

    Raises:
        TokenError: something is no scenario of the release.
        ChoiceError: `scenarios` is nothing of this.
    """
    selected = Selected(dataset, scenarios)
    pairs, left_out = collision_pairs(selected)
    angles, bearings = collision_histograms(pairs, left_out)
    distance_histogram, distance_quantiles = actors.distances(selected)
    speed_histogram, speed_quantiles = actors.speeds(selected)
    counts = [*whole.scenario_counts(selected), *actors.actor_counts(selected)]
    histograms = [
        whole.lengths(selected),
        whole.ego_speeds(selected),
        actors.actors(selected),
        distance_histogram,
        speed_histogram,
        angles,
        bearings,
    ]
    quantiles = [whole.ego_sizes(selected), actors.box_sizes(selected), distance_quantiles, speed_quantiles]
    return DatasetStatistics(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        release_scenarios=len(dataset.scenario),
        selected=scenarios is not None,
        scenarios=group_counts(selected.scenario_group),
        frames=group_counts(selected.group("frame")),
        samples=group_counts(selected.group("sample")),
        unlabelled=selected.unlabelled.counts,
        counts={table.name: table for table in counts},
        histograms={table.name: table for table in histograms},
        quantiles={table.name: table for table in quantiles},
        collisions=pairs,
    )
