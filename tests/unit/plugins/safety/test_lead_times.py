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
from support.expected_errors import assert_raises

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


def remove_labels(root: Path, agent: str) -> DeepAccident:
    """Remove an agent's labels, and open the release."""
    for folder in root.glob(f"*/*/{agent}/label"):
        shutil.rmtree(folder)
    return DeepAccident("v1", root, verbose=False)


@pytest.mark.parametrize("kind", ["annotated", "points", "released"])
def test_each_set_of_agents_by_a_plain_search(da_motion: DeepAccident, kind: str) -> None:
    accident, normal = (da_motion.find(collision=collides)[0] for collides in (True, False))
    times = lead_times(da_motion, accident, ObservationRule(kind=kind))
    assert times.ego_collides is True
    assert lead_times(da_motion, normal) is None

    _, observed = observed_actors(da_motion, accident, times.actor_ids, times.rule)
    for number, members in enumerate(COALITIONS):
        rows = [AGENTS.index(name) for name in members]
        both = observed[rows].any(axis=0).all(axis=0)
        frame = int(np.flatnonzero(both)[0]) + 1 if both.any() else 0
        lead = (accident["num_frames"] - frame) / 10 if frame else 0
        assert times.first_frames[number] == frame
        assert times.leads[number] == pytest.approx(lead)

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
    assert (times.ego_collides, times.from_the_start) == (False, False)
    assert (times.alone, times.together) == (1.0, 7.0)
    assert times.gains.tolist() == [0.5, 1.0, 0.25, 0.0]
    assert times.losses.tolist() == [0.5, 1.0, 1.5, 2.5]

    frames = np.arange(16)[::-1]
    from_the_start = [
        replace(times, first_frames=first_frames).from_the_start
        for first_frames in (frames + 1, frames + 2, 0 * frames)
    ]
    assert from_the_start == [True, False, False]

    less = replace(times, missing=("infrastructure",))
    assert less.together == 4.5
    assert less.losses.tolist()[:3] == [0.5, 1.5, 2.25]


def test_missing_agents_leave_the_other_sets(da: DeepAccident, da_partial: DeepAccident) -> None:
    scenario = da.find(collision=True)[0]["token"]
    rule = ObservationRule(kind="points")
    whole, partial = (lead_times(dataset, scenario, rule) for dataset in (da, da_partial))
    assert (whole.missing, partial.missing) == ((), ("other_vehicle_behind",))

    known = np.array(["other_vehicle_behind" not in members for members in COALITIONS])
    np.testing.assert_array_equal(partial.leads, np.where(known, whole.leads, np.nan))
    for values in (partial.shapley, partial.gains, partial.losses):
        assert np.isnan(values).tolist() == [False, False, True, False]
    assert partial.together == whole.leads[0b1011]
    assert np.nansum(partial.shapley) == pytest.approx(partial.together - partial.alone)

    payload = partial.to_dict()
    assert payload["shapley_seconds"]["other_vehicle_behind"] is None
    assert json.loads(json.dumps(payload, allow_nan=False)) == payload


def test_without_the_egos_labels_there_is_a_reason(own_release: Path) -> None:
    da = remove_labels(own_release, "ego_vehicle")
    accident = da.find(collision=True)[0]
    assert_raises(
        (lambda: lead_times(da, accident), NotAvailableError, ("has no labels of ego_vehicle",))
    )

    ledger = lead_time_ledger(da)
    assert (ledger.accidents, len(ledger.skipped)) == ((), 3)
    assert "no labels of ego_vehicle" in ledger.to_text()


def test_scenarios_are_counted_and_a_chosen_few_looked_at(da_b: DeepAccident) -> None:
    tokens = [scenario["token"] for scenario in da_b.find(collision=True)]
    full_ledger = lead_time_ledger(da_b)
    short_ledger = lead_time_ledger(da_b, [tokens[1], tokens[1]])

    for ledger, expected_tokens, without_accident in (
        (full_ledger, tokens, len(da_b.scenario) - len(tokens)),
        (short_ledger, tokens[1:2], 0),
    ):
        assert [accident.scenario for accident in ledger.accidents] == expected_tokens
        assert ledger.without_accident == without_accident

    for means, name in (
        (full_ledger.mean_leads, "leads"),
        (full_ledger.mean_gains, "gains"),
    ):
        values = np.mean([getattr(accident, name) for accident in full_ledger.accidents], axis=0)
        assert [mean.mean for mean in means] == pytest.approx(values)


@pytest.mark.slow
@pytest.mark.parametrize("make_report", [lead_time_ledger, avoidability_report, twin_report])
def test_two_workers_find_the_same(da_b: DeepAccident, make_report: Callable[..., Any]) -> None:
    one = make_report(da_b, workers=1)
    two = make_report(da_b, workers=2)
    assert two.to_json() == one.to_json()


def test_means_have_intervals_from_six_accidents_on() -> None:
    values = np.random.default_rng(1).exponential(2.0, size=(400, 2))
    values[:396, 1] = np.nan
    full, few = mean_times(values)
    assert (few.accidents, few.low, few.high, few.text) == (4, None, None, f"{few.mean:.2f}")
    assert few.mean == pytest.approx(values[396:, 1].mean())

    values[:200, 1] = values[:200, 0]
    values[200:, 1] = np.nan
    half = mean_times(values)[1]
    for interval, sample in (
        (full, values[:, 0]),
        (half, values[:200, 0]),
    ):
        error = sample.std() / math.sqrt(len(sample))
        assert interval.mean == pytest.approx(sample.mean())
        assert [interval.mean - interval.low, interval.high - interval.mean] == pytest.approx(
            [1.96 * error] * 2, abs=0.2 * error
        )


def test_the_command_prints_and_writes_the_ledger(da_b: DeepAccident, tmp_path: Path) -> None:
    arguments = ["safety", "lead-time", str(da_b.dataroot), "--seen", "annotated"]
    result = CliRunner().invoke(deepaccident, [*arguments, "--out", str(tmp_path)])
    assert result.exit_code == 0
    names = {"lead_times.csv", "lead_times.json", "lead_times.png", "skipped.csv"}
    assert {path.name for path in tmp_path.iterdir()} == names

    payload = json.loads((tmp_path / "lead_times.json").read_text(encoding="utf-8"))
    lines = (tmp_path / "lead_times.csv").read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(lines))
    assert len(rows) == payload["summary"]["accidents"] == len(da_b.find(collision=True))

    for row, accident in zip(rows, payload["accidents"], strict=True):
        leads = accident["lead_seconds"]
        shapley = accident["shapley_seconds"]
        assert row["scenario"] == accident["scenario"]
        assert row.items() >= {f"lead_{name}": str(lead) for name, lead in leads.items()}.items()
        assert (
            row.items()
            >= {f"shapley_{partner}": str(shapley[partner]) for partner in PARTNERS}.items()
        )
