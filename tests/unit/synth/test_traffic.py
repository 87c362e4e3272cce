import itertools

import numpy as np
import pytest

from deepaccident_devkit.synth.collision import gap
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.scenario import build_scenario, plan_scenarios


@pytest.mark.parametrize("accident", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_all_keep_clear_of_all_but_the_colliding_pair(seed, accident):
    config = SynthConfig(scenarios=2, frames=50, seed=seed)
    scenario = build_scenario(config, plan_scenarios(config)[0 if accident else 1])
    times = np.arange(0, 4.9, 0.03)
    poses = np.stack([actor.motion.poses(times) for actor in scenario.actors.all])
    sizes = scenario.actors.size[:, :2]
    for a, b in itertools.combinations(range(len(poses)), 2):
        assert gap(poses[a], sizes[a], poses[b], sizes[b]).min() > 0


def test_every_category_moves_about_over_a_few_scenes():
    config = SynthConfig(scenarios=8)
    found = {actor.category for plan in plan_scenarios(config) for actor in build_scenario(config, plan).actors.all}
    assert found == {"car", "van", "truck", "motorcycle", "cyclist", "pedestrian"}


def test_ids_are_unique_and_of_their_kind():
    config = SynthConfig(scenarios=1)
    actors = build_scenario(config, plan_scenarios(config)[0]).actors
    assert len(set(actors.actor_id.tolist())) == len(set(actors.object_id.tolist())) == len(actors)
    speed = np.hypot(*actors.at(0.0).velocities.T)
    np.testing.assert_array_equal(speed[actors.actor_id >= 20000], 0)
    assert (actors.actor_id >= 20000).sum() >= 4
    assert actors.actor_id[actors.actor_id < 20000].max() < 3000


def test_shapes_stay_inside_their_boxes():
    config = SynthConfig(scenarios=8)
    for plan in plan_scenarios(config):
        for actor in build_scenario(config, plan).actors.all:
            length, width, height = actor.size
            low, high = actor.shape.corners.min(axis=(0, 1)), actor.shape.corners.max(axis=(0, 1))
            limit = np.array([length / 2, width / 2, height + 0.02]) - 0.0099
            assert (high <= limit).all(), actor.category
            assert (low >= [-limit[0], -limit[1], 0.0299]).all(), actor.category


def test_only_the_accident_ends_in_a_contact():
    config = SynthConfig(scenarios=2, frames=40, seed=3)
    least = []
    for plan in plan_scenarios(config):
        scenario = build_scenario(config, plan)
        ego, other = (scenario.actors.row_of(scenario.agents[agent]) for agent in ("ego_vehicle", "other_vehicle"))
        poses = np.stack([scenario.actors.at(frame / 10).poses for frame in range(40)])
        size = scenario.actors.size[:, :2]
        least.append(gap(poses[:, ego], size[ego], poses[:, other], size[other]).min())
    assert least[0] < 1e-6
    assert least[1] > 2
