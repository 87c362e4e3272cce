"""What the generator knows of a scenario, from its scene and its rays: nothing is read from a
release's files.
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

STEP, STEPS_A_FRAME = 0.02, 5
"""Seconds between the samples of a simulation, and steps between frames."""
HORIZON = 3.0
"""Seconds for which replays go on after the end."""
Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Sights:
    """What the sensors of the five agents have of the two colliders at F frames.

    Attributes:
        points: (5, 2, F) LiDAR points in the box.
        pixels: (5, 2, F) whether any camera sees it.
        distance: (5, 2, F) metres across, in the LiDAR frame.
        tracked: (5, 2, F) whether it is near enough to have an id in the agent's label.
    """

    points: Array
    pixels: Array
    distance: Array
    tracked: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """A scenario as the generator made it; time 0 is the first recorded frame.

    Attributes:
        scenario: token.
        design: which of the paper's twelve its scene is of.
        meta: its meta file's content.
        frames: how many are recorded.
        fine: (2, M, 3) the colliders' poses from 0 to the last frame, `STEP` apart; ground frame.
        velocities: (2, M, 2) m/s.
        sizes: (2, 3) metres.
        world_paths: (2, F, 3) x, y, yaw of the colliders' boxes at the frames, world.
        sights: what the agents have of the colliders.
    """

    scenario: str
    design: int
    meta: Meta
    frames: int
    fine: Array
    velocities: Array
    sizes: Array
    world_paths: Array
    sights: Sights


def recorded(job: RecordingJob) -> Truth:
    """Write a scenario's labels, calib and meta, and tell what the generator knows of it."""
    scenario = build_scenario(job.config, job.plan)
    actors = scenario.actors
    rows = [actors.row_of(actor) for actor in scenario.meta.collision.ids]
    world_paths, sights = _looked_at(job, scenario, rows)
    times = np.arange((scenario.frames - 1) * STEPS_A_FRAME + 1) * STEP
    return Truth(
        scenario=job.plan.token,
        design=job.plan.design,
        meta=scenario.meta,
        frames=scenario.frames,
        fine=np.array([actors.all[row].motion.poses(times) for row in rows]),
        velocities=np.array([actors.all[row].motion.velocities(times) for row in rows]),
        sizes=actors.size[rows],
        world_paths=world_paths,
        sights=sights,
    )


def _looked_at(job: RecordingJob, scenario: Scenario, rows: list[int]) -> tuple[Array, Sights]:
    """Write the files; world paths and sights of the actors of some rows."""
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
    write_meta(folder.meta_path, scenario.meta)
    paths, sights = [], []
    for frame in range(1, scenario.frames + 1):
        scene = rig.scene(frame_timestamp(frame))
        world = [scenario.world.world_from_ground.matrix @ _box(scene, row) for row in rows]
        paths.append([[*pose[:2, 3], np.arctan2(pose[1, 0], pose[0, 0])] for pose in world])
        for agent in rig.agents:
            sighting = rig.sighting(scene, agent, frame)
            write_calib(folder.calib_path(agent.name, frame), sighting.calib)
            write_label(folder.label_path(agent.name, frame), sighting.labels)
            sights.append(list(_seen(scene, agent, sighting.points, rows)))
    columns = np.array(sights, dtype=np.float64).reshape(scenario.frames, len(AGENTS), len(rows), 4)
    return np.array(paths).swapaxes(0, 1), Sights(*columns.transpose(3, 1, 2, 0))


def _seen(scene: Scene, agent: Agent, cloud: Scan, rows: list[int]) -> Iterator[tuple[float, ...]]:
    """What the fields of `Sights` are for an agent and each row's actor."""
    ground_from_lidar = agent.ground_from_lidar(scene)
    pixels = camera_visible(scene, agent, ground_from_lidar, np.array(rows))
    for row, pixel in zip(rows, pixels, strict=True):
        box = ground_from_lidar.inverse().matrix @ _box(scene, row)
        yaw = 0.0 if row == agent.row else np.arctan2(box[1, 0], box[0, 0])
        along = (cloud.xyz - box[:3, 3]) @ quaternions.to_matrix(
            quaternions.from_yaw(np.array(yaw))
        )
        inside = (np.abs(along) <= scene.actors.size[row] / 2).all(axis=1)
        away = np.hypot(*(_box(scene, row) - ground_from_lidar.matrix)[:2, 3])
        yield inside.sum(), pixel, np.hypot(*box[:2, 3]), away <= TRACKING_RANGE


def _box(scene: Scene, row: int) -> Array:
    """(4, 4) pose of an actor's box on the ground."""
    pose = scene.frames[row].copy()
    pose[:3, 3] += pose[:3, 2] * (BOX_CLEARANCE + scene.actors.size[row, 2] / 2)
    return pose


def separations(truth: Truth, first: Array, second: Array) -> Array:
    """The widest gap of the colliders' outlines at poses (…, 3), as in `collision.separation`."""
    return separation(first, truth.sizes[0, :2], second, truth.sizes[1, :2])


def time_to_contact(truth: Truth, step: int) -> float:
    """Seconds from a step until the colliders touch if both keep their velocities; to a
    millisecond.
    """
    times = np.arange(0.0, 4.0, 1e-3)
    moved = [np.tile(pose, (len(times), 1)) for pose in truth.fine[:, step]]
    for poses, velocity in zip(moved, truth.velocities[:, step], strict=True):
        poses[:, :2] += times[:, None] * velocity
    touching = separations(truth, *moved) <= 1e-3
    return float(times[touching.argmax()]) if touching.any() else np.inf


def last_moment(truth: Truth, brakers: tuple[bool, bool], deceleration: float) -> float:
    """The last start of a braking that avoids the contact, in steps of `STEP`; NaN if none does.

    The exact motion goes on straight for 3 s at the last velocity, and is tried at all of its
    steps.
    """
    after = np.arange(1, round(HORIZON / STEP) + 1) * STEP
    placed = []
    for path, velocity, brakes in zip(truth.fine, truth.velocities[:, -1], brakers, strict=True):
        beyond = np.column_stack(
            [path[-1, :2] + after[:, None] * velocity, np.full(len(after), path[-1, 2])]
        )
        poses = np.concatenate([path, beyond])
        arcs = np.append(0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
        times = np.arange(len(poses)) * STEP
        begun = times[: len(path), None]
        speed = np.gradient(arcs, STEP)[: len(path), None] * brakes
        since = np.clip(times - begun, 0, speed / deceleration)
        allowed = arcs[: len(path), None] + speed * since - deceleration * since**2 / 2
        way = np.where((times > begun) & brakes, np.minimum(arcs, allowed), arcs)
        placed.append(np.stack([np.interp(way, arcs, each) for each in poses.T], axis=-1))
    apart = np.hypot(*np.moveaxis(placed[0] - placed[1], -1, 0)[:2])
    near = apart < np.hypot(*truth.sizes[:, :2].T).sum() / 2
    touches = np.zeros(apart.shape, dtype=bool)
    touches[near] = separations(truth, placed[0][near], placed[1][near]) <= 1e-6
    avoids = np.flatnonzero(~touches.any(axis=1))
    return float(avoids[-1] * STEP) if len(avoids) else np.nan


def facing(truth: Truth) -> Array:
    """(2,) unit vector from the first collider to the second at the end, across the widest gap
    along any side.
    """
    poses, sizes = truth.fine[:, -1], truth.sizes[:, :2]
    axes = np.concatenate(
        [[[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]] for yaw in poses[:, 2]]
    )
    reach = np.abs((axes @ axes.T).reshape(4, 2, 2) * sizes / 2).sum(axis=(1, 2))
    apart = axes @ (poses[1, :2] - poses[0, :2])
    best = np.argmax(np.abs(apart) - reach)
    return axes[best] * np.sign(apart[best])
