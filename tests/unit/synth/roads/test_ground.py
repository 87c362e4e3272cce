"""Maps of the ground."""

import numpy as np

from deepaccident_devkit.synth.roads import (
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
)


def test_cells_are_found_by_their_middles():
    codes = np.zeros((3000, 3000), dtype=np.uint8)
    codes[1500, 1520] = ROAD
    ground = GroundMap(codes)
    np.testing.assert_array_equal(ground.at(np.array([[2.05, 0.05], [0.05, 2.05]])), [ROAD, TERRAIN])
    np.testing.assert_array_equal(ground.at(np.array([[200.0, 0.0], [0.0, -151.0]])), [TERRAIN, TERRAIN])
    assert not ground.codes.flags.writeable
    assert codes.flags.writeable


def quarter_turned(codes):
    """The map turned counter-clockwise: x takes the place of y."""
    return codes.T[:, ::-1]


def test_a_four_way_map_is_its_own_quarter_turn_or_half_turn_where_one_road_gives_way():
    for spec in (RoadSpec(), RoadSpec(lanes=2)):
        codes = Junction(spec).ground_map().codes
        np.testing.assert_array_equal(quarter_turned(codes), codes)
    codes = Junction(RoadSpec(signalized=False)).ground_map().codes
    np.testing.assert_array_equal(quarter_turned(quarter_turned(codes)), codes)
    assert (quarter_turned(codes) != codes).any()


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


def test_crosswalks_are_striped_from_kerb_to_kerb():
    junction = Junction(RoadSpec())
    codes = junction.ground_map().at(junction.crosswalk("west").xy)
    assert len(np.flatnonzero(np.diff((codes == WHITE).astype(int)) == 1)) == 11


def test_corners_are_round():
    ground = Junction(RoadSpec()).ground_map()
    centre = RoadSpec().road_edge + 5.0
    for angle in np.deg2rad([190, 225, 260]):
        for radius, expected in ((4.8, SIDEWALK), (5.2, ROAD)):
            point = centre + radius * np.array([np.cos(angle), np.sin(angle)])
            for signs in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
                assert ground.at((point * signs)[None])[0] == expected
