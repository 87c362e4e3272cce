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
    for agent in rig.agents:
        picture, ground_from_ego = rig.bev(scene, agent), agent.ground_from_ego(scene)
        ahead, left = ((599.5 - index) * 0.1 for index in (rows, columns))
        x, y, _ = ground_from_ego.apply(np.stack([ahead, left, 0.0 * left], axis=1)).T
        expected = tag_of_code()[
            world.top.codes[((y + 150) * 10).astype(int), ((x + 150) * 10).astype(int)]
        ]
        free = picture.instance[rows, columns] == 0
        assert free.mean() > 0.9
        assert (picture.semantic[rows, columns] == expected)[free].mean() > 0.99


def test_who_is_higher_covers_who_is_lower(rig):
    """The pedestrian stands in the truck: its pixels are the truck's."""
    picture = rig.bev(rig.scene(0.0), rig.agents[0])
    truck = picture.instance == 10
    assert (set(picture.semantic[truck].tolist()), 11 in picture.instance) == ({10}, False)
    assert truck.sum() == pytest.approx(8.47 * 2.89 / 0.01, rel=0.05)
