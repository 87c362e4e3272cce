import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Junction
from deepaccident_devkit.plugins.synth.spec import draw, read_design
from deepaccident_devkit.plugins.synth.traffic.accidents import Performance, set_stage, try_accident
from deepaccident_devkit.plugins.synth.traffic.placement import replan_accident


def draw_unplanned(design, *seed):
    """Draw a design, its variant with a stranger, its junction, and the generator used for both."""
    rng = np.random.default_rng(seed)
    spec = draw(read_design(design), rng)
    junction = Junction(spec.road)
    return spec, replan_accident(rng, spec, junction), junction, rng


def play_unplanned(seed):
    _, spec, junction, rng = draw_unplanned(1, seed, 77)
    stage = set_stage(rng, spec, junction, 6.0)
    return spec, try_accident(stage)


@pytest.mark.slow
def test_a_stranger_meets_one_of_the_designed_pair_who_both_obey():
    strangers = set()
    accidents = 0
    for seed in range(8):
        spec, outcome = play_unplanned(seed)
        victim, stranger = spec.meet.actors
        assert victim in ("ego", "other")
        assert spec.design is None
        for actor in spec.actors:
            assert actor.role == stranger or not actor.ignores
        strangers.add(stranger)
        accidents += isinstance(outcome, Performance)

    assert strangers == {"pedestrian", "background"}
    assert accidents >= 6


def test_a_pedestrian_steps_out_behind_the_crest_of_a_hump():
    distances = []

    for seed in range(40):
        spec, changed, *_ = draw_unplanned(1, seed, 78)
        hump = spec.road.hump
        stranger = changed.actors[-1]
        if hump is not None and stranger.role == "pedestrian" and stranger.from_arm == hump.arm:
            distances.append(hump.distance - stranger.start_distance)

    assert 15.0 <= min(distances) <= max(distances) <= 22.0
