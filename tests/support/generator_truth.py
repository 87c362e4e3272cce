"""The generator's own knowledge of a scenario, taken from its scene and its rays; nothing is read
from the files of a release.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.plugins.synth.scenario import RecordingJob, Scenario, build_scenario
from deepaccident_devkit.plugins.synth.sensors.agents import Agent
from deepaccident_devkit.plugins.synth.sensors.annotate import TRACKING_RANGE, camera_visible
from deepaccident_devkit.plugins.synth.sensors.lidar import Scan
from deepaccident_devkit.plugins.synth.sensors.rig import make_rig
from deepaccident_devkit.plugins.synth.sensors.scene import Scene
from deepaccident_devkit.plugins.synth.shapes import BOX_CLEARANCE
from deepaccident_devkit.plugins.synth.traffic.simulate import separation
from deepaccident_devkit.release import Meta, write_calib, write_label, write_meta
from deepaccident_devkit.taxonomy import AGENTS, frame_timestamp

STEP_S, STEPS_PER_FRAME = 0.02, 5
"""Time between the samples of a simulation, and number of such steps between two frames."""
HORIZON_S = 3.0
"""Time for which replays continue after the last frame."""
Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Visibility:
    """What the sensors of the five agents observe of the two colliders in F frames.

    Attributes:
        points: Number of LiDAR points in the box, shape (5, 2, F).
        pixels: Whether any camera sees the box, shape (5, 2, F).
        distance: Horizontal distance in the LiDAR frame, metres, shape (5, 2, F).
        tracked: Whether the box is near enough to have an id in the agent's label, (5, 2, F).
    """

    points: Array
    pixels: Array
    distance: Array
    tracked: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class GeneratorTruth:
    """A scenario as the generator made it; time 0 is the first recorded frame.

    Attributes:
        scenario: Token of the scenario.
        design: Number of the paper's design that the scene belongs to, 1 to 12.
        meta: Content of its meta file.
        frames: Number of recorded frames, F.
        fine: Poses of the colliders on the ground from 0 to the last frame, `STEP_S` apart,
            shape (2, M, 3).
        velocities: Velocities of the colliders, m/s, shape (2, M, 2).
        sizes: Sizes of the colliders, metres, shape (2, 3).
        world_paths: x, y and yaw of the colliders' boxes in the world at the frames, (2, F, 3).
        sights: Observations of the colliders by the agents.
    """

    scenario: str
    design: int
    meta: Meta
    frames: int
    fine: Array
    velocities: Array
    sizes: Array
    world_paths: Array
    sights: Visibility


def record_truth(job: RecordingJob) -> GeneratorTruth:
    """Write the labels, calib and meta of a scenario, and return what the generator knows of it."""
    scenario = build_scenario(job.config, job.plan)
    actors = scenario.actors
    rows = [actors.row_of(actor) for actor in scenario.meta.collision.ids]
    world_paths, sights = _write_frames(job, scenario, rows)
    motions = [actors.all[row].motion for row in rows]

    times = np.arange((scenario.frames - 1) * STEPS_PER_FRAME + 1) * STEP_S
    return GeneratorTruth(
        scenario=job.plan.token,
        design=job.plan.design,
        meta=scenario.meta,
        frames=scenario.frames,
        fine=np.array([motion.poses(times) for motion in motions]),
        velocities=np.array([motion.velocities(times) for motion in motions]),
        sizes=actors.size[rows],
        world_paths=world_paths,
        sights=sights,
    )


def _write_frames(
    job: RecordingJob, scenario: Scenario, rows: list[int]
) -> tuple[Array, Visibility]:
    """Write the files of all frames, and return the paths in the world and the visibility of the
    actors in the given rows.
    """
    config, plan, folder = job.config, job.plan, job.folder
    rig = make_rig(
        scenario.world,
        scenario.actors,
        scenario.agents,
        sky=(scenario.spec.weather, scenario.spec.time_of_day),
        image_size=config.pixels,
        seed=(config.seed, plan.pair, int(plan.accident)),
        sensors="none",
        exact=config.exact,
    )
    world_from_ground = scenario.world.world_from_ground.matrix
    write_meta(folder.meta_path, scenario.meta)

    paths = []
    observations = []
    for frame in range(1, scenario.frames + 1):
        scene = rig.scene(frame_timestamp(frame))
        poses = [world_from_ground @ _box_pose(scene, row) for row in rows]
        paths.append([[*pose[:2, 3], np.arctan2(pose[1, 0], pose[0, 0])] for pose in poses])
        for agent in rig.agents:
            sighting = rig.sighting(scene, agent, frame)
            write_calib(folder.calib_path(agent.name, frame), sighting.calib)
            write_label(folder.label_path(agent.name, frame), sighting.labels)
            observations.append(list(_observe_actors(scene, agent, sighting.points, rows)))

    shape = (scenario.frames, len(AGENTS), len(rows), 4)
    columns = np.array(observations, dtype=np.float64).reshape(shape)
    return np.array(paths).swapaxes(0, 1), Visibility(*columns.transpose(3, 1, 2, 0))


def _observe_actors(
    scene: Scene, agent: Agent, cloud: Scan, rows: list[int]
) -> Iterator[tuple[float, ...]]:
    """Yield the four values of `Visibility` for one agent and the actor of each row."""
    ground_from_lidar = agent.ground_from_lidar(scene)
    lidar_from_ground = ground_from_lidar.inverse().matrix
    in_camera = camera_visible(scene, agent, ground_from_lidar, np.array(rows))

    for row, visible in zip(rows, in_camera, strict=True):
        ground_from_box = _box_pose(scene, row)
        lidar_from_box = lidar_from_ground @ ground_from_box
        yaw = 0.0 if row == agent.row else np.arctan2(lidar_from_box[1, 0], lidar_from_box[0, 0])
        rotation = quaternions.to_matrix(quaternions.from_yaw(np.array(yaw)))

        points = (cloud.xyz - lidar_from_box[:3, 3]) @ rotation
        inside = (np.abs(points) <= scene.actors.size[row] / 2).all(axis=1)
        distance = np.hypot(*lidar_from_box[:2, 3])
        ground_distance = np.hypot(*(ground_from_box - ground_from_lidar.matrix)[:2, 3])
        yield inside.sum(), visible, distance, ground_distance <= TRACKING_RANGE


def _box_pose(scene: Scene, row: int) -> Array:
    """Return the pose of an actor's box on the ground, shape (4, 4)."""
    pose = scene.frames[row].copy()
    pose[:3, 3] += pose[:3, 2] * (BOX_CLEARANCE + scene.actors.size[row, 2] / 2)
    return pose


def outline_gaps(truth: GeneratorTruth, first: Array, second: Array) -> Array:
    """Measure the widest gap between the colliders' outlines at poses (…, 3), as
    `collision.separation` does.
    """
    return separation(
        first,
        truth.sizes[0, :2],
        second,
        truth.sizes[1, :2],
    )


def time_to_contact(truth: GeneratorTruth, step: int) -> float:
    """Find when the colliders touch if both keep their velocities: seconds after a step, to a
    millisecond.
    """
    times = np.arange(0.0, 4.0, 1e-3)
    paths = [np.tile(pose, (len(times), 1)) for pose in truth.fine[:, step]]
    for path, velocity in zip(paths, truth.velocities[:, step], strict=True):
        path[:, :2] += times[:, None] * velocity

    touching = outline_gaps(truth, *paths) <= 1e-3
    return float(times[touching.argmax()]) if touching.any() else np.inf


def last_braking_step(
    truth: GeneratorTruth, brakers: tuple[bool, bool], deceleration: float
) -> float:
    """Find the last start of braking, in seconds, that avoids the contact; NaN if none does.

    The exact motion continues straight for `HORIZON_S` at the last velocity. Every step of it is
    tried as the start.
    """
    replays = [
        _replay_braking(path, velocity, brakes, deceleration)
        for path, velocity, brakes in zip(truth.fine, truth.velocities[:, -1], brakers, strict=True)
    ]
    distance = np.hypot(*np.moveaxis(replays[0] - replays[1], -1, 0)[:2])
    near = distance < np.hypot(*truth.sizes[:, :2].T).sum() / 2

    touching = np.zeros(distance.shape, dtype=bool)
    touching[near] = outline_gaps(truth, replays[0][near], replays[1][near]) <= 1e-6
    avoiding_steps = np.flatnonzero(~touching.any(axis=1))
    return float(avoiding_steps[-1] * STEP_S) if len(avoiding_steps) else np.nan


def _replay_braking(path: Array, velocity: Array, brakes: bool, deceleration: float) -> Array:
    """Return the poses of one collider, a row for each step at which the braking may start."""
    later = np.arange(1, round(HORIZON_S / STEP_S) + 1)[:, None] * STEP_S
    straight_on = np.column_stack(
        [
            path[-1, :2] + later * velocity,
            np.full(len(later), path[-1, 2]),
        ]
    )
    poses = np.concatenate([path, straight_on])
    step_lengths = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    arc_lengths = np.append(0, np.cumsum(step_lengths))

    times = np.arange(len(poses)) * STEP_S
    starts = times[: len(path), None]
    start_arcs = arc_lengths[: len(path), None]
    speed = np.gradient(arc_lengths, STEP_S)[: len(path), None] * brakes
    braking_time = np.clip(times - starts, 0, speed / deceleration)
    braking_distance = speed * braking_time - deceleration * braking_time**2 / 2

    travelled = np.where(
        (times > starts) & brakes,
        np.minimum(arc_lengths, start_arcs + braking_distance),
        arc_lengths,
    )
    columns = [np.interp(travelled, arc_lengths, column) for column in poses.T]
    return np.stack(columns, axis=-1)


def contact_direction(truth: GeneratorTruth) -> Array:
    """Return the unit vector (2,) from the first collider to the second at the end, across the
    widest gap along any side.
    """
    poses = truth.fine[:, -1]
    axes = np.concatenate(
        [[[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]] for yaw in poses[:, 2]]
    )
    projected_sizes = (axes @ axes.T).reshape(4, 2, 2) * truth.sizes[:, :2]
    reach = np.abs(projected_sizes / 2).sum(axis=(1, 2))
    offsets = axes @ (poses[1, :2] - poses[0, :2])

    widest = np.argmax(np.abs(offsets) - reach)
    return axes[widest] * np.sign(offsets[widest])
