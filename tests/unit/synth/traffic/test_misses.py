"""What is said about draws without a collision."""

import numpy as np
import pytest

from deepaccident_devkit.synth.traffic.casting import WARM_UP
from deepaccident_devkit.synth.traffic.impact import Arrival, Miss, by_far, measured_miss, misses_text
from deepaccident_devkit.synth.traffic.simulate import simulate

ROLES = ("ego", "background")


def arrival(role, time, *, late=0.0, came=True):
    return Arrival(role=role, time=time, came=came, late=late)


NEAR = Miss(gap=1.5, arrivals=(arrival("ego", 6.0), arrival("background", 7.0, late=0.6)))
FAR = Miss(gap=20.0, arrivals=(arrival("ego", 6.0), arrival("background", 8.0, came=False)))


def test_the_nearest_draw_is_told():
    assert misses_text([FAR, NEAR], ROLES) == (
        "ego and background did not collide in 2 draws; the least distance was 1.5 m, where they came to the "
        "crossing of their paths: ego at 6.0 s and background at 7.0 s; background came 0.5 s or more later than "
        "planned in 1 of the draws; choose a meet.offset nearer to 0, or another max_speed for one of the two"
    )
    assert "background not before 8.0 s" in misses_text([FAR], ROLES)


@pytest.mark.parametrize(
    ("misses", "remedy"),
    [
        ([NEAR, NEAR, FAR], "others are in the way of background: choose fewer background.vehicles, or another lane"),
        ([Miss(), Miss(), NEAR], "their paths do not cross: change from, turn or side of one of them"),
        ([Miss(gap=0.0, touched=("other", "parked"))] * 2, "let those who touched start farther apart"),
    ],
)
def test_the_commonest_cause_decides_what_to_change(misses, remedy):
    assert remedy in misses_text(misses, ROLES).rpartition("; ")[2]


def test_others_who_touched_are_named():
    text = misses_text([Miss(gap=0.0, touched=("other", "parked")), NEAR], ROLES)
    assert "; in 1 of the draws others touched before, such as other and parked; " in text


def test_a_miss_is_by_far_if_all_are():
    assert by_far([FAR, Miss()])
    assert not by_far([FAR, NEAR])
    assert not by_far([FAR, Miss(gap=0.0, touched=("other", "parked"))])


def test_a_miss_is_measured(driver):
    """One crosses 10 m/s fast after 20 m, the other one starts so late that it is still on its way."""
    users = [driver("west", before=20.0, speed=10.0), driver("south", before=60.0, speed=10.0)]
    run = simulate(users, begin=-3.0, end=2.0)
    miss = measured_miss(run, (0, 1), users, planned=(-1.0, 0.0))
    one, other = miss.arrivals
    place = np.hypot(*run.poses[:, 0, :2].T).argmin()
    assert one.came
    assert one.time == pytest.approx(run.time[place] + 3.0 - WARM_UP, abs=0.5)
    assert one.late == pytest.approx(one.time - 3.0 + WARM_UP + 1.0)
    assert (other.came, other.time, other.late) == (False, pytest.approx(5.0 - WARM_UP), 2.0)
    assert 5 < miss.gap < 60


def test_paths_that_do_not_cross_are_infinitely_far(driver):
    users = [driver("west"), driver("east")]
    assert measured_miss(simulate(users, begin=0.0, end=0.1), (0, 1), users, planned=(0.0, 0.0)) == Miss()
