"""Routes over junctions, against the painted ground."""

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import ROAD_CODES, Junction, RoadSpec
from deepaccident_devkit.plugins.synth.roads.junction import ROUTE_REACH
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD

HALF_TRUCK = 1.45


def beside(path, left):
    return path.xy + left * np.column_stack([-np.sin(path.yaw), np.cos(path.yaw)])


def test_routes_begin_and_end_on_lane_centres(junction):
    for route in junction.routes():
        center = junction.spec.lane_center(route.lane)
        for arm, point, yaw, sign in (
            (route.from_arm, route.path.xy[0], route.path.yaw[0], -1),
            (route.to_arm, route.path.xy[-1], route.path.yaw[-1], 1),
        ):
            out, heading = np.array(OUTWARD[arm], dtype=float), sign * np.array(OUTWARD[arm])
            np.testing.assert_allclose(
                point, ROUTE_REACH * out + center * np.array([heading[1], -heading[0]]), atol=1e-6
            )
            np.testing.assert_allclose([np.cos(yaw), np.sin(yaw)], heading, atol=1e-9)


def test_even_a_truck_stays_on_the_road(junction):
    ground = junction.ground_map()
    for route in junction.routes():
        for left in (-HALF_TRUCK, 0.0, HALF_TRUCK):
            assert np.isin(ground.at(beside(route.path, left)), ROAD_CODES).all(), (
                route.from_arm,
                route.turn,
            )


def test_stop_line_then_junction_then_arm(junction):
    spec = junction.spec
    for route in junction.routes():
        assert route.stop_s < route.enter_s < route.exit_s
        stop, enter, leave = (
            np.array(route.path.at(s)[:2]) for s in (route.stop_s, route.enter_s, route.exit_s)
        )
        inward, outward = OUTWARD[route.from_arm], OUTWARD[route.to_arm]
        found = [stop @ inward, enter @ inward, leave @ outward]
        np.testing.assert_allclose(found, [spec.stop_line[1], spec.mouth, spec.mouth], atol=1e-3)
        assert (
            np.linalg.norm(junction.stop_line(route.from_arm) - stop, axis=1).max()
            < spec.lanes_edge
        )


@pytest.mark.parametrize(
    ("first", "second", "meet"),
    [
        (("west", "straight"), ("north", "straight"), True),
        (("west", "straight"), ("east", "straight"), False),
        (("west", "left"), ("east", "straight"), True),
        (("west", "left"), ("east", "left"), False),
        (("west", "left"), ("east", "right"), True),
        (("west", "right"), ("east", "right"), False),
        (("west", "straight"), ("south", "right"), True),
        (("west", "right"), ("south", "straight"), False),
        (("west", "straight"), ("west", "left"), False),
    ],
)
def test_who_meets_whom(first, second, meet):
    junction = Junction(RoadSpec())
    assert (junction.conflicts(junction.route(*first), junction.route(*second)) is not None) == meet


def test_lefts_are_made_from_the_left_lane_unless_asked_otherwise():
    junction = Junction(RoadSpec(lanes=2))
    asked = (("straight",), ("left",), ("right",), ("left", 0))
    assert [junction.route("west", *each).lane for each in asked] == [0, 1, 0, 0]


def test_a_three_way_junction_has_no_way_north():
    junction = Junction(RoadSpec(kind="three-way"))
    assert {arm: junction.turns(arm) for arm in junction.arms} == {
        "west": ("straight", "right"),
        "south": ("left", "right"),
        "east": ("straight", "left"),
    }
    assert len(junction.routes()) == 6


@pytest.mark.parametrize(
    ("ask", "sentence"),
    [
        (
            lambda j: j.route("north", "left"),
            "arm: a three-way junction has no 'north' arm; choose one of west, south",
        ),
        (
            lambda j: j.route("west", "left"),
            "turn: nobody can go 'left' from the west arm of a three-way junction; ch",
        ),
        (lambda j: j.route("west", "right", 1), "lane: expected 0 to 0, found 1"),
        (lambda j: j.crosswalk("north"), "arm: a three-way junction has no 'north' arm"),
        (lambda j: j.stop_line("up"), "arm: a three-way junction has no 'up' arm"),
    ],
)
def test_what_is_not_there_is_refused(ask, sentence):
    assert_refused((lambda: ask(Junction(RoadSpec(kind="three-way"))), ConfigError, sentence))
