"""A house on the street corner that hides the colliders from each other."""

from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.plan import plan_scenarios
from deepaccident_devkit.plugins.synth.scenario import build_scenario
from deepaccident_devkit.release import find_release, read_label, read_meta
from deepaccident_devkit.tables import visible_mask
from deepaccident_devkit.taxonomy import INFRASTRUCTURE, VEHICLE_AGENTS

EGO, EGO_BEHIND, OTHER, OTHER_BEHIND = VEHICLE_AGENTS
HIDDEN = {
    side: SynthConfig(scenarios=2, frames=22, sensors=False, view="hidden", seed=seed)
    for side, seed in (("left", 7), ("right", 0))
}
"""By where other comes from."""


def build(config, number=0):
    return build_scenario(config, plan_scenarios(config)[number])


@pytest.fixture(scope="module", params=HIDDEN)
def folder(request, tmp_path_factory):
    """The files of an accident, whose other comes from that side."""
    config = replace(HIDDEN[request.param], scenarios=1)
    assert build(config).meta.spawn_side == request.param
    root = make_release(tmp_path_factory.mktemp("hidden") / "release", config, workers=1)
    return next(each for each in find_release(root).scenarios if each.scenario_type.endswith("accident"))


def sees(folder, agent, actor, frame):
    boxes = read_label(folder.label_path(agent, frame)).boxes()
    seen = (boxes.center[:, :2], boxes.category, boxes.num_lidar_pts, boxes.camera_visible)
    return actor in boxes.actor_id[visible_mask(*seen, infrastructure=agent == INFRASTRUCTURE)]


@pytest.mark.slow
def test_ego_and_other_see_each_other_late_and_the_pole_sees_the_other(folder):
    scenario = build(HIDDEN[read_meta(folder.meta_path).spawn_side])
    ego, other = scenario.agents[EGO], scenario.agents[OTHER]
    frames = range(2, 18)  # 2 s to 0.5 s before the last, the 22nd
    pairs = ((EGO, other), (OTHER, ego), (INFRASTRUCTURE, other), (EGO_BEHIND, ego))
    seen = {agent: [sees(folder, agent, actor, frame) for frame in frames] for agent, actor in pairs}
    assert seen[EGO][:9] == seen[OTHER][:9] == [False] * 9  # until 1.2 s before
    assert sum(seen[EGO]) < len(frames) / 2
    assert seen[INFRASTRUCTURE] == seen[EGO_BEHIND] == [True] * len(frames)


@pytest.mark.parametrize("side", HIDDEN)
@pytest.mark.parametrize("number", [0, 1])
def test_nobody_walks_or_parks_in_the_house(side, number):
    """The house takes the sidewalk of its corner; its quadrant lies between ego and other."""
    scenario = build(HIDDEN[side], number)
    sign = 1 if scenario.meta.spawn_side == "left" else -1
    for time in np.linspace(0, 2.1, 22):
        x, y = scenario.actors.at(time).poses[:, :2].T
        edge = scenario.spec.road.road_edge + 0.5
        assert not ((x < -edge) & (x > -27) & (sign * y > edge) & (sign * y < 27)).any()
