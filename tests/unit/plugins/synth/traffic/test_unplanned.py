import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Junction
from deepaccident_devkit.plugins.synth.spec import draw, read_design
from deepaccident_devkit.plugins.synth.traffic.accidents import Performance, set_stage, try_accident
from deepaccident_devkit.plugins.synth.traffic.placement import unplanned


def drawn(design, *seed):
    """A design, what becomes of it with a stranger, its junction, and the source of all that
    follows.
    """
    rng = np.random.default_rng(seed)
    spec = draw(read_design(design), rng)
    junction = Junction(spec.road)
    return spec, unplanned(rng, spec, junction), junction, rng


def played(seed):
    _, spec, junction, rng = drawn(1, seed, 77)
    stage = set_stage(rng, spec, junction, 6.0)
    return spec, stage, try_accident(stage)


@pytest.mark.slow
def test_a_stranger_meets_one_of_the_designed_pair_who_both_obey():
    made = [played(seed) for seed in range(8)]
    for spec, *_ in made:
        victim, stranger = spec.meet.actors
        assert (victim in ("ego", "other"), spec.design) == (True, None)
        assert not any(actor.ignores for actor in spec.actors if actor.role != stranger)
    assert {spec.meet.actors[1] for spec, *_ in made} == {"pedestrian", "background"}
    assert sum(isinstance(accident, Performance) for *_, accident in made) >= 6


def test_a_pedestrian_steps_out_behind_the_crest_of_a_hump():
    behind = []
    for seed in range(40):
        spec, changed, *_ = drawn(1, seed, 78)
        hump, stranger = spec.road.hump, changed.actors[-1]
        if hump is not None and stranger.role == "pedestrian" and stranger.from_arm == hump.arm:
            behind.append(hump.distance - stranger.start_distance)
    assert 15.0 <= min(behind) <= max(behind) <= 22.0
