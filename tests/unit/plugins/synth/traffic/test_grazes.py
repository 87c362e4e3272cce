"""Contacts beside the accident: who touches whom, when, and how."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.plan import SynthConfig, plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.plugins.synth.traffic.simulate import separation


@pytest.mark.slow
def test_scenarios_with_a_graze_have_one_contact_more_and_not_of_the_accident():
    plans = [
        plan
        for plan in plan_scenarios(SynthConfig(scenarios=24, frames=None, seed=11))
        if plan.grazes
    ]
    touched = 0
    for plan in plans:
        scenario = build_scenario(plan=plan, config=SynthConfig(scenarios=24, frames=None, seed=11))
        actors, pair = (
            scenario.actors,
            scenario.meta.collision.ids if scenario.meta.collision else (),
        )
        rows = np.flatnonzero(actors.actor_id < 20000)
        poses = np.stack(
            [actors.all[row].motion.poses(np.arange(scenario.frames) / 10) for row in rows]
        )
        size = actors.size[rows, :2]
        gaps = separation(poses[:, None], size[:, None, None], poses, size[:, None]).min(axis=-1)
        contacts = {
            (actors.actor_id[rows[i]], actors.actor_id[rows[j]])
            for i, j in np.argwhere(np.triu(gaps < 0, 1))
        }
        others = [two for two in contacts if set(two) != set(pair)]
        assert len(others) <= 1
        assert not any(set(two) & set(pair) for two in others)
        touched += len(others)
    assert touched >= len(plans) / 3
