import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from refusals import assert_refused

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
    assert (
        torn_twins({})
        == torn_twins({record["token"]: record["split"] for record in da_b.scenario})
        == ()
    )
    apart = {record["token"]: str(record["designed_accident"]) for record in da_b.scenario}
    assert len(torn_twins(apart)) == len(da_b.scenario) // 2


TOKENS = {"accident": "type1_subtype1_accident/a", "twin": "type1_subtype1_normal/a"}


def made_diff(**changes: object) -> TwinDiff:
    """An ego that brakes in the twin from frame 4 on, another car that does not, and one that the
    twin lacks.
    """
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


def reopened(root: Path) -> DeepAccident:
    shutil.rmtree(root / ".deepaccident", ignore_errors=True)
    return DeepAccident("v1", root, verbose=False)


def test_when_who_and_how_far() -> None:
    diff = made_diff()
    assert diff.distances[0].tolist()[:5] == [0, 0, 0, 0.5, 1.25]
    assert (diff.parting_frames.tolist(), diff.parting_frame) == ([5, 0, 0], 5)
    limits = {
        limit: replace(diff, parting=Parting(distance=limit)).parting_frame
        for limit in (0.49, 0.5, 9.0)
    }
    assert limits == {0.49: 4, 0.5: 5, 9.0: None}
    assert diff.in_both.tolist() == [True, True, False]
    told = diff.to_dict()
    assert (told["parting_time"], told["time_to_impact"]) == (0.4, 0.0)
    expected: tuple[dict[str, object], ...] = (
        {
            "actor_id": 5,
            "twin_id": 15,
            "agent": "ego_vehicle",
            "parting_frame": 5,
            "largest_distance": 1.25,
        }
        | {
            "position_at_parting": [4, 0],
            "twin_position_at_parting": [2.75, 0],
            "largest_speed_difference": -2,
        },
        {"parting_frame": None, "largest_distance": 0},
        {"twin_id": None, "largest_distance": None, "collides": False},
    )
    assert all(
        actor.items() >= values.items()
        for actor, values in zip(told["actors"], expected, strict=True)
    )


def test_twins_that_do_not_begin_together_are_told() -> None:
    diff = made_diff()
    poses = diff.poses.copy()
    poses[1, 0, :, 0] += 0.8
    apart = replace(diff, poses=poses)
    assert (diff.begins_together, apart.begins_together, apart.to_dict()["begins_together"]) == (
        True,
        False,
        False,
    )
    poses[1, 0] = np.nan
    assert replace(diff, poses=poses).begins_together, "no agent is there to tell"


def test_turns_count_the_shorter_way_and_keep_their_sign() -> None:
    poses = made_diff().poses.copy()
    poses[1, 1, 2:, 2] = -math.pi + 0.08
    poses[1, 0, 1:3, 2] = [0.05, -0.09]
    diff = made_diff(poses=poses)
    assert (diff.heading_differences[1, 3], diff.parting_frames[1]) == (pytest.approx(0.08), 0)
    assert diff.to_dict()["actors"][0]["largest_heading_difference"] == pytest.approx(-0.09)
    assert replace(diff, parting=Parting(distance=5.0, heading=0.07)).parting_frames.tolist() == [
        3,
        3,
        0,
    ]


def test_the_pairs_least_gap_in_the_twin() -> None:
    diff = made_diff()
    assert diff.gaps[0].tolist() == pytest.approx([7, 5.5, 4, 2.5, 1, math.nan], nan_ok=True)
    nearest = [each.nearest_in_twin for each in (diff, made_diff(shift=2), made_diff(pair=(0, 2)))]
    assert nearest == [pytest.approx((6, 1.5)), pytest.approx((8, 1.5)), None]
    assert made_diff().to_dict()["gap_at_impact"] == pytest.approx(1)


def test_limits_are_checked() -> None:
    assert_refused(
        (lambda: Parting(distance=0), ConfigError, "distance: expected a number above 0, found 0"),
        (
            lambda: Parting(heading=math.nan),
            ConfigError,
            "heading: expected a number above 0, found nan",
        ),
    )


def test_an_accident_and_its_twin(da_motion: DeepAccident) -> None:
    accident, normal = (da_motion.find(collision=ends)[0] for ends in (True, False))
    diff = twin_diff(da_motion, accident)
    assert (diff.accident, diff.twin) == (accident["token"], normal["token"])
    assert twin_diff(da_motion, normal["token"]).to_dict() == diff.to_dict()
    assert diff.num_frames == (accident["num_frames"], normal["num_frames"])
    pair = [(int(diff.actor_ids[row, 0]), diff.agents[row]) for row in diff.pair]
    assert pair == [
        *zip(accident["collision"]["ids"], accident["collision"]["agents"], strict=True)
    ]
    gap = diff.gaps[0, accident["num_frames"] - 1]
    assert gap == pytest.approx(da_motion.collision(accident).gap, abs=1e-6)
    assert diff.nearest_in_twin.gap > gap
    for row in np.flatnonzero(diff.parting_frames).tolist():
        frame, actors = diff.parting_frames[row], diff.actor_ids[row].tolist()
        for which, (token, number) in enumerate(
            ((diff.accident, frame), (diff.twin, frame + diff.shift))
        ):
            path = da_motion.trajectory(f"{token}/actor/{actors[which]}")
            np.testing.assert_allclose(
                path.center[path.index == number][0, :2], diff.poses[which, row, frame - 1, :2]
            )
    assert json.loads(json.dumps(diff.to_dict(), allow_nan=False)) == diff.to_dict()


def test_what_is_missing_is_said_and_counted(own_release: Path) -> None:
    """A twin without labels and calib is none; one without labels alone has nothing to compare."""
    first, second, third = reopened(own_release).find(collision=True)
    for scenario, kinds in ((first, ("label", "calib")), (second, ("label",))):
        twin = (
            own_release
            / scenario["folder"]
            / scenario["scenario_type"].replace("accident", "normal")
        )
        for folder in (
            each for kind in kinds for each in twin.glob(f"*/{kind}/{scenario['name']}")
        ):
            shutil.rmtree(folder)
    da = reopened(own_release)
    assert_refused(
        (lambda: twin_diff(da, first["token"]), NotAvailableError, ("no twin of it",)),
        (lambda: twin_diff(da, second["token"]), NotAvailableError, ("has no labels",)),
    )
    report = twin_report(da)
    assert [each.accident for each in report.diffs] == [third["token"]]
    assert [each.scenario for each in report.skipped] == [first["token"], second["token"]]
    assert second["name"] in report.to_text()


def test_two_normal_scenarios_are_nothing_to_compare(own_release: Path) -> None:
    accident = reopened(own_release).find(collision=True)[0]
    meta = (
        own_release
        / accident["folder"]
        / accident["scenario_type"]
        / "meta"
        / f"{accident['name']}.txt"
    )
    meta.write_bytes(Path(str(meta).replace("_accident", "_normal")).read_bytes())
    da = reopened(own_release)
    assert_refused(
        (
            lambda: twin_diff(da, accident["token"]),
            NotAvailableError,
            ("nor its twin", "an accident"),
        )
    )


def test_the_command(da_motion: DeepAccident, tmp_path: Path) -> None:
    root, normal = str(da_motion.dataroot), da_motion.find(collision=False)[0]["token"]

    def run(*words: str) -> Result:
        return CliRunner().invoke(deepaccident, ["safety", "twins", root, *words])

    results = run(), run("--where", "collision=true", "--out", str(tmp_path)), run(normal)
    assert [each.exit_code for each in results] == [0, 0, 2]
    names = {"twins.csv", "twin_actors.csv", "torn_twins.csv", "skipped.csv", "twins.json"}
    assert {path.name for path in tmp_path.iterdir()} == names
    diff = twin_diff(da_motion, normal)
    assert json.loads((tmp_path / "twins.json").read_text(encoding="utf-8"))["twins"] == [
        diff.to_dict()
    ]
    assert len((tmp_path / "twin_actors.csv").read_text(encoding="utf-8").splitlines()) == 1 + len(
        diff.categories
    )


def test_a_report_says_which_recordings_it_is_of(
    da_motion: DeepAccident, da_b: DeepAccident
) -> None:
    first, again, other = (twin_report(each, []) for each in (da_motion, da_motion, da_b))
    assert first.fingerprint == again.fingerprint != other.fingerprint
    assert (
        first.to_dict()["fingerprint"]
        == safety_report(da_motion, []).to_dict()["fingerprint"]
        == first.fingerprint
    )
