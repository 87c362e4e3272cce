from itertools import islice

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import Junction
from deepaccident_devkit.plugins.synth.spec import draw, read_design
from deepaccident_devkit.plugins.synth.traffic.accidents import Performance, perform_twin, set_stage, try_accident
from deepaccident_devkit.plugins.synth.traffic.placement import unplanned


def drawn(design, *seed):
    """A design, what becomes of it with a stranger, its junction, and the source of all that follows."""
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


def test_the_twin_has_no_accident():
    _, stage, _ = played(0)
    twin = perform_twin(stage, stage.cast.begin + 11.0)
    assert set(range(len(stage.cast.users))) <= set(twin.present)


def test_a_pedestrian_steps_out_behind_the_crest_of_a_hump():
    behind = []
    for seed in range(40):
        spec, changed, *_ = drawn(1, seed, 78)
        hump, stranger = spec.road.hump, changed.actors[-1]
        if hump is not None and stranger.role == "pedestrian" and stranger.from_arm == hump.arm:
            behind.append(hump.distance - stranger.start_distance)
    assert 15.0 <= min(behind) <= max(behind) <= 22.0


def test_where_there_are_two_lanes_some_change_into_the_victim_s():
    changing = (each for each in (drawn(7, seed, 79) for seed in range(200)) if each[1].actors[-1].lane_change)
    angles = []
    for _, spec, junction, rng in islice(changing, 5):
        stranger, victim = spec.actors[-1], spec.actor(spec.meet.actors[0])
        assert (stranger.from_arm, stranger.lane) == (victim.from_arm, 1 - victim.lane)
        stage = set_stage(rng, spec, junction, 6.0)
        accident = try_accident(stage)
        if isinstance(accident, Performance):
            one, other = accident.simulation.poses[-1, list(stage.cast.pair), 2]
            angles.append(abs(np.degrees(np.angle(np.exp(1j * (one - other))))))
    assert (len(angles) >= 3, max(angles) < 25) == (True, True)
