import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import Boxes
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
    assert_raises(
        (lambda: RoadSpec(**fields), ConfigError, sentence),
    )


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


def test_a_parked_van_stands_on_its_strip(junction):
    spec = junction.spec
    poses = junction.parking_places()
    vans = Boxes.from_arrays(
        poses * (1, 1, 0),
        np.tile([5.0, 2.1, 2.0], (len(poses), 1)),
        poses[:, 2],
    )
    corners = vans.corners()[..., :2]
    codes = junction.ground_map().at(corners.reshape(-1, 2))
    assert np.isin(codes, ROAD_CODES).all()

    from_road_centre = np.abs(corners).min(axis=2)
    assert spec.lanes_edge < from_road_centre.min() < from_road_centre.max() < spec.road_edge
    from_junction = np.abs(corners).max(axis=2)
    assert from_junction.min() > spec.stop_line[1] + 5
