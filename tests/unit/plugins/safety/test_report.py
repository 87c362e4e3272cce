"""The safety report: its numbers equal the numbers of its parts, each accident is replayed once,
and nothing is lost.
"""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from support.damaged_releases import damage_release
from support.text_contents import missing_parts

import deepaccident_devkit.plugins.safety.report as report_module
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import Skipped
from deepaccident_devkit.descriptions import describe, stories
from deepaccident_devkit.interactions import interactions
from deepaccident_devkit.plugins.safety import (
    SafetyReport,
    avoidability_report,
    lead_time_ledger,
    safety_report,
    twin_report,
)
from deepaccident_devkit.plugins.safety.avoidability_report import Dropped


@pytest.fixture(scope="module")
def report(da_motion: DeepAccident) -> SafetyReport:
    return safety_report(da_motion, workers=1)


def test_its_parts_are_those_of_the_functions(
    da_motion: DeepAccident, report: SafetyReport
) -> None:
    for part, function in (
        (report.avoidability, avoidability_report),
        (report.ledger, lead_time_ledger),
        (report.twins, twin_report),
    ):
        assert part.to_dict() == function(da_motion, workers=1).to_dict()

    accident_stories = [row.story for row in report.rows]
    assert accident_stories + list(report.normal) == list(stories(da_motion, workers=1))
    assert (report.scenarios, len(report.rows), report.left_out) == (2, 1, [])


def test_a_row_has_the_numbers_of_its_accident(
    da_motion: DeepAccident, report: SafetyReport
) -> None:
    (row,) = report.rows
    (replayed,) = report.avoidability.accidents
    (times,) = report.ledger.accidents
    (twin,) = report.twins.diffs
    story = describe(da_motion, row.scenario).facts["accident"]
    payload = row.to_dict()

    assert row.brakes == ["ego_vehicle"]
    assert payload["last_moments"]["6"] == story["braking"]["slack"]
    slack = replayed.slack[replayed.accident.agents.index("ego_vehicle")]
    last_moments = dict(zip((4.0, 6.0, 8.0), slack, strict=True))
    assert row.last_moments == pytest.approx(last_moments, abs=0.005)

    leads = {**story["seen"], "ego_vehicle": times.alone, "all": times.together}
    assert row.leads == pytest.approx(leads, abs=1e-6)
    assert row.parts == pytest.approx(twin.to_dict()["time_to_impact"])
    assert row.severity == max(collider["delta_v"] for collider in story["pair"])

    pairs = interactions(da_motion, row.scenario).pairs
    pair = pairs.position(*times.actor_ids)
    pet = np.inf if payload["pet"] is None else payload["pet"]
    assert payload["time_exposed"] == pytest.approx(pairs.tet[pair, 0], abs=0.005)
    assert pet == pytest.approx(abs(pairs.pet[pair]), abs=0.005)


def test_an_accident_that_cannot_be_replayed_keeps_its_row(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    (accident,) = da_motion.find(collision=True)
    dropped = Dropped(Skipped(scenario=accident["token"], reason="2.00 m apart"), 2.0)
    monkeypatch.setattr(report_module, "replay_accident", lambda *_: dropped)

    report = safety_report(da_motion, [accident], workers=1)
    (row,) = report.rows
    assert (row.replayed, row.last_moments, row.brakes, row.severity) == (None, {}, [], -1.0)
    assert report.left_out == [(row.scenario, "braking: dropped", "2.00 m apart")]
    assert report.to_dict()["margins"] == {row.scenario: 2.0}


def test_what_is_left_out_is_named(own_release: Path) -> None:
    damaged = damage_release(own_release)
    report = safety_report(damaged.dataset, workers=1)
    accidents = [row.scenario for row in report.rows]
    normal = [story.facts["scenario"] for story in report.normal]
    assert sorted(accidents + normal) == sorted(damaged.whole)

    messages = {scenario: f"{part}: {reason}" for scenario, part, reason in report.left_out}
    for scenario, *words in (
        (damaged.without_meta, "braking: skipped, lead times", "no meta file"),
        (damaged.without_labels, "braking: skipped, lead times", "no labels"),
        (damaged.broken, "everything", "on_error='skip'"),
    ):
        assert not missing_parts(messages[scenario], *words)


def test_normal_scenarios_come_by_their_least_time_to_collision(da_b: DeepAccident) -> None:
    normal = safety_report(da_b, workers=1).normal
    nearest = [story.facts["nearest"] for story in normal]
    times = [np.inf if approach is None else approach["min_ttc"] for approach in nearest]

    assert times == sorted(times)
    assert len(normal) == sum(scenario["collision"] is None for scenario in da_b.scenario)


def test_tables(report: SafetyReport, tmp_path: Path) -> None:
    (row,) = report.rows
    accidents, left_out = report.to_csv(tmp_path)
    heading, line = csv.reader(accidents.read_text(encoding="utf-8").splitlines())
    cells = dict(zip(heading, line, strict=True))
    assert (cells["scenario"], cells["story"]) == (row.scenario, row.story.text)

    numbers = {
        "closing_speed": row.story.facts["accident"]["closing_speed"],
        "lead_infrastructure": row.leads["infrastructure"],
        "last_moment_8": row.last_moments[8.0],
        "second_delta_v": row.colliders[1]["delta_v"],
        "twin_parts": row.parts,
    }
    assert {name: float(cells[name]) for name in numbers} == numbers
    assert left_out.read_text() == "scenario,part,reason\n"
    assert json.loads(report.to_json())["accidents"][0] == json.loads(json.dumps(row.to_dict()))
