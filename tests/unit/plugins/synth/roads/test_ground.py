"""Maps of the ground."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import (
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
from deepaccident_devkit.plugins.synth.roads.layout import OUTWARD


def test_cells_are_found_by_their_middles():
    codes = np.zeros((3000, 3000), dtype=np.uint8)
    codes[1500, 1520] = ROAD
    ground, beyond = GroundMap(codes), [[200.0, 0.0], [0.0, -151.0]]
    assert ground.at(np.array([[2.05, 0.05], [0.05, 2.05], *beyond])).tolist() == [
        ROAD,
        TERRAIN,
        TERRAIN,
        TERRAIN,
    ]
    assert (ground.codes.flags.writeable, codes.flags.writeable) == (False, True)


@pytest.mark.parametrize(
    ("spec", "quarters"), [(RoadSpec(), 1), (RoadSpec(lanes=2), 1), (RoadSpec(signalized=False), 2)]
)
def test_a_four_way_map_is_its_own_quarter_turn_or_half_turn_where_one_road_gives_way(
    spec, quarters
):
    codes = Junction(spec).ground_map().codes
    turned = [codes.T[:, ::-1], codes[::-1, ::-1]]  # counter-clockwise: x takes the place of y
    assert [(each == codes).all() for each in turned] == [quarters == 1, True]


def test_from_the_middle_line_outward(junction):
    """Yellow line, lane, kerb, sidewalk, grass, 80 m from the middle; behind the kerb's end all is
    as before it.
    """
    spec, ground = junction.spec, junction.ground_map()
    for arm in junction.arms:
        out = np.array(OUTWARD[arm])
        left = np.array([-out[1], out[0]])

        def codes(along, beside, out=out, left=left):
            return ground.at(along * out + np.multiply.outer(beside, left)).tolist()

        for side in (1, -1):
            bands = (
                0.12,
                1.75,
                spec.road_edge - 0.15,
                spec.road_edge + 0.15,
                spec.sidewalk_edge + 0.15,
            )
            yellow, lane, kerb, *beyond = codes(80.0, side * np.array(bands))
            assert (yellow, lane, kerb in ROAD_CODES, beyond) == (
                YELLOW,
                ROAD,
                True,
                [SIDEWALK, GRASS],
            )
        towards, away = (
            set(codes(np.mean(spec.stop_line), side * np.arange(0.35, 3.4, 0.1)))
            for side in (1, -1)
        )
        gives_way = {WHITE, ROAD} if arm in ("south", "north") else {ROAD}
        assert (towards, away) == ({WHITE} if spec.signalized else gives_way, {ROAD})
