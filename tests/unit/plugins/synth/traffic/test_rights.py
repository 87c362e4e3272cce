import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.accidents import touching_pairs
from deepaccident_devkit.plugins.synth.traffic.rights import find_rights
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate


def sizes_of(users):
    return np.array([user.body.size[:2] for user in users])


@pytest.mark.parametrize(
    ("first", "second", "minor", "waits"),
    [
        (("south", "straight"), ("west", "straight"), ("south", "north"), (True, False)),
        (("west", "left"), ("east", "straight"), (), (True, False)),
        (("west", "left"), ("east", "right"), (), (True, False)),
        (("west", "left"), ("east", "left"), (), (False, False)),
        (("west", "straight"), ("south", "straight"), (), (False, False)),
    ],
)
def test_who_waits(driver, first, second, minor, waits):
    rights = find_rights(
        [driver(*first), driver(*second)],
        minor=minor,
    )
    assert rights.waits[0, 1] == waits[0]
    assert rights.waits[1, 0] == waits[1]


def test_a_rule_that_is_ignored_does_not_count(driver, walker):
    users = [driver("south", ignores=("priority",)), driver("west"), walker()]
    rights = find_rights(users, minor=("south", "north"))
    assert rights.waits[0].tolist() == [False, False, True]


def test_a_blind_pair_sees_only_road_users_on_its_own_arm(driver):
    users = [
        driver("south"),
        driver("west"),
        driver("south", before=60.0),
        driver("east"),
    ]
    rights = find_rights(users, blind=(0, 1))
    assert rights.sees[:2].tolist() == [[False, False, True, False], [False] * 4]
    assert rights.waits[3].tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("waiting", "passing", "minor"),
    [
        (("west", "left"), ("east", "straight"), ()),
        (("west", "straight"), ("north", "straight"), ("west", "east")),
        (("east", "left"), ("west", "straight"), ()),
    ],
)
@pytest.mark.parametrize("before", [20.0, 30.0, 45.0])
def test_a_driver_that_has_to_wait_lets_the_other_pass(driver, waiting, passing, minor, before):
    users = [driver(*waiting, before=30.0), driver(*passing, before=before)]
    run = simulate(users, begin=0.0, end=12.0, rights=find_rights(users, minor=minor))
    assert touching_pairs(run.poses, sizes_of(users), 0.1) == []
    assert run.states[:, 1, 3].min() > 6.0

    along, _ = users[0].path.project(run.poses[-1:, 0, :2])
    assert along[0] > users[0].route.exit_s - 5.0


def test_a_pedestrian_is_let_over_the_road(driver, walker):
    users = [driver("west", before=35.0), walker()]
    run = simulate(users, begin=0.0, end=20.0, rights=find_rights(users))
    assert touching_pairs(run.poses, sizes_of(users), 0.3) == []
    assert run.states[:, 0, 3].min() < 5.0

    along, _ = users[0].path.project(run.poses[-1:, 0, :2])
    assert along[0] > users[0].route.exit_s


def test_a_pedestrian_does_not_step_before_a_car_that_cannot_stop(driver, walker):
    users = [
        driver("west", before=2.0, speed=10.0),
        walker(start=(-12.0, -4.3), delay=0.0),
    ]
    run = simulate(users, begin=0.0, end=4.0, rights=find_rights(users))
    assert not touching_pairs(run.poses, sizes_of(users), 0.1)
