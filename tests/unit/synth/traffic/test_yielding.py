import numpy as np
import pytest

from deepaccident_devkit.synth.traffic.rights import find_rights
from deepaccident_devkit.synth.traffic.yielding import waiting_gap


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


@pytest.mark.parametrize(("before", "waits"), [(25.0, True), (120.0, False)])
def test_it_waits_for_one_who_is_near_and_not_for_one_who_is_far(driver, before, waits):
    assert np.isfinite(gap_of_the_first([driver("south", before=10.0), driver("west", before=before)])) == waits


def test_it_does_not_wait_for_one_whom_a_red_light_holds(driver):
    users = [driver("south", before=10.0), driver("west", before=25.0)]
    assert np.isfinite(gap_of_the_first(users))
    assert np.isinf(gap_of_the_first(users, held=True))


@pytest.mark.parametrize(("fastest", "waits"), [(1.2, False), (5.0, True)])
def test_it_knows_how_fast_the_other_can_get_there(driver, walker, fastest, waits):
    """One who walks sets off 8 m away while a standing car has 10 m to go: it is out of the way in time."""
    users = [
        driver("west", before=1.0, speed=2.0),
        walker(start=(-11.0, 9.0), yaw=-np.pi / 2, length=18.0, start_speed=0.0, max_speed=fastest),
    ]
    assert np.isfinite(gap_of_the_first(users)) == waits


def test_it_counts_on_the_other_s_present_speed(driver):
    """One who creeps through the crossing is not gone soon, though it might speed up."""
    mine = driver("south", before=30.0, speed=6.0)
    creeping, driving = (driver("west", before=-6.0, speed=speed) for speed in (1.0, 10.0))
    assert np.isfinite(gap_of_the_first([mine, creeping]))
    assert np.isinf(gap_of_the_first([mine, driving]))
