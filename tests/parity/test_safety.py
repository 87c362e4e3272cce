"""The golden numbers of safety (tests/data/golden/safety), within the tolerances of its README.

Surrogate measures of pairs come from brute force, shapely and closed forms in plain code; `library`
holds the results of SSMsOnPlane. Replays under braking come from a separate program, sampled at
1 ms and checked by a second one that uses plain loops with shapely. Lead times, Shapley values
(means over the 24 orders) and the cost of false alarms come from plain code.
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
    contact_times,
    has_contact,
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

HORIZON_S = 20.0
WINDOW_S = 10.0


@functools.cache
def _read_surrogates(folder: Path) -> Mapping[str, Any]:
    path = folder / "safety" / "surrogates.json"
    if not path.is_file():
        return {}
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.fixture
def surrogates(pytestconfig: pytest.Config) -> Mapping[str, Any]:
    folder = pytestconfig.getoption("golden")
    content = _read_surrogates(folder)
    if not content.get("inputs", {}).get("x_i"):
        pytest.fail(f"{folder / 'safety' / 'surrogates.json'}: no pair; see pytest --golden DIR")
    return content


def to_numbers(values: list[Any]) -> np.ndarray:
    """Convert values of JSON, where null stands for NaN and "inf" for infinity."""
    return np.array(values, dtype=np.float64)


@dataclass(frozen=True)
class Side:
    box: np.ndarray
    velocity: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    mass: np.ndarray


def make_side(surrogates: Mapping[str, Any], side: str) -> Side:
    names = ("x", "y", "length", "width", "yaw", "speed", "acc", "mass")
    inputs = {name: np.array(surrogates["inputs"][f"{name}_{side}"]) for name in names}
    yaw = inputs["yaw"]
    speed = inputs["speed"]
    direction = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    box_fields = [inputs[name] for name in ("x", "y", "length", "width", "yaw")]
    return Side(
        box=np.stack(box_fields, axis=1),
        velocity=speed[:, None] * direction,
        speed=speed,
        acceleration=inputs["acc"],
        mass=inputs["mass"],
    )


def within_horizon(times_s: np.ndarray) -> np.ndarray:
    return np.where(times_s > HORIZON_S, np.inf, times_s)


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
        i.box, j.box, i.velocity, j.velocity, HORIZON_S
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
        interactions.post_encroachment_time(i.box, j.box, i.velocity, j.velocity, WINDOW_S)
    ),
    "pet_area": lambda i, j: interactions.conflict_area_pet(
        i.box, j.box, i.velocity, j.velocity, WINDOW_S
    ),
}
ABSOLUTE_TOLERANCES = {
    "ttc_2d": 1e-6,
    "mttc_2d": 1e-6,
    "min_distance_20s": 1e-6,
    "closing_speed_boxes": 1e-3,
    "pet": 1e-6,
    "pet_area": 1e-4,
}
FIELDS_WITH_UNKNOWNS = {"mttc_2d", "pet"}
"""Fields in which null stands for an unknown number; in other fields it stands for NaN."""


@pytest.mark.parametrize("name", MEASURES)
def test_surrogate_measure(surrogates: Mapping[str, Any], name: str) -> None:
    expected = to_numbers(surrogates["expected"][name])
    is_compared = np.ones(len(expected), dtype=bool)
    if name in FIELDS_WITH_UNKNOWNS:
        is_compared = ~np.isnan(expected)
    if name == "mttc_2d":
        is_compared &= ~np.array(surrogates["expected"]["mttc_2d_graze"])
    assert is_compared.any()

    values = MEASURES[name](make_side(surrogates, "i"), make_side(surrogates, "j"))

    np.testing.assert_allclose(
        values[is_compared],
        expected[is_compared],
        rtol=0.0 if name in ABSOLUTE_TOLERANCES else 1e-9,
        atol=ABSOLUTE_TOLERANCES.get(name, 1e-9),
    )


def test_every_expected_field_is_compared(surrogates: Mapping[str, Any]) -> None:
    expected = surrogates["expected"]
    num_pairs = len(surrogates["inputs"]["x_i"])
    assert set(expected) == {*MEASURES, "t_min_distance", "pet_first", "mttc_2d_graze"}
    assert {len(values) for values in expected.values()} == {num_pairs}


def test_time_of_the_least_distance(surrogates: Mapping[str, Any]) -> None:
    """Where a side passes along the other's corner, the gap stays at its minimum for a while.

    Any of these times is right.
    """
    i = make_side(surrogates, "i")
    j = make_side(surrogates, "j")
    expected = to_numbers(surrogates["expected"]["t_min_distance"])
    least_distance = to_numbers(surrogates["expected"]["min_distance_20s"])

    _, times = interactions.nearest_approach(i.box, j.box, i.velocity, j.velocity, HORIZON_S)

    for seconds in (times, expected):
        gaps = interactions.gaps_of_pairs(move_boxes(i, seconds), move_boxes(j, seconds))
        np.testing.assert_allclose(gaps, least_distance, atol=1e-9)
    differs = np.abs(times - expected) > 1e-3
    assert differs.mean() < 0.02


def move_boxes(side: Side, seconds: np.ndarray) -> np.ndarray:
    centers = side.box[:, :2] + seconds[:, None] * side.velocity
    return np.column_stack([centers, side.box[:, 2:]])


def test_which_side_passes_first(surrogates: Mapping[str, Any]) -> None:
    i = make_side(surrogates, "i")
    j = make_side(surrogates, "j")
    is_known = ~np.isnan(to_numbers(surrogates["expected"]["pet"]))
    expected = np.array(surrogates["expected"]["pet_first"])

    times = interactions.post_encroachment_time(i.box, j.box, i.velocity, j.velocity, WINDOW_S)

    first_sides = np.full(len(times), "")
    first_sides[np.isfinite(times) & (times > 0)] = "i"
    first_sides[np.isfinite(times) & (times < 0)] = "j"
    np.testing.assert_array_equal(first_sides[is_known], expected[is_known])


@pytest.mark.parametrize(("measure", "name"), [("ttc_2d", "lib_ttc"), ("drac_2d", "lib_drac")])
def test_measures_below_20_s_equal_the_librarys(
    surrogates: Mapping[str, Any], measure: str, name: str
) -> None:
    expected = to_numbers(surrogates["library"][name])
    library_times = to_numbers(surrogates["library"]["lib_ttc"])
    i = make_side(surrogates, "i")
    j = make_side(surrogates, "j")

    times = interactions.time_to_collision(i.box, j.box, i.velocity, j.velocity)
    values = times
    if measure == "drac_2d":
        values = interactions.drac(i.box, j.box, i.velocity, j.velocity)

    is_overlapping = times == 0  # where the library continues with −1
    assert (library_times[is_overlapping] == -1).all()
    is_near = ~is_overlapping & (times < HORIZON_S)
    assert is_near.any()
    np.testing.assert_allclose(values[is_near], expected[is_near], rtol=0, atol=1e-12)


def test_exposed_and_integrated_times(surrogates: Mapping[str, Any]) -> None:
    assert surrogates["tet_tit"]
    for series in surrogates["tet_tit"]:
        times = to_numbers(series["ttc"])
        exposed_time = interactions.time_exposed(times, series["tau"], series["dt"])
        integrated_time = interactions.time_integrated(times, series["tau"], series["dt"])
        assert exposed_time == pytest.approx(series["TET"], abs=1e-9)
        assert integrated_time == pytest.approx(series["TIT"], abs=1e-9)


UNIT_CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2


def make_pair(case: Mapping[str, Any], *, braking: bool) -> tuple[Pair, np.ndarray, np.ndarray]:
    """Return the pair, when each side starts to brake (1, 2), and the deceleration (1,)."""
    pair = pair_of([case["path_A"], case["path_B"]], [case["size_A"], case["size_B"]])
    starts = np.full((1, 2), np.inf)
    for number, name in enumerate("AB"):
        if braking and name in case["brakes"]:
            starts[0, number] = case["t_warning"] + case["reaction"]
    return pair, starts, np.array([case["deceleration"]])


def measure_separations(pair: Pair, starts: np.ndarray, deceleration: np.ndarray) -> np.ndarray:
    """Return the largest separation along the four face normals at every millisecond."""
    times = np.arange(0, pair.duration + 3, 1e-3)
    corners = []
    axes = []
    for motion, size, start in zip(pair.motions, pair.sizes, starts[0], strict=True):
        plans = braking_plans(motion, [start], deceleration)
        x, y, yaw = replay(motion, plans, np.zeros(len(times), dtype=np.int64), times).poses.T
        forward = np.stack([np.cos(yaw), np.sin(yaw)], -1)
        left = np.stack([-np.sin(yaw), np.cos(yaw)], -1)
        center = np.stack([x, y], -1)
        corners.append(center[:, None] + (UNIT_CORNERS * size) @ np.stack([forward, left], 1))
        axes += [forward, left]

    gaps = []
    for axis in axes:
        a = np.einsum("tcx,tx->tc", corners[0], axis)
        b = np.einsum("tcx,tx->tc", corners[1], axis)
        gaps.append(np.maximum(a.min(1) - b.max(1), b.min(1) - a.max(1)))
    return np.max(gaps, axis=0)


@pytest.mark.golden_cases("safety/prevented", "cases")
@pytest.mark.parametrize("kind", ["no_braking", "braking"])
def test_contact_and_speeds(golden, kind: str) -> None:
    case = golden.entry
    expected = case["expected"][kind]
    pair, starts, deceleration = make_pair(case, braking=kind == "braking")
    assert pair.margin == pytest.approx(case["margin"], abs=1e-9)
    assert pair.duration == pytest.approx(case["t_impact"])

    times = contact_times(pair, starts, deceleration)

    time = float(times[0])
    assert np.isfinite(time) == expected["contact"]
    assert has_contact(pair, starts, deceleration)[0] == expected["contact"]
    if not expected["contact"]:
        separations = measure_separations(pair, starts, deceleration)
        assert separations.min() == pytest.approx(expected["min_gap"], abs=0.02)
        return
    assert time == pytest.approx(expected["t_contact"], abs=2e-3)
    assert (time <= pair.duration + 1e-9) == expected["within_recording"]

    impact = impacts(pair, starts, deceleration, times)
    delta_v = delta_v_of([case["mass_A"], case["mass_B"]], impact.relative_speeds)[0]
    is_at_a_frame = abs(time * 10 - round(time * 10)) <= 0.02
    for name, speed, tolerance in [
        ("speed_A", impact.speeds[0, 0], 0.02),
        ("speed_B", impact.speeds[0, 1], 0.02),
        ("rel_speed", impact.relative_speeds[0], 0.05),
        ("delta_v_A", delta_v[0], 0.05),
        ("delta_v_B", delta_v[1], 0.05),
    ]:
        allowed_error = 0.3 if is_at_a_frame else tolerance
        assert speed == pytest.approx(expected[name], abs=allowed_error), name


@pytest.mark.golden_cases("safety/prevented", "cases")
def test_outcome_and_last_moment(golden) -> None:
    """The golden numbers lack the outcomes; they follow from the numbers by definition."""
    case = golden.entry
    paths = np.array([case["path_A"], case["path_B"]])
    brakers = ("A" in case["brakes"], "B" in case["brakes"])
    accident = Accident(
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
    )
    braking = Braking(reaction=case["reaction"], deceleration=case["deceleration"])

    outcomes = outcomes_of(accident, brakers, [case["t_warning"]], brakings=[braking])

    before = case["expected"]["no_braking"]
    after = case["expected"]["braking"]
    assert OUTCOMES[outcomes.outcome[0, 0]] == expected_outcome(before, after, case["brakes"])
    if after["contact"]:
        assert outcomes.extrapolated[0, 0] == (not after["within_recording"])
        speed_ratio = after["rel_speed"] / before["rel_speed"]
        assert outcomes.reduction[0, 0] == pytest.approx(1 - speed_ratio, abs=0.02)

    expected = case["expected"]["last_moment"]
    pair, starts, deceleration = make_pair(case, braking=True)
    scan = last_moments(pair, brakers, deceleration)
    assert np.isfinite(scan.time[0]) == expected["avoidable"]
    assert scan.switches[0] == expected["switches"]
    if expected["avoidable"]:
        assert scan.time[0] == pytest.approx(expected["last_moment"], abs=0.011)
    starts_at_0 = np.where(np.isfinite(starts), 0.0, np.inf)
    assert has_contact(pair, starts_at_0, deceleration)[0] == (not expected["avoids_at_0"])


def expected_outcome(before: Mapping[str, Any], after: Mapping[str, Any], brakers: str) -> str:
    """Classify by the speeds at the contact without and with braking."""
    if not after["contact"]:
        return "avoided"
    speed_ratio = after["rel_speed"] / before["rel_speed"]
    if speed_ratio >= 1.1:
        return "worsened"
    speeds = [(before[f"speed_{name}"], after[f"speed_{name}"]) for name in brakers]
    if all(speed_after < 0.5 <= speed_before for speed_before, speed_after in speeds):
        return "stopped"
    return "mitigated" if speed_ratio <= 0.9 else "unchanged"


@pytest.mark.golden_cases("safety/prevented", "cases")
def test_where_and_when_braking_sides_stop(golden) -> None:
    case = golden.entry
    expected = case["expected"]["braking"]
    pair, starts, deceleration = make_pair(case, braking=True)
    for name, motion, start in zip("AB", pair.motions, starts[0], strict=True):
        if name not in case["brakes"]:
            assert f"stop_s_{name}" not in expected
            continue
        plans = braking_plans(motion, [start], deceleration)
        if np.isinf(plans.starts[0]):
            assert expected.get(f"v_at_brake_{name}") is None
            continue
        speed = plans.speeds[0]
        assert speed == pytest.approx(expected[f"v_at_brake_{name}"], abs=0.02)
        seconds = speed / deceleration[0]
        stop_arc = plans.arcs[0] + speed * seconds / 2
        stop_time = plans.starts[0] + seconds
        assert stop_arc == pytest.approx(expected[f"stop_s_{name}"], abs=1e-3)
        assert stop_time == pytest.approx(expected[f"stop_t_{name}"], abs=1e-3)


@pytest.mark.golden_cases("safety/ledger_and_cost", "ledger")
def test_leads_of_all_coalitions_and_shapley_values(golden) -> None:
    entry = golden.entry
    observed_by_agent = [entry["observed"][agent] for agent in AGENTS]
    observed = np.array([[sides["A"], sides["B"]] for sides in observed_by_agent], dtype=bool)
    assert observed.shape == (5, 2, entry["frames"])
    expected = entry["expected"]["lead_seconds"]
    names = ["+".join(members) for members in COALITIONS]
    assert set(names) == expected.keys()

    leads = coalition_leads(observed)

    for name, lead in zip(names, leads.tolist(), strict=True):
        assert lead == pytest.approx(expected[name], rel=0, abs=1e-9), name
    shapley = dict(zip(PARTNERS, shapley_values(leads).tolist(), strict=True))
    assert shapley == pytest.approx(entry["expected"]["shapley_seconds"], rel=0, abs=1e-9)


@pytest.mark.golden_cases("safety/ledger_and_cost", "false_alarm_cost")
def test_false_alarm_cost(golden) -> None:
    """Compare runs and braking seconds; the golden file also has rates per minute."""
    entry = golden.entry
    expected = entry["expected"]
    in_alarm = np.array([entry["alarm"]]) > 0

    runs = AlarmRuns.of(in_alarm, entry["fps"])

    alarm_seconds = runs.length.sum() / entry["fps"]
    braking_seconds = runs.braking_seconds(entry["reaction"])[0]
    assert len(runs.row) == expected["episodes"]
    assert alarm_seconds == pytest.approx(expected["alarm_seconds"], rel=1e-9)
    assert braking_seconds == pytest.approx(expected["braking_seconds"], rel=1e-9, abs=1e-9)
