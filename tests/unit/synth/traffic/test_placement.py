from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.synth.roads import Junction, RoadSpec, crossing
from deepaccident_devkit.synth.spec import ActorSpec, MeetSpec, ScenarioSpec
from deepaccident_devkit.synth.traffic.driving import middle_of, road_crossing
from deepaccident_devkit.synth.traffic.placement import WARM_UP, cast_actors, drive_alone
from deepaccident_devkit.synth.traffic.simulate import simulate


def test_one_set_on_its_way_comes_to_the_place_in_time(driver):
    user = driver(before=90.0, speed=0.0)
    approach = drive_alone(user)
    time = approach.time_to(user.route.enter_s)
    started = approach.at(time - 4.0)
    run = simulate([started], begin=0.0, end=4.0)
    along, _ = user.path.project(run.poses[-1:, 0, :2])
    assert along[0] == pytest.approx(user.route.enter_s, abs=0.3)


def test_a_slow_one_is_driven_on_until_it_is_at_the_place(driver):
    slow = driver(before=90.0, speed=0.0, max_speed=3.0)
    place = slow.route.enter_s
    assert drive_alone(slow).along[-1] < place
    approach = drive_alone(slow, to=place)
    assert 30.0 < approach.time_to(place) < 40.0
    assert approach.along[-1] == pytest.approx(place, abs=0.5)
    quick = driver(before=20.0)
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
    assert found.begin == -(duration + WARM_UP)
    users = [found.users[row] for row in found.pair]
    assert [user.role for user in users] == ["ego", "other"]
    run = simulate(users, begin=found.begin, end=2.0)
    for row, (user, place, late) in enumerate(zip(users, crossing(*(u.path for u in users)), (0, offset), strict=True)):
        along, _ = user.path.project(run.poses[:, row, :2])
        assert run.time[np.searchsorted(along, place)] == pytest.approx(
            late, abs=0.11
        )  # who waits sets off at a decision


def test_those_behind_start_at_their_gap():
    found = cast()
    ego, behind = (found.users[found.row_of(role)] for role in ("ego", "ego_behind"))
    assert ego.start - behind.start - (ego.body.size[0] + behind.body.size[0]) / 2 == pytest.approx(8.0)
    assert behind.start_speed == ego.start_speed
    assert behind.max_speed > ego.max_speed
    other, behind = (found.users[found.row_of(role)] for role in ("other", "other_behind"))
    assert 8.0 <= other.start - behind.start - (other.body.size[0] + behind.body.size[0]) / 2 <= 16.0


def test_those_who_meet_may_notice_each_other_at_the_last_moment_and_nobody_else_does():
    alerts = [
        user.alert
        for seed in range(20)
        for user in cast_actors(np.random.default_rng(seed), SPEC, Junction(SPEC.road), 6.0).users
        if user.role in ("ego", "other")
    ]
    assert 5 < sum(alert == 0 for alert in alerts) < 35
    assert 0.1 < max(alerts) < 0.5
    behind = (user.alert for user in cast().users if user.role in ("ego_behind", "other_behind"))
    assert list(behind) == [0.0, 0.0]


def test_a_start_that_is_given_is_kept_where_nobody_is_to_meet():
    actors = (replace(SPEC.actors[0], start_distance=33.0), *SPEC.actors[1:])
    ego = cast(replace(SPEC, actors=actors, meet=None)).users[0]
    assert middle_of(ego.route) - ego.start == 33.0
    assert ego.start_speed == ego.max_speed


def test_paths_that_never_cross_have_no_pair():
    actors = (SPEC.actors[0], SPEC.actors[1], replace(SPEC.actors[2], from_arm="east"), SPEC.actors[3])
    assert cast(replace(SPEC, actors=actors)).pair is None


@pytest.mark.parametrize(("side", "sign"), [("right", -1), ("left", 1)])
def test_a_pedestrian_walks_over_the_road_from_its_side(side, sign):
    path = road_crossing(SPEC.road, "west", 30.0, side)
    np.testing.assert_allclose(path.xy[:, 0], -30.0)
    assert path.xy[0, 1] == pytest.approx(sign * (SPEC.road.road_edge + 0.7))
    assert path.xy[-1, 1] == pytest.approx(-path.xy[0, 1])
