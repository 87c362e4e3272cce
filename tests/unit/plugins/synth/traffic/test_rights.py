import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.accidents import touching_pairs
from deepaccident_devkit.plugins.synth.traffic.rights import find_rights
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate


def sizes(users):
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
    rights = find_rights([driver(*first), driver(*second)], minor=minor)
    assert (rights.waits[0, 1], rights.waits[1, 0]) == waits


def test_a_rule_that_is_ignored_does_not_count(driver, walker):
    rights = find_rights(
        [driver("south", ignores=("priority",)), driver("west"), walker()], minor=("south", "north")
    )
    assert rights.waits[0].tolist() == [False, False, True]


def test_a_blind_pair_sees_nobody_but_who_is_on_its_arm(driver):
    rights = find_rights(
        [driver("south"), driver("west"), driver("south", before=60.0), driver("east")],
        blind=(0, 1),
    )
    assert rights.sees[:2].tolist() == [[False, False, True, False], [False] * 4]
    assert rights.waits[3].tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    "other", [("east", "straight"), ("north", "straight"), ("west", "straight")]
)
@pytest.mark.parametrize("before", [20.0, 30.0, 45.0])
def test_one_who_has_to_wait_lets_the_other_pass(driver, other, before):
    mine = (
        ("east" if other[0] == "west" else "west", "left")
        if other[0] != "north"
        else ("west", "straight")
    )
    users = [driver(*mine, before=30.0), driver(*other, before=before)]
    minor = ("west", "east") if other[0] == "north" else ()
    run = simulate(users, begin=0.0, end=12.0, rights=find_rights(users, minor=minor))
    assert (touching_pairs(run.poses, sizes(users), 0.1), run.states[:, 1, 3].min() > 6.0) == (
        [],
        True,
    )
    assert users[0].path.project(run.poses[-1:, 0, :2])[0][0] > users[0].route.exit_s - 5.0


def test_one_on_foot_is_let_over_the_road(driver, walker):
    users = [driver("west", before=35.0), walker()]
    run = simulate(users, begin=0.0, end=20.0, rights=find_rights(users))
    assert (touching_pairs(run.poses, sizes(users), 0.3), run.states[:, 0, 3].min() < 5.0) == (
        [],
        True,
    )
    assert users[0].path.project(run.poses[-1:, 0, :2])[0][0] > users[0].route.exit_s


def test_one_on_foot_does_not_step_before_a_car_that_cannot_stop(driver, walker):
    users = [driver("west", before=2.0, speed=10.0), walker(start=(-12.0, -4.3), delay=0.0)]
    assert not touching_pairs(
        simulate(users, begin=0.0, end=4.0, rights=find_rights(users)).poses, sizes(users), 0.1
    )
