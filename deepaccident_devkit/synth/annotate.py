"""Labels: what an agent's label file says of a scene."""

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.release import Labels
from deepaccident_devkit.synth.agents import Agent, Camera
from deepaccident_devkit.synth.lidar import Scan
from deepaccident_devkit.synth.scene import Scene
from deepaccident_devkit.synth.shapes import BOX_CLEARANCE
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID, UNTRACKED_ID

LABEL_RANGE = 70.0
"""Actors up to here are annotated, metres over the ground from the LiDAR to the box's centre."""
TRACKING_RANGE = 60.0
"""Actors beyond have no id."""


def annotate(scene: Scene, agent: Agent, world_from_ground: SE3, ground_from_lidar: SE3, scan: Scan) -> Labels:
    """The labels of one agent at one moment, in the order of the actors' ids.

    `num_lidar_pts` counts the points of `scan`, as stored, in each box.
    """
    distance = np.hypot(*(scene.snapshot.poses[:, :2] - ground_from_lidar.translation[:2]).T)
    rows = np.flatnonzero(distance <= LABEL_RANGE)
    actor_id = np.where(distance > TRACKING_RANGE, UNTRACKED_ID, scene.actors.actor_id)
    center, yaw, velocity = _kinematics(scene, ground_from_lidar)
    velocity_world = world_from_ground.rotate(np.column_stack([scene.snapshot.velocities, np.zeros(len(actor_id))]))
    agent_velocity = np.zeros((1, 2))
    visible = camera_visible(scene, agent, ground_from_lidar)
    if agent.row is not None:
        actor_id[agent.row] = OWN_ACTOR_ID
        velocity[agent.row] = agent_velocity[0] = velocity_world[agent.row, :2]
        visible[agent.row] = False
    num_points = _points_in_boxes(center, scene.actors.size, yaw, scan)
    return Labels(
        raw=False,
        num_boxes=np.array([len(rows)]),
        agent_velocity=agent_velocity,
        category=scene.actors.category[rows],
        center=center[rows],
        size=scene.actors.size[rows],
        yaw=yaw[rows],
        velocity=velocity[rows],
        actor_id=actor_id[rows],
        num_lidar_pts=num_points[rows],
        camera_visible=visible[rows],
    )


def camera_visible(scene: Scene, agent: Agent, ground_from_lidar: SE3) -> BoolArray:
    """Which actors (A,) any camera of the agent sees: a ray to some point on them meets nobody else first."""
    seen = np.zeros(len(scene.actors), dtype=bool)
    for camera in agent.cameras:
        ground_from_camera = ground_from_lidar @ camera.camera_from_lidar.inverse()
        rays, owner = _rays_to_actors(scene, camera, ground_from_camera)
        _, face = scene.caster.cast(ground_from_camera.translation, rays)
        met = scene.owner_of(face) == owner
        seen[owner[met]] = True
    return seen


def _rays_to_actors(scene: Scene, camera: Camera, ground_from_camera: SE3) -> tuple[FloatArray, IntArray]:
    """Directions (N, 3) to the points on actors that face the camera and lie in its picture, and whose they are."""
    points = scene.samples
    rays = points.position - ground_from_camera.translation
    facing = np.einsum("nk,nk->n", rays, points.normal) < 0
    right, down, forward = (rays @ ground_from_camera.rotation).T
    optics = camera.optics
    focal = optics.intrinsic[0, 0]
    inside = np.abs(right) * focal < forward * optics.width / 2
    inside &= np.abs(down) * focal < forward * optics.height / 2
    picked = np.flatnonzero(facing & inside)
    return rays[picked], points.owner[picked]


def _kinematics(scene: Scene, ground_from_lidar: SE3) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres (A, 3), yaw (A,) in (−π, π] and velocities (A, 2) of all boxes in the LiDAR frame."""
    poses = scene.snapshot.poses
    lidar_from_ground = ground_from_lidar.inverse()
    height = BOX_CLEARANCE + scene.actors.size[:, 2] / 2
    center = lidar_from_ground.apply(np.column_stack([poses[:, :2], height]))
    turn = poses[:, 2] - ground_from_lidar.yaw
    yaw = np.arctan2(np.sin(turn), np.cos(turn))
    velocity = scene.snapshot.velocities @ lidar_from_ground.rotation[:2, :2].T
    return center, yaw, velocity


def _points_in_boxes(center: FloatArray, size: FloatArray, yaw: FloatArray, scan: Scan) -> IntArray:
    """How many points of the scan lie in each box (A,).

    Boxes never overlap and shapes keep `shapes.INSET` from their box's faces, so a point can only lie in the box of
    the actor that it is on, and rounding decides nothing: `Boxes.contains` over all stored points gives the same.
    """
    on_actors = np.flatnonzero(scan.owner >= 0)
    owner = scan.owner[on_actors]
    away = scan.xyz[on_actors] - center[owner]
    cos, sin = np.cos(yaw)[owner], np.sin(yaw)[owner]
    along = np.abs(cos * away[:, 0] + sin * away[:, 1])
    across = np.abs(cos * away[:, 1] - sin * away[:, 0])
    local = np.stack([along, across, np.abs(away[:, 2])], axis=1)
    inside = (local <= size[owner] / 2).all(axis=1)
    return np.bincount(owner[inside], minlength=len(center))
