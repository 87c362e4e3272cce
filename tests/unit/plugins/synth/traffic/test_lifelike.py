"""Releases that are like the real one; docs/synth.md has the numbers over more scenarios."""

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


def test_all_kinds_of_accidents_happen_between_the_agents_they_name(collided):
    kinds = list(ACCIDENT_KINDS.values())
    numbers = set()
    for scenario in collided:
        kind = scenario.plan.kind
        numbers.add(kinds.index(kind))
        agents = [
            agent and agent.replace("_vehicle", "") for agent in scenario.meta.collision.agents
        ]
        if kind.pair is None:
            assert agents[1] is None
        else:
            assert agents == list(kind.pair)
    assert len(numbers) >= len(kinds) - 1


def test_contact_begins_up_to_three_frames_before_the_end(collided):
    contact_frames = set()

    for scenario in collided:
        ids = scenario.meta.collision.ids
        if 0 in ids:
            continue
        actors = scenario.actors
        first, second = (actors.row_of(actor) for actor in ids)
        times = np.arange(scenario.frames) / 10
        gaps = separation(
            actors.all[first].motion.poses(times),
            actors.size[first, :2],
            actors.all[second].motion.poses(times),
            actors.size[second, :2],
        )
        touching = int((gaps <= 0).sum())
        contact_frames.add(touching)
        assert (gaps[: -1 - touching] > 0).all()
        assert -0.78 < gaps[-1] < 0.6

    assert {3, 4} < contact_frames < {*range(5)}


def test_an_unlabelled_partner_has_the_id_0(collided):
    unlabelled = [scenario for scenario in collided if not scenario.plan.kind.labelled]
    assert unlabelled

    for scenario in unlabelled:
        assert scenario.meta.collision.ids[1] == 0
        assert 0 not in scenario.actors.actor_id


def test_meta_has_the_words_of_the_release(collided):
    collisions = [scenario.meta.collision for scenario in collided]
    assert {collision.spawn_relation for collision in collisions} == {"same", "opposite"}
    assert {collision.contact_side for collision in collisions} == {
        "front",
        "front_side",
        "rear",
        "rear_side",
    }


def test_normal_scenarios_are_longer_and_some_folders_say_otherwise(built):
    accident_frames = [scenario.frames for scenario in built if scenario.meta.collision]
    normal_frames = [scenario.frames for scenario in built if not scenario.meta.collision]
    assert 36 <= min(accident_frames) <= max(accident_frames) <= 95
    assert min(normal_frames) >= 93
    assert max(normal_frames) == 100

    plans = plan_scenarios(SynthConfig(scenarios=600, seed=1))
    assert 9 <= sum(plan.misfiled for plan in plans) <= 30


def test_agents_start_slowly_and_some_become_fast(built):
    speeds = []
    for scenario in built:
        for actor in scenario.agents.values():
            motion = scenario.actors.all[scenario.actors.row_of(actor)].motion
            speeds.append(np.hypot(*motion.velocities([0.0, 2.0, 4.0]).T))

    start_speeds = np.array(speeds)[:, 0]
    assert 2.5 < np.median(start_speeds) < 4.5
    assert (start_speeds < 0.5).any()
    assert 15.0 < np.max(speeds) < 18.7
