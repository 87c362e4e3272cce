"""Scenes, seen directly: points on surfaces, cameras against labels."""

from dataclasses import replace

import numpy as np
import pytest

from deepaccident_devkit.synth.agents import make_agents
from deepaccident_devkit.synth.annotate import camera_visible
from deepaccident_devkit.synth.bev import bev_picture
from deepaccident_devkit.synth.camera import _pixel_slopes, _ray_directions, paint, render
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.lidar import scan
from deepaccident_devkit.synth.look import make_look
from deepaccident_devkit.synth.roads import tag_of_code
from deepaccident_devkit.synth.scenario import build_scenario, plan_scenarios
from deepaccident_devkit.synth.scene import GROUND, ground_distance, make_scene
from deepaccident_devkit.taxonomy import TIMES_OF_DAY, WEATHERS


@pytest.fixture(scope="module")
def scenario():
    config = SynthConfig(scenarios=1, frames=30, seed=2)
    return build_scenario(config, plan_scenarios(config)[0])


@pytest.fixture(scope="module")
def scene(scenario):
    return make_scene(scenario.world, scenario.actors, 2.0)


@pytest.fixture(scope="module")
def agents(scenario):
    return make_agents(scenario, (480, 270))


def test_points_lie_on_surfaces(scenario, scene, agents):
    for agent in agents:
        ground_from_lidar = agent.ground_from_ego(scene.snapshot) @ agent.ego_from_lidar
        xyz = ground_from_lidar @ scan(scene, ground_from_lidar).xyz.astype(np.float64)
        off = np.abs(xyz[:, 2])
        for quad, normal, offset in zip(scene.quads, scene.normals, scene.offsets, strict=True):
            near = np.flatnonzero(np.abs(xyz @ normal - offset) < 1e-4)
            edges = np.roll(quad, -1, axis=0) - quad
            beside = np.cross(edges[None], xyz[near, None] - quad[None]) @ normal
            inside = (beside >= -1e-3).all(axis=1)
            off[near[inside]] = 0
        assert off.max() < 1e-4
        assert (np.abs(xyz[:, 2]) > 0.1).mean() > 0.2


def test_visible_is_what_the_pixels_show(scene, agents):
    disagreeing = compared = 0
    for agent in agents:
        ground_from_lidar = agent.ground_from_ego(scene.snapshot) @ agent.ego_from_lidar
        shown = np.zeros(len(scene.actors), dtype=int)
        for camera in agent.cameras:
            ground_from_camera = ground_from_lidar @ camera.camera_from_lidar.inverse()
            rays = _ray_directions(ground_from_camera, *_pixel_slopes(camera)).reshape(-1, 3)
            _, face = scene.cast(ground_from_camera.translation, rays.astype(np.float64))
            owner = scene.owner_of(face)
            shown += np.bincount(owner[owner >= 0], minlength=len(shown))
        near = np.hypot(*(scene.snapshot.poses[:, :2] - ground_from_lidar.translation[:2]).T) < 70
        if agent.row is not None:
            assert shown[agent.row] == 0
        seen = camera_visible(scene, agent, ground_from_lidar)
        disagreeing += (seen != (shown > 0))[near].sum()
        compared += near.sum()
        assert seen[near & (shown > 60)].all()
    assert compared > 100
    assert disagreeing / compared < 0.04


def test_painting_an_actor_changes_its_pixels_and_no_others(scenario, scene, agents):
    pole = agents[-1]
    look = make_look(scenario.world, "Clear", "Noon", np.random.default_rng(0))
    colors = paint(scene, scenario.world, look)
    painted = 0
    for camera in pole.cameras:
        ground_from_camera = pole.ground_from_ego(scene.snapshot) @ camera.camera_from_lidar.inverse()
        rays = _ray_directions(ground_from_camera, *_pixel_slopes(camera))
        _, face = scene.cast(ground_from_camera.translation, rays.reshape(-1, 3).astype(np.float64))
        owner = scene.owner_of(face)
        shown = np.bincount(owner[owner >= 0], minlength=1)
        wall = colors.wall.copy()
        wall[scene.owner_of(np.arange(len(wall))) == shown.argmax()] = (255, 0, 255)
        plain = render(scene, colors, look, camera, ground_from_camera).astype(int)
        marked = render(scene, replace(colors, wall=wall), look, camera, ground_from_camera).astype(int)
        changed = np.abs(marked - plain).max(axis=2).ravel() > 8
        np.testing.assert_array_equal(changed, owner == shown.argmax())
        painted += shown.max()
    assert painted > 500


def test_no_face_is_black(scenario, scene):
    for time_of_day in TIMES_OF_DAY:
        for weather in WEATHERS:
            look = make_look(scenario.world, weather, time_of_day, np.random.default_rng(0))
            assert paint(scene, scenario.world, look).wall.max(axis=1).min() > 4
            assert look.ground.max() > 60


def test_buildings_hide_some_and_show_others(scene, agents):
    ego = agents[0]
    seen = camera_visible(scene, ego, ego.ground_from_ego(scene.snapshot) @ ego.ego_from_lidar)
    assert 3 < seen.sum() < len(seen) - 3


def test_rays_down_meet_the_ground(scene):
    distance, face = scene.cast(np.array([0.0, 0.0, 40.0]), np.array([[2.0, 1.9, -1.0], [0.0, 0.0, 1.0]]))
    assert face[1] == -1
    assert np.isinf(distance[1])
    np.testing.assert_allclose(ground_distance(3.0, np.array([-1.0, -0.5, 0.0, 1.0])), [3, 6, np.inf, np.inf])
    _, straight = scene.cast(np.array([0.0, 7.8, 0.5]), np.array([[0.0, 0.0, -1.0]]))
    assert straight[0] == GROUND


def test_ego_origin_is_where_its_actor_has_it(scenario, scene, agents):
    for agent in agents[:4]:
        actor = scenario.actors.all[agent.row]
        center = np.append(scene.snapshot.poses[agent.row, :2], 0.0)
        seen = agent.ground_from_ego(scene.snapshot).inverse() @ center
        np.testing.assert_allclose(seen, [-actor.origin[0], -actor.origin[1], 0], atol=1e-9)


def test_rays_go_through_the_middles_of_the_pixels(scene, agents):
    camera = agents[0].cameras[1]
    ground_from_camera = agents[0].ground_from_ego(scene.snapshot) @ camera.camera_from_lidar.inverse()
    rays = _ray_directions(ground_from_camera, *_pixel_slopes(camera))
    pixels, depth = camera.optics.project(ground_from_camera.inverse().rotate(rays.reshape(-1, 3)))
    row, column = (grid.ravel() for grid in np.mgrid[:270, :480])
    np.testing.assert_allclose(pixels, np.stack([column, row], axis=1) + 0.5, atol=1e-3)
    np.testing.assert_allclose(depth, 1, atol=1e-6)


def test_bev_shows_the_map_around_the_agent(scenario, scene, agents):
    rows, columns = np.random.default_rng(0).integers(0, 1200, (2, 5000))
    for agent in agents:
        ground_from_ego = agent.ground_from_ego(scene.snapshot)
        picture = bev_picture(scene, scenario.world.top, ground_from_ego)
        ahead, left = ((599.5 - index) * 0.1 for index in (rows, columns))
        x, y, _ = (ground_from_ego @ np.stack([ahead, left, 0.0 * left], axis=1)).T
        expected = tag_of_code()[scenario.world.top.codes[((y + 150) * 10).astype(int), ((x + 150) * 10).astype(int)]]
        free = picture.instance[rows, columns] == 0
        assert (picture.semantic[rows, columns] == expected)[free].mean() > 0.99
