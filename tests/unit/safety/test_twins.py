import shutil
from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.safety import TornTwins, torn_twins, twin_of


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
