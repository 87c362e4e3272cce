import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.driving import Tracks
from deepaccident_devkit.plugins.synth.traffic.simulate import Bodies, ContactAlarm, leaders

SEES = ~np.eye(2, dtype=bool)


def look(users, sees=SEES):
    """Gaps and leaders' speeds of two users where they start."""
    starts = np.array([user.start for user in users])
    tracks = Tracks([user.path for user in users], np.full(2, 3.0), np.zeros(2, dtype=bool))
    length, width, _ = np.array([user.body.size for user in users]).T
    speed = np.array([user.start_speed for user in users])
    return leaders(Bodies(poses=tracks.at(starts)[:3].T, speed=speed, length=length, width=width), tracks, starts, sees)


def test_the_gap_is_from_bumper_to_bumper(driver):
    users = [driver(before=30.0), driver(before=18.0, speed=5.0)]
    gap, speed = look(users)
    assert (*gap, speed[0]) == pytest.approx((12.0 - users[1].body.size[0], np.inf, 5.0), abs=1e-6)


@pytest.mark.parametrize(
    ("arms", "before", "sees"),
    [(("west", "east"), (5.0, 5.0), SEES), (("west", "west"), (30.0, 18.0), np.zeros((2, 2), dtype=bool))],
    ids=["who comes the other way in its lane", "who is not seen"],
)
def test_who_is_not_ahead(driver, arms, before, sees):
    gap, _ = look([driver(arm, before=metres) for arm, metres in zip(arms, before, strict=True)], sees)
    assert np.isinf(gap).all()


def test_who_stands_across_the_lane_is_ahead_and_does_not_move_along_it(driver, walker):
    gap, speed = look([driver(before=20.0), walker(start=(-15.0, -1.75))])
    assert (10.0 < gap[0] < 25.0, speed[0]) == (True, pytest.approx(0.0, abs=1e-9))


def test_one_sees_round_its_own_bend(driver):
    turning, past = driver("west", "right", before=1.0), driver("west", "right")
    exit_gap = past.route.exit_s + 6.0
    users = [turning, driver("west", "right", start=exit_gap)]
    gap, _ = look(users)
    along = exit_gap - turning.start - (turning.body.size[0] + users[1].body.size[0]) / 2
    assert gap[0] == pytest.approx(along, abs=0.5)


SIZE = np.array([[4.0, 2.0], [4.0, 2.0]])
BYSTANDER = [50.0, 50.0, 0.0]


def crossing_poses(seconds):
    """Two at right angles and one who stands aside; they touch in so many seconds, at 10 m/s each."""
    back = 10.0 * seconds
    poses = np.array([BYSTANDER, [-2.0 - back, 0.0, 0.0], [1.0, -3.0 - back, np.pi / 2]])
    return poses, np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])


def alarm(*alert):
    return ContactAlarm(np.array([1, 2]), SIZE, np.array(alert))


@pytest.mark.parametrize("seconds", [0.13, 0.27, 0.44])
def test_each_notices_the_contact_so_long_before_it(seconds):
    found = alarm(0.4, 0.2).rows(*crossing_poses(seconds)).tolist()
    assert found == [row for row, alert in ((1, 0.4), (2, 0.2)) if seconds < alert]


def test_who_has_noticed_brakes_until_the_end_and_who_is_never_alert_not():
    both, never = alarm(0.2, 0.6), alarm(0.0, 0.0)
    assert [both.rows(*crossing_poses(seconds)).tolist() for seconds in (0.13, 0.44, 5.0)] == [[1, 2]] * 3
    assert never.rows(*crossing_poses(0.0)).tolist() == []


def test_nobody_notices_one_who_comes_from_behind():
    poses = np.array([BYSTANDER, [0.0, 0.0, 0.0], [-6.0, 0.0, 0.0]])
    assert alarm(1.0, 1.0).rows(poses, np.array([[0.0, 0.0], [2.0, 0.0], [12.0, 0.0]])).tolist() == [2]
