"""Towns around junctions: nothing stands in the way, the pole sees the middle, lamps are in the
right places.
"""

import itertools

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import (
    FIRST_BUILDING,
    POLE,
    ROAD_CODES,
    SIDEWALK,
    TREE,
    Hump,
    Junction,
    RoadSpec,
)
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD
from deepaccident_devkit.plugins.synth.world import LAMP_COLORS, random_world

SPECS = {
    "four-way": RoadSpec(),
    "three-way": RoadSpec(kind="three-way"),
    "wide": RoadSpec(lanes=2, signalized=False),
    "hilly": RoadSpec(hump=Hump(arm="east", distance=60.0)),
}
NEIGHBOURS = [("west", "north"), ("south", "west"), ("east", "south"), ("north", "east")]


def make_world(name, seed=0, view="open", between=("west", "south")):
    return random_world(
        np.random.default_rng(seed),
        Junction(SPECS[name]),
        view,
        between=between,
    )


@pytest.fixture(params=itertools.product(SPECS, (0, 1)), ids=lambda param: f"{param[0]}-{param[1]}")
def town(request):
    """A junction and the world around it."""
    name, seed = request.param
    return Junction(SPECS[name]), make_world(name, seed)


def is_visible(world, start, end):
    """Return whether the line of sight between two points meets no block, in steps of 5 cm."""
    steps = int(np.linalg.norm(np.subtract(end, start)) / 0.05)
    line = np.linspace(start, end, steps)[1:-1, None]
    low = world.props.corners.min(axis=1)
    high = world.props.corners.max(axis=1)
    inside = ((line > low) & (line < high)).all(axis=2)

    return not inside.any()


def test_nothing_stands_on_the_road_and_no_house_on_the_sidewalk(town):
    _, world = town
    ground, top = world.ground.codes, world.top.codes
    covered = top != ground

    assert not np.isin(ground[covered], ROAD_CODES).any()
    assert set(top[covered & (ground == SIDEWALK)].tolist()) == {POLE}
    assert {TREE, POLE, FIRST_BUILDING} <= set(np.unique(top).tolist())


def test_things_reach_into_the_ground_and_stand_above_it(town):
    _, world = town
    heights = world.props.corners[..., 2]
    ground = world.terrain.height(world.props.corners[..., :2])
    assert (heights < ground).any(axis=1).mean() > 0.3

    houses = world.props.facade
    house_heights, house_ground = heights[houses], ground[houses]
    assert (house_heights.min(axis=1) <= house_ground.min(axis=1) - 0.19).all()
    assert (house_heights.max(axis=1) > house_ground.max(axis=1) + 3).all()


def test_the_pole_sees_the_middle(town):
    _, world = town
    position = world.lidar_pole.translation
    assert 3 <= position[2] <= 5
    assert world.ground.at(position[None, :2])[0] == SIDEWALK

    ahead = world.lidar_pole.rotation[:, 0]
    to_middle = -position[:2] / np.hypot(*position[:2])
    np.testing.assert_allclose(ahead[:2], to_middle, atol=1e-9)

    targets = ([0.0, 0.0, 0.5], [3.0, -3.0, 0.5], [-3.0, -3.0, 0.5], [2.0, 3.0, 0.5])
    for target in targets:
        assert is_visible(world, position, target)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("between", "corners"),
    [
        (("west", "north"), {(-1, 1)}),
        (("south", "east"), {(1, -1)}),
        (("south", "south"), {(1, -1), (-1, -1)}),
        (("east", "west"), {(1, 1), (1, -1), (-1, 1), (-1, -1)}),
    ],
)
def test_the_pole_stands_where_the_two_come_from(seed, between, corners):
    position = make_world("wide", seed, between=between).lidar_pole.translation
    corner = np.sign(position[:2]).astype(int)
    assert tuple(corner.tolist()) in corners


def test_each_arm_sees_its_lamps(town):
    junction, world = town
    expected_arms = list(junction.arms) if junction.spec.signalized else []
    assert [head.arm for head in world.signals] == expected_arms

    for head in world.signals:
        rows = list(head.rows)
        lamps = world.props.corners[rows].mean(axis=1)
        assert (np.diff(lamps[:, 2]) < 0).all()

        outward = np.array(OUTWARD[head.arm], dtype=np.float64)
        line = junction.stop_line(head.arm).mean(axis=0)
        waiting = np.append(line * (1 + 8 / np.hypot(*line)), 1.5)
        assert outward @ (waiting - lamps[1])[:2] > 5
        front_of_lamp = lamps[1] + 0.2 * np.append(outward, 0)
        assert is_visible(world, front_of_lamp, waiting)

        red, _, green = world.props.colors[rows, 0].astype(int)
        assert red[0] == red.max() < LAMP_COLORS[0][0]
        assert green[1] == green.max() < LAMP_COLORS[2][1]


@pytest.mark.parametrize("between", NEIGHBOURS)
@pytest.mark.parametrize("name", ["four-way", "hilly"])
def test_a_house_on_the_kerb_hides_the_two_from_each_other_until_late(name, between):
    world = make_world(name, view="hidden", between=between)
    junction = Junction(SPECS[name])
    first, second = (junction.route(arm, "straight") for arm in between)
    meeting = junction.conflicts(first, second)

    def eyes_before_meeting(metres):
        """Return the eyes of the two at a distance before they meet."""
        x_a, y_a, *_ = first.path.at(meeting.s_a - metres)
        x_b, y_b, *_ = second.path.at(meeting.s_b - metres)
        return np.array([[x_a, y_a, 1.5], [x_b, y_b, 1.5]])

    assert not is_visible(world, *eyes_before_meeting(20.0))
    assert not is_visible(world, *eyes_before_meeting(30.0))
    assert is_visible(world, *eyes_before_meeting(6.0))

    for metres in (0.0, 10.0, 20.0, 30.0):
        for eye in eyes_before_meeting(metres):
            assert is_visible(world, world.lidar_pole.translation, eye)

    covered = world.top.codes != world.ground.codes
    assert not np.isin(world.ground.codes[covered], ROAD_CODES).any()


def test_a_junction_with_a_hump_lies_level():
    hilly = make_world("hilly").world_from_ground
    flat = make_world("four-way").world_from_ground
    assert hilly.rotation[2, 2] == pytest.approx(1, abs=1e-15)
    assert 0.9986 < flat.rotation[2, 2] < 1


@pytest.mark.parametrize(
    ("name", "between", "arms"),
    [
        ("four-way", ("west", "east"), "west, south, east, north"),
        ("three-way", ("west", "north"), "west, south, east"),
    ],
)
def test_arms_without_a_corner_are_refused(name, between, arms):
    assert_raises(
        (
            lambda: make_world(name, view="hidden", between=between),
            ConfigError,
            f"between: the arms .* no corner in common; choose two neighbours of {arms}",
        )
    )
