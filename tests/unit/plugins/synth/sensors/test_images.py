"""Light, weather and lamps show in the pictures."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.sensors.caster import GROUND
from deepaccident_devkit.plugins.synth.sensors.render import trace_picture
from deepaccident_devkit.plugins.synth.solids import Block

pytestmark = pytest.mark.slow


def take_picture(rig, signals=None, channel="Camera_Front", agent=0):
    scene = rig.scene(0.0)
    surroundings = rig.surroundings(scene, signals or {})
    pictures = dict(rig.images(scene, surroundings, rig.agents[agent], 1))
    return pictures[channel]


def test_noon_is_brighter_than_sunset_and_sunset_than_night(world, rig_of):
    noon, sunset, night = (
        take_picture(rig_of(world, sky=("Cloudy", time))).mean()
        for time in ("Noon", "Sunset", "Night")
    )
    assert noon > 1.15 * sunset > 1.15 * 2 * night


def test_red_lights_are_red_and_green_ones_green(world, rig_of):
    """The light for the west arm, seen from the ego that waits for it."""
    rig = rig_of(world, image_size=(640, 360), places={"ego_vehicle": (-22.0, -1.75, 0.0)})
    red, green, dark = (
        take_picture(rig, signals).astype(int) for signals in ({"west": 0}, {"west": 2}, {})
    )
    different = np.abs(red - green).max(axis=-1) > 60
    assert 2 < different.sum() < 900

    for lit, other, channel, factor in ((red, green, 0, 2), (green, red, 1, 1.5)):
        brighter = (lit - other)[..., channel] > 60
        gained = (lit - dark)[brighter]
        other_channel = np.abs(gained[:, 1 - channel])
        assert gained[:, channel].mean() > factor * other_channel.mean()


def test_headlamps_light_the_road_ahead_only_at_night(world, bare, rig_of):
    def near_to_far_ratio(time):
        picture = take_picture(rig_of(bare(world), sky=("Clear", time))).astype(float)
        rows = picture[125:160, 130:190].mean(axis=(1, 2))
        return rows[15:].mean() / rows[:3].mean()

    assert near_to_far_ratio("Night") > 1.2 * near_to_far_ratio("Noon")


def test_cars_throw_shadows_in_the_sun(world, bare, actor, rig_of):
    rig = rig_of(bare(world), [actor(9, "car", -16.0, -1.75)])
    with_car = take_picture(rig).astype(int)
    without = take_picture(rig_of(bare(world), [])).astype(int)
    darker = (without - with_car).mean(axis=-1) > 25

    scene = rig.scene(0.0)
    agent = rig.agents[0]
    camera = agent.cameras[0]
    pose = agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()
    on_ground = trace_picture(scene, camera, pose).all.face == GROUND
    assert (on_ground & darker).sum() > 100


@pytest.mark.parametrize("ground", ["world", "hilly_world"])
def test_wet_ground_mirrors_what_stands_on_it(ground, request, bare, rig_of):
    """The road in front of a red wall is redder than in front of a green one, whether or not there
    is a hump somewhere.
    """
    roads = request.getfixturevalue(ground)

    def road_color(wall_color):
        wall = Block((0.0, 1.0), (-20.0, 20.0), (-0.1, 12.0), wall_color)
        rig = rig_of(
            bare(roads, [wall]),
            sky=("Wet", "Noon"),
            places={"ego_vehicle": (-25.0, -1.75, 0.0)},
        )
        road = take_picture(rig)[112:125, 140:180]

        return road.astype(int).mean(axis=(0, 1))

    red, green, _ = road_color((220, 20, 20)) - road_color((20, 220, 20))
    assert red > 10
    assert green < -10


@pytest.mark.parametrize("size", [(16, 9), (33, 19)])
@pytest.mark.parametrize("roads", ["world", "hilly_world"])
def test_the_smallest_and_an_odd_size_work(request, roads, size, rig_of):
    width, height = size
    rig = rig_of(
        request.getfixturevalue(roads),
        sky=("Wet", "Noon"),
        image_size=size,
    )
    assert take_picture(rig).shape == (height, width, 3)
