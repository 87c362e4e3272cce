"""Avoidability over many accidents: shares, text, CSV, JSON; what is dropped and skipped is named."""

import csv
import importlib
import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from replayed_accidents import head_on, rear_end

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.accidents.outcomes import delta_v_ranges
from deepaccident_devkit.errors import ConfigError, TokenError
from deepaccident_devkit.safety import (
    OUTCOMES,
    Avoidability,
    AvoidabilityReport,
    Skipped,
    avoidability_of,
    avoidability_report,
    outcome_shares,
)
from deepaccident_devkit.safety.avoidability import SecondaryContact
from deepaccident_devkit.safety.avoidability_report import group_of

AVOIDED = OUTCOMES.index("avoided")


@pytest.fixture(scope="module")
def accidents() -> list[Avoidability]:
    """Two rear-ends of 5 and 3 s, in which the ego is the striker; a head-on one; one with a pedestrian."""
    walking = replace(rear_end(8, 1, 2), categories=("car", "pedestrian"), agents=(None, None))
    heavy = replace(rear_end(20, 10), masses=np.array([1000.0, 3000.0]))
    return [avoidability_of(each) for each in (heavy, rear_end(20, 16, 3), head_on(10, 4), walking)]


@pytest.fixture(scope="module")
def report(accidents: list[Avoidability]) -> AvoidabilityReport:
    gone = Skipped(scenario="far", reason="far: the outlines are 2.00 m apart")
    return AvoidabilityReport(
        dataroot="/data",
        version="v1",
        accidents=tuple(accidents),
        dropped=(gone,),
        skipped=(Skipped(scenario="bare", reason="bare has no labels"),),
        margins={f"s{number}": each.check.margin for number, each in enumerate(accidents)} | {"far": 2.0},
    )


def test_groups(accidents: list[Avoidability]) -> None:
    assert [group_of(each) for each in accidents] == ["vehicles", "vehicles", "head-on", "pedestrians"]
    assert [(each.group, each.warned) for each in outcome_shares(accidents)] == [
        *((group, warned) for group in ("vehicles", "head-on") for warned in ("first", "second", "both", "ego")),
        *(("pedestrians", warned) for warned in ("first", "second", "both")),  # the ego is not in it
    ]
    assert outcome_shares([]) == []


def test_shares_are_means_of_the_accidents_that_are_long_enough(accidents: list[Avoidability]) -> None:
    shares = outcome_shares(accidents)[0]
    first, second = accidents[:2]
    assert shares.leads == pytest.approx(np.arange(51) / 10)
    assert shares.accidents.tolist() == [2] * 31 + [1] * 20
    np.testing.assert_allclose(shares.shares.sum(axis=2), 1)
    both = [each.outcomes[0].outcome[:31] == AVOIDED for each in (first, second)]
    np.testing.assert_allclose(shares.shares[:31, :, AVOIDED], np.mean(both, axis=0))
    np.testing.assert_allclose(shares.shares[31:, :, AVOIDED], first.outcomes[0].outcome[31:] == AVOIDED)
    assert shares.relative_speed[0] == pytest.approx(7)  # 10 and 4 m/s
    assert shares.delta_v[0, 0, 0] == pytest.approx((7.5 + 2) / 2)  # of the lighter one, and of either
    ranges = delta_v_ranges([1000, 3000], 10.0)[0], delta_v_ranges([1500, 1500], 4.0)[0]
    assert shares.delta_v[0, 0, 1:] == pytest.approx(np.mean(ranges, axis=0))
    extrapolated = [each.outcomes[0].extrapolated[:31] for each in (first, second)]
    np.testing.assert_allclose(shares.extrapolated[:31], np.mean(extrapolated, axis=0))


def test_the_ego_is_warned_where_it_is_of_the_pair(accidents: list[Avoidability]) -> None:
    first, second, _, ego = outcome_shares(accidents)[:4]
    np.testing.assert_array_equal(ego.shares, first.shares)
    other = replace(accidents[0].accident, agents=(None, "ego_vehicle"))
    mixed = outcome_shares([accidents[0], replace(accidents[0], accident=other)])
    np.testing.assert_allclose(mixed[3].shares, (mixed[0].shares + mixed[1].shares) / 2)
    assert not np.array_equal(first.shares, second.shares)


def test_text(report: AvoidabilityReport) -> None:
    text = report.to_text()
    assert "4 accidents; 1 dropped, as the two are too far apart at the end; 1 skipped" in text
    assert "\n  far: the outlines are 2.00 m apart" in text
    assert "\n  bare has no labels" in text
    assert "1 m or more: 1" in text
    assert "the largest: 2.000 m, far" in text
    block = text.split("\n\n")[1].splitlines()
    assert block[0] == "vehicles: 2 accidents; seconds of warning that 50% and 90% of them need"
    half, most = sorted(each.slack[0, 0] for each in report.accidents[:2])
    needed = " ".join(f"{half + reaction:.2f} / {most + reaction:.2f}" for reaction in (0.5, 1, 1.5))
    assert block[2].split() == f"first 4 2 0 {needed}".split()
    assert block[5].split() == ["second", "4", "0", "0", *["–", "/", "–"] * 3]


def test_head_on_answers_of_the_continuation_are_counted(report: AvoidabilityReport) -> None:
    alone = AvoidabilityReport(
        dataroot="", version="v1", accidents=report.accidents[2:3], dropped=(), skipped=(), margins={}
    )
    line = next(line for line in alone.to_text().splitlines() if line.startswith("first"))
    count = int(report.accidents[2].last_moments.extrapolated[0])
    assert line.split()[:4] == ["first", "4", str(1 - count), str(count)]


def test_contacts_with_others_before_the_end_and_after_it(accidents: list[Avoidability]) -> None:
    told = {"actor_id": 11, "other_id": 30, "category": "car"}
    contacts = (
        SecondaryContact(replay=0, time=4.5, extrapolated=False, **told),
        SecondaryContact(replay=0, time=4.7, extrapolated=False, **told),
        SecondaryContact(replay=1, time=5.5, extrapolated=True, **told),
    )
    crowded = replace(accidents[0], secondary=contacts)
    alone = AvoidabilityReport(dataroot="", version="v1", accidents=(crowded,), dropped=(), skipped=(), margins={})
    assert "touched in 1 of 6 replays" in alone.to_text()
    assert "in 2 if all go straight on for 3 s" in alone.to_text()
    rows = [row["secondary"] for row in alone.to_dict()["accidents"][0]["last_moments"]]
    assert [len(each) for each in rows] == [2, 1, 0, 0, 0, 0, 0, 0, 0]


def test_an_empty_report() -> None:
    empty = AvoidabilityReport(dataroot="/data", version="v1", accidents=(), dropped=(), skipped=(), margins={})
    assert empty.to_text() == "DeepAccident v1 at /data\n0 accidents"
    assert json.loads(empty.to_json())["accidents"] == []
    assert empty.shares == []


def test_files(report: AvoidabilityReport, tmp_path: Path) -> None:
    paths = report.to_csv(tmp_path / "out")
    tables = {
        path.stem.removeprefix("avoidability_"): list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        for path in paths
    }
    assert {name: len(rows) for name, rows in tables.items()} == {
        "last_moments": 4 * 9,
        "secondary_contacts": 0,
        "outcome_shares": 9 * (4 * 51 + 4 * 41 + 3 * 21),
        "self_check": 4,
        "left_out": 2,
    }
    first = tables["last_moments"][0]
    slack = f"{report.accidents[0].slack[0, 0]:g}"
    assert (first["brakers"], first["deceleration"], first["slack"]) == ("first", "4.0", slack)
    assert tables["self_check"][0]["delta_v_first"] == "7.5"
    least, most = (float(tables["self_check"][0][f"delta_v_first_{end}"]) for end in ("least", "most"))
    assert (least, most) == pytest.approx(tuple(delta_v_ranges([1000, 3000], 10.0)[0]), abs=5e-4)
    share = tables["outcome_shares"][0]
    assert (share["lead"], share["accidents"], share["relative_speed"]) == ("0.0", "2", "7.0")
    assert share["unchanged"] == "1.0"
    assert [(row["why"], row["scenario"], row["margin"]) for row in tables["left_out"]] == [
        ("dropped", "far", "2.0"),
        ("skipped", "bare", ""),
    ]
    with pytest.raises(ConfigError, match="is a file; give a folder"):
        report.to_csv(paths[0])


def test_json_and_pickle(report: AvoidabilityReport) -> None:
    told = json.loads(report.to_json())
    assert set(told["dropped"]) == {"far"}
    assert set(told["skipped"]) == {"bare"}
    assert told["margins"]["far"] == 2
    assert [each["group"] for each in told["accidents"]] == ["vehicles", "vehicles", "head-on", "pedestrians"]
    assert pickle.loads(pickle.dumps(report)).to_text() == report.to_text()


def test_of_a_release(own_release: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One scenario has no meta file; of another the gap at the end is made too large; the rest is replayed."""
    scenarios = DeepAccident("v1", own_release, verbose=False).find(collision=True)
    bare, far = scenarios[0], scenarios[1]["token"]
    (own_release / bare["folder"] / bare["scenario_type"] / "meta" / f"{bare['name']}.txt").unlink()
    shutil.rmtree(own_release / ".deepaccident")
    dataset = DeepAccident("v1", own_release, verbose=False)
    module = importlib.import_module("deepaccident_devkit.safety.avoidability_report")
    real = module.accident_of

    def moved_apart(dataset: DeepAccident, scenario: str) -> object:
        accident = real(dataset, scenario)
        if accident is None or accident.scenario != far:
            return accident
        paths = accident.paths.copy()
        paths[1, :, :2] += 500.0
        return replace(accident, paths=paths)

    monkeypatch.setattr(module, "accident_of", moved_apart)
    report = avoidability_report(dataset, workers=1)
    assert [each.scenario for each in report.skipped] == [bare["token"]]
    assert [each.scenario for each in report.dropped] == [far]
    assert report.margins[far] > 400
    assert [each.accident.scenario for each in report.accidents] == [each["token"] for each in scenarios[2:]]
    assert set(report.margins) == {far, *(each["token"] for each in scenarios[2:])}
    one = avoidability_report(dataset, [scenarios[2]], workers=1)
    assert [each.accident.scenario for each in one.accidents] == [scenarios[2]["token"]]
    with pytest.raises(TokenError, match="nowhere"):
        avoidability_report(dataset, ["nowhere"])
