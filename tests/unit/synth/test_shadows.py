import numpy as np

from deepaccident_devkit.synth.shadows import with_shadows
from deepaccident_devkit.synth.solids import Block, build

CUBE = build([Block((10, 12), (-1, 1), (0, 2), (9, 9, 9))]).corners
SUN = np.array([0.6, 0.0, 0.6])  # half way up, at +x: shadows fall towards −x, as long as things are high


def _cell(x, y):
    return round((y + 150) * 10), round((x + 150) * 10)


def test_shadow_falls_away_from_the_sun():
    ground = np.full((3000, 3000, 3), 200, dtype=np.uint8)
    shadowed = with_shadows(ground, CUBE, SUN, 0.5)
    assert (shadowed[_cell(11, 0)] == 100).all()
    assert (shadowed[_cell(8.2, 0)] == 100).all()
    assert (shadowed[_cell(7.8, 0)] == 200).all()
    assert (shadowed[_cell(12.3, 0)] == 200).all()
    area = (shadowed != 200).any(axis=2).sum() * 0.01
    assert 8.0 <= area < 8.9  # 4 m × 2 m, and the cells on its edge
    assert (ground == 200).all()


def test_two_shadows_are_no_darker_than_one():
    ground = np.full((3000, 3000, 3), 200, dtype=np.uint8)
    twice = with_shadows(ground, np.concatenate([CUBE, CUBE]), SUN, 0.5)
    np.testing.assert_array_equal(twice, with_shadows(ground, CUBE, SUN, 0.5))
