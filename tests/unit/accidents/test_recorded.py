import shutil
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.accidents.recorded import CLASS_MASSES, accident_of, accidents_of, masses_of
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.testing import SmallRelease, write_small_release


def test_the_pair_of_an_accident(da_motion: DeepAccident) -> None:
    scenario = da_motion.find(collision=True)[0]
    accident = accident_of(da_motion, scenario)
    assert accident is not None
    contact = da_motion.collision(scenario)
    assert (accident.actor_ids, accident.agents) == (contact.actor_ids, tuple(scenario["collision"]["agents"]))
    assert accident.categories == tuple(scenario["collision"]["classes"])
    assert accident.last_frame == accident.num_frames == scenario["num_frames"]
    assert accident.paths.shape == (2, accident.num_frames, 3)
    assert accident.duration == pytest.approx((accident.num_frames - 1) / 10)
    for which, token in enumerate(contact.instances):
        np.testing.assert_allclose(accident.paths[which, :, :2], da_motion.trajectory(token).center[:, :2])
    assert (accident.masses > 0).all()


def test_a_missing_label_is_bridged_the_shorter_way(own_release: Path) -> None:
    scenario = DeepAccident("v1", own_release, verbose=False).find(collision=True)[0]
    whole = accident_of(DeepAccident("v1", own_release, verbose=False), scenario)
    first = scenario["collision"]["ids"][0]
    agent = dict(zip(scenario["collision"]["ids"], scenario["collision"]["agents"], strict=True))[first]
    for label in (own_release / scenario["folder"] / scenario["scenario_type"]).glob(
        f"*/label/{scenario['name']}/*_002.txt"
    ):
        rows = [line for line in label.read_text().splitlines(keepends=True) if line.split()[-3:-2] != [str(first)]]
        if f"/{agent}/" in str(label):
            rows = [line for line in rows if " -100 " not in line]
        label.write_text("".join(rows))
    shutil.rmtree(own_release / ".deepaccident")
    accident = accident_of(DeepAccident("v1", own_release, verbose=False), scenario)
    assert whole is not None
    assert accident is not None
    assert (whole.interpolated, accident.interpolated) == (0, 1)
    np.testing.assert_allclose(accident.paths[0, 1], whole.paths[0, [0, 2]].mean(axis=0), atol=1e-3)


def test_scenarios_that_lack_something_are_named_and_the_others_stay(own_release: Path) -> None:
    accidents = DeepAccident("v1", own_release, verbose=False).find(collision=True)
    without_meta, seen_once = accidents[:2]
    (
        own_release / without_meta["folder"] / without_meta["scenario_type"] / "meta" / f"{without_meta['name']}.txt"
    ).unlink()
    first, agent = str(seen_once["collision"]["ids"][0]), seen_once["collision"]["agents"][0]
    for label in (own_release / seen_once["folder"] / seen_once["scenario_type"]).glob(
        f"*/label/{seen_once['name']}/*.txt"
    ):
        if not label.stem.endswith("_002"):
            own, rows = f"/{agent}/" in str(label), label.read_text().splitlines(keepends=True)
            label.write_text(
                "".join(row for row in rows if row.split()[-3:-2] not in ([first], ["-100"] if own else [first]))
            )
    shutil.rmtree(own_release / ".deepaccident")
    found, skipped = accidents_of(DeepAccident("v1", own_release, verbose=False))
    assert {each.scenario for each in found} == {each["token"] for each in accidents[2:]}
    reasons = {each.scenario: each.reason for each in skipped}
    assert reasons.keys() == {without_meta["token"], seen_once["token"]}
    assert "no meta file" in reasons[without_meta["token"]]
    assert "together at 1 frames" in reasons[seen_once["token"]]


def test_a_scenario_without_labels_is_named(tmp_path: Path) -> None:
    root = write_small_release(tmp_path, SmallRelease(channels=()))
    for label in root.glob("type1_subtype1_accident/*/label"):
        for file in label.rglob("*.txt"):
            file.unlink()
        for folder in (*label.iterdir(), label):
            folder.rmdir()
    da = DeepAccident("v1", root, verbose=False)
    assert_refused(
        (lambda: accident_of(da, da.find(collision=True, signalized=True)[0]), NotAvailableError, "has no labels"),
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
