"""Lights, signs and lanterns."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import SIDEWALK, Junction, RoadSpec
from deepaccident_devkit.plugins.synth.world import lanterns, traffic_light, yield_sign


def middle(prop):
    x0, x1, y0, y1 = prop.footprint
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2])


@pytest.mark.parametrize("make", [traffic_light, yield_sign])
@pytest.mark.parametrize("spec", [RoadSpec(), RoadSpec(kind="three-way", lanes=2)])
def test_it_stands_on_the_sidewalk_at_the_right_of_the_line(make, spec):
    junction = Junction(spec)
    for arm in junction.arms:
        place, (left_end, right_end) = middle(make(spec, arm)), junction.stop_line(arm)
        inward, right = (each / np.linalg.norm(each) for each in (-left_end, right_end - left_end))
        np.testing.assert_allclose([inward[1], -inward[0]], right, atol=1e-9)
        assert junction.ground_map().at(place[None])[0] == SIDEWALK
        assert spec.road_edge < (place - left_end) @ right < spec.road_edge + 0.6
        assert 0 < (place - left_end) @ inward < 1.5


def test_lanterns_stand_behind_the_kerb_on_both_sides():
    spec = RoadSpec(lanes=2)
    places = np.array([middle(each) for each in lanterns(spec)])
    assert (Junction(spec).ground_map().at(places) == SIDEWALK).all()
    assert set(np.sign(places[places[:, 0] > 30][:, 1])) == {-1, 1}
