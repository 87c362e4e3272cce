"""Accidents that instance maps show."""

import numpy as np
import pytest
from accident_scenes import scene, standing

from deepaccident_devkit.errors import ChoiceError, ConfigError, GeometryError
from deepaccident_devkit.evaluation.metrics.accident import AccidentReading, accidents_of
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_accidents_of_instance_maps(orientation) -> None:
    label = scene({5: standing(20, 10), 9: [(15.5 - gap, 10) for gap in (4, 3, 2, 0, 1)]}, orientation=orientation)
    grid = label.config.grid
    ids = tuple(sorted(label.id_map.values()))
    (found,) = accidents_of(label.instance, grid)
    np.testing.assert_allclose(found.positions, [[20, 10], [15.5, 10]])
    assert (found.time, found.ids) == (1.5, ids)
    calm = np.where(label.instance == ids[0], ids[0], -1)  # below 0 is background, too
    assert [each.time for each in accidents_of(np.stack([label.instance, calm]), grid, step=0.1)] == [
        pytest.approx(0.3)
    ]
    assert accidents_of(label.instance, grid, reading=AccidentReading(danger_distance=0.25)) == []
    (raw,) = accidents_of(label.instance, grid, labels=None)
    np.testing.assert_allclose(np.abs(raw.positions - found.positions), 0.25)
    with pytest.raises(ChoiceError, match="labels"):
        accidents_of(label.instance, grid, labels="none")
    with pytest.raises(ConfigError, match="step"):
        accidents_of(label.instance, grid, step=0)
    with pytest.raises(GeometryError, match="instances"):
        accidents_of(label.instance[..., :9], grid)
