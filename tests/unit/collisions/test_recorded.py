"""The accidents of a release: who collides, on which paths, and what makes one unusable."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions.recorded import (
    CLASS_MASSES,
    accident_of,
    accidents_of,
    masses_of,
)
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.tables.records import ScenarioRecord
from deepaccident_devkit.testing import SmallRelease, write_small_release


def test_the_pair_of_an_accident(da_motion: DeepAccident) -> None:
    scenario = da_motion.find(collision=True)[0]
    accident = accident_of(da_motion, scenario)
    assert accident is not None
    contact = da_motion.collision(scenario)
    assert accident.actor_ids == contact.actor_ids
    assert accident.agents == tuple(scenario["collision"]["agents"])
    assert accident.categories == tuple(scenario["collision"]["classes"])
    assert accident.last_frame == accident.num_frames == scenario["num_frames"]
    assert accident.paths.shape == (2, accident.num_frames, 3)
    assert accident.duration == pytest.approx((accident.num_frames - 1) / 10)
    for path, token in zip(accident.paths, contact.instances, strict=True):
        np.testing.assert_allclose(path[:, :2], da_motion.trajectory(token).center[:, :2])
    assert (accident.masses > 0).all()


def remove_first_actor(root: Path, scenario: ScenarioRecord, *frames: int) -> None:
    """Remove the first actor of the colliding pair from all labels of these frames."""
    first_id = str(scenario["collision"]["ids"][0])
    agent = scenario["collision"]["agents"][0]
    folder = root / scenario["folder"] / scenario["scenario_type"]
    for label in folder.glob(f"*/label/{scenario['name']}/*.txt"):
        if int(label.stem[-3:]) in frames:
            # the agent's own row has the id -100
            removed_ids = [first_id, "-100"] if f"/{agent}/" in str(label) else [first_id]
            header, *rows = label.read_text().splitlines(keepends=True)
            kept_rows = [row for row in rows if row.split()[-3] not in removed_ids]
            label.write_text("".join([header, *kept_rows]))
    shutil.rmtree(root / ".deepaccident", ignore_errors=True)


def test_a_missing_label_is_bridged_the_shorter_way(own_release: Path) -> None:
    da = DeepAccident("v1", own_release, verbose=False)
    scenario = da.find(collision=True)[0]
    complete = accident_of(da, scenario)
    assert complete.interpolated == 0

    remove_first_actor(own_release, scenario, 2)
    bridged = accident_of(DeepAccident("v1", own_release, verbose=False), scenario)
    assert bridged.interpolated == 1
    midpoint = complete.paths[0, [0, 2]].mean(axis=0)
    np.testing.assert_allclose(bridged.paths[0, 1], midpoint, atol=1e-3)


def test_scenarios_that_lack_something_are_named_and_the_others_stay(own_release: Path) -> None:
    scenarios = DeepAccident("v1", own_release, verbose=False).find(collision=True)
    without_meta, seen_once, *complete_scenarios = scenarios
    type_folder = own_release / without_meta["folder"] / without_meta["scenario_type"]
    (type_folder / "meta" / f"{without_meta['name']}.txt").unlink()
    remove_first_actor(own_release, seen_once, 1, 3, 4)

    accidents, skipped = accidents_of(DeepAccident("v1", own_release, verbose=False))
    expected = {scenario["token"] for scenario in complete_scenarios}
    assert {accident.scenario for accident in accidents} == expected
    reasons = {skip.scenario: skip.reason for skip in skipped}
    assert reasons.keys() == {without_meta["token"], seen_once["token"]}
    assert "no meta file" in reasons[without_meta["token"]]
    assert "together at 1 frames" in reasons[seen_once["token"]]


def test_a_scenario_without_labels_is_named(tmp_path: Path) -> None:
    root = write_small_release(tmp_path, SmallRelease(channels=()))
    for label in root.glob("type1_subtype1_accident/*/label"):
        shutil.rmtree(label)
    da = DeepAccident("v1", root, verbose=False)
    assert_raises(
        (
            lambda: accident_of(da, da.find(collision=True, signalized=True)[0]),
            NotAvailableError,
            "has no labels",
        ),
    )


def test_masses_follow_class_and_size() -> None:
    sizes = np.array([[4.6, 1.93, 1.52], [9.2, 3.86, 3.04], [0.1, 0.1, 0.1]])
    np.testing.assert_allclose(masses_of([0, 0, 5], sizes), [1500, 3000, 37.5])
    assert_raises(
        (
            lambda: masses_of([0], sizes[:1], {**CLASS_MASSES, "car": 0, "truck": -1}),
            ConfigError,
            "car, truck has none",
        ),
    )
