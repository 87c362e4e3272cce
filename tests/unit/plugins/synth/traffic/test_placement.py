from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec, crossing
from deepaccident_devkit.plugins.synth.spec import ActorSpec, MeetSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.traffic.driving import distance_to_middle
from deepaccident_devkit.plugins.synth.traffic.placement import WARM_UP, cast_actors
from deepaccident_devkit.plugins.synth.traffic.simulate import simulate

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


def make_cast(spec=SPEC, duration=6.0, seed=0):
    return cast_actors(
        np.random.default_rng(seed),
        spec,
        Junction(spec.road),
        duration,
    )


@pytest.mark.parametrize("offset", [-0.5, 0.0, 0.7])
@pytest.mark.parametrize("duration", [4.0, 8.0, 30.0])
def test_the_pair_comes_to_the_crossing_when_it_should(offset, duration):
    cast = make_cast(replace(SPEC, meet=MeetSpec(offset=offset)), duration)
    users = [cast.users[row] for row in cast.pair]
    assert cast.begin == -(duration + WARM_UP)
    assert [user.role for user in users] == ["ego", "other"]

    run = simulate(users, begin=cast.begin, end=2.0)
    meeting = crossing(users[0].path, users[1].path)
    for row, (meeting_s, arrival) in enumerate(zip(meeting, (0, offset), strict=True)):
        along, _ = users[row].path.project(run.poses[:, row, :2])
        # a waiting road user sets off at a decision
        time = run.time[np.searchsorted(along, meeting_s)]
        assert time == pytest.approx(arrival, abs=0.11)


def test_only_the_pair_may_notice_each_other_at_the_last_moment():
    alerts = [
        user.alert
        for seed in range(20)
        for user in make_cast(seed=seed).users
        if user.role in ("ego", "other")
    ]
    assert 5 < alerts.count(0) < 35
    assert 0.1 < max(alerts) < 0.5

    followers = [user for user in make_cast().users if user.role in ("ego_behind", "other_behind")]
    assert [user.alert for user in followers] == [0.0, 0.0]


def test_a_given_start_is_kept_where_nobody_is_to_meet():
    ego_spec = replace(SPEC.actors[0], start_distance=33.0)
    spec = replace(SPEC, actors=(ego_spec, *SPEC.actors[1:]), meet=None)
    ego = make_cast(spec).users[0]

    assert distance_to_middle(ego.route) - ego.start == 33.0
    assert ego.start_speed == ego.max_speed
