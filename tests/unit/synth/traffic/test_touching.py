import numpy as np
import pytest

from deepaccident_devkit.synth.traffic.touching import least_gap, touching_pairs

SIZE = np.array([[4.0, 2.0], [4.0, 2.0], [4.0, 2.0]])


def paths(*columns):
    return np.stack([np.array(column, dtype=np.float64) for column in columns], axis=1)


def test_those_who_meet_between_two_looks_are_found():
    x = np.linspace(-8, 8, 81)
    still, passing = np.zeros((81, 3)), np.stack([x, np.full(81, 1.9), np.zeros(81)], axis=1)
    far = still + np.array([50.0, 0, 0])
    assert touching_pairs(paths(still, passing, far), SIZE, 0.0) == [(0, 1)]
    passing[:, 1] = 2.3
    assert touching_pairs(paths(still, passing, far), SIZE, 0.0) == []
    assert touching_pairs(paths(still, passing, far), SIZE, 0.4) == [(0, 1)]


def test_the_least_gap_is_that_of_the_rows_asked_for():
    still = np.zeros((3, 3))
    beside, farther = (still + np.array([0, y, 0]) for y in (3.0, 3.5))
    poses = paths(still, beside, farther)
    assert least_gap(poses, SIZE, [0, 1], 2.0) == pytest.approx(1.0)
    assert least_gap(poses, SIZE, [0, 2], 2.0) == pytest.approx(1.5)
    assert least_gap(poses, SIZE, [0], 2.0) == 2.0
