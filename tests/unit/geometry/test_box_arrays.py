"""Time to collision: by hand, and as golden safety/surrogates has it (brute force at 1 ms, up to 20
s).
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit.geometry.box_arrays import time_to_collision

EAST = [10.0, 0.0]
CAR = [0.0, 0.0, 4.0, 2.0, 0.0]
AHEAD = [24.0, 0.0, 4.0, 2.0, 0.0]


def seconds(first, second, first_velocity, second_velocity) -> float:
    arrays = (
        np.array([each], dtype=np.float64)
        for each in (first, second, first_velocity, second_velocity)
    )
    return time_to_collision(*arrays).item()


@pytest.mark.parametrize(
    ("other", "velocity", "other_velocity", "expected"),
    [
        (AHEAD, EAST, [0.0, 0.0], 2.0),
        (AHEAD, EAST, [5.0, 0.0], 4.0),
        (AHEAD, EAST, EAST, math.inf),
        (AHEAD, [0.0, 0.0], EAST, math.inf),
        ([24.0, 2.5, 4.0, 2.0, 0.0], EAST, [0.0, 0.0], math.inf),  # beside it
        ([13.0, -13.0, 4.0, 2.0, math.pi / 2], EAST, [0.0, 10.0], 1.0),  # on a crossing path
    ],
)
def test_a_car_needs_the_gap_at_its_closing_speed(
    other: list[float], velocity: list[float], other_velocity: list[float], expected: float
) -> None:
    assert seconds(CAR, other, velocity, other_velocity) == pytest.approx(expected)


def test_boxes_that_touch_now_have_no_time() -> None:
    assert seconds(CAR, [3.0, 1.0, 4.0, 2.0, 0.3], [0.0, 0.0], [0.0, 0.0]) == 0
    assert time_to_collision(*(np.zeros((0, width)) for width in (5, 5, 2, 2))).shape == (0,)


def test_as_brute_force_has_it(pytestconfig: pytest.Config) -> None:
    golden = json.loads(
        (Path(pytestconfig.getoption("golden")) / "safety" / "surrogates.json").read_text(
            encoding="utf-8"
        )
    )
    given = {name: np.array(values) for name, values in golden["inputs"].items() if name != "kind"}
    sides = [
        (
            np.stack(
                [given[f"{part}_{side}"] for part in ("x", "y", "length", "width", "yaw")], axis=1
            ),
            given[f"speed_{side}"][:, None]
            * np.stack([np.cos(given[f"yaw_{side}"]), np.sin(given[f"yaw_{side}"])], axis=1),
        )
        for side in "ij"
    ]
    found = time_to_collision(sides[0][0], sides[1][0], sides[0][1], sides[1][1])
    expected = np.array(golden["expected"]["ttc_2d"], dtype=np.float64)
    assert len(expected) == 200
    np.testing.assert_allclose(np.where(found > 20, np.inf, found), expected, atol=1e-6)
