import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.roads import ARMS, Hump, Terrain
from deepaccident_devkit.plugins.synth.roads.layout import EXTENT, OUTWARD

SLOPED = {arm: Terrain(Hump(arm=arm, distance=55.0, height=2.0, length=60.0)) for arm in ARMS}


def draw_points(count=4000):
    rng = np.random.default_rng(0)
    return rng.uniform(-EXTENT, EXTENT, (count, 2))


@pytest.mark.parametrize("arm", ARMS)
def test_the_crest_is_where_it_should_be_and_all_else_is_flat(arm):
    terrain = SLOPED[arm]
    out = np.array(OUTWARD[arm])
    along = np.linspace(0, EXTENT, 3001)
    height = terrain.height(along[:, None] * out)
    assert terrain.is_flat is False
    assert along[height.argmax()] == pytest.approx(55.0)
    assert height.max() == pytest.approx(2.0)

    np.testing.assert_array_equal(height[(along < 25) | (along > 85)], 0)
    np.testing.assert_array_equal(terrain.height(-along[:, None] * out), 0)
    assert terrain.height([55.0 * out + 60.0 * out[::-1]])[0] == 0
    grades = np.abs(np.diff(height) / np.diff(along))
    assert grades.max() <= 2.0 / (30 * 0.75) + 1e-9


@pytest.mark.parametrize("arm", ARMS)
def test_normals_are_the_slopes_of_the_height(arm):
    terrain = SLOPED[arm]
    points = draw_points()
    slopes = []
    for step in 1e-5 * np.eye(2):
        rise = terrain.height(points + step) - terrain.height(points - step)
        slopes.append(rise / 2e-5)
    assert np.abs(slopes).max() > 0.05

    normal = terrain.normal(points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(-normal[:, :2] / normal[:, 2:], np.transpose(slopes), atol=1e-5)


def test_the_default_hump_hides_a_pedestrian():
    """No line of sight joins eyes 1.7 m above the road, 28 m before the crest, and the head of a
    pedestrian of 1.86 m as far behind it.
    """
    along = np.linspace(Hump().distance - 28, Hump().distance + 28, 500)
    points = np.column_stack([along, np.zeros(500)])
    ground = Terrain(Hump(arm="east")).height(points)
    line_of_sight = np.linspace(ground[0] + 1.7, ground[-1] + 1.86, 500)

    assert (line_of_sight < ground).any()


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
            (
                r"hump: 6 m over 70 m are a grade of 22.9%; make it longer or lower; 21% is the "
                r"maximum"
            ),
        ),
    ],
)
def test_impossible_humps_are_refused(fields, sentence):
    assert_raises(
        (lambda: Hump(**fields), ConfigError, sentence),
    )
