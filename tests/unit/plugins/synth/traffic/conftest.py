from functools import lru_cache

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.actors import random_body
from deepaccident_devkit.plugins.synth.roads import Junction, RoadSpec, straight
from deepaccident_devkit.plugins.synth.traffic.driving import RoadUser, lane_span


@lru_cache(maxsize=8)
def _junction(kind, signalized, lanes):
    return Junction(RoadSpec(kind=kind, signalized=signalized, lanes=lanes))


@pytest.fixture(scope="session")
def junction():
    def make(kind="four-way", *, signalized=False, lanes=1):
        return _junction(kind, signalized, lanes)

    return make


@pytest.fixture(scope="session")
def driver(junction):
    """A function that makes a driver; it starts `before` metres before its stop line."""

    def make(
        arm="west", turn="straight", *, before=40.0, speed=8.0, category="car", on=None, **fields
    ):
        route = (on or junction()).route(arm, turn)
        body = random_body(np.random.default_rng(1), category)
        defaults = {
            "role": "background",
            "path": route.path,
            "start": route.stop_s - before - body.size[0] / 2,
            "start_speed": speed,
            "max_speed": 10.0,
            "span": lane_span(route),
        }
        return RoadUser(body=body, route=route, **{**defaults, **fields})

    return make


@pytest.fixture(scope="session")
def walker():
    """A function that makes a pedestrian, who walks straight over the west arm by default."""

    def make(start=(-12.0, -8.0), yaw=np.pi / 2, length=16.0, **fields):
        defaults = {
            "role": "pedestrian",
            "start": 0.0,
            "start_speed": 0.0,
            "max_speed": 1.4,
            "span": (0.0, length),
        }
        return RoadUser(
            body=random_body(np.random.default_rng(2), "pedestrian"),
            path=straight(start, yaw, length),
            **{**defaults, **fields},
        )

    return make
