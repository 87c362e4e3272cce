"""The golden replays under braking (tests/data/golden/safety/prevented.json): 34 accidents, sampled at 1 ms.

A program of its own made them, and a second one, plain loops with shapely, checked them; the tolerances are those of
tests/data/golden/safety/README.md.
"""

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit.safety import OUTCOMES, Accident, Braking, outcomes_of
from deepaccident_devkit.safety.avoidability import last_moments
from deepaccident_devkit.safety.contact import Pair, contact_made, contact_times, impacts, pair_of
from deepaccident_devkit.safety.outcomes import delta_v_of
from deepaccident_devkit.safety.replay import braking_plans, replay

CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2


@functools.cache
def _cases(folder: Path) -> Mapping[str, Any]:
    path = folder / "safety" / "prevented.json"
    if not path.is_file():
        return {}
    return {case["name"]: case for case in json.loads(path.read_text(encoding="utf-8"))["cases"]}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "case" in metafunc.fixturenames:
        metafunc.parametrize("case", list(_cases(metafunc.config.getoption("golden"))) or [None])


@pytest.fixture
def golden(case: str | None, pytestconfig: pytest.Config) -> Mapping[str, Any]:
    folder = pytestconfig.getoption("golden")
    if case is None:
        pytest.fail(f"{folder / 'safety' / 'prevented.json'}: no case; see pytest --golden DIR")
    return _cases(folder)[case]


def pair_and_start(golden: Mapping[str, Any], *, braking: bool) -> tuple[Pair, np.ndarray, np.ndarray]:
    pair = pair_of([golden["path_A"], golden["path_B"]], [golden["size_A"], golden["size_B"]])
    start = golden["t_warning"] + golden["reaction"]
    starts = [start if braking and name in golden["brakes"] else np.inf for name in "AB"]
    return pair, np.array([starts]), np.array([golden["deceleration"]])


def separations(pair: Pair, starts: np.ndarray, deceleration: np.ndarray) -> np.ndarray:
    """The largest separation along the four face normals, at every millisecond."""
    times = np.arange(0, pair.duration + 3, 1e-3)
    corners, axes = [], []
    for motion, size, start in zip(pair.motions, pair.sizes, starts[0], strict=True):
        plans = braking_plans(motion, [start], deceleration)
        x, y, yaw = replay(motion, plans, np.zeros(len(times), dtype=np.int64), times).poses.T
        turns = np.stack([np.stack([np.cos(yaw), np.sin(yaw)], -1), np.stack([-np.sin(yaw), np.cos(yaw)], -1)], 1)
        corners.append(np.stack([x, y], -1)[:, None] + (CORNERS * size) @ turns)
        axes += [turns[:, 0], turns[:, 1]]
    gaps = []
    for axis in axes:
        one, two = (np.einsum("tcx,tx->tc", each, axis) for each in corners)
        gaps.append(np.maximum(one.min(1) - two.max(1), two.min(1) - one.max(1)))
    return np.max(gaps, axis=0)


@pytest.mark.parametrize("kind", ["no_braking", "braking"])
def test_contact_and_speeds(golden: Mapping[str, Any], case: str, kind: str) -> None:
    expected = golden["expected"][kind]
    pair, starts, deceleration = pair_and_start(golden, braking=kind == "braking")
    assert pair.margin == pytest.approx(golden["margin"], abs=1e-9)
    assert pair.duration == pytest.approx(golden["t_impact"])
    times = contact_times(pair, starts, deceleration)
    time = float(times[0])
    assert np.isfinite(time) == contact_made(pair, starts, deceleration)[0] == expected["contact"]
    if not expected["contact"]:
        assert separations(pair, starts, deceleration).min() == pytest.approx(expected["min_gap"], abs=0.02)
        return
    assert time == pytest.approx(expected["t_contact"], abs=2e-3)
    assert (time <= pair.duration + 1e-9) == expected["within_recording"]
    at_a_frame = abs(time * 10 - round(time * 10)) <= 0.02
    impact = impacts(pair, starts, deceleration, times)
    delta_v = delta_v_of([golden["mass_A"], golden["mass_B"]], impact.relative_speeds)[0]
    for name, found, tolerance in [
        ("speed_A", impact.speeds[0, 0], 0.02),
        ("speed_B", impact.speeds[0, 1], 0.02),
        ("rel_speed", impact.relative_speeds[0], 0.05),
        ("delta_v_A", delta_v[0], 0.05),
        ("delta_v_B", delta_v[1], 0.05),
    ]:
        assert found == pytest.approx(expected[name], abs=0.3 if at_a_frame else tolerance), name


def test_outcome_and_last_moment(golden: Mapping[str, Any], case: str) -> None:
    """The classes are not in the golden numbers; here they follow from them by the definitions."""
    paths = np.array([golden["path_A"], golden["path_B"]])
    brakers = ("A" in golden["brakes"], "B" in golden["brakes"])
    found = outcomes_of(
        Accident(
            scenario=case,
            actor_ids=(1, 2),
            categories=("car", "car"),
            agents=(None, None),
            first_frame=1,
            num_frames=paths.shape[1],
            paths=paths,
            sizes=np.array([[*golden["size_A"], 1.5], [*golden["size_B"], 1.5]]),
            masses=np.array([golden["mass_A"], golden["mass_B"]]),
            interpolated=0,
        ),
        brakers,
        [golden["t_warning"]],
        brakings=[Braking(reaction=golden["reaction"], deceleration=golden["deceleration"])],
    )
    before, after = (golden["expected"][kind] for kind in ("no_braking", "braking"))
    outcome = OUTCOMES[found.outcome[0, 0]]
    assert (outcome == "avoided") == (not after["contact"])
    if after["contact"]:
        assert found.extrapolated[0, 0] == (not after["within_recording"])
        change = after["rel_speed"] / before["rel_speed"]
        assert found.reduction[0, 0] == pytest.approx(1 - change, abs=0.02)
        stopped = all(after[f"speed_{name}"] < 0.5 <= before[f"speed_{name}"] for name in golden["brakes"])
        told = "worsened" if change >= 1.1 else "stopped" if stopped else "mitigated" if change <= 0.9 else "unchanged"
        assert outcome == told
    scan = last_moments(pair_of(paths, [golden["size_A"], golden["size_B"]]), brakers, [golden["deceleration"]])
    expected = golden["expected"]["last_moment"]
    assert np.isfinite(scan.time[0]) == expected["avoidable"]
    assert scan.switches[0] == expected["switches"]
    if expected["avoidable"]:
        assert scan.time[0] == pytest.approx(expected["last_moment"], abs=0.011)
    assert avoids_from(golden, 0.0) == expected["avoids_at_0"]


def avoids_from(golden: Mapping[str, Any], start: float) -> bool:
    """Whether braking from a moment on avoids the contact."""
    pair, starts, deceleration = pair_and_start(golden, braking=True)
    return not contact_made(pair, np.where(np.isfinite(starts), start, np.inf), deceleration)[0]


def test_where_braking_alone_ends(golden: Mapping[str, Any], case: str) -> None:
    expected = golden["expected"]["braking"]
    pair, starts, deceleration = pair_and_start(golden, braking=True)
    for name, motion, start in zip("AB", pair.motions, starts[0], strict=True):
        if name not in golden["brakes"]:
            assert f"stop_s_{name}" not in expected
            continue
        plans = braking_plans(motion, [start], deceleration)
        if np.isinf(plans.starts[0]):
            assert expected.get(f"v_at_brake_{name}") is None
            continue
        assert plans.speeds[0] == pytest.approx(expected[f"v_at_brake_{name}"], abs=0.02)
        assert plans.stop_arcs[0] == pytest.approx(expected[f"stop_s_{name}"], abs=1e-3)
        assert plans.stop_times[0] == pytest.approx(expected[f"stop_t_{name}"], abs=1e-3)
