"""What a junction can be like."""

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import ROAD_CODES, Hump, RoadSpec


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"kind": "five-way"}, "road.kind: expected one of four-way, three-way, found 'five-way'"),
        ({"lanes": 3}, "road.lanes: expected 1 or 2 in each direction, found 3"),
        (
            {"kind": "three-way", "hump": Hump(arm="north")},
            "road.hump.arm: a three-way junction has no north arm; choose one of west, south, east",
        ),
        (
            {"hump": Hump(distance=36.0)},
            (
                r"road.hump.distance: 36 m puts the foot of the hump into the "
                r"junction; choose 48.0 m or more"
            ),
        ),
    ],
)
def test_impossible_junctions_are_refused(fields, sentence):
    assert_refused((lambda: RoadSpec(**fields), ConfigError, sentence))


@pytest.mark.parametrize(
    ("fields", "arms"),
    [
        ({}, ()),
        ({"signalized": False}, ("south", "north")),
        ({"kind": "three-way", "signalized": False}, ("south",)),
    ],
)
def test_who_has_a_yield_line(fields, arms):
    assert RoadSpec(**fields).yielding_arms == arms


def corners(places, length, width):
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length / 2, width / 2]
    cos, sin = np.cos(places[:, 2, None]), np.sin(places[:, 2, None])
    x = places[:, 0, None] + cos * signs[:, 0] - sin * signs[:, 1]
    y = places[:, 1, None] + sin * signs[:, 0] + cos * signs[:, 1]
    return np.stack([x, y], axis=-1)


def test_a_parked_van_stands_on_its_strip(junction):
    vans, spec = corners(junction.parking_places(), 5.0, 2.1), junction.spec
    assert np.isin(junction.ground_map().at(vans.reshape(-1, 2)), ROAD_CODES).all()
    beside = np.abs(vans).min(axis=2)
    assert spec.lanes_edge < beside.min() < beside.max() < spec.road_edge
    assert np.abs(vans).max(axis=2).min() > spec.stop_line[1] + 5
