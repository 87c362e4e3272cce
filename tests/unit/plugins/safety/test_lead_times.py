import csv
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.descriptions import ObservationRule, observed_actors
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.plugins.safety import (
    COALITIONS,
    PARTNERS,
    LeadTimes,
    avoidability_report,
    lead_time_ledger,
    lead_times,
    twin_report,
)
from deepaccident_devkit.plugins.safety.lead_times import mean_times
from deepaccident_devkit.taxonomy import AGENTS


def without(root: Path, agent: str) -> DeepAccident:
    """The release without an agent's labels."""
    for folder in root.glob(f"*/*/{agent}/label"):
        shutil.rmtree(folder)
    return DeepAccident("v1", root, verbose=False)


@pytest.mark.parametrize("kind", ["annotated", "points", "released"])
def test_each_set_of_agents_by_a_plain_search(da_motion: DeepAccident, kind: str) -> None:
    scenario, normal = (da_motion.find(collision=ends)[0] for ends in (True, False))
    times = lead_times(da_motion, scenario, ObservationRule(kind=kind))
    assert (times.ego_collides, lead_times(da_motion, normal)) == (True, None)
    _, observed = observed_actors(da_motion, scenario, times.actor_ids, times.rule)
    for number, members in enumerate(COALITIONS):
        both = observed[[AGENTS.index(name) for name in members]].any(axis=0).all(axis=0)
        frame = int(np.flatnonzero(both)[0]) + 1 if both.any() else 0
        lead = (scenario["num_frames"] - frame) / 10 if frame else 0
        assert (times.first_frames[number], times.leads[number]) == (frame, pytest.approx(lead))
    assert times.shapley.sum() == pytest.approx(times.together - times.alone)
    assert times.gains[3] == pytest.approx(times.leads[8] - times.leads[0])
    assert times.losses[0] == pytest.approx(times.leads[15] - times.leads[14])


def test_gains_and_losses_are_differences_of_sets() -> None:
    leads = np.array(
        [1.0, 1.5, 2.0, 2.25, 1.25, 3.0, 4.0, 4.5, 1.0, 5.0, 2.5, 5.5, 3.5, 6.0, 6.5, 7.0]
    )
    times = LeadTimes(
        scenario="type1_subtype1_accident/a",
        rule=ObservationRule(),
        actor_ids=(1, 2),
        categories=("car", "van"),
        colliding_agents=(None, "other_vehicle"),
        missing=(),
        num_frames=80,
        touching=None,
        first_frames=80 - np.round(leads * 10).astype(int),
        leads=leads,
        shapley=np.ones(4),
    )
    assert (times.ego_collides, times.alone, times.together, times.from_the_start) == (
        False,
        1.0,
        7.0,
        False,
    )
    assert (times.gains.tolist(), times.losses.tolist()) == (
        [0.5, 1.0, 0.25, 0.0],
        [0.5, 1.0, 1.5, 2.5],
    )
    frames = np.arange(16)[::-1]
    seen = [
        replace(times, first_frames=first).from_the_start
        for first in (frames + 1, frames + 2, 0 * frames)
    ]
    assert seen == [True, False, False]
    less = replace(times, missing=("infrastructure",))
    assert (less.together, less.losses.tolist()[:3]) == (4.5, [0.5, 1.5, 2.25])


def test_missing_agents_leave_the_sets_that_are_there(
    da: DeepAccident, da_partial: DeepAccident
) -> None:
    scenario = da.find(collision=True)[0]["token"]
    whole, partial = (
        lead_times(each, scenario, ObservationRule(kind="points")) for each in (da, da_partial)
    )
    assert (whole.missing, partial.missing) == ((), ("other_vehicle_behind",))
    known = np.array(["other_vehicle_behind" not in members for members in COALITIONS])
    np.testing.assert_array_equal(partial.leads, np.where(known, whole.leads, np.nan))
    for values in (partial.shapley, partial.gains, partial.losses):
        assert np.isnan(values).tolist() == [False, False, True, False]
    assert partial.together == whole.leads[0b1011]
    assert np.nansum(partial.shapley) == pytest.approx(partial.together - partial.alone)
    told = partial.to_dict()
    assert told["shapley_seconds"]["other_vehicle_behind"] is None
    assert json.loads(json.dumps(told, allow_nan=False)) == told


def test_without_the_egos_labels_there_is_a_reason(own_release: Path) -> None:
    da = without(own_release, "ego_vehicle")
    accident, ledger = da.find(collision=True)[0], lead_time_ledger(da)
    assert_refused(
        (lambda: lead_times(da, accident), NotAvailableError, ("has no labels of ego_vehicle",))
    )
    assert (ledger.accidents, len(ledger.skipped)) == ((), 3)
    assert "no labels of ego_vehicle" in ledger.to_text()


def test_scenarios_are_counted_and_a_chosen_few_looked_at(da_b: DeepAccident) -> None:
    accidents = [scenario["token"] for scenario in da_b.find(collision=True)]
    ledger, few = lead_time_ledger(da_b), lead_time_ledger(da_b, [accidents[1], accidents[1]])
    for each, tokens, others in (
        (ledger, accidents, len(da_b.scenario) - len(accidents)),
        (few, accidents[1:2], 0),
    ):
        assert ([one.scenario for one in each.accidents], each.without_accident) == (tokens, others)
    for means, name in ((ledger.mean_leads, "leads"), (ledger.mean_gains, "gains")):
        values = np.mean([getattr(each, name) for each in ledger.accidents], axis=0)
        assert [each.mean for each in means] == pytest.approx(values)


@pytest.mark.slow
@pytest.mark.parametrize("report", [lead_time_ledger, avoidability_report, twin_report])
def test_two_workers_find_the_same(da_b: DeepAccident, report: Callable[..., Any]) -> None:
    assert report(da_b, workers=2).to_json() == report(da_b, workers=1).to_json()


def test_means_have_intervals_from_six_accidents_on() -> None:
    values = np.random.default_rng(1).exponential(2.0, size=(400, 2))
    values[:396, 1] = np.nan
    known, few = mean_times(values)
    assert (few.accidents, few.low, few.high, few.text) == (4, None, None, f"{few.mean:.2f}")
    assert few.mean == pytest.approx(values[396:, 1].mean())
    values[:200, 1], values[200:, 1] = values[:200, 0], np.nan
    half = mean_times(values)[1]
    for mean, of in ((known, values[:, 0]), (half, values[:200, 0])):
        error = of.std() / math.sqrt(len(of))
        assert mean.mean == pytest.approx(of.mean())
        assert [mean.mean - mean.low, mean.high - mean.mean] == pytest.approx(
            [1.96 * error] * 2, abs=0.2 * error
        )


def test_the_command_prints_and_writes_the_ledger(da_b: DeepAccident, tmp_path: Path) -> None:
    command = ["safety", "lead-time", str(da_b.dataroot)]
    result = CliRunner().invoke(
        deepaccident, [*command, "--seen", "annotated", "--out", str(tmp_path)]
    )
    assert result.exit_code == 0
    names = {"lead_times.csv", "lead_times.json", "lead_times.png", "skipped.csv"}
    assert {path.name for path in tmp_path.iterdir()} == names
    told = json.loads((tmp_path / "lead_times.json").read_text(encoding="utf-8"))
    rows = list(
        csv.DictReader((tmp_path / "lead_times.csv").read_text(encoding="utf-8").splitlines())
    )
    assert len(rows) == told["summary"]["accidents"] == len(da_b.find(collision=True))
    for row, accident in zip(rows, told["accidents"], strict=True):
        values = {f"lead_{name}": str(lead) for name, lead in accident["lead_seconds"].items()}
        values |= {
            f"shapley_{partner}": str(accident["shapley_seconds"][partner]) for partner in PARTNERS
        }
        assert row.items() >= {**values, "scenario": accident["scenario"]}.items()
