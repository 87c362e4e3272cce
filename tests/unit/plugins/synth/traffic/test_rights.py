import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.accidents import touching_pairs
from deepaccident_devkit.plugins.synth.traffic.rights import find_rights, find_zones, waiting_gap
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate


def sizes(users):
    return np.array([user.body.size[:2] for user in users])


def test_zones_are_where_the_lanes_cross(driver):
    users = [driver("west"), driver("south")]
    paths, spans = [user.path for user in users], [user.span for user in users]
    zones = find_zones(paths, spans, sizes(users)[:, 1], np.zeros((2, 2), dtype=bool))
    for i, j in ((0, 1), (1, 0)):
        enter, leave = zones.enter[i, j], zones.leave[i, j]
        np.testing.assert_allclose(paths[i].at((enter + leave) / 2)[:2], [1.75, -1.75], atol=0.5)
        assert 3.0 < leave - enter < 6.0
    assert np.isinf(zones.enter[0, 0])


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


def test_drivers_wait_for_walkers_but_not_the_reverse_and_walkers_pass_each_other(driver, walker):
    rights = find_rights([driver(), walker(), walker()])
    assert (rights.waits[0, 1], rights.waits[1, 0]) == (True, False)
    assert np.isinf(rights.zones.enter[1:, 1:]).all()


def test_a_rule_that_is_ignored_does_not_count(driver, walker):
    rights = find_rights([driver("south", ignores=("priority",)), driver("west"), walker()], minor=("south", "north"))
    assert rights.waits[0].tolist() == [False, False, True]


def test_a_blind_pair_sees_nobody_but_who_is_on_its_arm(driver):
    rights = find_rights([driver("south"), driver("west"), driver("south", before=60.0), driver("east")], blind=(0, 1))
    assert rights.sees[:2].tolist() == [[False, False, True, False], [False] * 4]
    assert rights.waits[3].tolist() == [True, True, False, False]


@pytest.mark.parametrize("other", [("east", "straight"), ("north", "straight"), ("west", "straight")])
@pytest.mark.parametrize("before", [20.0, 30.0, 45.0])
def test_one_who_has_to_wait_lets_the_other_pass(driver, other, before):
    mine = ("east" if other[0] == "west" else "west", "left") if other[0] != "north" else ("west", "straight")
    users = [driver(*mine, before=30.0), driver(*other, before=before)]
    minor = ("west", "east") if other[0] == "north" else ()
    run = simulate(users, begin=0.0, end=12.0, rights=find_rights(users, minor=minor))
    assert (touching_pairs(run.poses, sizes(users), 0.1), run.states[:, 1, 3].min() > 6.0) == ([], True)
    assert users[0].path.project(run.poses[-1:, 0, :2])[0][0] > users[0].route.exit_s - 5.0


def test_one_on_foot_is_let_over_the_road(driver, walker):
    users = [driver("west", before=35.0), walker()]
    run = simulate(users, begin=0.0, end=20.0, rights=find_rights(users))
    assert (touching_pairs(run.poses, sizes(users), 0.3), run.states[:, 0, 3].min() < 5.0) == ([], True)
    assert users[0].path.project(run.poses[-1:, 0, :2])[0][0] > users[0].route.exit_s


def test_one_on_foot_does_not_step_before_a_car_that_cannot_stop(driver, walker):
    users = [driver("west", before=2.0, speed=10.0), walker(start=(-12.0, -4.3), delay=0.0)]
    assert not touching_pairs(simulate(users, begin=0.0, end=4.0, rights=find_rights(users)).poses, sizes(users), 0.1)


def gap_of_the_first(users, *, held=False):
    """Metres to where the first of two has to stop for the second."""
    start = np.array([user.start for user in users])
    half = np.array([user.body.size[0] for user in users]) / 2
    speed, top = (np.array([getattr(user, name) for user in users]) for name in ("start_speed", "max_speed"))
    rights = find_rights(users, minor=("south", "north"))
    return waiting_gap(rights, start + half, start - half, speed, top, np.array([False, held]))[0]


def test_it_stops_a_little_before_the_other_s_way(driver):
    users = [driver("south", before=10.0), driver("west", before=25.0)]
    front = users[0].start + users[0].body.size[0] / 2
    to_zone = find_rights(users, minor=("south", "north")).zones.enter[0, 1] - front
    assert 0.5 < to_zone - gap_of_the_first(users) < 2.0


@pytest.mark.parametrize(
    ("mine", "other", "held", "waits"),
    [
        ({"before": 10.0}, {"before": 25.0}, False, True),
        ({"before": 10.0}, {"before": 25.0}, True, False),  # a red light holds it
        ({"before": 10.0}, {"before": 120.0}, False, False),
        # who creeps through the crossing is not gone soon, though it might speed up
        ({"before": 30.0, "speed": 6.0}, {"before": -6.0, "speed": 1.0}, False, True),
        ({"before": 30.0, "speed": 6.0}, {"before": -6.0, "speed": 10.0}, False, False),
    ],
)
def test_it_waits_for_one_who_is_near_not_far_nor_held_nor_soon_gone(driver, mine, other, held, waits):
    assert np.isfinite(gap_of_the_first([driver("south", **mine), driver("west", **other)], held=held)) == waits


@pytest.mark.parametrize(("fastest", "waits"), [(1.2, False), (5.0, True)])
def test_it_knows_how_fast_the_other_can_get_there(driver, walker, fastest, waits):
    """One who walks sets off 8 m away while a standing car has 10 m to go: it is out of the way in time."""
    users = [
        driver("west", before=1.0, speed=2.0),
        walker(start=(-11.0, 9.0), yaw=-np.pi / 2, length=18.0, start_speed=0.0, max_speed=fastest),
    ]
    assert np.isfinite(gap_of_the_first(users)) == waits
