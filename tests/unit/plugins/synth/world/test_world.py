"""Towns around junctions: nothing stands in the way, the pole sees the middle, lamps are where they
should be.
"""

import itertools

import numpy as np
import pytest
from refusals import assert_refused

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
CORNERS = [("west", "north"), ("south", "west"), ("east", "south"), ("north", "east")]


def world_of(name, seed=0, view="open", between=("west", "south")):
    return random_world(np.random.default_rng(seed), Junction(SPECS[name]), view, between=between)


@pytest.fixture(params=itertools.product(SPECS, (0, 1)), ids=lambda param: f"{param[0]}-{param[1]}")
def named(request):
    name, seed = request.param
    return Junction(SPECS[name]), world_of(name, seed)


def clear_of_props(world, start, end):
    """Whether the sight from one point to another passes above or beside every block, seen in steps
    of 5 cm.
    """
    line = np.linspace(start, end, int(np.linalg.norm(np.subtract(end, start)) / 0.05))[1:-1]
    low, high = world.props.corners.min(axis=1), world.props.corners.max(axis=1)
    return not ((line[:, None] > low) & (line[:, None] < high)).all(axis=2).any()


def test_nothing_stands_on_the_road_and_no_house_on_the_sidewalk(named):
    _, world = named
    covered = world.top.codes != world.ground.codes
    assert not np.isin(world.ground.codes[covered], ROAD_CODES).any()
    assert set(world.top.codes[covered & (world.ground.codes == SIDEWALK)].tolist()) == {POLE}
    assert {TREE, POLE, FIRST_BUILDING} <= set(np.unique(world.top.codes).tolist())


def test_things_reach_into_the_ground_and_stand_above_it(named):
    _, world = named
    above = world.props.corners[..., 2]
    ground, houses = world.terrain.height(world.props.corners[..., :2]), world.props.facade
    assert (above[houses].min(axis=1) <= ground[houses].min(axis=1) - 0.19).all()
    assert (above[houses].max(axis=1) > ground[houses].max(axis=1) + 3).all()
    assert (above < ground).any(axis=1).mean() > 0.3


def test_the_pole_sees_the_middle(named):
    _, world = named
    place, ahead = world.lidar_pole.translation, world.lidar_pole.rotation[:, 0]
    assert (3 <= place[2] <= 5, world.ground.at(place[None, :2])[0]) == (True, SIDEWALK)
    np.testing.assert_allclose(ahead[:2], -place[:2] / np.hypot(*place[:2]), atol=1e-9)
    targets = ([0.0, 0.0, 0.5], [3.0, -3.0, 0.5], [-3.0, -3.0, 0.5], [2.0, 3.0, 0.5])
    assert [target for target in targets if not clear_of_props(world, place, target)] == []


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
    place = world_of("wide", seed, between=between).lidar_pole.translation
    assert tuple(np.sign(place[:2]).astype(int).tolist()) in corners


def test_each_arm_sees_its_lamps(named):
    junction, world = named
    assert [head.arm for head in world.signals] == (
        list(junction.arms) if junction.spec.signalized else []
    )
    for head in world.signals:
        lamps = world.props.corners[list(head.rows)].mean(axis=1)
        assert (np.diff(lamps[:, 2]) < 0).all()
        line, shining = (
            junction.stop_line(head.arm).mean(axis=0),
            np.array(OUTWARD[head.arm], dtype=np.float64),
        )
        waiting = np.append(line * (1 + 8 / np.hypot(*line)), 1.5)
        assert shining @ (waiting - lamps[1])[:2] > 5
        assert clear_of_props(world, lamps[1] + 0.2 * np.append(shining, 0), waiting)
        red, _, green = world.props.colors[list(head.rows), 0].astype(int)
        assert red[0] == red.max() < LAMP_COLORS[0][0]
        assert green[1] == green.max() < LAMP_COLORS[2][1]


@pytest.mark.parametrize("between", CORNERS)
@pytest.mark.parametrize("name", ["four-way", "hilly"])
def test_a_house_on_the_kerb_hides_who_comes_until_late(name, between):
    hidden, junction = world_of(name, view="hidden", between=between), Junction(SPECS[name])
    first, second = (junction.route(arm, "straight") for arm in between)
    meeting = junction.conflicts(first, second)

    def eyes(metres):
        """Those of the two, so far before they meet."""
        places = ((first, meeting.s_a), (second, meeting.s_b))
        return [np.array([*route.path.at(s - metres)[:2], 1.5]) for route, s in places]

    assert [clear_of_props(hidden, *eyes(metres)) for metres in (20.0, 30.0, 6.0)] == [
        False,
        False,
        True,
    ]
    seen = [eye for metres in (0.0, 10.0, 20.0, 30.0) for eye in eyes(metres)]
    assert all(clear_of_props(hidden, hidden.lidar_pole.translation, eye) for eye in seen)
    covered = hidden.top.codes != hidden.ground.codes
    assert not np.isin(hidden.ground.codes[covered], ROAD_CODES).any()


def test_a_junction_with_a_hump_lies_level():
    assert world_of("hilly").world_from_ground.rotation[2, 2] == pytest.approx(1, abs=1e-15)
    assert 0.9986 < world_of("four-way").world_from_ground.rotation[2, 2] < 1


@pytest.mark.parametrize(
    ("name", "between", "arms"),
    [
        ("four-way", ("west", "east"), "west, south, east, north"),
        ("three-way", ("west", "north"), "west, south, east"),
    ],
)
def test_arms_without_a_corner_are_refused(name, between, arms):
    assert_refused(
        (
            lambda: world_of(name, view="hidden", between=between),
            ConfigError,
            f"between: the arms .* no corner in common; choose two neighbours of {arms}",
        )
    )
