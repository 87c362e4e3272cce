"""Statistics of interactions: how soon moving pairs would collide, and the most critical pair of each scenario."""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.statistics.results import Histogram, LeftOut
from deepaccident_devkit.statistics.selected import Selected, group_of
from deepaccident_devkit.statistics.tally import LEFT_OUT, PARTS, Tally

PAIRS: Final = "pair_min_ttcs"
SCENARIOS: Final = "scenario_min_ttcs"
_EDGES: Final = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0)


def count_interactions(dataset: Dataset, selected: Selected, tally: Tally) -> None:
    """Add the pairs of which each moves at some frame, and the scenarios by the most critical of these."""
    for scenario in selected.scenarios.values():
        group = group_of(scenario)
        pairs = interactions(dataset, scenario).pairs
        times = pairs.min_ttc[pairs.moving]
        finite = times[np.isfinite(times)]
        tally.counts[PAIRS, LEFT_OUT, group] += len(times) - len(finite)
        tally.counts[SCENARIOS, LEFT_OUT, group] += not len(finite)
        code = PARTS.index(group)
        tally.count_bins(PAIRS, finite, np.full(len(finite), code, dtype=np.int8), _EDGES)
        least = np.sort(finite)[:1]
        tally.count_bins(SCENARIOS, least, np.full(len(least), code, dtype=np.int8), _EDGES)


def interaction_histograms(tally: Tally) -> list[Histogram]:
    """The least time to collision of pairs, and of scenarios."""
    texts = (
        (PAIRS, "Least TTC of moving pairs", "pairs", "moving pairs that come near each other on no collision course"),
        (
            SCENARIOS,
            "Least TTC of scenarios",
            "scenarios",
            "scenarios without labels or moving pairs that would collide",
        ),
    )
    made = []
    for name, title, counted, what in texts:
        counts, outside = tally.by_bin(name, _EDGES)
        made.append(
            Histogram(
                name=name,
                title=title,
                field="least time to collision",
                unit="s",
                counted=counted,
                edges=_EDGES,
                counts=counts,
                outside=outside,
                left_out=LeftOut(what=what, counts=tally.by_group(name, LEFT_OUT)),
            )
        )
    return made
