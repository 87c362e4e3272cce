import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.roads import tag_of_code


@pytest.fixture(scope="module")
def rig(world, actor, rig_of):
    return rig_of(
        world,
        [actor(9, "truck", -20.0, 1.75, np.pi), actor(10, "pedestrian", -20.0, 1.75)],
        sensors="none",
    )


def test_bev_shows_the_map_around_the_agent(world, rig):
    scene = rig.scene(0.0)
    rows, columns = np.random.default_rng(0).integers(0, 1200, (2, 5000))
    ahead, left = (599.5 - rows) * 0.1, (599.5 - columns) * 0.1
    points = np.stack([ahead, left, 0.0 * left], axis=1)

    for agent in rig.agents:
        picture = rig.bev(scene, agent)
        x, y, _ = agent.ground_from_ego(scene).apply(points).T
        cells = ((y + 150) * 10).astype(int), ((x + 150) * 10).astype(int)
        expected = tag_of_code()[world.top.codes[cells]]

        free = picture.instance[rows, columns] == 0
        assert free.mean() > 0.9
        equal = picture.semantic[rows, columns] == expected
        assert equal[free].mean() > 0.99


def test_the_higher_actor_covers_the_lower_one(rig):
    """The pedestrian stands in the truck, so its pixels show the truck."""
    picture = rig.bev(rig.scene(0.0), rig.agents[0])
    truck = picture.instance == 10

    assert set(picture.semantic[truck].tolist()) == {10}
    assert 11 not in picture.instance
    assert truck.sum() == pytest.approx(8.47 * 2.89 / 0.01, rel=0.05)
