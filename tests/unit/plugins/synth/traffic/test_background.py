from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD
from deepaccident_devkit.plugins.synth.spec import ActorSpec, BackgroundSpec, ScenarioSpec
from deepaccident_devkit.plugins.synth.traffic.accidents import touching_pairs
from deepaccident_devkit.plugins.synth.traffic.background import background_users, parked_vehicles
from deepaccident_devkit.plugins.synth.traffic.placement import cast_actors
from deepaccident_devkit.plugins.synth.traffic.rights import RED, SignalPlan

MANY = BackgroundSpec(vehicles=12, two_wheelers=6, parked=14, walking=8, crossing=6)
SPEC = ScenarioSpec(
    road=RoadSpec(lanes=2),
    actors=(
        ActorSpec(role="ego", from_arm="west"),
        ActorSpec(role="other", from_arm="south"),
        ActorSpec(role="ego_behind"),
        ActorSpec(role="other_behind"),
    ),
    background=MANY,
)
PLAN = SignalPlan(first="west-east", start=-10.0, green=20.0)


@pytest.fixture(scope="module", params=range(3))
def scene(request):
    """Named road users and a background."""
    rng, junction = np.random.default_rng(request.param), Junction(SPEC.road)
    named = cast_actors(rng, SPEC, junction, 6.0).users
    return junction, named, background_users(rng, SPEC, junction, named, PLAN, -7.0)


def test_nobody_starts_between_the_named_ones_and_the_junction(scene):
    _, named, background = scene
    between = [
        other
        for user in named
        for other in background
        if other.route
        and (other.route.from_arm, other.route.lane) == (user.route.from_arm, user.route.lane)
        and user.start < other.start < user.route.exit_s
    ]
    assert between == []


def test_crosswalks_are_walked_over_while_their_arm_has_red(scene):
    junction, named, background = scene
    taken = {arm for each in named for arm in (each.route.from_arm, each.route.to_arm)}
    for user in (each for each in background if each.walks and each.span[1] > 0):
        x, y, _, _ = user.path.at(user.path.length / 2)
        arm = max(junction.arms, key=lambda each: float(np.dot([x, y], OUTWARD[each])))
        assert (PLAN.state(arm, -7.0 + user.delay), arm in taken) == (RED, False)


def test_parked_vehicles_stand_on_their_own_slots():
    rng, junction = np.random.default_rng(4), Junction(SPEC.road)
    named = ActorSpec(
        role="parked", category="van", from_arm="east", side="left", start_distance=40.0
    )
    vehicles = parked_vehicles(rng, replace(SPEC, actors=(*SPEC.actors, named)), junction, [])
    poses, size = (
        np.array(each) for each in zip(*((v.pose, v.body.size[:2]) for v in vehicles), strict=True)
    )
    assert (len(vehicles), touching_pairs(poses[None], size, 0.3)) == (MANY.parked + 1, [])
    x, y, yaw = poses[0]
    assert (
        y < -SPEC.road.lanes_edge
    )  # who drives towards the junction from the east has the south on his left
    assert (vehicles[0].body.category, abs(np.cos(yaw)), x) == (
        "van",
        pytest.approx(1),
        pytest.approx(40, abs=3.5),
    )


def test_nobody_parks_where_one_steps_onto_the_road():
    walking = ActorSpec(
        role="pedestrian", category="pedestrian", from_arm="west", start_distance=40.0
    )
    spec = replace(SPEC, actors=(*SPEC.actors, walking), background=replace(MANY, parked=40))
    rng, junction = np.random.default_rng(4), Junction(SPEC.road)
    users = [user for user in cast_actors(rng, spec, junction, 6.0).users if user.walks]
    vehicles = parked_vehicles(rng, spec, junction, users)
    assert (
        0.5
        < min(abs(vehicle.pose[0] + 40.0) - vehicle.body.size[0] / 2 for vehicle in vehicles)
        < 8.0
    )
