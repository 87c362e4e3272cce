import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.simulate import ContactAlarm

SIZE = np.array([[4.0, 2.0], [4.0, 2.0]])
BYSTANDER = [50.0, 50.0, 0.0]


def crossing_poses(seconds):
    """Return poses and velocities of a bystander and of two road users at right angles, who touch
    after a time at 10 m/s each.
    """
    distance = 10.0 * seconds
    poses = np.array(
        [
            BYSTANDER,
            [-2.0 - distance, 0.0, 0.0],
            [1.0, -3.0 - distance, np.pi / 2],
        ]
    )
    velocities = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    return poses, velocities


def make_alarm(*alert_seconds):
    return ContactAlarm(
        np.array([1, 2]),
        SIZE,
        np.array(alert_seconds),
    )


@pytest.mark.parametrize("seconds", [0.13, 0.27, 0.44])
def test_each_road_user_notices_the_contact_in_its_own_time(seconds):
    rows = make_alarm(0.4, 0.2).rows(*crossing_poses(seconds))
    expected = [row for row, alert in ((1, 0.4), (2, 0.2)) if seconds < alert]
    assert rows.tolist() == expected


def test_a_noticed_contact_stays_noticed_and_is_never_noticed_without_alertness():
    both = make_alarm(0.2, 0.6)
    for seconds in (0.13, 0.44, 5.0):
        assert both.rows(*crossing_poses(seconds)).tolist() == [1, 2]

    assert make_alarm(0.0, 0.0).rows(*crossing_poses(0.0)).tolist() == []


def test_nobody_notices_a_road_user_that_comes_from_behind():
    poses = np.array([BYSTANDER, [0.0, 0.0, 0.0], [-6.0, 0.0, 0.0]])
    velocities = np.array([[0.0, 0.0], [2.0, 0.0], [12.0, 0.0]])
    rows = make_alarm(1.0, 1.0).rows(poses, velocities)
    assert rows.tolist() == [2]
