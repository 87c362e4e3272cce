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


def test_one_of_the_two_roads_always_has_red():
    times = np.arange(-60, 60, 0.1)

    for first, second in (("west", "south"), ("east", "north")):
        first_red = PLAN.state(first, times) == RED
        second_red = PLAN.state(second, times) == RED
        assert (first_red | second_red).all()

    np.testing.assert_array_equal(PLAN.state("west", times), PLAN.state("east", times))


@pytest.mark.parametrize("ignores", [(), ("signal",)])
def test_an_obedient_driver_stops_before_the_line_at_red_and_goes_at_green(
    driver, junction, ignores
):
    user = driver("west", on=junction(signalized=True), ignores=ignores)
    plan = SignalPlan(first="south-north", start=0.0, green=8.0)  # green for west from 12.5 s on
    run = simulate([user], begin=0.0, end=20.0, rights=find_rights([user]), signals=plan)

    along, _ = user.path.project(run.poses[:, 0, :2])
    front = along + user.body.size[0] / 2
    farthest_at_red = front[run.time < 12.5].max()
    stop_s = user.route.stop_s
    assert (stop_s - 3.0 < farthest_at_red < stop_s) == (not ignores)
    assert front[-1] > user.route.enter_s
