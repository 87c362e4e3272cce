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

DENSE_BACKGROUND = BackgroundSpec(vehicles=12, two_wheelers=6, parked=14, walking=8, crossing=6)
SPEC = ScenarioSpec(
    road=RoadSpec(lanes=2),
    actors=(
        ActorSpec(role="ego", from_arm="west"),
        ActorSpec(role="other", from_arm="south"),
        ActorSpec(role="ego_behind"),
        ActorSpec(role="other_behind"),
    ),
    background=DENSE_BACKGROUND,
)
PLAN = SignalPlan(first="west-east", start=-10.0, green=20.0)


@pytest.fixture(scope="module", params=range(3))
def scene(request):
    """A junction, named road users and a background."""
    rng = np.random.default_rng(request.param)
    junction = Junction(SPEC.road)
    named = cast_actors(rng, SPEC, junction, 6.0).users
    return junction, named, background_users(rng, SPEC, junction, named, PLAN, -7.0)


def test_nobody_starts_between_a_named_road_user_and_the_junction(scene):
    _, named, background = scene
    drivers = [user for user in background if user.route]

    for user in named:
        route = user.route
        starts = [
            driver.start
            for driver in drivers
            if (driver.route.from_arm, driver.route.lane) == (route.from_arm, route.lane)
        ]
        assert not [start for start in starts if user.start < start < route.exit_s]


def test_crosswalks_are_walked_over_while_their_arm_has_red(scene):
    junction, named, background = scene
    used_arms = {user.route.from_arm for user in named} | {user.route.to_arm for user in named}
    crossing = [user for user in background if user.walks and user.span[1] > 0]

    for user in crossing:
        x, y, _, _ = user.path.at(user.path.length / 2)
        distances = {arm: float(np.dot([x, y], OUTWARD[arm])) for arm in junction.arms}
        arm = max(distances, key=distances.get)
        assert PLAN.state(arm, -7.0 + user.delay) == RED
        assert arm not in used_arms


def test_parked_vehicles_stand_on_their_own_slots():
    van_spec = ActorSpec(
        role="parked", category="van", from_arm="east", side="left", start_distance=40.0
    )
    spec = replace(SPEC, actors=(*SPEC.actors, van_spec))
    vehicles = parked_vehicles(np.random.default_rng(4), spec, Junction(SPEC.road), [])
    assert len(vehicles) == DENSE_BACKGROUND.parked + 1

    poses = np.array([vehicle.pose for vehicle in vehicles])
    sizes = np.array([vehicle.body.size[:2] for vehicle in vehicles])
    assert touching_pairs(poses[None], sizes, 0.3) == []

    assert vehicles[0].body.category == "van"
    x, y, yaw = poses[0]
    assert x == pytest.approx(40, abs=3.5)
    # south of the road is left of those who drive from the east towards the junction
    assert y < -SPEC.road.lanes_edge
    assert abs(np.cos(yaw)) == pytest.approx(1)


def test_nobody_parks_where_a_pedestrian_steps_onto_the_road():
    pedestrian = ActorSpec(
        role="pedestrian", category="pedestrian", from_arm="west", start_distance=40.0
    )
    spec = replace(
        SPEC,
        actors=(*SPEC.actors, pedestrian),
        background=replace(DENSE_BACKGROUND, parked=40),
    )
    rng = np.random.default_rng(4)
    junction = Junction(SPEC.road)
    users = [user for user in cast_actors(rng, spec, junction, 6.0).users if user.walks]

    vehicles = parked_vehicles(rng, spec, junction, users)

    gaps = [abs(vehicle.pose[0] + 40.0) - vehicle.body.size[0] / 2 for vehicle in vehicles]
    assert 0.5 < min(gaps) < 8.0
