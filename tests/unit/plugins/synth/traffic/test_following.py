import numpy as np

from deepaccident_devkit.plugins.synth.traffic.rights import find_rights
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate


def test_a_follower_stands_behind_a_standing_one(driver):
    users = [driver(before=5.0, speed=0.0, delay=100.0), driver(before=60.0)]
    run = simulate(users, begin=0.0, end=15.0, rights=find_rights(users))
    gap = (
        run.poses[-1, 0, 0]
        - run.poses[-1, 1, 0]
        - (users[0].body.size[0] + users[1].body.size[0]) / 2
    )
    assert (run.states[-1, 1, 3] < 0.05, 1.5 < gap < 3.0) == (True, True)
    assert (np.diff(run.states[:, 1, 3]) / 0.02).min() > -4.0
