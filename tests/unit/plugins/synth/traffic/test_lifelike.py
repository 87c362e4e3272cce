"""Releases that are as the real one is; docs/synth.md has the numbers over more scenarios."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.plan import SynthConfig, plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.plugins.synth.traffic.lifelike import ACCIDENT_KINDS
from deepaccident_devkit.plugins.synth.traffic.simulate import separation

pytestmark = pytest.mark.slow

CONFIG = SynthConfig(scenarios=48, frames=None, seed=4004)


@pytest.fixture(scope="module")
def built():
    return [build_scenario(CONFIG, plan) for plan in plan_scenarios(CONFIG)]


@pytest.fixture(scope="module")
def collided(built):
    return [scenario for scenario in built if scenario.meta.collision]


def test_all_kinds_of_accidents_happen_between_those_they_name(collided):
    kinds, pairs = list(ACCIDENT_KINDS.values()), {}
    for scenario in collided:
        agents = [
            agent and agent.replace("_vehicle", "") for agent in scenario.meta.collision.agents
        ]
        pairs.setdefault(kinds.index(scenario.plan.kind), []).append(agents)
    assert len(pairs) >= len(kinds) - 1
    for number, found in pairs.items():
        named = kinds[number].pair
        assert all(
            agents[1] is None if named is None else agents == list(named) for agents in found
        )


def test_contact_begins_up_to_three_frames_before_the_end(collided):
    touching = []
    for scenario in collided:
        actors, ids = scenario.actors, scenario.meta.collision.ids
        if 0 not in ids:
            rows, times = [actors.row_of(each) for each in ids], np.arange(scenario.frames) / 10
            first, second = (actors.all[row].motion.poses(times) for row in rows)
            apart = separation(first, actors.size[rows[0], :2], second, actors.size[rows[1], :2])
            touching.append(int((apart <= 0).sum()))
            assert (apart[: -1 - touching[-1]] > 0).all()
            assert -0.78 < apart[-1] < 0.6
    assert {3, 4} < {*touching} < {*range(5)}


def test_a_partner_whom_no_label_names_has_the_id_0(collided):
    found = {
        (scenario.meta.collision.ids[1], 0 in scenario.actors.actor_id)
        for scenario in collided
        if not scenario.plan.kind.labelled
    }
    assert found == {(0, False)}


def test_meta_has_the_words_of_the_release(collided):
    metas = [scenario.meta.collision for scenario in collided]
    assert ({meta.spawn_relation for meta in metas}, {meta.contact_side for meta in metas}) == (
        {"same", "opposite"},
        {"front", "front_side", "rear", "rear_side"},
    )


def test_normal_scenarios_are_longer_and_some_folders_say_otherwise(built):
    accidents, normals = (
        [each.frames for each in built if bool(each.meta.collision) == sort]
        for sort in (True, False)
    )
    assert (min(accidents) >= 36, max(accidents) <= 95, min(normals) >= 93, max(normals)) == (
        True,
        True,
        True,
        100,
    )
    misfiled = sum(plan.misfiled for plan in plan_scenarios(SynthConfig(scenarios=600, seed=1)))
    assert 9 <= misfiled <= 30


def test_agents_start_slowly_and_some_become_fast(built):
    speeds = np.concatenate(
        [
            np.hypot(
                *scenario.actors.all[scenario.actors.row_of(actor)]
                .motion.velocities([0.0, 2.0, 4.0])
                .T
            )
            for scenario in built
            for actor in scenario.agents.values()
        ]
    )
    assert 2.5 < np.median(speeds[::3]) < 4.5
    assert (speeds[::3] < 0.5).any()
    assert 15.0 < speeds.max() < 18.7
