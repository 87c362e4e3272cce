"""Maps of the ground."""

import numpy as np

from deepaccident_devkit.synth.roads import FIRST_BUILDING, GRASS, ROAD, TERRAIN, GroundMap, tag_of_code


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
