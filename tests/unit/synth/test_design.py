import numpy as np
import pytest

from deepaccident_devkit.synth.collision import gap, separation
from deepaccident_devkit.synth.design import footprint, random_encounter
from deepaccident_devkit.taxonomy import VEHICLE_AGENTS

EGO, EGO_BEHIND, OTHER, OTHER_BEHIND = VEHICLE_AGENTS


def _pair(encounter, motions, times, first=EGO, second=OTHER):
    poses = [motions[agent].poses(times) for agent in (first, second)]
    sizes = [footprint(encounter.bodies[agent]) for agent in (first, second)]
    return poses[0], sizes[0], poses[1], sizes[1]


@pytest.fixture(params=range(20))
def encounter(request):
    duration = 0.1 * [39, 99, 998, 1, 0][request.param % 5]
    return random_encounter(np.random.default_rng(request.param), duration)


def test_first_contact_is_at_the_last_frame(encounter):
    before = np.arange(encounter.end_time - 20, encounter.end_time - 1e-3, 0.01)
    assert 0 <= separation(*_pair(encounter, encounter.accident, [encounter.end_time]))[0] < 1e-6
    assert separation(*_pair(encounter, encounter.accident, [encounter.end_time + 0.01]))[0] < 0
    assert gap(*_pair(encounter, encounter.accident, before)).min() > 0
    assert gap(*_pair(encounter, encounter.accident, [encounter.end_time - 0.1]))[0] > 0.3


def test_nobody_else_touches_before_the_contact(encounter):
    times = np.arange(0, encounter.end_time, 0.02)
    for first, second in [(EGO, EGO_BEHIND), (OTHER, OTHER_BEHIND), (EGO, OTHER_BEHIND), (EGO_BEHIND, OTHER)]:
        assert (gap(*_pair(encounter, encounter.accident, times, first, second)) > 0.5).all()


def test_twins_pass_with_two_metres(encounter):
    times = np.arange(0, encounter.end_time + 3.9, 0.02)
    for first in (EGO, EGO_BEHIND):
        for second in (OTHER, OTHER_BEHIND):
            assert gap(*_pair(encounter, encounter.normal, times, first, second)).min() > 2


def test_other_comes_from_the_side_that_is_named(encounter):
    start = encounter.accident[OTHER].poses([-1e3])[0]
    assert (start[1] > 30) == (encounter.spawn_side == "left")
    assert (start[1] < -30) == (encounter.spawn_side == "right")


def test_both_sides_occur():
    sides = {random_encounter(np.random.default_rng(seed), 3.9).spawn_side for seed in range(10)}
    assert sides == {"left", "right"}


def test_velocities_are_the_poses_slopes(encounter):
    motion, times = encounter.accident[EGO], np.linspace(encounter.end_time - 15, encounter.end_time, 400)
    slope = (motion.poses(times + 1e-4) - motion.poses(times - 1e-4))[:, :2] / 2e-4
    np.testing.assert_allclose(motion.velocities(times), slope, atol=2e-3)
