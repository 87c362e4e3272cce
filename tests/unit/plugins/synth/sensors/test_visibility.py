"""Visible actors: scenes that one can work out by hand, and the pictures themselves."""

import numpy as np
import pytest

from deepaccident_devkit.plugins.synth.sensors.annotate import CameraViews, camera_visible
from deepaccident_devkit.plugins.synth.sensors.render import trace_picture
from deepaccident_devkit.plugins.synth.solids import Block

WALL = (120, 120, 120)


def ego_sees(rig, actor_id, agent=0):
    scene = rig.scene(0.0)
    observer = rig.agents[agent]
    rows = np.array([scene.actors.row_of(actor_id)])
    visible = camera_visible(scene, observer, observer.ground_from_lidar(scene), rows)

    return bool(visible[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("upper_edge", "width", "seen"),
    [(4.0, 6.0, False), (4.0, 1.9, True), (1.0, 6.0, True)],
    ids=["a wall before all of it", "a wall before half of it", "a low wall"],
)
def test_a_wall_hides_what_is_behind_it(world, bare, actor, rig_of, upper_edge, width, seen):
    """The wall ends `width` to the left of the car's right side, seen from the ego at (-30,
    -1.75).
    """
    car = actor(9, "car", -8.0, -1.75)
    assert ego_sees(rig_of(bare(world), [car]), 1009)

    wall = Block(
        (-16.2, -16.0),
        (-5.0, -5.0 + width),
        (-0.1, upper_edge),
        WALL,
    )
    assert ego_sees(rig_of(bare(world, [wall]), [car]), 1009) == seen


@pytest.mark.parametrize("hidden", [False, True])
def test_a_truck_hides_the_car_before_it(world, bare, actor, rig_of, hidden):
    actors = [actor(9, "car", 6.0, -1.75)]
    if hidden:
        actors.append(actor(10, "truck", -8.0, -1.75))
    assert ego_sees(rig_of(bare(world), actors), 1009) != hidden


@pytest.mark.slow
@pytest.mark.parametrize(("x", "seen"), [(-30.0, False), (-56.0, True)])
def test_a_rise_hides_a_pedestrian_behind_it(hilly_world, bare, actor, rig_of, x, seen):
    """The crest lies 55 m from the middle; the ego waits 30 m from the middle or on the crest, the
    pedestrian stands far behind.
    """
    rig = rig_of(
        bare(hilly_world),
        [actor(9, "pedestrian", -86.0, -1.75)],
        places={"ego_vehicle": (x, -1.75, np.pi), "ego_vehicle_behind": (20.0, -1.75, 0.0)},
    )
    assert ego_sees(rig, 1009) == seen


def test_nobody_sees_itself_and_all_around_is_seen(world, bare, actor, rig_of):
    turns = np.deg2rad([0, 50, -50, 95, -95, 140, -140, 180])
    pedestrians = [
        actor(10 + k, "pedestrian", -30 + 9 * np.cos(turn), -1.75 + 9 * np.sin(turn))
        for k, turn in enumerate(turns)
    ]
    rig = rig_of(bare(world), pedestrians)

    assert not ego_sees(rig, 1000)

    for actor_id in range(1010, 1018):
        assert ego_sees(rig, actor_id)


def test_pixel_counts_are_near_the_counts_of_the_picture(world, actor, rig_of):
    """The counts for a 400 × 225 picture, compared with all pixels of a picture of that size."""
    actors = [actor(10 + k, "car", 5.0 + 9 * k, 1.75, np.pi) for k in range(4)]
    actors += [actor(20 + k, "pedestrian", -14.0 + 4 * k, 5.0) for k in range(4)]
    rig = rig_of(world, actors, image_size=(400, 225))
    scene = rig.scene(0.0)
    agent = rig.agents[1]
    rows = np.arange(len(scene.actors))

    for camera in agent.cameras:
        pose = agent.ground_from_lidar(scene) @ camera.camera_from_lidar.inverse()
        owners = scene.face_owner[trace_picture(scene, camera, pose).all.face]
        pixel_counts = np.bincount(owners[owners >= 0], minlength=len(rows))
        counted = CameraViews(scene, [camera], [pose], rows).pixels()[0]
        np.testing.assert_allclose(counted, pixel_counts, rtol=0.35, atol=12)
        assert not (counted[pixel_counts > 12] == 0).any()
