"""The golden numbers of safety (tests/data/golden/safety), within the tolerances of its README.

Surrogate measures of pairs: brute force, shapely and closed forms in plain code; `library` is what
    SSMsOnPlane gave.
Replays under braking: a program of its own, sampled at 1 ms, checked by a second one, plain loops
    with shapely. Lead
times, Shapley values (means over the 24 orders) and the cost of false alarms: plain code.
"""

import functools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import interactions
from deepaccident_devkit.collisions import OUTCOMES, Accident, Braking, outcomes_of
from deepaccident_devkit.collisions.contact import (
    Pair,
    contact_made,
    contact_times,
    impacts,
    pair_of,
)
from deepaccident_devkit.collisions.outcomes import delta_v_of
from deepaccident_devkit.collisions.replay import braking_plans, replay
from deepaccident_devkit.descriptions import coalition_leads, shapley_values
from deepaccident_devkit.descriptions.avoidability import last_moments
from deepaccident_devkit.evaluation.warning.recordings import AlarmRuns
from deepaccident_devkit.plugins.safety import COALITIONS, PARTNERS
from deepaccident_devkit.taxonomy import AGENTS

HORIZON, WINDOW = 20.0, 10.0


@functools.cache
def _surrogates(folder: Path) -> Mapping[str, Any]:
    path = folder / "safety" / "surrogates.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


@pytest.fixture
def surrogates(pytestconfig: pytest.Config) -> Mapping[str, Any]:
    folder = pytestconfig.getoption("golden")
    found = _surrogates(folder)
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


def side_of(surrogates: Mapping[str, Any], side: str) -> Side:
    given = {
        name: np.array(values) for name, values in surrogates["inputs"].items() if name != "kind"
    }
    yaw, speed = given[f"yaw_{side}"], given[f"speed_{side}"]
    return Side(
        box=np.stack(
            [given[f"{part}_{side}"] for part in ("x", "y", "length", "width", "yaw")], axis=1
        ),
        velocity=speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1),
        speed=speed,
        acceleration=given[f"acc_{side}"],
        mass=given[f"mass_{side}"],
    )


def within_horizon(seconds: np.ndarray) -> np.ndarray:
    return np.where(seconds > HORIZON, np.inf, seconds)


MEASURES: dict[str, Callable[[Side, Side], np.ndarray]] = {
    "ttc_2d": lambda i, j: within_horizon(
        interactions.time_to_collision(i.box, j.box, i.velocity, j.velocity)
    ),
    "mttc_2d": lambda i, j: within_horizon(
        interactions.modified_ttc(i.box, j.box, i.speed, j.speed, i.acceleration, j.acceleration)
    ),
    "ttc_1d": lambda i, j: interactions.time_to_collision_1d(i.box, j.box, i.velocity, j.velocity),
    "drac_1d": lambda i, j: interactions.drac_1d(i.box, j.box, i.velocity, j.velocity),
    "mttc_1d": lambda i, j: interactions.modified_ttc_1d(
        i.box, j.box, i.velocity, j.velocity, i.acceleration, j.acceleration
    ),
    "drac_2d": lambda i, j: interactions.drac_of(
        within_horizon(interactions.time_to_collision(i.box, j.box, i.velocity, j.velocity)),
        interactions.relative_speed(i.velocity, j.velocity),
    ),
    "distance": lambda i, j: interactions.gaps_of_pairs(i.box, j.box),
    "min_distance_20s": lambda i, j: interactions.nearest_approach(
        i.box, j.box, i.velocity, j.velocity, HORIZON
    )[0],
    "closing_speed": lambda i, j: interactions.closing_speed(i.box, j.box, i.velocity, j.velocity),
    "closing_speed_boxes": lambda i, j: interactions.closing_speed_of_boxes(
        i.box, j.box, i.velocity, j.velocity
    ),
    "relative_speed": lambda i, j: interactions.relative_speed(i.velocity, j.velocity),
    "delta_v_i": lambda i, j: interactions.delta_v(i.velocity, j.velocity, i.mass, j.mass)[:, 0],
    "delta_v_j": lambda i, j: interactions.delta_v(i.velocity, j.velocity, i.mass, j.mass)[:, 1],
    "impact_heading": lambda i, j: interactions.impact_heading(i.box, j.box),
    "impact_direction_i": lambda i, j: interactions.impact_direction(i.box, i.velocity, j.velocity),
    "pet": lambda i, j: np.abs(
        interactions.post_encroachment_time(i.box, j.box, i.velocity, j.velocity, WINDOW)
    ),
    "pet_area": lambda i, j: interactions.conflict_area_pet(
        i.box, j.box, i.velocity, j.velocity, WINDOW
    ),
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
def test_surrogate_measure(surrogates: Mapping[str, Any], name: str) -> None:
    expected = numbers(surrogates["expected"][name])
    found = MEASURES[name](side_of(surrogates, "i"), side_of(surrogates, "j"))
    counts = np.ones(len(expected), dtype=bool)
    if name in LEFT_OUT_WHERE_NULL:
        counts = ~np.isnan(expected)
    if name == "mttc_2d":
        counts &= ~np.array(surrogates["expected"]["mttc_2d_graze"])
    assert counts.any()
    tolerance = (
        {"rtol": 0.0, "atol": ABSOLUTE[name]} if name in ABSOLUTE else {"rtol": 1e-9, "atol": 1e-9}
    )
    np.testing.assert_allclose(found[counts], expected[counts], **tolerance)


def test_every_expected_field_is_compared(surrogates: Mapping[str, Any]) -> None:
    assert set(surrogates["expected"]) == {
        *MEASURES,
        "t_min_distance",
        "pet_first",
        "mttc_2d_graze",
    }
    assert {len(values) for values in surrogates["expected"].values()} == {
        len(surrogates["inputs"]["x_i"])
    }


def test_the_time_of_the_least_distance_where_there_is_one(surrogates: Mapping[str, Any]) -> None:
    """Where a side passes along the other's corner, the gap stays the least for a while: any of
    these times will do.
    """
    i, j = side_of(surrogates, "i"), side_of(surrogates, "j")
    expected, least = (
        numbers(surrogates["expected"][name]) for name in ("t_min_distance", "min_distance_20s")
    )
    found = interactions.nearest_approach(i.box, j.box, i.velocity, j.velocity, HORIZON)[1]
    for times in (found, expected):
        moved = [
            np.column_stack([one.box[:, :2] + times[:, None] * one.velocity, one.box[:, 2:]])
            for one in (i, j)
        ]
        np.testing.assert_allclose(interactions.gaps_of_pairs(moved[0], moved[1]), least, atol=1e-9)
    assert (np.abs(found - expected) > 1e-3).mean() < 0.02


def test_who_is_first(surrogates: Mapping[str, Any]) -> None:
    i, j = side_of(surrogates, "i"), side_of(surrogates, "j")
    times = interactions.post_encroachment_time(i.box, j.box, i.velocity, j.velocity, WINDOW)
    known = ~np.isnan(numbers(surrogates["expected"]["pet"]))
    words = np.where(np.isfinite(times) & (times != 0), np.where(times > 0, "i", "j"), "")
    np.testing.assert_array_equal(
        words[known], np.array(surrogates["expected"]["pet_first"])[known]
    )


@pytest.mark.parametrize(("measure", "name"), [("ttc_2d", "lib_ttc"), ("drac_2d", "lib_drac")])
def test_as_the_library_has_it_below_20_s(
    surrogates: Mapping[str, Any], measure: str, name: str
) -> None:
    expected = numbers(surrogates["library"][name])
    i, j = side_of(surrogates, "i"), side_of(surrogates, "j")
    times = interactions.time_to_collision(i.box, j.box, i.velocity, j.velocity)
    found = (
        times if measure == "ttc_2d" else interactions.drac(i.box, j.box, i.velocity, j.velocity)
    )
    overlapping = times == 0  # where the library goes on calculating with −1
    assert (numbers(surrogates["library"]["lib_ttc"])[overlapping] == -1).all()
    near = ~overlapping & (times < HORIZON)
    assert near.any()
    np.testing.assert_allclose(found[near], expected[near], rtol=0, atol=1e-12)


def test_exposed_and_integrated_times(surrogates: Mapping[str, Any]) -> None:
    assert surrogates["tet_tit"]
    for series in surrogates["tet_tit"]:
        times = numbers(series["ttc"])
        for function, name in (
            (interactions.time_exposed, "TET"),
            (interactions.time_integrated, "TIT"),
        ):
            assert function(times, series["tau"], series["dt"]) == pytest.approx(
                series[name], abs=1e-9
            ), name


CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2


def pair_and_start(
    case: Mapping[str, Any], *, braking: bool
) -> tuple[Pair, np.ndarray, np.ndarray]:
    pair = pair_of([case["path_A"], case["path_B"]], [case["size_A"], case["size_B"]])
    start = case["t_warning"] + case["reaction"]
    starts = [start if braking and name in case["brakes"] else np.inf for name in "AB"]
    return pair, np.array([starts]), np.array([case["deceleration"]])


def separations(pair: Pair, starts: np.ndarray, deceleration: np.ndarray) -> np.ndarray:
    """The largest separation along the four face normals, at every millisecond."""
    times = np.arange(0, pair.duration + 3, 1e-3)
    corners, axes = [], []
    for motion, size, start in zip(pair.motions, pair.sizes, starts[0], strict=True):
        plans = braking_plans(motion, [start], deceleration)
        x, y, yaw = replay(motion, plans, np.zeros(len(times), dtype=np.int64), times).poses.T
        turns = np.stack(
            [np.stack([np.cos(yaw), np.sin(yaw)], -1), np.stack([-np.sin(yaw), np.cos(yaw)], -1)], 1
        )
        corners.append(np.stack([x, y], -1)[:, None] + (CORNERS * size) @ turns)
        axes += [turns[:, 0], turns[:, 1]]
    gaps = []
    for axis in axes:
        one, two = (np.einsum("tcx,tx->tc", each, axis) for each in corners)
        gaps.append(np.maximum(one.min(1) - two.max(1), two.min(1) - one.max(1)))
    return np.max(gaps, axis=0)


@pytest.mark.golden_cases("safety/prevented", "cases")
@pytest.mark.parametrize("kind", ["no_braking", "braking"])
def test_contact_and_speeds(golden, kind: str) -> None:
    case = golden.entry
    expected = case["expected"][kind]
    pair, starts, deceleration = pair_and_start(case, braking=kind == "braking")
    assert pair.margin == pytest.approx(case["margin"], abs=1e-9)
    assert pair.duration == pytest.approx(case["t_impact"])
    times = contact_times(pair, starts, deceleration)
    time = float(times[0])
    assert np.isfinite(time) == contact_made(pair, starts, deceleration)[0] == expected["contact"]
    if not expected["contact"]:
        assert separations(pair, starts, deceleration).min() == pytest.approx(
            expected["min_gap"], abs=0.02
        )
        return
    assert time == pytest.approx(expected["t_contact"], abs=2e-3)
    assert (time <= pair.duration + 1e-9) == expected["within_recording"]
    at_a_frame = abs(time * 10 - round(time * 10)) <= 0.02
    impact = impacts(pair, starts, deceleration, times)
    delta_v = delta_v_of([case["mass_A"], case["mass_B"]], impact.relative_speeds)[0]
    for name, found, tolerance in [
        ("speed_A", impact.speeds[0, 0], 0.02),
        ("speed_B", impact.speeds[0, 1], 0.02),
        ("rel_speed", impact.relative_speeds[0], 0.05),
        ("delta_v_A", delta_v[0], 0.05),
        ("delta_v_B", delta_v[1], 0.05),
    ]:
        assert found == pytest.approx(expected[name], abs=0.3 if at_a_frame else tolerance), name


@pytest.mark.golden_cases("safety/prevented", "cases")
def test_outcome_and_last_moment(golden) -> None:
    """The classes are not in the golden numbers; here they follow from them by the definitions."""
    case = golden.entry
    paths = np.array([case["path_A"], case["path_B"]])
    brakers = ("A" in case["brakes"], "B" in case["brakes"])
    found = outcomes_of(
        Accident(
            scenario=case["name"],
            actor_ids=(1, 2),
            categories=("car", "car"),
            agents=(None, None),
            first_frame=1,
            num_frames=paths.shape[1],
            paths=paths,
            sizes=np.array([[*case["size_A"], 1.5], [*case["size_B"], 1.5]]),
            masses=np.array([case["mass_A"], case["mass_B"]]),
            interpolated=0,
        ),
        brakers,
        [case["t_warning"]],
        brakings=[Braking(reaction=case["reaction"], deceleration=case["deceleration"])],
    )
    before, after = (case["expected"][kind] for kind in ("no_braking", "braking"))
    outcome = OUTCOMES[found.outcome[0, 0]]
    assert (outcome == "avoided") == (not after["contact"])
    if after["contact"]:
        assert found.extrapolated[0, 0] == (not after["within_recording"])
        change = after["rel_speed"] / before["rel_speed"]
        assert found.reduction[0, 0] == pytest.approx(1 - change, abs=0.02)
        stopped = all(
            after[f"speed_{name}"] < 0.5 <= before[f"speed_{name}"] for name in case["brakes"]
        )
        told = (
            "worsened"
            if change >= 1.1
            else "stopped"
            if stopped
            else "mitigated"
            if change <= 0.9
            else "unchanged"
        )
        assert outcome == told
    scan = last_moments(
        pair_of(paths, [case["size_A"], case["size_B"]]), brakers, [case["deceleration"]]
    )
    expected = case["expected"]["last_moment"]
    assert np.isfinite(scan.time[0]) == expected["avoidable"]
    assert scan.switches[0] == expected["switches"]
    if expected["avoidable"]:
        assert scan.time[0] == pytest.approx(expected["last_moment"], abs=0.011)
    assert avoids_from(case, 0.0) == expected["avoids_at_0"]


def avoids_from(case: Mapping[str, Any], start: float) -> bool:
    """Whether braking from a moment on avoids the contact."""
    pair, starts, deceleration = pair_and_start(case, braking=True)
    return not contact_made(pair, np.where(np.isfinite(starts), start, np.inf), deceleration)[0]


@pytest.mark.golden_cases("safety/prevented", "cases")
def test_where_braking_alone_ends(golden) -> None:
    case = golden.entry
    expected = case["expected"]["braking"]
    pair, starts, deceleration = pair_and_start(case, braking=True)
    for name, motion, start in zip("AB", pair.motions, starts[0], strict=True):
        if name not in case["brakes"]:
            assert f"stop_s_{name}" not in expected
            continue
        plans = braking_plans(motion, [start], deceleration)
        if np.isinf(plans.starts[0]):
            assert expected.get(f"v_at_brake_{name}") is None
            continue
        assert plans.speeds[0] == pytest.approx(expected[f"v_at_brake_{name}"], abs=0.02)
        seconds = plans.speeds[0] / deceleration[0]
        assert plans.arcs[0] + plans.speeds[0] * seconds / 2 == pytest.approx(
            expected[f"stop_s_{name}"], abs=1e-3
        )
        assert plans.starts[0] + seconds == pytest.approx(expected[f"stop_t_{name}"], abs=1e-3)


@pytest.mark.golden_cases("safety/ledger_and_cost", "ledger")
def test_leads_of_all_coalitions_and_shapley_values(golden) -> None:
    entry = golden.entry
    observed = np.array(
        [[entry["observed"][agent][which] for which in "AB"] for agent in AGENTS], dtype=bool
    )
    assert observed.shape == (5, 2, entry["frames"])
    leads = coalition_leads(observed)
    expected = entry["expected"]["lead_seconds"]
    assert {"+".join(members) for members in COALITIONS} == expected.keys()
    for members, lead in zip(COALITIONS, leads.tolist(), strict=True):
        assert lead == pytest.approx(expected["+".join(members)], rel=0, abs=1e-9), members
    shapley = dict(zip(PARTNERS, shapley_values(leads).tolist(), strict=True))
    assert shapley == pytest.approx(entry["expected"]["shapley_seconds"], rel=0, abs=1e-9)


@pytest.mark.golden_cases("safety/ledger_and_cost", "false_alarm_cost")
def test_false_alarm_cost(golden) -> None:
    """Runs and braking seconds; the golden file has the rates of a minute, too."""
    entry, expected = golden.entry, golden.entry["expected"]
    runs = AlarmRuns.of(np.array([entry["alarm"]]) > 0, entry["fps"])
    assert len(runs.row) == expected["episodes"]
    assert runs.length.sum() / entry["fps"] == pytest.approx(expected["alarm_seconds"], rel=1e-9)
    assert runs.braking_seconds(entry["reaction"])[0] == pytest.approx(
        expected["braking_seconds"], rel=1e-9, abs=1e-9
    )
