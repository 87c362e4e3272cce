import numpy as np

from deepaccident_devkit.plugins.synth.traffic.rights import find_rights
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate


def test_a_follower_stops_behind_a_standing_car(driver):
    leader = driver(before=5.0, speed=0.0, delay=100.0)
    follower = driver(before=60.0)
    users = [leader, follower]
    run = simulate(users, begin=0.0, end=15.0, rights=find_rights(users))

    distance = run.poses[-1, 0, 0] - run.poses[-1, 1, 0]
    gap = distance - (leader.body.size[0] + follower.body.size[0]) / 2
    assert 1.5 < gap < 3.0

    speeds = run.states[:, 1, 3]
    assert speeds[-1] < 0.05
    assert (np.diff(speeds) / 0.02).min() > -4.0
