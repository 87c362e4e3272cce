import shutil
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

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
    assert (accident.actor_ids, accident.agents) == (
        contact.actor_ids,
        tuple(scenario["collision"]["agents"]),
    )
    assert accident.categories == tuple(scenario["collision"]["classes"])
    assert accident.last_frame == accident.num_frames == scenario["num_frames"]
    assert accident.paths.shape == (2, accident.num_frames, 3)
    assert accident.duration == pytest.approx((accident.num_frames - 1) / 10)
    for which, token in enumerate(contact.instances):
        np.testing.assert_allclose(
            accident.paths[which, :, :2], da_motion.trajectory(token).center[:, :2]
        )
    assert (accident.masses > 0).all()


def without_first(root: Path, scenario: ScenarioRecord, *frames: int) -> None:
    """Take the first of the pair out of all labels of some frames."""
    first, agent = str(scenario["collision"]["ids"][0]), scenario["collision"]["agents"][0]
    folder = root / scenario["folder"] / scenario["scenario_type"]
    for label in folder.glob(f"*/label/{scenario['name']}/*.txt"):
        if int(label.stem[-3:]) in frames:
            gone = [first, "-100"] if f"/{agent}/" in str(label) else [first]
            rows = label.read_text().splitlines(keepends=True)
            label.write_text(
                "".join(row for row in rows if row.split()[-3:-2] not in [[each] for each in gone])
            )
    shutil.rmtree(root / ".deepaccident", ignore_errors=True)


def test_a_missing_label_is_bridged_the_shorter_way(own_release: Path) -> None:
    scenario = DeepAccident("v1", own_release, verbose=False).find(collision=True)[0]
    whole = accident_of(DeepAccident("v1", own_release, verbose=False), scenario)
    without_first(own_release, scenario, 2)
    accident = accident_of(DeepAccident("v1", own_release, verbose=False), scenario)
    assert (whole.interpolated, accident.interpolated) == (0, 1)
    np.testing.assert_allclose(accident.paths[0, 1], whole.paths[0, [0, 2]].mean(axis=0), atol=1e-3)


def test_scenarios_that_lack_something_are_named_and_the_others_stay(own_release: Path) -> None:
    accidents = DeepAccident("v1", own_release, verbose=False).find(collision=True)
    silent, seen_once = accidents[:2]
    (
        own_release / silent["folder"] / silent["scenario_type"] / "meta" / f"{silent['name']}.txt"
    ).unlink()
    without_first(own_release, seen_once, 1, 3, 4)
    found, skipped = accidents_of(DeepAccident("v1", own_release, verbose=False))
    assert {each.scenario for each in found} == {each["token"] for each in accidents[2:]}
    reasons = {each.scenario: each.reason for each in skipped}
    assert reasons.keys() == {silent["token"], seen_once["token"]}
    assert "no meta file" in reasons[silent["token"]]
    assert "together at 1 frames" in reasons[seen_once["token"]]


def test_a_scenario_without_labels_is_named(tmp_path: Path) -> None:
    root = write_small_release(tmp_path, SmallRelease(channels=()))
    for label in root.glob("type1_subtype1_accident/*/label"):
        shutil.rmtree(label)
    da = DeepAccident("v1", root, verbose=False)
    assert_refused(
        (
            lambda: accident_of(da, da.find(collision=True, signalized=True)[0]),
            NotAvailableError,
            "has no labels",
        ),
    )


def test_masses_follow_class_and_size() -> None:
    sizes = np.array([[4.6, 1.93, 1.52], [9.2, 3.86, 3.04], [0.1, 0.1, 0.1]])
    np.testing.assert_allclose(masses_of([0, 0, 5], sizes), [1500, 3000, 37.5])
    assert_refused(
        (
            lambda: masses_of([0], sizes[:1], {**CLASS_MASSES, "car": 0, "truck": -1}),
            ConfigError,
            "car, truck has none",
        ),
    )
