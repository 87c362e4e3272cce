"""Lights, signs and lanterns."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import SIDEWALK, Junction, RoadSpec
from deepaccident_devkit.plugins.synth.world import traffic_light, yield_sign


@pytest.mark.parametrize("make", [traffic_light, yield_sign])
@pytest.mark.parametrize("spec", [RoadSpec(), RoadSpec(kind="three-way", lanes=2)])
def test_it_stands_on_the_sidewalk_at_the_right_of_the_line(make, spec):
    junction = Junction(spec)
    for arm in junction.arms:
        place, (left_end, right_end) = (
            np.array(make(spec, arm).footprint).reshape(2, 2).mean(axis=1),
            junction.stop_line(arm),
        )
        inward, right = (each / np.linalg.norm(each) for each in (-left_end, right_end - left_end))
        np.testing.assert_allclose([inward[1], -inward[0]], right, atol=1e-9)
        assert junction.ground_map().at(place[None])[0] == SIDEWALK
        assert spec.road_edge < (place - left_end) @ right < spec.road_edge + 0.6
        assert 0 < (place - left_end) @ inward < 1.5
