"""Avoidability of many accidents: shares, text, CSV and JSON; dropped and skipped accidents are
named.
"""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.braking_accidents import head_on_accident, rear_end_accident
from support.expected_errors import assert_raises
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import OUTCOMES, Skipped, outcomes
from deepaccident_devkit.collisions.outcomes import delta_v_ranges
from deepaccident_devkit.descriptions import Avoidability, avoidability_of
from deepaccident_devkit.descriptions.avoidability import SecondaryContact
from deepaccident_devkit.errors import ConfigError, TokenError
from deepaccident_devkit.plugins.safety import (
    AvoidabilityReport,
    avoidability_report,
    outcome_shares,
)
from deepaccident_devkit.plugins.safety.avoidability_report import group_of


def make_report(accidents: Sequence[Avoidability], **changes: Any) -> AvoidabilityReport:
    fields = {
        "dataroot": "/data",
        "version": "v1",
        "dropped": (),
        "skipped": (),
        "margins": {},
        **changes,
    }
    return AvoidabilityReport(accidents=tuple(accidents), **fields)


AVOIDED = OUTCOMES.index("avoided")


@pytest.fixture(scope="module")
def accidents() -> list[Avoidability]:
    """Two rear-end accidents of 5 and 3 s in which the ego is the striker, a head-on one, and one
    with a pedestrian.
    """
    heavy = replace(
        rear_end_accident(20, 10),
        masses=np.array([1000.0, 3000.0]),
    )
    pedestrian = replace(
        rear_end_accident(8, 1, 2),
        categories=("car", "pedestrian"),
        agents=(None, None),
    )
    recorded = (heavy, rear_end_accident(20, 16, 3), head_on_accident(10, 4), pedestrian)
    return [avoidability_of(accident) for accident in recorded]


@pytest.fixture(scope="module")
def report(accidents: list[Avoidability]) -> AvoidabilityReport:
    margins = {f"s{number}": accident.check.margin for number, accident in enumerate(accidents)}
    return make_report(
        accidents,
        dropped=(Skipped(scenario="far", reason="far: the outlines are 2.00 m apart"),),
        skipped=(Skipped(scenario="bare", reason="bare has no labels"),),
        margins={**margins, "far": 2.0},
    )


def test_groups(accidents: list[Avoidability]) -> None:
    groups = [group_of(accident) for accident in accidents]
    assert groups == [
        "vehicles",
        "vehicles",
        "head-on",
        "pedestrians",
    ]
    assert [(share.group, share.warned) for share in outcome_shares(accidents)] == [
        ("vehicles", "first"),
        ("vehicles", "second"),
        ("vehicles", "both"),
        ("vehicles", "ego"),
        ("head-on", "first"),
        ("head-on", "second"),
        ("head-on", "both"),
        ("head-on", "ego"),
        ("pedestrians", "first"),
        ("pedestrians", "second"),
        ("pedestrians", "both"),  # the ego is not in it
    ]
    assert outcome_shares([]) == []


def test_shares_are_means_of_the_accidents_that_are_long_enough(
    accidents: list[Avoidability],
) -> None:
    first, second = (accident.outcomes[0] for accident in accidents[:2])
    shares = outcome_shares(accidents)[0]
    assert shares.leads == pytest.approx(np.arange(51) / 10)
    assert shares.accidents.tolist() == [2] * 31 + [1] * 20
    np.testing.assert_allclose(shares.shares.sum(axis=2), 1)

    both = np.mean(
        [first.outcome[:31] == AVOIDED, second.outcome[:31] == AVOIDED],
        axis=0,
    )
    longer = first.outcome[31:] == AVOIDED
    np.testing.assert_allclose(shares.shares[..., AVOIDED], [*both, *longer])

    extrapolated = np.mean(
        [first.extrapolated[:31], second.extrapolated[:31]],
        axis=0,
    )
    np.testing.assert_allclose(shares.extrapolated[:31], extrapolated)
    assert shares.relative_speed[0] == pytest.approx(7)  # 10 and 4 m/s

    # delta-v of the lighter car in the first accident, of either car in the second
    ranges = [
        delta_v_ranges([1000, 3000], 10.0)[0],
        delta_v_ranges([1500, 1500], 4.0)[0],
    ]
    expected_delta_v = ((7.5 + 2) / 2, *np.mean(ranges, axis=0))
    assert shares.delta_v[0, 0] == pytest.approx(expected_delta_v)


def test_the_ego_is_warned_where_it_is_of_the_pair(accidents: list[Avoidability]) -> None:
    first, second, _, ego = outcome_shares(accidents)[:4]
    np.testing.assert_array_equal(ego.shares, first.shares)
    assert not np.array_equal(first.shares, second.shares)

    ego_second = replace(accidents[0].accident, agents=(None, "ego_vehicle"))
    mixed = outcome_shares([accidents[0], replace(accidents[0], accident=ego_second)])
    np.testing.assert_allclose(mixed[3].shares, (mixed[0].shares + mixed[1].shares) / 2)


def test_text(report: AvoidabilityReport) -> None:
    text = report.to_text()
    assert not missing_parts(
        text, "far: the outlines are 2.00 m apart", "bare has no labels", "2.000 m, far"
    )

    _, _, first, _, _, second, *_ = text.split("\n\n")[1].splitlines()
    first_slack, second_slack = sorted(accident.slack[0, 0] for accident in report.accidents[:2])
    moments = " ".join(
        f"{first_slack + reaction:.2f} / {second_slack + reaction:.2f}"
        for reaction in (0.5, 1, 1.5)
    )
    assert first.split() == f"first 4 2 0 {moments}".split()
    assert second.split() == ["second", "4", "0", "0", *["–", "/", "–"] * 3]


def test_contacts_with_others_before_the_end_and_after_it(accidents: list[Avoidability]) -> None:
    contacts = tuple(
        SecondaryContact(
            replay=replay,
            time=time,
            extrapolated=time > 5,
            actor_id=11,
            other_id=30,
            category="car",
        )
        for replay, time in ((0, 4.5), (0, 4.7), (1, 5.5))
    )
    report = make_report([replace(accidents[0], secondary=contacts)])
    last_moments = report.to_dict()["accidents"][0]["last_moments"]
    counts = [len(moment["secondary"]) for moment in last_moments]
    assert counts == [2, 1, 0, 0, 0, 0, 0, 0, 0]


def test_files(report: AvoidabilityReport, tmp_path: Path) -> None:
    paths = report.to_csv(tmp_path / "out")
    tables = {}
    for path in paths:
        lines = path.read_text(encoding="utf-8").splitlines()
        tables[path.stem.removeprefix("avoidability_")] = list(csv.DictReader(lines))

    assert {name: len(rows) for name, rows in tables.items()} == {
        "last_moments": 4 * 9,
        "secondary_contacts": 0,
        "outcome_shares": 9 * (4 * 51 + 4 * 41 + 3 * 21),
        "self_check": 4,
        "left_out": 2,
    }
    low, high = (f"{value:.4g}" for value in delta_v_ranges([1000, 3000], 10.0)[0])
    for name, expected in {
        "last_moments": {
            "brakers": "first",
            "deceleration": "4.0",
            "slack": f"{report.accidents[0].slack[0, 0]:g}",
        },
        "self_check": {
            "delta_v_first": "7.5",
            "delta_v_first_least": low,
            "delta_v_first_most": high,
        },
        "outcome_shares": {
            "lead": "0.0",
            "accidents": "2",
            "relative_speed": "7.0",
            "unchanged": "1.0",
        },
        "left_out": {"why": "dropped", "scenario": "far", "margin": "2.0"},
    }.items():
        assert tables[name][0].items() >= expected.items()
    assert_raises(
        (lambda: report.to_csv(paths[0]), ConfigError, ("is a file", "give a folder")),
    )


def test_an_accident_whose_end_is_too_far_apart_is_dropped(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outcomes, "MAX_END_GAP_M", -1.0)
    report = avoidability_report(da_motion, workers=1)

    assert [dropped.scenario for dropped in report.dropped] == [
        scenario["token"] for scenario in da_motion.find(collision=True)
    ]


def test_an_unknown_scenario_is_refused(da_b: DeepAccident) -> None:
    assert_raises(
        (lambda: avoidability_report(da_b, ["nowhere"]), TokenError, ("nowhere",)),
    )
