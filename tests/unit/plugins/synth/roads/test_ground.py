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


def test_cells_are_found_by_their_centres():
    codes = np.zeros((3000, 3000), dtype=np.uint8)
    codes[1500, 1520] = ROAD
    ground = GroundMap(codes)
    assert (ground.codes.flags.writeable, codes.flags.writeable) == (False, True)

    points = np.array(
        [
            [2.05, 0.05],
            [0.05, 2.05],
            [200.0, 0.0],  # beyond the map
            [0.0, -151.0],
        ]
    )
    assert ground.at(points).tolist() == [ROAD, TERRAIN, TERRAIN, TERRAIN]


@pytest.mark.parametrize(
    ("spec", "same_after_quarter_turn"),
    [
        (RoadSpec(), True),
        (RoadSpec(lanes=2), True),
        (RoadSpec(signalized=False), False),
    ],
)
def test_a_four_way_map_stays_the_same_when_turned(spec, same_after_quarter_turn):
    """By a half turn; by a quarter turn only if no road gives way."""
    codes = Junction(spec).ground_map().codes
    # counter-clockwise: x takes the place of y
    quarter_turned = codes.T[:, ::-1]
    half_turned = codes[::-1, ::-1]

    assert (quarter_turned == codes).all() == same_after_quarter_turn
    assert (half_turned == codes).all()


def test_from_the_middle_line_outward(junction):
    """Yellow line, lane, kerb, sidewalk and grass 80 m from the middle; the stop line on the way in
    and none on the way out.
    """
    spec = junction.spec
    ground = junction.ground_map()
    bands = np.array(
        [0.12, 1.75, spec.road_edge - 0.15, spec.road_edge + 0.15, spec.sidewalk_edge + 0.15]
    )
    lane = np.arange(0.35, 3.4, 0.1)

    for arm in junction.arms:
        out = np.array(OUTWARD[arm])
        left = np.array([-out[1], out[0]])
        for side in (left, -left):
            across = ground.at(80.0 * out + bands[:, None] * side).tolist()
            assert across[:2] == [YELLOW, ROAD]
            assert across[2] in ROAD_CODES
            assert across[3:] == [SIDEWALK, GRASS]

        line = np.mean(spec.stop_line) * out
        inward_codes = set(ground.at(line + lane[:, None] * left).tolist())
        outward_codes = set(ground.at(line - lane[:, None] * left).tolist())
        yields = {WHITE, ROAD} if arm in ("south", "north") else {ROAD}
        assert inward_codes == ({WHITE} if spec.signalized else yields)
        assert outward_codes == {ROAD}
