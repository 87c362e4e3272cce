from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec, crossing
from deepaccident_devkit.plugins.synth.spec import ActorSpec, MeetSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.traffic.driving import middle_of
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


def cast(spec=SPEC, duration=6.0):
    return cast_actors(np.random.default_rng(0), spec, Junction(spec.road), duration)


@pytest.mark.parametrize("offset", [-0.5, 0.0, 0.7])
@pytest.mark.parametrize("duration", [4.0, 8.0, 30.0])
def test_the_pair_comes_to_the_crossing_when_it_should(offset, duration):
    found = cast(replace(SPEC, meet=MeetSpec(offset=offset)), duration)
    users = [found.users[row] for row in found.pair]
    assert (found.begin, [user.role for user in users]) == (-(duration + WARM_UP), ["ego", "other"])
    run = simulate(users, begin=found.begin, end=2.0)
    for row, (user, place, late) in enumerate(
        zip(users, crossing(*(u.path for u in users)), (0, offset), strict=True)
    ):
        along, _ = user.path.project(run.poses[:, row, :2])
        # who waits sets off at a decision
        assert run.time[np.searchsorted(along, place)] == pytest.approx(late, abs=0.11)


def test_those_who_meet_may_notice_each_other_at_the_last_moment_and_nobody_else_does():
    alerts = [
        user.alert
        for seed in range(20)
        for user in cast_actors(np.random.default_rng(seed), SPEC, Junction(SPEC.road), 6.0).users
        if user.role in ("ego", "other")
    ]
    assert 5 < sum(alert == 0 for alert in alerts) < 35
    assert 0.1 < max(alerts) < 0.5
    assert [user.alert for user in cast().users if user.role in ("ego_behind", "other_behind")] == [
        0.0,
        0.0,
    ]


def test_a_start_that_is_given_is_kept_where_nobody_is_to_meet():
    actors = (replace(SPEC.actors[0], start_distance=33.0), *SPEC.actors[1:])
    ego = cast(replace(SPEC, actors=actors, meet=None)).users[0]
    assert (middle_of(ego.route) - ego.start, ego.start_speed) == (33.0, ego.max_speed)
