"""Light, weather and lamps show in the pictures."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.sensors.caster import GROUND, NOTHING
from deepaccident_devkit.plugins.synth.sensors.paint import facades_of, on_facades
from deepaccident_devkit.plugins.synth.sensors.render import look, ray_directions, slopes
from deepaccident_devkit.plugins.synth.sensors.shadows import wall_shadows
from deepaccident_devkit.plugins.synth.solids import FACES_A_SOLID, FRONT, REAR, Block

pytestmark = pytest.mark.slow


def picture(rig, signals=None, channel="Camera_Front", agent=0):
    scene = rig.scene(0.0)
    return dict(rig.images(scene, rig.surroundings(scene, signals or {}), rig.agents[agent], 1))[channel]


def pose_of(agent, scene, camera):
    return agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()


def test_noon_is_brighter_than_sunset_and_sunset_than_night(world, rig_of):
    noon, sunset, night = (picture(rig_of(world, sky=("Cloudy", time))).mean() for time in ("Noon", "Sunset", "Night"))
    assert noon > 1.15 * sunset > 1.15 * 2 * night


def test_haze_hides_what_is_far(world, bare, rig_of):
    """The contrast of two walls, one light and one dark, 100 m away, in hard rain and in clear air."""
    spans = (((-40, -1.75), (20,) * 3), ((-1.75, 40), (235,) * 3))
    walls = [Block((70.0, 71.0), span, (-0.1, 30.0), color) for span, color in spans]

    def contrast(weather):
        image = picture(rig_of(bare(world, walls), sky=(weather, "Noon"))).astype(int)
        return image[70:80, 120:135].mean() - image[70:80, 185:200].mean()

    assert contrast("Clear") > 60
    assert 0 < contrast("HardRain") < 0.4 * contrast("Clear")


def test_red_lights_are_red_and_green_ones_green(world, rig_of):
    """The light for those who come from the west, seen from the ego that waits for it."""
    rig = rig_of(world, image_size=(640, 360), places={"ego_vehicle": (-22.0, -1.75, 0.0)})
    red, green, dark = (picture(rig, signals).astype(int) for signals in ({"west": 0}, {"west": 2}, {}))
    assert 2 < (np.abs(red - green).max(axis=-1) > 60).sum() < 900
    for lit, other, channel, factor in ((red, green, 0, 2), (green, red, 1, 1.5)):
        gained = (lit - dark)[(lit - other)[..., channel] > 60]
        assert gained[:, channel].mean() > factor * np.abs(gained[:, 1 - channel]).mean()


def test_headlamps_light_the_road_ahead_at_night_alone(world, bare, rig_of):
    def ahead(time):
        rows = picture(rig_of(bare(world), sky=("Clear", time))).astype(float)[125:160, 130:190].mean(axis=(1, 2))
        return rows[15:].mean() / rows[:3].mean()

    assert ahead("Night") > 1.2 * ahead("Noon")


def test_cars_throw_shadows_in_the_sun(world, bare, actor, rig_of):
    car = actor(9, "car", -16.0, -1.75)
    with_car, without = (picture(rig_of(bare(world), others)).astype(int) for others in ([car], []))
    rig = rig_of(bare(world), [car])
    scene, camera = rig.scene(0.0), rig.agents[0].cameras[0]
    ground = look(scene, camera, pose_of(rig.agents[0], scene, camera)).all.face == GROUND
    assert (ground & ((without - with_car).mean(axis=-1) > 25)).sum() > 100


HOUSE = Block((-15.0, -5.0), (-9.0, 4.0), (-0.2, 13.2), (206, 190, 160), facade=True)
"""13 m wide towards the ego, which looks at it from the east."""
OPPOSITE = {"ego_vehicle": (30.0, -1.75, np.pi)}


def front_of_house(rig):
    """Face of the house that the ego looks at, the picture (pixels, 3), and where which pixels are on the face."""
    image, scene, camera = picture(rig), rig.scene(0.0), rig.agents[0].cameras[0]
    pose = pose_of(rig.agents[0], scene, camera)
    rays = look(scene, camera, pose).all
    points = ray_directions(pose, rays.right, rays.down) * rays.depth[..., None] + pose.translation
    front, facades = int(rig.setting.props[0]) * FACES_A_SOLID + FRONT, facades_of(rig.setting.still)
    places = on_facades(rays.face == front, rays.face, tuple(np.moveaxis(points, -1, 0)), facades)
    return front, image.reshape(-1, 3).astype(int), places


def test_things_throw_shadows_on_facades(world, bare, rig_of):
    """A slab before the house, and the strip of the front that it takes the sun from."""
    slab = Block((-1.0, -0.8), (-4.0, -1.0), (-0.2, 30.0), (90, 90, 90))
    rig = rig_of(bare(world, [HOUSE, slab]), sky=("Clear", "Sunset"), image_size=(640, 360), places=OPPOSITE)
    front, image, places = front_of_house(rig)
    sun = rig.studio.light.to_sun
    y = places.across - 9.0 + 4.1 * sun[1] / sun[0]
    shaded, sunny = (y > -3.7) & (y < -1.3), (y < -4.5) | (y > -0.5)
    brightness = image[places.pixel].mean(axis=1)
    assert np.median(brightness[shaded]) < 0.7 * np.median(brightness[sunny])
    shadows, behind = wall_shadows(rig.setting, facades_of(rig.setting.still), rig.studio.light), front - FRONT + REAR
    assert shadows.density[front] == pytest.approx(1 / 0.4, rel=0.05)
    assert (shadows.column[behind], shadows.density[behind], set(shadows.lit[:, 0].tolist())) == (0, 0, {255})


def test_depths_are_those_of_single_rays(world, actor, rig_of):
    """Interpolated pixels against a ray through each of them."""
    rig = rig_of(world, [actor(9, "truck", -10.0, 1.75, np.pi)], image_size=(240, 135))
    scene, agent = rig.scene(0.0), rig.agents[1]
    for camera in agent.cameras[:3]:
        pose = pose_of(agent, scene, camera)
        buffers, (right, down) = look(scene, camera, pose), slopes(camera, np.arange(240), np.arange(135))
        rays = ray_directions(pose, right[None], down[:, None]).reshape(-1, 3)
        depth, face = (each.reshape(135, 240) for each in scene.cast(pose.translation, rays))
        same = buffers.all.face == face
        assert same.mean() > 0.97
        sure = same & (face != NOTHING)
        sure.reshape(-1)[buffers.outline] = False
        np.testing.assert_allclose(buffers.all.depth[sure], depth[sure], rtol=2e-3)


@pytest.mark.parametrize("ground", ["world", "hilly_world"])
def test_wet_ground_mirrors_what_stands_on_it(ground, request, bare, rig_of):
    """The road before a red wall is redder than before a green one, with a hump elsewhere as well as without."""
    roads = request.getfixturevalue(ground)

    def before(color):
        wall = Block((0.0, 1.0), (-20.0, 20.0), (-0.1, 12.0), color)
        image = picture(rig_of(bare(roads, [wall]), sky=("Wet", "Noon"), places={"ego_vehicle": (-25.0, -1.75, 0.0)}))
        return image[112:125, 140:180].astype(int).mean(axis=(0, 1))

    red, green, _ = before((220, 20, 20)) - before((20, 220, 20))
    assert (red > 10, green < -10) == (True, True)


def test_pictures_are_the_seeds_alone(world, rig_of):
    first, again = (picture(rig_of(world, sky=("HardRain", "Night"))) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert (picture(rig_of(world, sky=("HardRain", "Night"), seed=(1,))) != first).any()


@pytest.mark.parametrize("size", [(16, 9), (33, 19)])
@pytest.mark.parametrize("roads", ["world", "hilly_world"])
def test_the_smallest_and_an_odd_size_work(request, roads, size, rig_of):
    rig = rig_of(request.getfixturevalue(roads), sky=("Wet", "Noon"), image_size=size)
    assert picture(rig).shape == (size[1], size[0], 3)
