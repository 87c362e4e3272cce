import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.sensors.caster import GROUND
from deepaccident_devkit.plugins.synth.sensors.lidar import (
    AIR_OF_WEATHER,
    RANGE_NOISE,
    intensity,
    scan,
)
from deepaccident_devkit.plugins.synth.solids import Block

DRY, RAIN = AIR_OF_WEATHER["Clear"], AIR_OF_WEATHER["HardRain"]
RED = (200, 30, 30)


def scan_of(rig, agent=0, air=DRY, seed=0, *, boxed=False):
    scene, agent = rig.scene(0.0), rig.agents[agent]
    pose, rng = agent.ground_from_lidar(scene), np.random.default_rng(seed)
    return scene, pose, scan(scene, rig.lidars[agent.name], pose, air, rng, boxed=boxed)


def test_points_lie_on_surfaces_within_the_noise(world, bare, rig_of):
    wall = Block((-20.0, -19.0), (-30.0, 30.0), (-0.1, 6.0), RED)
    _, pose, points = scan_of(rig_of(bare(world, [wall]), sensors="none"))
    on_wall = pose.apply(points.xyz[points.face == 1].astype(np.float64))
    ahead = on_wall[:, 0] - pose.translation[0]
    along = (on_wall[:, 0] + 20.0) * np.linalg.norm(on_wall - pose.translation, axis=1) / ahead
    assert (len(on_wall) > 3000, np.abs(along).max() < 6 * RANGE_NOISE) == (True, True)
    assert (along.std(), along.mean()) == (
        pytest.approx(RANGE_NOISE, rel=0.05),
        pytest.approx(0, abs=0.002),
    )


@pytest.mark.parametrize("kind", ["flat", "hilly"])
def test_points_of_the_ground_lie_on_the_terrain(world, hilly_world, rig_of, kind):
    place = world if kind == "flat" else hilly_world
    scene, pose, points = scan_of(
        rig_of(place, sensors="none", places={"ego_vehicle": (-48.0, -1.75, 0.0)})
    )
    ground = pose.apply(points.xyz[points.face == GROUND].astype(np.float64))
    above = ground[:, 2] - scene.setting.terrain.height(ground[:, :2])
    assert (
        np.abs(above).max() < 3 * RANGE_NOISE
    )  # along the ray, which looks down by 30 degrees at most
    assert (len(ground) > 5000, np.abs(ground[:, 2]).max() > 0.5) == (True, kind == "hilly")


def test_a_car_on_a_slope_is_tilted_with_its_sensors(hilly_world, rig_of):
    rig = rig_of(hilly_world, sensors="none", places={"ego_vehicle": (-70.0, -1.75, 0.0)})
    scene, agent = rig.scene(0.0), rig.agents[0]
    normal = scene.setting.terrain.normal(np.array([[-70.0, -1.75]]))[0]
    assert normal[2] < 0.998
    np.testing.assert_allclose(agent.ground_from_lidar(scene).rotation[:, 2], normal, atol=0.02)
    labels = rig.sighting(scene, agent, 1).labels
    own = int(np.flatnonzero(labels.actor_id == -100)[0])
    bottom, above = (
        labels.center[own, 2] - labels.size[own, 2] / 2,
        agent.ego_from_lidar.translation[2],
    )
    assert (bottom, labels.num_lidar_pts[own] > 300) == (
        pytest.approx(0.02 - above, abs=0.01),
        True,
    )


def test_more_gets_lost_in_rain(world, bare, rig_of):
    rig = rig_of(
        bare(world, [Block((19.0, 20.0), (-60.0, 60.0), (-0.1, 12.0), RED)]), sensors="none"
    )
    clear, rain = (len(scan_of(rig, air=air)[2].xyz) for air in (DRY, RAIN))
    assert rain < 0.95 * clear


def test_intensity_is_that_of_the_distance_before_the_noise(world, rig_of):
    """As in a real scenario: exp(−0.03 · distance), whatever the point lies on."""
    _, _, points = scan_of(rig_of(world, sensors="none"))
    bright = intensity(points, DRY)
    assert bright.dtype == np.float32
    off = np.linalg.norm(points.xyz, axis=1) + np.log(bright) / 0.03
    assert (off.std(), off.mean()) == (
        pytest.approx(RANGE_NOISE, rel=0.05),
        pytest.approx(0, abs=0.002),
    )
    assert (intensity(points, RAIN) < bright).all()
