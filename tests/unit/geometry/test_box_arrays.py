"""Time to collision by hand, and as in the golden safety/surrogates (brute force at 1 ms, up to 20
s).
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit.geometry.box_arrays import corner_offsets, time_to_collision

EAST_M_S = [10.0, 0.0]
STANDING = [0.0, 0.0]
CAR = [0.0, 0.0, 4.0, 2.0, 0.0]
CAR_AHEAD = [24.0, 0.0, 4.0, 2.0, 0.0]


def time_to_collision_s(first, second, first_velocity, second_velocity) -> float:
    pair = (first, second, first_velocity, second_velocity)
    return time_to_collision(*(np.array([row], dtype=np.float64) for row in pair)).item()


@pytest.mark.parametrize(
    ("other", "velocity", "other_velocity", "expected"),
    [
        (CAR_AHEAD, EAST_M_S, STANDING, 2.0),
        (CAR_AHEAD, EAST_M_S, [5.0, 0.0], 4.0),
        (CAR_AHEAD, EAST_M_S, EAST_M_S, math.inf),
        (CAR_AHEAD, STANDING, EAST_M_S, math.inf),
        ([24.0, 2.5, 4.0, 2.0, 0.0], EAST_M_S, STANDING, math.inf),  # beside it
        ([13.0, -13.0, 4.0, 2.0, math.pi / 2], EAST_M_S, [0.0, 10.0], 1.0),  # on a crossing path
    ],
)
def test_a_car_needs_the_gap_at_its_closing_speed(
    other: list[float], velocity: list[float], other_velocity: list[float], expected: float
) -> None:
    assert time_to_collision_s(CAR, other, velocity, other_velocity) == pytest.approx(expected)


def test_boxes_that_touch_now_have_no_time() -> None:
    touching = [3.0, 1.0, 4.0, 2.0, 0.3]
    no_pairs = [np.zeros((0, width)) for width in (5, 5, 2, 2)]
    assert time_to_collision_s(CAR, touching, STANDING, STANDING) == 0
    assert time_to_collision(*no_pairs).shape == (0,)


def test_times_agree_with_brute_force(pytestconfig: pytest.Config) -> None:
    path = Path(pytestconfig.getoption("golden")) / "safety" / "surrogates.json"
    golden = json.loads(path.read_text(encoding="utf-8"))
    inputs = {name: np.array(values) for name, values in golden["inputs"].items() if name != "kind"}
    boxes = {}
    velocities = {}
    for side in "ij":
        columns = [inputs[f"{name}_{side}"] for name in ("x", "y", "length", "width", "yaw")]
        yaw = columns[-1]
        heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        boxes[side] = np.stack(columns, axis=1)
        velocities[side] = inputs[f"speed_{side}"][:, None] * heading

    times_s = time_to_collision(boxes["i"], boxes["j"], velocities["i"], velocities["j"])
    expected_s = np.array(golden["expected"]["ttc_2d"], dtype=np.float64)
    assert len(expected_s) == 200
    np.testing.assert_allclose(np.where(times_s > 20, np.inf, times_s), expected_s, atol=1e-6)


def test_corners_turn_with_the_footprint() -> None:
    """A 4 m × 2 m footprint that points a 3-4-5 triangle's angle to the left of x."""
    footprint = np.array([7.0, -3.0, 4.0, 2.0, np.arctan2(3, 4)])
    front_left, rear_left = [1.0, 2.0], [-2.2, -0.4]
    expected = [front_left, rear_left, [-1.0, -2.0], [2.2, 0.4]]
    np.testing.assert_allclose(corner_offsets(footprint), expected, atol=1e-12)
