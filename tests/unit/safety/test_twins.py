import csv
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.safety import (
    Parting,
    TornTwins,
    TwinDiff,
    TwinReport,
    torn_twins,
    twin_diff,
    twin_of,
    twin_report,
)


def test_twins_have_the_same_name_and_subtype(da_b: DeepAccident) -> None:
    for scenario in da_b.scenario:
        twin = twin_of(da_b, scenario)
        assert twin is not None
        assert twin["name"] == scenario["name"]
        assert twin["signalized"] == scenario["signalized"]
        assert twin["designed_accident"] != scenario["designed_accident"]
        assert twin_of(da_b, twin["token"]) == scenario


def test_a_scenario_may_have_no_twin(own_release: Path) -> None:
    for folder in own_release.glob("*/type1_subtype1_normal"):
        shutil.rmtree(folder)
    da = DeepAccident("v1", own_release, verbose=False)
    alone = da.find(signalized=True)
    assert alone
    assert all(twin_of(da, scenario) is None for scenario in alone)


def test_torn_twins_are_those_of_two_splits() -> None:
    splits = {
        "type1_subtype1_accident/Town01_a": "train",
        "type1_subtype1_normal/Town01_a": "val",
        "type1_subtype2_normal/Town01_a": "test",
        "type1_subtype2_accident/Town01_a": "test",
        "type1_subtype2_accident/Town01_b": "train",
        "type1_subtype2_normal/Town01_b": None,
        "type1_subtype1_accident/Town01_c": "val",
    }
    torn = TornTwins(
        scenarios=("type1_subtype1_accident/Town01_a", "type1_subtype1_normal/Town01_a"), splits=("train", "val")
    )
    assert torn_twins(splits) == (torn,)
    assert torn_twins({}) == ()


def test_the_synthetic_splits_keep_twins_together(da_b: DeepAccident) -> None:
    assert torn_twins({record["token"]: record["split"] for record in da_b.scenario}) == ()
    apart = {record["token"]: str(record["designed_accident"]) for record in da_b.scenario}
    assert len(torn_twins(apart)) == len(da_b.scenario) // 2


@pytest.mark.parametrize("kind", ["accident", "odd"])
def test_other_types_are_no_twins(kind: str) -> None:
    torn = torn_twins({"type1_subtype1_normal/a": "train", f"type2_subtype1_{kind}/a": "val"})
    assert torn == ()


TOKENS = {"accident": "type1_subtype1_accident/a", "twin": "type1_subtype1_normal/a"}


def made_diff(**changes: object) -> TwinDiff:
    """An ego that brakes in the twin from frame 4 on, another car that does not, and one that the twin lacks."""
    poses = np.zeros((2, 3, 6, 3))
    poses[:, 0, :, 0] = np.arange(6)
    poses[1, 0, 3:, 0] = [2.5, 2.75, 3.0]
    poses[:, 1, :, 0] = 9 - np.arange(6) / 2
    poses[:, 1, :, 2] = math.pi
    poses[1, 2] = np.nan
    poses[0, :, 5:] = np.nan  # it ends in the impact
    values = {
        **TOKENS,
        "parting": Parting(distance=0.75, heading=0.1),
        "actor_ids": np.array([[5, 15], [6, 16], [7, -1]]),
        "categories": ("car", "van", "pedestrian"),
        "agents": ("ego_vehicle", None, None),
        "matched_by": ("agent", "start", None),
        "num_frames": (5, 6),
        "shift": 0,
        "poses": poses,
        "speeds": np.stack([np.full((3, 6), 10.0), np.full((3, 6), 8.0)]),
        "sizes": np.ones((2, 3, 3)) * (2, 1, 1),
        "pair": (0, 1),
    }
    return TwinDiff(**{**values, **changes})  # type: ignore[arg-type]


def test_when_who_and_how_far() -> None:
    diff = made_diff()
    assert diff.distances[0].tolist()[:5] == [0, 0, 0, 0.5, 1.25]
    assert diff.parting_frames.tolist() == [5, 0, 0]
    assert diff.parting_frame == 5
    assert replace(diff, parting=Parting(distance=0.49)).parting_frame == 4
    assert replace(diff, parting=Parting(distance=0.5)).parting_frame == 5
    assert replace(diff, parting=Parting(distance=9.0)).parting_frame is None
    assert diff.in_both.tolist() == [True, True, False]
    told = diff.to_dict()
    assert (told["parting_time"], told["time_to_impact"]) == (0.4, 0.0)
    ego, van, walker = told["actors"]
    assert (ego["actor_id"], ego["twin_id"], ego["agent"], ego["parting_frame"]) == (5, 15, "ego_vehicle", 5)
    assert (ego["position_at_parting"], ego["twin_position_at_parting"]) == ([4, 0], [2.75, 0])
    assert (ego["largest_distance"], ego["largest_speed_difference"]) == (1.25, -2)
    assert (van["parting_frame"], van["largest_distance"]) == (None, 0)
    assert (walker["twin_id"], walker["largest_distance"], walker["collides"]) == (None, None, False)


def test_twins_that_do_not_begin_together_are_told() -> None:
    diff = made_diff()
    assert diff.begins_together
    poses = diff.poses.copy()
    poses[1, 0, :, 0] += 0.8
    apart = replace(diff, poses=poses)
    assert not apart.begins_together
    report = TwinReport(dataroot="", version="v1", diffs=(diff, apart), skipped=(), torn=())
    assert "1 of them: the recordings do not begin together" in report.to_text()
    assert apart.to_dict()["begins_together"] is False
    poses[1, 0] = np.nan
    assert replace(diff, poses=poses).begins_together, "no agent is there to tell"


def test_turns_count_the_shorter_way() -> None:
    poses = made_diff().poses.copy()
    poses[1, 1, 2:, 2] = -math.pi + 0.08
    diff = made_diff(poses=poses)
    assert diff.heading_differences[1, 3] == pytest.approx(0.08)
    assert diff.parting_frames[1] == 0
    assert replace(diff, parting=Parting(heading=0.07)).parting_frames[1] == 3
    assert diff.order.tolist() == [0, 1, 2]
    assert replace(diff, parting=Parting(distance=5.0, heading=0.07)).order.tolist() == [1, 0, 2]


def test_the_largest_difference_keeps_its_sign() -> None:
    poses = made_diff().poses.copy()
    poses[1, 0, 1:3, 2] = [0.05, -0.2]
    ego = made_diff(poses=poses).to_dict()["actors"][0]
    assert ego["largest_heading_difference"] == pytest.approx(-0.2)
    assert ego["parting_frame"] == 3


def test_the_pairs_least_gap_in_the_twin() -> None:
    diff = made_diff()
    assert diff.gaps[0].tolist()[:5] == pytest.approx([7, 5.5, 4, 2.5, 1])
    assert np.isnan(diff.gaps[0, 5])
    assert diff.nearest_in_twin == pytest.approx((6, 1.5))
    assert made_diff(shift=2).nearest_in_twin == pytest.approx((8, 1.5))
    assert made_diff(pair=(0, 2)).nearest_in_twin is None
    assert made_diff().to_dict()["gap_at_impact"] == pytest.approx(1)


def test_limits_are_checked() -> None:
    assert_refused(
        (lambda: Parting(distance=0), ConfigError, "distance: expected a number above 0, found 0"),
        (lambda: Parting(heading=math.nan), ConfigError, "heading: expected a number above 0, found nan"),
    )


def test_an_accident_and_its_twin(da_motion: DeepAccident) -> None:
    accident, normal = (da_motion.find(collision=ends)[0] for ends in (True, False))
    diff = twin_diff(da_motion, accident)
    assert (diff.accident, diff.twin) == (accident["token"], normal["token"])
    again = twin_diff(da_motion, normal["token"])
    assert again.to_dict() == diff.to_dict()
    assert diff.num_frames == (accident["num_frames"], normal["num_frames"])
    pair = [int(diff.actor_ids[row, 0]) for row in diff.pair]
    assert pair == accident["collision"]["ids"]
    assert [diff.agents[row] for row in diff.pair] == accident["collision"]["agents"]
    gap = diff.gaps[0, accident["num_frames"] - 1]
    assert gap == pytest.approx(da_motion.collision(accident).gap, abs=1e-6)
    assert diff.nearest_in_twin is not None
    assert diff.nearest_in_twin.gap > gap
    for row in np.flatnonzero(diff.parting_frames).tolist():
        frame = diff.parting_frames[row]
        places = [
            da_motion.trajectory(f"{token}/actor/{actor}")
            for token, actor in zip((diff.accident, diff.twin), diff.actor_ids[row].tolist(), strict=True)
        ]
        own = [
            each.center[each.index == number][0, :2]
            for each, number in zip(places, (frame, frame + diff.shift), strict=True)
        ]
        np.testing.assert_allclose(own, diff.poses[:, row, frame - 1, :2])
    assert json.loads(json.dumps(diff.to_dict(), allow_nan=False)) == diff.to_dict()


def test_what_is_missing_is_said_and_counted(own_release: Path) -> None:
    da = DeepAccident("v1", own_release, verbose=False)
    first, second, third = da.find(collision=True)
    twin = own_release / first["folder"] / first["scenario_type"].replace("accident", "normal")
    for kind in ("*/label", "*/calib"):
        for folder in twin.glob(f"{kind}/{first['name']}"):
            shutil.rmtree(folder)
    twin = own_release / second["folder"] / second["scenario_type"].replace("accident", "normal")
    for folder in twin.glob("*/label"):
        shutil.rmtree(folder / second["name"])
    shutil.rmtree(own_release / ".deepaccident")
    da = DeepAccident("v1", own_release, verbose=False)
    assert_refused(
        (lambda: twin_diff(da, first["token"]), NotAvailableError, "this release has no twin of it"),
        (lambda: twin_diff(da, second["token"]), NotAvailableError, "has no labels"),
    )
    report = twin_report(da)
    assert [each.accident for each in report.diffs] == [third["token"]]
    assert [each.scenario for each in report.skipped] == [first["token"], second["token"]]
    assert "skipped:" in report.to_text()


def test_two_normal_scenarios_are_nothing_to_compare(own_release: Path) -> None:
    da = DeepAccident("v1", own_release, verbose=False)
    accident = da.find(collision=True)[0]
    meta = own_release / accident["folder"] / accident["scenario_type"] / "meta" / f"{accident['name']}.txt"
    normal = Path(str(meta).replace("_accident", "_normal"))
    meta.write_bytes(normal.read_bytes())
    shutil.rmtree(own_release / ".deepaccident")
    da = DeepAccident("v1", own_release, verbose=False)
    with pytest.raises(NotAvailableError, match="neither it nor its twin ends in an accident"):
        twin_diff(da, accident["token"])


def test_the_command(da_motion: DeepAccident, tmp_path: Path) -> None:
    root, normal = str(da_motion.dataroot), da_motion.find(collision=False)[0]["token"]
    all_of_them = CliRunner().invoke(deepaccident, ["safety", "twins", root], catch_exceptions=False)
    assert all_of_them.exit_code == 0
    chosen = ["--where", "collision=true", "--out", str(tmp_path)]
    CliRunner().invoke(deepaccident, ["safety", "twins", root, *chosen], catch_exceptions=False)
    names = {"twins.csv", "twin_actors.csv", "torn_twins.csv", "skipped.csv", "twins.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    told = json.loads((tmp_path / "twins.json").read_text(encoding="utf-8"))
    diff = twin_diff(da_motion, normal)
    assert told["twins"] == [diff.to_dict()]
    with (tmp_path / "twin_actors.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(diff.categories)
    wrong = CliRunner().invoke(deepaccident, ["safety", "twins", root, normal])
    assert (wrong.exit_code, "SCENARIO changes nothing with twins" in wrong.output) == (2, True)


def test_a_report_of_several_lists_torn_twins(da_b: DeepAccident) -> None:
    report = twin_report(da_b)
    assert [each.accident for each in report.diffs] == [each["token"] for each in da_b.find(collision=True)]
    assert report.torn == ()
    assert "tears apart" not in report.to_text()
    token = report.diffs[0].accident
    line = next(each for each in report.to_text().splitlines() if each.startswith(token))
    assert f"{report.diffs[0].nearest_in_twin.gap:.2f}" in line
