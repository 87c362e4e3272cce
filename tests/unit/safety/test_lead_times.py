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

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.safety import (
    COALITIONS,
    PARTNERS,
    LeadTimes,
    ObservationRule,
    avoidability_report,
    lead_time_ledger,
    lead_times,
    twin_report,
)
from deepaccident_devkit.safety.lead_times import CAVEAT, mean_times
from deepaccident_devkit.safety.observation import observed_actors
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.taxonomy import AGENTS


def reopened(root: Path) -> DeepAccident:
    shutil.rmtree(root / ".deepaccident", ignore_errors=True)
    return DeepAccident("v1", root, verbose=False)


@pytest.mark.parametrize("kind", ["annotated", "points", "released"])
def test_each_set_of_agents_by_a_plain_search(da_motion: DeepAccident, kind: str) -> None:
    scenario = da_motion.find(collision=True)[0]
    times = lead_times(da_motion, scenario, ObservationRule(kind=kind))
    assert times is not None
    assert times.ego_collides
    _, observed = observed_actors(da_motion, scenario, times.actor_ids, times.rule)
    for number, members in enumerate(COALITIONS):
        both = observed[[AGENTS.index(name) for name in members]].any(axis=0).all(axis=0)
        frames = np.flatnonzero(both) + 1
        assert times.first_frames[number] == (frames[0] if len(frames) else 0)
        expected = (scenario["num_frames"] - frames[0]) / 10 if len(frames) else 0
        assert times.leads[number] == pytest.approx(expected)
    assert times.shapley.sum() == pytest.approx(times.together - times.alone)
    assert times.gains[3] == pytest.approx(times.leads[8] - times.leads[0])
    assert times.losses[0] == pytest.approx(times.leads[15] - times.leads[14])


def test_gains_and_losses_are_differences_of_sets() -> None:
    leads = np.array([1.0, 1.5, 2.0, 2.25, 1.25, 3.0, 4.0, 4.5, 1.0, 5.0, 2.5, 5.5, 3.5, 6.0, 6.5, 7.0])
    times = LeadTimes(
        scenario="type1_subtype1_accident/a",
        rule=ObservationRule(),
        actor_ids=(1, 2),
        categories=("car", "van"),
        colliding_agents=(None, "other_vehicle"),
        missing=(),
        num_frames=80,
        first_frames=80 - np.round(leads * 10).astype(int),
        leads=leads,
        shapley=np.ones(4),
    )
    assert not times.ego_collides
    assert (times.alone, times.together) == (1.0, 7.0)
    assert times.gains.tolist() == [0.5, 1.0, 0.25, 0.0]
    assert times.losses.tolist() == [0.5, 1.0, 1.5, 2.5]
    assert not times.from_the_start
    assert replace(times, first_frames=np.arange(16)[::-1] + 1).from_the_start
    assert not replace(times, first_frames=np.arange(16)[::-1] + 2).from_the_start
    assert not replace(times, first_frames=np.zeros(16, dtype=int)).from_the_start
    lacking = replace(times, missing=("infrastructure",))
    assert lacking.together == 4.5
    assert lacking.losses.tolist()[:3] == [0.5, 1.5, 2.25]


def test_a_scenario_without_a_collision_has_no_lead_times(da_motion: DeepAccident) -> None:
    assert lead_times(da_motion, da_motion.find(collision=False)[0]) is None


def test_missing_agents_leave_the_sets_that_are_there(da: DeepAccident, da_partial: DeepAccident) -> None:
    scenario = da.find(collision=True)[0]["token"]
    whole, partial = (lead_times(each, scenario, ObservationRule(kind="points")) for each in (da, da_partial))
    assert whole is not None
    assert partial is not None
    assert (whole.missing, partial.missing) == ((), ("other_vehicle_behind",))
    lacking = np.array(["other_vehicle_behind" in members for members in COALITIONS])
    assert np.isnan(partial.leads[lacking]).all()
    np.testing.assert_array_equal(partial.leads[~lacking], whole.leads[~lacking])
    assert np.isnan(partial.shapley).tolist() == [False, False, True, False]
    assert np.isnan(partial.gains).tolist() == np.isnan(partial.losses).tolist() == [False, False, True, False]
    assert partial.together == whole.leads[0b1011]
    assert np.nansum(partial.shapley) == pytest.approx(partial.together - partial.alone)
    told = partial.to_dict()
    assert told["shapley_seconds"]["other_vehicle_behind"] is None
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    text = lead_time_ledger(da_partial).to_text()
    assert "*: of the agents that are there" in text


def test_without_the_egos_labels_there_is_a_reason(own_release: Path) -> None:
    for folder in own_release.glob("*/*/ego_vehicle/label"):
        shutil.rmtree(folder)
    da = reopened(own_release)
    with pytest.raises(NotAvailableError, match="has no labels of ego_vehicle"):
        lead_times(da, da.find(collision=True)[0])
    ledger = lead_time_ledger(da)
    assert (ledger.accidents, len(ledger.skipped)) == ((), 3)
    assert "no labels of ego_vehicle" in ledger.to_text()
    assert ledger.mean_leads[0].text == "–"
    assert ledger.share_never_alone is None


def test_an_agent_without_labels_counts_as_missing(own_release: Path) -> None:
    for folder in own_release.glob("*/*/infrastructure/label"):
        shutil.rmtree(folder)
    ledger = lead_time_ledger(reopened(own_release))
    assert {each.missing for each in ledger.accidents} == {("infrastructure",)}


def test_scenarios_are_counted_and_a_chosen_few_looked_at(da_b: DeepAccident) -> None:
    accidents = [scenario["token"] for scenario in da_b.find(collision=True)]
    ledger = lead_time_ledger(da_b)
    assert [each.scenario for each in ledger.accidents] == accidents
    assert ledger.without_accident == len(da_b.scenario) - len(accidents)
    few = lead_time_ledger(da_b, [accidents[1], accidents[1]])
    assert ([each.scenario for each in few.accidents], few.without_accident) == ([accidents[1]], 0)
    leads = np.array([each.leads for each in ledger.accidents])
    for number, mean in enumerate(ledger.mean_leads):
        assert mean.mean == pytest.approx(leads[:, number].mean())
    assert ledger.mean_gains[1].mean == pytest.approx(np.mean([each.gains[1] for each in ledger.accidents]))


@pytest.mark.slow
@pytest.mark.parametrize("report", [lead_time_ledger, avoidability_report, twin_report])
def test_two_workers_find_the_same(da_b: DeepAccident, report: Callable[..., Any]) -> None:
    assert report(da_b, workers=2).to_json() == report(da_b, workers=1).to_json()


@pytest.mark.slow
def test_a_house_hides_the_colliders_from_each_other_until_a_second_before(tmp_path: Path) -> None:
    """What the generator built, found again from the labels alone."""
    root = make_release(tmp_path / "r", SynthConfig(scenarios=2, sensors=False, view="hidden", seed=2), workers=1)
    da = DeepAccident("v1", root, verbose=False)
    for kind in ("points", "released"):
        times = lead_times(da, da.find(collision=True)[0], ObservationRule(kind=kind))
        assert times is not None
        assert 0.5 < times.alone < 2
        assert times.gains[0] == 0
        assert (times.gains[1:] > 1.5).all()
        assert times.together == pytest.approx((times.num_frames - 1) / 10)


def test_means_have_intervals_from_six_accidents_on() -> None:
    values = np.random.default_rng(1).exponential(2.0, size=(400, 2))
    values[:396, 1] = np.nan
    known, few = mean_times(values)
    assert known.mean == pytest.approx(values[:, 0].mean())
    error = values[:, 0].std() / 20
    assert known.low == pytest.approx(known.mean - 1.96 * error, abs=0.2 * error)
    assert known.high == pytest.approx(known.mean + 1.96 * error, abs=0.2 * error)
    assert (few.accidents, few.low, few.high) == (4, None, None)
    assert few.mean == pytest.approx(values[396:, 1].mean())
    assert few.text == f"{few.mean:.2f}"
    values[:200, 1], values[200:, 1] = values[:200, 0], np.nan
    half = mean_times(values)[1]
    error = values[:200, 0].std() / math.sqrt(200)
    assert half.low == pytest.approx(values[:200, 0].mean() - 1.96 * error, abs=0.2 * error)
    same = mean_times(np.full((6, 1), 2.5))[0]
    assert (same.mean, same.low, same.high) == (2.5, 2.5, 2.5)


def test_the_command_prints_and_writes_the_ledger(da_b: DeepAccident, tmp_path: Path) -> None:
    root = str(da_b.dataroot)
    where = ["--seen", "annotated"]
    result = CliRunner().invoke(
        deepaccident, ["safety", "lead-time", root, *where, "--out", str(tmp_path / "out")], catch_exceptions=False
    )
    assert result.exit_code == 0
    assert CAVEAT in result.output
    assert "observed: annotated" in result.output
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"lead_times.csv", "lead_times.json", "lead_times.png", "skipped.csv"}
    told = json.loads((tmp_path / "out" / "lead_times.json").read_text(encoding="utf-8"))
    with (tmp_path / "out" / "lead_times.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(told["accidents"]) == told["summary"]["accidents"] == len(da_b.find(collision=True))
    for row, accident in zip(rows, told["accidents"], strict=True):
        assert row["scenario"] == accident["scenario"]
        for name, lead in accident["lead_seconds"].items():
            assert float(row[f"lead_{name}"]) == lead
        for partner in PARTNERS:
            assert float(row[f"shapley_{partner}"]) == accident["shapley_seconds"][partner]
    again = CliRunner().invoke(deepaccident, ["safety", "lead-time", root, "--where", "collision=false", "--json"])
    assert json.loads(again.output)["summary"]["without_accident"] == len(da_b.find(collision=False))
