"""Routes over junctions, compared with the painted ground."""

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import ROAD_CODES, Junction, RoadSpec
from deepaccident_devkit.plugins.synth.roads.junction import ROUTE_REACH
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD

HALF_TRUCK_WIDTH_M = 1.45


def shift_path(path, left):
    """Return the points at a distance to the left of a path, shape (N, 2)."""
    normals = np.column_stack([-np.sin(path.yaw), np.cos(path.yaw)])
    return path.xy + left * normals


def test_routes_begin_and_end_on_lane_centres(junction):
    for route in junction.routes():
        center = junction.spec.lane_center(route.lane)
        for arm, index, sign in (
            (route.from_arm, 0, -1),
            (route.to_arm, -1, 1),
        ):
            out = np.array(OUTWARD[arm], dtype=float)
            heading = sign * out
            right = np.array([heading[1], -heading[0]])
            expected = ROUTE_REACH * out + center * right
            np.testing.assert_allclose(route.path.xy[index], expected, atol=1e-6)

            yaw = route.path.yaw[index]
            np.testing.assert_allclose([np.cos(yaw), np.sin(yaw)], heading, atol=1e-9)


def test_even_a_truck_stays_on_the_road(junction):
    ground = junction.ground_map()

    for route in junction.routes():
        for left in (-HALF_TRUCK_WIDTH_M, 0.0, HALF_TRUCK_WIDTH_M):
            codes = ground.at(shift_path(route.path, left))
            assert np.isin(codes, ROAD_CODES).all(), (route.from_arm, route.turn)


def test_stop_line_then_junction_then_arm(junction):
    spec = junction.spec

    for route in junction.routes():
        assert route.stop_s < route.enter_s < route.exit_s
        stop, enter, leave = (
            np.array(route.path.at(s)[:2]) for s in (route.stop_s, route.enter_s, route.exit_s)
        )
        inward, outward = OUTWARD[route.from_arm], OUTWARD[route.to_arm]
        np.testing.assert_allclose(
            [stop @ inward, enter @ inward, leave @ outward],
            [spec.stop_line[1], spec.mouth, spec.mouth],
            atol=1e-3,
        )
        distances = np.linalg.norm(junction.stop_line(route.from_arm) - stop, axis=1)
        assert distances.max() < spec.lanes_edge


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
    conflict = junction.conflicts(
        junction.route(*first),
        junction.route(*second),
    )
    assert (conflict is not None) == meet


def test_lefts_are_made_from_the_left_lane_unless_asked_otherwise():
    junction = Junction(RoadSpec(lanes=2))
    assert junction.route("west", "straight").lane == 0
    assert junction.route("west", "left").lane == 1
    assert junction.route("west", "right").lane == 0
    assert junction.route("west", "left", 0).lane == 0


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
            lambda junction: junction.route("north", "left"),
            "arm: a three-way junction has no 'north' arm; choose one of west, south",
        ),
        (
            lambda junction: junction.route("west", "left"),
            "turn: 'left' is impossible from the west arm of a three-way junction; ch",
        ),
        (
            lambda junction: junction.route("west", "right", 1),
            "lane: expected 0 to 0, found 1",
        ),
        (
            lambda junction: junction.crosswalk("north"),
            "arm: a three-way junction has no 'north' arm",
        ),
        (
            lambda junction: junction.stop_line("up"),
            "arm: a three-way junction has no 'up' arm",
        ),
    ],
)
def test_missing_arms_turns_and_lanes_are_refused(ask, sentence):
    junction = Junction(RoadSpec(kind="three-way"))
    assert_raises(
        (lambda: ask(junction), ConfigError, sentence),
    )
