import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.accidents import impact_of, least_gap, touching_pairs
from deepaccident_devkit.plugins.synth.traffic.simulate import Simulation, separation

THREE_SIZES = np.array([[4.0, 2.0], [4.0, 2.0], [4.0, 2.0]])


def paths(*columns):
    return np.stack([np.array(column, dtype=np.float64) for column in columns], axis=1)


@pytest.mark.parametrize(("beside", "margin", "found"), [(1.9, 0.0, [(0, 1)]), (2.3, 0.0, []), (2.3, 0.4, [(0, 1)])])
def test_those_who_meet_between_two_looks_are_found(beside, margin, found):
    still, x = np.zeros((81, 3)), np.linspace(-8, 8, 81)
    passing = np.stack([x, np.full(81, beside), np.zeros(81)], axis=1)
    assert touching_pairs(paths(still, passing, np.add(still, [50.0, 0, 0])), THREE_SIZES, margin) == found


@pytest.mark.parametrize(("rows", "gap"), [([0, 1], 1.0), ([0, 2], 1.5), ([0], 2.0)])
def test_the_least_gap_is_that_of_the_rows_asked_for(rows, gap):
    poses = paths(*(np.tile([0, y, 0], (3, 1)) for y in (0.0, 3.0, 3.5)))
    assert least_gap(poses, THREE_SIZES, rows, 2.0) == pytest.approx(gap)


SIZE = np.array([[4.0, 2.0], [5.0, 2.0]])


def last_step(first, second, velocities):
    """A simulation of two steps that ends with poses, each reached at a velocity."""
    velocity, states = np.array(velocities, dtype=np.float64), np.zeros((2, 2, 5))
    states[:, :, :3] = np.array([first, second])
    states[0, :, :2] -= 0.02 * velocity
    return Simulation(time=np.array([1.0, 1.02]), states=states, velocities=np.stack([velocity, velocity]), contact=1)


@pytest.mark.parametrize(
    ("second", "velocities", "words"),
    [
        ((4.4, 0.0, np.pi), ((8, 0), (-8, 0)), ("opposite", "front")),
        ((-4.4, 0.0, 0.0), ((2, 0), (10, 0)), ("same", "rear")),
        ((0.5, 3.4, -np.pi / 2), ((0, 0), (0, -8)), ("same", "front_side")),
        ((-0.5, -3.4, np.pi / 2), ((0, 0), (0, 8)), ("same", "rear_side")),
    ],
)
def test_meta_s_words_of_the_impact(second, velocities, words):
    impact = impact_of(last_step((0, 0, 0), second, velocities), (0, 1), SIZE)
    assert (impact.relation, impact.side) == words


def test_the_boxes_just_touch_at_its_time():
    run = last_step((0, 0, 0), (4.4, 0.0, np.pi), ((8, 0), (-8, 0)))
    impact = impact_of(run, (0, 1), SIZE)
    poses = run.poses[0] + (impact.time - 1.0) / 0.02 * (run.poses[1] - run.poses[0])
    assert separation(poses[0], SIZE[0], poses[1], SIZE[1]) == pytest.approx(0.0, abs=1e-6)
    assert (impact.time, impact.strength) == pytest.approx((1.02 - 0.1 / 16, 60 * 8 * 16))
