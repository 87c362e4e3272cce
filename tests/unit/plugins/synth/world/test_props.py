"""Things on the ground."""

import numpy as np

from deepaccident_devkit.plugins.synth.roads import GRASS, GroundMap, Hump, Terrain
from deepaccident_devkit.plugins.synth.solids import Block
from deepaccident_devkit.plugins.synth.world import Prop, overlap, settled_prop, solids_of, top_map

LOW = Prop(20, (Block((0.0, 4.0), (0.0, 2.0), (-0.2, 1.0), (1, 2, 3)),))
HIGH = Prop(21, (Block((3.0, 5.0), (0.0, 2.0), (-0.2, 3.0), (1, 2, 3)), Block((5.0, 6.0), (-1, 1), (0, 2), (4, 5, 6))))


def test_who_stands_on_the_same_ground_overlaps():
    assert HIGH.footprint == (3.0, 6.0, -1.0, 2.0)
    far = Prop(22, (Block((6.5, 7.0), (0.0, 2.0), (0, 1), (0, 0, 0)),))
    assert overlap(LOW, HIGH)
    assert not overlap(HIGH, far)


def test_higher_things_cover_lower_ones_whatever_their_order():
    ground = GroundMap(np.full((3000, 3000), GRASS, dtype=np.uint8))
    points = np.array([[1.0, 1.0], [3.5, 1.0], [5.5, 0.5], [8.0, 8.0]])
    for props in ((LOW, HIGH), (HIGH, LOW)):
        np.testing.assert_array_equal(top_map(ground, props).at(points), [20, 21, 21, GRASS])
    assert len(solids_of([LOW, HIGH])) == 3


def test_a_thing_on_a_slope_goes_down_to_its_lowest_corner():
    terrain = Terrain(Hump(arm="east", distance=40.0, height=2.0, length=60.0))
    moved = Prop(20, (Block((20.0, 30.0), (0.0, 2.0), (-0.2, 3.0), (1, 2, 3)),))
    lift, higher = terrain.height([[20.0, 0.0], [30.0, 0.0]])
    assert 0 < lift < higher
    assert settled_prop(moved, terrain).blocks[0].z == (-0.2 + lift, 3.0 + lift)
    assert settled_prop(moved, Terrain()) is moved
