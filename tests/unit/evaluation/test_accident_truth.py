"""What happens after a sample: whose boxes come near, and what constant velocities lead to."""

import math
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation.accident_truth import BoxTruth, box_truth, constant_velocity_alarms
from deepaccident_devkit.geometry import Boxes

GONE, FAR, AWAY = (math.nan, math.nan), (90.0, 90.0), (-90.0, 90.0)
MOVING = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
Path = list[tuple[float, float]]


def truth_of(*paths: Path, **columns: Any) -> BoxTruth:
    """Cars of 4 m × 2 m that look ahead, by their places at each tenth of a second; ids 10, 20, …"""
    center = np.array(paths, dtype=np.float64).swapaxes(0, 1)
    footprint = np.concatenate([center, np.broadcast_to([4.0, 2.0, 0.0], (*center.shape[:2], 3))], axis=2)
    ids, time = np.arange(1, len(paths) + 1) * 10, np.arange(len(center)) / 10
    return BoxTruth(time=time, footprint=footprint, accident=None, actor_id=ids, **columns)


@pytest.mark.parametrize(
    ("paths", "pair"),
    [
        ([[(0, 0)] * 3, [(0, 2), (0, 2.49), (0, 2)]], None),  # both stand, but for less than half a metre
        ([[(0, 0)] * 3, [(0, 2), (0, 2.5), (0, 2)]], (10, 20)),
        ([MOVING, [(0, 3), (1, 3), (2, 3)]], None),  # exactly a metre
        ([MOVING, [(0, 3), (1, 2.9), (2, 3)]], (10, 20)),
        ([MOVING, [(0, 2.9), FAR, FAR], [AWAY, AWAY, (2, 2.2)]], (10, 30)),  # the nearest
        ([MOVING, [FAR, FAR, (2, 2.5)], [AWAY, (1, 2.5), AWAY]], (10, 30)),  # the earliest
        ([MOVING, [FAR, (1, 2.5), FAR], [AWAY, (1, -2.5), AWAY]], (10, 20)),  # the first
        ([MOVING, [GONE, (1, 2.5), GONE]], (10, 20)),
        ([MOVING], None),
    ],
)
def test_the_two_that_come_nearest(paths: list[Path], pair: tuple[int, int] | None) -> None:
    assert truth_of(*paths).nearest_pair(1.0) == pair


def test_tracks_end_with_the_window() -> None:
    truth = truth_of([(float(frame), 0.0) for frame in range(6)])
    for seconds, places in ((0.25, [0, 2, 5]), (0.3, [0, 3, math.nan])):
        np.testing.assert_array_equal(truth.tracks(seconds, 3).center[:, 0, 0], places)


@pytest.mark.parametrize(("unplaced", "said"), [(None, False), (2.05, True), (2.06, False), (0.0, True)])
def test_an_unplaced_accident_comes_within_half_a_frame_of_the_horizon(unplaced: float | None, said: bool) -> None:
    assert truth_of(MOVING, horizon=2.0, unplaced=unplaced).is_unplaced is said


@pytest.mark.parametrize(
    ("rows", "names", "own", "alarms"),
    [
        ([(0, 0, 2), (9.8, 0, 0)], {}, None, [(2.9, (1, 2))]),
        ([(0, 0, 2), (10, 0, 0)], {}, None, []),  # in 3 s
        ([(0, 0, 0.1), (4.1, 0, 0)], {}, None, [(1, (1, 2))]),
        ([(0, 0, 0.09), (4.1, 0, 0)], {}, None, []),  # too slow
        ([(0, 0, math.nan), (4.1, 0, -1)], {}, None, [(0.1, (1, 2))]),
        ([(0, 0, 2), (8, 0, 0), (0, 50, 1), (5, 50, 0)], {4: 44, 3: None}, None, [(1, None), (2, (1, 2))]),
        ([(0, 0, 2), (8, 0, 0), (0, 50, 1), (5, 50, 0)], {}, 4, [(1, (3, 4))]),
        ([(0, 0, 2), (8, 0, 0), (0, 50, 1), (5, 50, 0)], {2: 99}, 99, [(2, (1, 99))]),
    ],
)
def test_alarms_of_constant_velocities(
    rows: Path, names: dict[int, int | None], own: int | None, alarms: list[tuple[float, Any]]
) -> None:
    """Of cars at x, y with a speed ahead each; ids 1, 2, …"""
    x, y, speed = np.array(rows, dtype=np.float64).T
    center, velocity = (np.stack([each, other, y * 0], axis=1) for each, other in ((x, y), (speed, y * 0)))
    ids = np.arange(1, len(x) + 1)
    boxes = Boxes.from_arrays(
        center, np.tile([4.0, 2.0, 1.5], (len(x), 1)), x * 0, frame="ego", velocity=velocity, actor_id=ids
    )
    found = constant_velocity_alarms(boxes, names, own)
    assert [(pytest.approx(each.time), each.ids) for each in found] == alarms
    assert [each.score for each in found] == pytest.approx([1 - time / 3 for time, _ in alarms])
    assert all(each.positions[1, 0] - each.positions[0, 0] == pytest.approx(4) for each in found)


def test_the_horizon_that_is_not_given_is_of_2_seconds(da_motion: DeepAccident) -> None:
    truth = box_truth(da_motion, f"{da_motion.scenario[0]['token']}/ego_vehicle/010")
    assert (truth.horizon, len(truth.time), truth.time[-1]) == (2.0, 21, pytest.approx(2.0))
