import numpy as np
import pytest

from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.plugins.synth.sensors.caster import GROUND
from deepaccident_devkit.plugins.synth.sensors.lidar import (
    AIR_OF_WEATHER,
    RANGE_NOISE,
    Air,
    cast_all,
    intensity,
    lidar_ray_directions,
    returns,
    scan,
)
from deepaccident_devkit.plugins.synth.solids import Block

DRY, RAIN = AIR_OF_WEATHER["Clear"], AIR_OF_WEATHER["HardRain"]
RED = (200, 30, 30)


def scan_of(rig, agent=0, air=DRY, seed=0, *, boxed=False):
    scene, agent = rig.scene(0.0), rig.agents[agent]
    pose, rng = agent.ground_from_lidar(scene), np.random.default_rng(seed)
    return scene, pose, scan(scene, rig.lidars[agent.name], pose, air, rng, boxed=boxed)


def poses_of(scene, ground_from_lidar):
    """Centres, sizes and yaws of all boxes in the LiDAR frame."""
    lidar_from_ground = ground_from_lidar.inverse()
    center = lidar_from_ground.apply(scene.box_corners.mean(axis=1))
    ahead = lidar_from_ground.rotate(scene.frames[:, :3, 0])
    return center, scene.actors.size, np.arctan2(ahead[:, 1], ahead[:, 0])


def test_points_lie_on_surfaces_within_the_noise(world, bare, rig_of):
    wall = Block((-20.0, -19.0), (-30.0, 30.0), (-0.1, 6.0), RED)
    _, pose, points = scan_of(rig_of(bare(world, [wall]), sensors="none"))
    on_wall = pose.apply(points.xyz[points.face == 1].astype(np.float64))
    ahead = on_wall[:, 0] - pose.translation[0]
    along = (on_wall[:, 0] + 20.0) * np.linalg.norm(on_wall - pose.translation, axis=1) / ahead
    assert (len(on_wall) > 3000, np.abs(along).max() < 6 * RANGE_NOISE) == (True, True)
    assert (along.std(), along.mean()) == (pytest.approx(RANGE_NOISE, rel=0.05), pytest.approx(0, abs=0.002))


@pytest.mark.parametrize("kind", ["flat", "hilly"])
def test_points_of_the_ground_lie_on_the_terrain(world, hilly_world, rig_of, kind):
    place = world if kind == "flat" else hilly_world
    scene, pose, points = scan_of(rig_of(place, sensors="none", places={"ego_vehicle": (-48.0, -1.75, 0.0)}))
    ground = pose.apply(points.xyz[points.face == GROUND].astype(np.float64))
    above = ground[:, 2] - scene.setting.terrain.height(ground[:, :2])
    assert np.abs(above).max() < 3 * RANGE_NOISE  # along the ray, which looks down by 30 degrees at most
    assert (len(ground) > 5000, np.abs(ground[:, 2]).max() > 0.5) == (True, kind == "hilly")


def test_a_car_on_a_slope_is_tilted_with_its_sensors(hilly_world, rig_of):
    rig = rig_of(hilly_world, sensors="none", places={"ego_vehicle": (-70.0, -1.75, 0.0)})
    scene, agent = rig.scene(0.0), rig.agents[0]
    normal = scene.setting.terrain.normal(np.array([[-70.0, -1.75]]))[0]
    assert normal[2] < 0.998
    np.testing.assert_allclose(agent.ground_from_lidar(scene).rotation[:, 2], normal, atol=0.02)
    labels = rig.sighting(scene, agent, 1).labels
    own = int(np.flatnonzero(labels.actor_id == -100)[0])
    bottom, above = labels.center[own, 2] - labels.size[own, 2] / 2, agent.ego_from_lidar.translation[2]
    assert (bottom, labels.num_lidar_pts[own] > 300) == (pytest.approx(0.02 - above, abs=0.01), True)


@pytest.fixture
def crowd(actor):
    trucks = [actor(10 + k, "truck", -60.0 + 17 * k, 1.75, np.pi) for k in range(8)]
    pedestrians = [actor(30 + k, "pedestrian", -40.0 + 5 * k, -7.0) for k in range(8)]
    return trucks + pedestrians + [actor(50 + k, "car", -70.0 + 20 * k, -4.8, parked=True) for k in range(3)]


@pytest.mark.slow
@pytest.mark.parametrize("place", ["world", "hilly_world"])
@pytest.mark.parametrize("air", [DRY, RAIN, Air(drops=0.7)])
def test_boxed_all_points_in_boxes_are_there(request, crowd, rig_of, place, air):
    """Of what lies in a box, raindrops too; far fewer rays are followed."""
    rig = rig_of(request.getfixturevalue(place), crowd, sensors="none")
    for agent in range(5):
        scene, pose, full = scan_of(rig, agent, air)
        _, _, boxed = scan_of(rig, agent, air, boxed=True)
        boxes = Boxes.from_arrays(*poses_of(scene, pose), frame="lidar")
        found = []
        for points in (full, boxed):
            box, point = np.nonzero(boxes.contains(points.xyz))
            order = np.lexsort([points.ray[point], box])
            found.append((box[order], points.ray[point][order], points.xyz[point][order], points.face[point][order]))
        assert len(found[0][0]) > 500
        for one, other in zip(*found, strict=True):
            np.testing.assert_array_equal(one, other)
        assert len(boxed.xyz) < 0.75 * len(full.xyz)


def test_the_own_body_is_met_where_it_is(world, rig_of):
    """What is worked out once for all moments, against a cast at one."""
    rig = rig_of(world, sensors="none")
    scene, agent = rig.scene(0.0), rig.agents[0]
    pose, lidar = agent.ground_from_lidar(scene), rig.lidars[agent.name]
    met = np.isfinite(lidar.distance)
    assert 300 < met.sum() < len(lidar.body)
    distance, face = scene.cast(pose.translation, pose.rotate(lidar_ray_directions()[lidar.body]).astype(np.float32))
    np.testing.assert_array_equal(scene.face_owner[face] == agent.row, met)
    np.testing.assert_allclose(distance[met], lidar.distance[met], atol=1e-4)
    assert (face[met] == lidar.face[met]).mean() > 0.99
    rows, everywhere, _ = cast_all(scene, lidar, pose)
    np.testing.assert_array_equal(everywhere[lidar.body[met]], lidar.distance[met])
    assert len(rows) == len(lidar_ray_directions())


def test_more_gets_lost_in_rain_and_of_what_comes_back_weak(world, bare, rig_of):
    rig = rig_of(bare(world, [Block((19.0, 20.0), (-60.0, 60.0), (-0.1, 12.0), RED)]), sensors="none")
    clear, rain = (len(scan_of(rig, air=air)[2].xyz) for air in (DRY, RAIN))
    assert rain < 0.95 * clear
    reach = np.repeat(np.array([5.0, 30.0, 69.0], dtype=np.float32), 10_000)
    kept = returns(reach, np.tile(np.linspace(0, 1, 10_000, dtype=np.float32), 3), DRY).reshape(3, -1).mean(axis=1)
    expected = 1 - 0.4 * np.maximum(1 - np.exp(-0.03 * np.array([5.0, 30.0, 69.0])) / 0.8, 0)
    np.testing.assert_allclose(kept, expected, atol=1e-3)
    assert not returns(np.array([70.1, np.inf], dtype=np.float32), np.ones(2, dtype=np.float32), DRY).any()


def test_rain_sends_rays_back(world, rig_of):
    rig = rig_of(world, sensors="none")
    assert (scan_of(rig)[2].face == -1).sum() == 0
    assert (scan_of(rig, air=RAIN)[2].face == -1).sum() > 20


def test_intensity_is_that_of_the_distance_before_the_noise(world, rig_of):
    """As in a real scenario: exp(−0.03 · distance), whatever the point lies on."""
    _, _, points = scan_of(rig_of(world, sensors="none"))
    bright = intensity(points, DRY)
    assert bright.dtype == np.float32
    off = np.linalg.norm(points.xyz, axis=1) + np.log(bright) / 0.03
    assert (off.std(), off.mean()) == (pytest.approx(RANGE_NOISE, rel=0.05), pytest.approx(0, abs=0.002))
    assert (intensity(points, RAIN) < bright).all()


def test_noise_is_the_seeds_alone(world, rig_of):
    rig = rig_of(world, sensors="none")
    first, again, other = (scan_of(rig, seed=seed)[2].xyz for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or (first != other).any()
