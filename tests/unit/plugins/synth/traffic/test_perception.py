import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.simulate import ContactAlarm

SIZE = np.array([[4.0, 2.0], [4.0, 2.0]])
BYSTANDER = [50.0, 50.0, 0.0]


def crossing_poses(seconds):
    """Two at right angles and one who stands aside; they touch in so many seconds, at 10 m/s
    each.
    """
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
    assert [both.rows(*crossing_poses(seconds)).tolist() for seconds in (0.13, 0.44, 5.0)] == [
        [1, 2]
    ] * 3
    assert never.rows(*crossing_poses(0.0)).tolist() == []


def test_nobody_notices_one_who_comes_from_behind():
    poses = np.array([BYSTANDER, [0.0, 0.0, 0.0], [-6.0, 0.0, 0.0]])
    assert alarm(1.0, 1.0).rows(
        poses, np.array([[0.0, 0.0], [2.0, 0.0], [12.0, 0.0]])
    ).tolist() == [2]
