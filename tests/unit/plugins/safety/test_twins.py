import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.collisions import TornTwins, torn_twins
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.plugins.safety import (
    Parting,
    TwinDiff,
    safety_report,
    twin_diff,
    twin_report,
)


def test_torn_twins_are_those_of_two_splits(da_b: DeepAccident) -> None:
    splits = {
        "type1_subtype1_accident/Town01_a": "train",
        "type1_subtype1_normal/Town01_a": "val",
        "type1_subtype2_normal/Town01_a": "test",
        "type1_subtype2_accident/Town01_a": "test",
        "type1_subtype2_accident/Town01_b": "train",
        "type1_subtype2_normal/Town01_b": None,
        "type1_subtype1_accident/Town01_c": "val",
        "type1_subtype1_normal/a": "train",
        "type2_subtype1_accident/a": "val",
        "type2_subtype1_odd/a": "val",
    }
    scenarios = ("type1_subtype1_accident/Town01_a", "type1_subtype1_normal/Town01_a")
    assert torn_twins(splits) == (TornTwins(scenarios=scenarios, splits=("train", "val")),)
    assert torn_twins({}) == ()

    released_splits = {record["token"]: record["split"] for record in da_b.scenario}
    assert torn_twins(released_splits) == ()
    torn_splits = {record["token"]: str(record["designed_accident"]) for record in da_b.scenario}
    assert len(torn_twins(torn_splits)) == len(da_b.scenario) // 2


TOKENS = {"accident": "type1_subtype1_accident/a", "twin": "type1_subtype1_normal/a"}


def make_diff(**changes: object) -> TwinDiff:
    """Make the diff of an ego that brakes in the twin from frame 4 on, another car that does not,
    and a pedestrian that the twin lacks.
    """
    poses = np.zeros((2, 3, 6, 3))
    poses[:, 0, :, 0] = np.arange(6)
    poses[1, 0, 3:, 0] = [2.5, 2.75, 3.0]
    poses[:, 1, :, 0] = 9 - np.arange(6) / 2
    poses[:, 1, :, 2] = math.pi
    poses[1, 2] = np.nan
    poses[0, :, 5:] = np.nan  # it ends in the impact
    fields = {
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

    return TwinDiff(**{**fields, **changes})  # type: ignore[arg-type]


def reopen_release(root: Path) -> DeepAccident:
    shutil.rmtree(root / ".deepaccident", ignore_errors=True)
    return DeepAccident("v1", root, verbose=False)


def test_when_who_and_how_far() -> None:
    diff = make_diff()
    assert diff.distances[0].tolist()[:5] == [0, 0, 0, 0.5, 1.25]
    assert (diff.parting_frames.tolist(), diff.parting_frame) == ([5, 0, 0], 5)
    assert diff.in_both.tolist() == [True, True, False]
    frames = {
        distance: replace(diff, parting=Parting(distance=distance)).parting_frame
        for distance in (0.49, 0.5, 9.0)
    }
    assert frames == {0.49: 4, 0.5: 5, 9.0: None}

    summary = diff.to_dict()
    assert (summary["parting_time"], summary["time_to_impact"]) == (0.4, 0.0)
    ego, car, pedestrian = summary["actors"]
    expected_ego: dict[str, object] = {
        "actor_id": 5,
        "twin_id": 15,
        "agent": "ego_vehicle",
        "parting_frame": 5,
        "largest_distance": 1.25,
        "position_at_parting": [4, 0],
        "twin_position_at_parting": [2.75, 0],
        "largest_speed_difference": -2,
    }
    for name, value in expected_ego.items():
        assert ego[name] == value
    assert (car["parting_frame"], car["largest_distance"]) == (None, 0)
    assert (pedestrian["twin_id"], pedestrian["largest_distance"]) == (None, None)
    assert pedestrian["collides"] is False


def test_a_diff_says_whether_the_twins_begin_together() -> None:
    diff = make_diff()
    poses = diff.poses.copy()
    poses[1, 0, :, 0] += 0.8
    apart = replace(diff, poses=poses)
    assert diff.begins_together is True
    assert apart.begins_together is False
    assert apart.to_dict()["begins_together"] is False

    poses[1, 0] = np.nan
    assert replace(diff, poses=poses).begins_together, "no agent shows whether they do"


def test_turns_count_the_shorter_way_and_keep_their_sign() -> None:
    poses = make_diff().poses.copy()
    poses[1, 1, 2:, 2] = -math.pi + 0.08
    poses[1, 0, 1:3, 2] = [0.05, -0.09]
    diff = make_diff(poses=poses)
    assert diff.heading_differences[1, 3] == pytest.approx(0.08)
    assert diff.parting_frames[1] == 0
    ego = diff.to_dict()["actors"][0]
    assert ego["largest_heading_difference"] == pytest.approx(-0.09)

    sensitive = replace(diff, parting=Parting(distance=5.0, heading=0.07))
    assert sensitive.parting_frames.tolist() == [3, 3, 0]


def test_the_pairs_least_gap_in_the_twin() -> None:
    diff = make_diff()
    assert diff.gaps[0].tolist() == pytest.approx([7, 5.5, 4, 2.5, 1, math.nan], nan_ok=True)
    assert diff.nearest_in_twin == pytest.approx((6, 1.5))
    assert make_diff(shift=2).nearest_in_twin == pytest.approx((8, 1.5))
    assert make_diff(pair=(0, 2)).nearest_in_twin is None
    assert diff.to_dict()["gap_at_impact"] == pytest.approx(1)


def test_limits_are_checked() -> None:
    assert_raises(
        (lambda: Parting(distance=0), ConfigError, "distance: expected a number above 0, found 0"),
        (
            lambda: Parting(heading=math.nan),
            ConfigError,
            "heading: expected a number above 0, found nan",
        ),
    )


def test_an_accident_and_its_twin(da_motion: DeepAccident) -> None:
    accident, normal = (da_motion.find(collision=collides)[0] for collides in (True, False))
    diff = twin_diff(da_motion, accident)
    assert (diff.accident, diff.twin) == (accident["token"], normal["token"])
    assert twin_diff(da_motion, normal["token"]).to_dict() == diff.to_dict()
    assert diff.num_frames == (accident["num_frames"], normal["num_frames"])

    collision = accident["collision"]
    rows = list(diff.pair)
    assert diff.actor_ids[rows, 0].tolist() == list(collision["ids"])
    assert [diff.agents[row] for row in rows] == list(collision["agents"])

    gap = diff.gaps[0, accident["num_frames"] - 1]
    assert gap == pytest.approx(da_motion.collision(accident).gap, abs=1e-6)
    assert diff.nearest_in_twin.gap > gap

    for row in np.flatnonzero(diff.parting_frames).tolist():
        frame = diff.parting_frames[row]
        for side, (token, number) in enumerate(
            ((diff.accident, frame), (diff.twin, frame + diff.shift))
        ):
            path = da_motion.trajectory(f"{token}/actor/{diff.actor_ids[row, side]}")
            center = path.center[path.index == number][0, :2]
            np.testing.assert_allclose(center, diff.poses[side, row, frame - 1, :2])
    assert json.loads(json.dumps(diff.to_dict(), allow_nan=False)) == diff.to_dict()


def test_what_is_missing_is_said_and_counted(own_release: Path) -> None:
    """A twin without labels and calib does not count as one; a twin without only its labels cannot
    be compared.
    """
    first, second, third = reopen_release(own_release).find(collision=True)
    for scenario, kinds in ((first, ("label", "calib")), (second, ("label",))):
        twin_type = scenario["scenario_type"].replace("accident", "normal")
        twin = own_release / scenario["folder"] / twin_type
        for kind in kinds:
            for folder in twin.glob(f"*/{kind}/{scenario['name']}"):
                shutil.rmtree(folder)
    da = reopen_release(own_release)

    assert_raises(
        (lambda: twin_diff(da, first["token"]), NotAvailableError, ("no twin of it",)),
        (lambda: twin_diff(da, second["token"]), NotAvailableError, ("has no labels",)),
    )
    report = twin_report(da)
    assert [diff.accident for diff in report.diffs] == [third["token"]]
    assert [skipped.scenario for skipped in report.skipped] == [first["token"], second["token"]]
    assert second["name"] in report.to_text()


def test_two_normal_scenarios_are_nothing_to_compare(own_release: Path) -> None:
    accident = reopen_release(own_release).find(collision=True)[0]
    folder = own_release / accident["folder"] / accident["scenario_type"]
    meta = folder / "meta" / f"{accident['name']}.txt"
    meta.write_bytes(Path(str(meta).replace("_accident", "_normal")).read_bytes())

    da = reopen_release(own_release)
    assert_raises(
        (
            lambda: twin_diff(da, accident["token"]),
            NotAvailableError,
            ("nor its twin", "an accident"),
        )
    )


def test_the_command(da_motion: DeepAccident, tmp_path: Path) -> None:
    normal = da_motion.find(collision=False)[0]["token"]

    def run_twins(*arguments: str) -> Result:
        command = ["safety", "twins", str(da_motion.dataroot), *arguments]
        return CliRunner().invoke(deepaccident, command)

    assert run_twins().exit_code == 0
    assert run_twins("--where", "collision=true", "--out", str(tmp_path)).exit_code == 0
    assert run_twins(normal).exit_code == 2

    names = {"twins.csv", "twin_actors.csv", "torn_twins.csv", "skipped.csv", "twins.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    diff = twin_diff(da_motion, normal)
    payload = json.loads((tmp_path / "twins.json").read_text(encoding="utf-8"))
    assert payload["twins"] == [diff.to_dict()]
    rows = (tmp_path / "twin_actors.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 1 + len(diff.categories)


def test_a_report_says_which_recordings_it_covers(
    da_motion: DeepAccident, da_b: DeepAccident
) -> None:
    report = twin_report(da_motion, [])
    again = twin_report(da_motion, [])
    other = twin_report(da_b, [])
    assert report.fingerprint == again.fingerprint != other.fingerprint

    assert report.to_dict()["fingerprint"] == report.fingerprint
    summary = safety_report(da_motion, []).to_dict()
    assert summary["fingerprint"] == report.fingerprint
