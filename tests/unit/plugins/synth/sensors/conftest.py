"""A junction with a few road users set by hand, and the sensors of their agents."""

from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth import solids
from deepaccident_devkit.plugins.synth.actors import MEDIAN_SIZES, Actor, Actors, SampledMotion
from deepaccident_devkit.plugins.synth.roads import Hump, Junction, RoadSpec
from deepaccident_devkit.plugins.synth.sensors.rig import make_rig
from deepaccident_devkit.plugins.synth.shapes import make_shape
from deepaccident_devkit.plugins.synth.world import random_world
from deepaccident_devkit.taxonomy import STATIC_ACTOR_ID, VEHICLE_AGENTS

RED, BLUE = (200, 30, 30), (30, 60, 200)
FOUR_WAY = RoadSpec(kind="four-way", signalized=True)
AGENT_POSES = {
    "ego_vehicle": (-30.0, -1.75, 0.0),
    "ego_vehicle_behind": (-42.0, -1.75, 0.0),
    "other_vehicle": (1.75, -40.0, np.pi / 2),
    "other_vehicle_behind": (1.75, -52.0, np.pi / 2),
}
"""x, y and yaw of the vehicles with sensors."""


def make_motion(x, y, yaw, speed):
    """Make a motion straight on for 100 s before and after time 0."""
    velocity = speed * np.array([np.cos(yaw), np.sin(yaw)])
    offset = 100.0 * velocity

    return SampledMotion(
        start=-100.0,
        period=200.0,
        samples=np.array(
            [[x - offset[0], y - offset[1], yaw], [x + offset[0], y + offset[1], yaw]]
        ),
        sample_velocities=np.stack([velocity, velocity]),
    )


@pytest.fixture(scope="session")
def world():
    """A signalised crossing of flat roads."""
    return random_world(np.random.default_rng(0), Junction(FOUR_WAY))


@pytest.fixture(scope="session")
def hilly_world():
    """The same crossing with a hump on the arm of the ego."""
    spec = RoadSpec(
        kind="four-way",
        signalized=True,
        hump=Hump(arm="west", distance=55.0, height=2.4, length=70.0),
    )
    return random_world(np.random.default_rng(0), Junction(spec))


@pytest.fixture(scope="session")
def actor():
    def make(number, category, x, y, yaw=0.0, speed=0.0, *, color=RED, parked=False):
        size = MEDIAN_SIZES[category]
        return Actor(
            actor_id=(STATIC_ACTOR_ID if parked else 1000) + number,
            object_id=number + 1,
            category=category,
            size=size,
            shape=make_shape(category, size, color, BLUE),
            motion=make_motion(x, y, yaw, speed),
        )

    return make


@pytest.fixture(scope="session")
def rig_of(actor):
    """A function that makes the rig of the four agents and of other actors in a world; `places`
    moves agents.
    """

    def make(
        world,
        actors=(),
        *,
        places=None,
        sky=("Clear", "Noon"),
        image_size=(320, 180),
        seed=(0,),
        **options,
    ):
        poses = {**AGENT_POSES, **(places or {})}
        cars = [actor(k, "car", *poses[name]) for k, name in enumerate(VEHICLE_AGENTS)]
        ids = {name: car.actor_id for name, car in zip(VEHICLE_AGENTS, cars, strict=True)}
        return make_rig(
            world,
            Actors.of([*cars, *actors]),
            ids,
            sky=sky,
            image_size=image_size,
            seed=seed,
            **options,
        )

    return make


@pytest.fixture(scope="session")
def bare():
    """A function that copies a world with only the given blocks on it."""

    def make(world, blocks=()):
        return replace(world, props=solids.build(blocks), signals=())

    return make
