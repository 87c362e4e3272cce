"""Statistics of interactions: as `da.interactions` has them, and only if asked for."""

import numpy as np
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.statistics import dataset_statistics

EDGES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0)


def test_pairs_and_scenarios_are_in_their_bins(da_b: DeepAccident) -> None:
    plain = dataset_statistics(da_b)
    assert not {"pair_min_ttcs", "scenario_min_ttcs"} & plain.histograms.keys()
    made = dataset_statistics(da_b, interactions=True)
    assert {name: each for name, each in made.histograms.items() if name in plain.histograms} == plain.histograms
    times = [found.pairs.min_ttc[found.pairs.moving] for found in map(da_b.interactions, da_b.scenario)]
    pairs, scenarios = made.histograms["pair_min_ttcs"], made.histograms["scenario_min_ttcs"]
    together = np.concatenate(times)
    assert pairs.counts["total"] == tuple(np.histogram(together[together <= 10], EDGES)[0])
    assert pairs.outside["total"] == ((together > 10) & np.isfinite(together)).sum()
    assert pairs.left_out.counts["total"] == np.isinf(together).sum()
    least = np.array([each.min() for each in times])
    assert scenarios.counts["total"] == tuple(np.histogram(least[least <= 10], EDGES)[0])
    assert scenarios.total() + scenarios.left_out.counts["total"] == len(da_b.scenario)
    below = int((least < 1.5).sum())
    line = next(line for line in made.to_text().splitlines() if line.startswith("below 1.5 s"))
    assert f" {below} ({round(100 * below / len(least)):>3} %)" in line
    assert "below 1.5 s" not in plain.to_text()


def test_the_verb_counts_them(da_b: DeepAccident) -> None:
    words = ["info", str(da_b.dataroot), "--statistics", "--interactions"]
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    assert result.exit_code == 0
    assert result.output.rstrip("\n") == dataset_statistics(da_b, interactions=True).to_text()
