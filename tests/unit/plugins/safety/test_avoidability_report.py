"""Avoidability over many accidents: shares, text, CSV, JSON; what is dropped and skipped is
named.
"""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused
from replayed_accidents import head_on, rear_end
from wording import lacking

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


def report_of(accidents: Sequence[Avoidability], **more: Any) -> AvoidabilityReport:
    told = {
        "dataroot": "/data",
        "version": "v1",
        "dropped": (),
        "skipped": (),
        "margins": {},
        **more,
    }
    return AvoidabilityReport(accidents=tuple(accidents), **told)


AVOIDED = OUTCOMES.index("avoided")


@pytest.fixture(scope="module")
def accidents() -> list[Avoidability]:
    """Two rear-ends of 5 and 3 s, in which the ego is the striker; a head-on one; one with a
    pedestrian.
    """
    walking = replace(rear_end(8, 1, 2), categories=("car", "pedestrian"), agents=(None, None))
    heavy = replace(rear_end(20, 10), masses=np.array([1000.0, 3000.0]))
    return [avoidability_of(each) for each in (heavy, rear_end(20, 16, 3), head_on(10, 4), walking)]


@pytest.fixture(scope="module")
def report(accidents: list[Avoidability]) -> AvoidabilityReport:
    return report_of(
        accidents,
        dropped=(Skipped(scenario="far", reason="far: the outlines are 2.00 m apart"),),
        skipped=(Skipped(scenario="bare", reason="bare has no labels"),),
        margins={f"s{number}": each.check.margin for number, each in enumerate(accidents)}
        | {"far": 2.0},
    )


def test_groups(accidents: list[Avoidability]) -> None:
    assert [group_of(each) for each in accidents] == [
        "vehicles",
        "vehicles",
        "head-on",
        "pedestrians",
    ]
    assert [(each.group, each.warned) for each in outcome_shares(accidents)] == [
        *(
            (group, warned)
            for group in ("vehicles", "head-on")
            for warned in ("first", "second", "both", "ego")
        ),
        *(
            ("pedestrians", warned) for warned in ("first", "second", "both")
        ),  # the ego is not in it
    ]
    assert outcome_shares([]) == []


def test_shares_are_means_of_the_accidents_that_are_long_enough(
    accidents: list[Avoidability],
) -> None:
    shares, (first, second) = (
        outcome_shares(accidents)[0],
        (each.outcomes[0] for each in accidents[:2]),
    )
    assert (shares.leads, shares.accidents.tolist()) == (
        pytest.approx(np.arange(51) / 10),
        [2] * 31 + [1] * 20,
    )
    np.testing.assert_allclose(shares.shares.sum(axis=2), 1)
    both = np.mean([each.outcome[:31] == AVOIDED for each in (first, second)], axis=0)
    np.testing.assert_allclose(
        shares.shares[..., AVOIDED], [*both, *(first.outcome[31:] == AVOIDED)]
    )
    extrapolated = np.mean([first.extrapolated[:31], second.extrapolated[:31]], axis=0)
    np.testing.assert_allclose(shares.extrapolated[:31], extrapolated)
    assert shares.relative_speed[0] == pytest.approx(7)  # 10 and 4 m/s
    ranges = delta_v_ranges([1000, 3000], 10.0)[0], delta_v_ranges([1500, 1500], 4.0)[0]
    # of the lighter one, and of either
    assert shares.delta_v[0, 0] == pytest.approx(((7.5 + 2) / 2, *np.mean(ranges, axis=0)))


def test_the_ego_is_warned_where_it_is_of_the_pair(accidents: list[Avoidability]) -> None:
    first, second, _, ego = outcome_shares(accidents)[:4]
    np.testing.assert_array_equal(ego.shares, first.shares)
    other = replace(accidents[0].accident, agents=(None, "ego_vehicle"))
    mixed = outcome_shares([accidents[0], replace(accidents[0], accident=other)])
    np.testing.assert_allclose(mixed[3].shares, (mixed[0].shares + mixed[1].shares) / 2)
    assert not np.array_equal(first.shares, second.shares)


def test_text(report: AvoidabilityReport) -> None:
    text = report.to_text()
    assert not lacking(
        text, "far: the outlines are 2.00 m apart", "bare has no labels", "2.000 m, far"
    )
    _, _, first, _, _, second, *_ = text.split("\n\n")[1].splitlines()
    half, most = sorted(each.slack[0, 0] for each in report.accidents[:2])
    needed = " ".join(
        f"{half + reaction:.2f} / {most + reaction:.2f}" for reaction in (0.5, 1, 1.5)
    )
    assert first.split() == f"first 4 2 0 {needed}".split()
    assert second.split() == ["second", "4", "0", "0", *["–", "/", "–"] * 3]


def test_contacts_with_others_before_the_end_and_after_it(accidents: list[Avoidability]) -> None:
    told = {"actor_id": 11, "other_id": 30, "category": "car"}
    contacts = tuple(
        SecondaryContact(replay=replay, time=time, extrapolated=time > 5, **told)
        for replay, time in ((0, 4.5), (0, 4.7), (1, 5.5))
    )
    alone = report_of([replace(accidents[0], secondary=contacts)])
    rows = [row["secondary"] for row in alone.to_dict()["accidents"][0]["last_moments"]]
    assert [len(each) for each in rows] == [2, 1, 0, 0, 0, 0, 0, 0, 0]


def test_files(report: AvoidabilityReport, tmp_path: Path) -> None:
    paths = report.to_csv(tmp_path / "out")
    lines = {
        path.stem.removeprefix("avoidability_"): path.read_text(encoding="utf-8").splitlines()
        for path in paths
    }
    tables = {name: list(csv.DictReader(each)) for name, each in lines.items()}
    assert {name: len(rows) for name, rows in tables.items()} == {
        "last_moments": 4 * 9,
        "secondary_contacts": 0,
        "outcome_shares": 9 * (4 * 51 + 4 * 41 + 3 * 21),
        "self_check": 4,
        "left_out": 2,
    }
    least, most = (f"{value:.4g}" for value in delta_v_ranges([1000, 3000], 10.0)[0])
    for name, expected in {
        "last_moments": {
            "brakers": "first",
            "deceleration": "4.0",
            "slack": f"{report.accidents[0].slack[0, 0]:g}",
        },
        "self_check": {
            "delta_v_first": "7.5",
            "delta_v_first_least": least,
            "delta_v_first_most": most,
        },
        "outcome_shares": {
            "lead": "0.0",
            "accidents": "2",
            "relative_speed": "7.0",
            "unchanged": "1.0",
        },
        "left_out": {"why": "dropped", "scenario": "far", "margin": "2.0"},
    }.items():
        assert {column: tables[name][0][column] for column in expected} == expected
    assert_refused((lambda: report.to_csv(paths[0]), ConfigError, ("is a file", "give a folder")))


def test_an_accident_whose_end_is_too_far_apart_is_dropped(
    da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outcomes, "MOST_MARGIN", -1.0)
    report = avoidability_report(da_motion, workers=1)
    assert [each.scenario for each in report.dropped] == [
        each["token"] for each in da_motion.find(collision=True)
    ]


def test_an_unknown_scenario_is_refused(da_b: DeepAccident) -> None:
    assert_refused((lambda: avoidability_report(da_b, ["nowhere"]), TokenError, ("nowhere",)))
