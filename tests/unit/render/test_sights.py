"""Who sees an actor over time, by the agents' labels and the released rule."""

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.actors import sightings
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x import visible_instances


@pytest.mark.parametrize("agent", AGENTS)
def test_sightings_are_the_agent_s_annotations_and_the_released_rule(da: DeepAccident, other: str, agent: str) -> None:
    scenario, actor = other.split("/actor/")
    known = sightings(da, scenario, agent, int(actor))
    points, camera, seen = {}, {}, []
    for index in range(1, 7):
        sample = f"{scenario}/{agent}/{index:03d}"
        for annotation in da.annotation:
            if annotation["sample_token"] == sample and annotation["actor_id"] == int(actor):
                points[index], camera[index] = annotation["num_lidar_pts"], annotation["camera_visible"]
                seen.append(other in visible_instances(da, sample, agents=[agent]))
    assert known.index.tolist() == list(points)
    assert known.points.tolist() == list(points.values())
    assert known.camera.tolist() == list(camera.values())
    assert known.seen.tolist() == seen
    assert (agent == "other_vehicle") == (len(points) == 0)
