from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec, crossing
from deepaccident_devkit.plugins.synth.spec import ActorSpec, MeetSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.traffic.driving import middle_of, road_crossing
from deepaccident_devkit.plugins.synth.traffic.placement import WARM_UP, cast_actors, drive_alone
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate


def test_one_set_on_its_way_comes_to_the_place_in_time(driver):
    user = driver(before=90.0, speed=0.0)
    place, approach = user.route.enter_s, drive_alone(user)
    run = simulate([approach.at(approach.time_to(place) - 4.0)], begin=0.0, end=4.0)
    assert user.path.project(run.poses[-1:, 0, :2])[0][0] == pytest.approx(place, abs=0.3)


def test_a_slow_one_is_driven_on_until_it_is_at_the_place(driver):
    slow, quick = driver(before=90.0, speed=0.0, max_speed=3.0), driver(before=20.0)
    place = slow.route.enter_s
    approach = drive_alone(slow, to=place)
    assert (drive_alone(slow).along[-1] < place, 30.0 < approach.time_to(place) < 40.0) == (True, True)
    assert approach.along[-1] == pytest.approx(place, abs=0.5)
    assert len(drive_alone(quick, to=quick.route.enter_s).along) == len(drive_alone(quick).along)


def test_before_its_start_it_waits_or_comes_from_farther_back(driver):
    standing, moving = driver(speed=0.0), driver(speed=5.0)
    waiting = drive_alone(standing).at(-2.0)
    assert (waiting.delay, waiting.start, waiting.start_speed) == (2.0, standing.start, 0.0)
    assert drive_alone(moving).at(-2.0).start == pytest.approx(moving.start - 10.0)


SPEC = ScenarioSpec(
    road=RoadSpec(signalized=False),
    actors=(
        ActorSpec(role="ego", from_arm="west", max_speed=10.0),
        ActorSpec(role="ego_behind", gap=8.0),
        ActorSpec(role="other", from_arm="south", max_speed=9.0, ignores=("priority",)),
        ActorSpec(role="other_behind"),
    ),
    meet=MeetSpec(),
)


def cast(spec=SPEC, duration=6.0):
    return cast_actors(np.random.default_rng(0), spec, Junction(spec.road), duration)


@pytest.mark.parametrize("offset", [-0.5, 0.0, 0.7])
@pytest.mark.parametrize("duration", [4.0, 8.0, 30.0])
def test_the_pair_comes_to_the_crossing_when_it_should(offset, duration):
    found = cast(replace(SPEC, meet=MeetSpec(offset=offset)), duration)
    users = [found.users[row] for row in found.pair]
    assert (found.begin, [user.role for user in users]) == (-(duration + WARM_UP), ["ego", "other"])
    run = simulate(users, begin=found.begin, end=2.0)
    for row, (user, place, late) in enumerate(zip(users, crossing(*(u.path for u in users)), (0, offset), strict=True)):
        along, _ = user.path.project(run.poses[:, row, :2])
        # who waits sets off at a decision
        assert run.time[np.searchsorted(along, place)] == pytest.approx(late, abs=0.11)


def test_those_behind_start_at_their_gap():
    found = cast()

    def ahead_and_gap(role):
        ahead, behind = (found.users[found.row_of(each)] for each in (role, f"{role}_behind"))
        return ahead, behind, ahead.start - behind.start - (ahead.body.size[0] + behind.body.size[0]) / 2

    ego, behind, gap = ahead_and_gap("ego")
    assert gap == pytest.approx(8.0)
    assert (behind.start_speed, behind.max_speed > ego.max_speed) == (ego.start_speed, True)
    assert 8.0 <= ahead_and_gap("other")[2] <= 16.0


def test_those_who_meet_may_notice_each_other_at_the_last_moment_and_nobody_else_does():
    alerts = [
        user.alert
        for seed in range(20)
        for user in cast_actors(np.random.default_rng(seed), SPEC, Junction(SPEC.road), 6.0).users
        if user.role in ("ego", "other")
    ]
    assert 5 < sum(alert == 0 for alert in alerts) < 35
    assert 0.1 < max(alerts) < 0.5
    assert [user.alert for user in cast().users if user.role in ("ego_behind", "other_behind")] == [0.0, 0.0]


def test_a_start_that_is_given_is_kept_where_nobody_is_to_meet():
    actors = (replace(SPEC.actors[0], start_distance=33.0), *SPEC.actors[1:])
    ego = cast(replace(SPEC, actors=actors, meet=None)).users[0]
    assert (middle_of(ego.route) - ego.start, ego.start_speed) == (33.0, ego.max_speed)


def test_paths_that_never_cross_have_no_pair():
    actors = (SPEC.actors[0], SPEC.actors[1], replace(SPEC.actors[2], from_arm="east"), SPEC.actors[3])
    assert cast(replace(SPEC, actors=actors)).pair is None


@pytest.mark.parametrize(("side", "sign"), [("right", -1), ("left", 1)])
def test_a_pedestrian_walks_over_the_road_from_its_side(side, sign):
    path, begin = road_crossing(SPEC.road, "west", 30.0, side), sign * (SPEC.road.road_edge + 0.7)
    np.testing.assert_allclose(path.xy[:, 0], -30.0)
    np.testing.assert_allclose(path.xy[[0, -1], 1], [begin, -begin])
