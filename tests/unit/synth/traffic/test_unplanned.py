from collections import Counter

import numpy as np
import pytest

from deepaccident_devkit.synth.roads import Junction
from deepaccident_devkit.synth.spec import draw, read_design
from deepaccident_devkit.synth.traffic.accidents import Performance, perform_twin, set_stage, try_accident
from deepaccident_devkit.synth.traffic.placement import unplanned


def played(seed, design=1):
    rng = np.random.default_rng([seed, 77])
    spec = draw(read_design(design), rng)
    junction = Junction(spec.road)
    spec = unplanned(rng, spec, junction)
    stage = set_stage(rng, spec, junction, 6.0)
    return spec, stage, try_accident(stage)


@pytest.mark.slow
def test_a_stranger_meets_one_of_the_designed_pair_who_both_obey():
    kinds, met = Counter(), 0
    for seed in range(8):
        spec, _, accident = played(seed)
        victim, stranger = spec.meet.actors
        kinds[stranger] += 1
        assert victim in ("ego", "other")
        assert spec.design is None
        assert all(not actor.ignores for actor in spec.actors if actor.role != stranger)
        met += isinstance(accident, Performance)
    assert set(kinds) == {"pedestrian", "background"}
    assert met >= 6


def test_the_twin_has_no_accident():
    _, stage, _ = played(0)
    twin = perform_twin(stage, stage.cast.begin + 11.0)
    assert twin is not None
    assert set(range(len(stage.cast.users))) <= set(twin.present)


def test_a_pedestrian_steps_out_behind_the_crest_of_a_hump():
    found = 0
    for seed in range(40):
        rng = np.random.default_rng([seed, 78])
        spec = draw(read_design(1), rng)
        hump = spec.road.hump
        changed = unplanned(rng, spec, Junction(spec.road))
        stranger = changed.actors[-1]
        if hump is not None and stranger.role == "pedestrian" and stranger.from_arm == hump.arm:
            found += 1
            assert 15.0 <= hump.distance - stranger.start_distance <= 22.0
    assert found > 0


def test_where_there_are_two_lanes_some_change_into_the_victim_s(monkeypatch):
    monkeypatch.setattr("deepaccident_devkit.synth.traffic.placement._PEDESTRIANS", 0.0)
    met = found = 0
    for seed in range(60):
        rng = np.random.default_rng([seed, 79])
        spec = draw(read_design(7), rng)
        junction = Junction(spec.road)
        changed = unplanned(rng, spec, junction)
        stranger = changed.actors[-1]
        if stranger.lane_change is None or found == 5:
            continue
        found += 1
        victim = changed.actor(changed.meet.actors[0])
        assert (stranger.from_arm, stranger.lane) == (victim.from_arm, 1 - victim.lane)
        stage = set_stage(rng, changed, junction, 6.0)
        accident = try_accident(stage)
        if isinstance(accident, Performance):
            met += 1
            one, other = accident.simulation.poses[-1, list(stage.cast.pair), 2]
            assert abs(np.degrees(np.angle(np.exp(1j * (one - other))))) < 25
    assert found >= 4
    assert met >= 3
