import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import SIDEWALK, Junction, RoadSpec
from deepaccident_devkit.plugins.synth.world import traffic_light, yield_sign


@pytest.mark.parametrize("make_block", [traffic_light, yield_sign])
@pytest.mark.parametrize("spec", [RoadSpec(), RoadSpec(kind="three-way", lanes=2)])
def test_it_stands_on_the_sidewalk_at_the_right_of_the_line(make_block, spec):
    junction = Junction(spec)
    for arm in junction.arms:
        position = np.array(make_block(spec, arm).footprint).reshape(2, 2).mean(axis=1)
        left_end, right_end = junction.stop_line(arm)
        inward = -left_end / np.linalg.norm(left_end)
        right = (right_end - left_end) / np.linalg.norm(right_end - left_end)
        np.testing.assert_allclose([inward[1], -inward[0]], right, atol=1e-9)

        assert junction.ground_map().at(position[None])[0] == SIDEWALK
        offset = position - left_end
        assert spec.road_edge < offset @ right < spec.road_edge + 0.6
        assert 0 < offset @ inward < 1.5
