import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.driving import (
    Temper,
    can_stop,
    free_acceleration,
    hardest_braking,
    interaction,
)
from deepaccident_devkit.plugins.synth.traffic.rights import find_rights
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate

ONE = np.ones(1)
TEMPER = Temper(
    max_speed=10 * ONE, acceleration=2 * ONE, braking=2.5 * ONE, slowing=4 * ONE, time_gap=ONE, min_gap=2 * ONE
)


@pytest.mark.parametrize(
    ("speed", "bend", "expected"),
    [(0, np.inf, 2.0), (10, np.inf, 0.0), (8, 7.5, -1.25), (8, 1, -4.0)],
    ids=["it speeds up", "it keeps its speed", "it slows down for a bend", "but not without limit"],
)
def test_a_free_driver(speed, bend, expected):
    assert free_acceleration(TEMPER, speed * ONE, bend * ONE)[0] == pytest.approx(expected)
    assert free_acceleration(TEMPER, 12 * ONE, bend * ONE)[0] < 0


def test_a_slower_leader_asks_for_more_braking_than_a_faster_one():
    slow, fast = (interaction(TEMPER, 8 * ONE, 15 * ONE, speed * ONE)[0] for speed in (2, 10))
    assert slow < fast < 0


def test_nobody_brakes_hard_at_walking_pace():
    hardest = hardest_braking(np.array([0.0, 1.0, 10.0]))
    assert hardest[0] < hardest[1] < 5.0
    assert hardest[2] == 8.0


@pytest.mark.parametrize(("metres", "possible"), [(20, True), (10, False)])
def test_whether_one_can_stop(metres, possible):
    assert can_stop(TEMPER, 10 * ONE, metres * ONE)[0] == possible


def test_a_follower_stands_behind_a_standing_one(driver):
    users = [driver(before=5.0, speed=0.0, delay=100.0), driver(before=60.0)]
    run = simulate(users, begin=0.0, end=15.0, rights=find_rights(users))
    gap = run.poses[-1, 0, 0] - run.poses[-1, 1, 0] - (users[0].body.size[0] + users[1].body.size[0]) / 2
    assert (run.states[-1, 1, 3] < 0.05, 1.5 < gap < 3.0) == (True, True)
    assert (np.diff(run.states[:, 1, 3]) / 0.02).min() > -4.0
