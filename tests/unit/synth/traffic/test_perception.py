import numpy as np
import pytest

from deepaccident_devkit.synth.traffic.driving import Tracks
from deepaccident_devkit.synth.traffic.simulate import Alarm, Bodies, leaders

SEES = ~np.eye(2, dtype=bool)


def look(users, sees=SEES):
    """Gaps and leaders' speeds of two users where they start."""
    lateral, stops = np.full(2, 3.0), np.zeros(2, dtype=bool)
    starts = np.array([user.start for user in users])
    tracks = Tracks([user.path for user in users], lateral, stops)
    bodies = Bodies(
        poses=tracks.at(starts)[:3].T,
        speed=np.array([user.start_speed for user in users]),
        length=np.array([user.body.size[0] for user in users]),
        width=np.array([user.body.size[1] for user in users]),
    )
    return leaders(bodies, tracks, starts, sees)


def test_the_gap_is_from_bumper_to_bumper(driver):
    users = [driver(before=30.0), driver(before=18.0, speed=5.0)]
    gap, speed = look(users)
    assert gap[0] == pytest.approx(12.0 - users[1].body.size[0], abs=1e-6)
    assert speed[0] == pytest.approx(5.0)
    assert np.isinf(gap[1])


def test_who_comes_the_other_way_in_its_lane_is_not_ahead(driver):
    gap, _ = look([driver("west", before=5.0), driver("east", before=5.0)])
    assert np.isinf(gap).all()


def test_who_stands_across_the_lane_is_ahead_and_does_not_move_along_it(driver, walker):
    gap, speed = look([driver(before=20.0), walker(start=(-15.0, -1.75))])
    assert 10.0 < gap[0] < 25.0
    assert speed[0] == pytest.approx(0.0, abs=1e-9)


def test_who_is_not_seen_is_not_ahead(driver):
    gap, _ = look([driver(before=30.0), driver(before=18.0)], np.zeros((2, 2), dtype=bool))
    assert np.isinf(gap).all()


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
    return Alarm(np.array([1, 2]), SIZE, np.array(alert))


@pytest.mark.parametrize("seconds", [0.13, 0.27, 0.44])
def test_each_notices_the_contact_so_long_before_it(seconds):
    found = alarm(0.4, 0.2).rows(*crossing_poses(seconds)).tolist()
    assert found == [row for row, alert in ((1, 0.4), (2, 0.2)) if seconds < alert]


def test_one_who_is_never_alert_notices_nothing():
    assert alarm(0.0, 0.0).rows(*crossing_poses(0.0)).tolist() == []


def test_who_has_noticed_brakes_until_the_end():
    both = alarm(0.2, 0.6)
    assert both.rows(*crossing_poses(0.13)).tolist() == [1, 2]
    assert both.rows(*crossing_poses(0.44)).tolist() == [1, 2]
    assert both.rows(*crossing_poses(5.0)).tolist() == [1, 2]


def test_nobody_notices_one_who_comes_from_behind():
    poses = np.array([BYSTANDER, [0.0, 0.0, 0.0], [-6.0, 0.0, 0.0]])
    assert alarm(1.0, 1.0).rows(poses, np.array([[0.0, 0.0], [2.0, 0.0], [12.0, 0.0]])).tolist() == [2]
