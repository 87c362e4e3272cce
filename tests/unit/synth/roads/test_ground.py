"""Maps of the ground."""

import numpy as np
import pytest

from deepaccident_devkit.synth.roads import (
    FIRST_BUILDING,
    GRASS,
    ROAD,
    ROAD_CODES,
    SIDEWALK,
    TERRAIN,
    WHITE,
    YELLOW,
    GroundMap,
    Junction,
    RoadSpec,
    tag_of_code,
)


def test_cells_are_found_by_their_middles():
    codes = np.zeros((3000, 3000), dtype=np.uint8)
    codes[1500, 1520] = ROAD
    ground = GroundMap(codes)
    np.testing.assert_array_equal(ground.at(np.array([[2.05, 0.05], [0.05, 2.05]])), [ROAD, TERRAIN])
    np.testing.assert_array_equal(ground.at(np.array([[200.0, 0.0], [0.0, -151.0]])), [TERRAIN, TERRAIN])
    assert not ground.codes.flags.writeable
    assert codes.flags.writeable


def test_rectangles_are_painted_in_order_on_a_copy():
    ground = GroundMap(np.full((3000, 3000), GRASS, dtype=np.uint8))
    painted = ground.with_rectangles(
        np.array([[0.0, 2.0, 0.0, 1.0], [1.0, 3.0, 0.0, 1.0]]), np.array([16, 17], dtype=np.uint8)
    )
    points = np.array([[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [0.5, 1.5]])
    np.testing.assert_array_equal(painted.at(points), [16, 17, 17, GRASS])
    assert (ground.codes == GRASS).all()


def test_every_code_has_a_tag():
    tags = tag_of_code()
    assert tags.shape == (256,)
    assert (tags[FIRST_BUILDING:] == 1).all()
    assert len(set(tags[:8].tolist())) == 7  # both colours of lines have one tag


def quarter_turned(codes):
    """The map turned counter-clockwise: x takes the place of y."""
    return codes.T[:, ::-1]


def test_a_four_way_map_is_its_own_quarter_turn_or_half_turn_where_one_road_gives_way():
    for spec in (RoadSpec(), RoadSpec(lanes=2, parking=False)):
        codes = Junction(spec).ground_map().codes
        np.testing.assert_array_equal(quarter_turned(codes), codes)
    codes = Junction(RoadSpec(signalized=False)).ground_map().codes
    np.testing.assert_array_equal(quarter_turned(quarter_turned(codes)), codes)
    assert (quarter_turned(codes) != codes).any()


def test_a_three_way_map_mirrors_itself_but_for_lines_and_has_no_north_arm():
    codes = Junction(RoadSpec(kind="three-way", signalized=False)).ground_map().codes
    driven = np.isin(codes, ROAD_CODES)
    np.testing.assert_array_equal(driven, driven[:, ::-1])
    assert not driven[1500 + 60 :].any()
    four = Junction(RoadSpec(signalized=False)).ground_map().codes
    np.testing.assert_array_equal(codes[:1350], four[:1350])


def test_from_the_middle_line_outward(junction):
    """Yellow line, lane, kerb, sidewalk, grass, 80 m from the middle; behind the kerb's end all is as before it."""
    spec, ground = junction.spec, junction.ground_map()
    for arm, (x, y) in {"west": (-1, 0), "south": (0, -1), "east": (1, 0), "north": (0, 1)}.items():
        if arm not in junction.arms:
            continue

        def code(along, beside, x=x, y=y):
            return ground.at(np.array([[along * x - beside * y, along * y + beside * x]]))[0]

        for side in (1, -1):
            assert code(80.0, side * 0.12) == YELLOW
            assert code(80.0, side * 1.75) == ROAD
            assert code(80.0, side * (spec.road_edge - 0.15)) in ROAD_CODES
            assert code(80.0, side * (spec.road_edge + 0.15)) == SIDEWALK
            assert code(80.0, side * (spec.sidewalk_edge + 0.15)) == GRASS
        stop = np.mean(spec.stop_line)
        towards, away = ({code(stop, side * beside) for beside in np.arange(0.35, 3.4, 0.1)} for side in (1, -1))
        gives_way = arm in ("south", "north")
        assert towards == ({WHITE} if spec.signalized else {WHITE, ROAD} if gives_way else {ROAD})
        assert away == {ROAD}


def test_crosswalks_are_striped_from_kerb_to_kerb_or_not_at_all():
    for marked in (True, False):
        junction = Junction(RoadSpec(crosswalks=marked, parking=False))
        codes = junction.ground_map().at(junction.crosswalk("west").xy)
        stripes = np.flatnonzero(np.diff((codes == WHITE).astype(int)) == 1)
        assert len(stripes) == (7 if marked else 0)


@pytest.mark.parametrize("spec", [RoadSpec(), RoadSpec(parking=False), RoadSpec(lanes=2)])
def test_all_stripes_of_a_crosswalk_are_as_wide_and_the_middle_one_is_in_the_middle(spec):
    junction = Junction(spec)
    path = junction.crosswalk("south")
    white = junction.ground_map().at(path.xy) == WHITE
    starts, ends = (path.s[np.flatnonzero(np.diff(white.astype(int)) == step)] for step in (1, -1))
    np.testing.assert_allclose(ends - starts, 0.5, atol=0.16)
    np.testing.assert_allclose(np.mean([starts, ends], axis=0)[len(starts) // 2], path.s[-1] / 2, atol=0.11)
    assert len(starts) % 2 == 1


def test_corners_are_round():
    spec = RoadSpec(parking=False, kerb_radius=6.0)
    ground = Junction(spec).ground_map()
    centre = spec.road_edge + spec.kerb_radius
    for angle in np.deg2rad([190, 225, 260]):
        for radius, expected in ((5.8, SIDEWALK), (6.2, ROAD)):
            point = centre + radius * np.array([np.cos(angle), np.sin(angle)])
            for signs in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
                assert ground.at((point * signs)[None])[0] == expected


@pytest.mark.parametrize("signalized", [True, False])
def test_the_same_junction_is_painted_once(signalized):
    first, second = (Junction(RoadSpec(signalized=signalized)).ground_map() for _ in range(2))
    assert first is second
