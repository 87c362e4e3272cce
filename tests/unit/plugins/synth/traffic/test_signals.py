import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.traffic.rights import (
    AMBER,
    GREEN,
    RED,
    SignalPlan,
    find_rights,
)
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate

PLAN = SignalPlan(first="west-east", start=0.0, green=10.0)


def test_phases_follow_each_other():
    assert PLAN.state("west", [0.0, 9.9, 10.1, 13.1, 28.9, 29.1]).tolist() == [
        GREEN,
        GREEN,
        AMBER,
        RED,
        RED,
        GREEN,
    ]
    assert PLAN.state("north", [0.0, 14.4, 14.6, 24.6, 27.6]).tolist() == [
        RED,
        RED,
        GREEN,
        AMBER,
        RED,
    ]


def test_never_have_both_roads_anything_but_red():
    times = np.arange(-60, 60, 0.1)
    for one, other in (("west", "south"), ("east", "north")):
        assert ((PLAN.state(one, times) == RED) | (PLAN.state(other, times) == RED)).all()
    np.testing.assert_array_equal(PLAN.state("west", times), PLAN.state("east", times))


@pytest.mark.parametrize("ignores", [(), ("signal",)])
def test_one_stops_before_the_line_at_red_and_goes_at_green_if_it_obeys(driver, junction, ignores):
    users = [driver("west", on=junction(signalized=True), ignores=ignores)]
    plan = SignalPlan(first="south-north", start=0.0, green=8.0)  # green for west from 12.5 s on
    run = simulate(users, begin=0.0, end=20.0, rights=find_rights(users), signals=plan)
    front = users[0].path.project(run.poses[:, 0, :2])[0] + users[0].body.size[0] / 2
    at_red, route = front[run.time < 12.5].max(), users[0].route
    assert (route.stop_s - 3.0 < at_red < route.stop_s) == (not ignores)
    assert front[-1] > route.enter_s
