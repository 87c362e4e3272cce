"""The height of the ground."""

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import ARMS, Hump, Terrain
from deepaccident_devkit.plugins.synth.roads.layout import EXTENT, OUTWARD

SLOPED = {arm: Terrain(Hump(arm=arm, distance=55.0, height=2.0, length=60.0)) for arm in ARMS}


def grid(n=4000, seed=0):
    return np.random.default_rng(seed).uniform(-EXTENT, EXTENT, (n, 2))


@pytest.mark.parametrize("arm", ARMS)
def test_the_crest_is_where_it_should_be_and_all_else_is_flat(arm):
    terrain, out = SLOPED[arm], np.array(OUTWARD[arm])
    along = np.linspace(0, EXTENT, 3001)
    height = terrain.height(along[:, None] * out)
    assert (terrain.is_flat, along[height.argmax()], height.max()) == (
        False,
        pytest.approx(55.0),
        pytest.approx(2.0),
    )
    for flat in (height[(along < 25) | (along > 85)], terrain.height(-along[:, None] * out)):
        np.testing.assert_array_equal(flat, 0)
    assert terrain.height([55.0 * out + 60.0 * out[::-1]])[0] == 0
    assert np.abs(np.diff(height) / np.diff(along)).max() <= 2.0 / (30 * 0.75) + 1e-9


@pytest.mark.parametrize("arm", ARMS)
def test_normals_are_the_slopes_of_the_height(arm):
    terrain, points, steps = SLOPED[arm], grid(), 1e-5 * np.eye(2)
    slopes = [
        (terrain.height(points + step) - terrain.height(points - step)) / 2e-5 for step in steps
    ]
    normal = terrain.normal(points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(-normal[:, :2] / normal[:, 2:], np.transpose(slopes), atol=1e-5)
    assert np.abs(slopes).max() > 0.05


def test_the_default_hump_hides_a_pedestrian():
    """From eyes 1.7 m above the road 28 m before the crest, one of 1.86 m as far behind it: no line
    of sight.
    """
    line = np.linspace(Hump().distance - 28, Hump().distance + 28, 500)
    ground = Terrain(Hump(arm="east")).height(np.column_stack([line, np.zeros(500)]))
    assert (np.linspace(ground[0] + 1.7, ground[-1] + 1.86, 500) < ground).any()


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"arm": "up"}, "hump.arm: expected one of west, south, east, north, found 'up'"),
        (
            {"length": 0.0},
            "hump: expected a length above 0 and a height of 0 or more, found 0.0 and 2.4",
        ),
        (
            {"distance": 130.0},
            r"hump: 70 m around 130 m do not fit on an arm of 150 m; make it shorter",
        ),
        (
            {"height": 6.0},
            r"hump: 6 m over 70 m are a grade of 22.9%; make it longer or lower, 21% is the most",
        ),
    ],
)
def test_impossible_humps_are_refused(fields, sentence):
    assert_refused((lambda: Hump(**fields), ConfigError, sentence))
