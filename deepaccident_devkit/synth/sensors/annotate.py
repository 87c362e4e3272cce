"""Labels: the label file of an agent for a scene."""

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.release import Labels, label_from_world_velocity
from deepaccident_devkit.synth.sensors.agents import Agent
from deepaccident_devkit.synth.sensors.lidar import Scan
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.synth.sensors.visibility import camera_visible
from deepaccident_devkit.synth.shapes import BOX_CLEARANCE
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID

LABEL_RANGE = 120.0
"""Actors up to this distance are annotated: metres over the ground from the LiDAR to the box's centre."""
TRACKING_RANGE = 115.0
"""Actors farther away than this, in metres, have no id."""
COUNTED_LATER = 0.003
"""Points are counted in boxes of so many seconds after the point cloud, when other actors have already moved on."""
MOST_AHEAD = 0.012
"""The most metres that they have moved on: more would be too wrong for a fast one of which only the back is seen."""
_PEDESTRIAN = CATEGORIES.index("pedestrian")


def annotate(scene: Scene, agent: Agent, world_from_ground: SE3, scan: Scan, *, exact: bool) -> Labels:
    """The labels of one agent at one moment: parked vehicles, other vehicles, pedestrians.

    Args:
        scene: the moment.
        agent: whose labels.
        world_from_ground: the place in its town.
        scan: the point cloud; `num_lidar_pts` counts all its stored points in each box.
        exact: whether points are counted in the annotated boxes, and not in those of `COUNTED_LATER`.
    """
    ground_from_lidar = agent.ground_from_lidar(scene)
    center, yaw, velocity = _kinematics(scene)
    distance = np.hypot(*(center[:, :2] - ground_from_lidar.translation[:2]).T)
    rows = _in_order(scene, distance <= LABEL_RANGE)
    actor_id = np.where(distance > TRACKING_RANGE, UNTRACKED_ID, scene.actors.actor_id)
    lidar_from_ground = ground_from_lidar.inverse()
    lidar_center, lidar_velocity = lidar_from_ground.apply(center), lidar_from_ground.rotate(velocity)
    lidar_yaw = _turned(yaw, lidar_from_ground)
    world_velocity = world_from_ground.rotate(velocity)[:, :2]
    agent_velocity = np.zeros((1, 2))
    if agent.row is not None:
        actor_id[agent.row] = OWN_ACTOR_ID
        agent_velocity[0] = world_velocity[agent.row]
        lidar_yaw[agent.row], lidar_velocity[agent.row] = 0.0, 0.0
    size, ahead = scene.actors.size[rows], np.zeros((len(rows), 3)) if exact else _ahead(lidar_velocity[rows])
    counted = Boxes.from_arrays(lidar_center[rows] + ahead, size, lidar_yaw[rows], frame="lidar")
    return Labels(
        raw=False,
        num_boxes=np.array([len(rows)]),
        agent_velocity=agent_velocity,
        category=scene.actors.category[rows],
        center=lidar_center[rows],
        size=size,
        yaw=lidar_yaw[rows],
        velocity=label_from_world_velocity(world_velocity, lidar_yaw)[rows],
        actor_id=actor_id[rows],
        num_lidar_pts=counted.count_points(scan.xyz),
        camera_visible=camera_visible(scene, agent, ground_from_lidar, rows),
    )


def _ahead(velocity: FloatArray) -> FloatArray:
    """How far (N, 3), metres, actors with velocities (N, 3) have moved on when points are counted."""
    way = COUNTED_LATER * velocity
    return np.asarray(way * np.minimum(1.0, MOST_AHEAD / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)))


def _in_order(scene: Scene, wanted: BoolArray) -> IntArray:
    """Rows of the wanted actors (A,) in the order of label lines: the same for all agents and frames, not by ids."""
    actors = scene.actors
    parked = np.isin(np.arange(len(actors)), scene.setting.parked)
    order = np.lexsort([actors.object_id, actors.category == _PEDESTRIAN, ~parked])
    return np.asarray(order[wanted[order]])


def _kinematics(scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres (A, 3), forward unit vectors (A, 3) and velocities (A, 3) along the ground of all boxes, ground frame."""
    forward, up = scene.frames[:, :3, 0], scene.frames[:, :3, 2]
    center = scene.frames[:, :3, 3] + up * (BOX_CLEARANCE + scene.actors.size[:, 2:] / 2)
    over_ground = scene.snapshot.velocities
    climb = -(over_ground * up[:, :2]).sum(axis=1) / up[:, 2]
    return center, forward, np.column_stack([over_ground, climb])


def _turned(forward: FloatArray, lidar_from_ground: SE3) -> FloatArray:
    """Yaw (A,) of forward vectors (A, 3) in the LiDAR frame, in (−π, π]."""
    ahead = lidar_from_ground.rotate(forward)
    return np.asarray(np.arctan2(ahead[:, 1], ahead[:, 0]))
