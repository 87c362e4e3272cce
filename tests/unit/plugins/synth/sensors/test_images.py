"""Light, weather and lamps show in the pictures."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.sensors.caster import GROUND
from deepaccident_devkit.plugins.synth.sensors.render import trace_picture
from deepaccident_devkit.plugins.synth.solids import Block

pytestmark = pytest.mark.slow


def picture(rig, signals=None, channel="Camera_Front", agent=0):
    scene = rig.scene(0.0)
    return dict(rig.images(scene, rig.surroundings(scene, signals or {}), rig.agents[agent], 1))[
        channel
    ]


def pose_of(agent, scene, camera):
    return agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()


def test_noon_is_brighter_than_sunset_and_sunset_than_night(world, rig_of):
    noon, sunset, night = (
        picture(rig_of(world, sky=("Cloudy", time))).mean() for time in ("Noon", "Sunset", "Night")
    )
    assert noon > 1.15 * sunset > 1.15 * 2 * night


def test_red_lights_are_red_and_green_ones_green(world, rig_of):
    """The light for those who come from the west, seen from the ego that waits for it."""
    rig = rig_of(world, image_size=(640, 360), places={"ego_vehicle": (-22.0, -1.75, 0.0)})
    red, green, dark = (
        picture(rig, signals).astype(int) for signals in ({"west": 0}, {"west": 2}, {})
    )
    assert 2 < (np.abs(red - green).max(axis=-1) > 60).sum() < 900
    for lit, other, channel, factor in ((red, green, 0, 2), (green, red, 1, 1.5)):
        gained = (lit - dark)[(lit - other)[..., channel] > 60]
        assert gained[:, channel].mean() > factor * np.abs(gained[:, 1 - channel]).mean()


def test_headlamps_light_the_road_ahead_at_night_alone(world, bare, rig_of):
    def ahead(time):
        rows = (
            picture(rig_of(bare(world), sky=("Clear", time)))
            .astype(float)[125:160, 130:190]
            .mean(axis=(1, 2))
        )
        return rows[15:].mean() / rows[:3].mean()

    assert ahead("Night") > 1.2 * ahead("Noon")


def test_cars_throw_shadows_in_the_sun(world, bare, actor, rig_of):
    car = actor(9, "car", -16.0, -1.75)
    with_car, without = (picture(rig_of(bare(world), others)).astype(int) for others in ([car], []))
    rig = rig_of(bare(world), [car])
    scene, camera = rig.scene(0.0), rig.agents[0].cameras[0]
    ground = trace_picture(scene, camera, pose_of(rig.agents[0], scene, camera)).all.face == GROUND
    assert (ground & ((without - with_car).mean(axis=-1) > 25)).sum() > 100


@pytest.mark.parametrize("ground", ["world", "hilly_world"])
def test_wet_ground_mirrors_what_stands_on_it(ground, request, bare, rig_of):
    """The road before a red wall is redder than before a green one, with a hump elsewhere as well
    as without.
    """
    roads = request.getfixturevalue(ground)

    def before(color):
        wall = Block((0.0, 1.0), (-20.0, 20.0), (-0.1, 12.0), color)
        image = picture(
            rig_of(
                bare(roads, [wall]),
                sky=("Wet", "Noon"),
                places={"ego_vehicle": (-25.0, -1.75, 0.0)},
            )
        )
        return image[112:125, 140:180].astype(int).mean(axis=(0, 1))

    red, green, _ = before((220, 20, 20)) - before((20, 220, 20))
    assert (red > 10, green < -10) == (True, True)


@pytest.mark.parametrize("size", [(16, 9), (33, 19)])
@pytest.mark.parametrize("roads", ["world", "hilly_world"])
def test_the_smallest_and_an_odd_size_work(request, roads, size, rig_of):
    rig = rig_of(request.getfixturevalue(roads), sky=("Wet", "Noon"), image_size=size)
    assert picture(rig).shape == (size[1], size[0], 3)
