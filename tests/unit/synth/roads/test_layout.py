"""What a junction can be like."""

import pytest

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.synth.roads import Hump, RoadSpec


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"kind": "five-way"}, "road.kind: expected one of four-way, three-way, found 'five-way'"),
        ({"lanes": 3}, "road.lanes: expected 1 or 2 in each direction, found 3"),
        ({"kerb_radius": 1.0}, "road.kerb_radius: expected 3 to 10 metres, found 1"),
        (
            {"kind": "three-way", "hump": Hump(arm="north")},
            "road.hump.arm: a three-way junction has no north arm; choose one of west, south, east",
        ),
        (
            {"hump": Hump(distance=36.0)},
            r"road.hump.distance: 36 m put the foot of the hump into the junction; choose 48.0 m or more",
        ),
    ],
)
def test_impossible_junctions_are_refused(fields, sentence):
    with pytest.raises(ConfigError, match=sentence):
        RoadSpec(**fields)


def test_everything_lies_outward_in_order():
    for spec in (RoadSpec(), RoadSpec(lanes=2, parking=False), RoadSpec(crosswalks=False)):
        assert spec.lanes_edge < spec.road_edge < spec.sidewalk_edge
        assert spec.road_edge < spec.mouth < spec.stop_line[0] < spec.stop_line[1]
        assert not spec.crosswalks or spec.crosswalk[1] < spec.stop_line[0]


def test_lane_0_is_the_rightmost():
    assert [RoadSpec(lanes=2).lane_center(lane) for lane in (0, 1)] == [5.25, 1.75]


def test_who_has_a_yield_line():
    assert RoadSpec().yielding_arms == ()
    assert RoadSpec(signalized=False).yielding_arms == ("south", "north")
    assert RoadSpec(kind="three-way", signalized=False).yielding_arms == ("south",)
