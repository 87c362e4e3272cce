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


def scan_scene(rig, agent=0, air=DRY, seed=0, *, boxed=False):
    """Return the scene at time 0, the pose of an agent's LiDAR, and its scan."""
    scene = rig.scene(0.0)
    agent = rig.agents[agent]
    pose = agent.ground_from_lidar(scene)
    lidar = rig.lidars[agent.name]

    return scene, pose, scan(scene, lidar, pose, air, np.random.default_rng(seed), boxed=boxed)


def test_points_lie_on_surfaces_within_the_noise(world, bare, rig_of):
    wall = Block((-20.0, -19.0), (-30.0, 30.0), (-0.1, 6.0), RED)
    _, pose, points = scan_scene(rig_of(bare(world, [wall]), sensors="none"))
    on_wall = pose.apply(points.xyz[points.face == 1].astype(np.float64))
    assert len(on_wall) > 3000

    from_lidar = on_wall - pose.translation
    ranges = np.linalg.norm(from_lidar, axis=1)
    errors = (on_wall[:, 0] + 20.0) * ranges / from_lidar[:, 0]
    assert np.abs(errors).max() < 6 * RANGE_NOISE
    assert errors.std() == pytest.approx(RANGE_NOISE, rel=0.05)
    assert errors.mean() == pytest.approx(0, abs=0.002)


@pytest.mark.parametrize("kind", ["flat", "hilly"])
def test_points_of_the_ground_lie_on_the_terrain(world, hilly_world, rig_of, kind):
    rig = rig_of(
        world if kind == "flat" else hilly_world,
        sensors="none",
        places={"ego_vehicle": (-48.0, -1.75, 0.0)},
    )
    scene, pose, points = scan_scene(rig)
    ground = pose.apply(points.xyz[points.face == GROUND].astype(np.float64))
    assert len(ground) > 5000
    assert (np.abs(ground[:, 2]).max() > 0.5) == (kind == "hilly")

    # the noise is along the ray, which looks down by 30 degrees at most
    errors = ground[:, 2] - scene.setting.terrain.height(ground[:, :2])
    assert np.abs(errors).max() < 3 * RANGE_NOISE


def test_a_car_on_a_slope_is_tilted_with_its_sensors(hilly_world, rig_of):
    rig = rig_of(hilly_world, sensors="none", places={"ego_vehicle": (-70.0, -1.75, 0.0)})
    scene = rig.scene(0.0)
    agent = rig.agents[0]
    normal = scene.setting.terrain.normal(np.array([[-70.0, -1.75]]))[0]
    assert normal[2] < 0.998
    np.testing.assert_allclose(agent.ground_from_lidar(scene).rotation[:, 2], normal, atol=0.02)

    labels = rig.sighting(scene, agent, 1).labels
    own = int(np.flatnonzero(labels.actor_id == -100)[0])
    bottom = labels.center[own, 2] - labels.size[own, 2] / 2
    lidar_height = agent.ego_from_lidar.translation[2]
    assert bottom == pytest.approx(0.02 - lidar_height, abs=0.01)
    assert labels.num_lidar_pts[own] > 300


def test_more_points_get_lost_in_rain(world, bare, rig_of):
    wall = Block((19.0, 20.0), (-60.0, 60.0), (-0.1, 12.0), RED)
    rig = rig_of(bare(world, [wall]), sensors="none")
    _, _, dry_points = scan_scene(rig, air=DRY)
    _, _, rain_points = scan_scene(rig, air=RAIN)

    assert len(rain_points.xyz) < 0.95 * len(dry_points.xyz)


def test_intensity_follows_from_the_distance_before_the_noise(world, rig_of):
    """As in a real scenario it is exp(−0.03 · distance), whatever the point lies on."""
    _, _, points = scan_scene(rig_of(world, sensors="none"))
    intensities = intensity(points, DRY)
    assert intensities.dtype == np.float32
    assert (intensity(points, RAIN) < intensities).all()

    errors = np.linalg.norm(points.xyz, axis=1) + np.log(intensities) / 0.03
    assert errors.std() == pytest.approx(RANGE_NOISE, rel=0.05)
    assert errors.mean() == pytest.approx(0, abs=0.002)
