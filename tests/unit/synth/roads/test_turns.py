"""Right angles."""

import numpy as np
import pytest

from deepaccident_devkit.synth.roads.paths import bent
from deepaccident_devkit.synth.roads.turns import quarter_turn, tangent_of_corner, tangent_of_radius


@pytest.mark.parametrize("left", [True, False])
@pytest.mark.parametrize("tangent", [3.0, 14.0])
def test_it_ends_on_the_other_line(left, tangent):
    path = bent((0.0, 0.0), 0.0, quarter_turn(tangent, left=left))
    sign = 1 if left else -1
    np.testing.assert_allclose(path.xy[-1], [tangent, sign * tangent], atol=1e-7)
    np.testing.assert_allclose(path.yaw[-1], sign * np.pi / 2, atol=1e-12)
    assert path.curvature[0] == 0
    np.testing.assert_allclose(path.curvature[-1], 0, atol=1e-12)


def test_radius_and_corner_are_those_asked_for():
    path = bent((0.0, 0.0), 0.0, quarter_turn(tangent_of_radius(8.0), left=True))
    np.testing.assert_allclose(path.curvature.max(), 1 / 8)
    tangent = tangent_of_corner(4.0)
    path = bent((0.0, 0.0), 0.0, quarter_turn(tangent, left=True))
    np.testing.assert_allclose(np.hypot(path.xy[:, 0] - tangent, path.xy[:, 1]).min(), 4.0, atol=1e-3)
