"""The golden surrogate measures (tests/data/golden/safety/surrogates.json): 200 pairs, all fields; 24 series.

Brute force, shapely and closed forms in plain code made the numbers; `library` is what SSMsOnPlane returned
(tests/data/golden/safety/README.md). Tolerances are those of that page.
"""

import functools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import safety

HORIZON, WINDOW = 20.0, 10.0


@functools.cache
def _golden(folder: Path) -> Mapping[str, Any]:
    path = folder / "safety" / "surrogates.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


@pytest.fixture
def golden(pytestconfig: pytest.Config) -> Mapping[str, Any]:
    folder = pytestconfig.getoption("golden")
    found = _golden(folder)
    if not found.get("inputs", {}).get("x_i"):
        pytest.fail(f"{folder / 'safety' / 'surrogates.json'}: no pair; see pytest --golden DIR")
    return found


def numbers(values: list[Any]) -> np.ndarray:
    """null is NaN, "inf" infinite."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


@dataclass(frozen=True)
class Side:
    box: np.ndarray
    velocity: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    mass: np.ndarray


def side_of(golden: Mapping[str, Any], side: str) -> Side:
    given = {name: np.array(values) for name, values in golden["inputs"].items() if name != "kind"}
    yaw, speed = given[f"yaw_{side}"], given[f"speed_{side}"]
    return Side(
        box=np.stack([given[f"{part}_{side}"] for part in ("x", "y", "length", "width", "yaw")], axis=1),
        velocity=speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1),
        speed=speed,
        acceleration=given[f"acc_{side}"],
        mass=given[f"mass_{side}"],
    )


def within_horizon(seconds: np.ndarray) -> np.ndarray:
    return np.where(seconds > HORIZON, np.inf, seconds)


MEASURES: dict[str, Callable[[Side, Side], np.ndarray]] = {
    "ttc_2d": lambda i, j: within_horizon(safety.time_to_collision(i.box, j.box, i.velocity, j.velocity)),
    "mttc_2d": lambda i, j: within_horizon(
        safety.modified_ttc(i.box, j.box, i.speed, j.speed, i.acceleration, j.acceleration)
    ),
    "ttc_1d": lambda i, j: safety.time_to_collision_1d(i.box, j.box, i.velocity, j.velocity),
    "drac_1d": lambda i, j: safety.drac_1d(i.box, j.box, i.velocity, j.velocity),
    "mttc_1d": lambda i, j: safety.modified_ttc_1d(
        i.box, j.box, i.velocity, j.velocity, i.acceleration, j.acceleration
    ),
    "drac_2d": lambda i, j: safety.drac_of(
        within_horizon(safety.time_to_collision(i.box, j.box, i.velocity, j.velocity)),
        safety.relative_speed(i.velocity, j.velocity),
    ),
    "distance": lambda i, j: safety.gaps_of_pairs(i.box, j.box),
    "min_distance_20s": lambda i, j: safety.nearest_approach(i.box, j.box, i.velocity, j.velocity, HORIZON)[0],
    "closing_speed": lambda i, j: safety.closing_speed(i.box, j.box, i.velocity, j.velocity),
    "closing_speed_boxes": lambda i, j: safety.closing_speed_of_boxes(i.box, j.box, i.velocity, j.velocity),
    "relative_speed": lambda i, j: safety.relative_speed(i.velocity, j.velocity),
    "delta_v_i": lambda i, j: safety.delta_v(i.velocity, j.velocity, i.mass, j.mass)[:, 0],
    "delta_v_j": lambda i, j: safety.delta_v(i.velocity, j.velocity, i.mass, j.mass)[:, 1],
    "impact_heading": lambda i, j: safety.impact_heading(i.box, j.box),
    "impact_direction_i": lambda i, j: safety.impact_direction(i.box, i.velocity, j.velocity),
    "pet": lambda i, j: np.abs(safety.post_encroachment_time(i.box, j.box, i.velocity, j.velocity, WINDOW)),
    "pet_area": lambda i, j: safety.conflict_area_pet(i.box, j.box, i.velocity, j.velocity, WINDOW),
}
ABSOLUTE = {
    "ttc_2d": 1e-6,
    "mttc_2d": 1e-6,
    "min_distance_20s": 1e-6,
    "closing_speed_boxes": 1e-3,
    "pet": 1e-6,
    "pet_area": 1e-4,
}
LEFT_OUT_WHERE_NULL = {"mttc_2d", "pet"}
"""Fields of which a null says that the number is not known; in others it says NaN."""


@pytest.mark.parametrize("name", MEASURES)
def test_measure(golden: Mapping[str, Any], name: str) -> None:
    expected = numbers(golden["expected"][name])
    found = MEASURES[name](side_of(golden, "i"), side_of(golden, "j"))
    counts = np.ones(len(expected), dtype=bool)
    if name in LEFT_OUT_WHERE_NULL:
        counts = ~np.isnan(expected)
    if name == "mttc_2d":
        counts &= ~np.array(golden["expected"]["mttc_2d_graze"])
    assert counts.sum() > 100
    tolerance = {"rtol": 0.0, "atol": ABSOLUTE[name]} if name in ABSOLUTE else {"rtol": 1e-9, "atol": 1e-9}
    np.testing.assert_allclose(found[counts], expected[counts], **tolerance)


def test_every_expected_field_is_compared(golden: Mapping[str, Any]) -> None:
    assert set(golden["expected"]) == {*MEASURES, "t_min_distance", "pet_first", "mttc_2d_graze"}
    assert {len(values) for values in golden["expected"].values()} == {200}


def test_the_time_of_the_least_distance_where_there_is_one(golden: Mapping[str, Any]) -> None:
    i, j = side_of(golden, "i"), side_of(golden, "j")
    expected = numbers(golden["expected"]["t_min_distance"])
    found = safety.nearest_approach(i.box, j.box, i.velocity, j.velocity, HORIZON)[1]
    others = np.flatnonzero(np.abs(found - expected) > 1e-3)
    assert golden["inputs"]["kind"][189] == "standing_other"
    assert others.tolist() == [189], "a side passes along the other's corner: the gap stays the least for 2 s"
    for times in (found, expected):
        moved = [np.column_stack([one.box[:, :2] + times[:, None] * one.velocity, one.box[:, 2:]]) for one in (i, j)]
        gaps = safety.gaps_of_pairs(moved[0], moved[1])
        np.testing.assert_allclose(gaps, numbers(golden["expected"]["min_distance_20s"]), atol=1e-9)


def test_who_is_first(golden: Mapping[str, Any]) -> None:
    i, j = side_of(golden, "i"), side_of(golden, "j")
    times = safety.post_encroachment_time(i.box, j.box, i.velocity, j.velocity, WINDOW)
    known = ~np.isnan(numbers(golden["expected"]["pet"]))
    words = np.where(np.isfinite(times) & (times != 0), np.where(times > 0, "i", "j"), "")
    np.testing.assert_array_equal(words[known], np.array(golden["expected"]["pet_first"])[known])


@pytest.mark.parametrize(("measure", "name"), [("ttc_2d", "lib_ttc"), ("drac_2d", "lib_drac")])
def test_as_the_library_has_it_below_20_s(golden: Mapping[str, Any], measure: str, name: str) -> None:
    expected = numbers(golden["library"][name])
    i, j = side_of(golden, "i"), side_of(golden, "j")
    times = safety.time_to_collision(i.box, j.box, i.velocity, j.velocity)
    found = times if measure == "ttc_2d" else safety.drac(i.box, j.box, i.velocity, j.velocity)
    overlapping = times == 0  # where the library goes on calculating with −1
    assert (numbers(golden["library"]["lib_ttc"])[overlapping] == -1).all()
    near = ~overlapping & (times < HORIZON)
    assert near.sum() > 100
    np.testing.assert_allclose(found[near], expected[near], rtol=0, atol=1e-12)


def test_exposed_and_integrated_times(golden: Mapping[str, Any]) -> None:
    assert len(golden["tet_tit"]) == 24
    for series in golden["tet_tit"]:
        times = numbers(series["ttc"])
        for function, name in ((safety.time_exposed, "TET"), (safety.time_integrated, "TIT")):
            assert function(times, series["tau"], series["dt"]) == pytest.approx(series[name], abs=1e-9), name
