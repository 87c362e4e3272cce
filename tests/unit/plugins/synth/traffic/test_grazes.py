"""Contacts besides the accident: which road users touch, and when."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.plan import SynthConfig, plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.plugins.synth.traffic.simulate import separation


@pytest.mark.slow
def test_a_graze_is_one_more_contact_without_the_accident_s_pair():
    config = SynthConfig(scenarios=24, frames=None, seed=11)
    plans = [plan for plan in plan_scenarios(config) if plan.grazes]
    grazes = 0
    for plan in plans:
        scenario = build_scenario(plan=plan, config=config)
        actors = scenario.actors
        collision = scenario.meta.collision
        pair = set(collision.ids) if collision else set()

        times = np.arange(scenario.frames) / 10
        rows = np.flatnonzero(actors.actor_id < 20000)
        poses = np.stack([actors.all[row].motion.poses(times) for row in rows])
        sizes = actors.size[rows, :2]
        gaps = separation(poses[:, None], sizes[:, None, None], poses, sizes[:, None])
        touching = np.triu(gaps.min(axis=-1) < 0, 1)

        contacts = {
            frozenset(actors.actor_id[rows[contact]].tolist()) for contact in np.argwhere(touching)
        }
        contacts.discard(frozenset(pair))
        assert len(contacts) <= 1
        for contact in contacts:
            assert not contact & pair
        grazes += len(contacts)
    assert grazes >= len(plans) / 3
