import numpy as np
import pytest

from deepaccident_devkit.synth.traffic.approach import drive_alone
from deepaccident_devkit.synth.traffic.simulate import simulate


@pytest.mark.parametrize("turn", ["straight", "left", "right"])
def test_it_is_what_the_simulation_does_without_others(driver, turn):
    user = driver(turn=turn, before=90.0, speed=0.0)
    approach = drive_alone(user)
    run = simulate([user], begin=0.0, end=18.0)
    along, _ = user.path.project(run.poses[:, 0, :2])
    np.testing.assert_allclose(approach.along[: len(along)], along, atol=0.25)
    np.testing.assert_allclose(approach.speed[: len(along)], run.states[:, 0, 3], atol=0.15)


def test_one_set_on_its_way_comes_to_the_place_in_time(driver):
    user = driver(before=90.0, speed=0.0)
    approach = drive_alone(user)
    time = approach.time_to(user.route.enter_s)
    started = approach.at(time - 4.0)
    run = simulate([started], begin=0.0, end=4.0)
    along, _ = user.path.project(run.poses[-1:, 0, :2])
    assert along[0] == pytest.approx(user.route.enter_s, abs=0.3)


def test_before_its_start_it_waits_or_comes_from_farther_back(driver):
    standing, moving = driver(speed=0.0), driver(speed=5.0)
    waiting = drive_alone(standing).at(-2.0)
    assert (waiting.delay, waiting.start, waiting.start_speed) == (2.0, standing.start, 0.0)
    assert drive_alone(moving).at(-2.0).start == pytest.approx(moving.start - 10.0)
