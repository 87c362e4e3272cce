"""Series of an agent's motion, from its recorded poses."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.geometry.box_arrays import normals
from deepaccident_devkit.geometry.conventions import stored_transforms
from deepaccident_devkit.support.arrays import FloatArray, FrozenArrays
from deepaccident_devkit.tables.build import timestamps
from deepaccident_devkit.taxonomy import FRAME_PERIOD

MIN_CURVATURE_SPEED: Final = 0.5
"""Slowest speed, m/s, at which a path has a curvature."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AgentMotion(FrozenArrays):
    """An agent's motion over the ground in the F frames of its scenario; arrays are read-only.

    Attributes:
        time: Seconds since the scenario's first frame, shape (F,), float64.
        speed: Speed of the ego frame's origin, shape (F,), float64, m/s.
        acceleration: Acceleration along the heading, shape (F,), float64, m/s².
        lateral_acceleration: Acceleration to the left of the heading, shape (F,), float64, m/s².
        yaw_rate: Rate of the heading, shape (F,), float64, rad/s, positive to the left.
        curvature: Curvature of the path, shape (F,), float64, 1/m, positive to the left; NaN below
            `MIN_CURVATURE_SPEED`.
    """

    time: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    lateral_acceleration: FloatArray
    yaw_rate: FloatArray
    curvature: FloatArray


def agent_motion(dataset: Dataset, agent: RowArgument) -> AgentMotion:
    """Return speed, accelerations, yaw rate and curvature of an agent in every frame.

    They are differences of `world_from_ego` at 10 Hz: central ones, and one-sided ones in the first
    and last frame. In a recording of a single frame nothing moves.

    Args:
        dataset: The release.
        agent: Token or record of the agent.

    Raises:
        TokenError: The agent is unknown.
    """
    agent_row = dataset.getind("agent", agent)
    agents = dataset.columns("agent")
    first_sample = agents["first_sample_row"].item(agent_row)
    scenario_row = agents["scenario_row"].item(agent_row)
    num_frames = dataset.columns("scenario")["num_frames"].item(scenario_row)
    poses = dataset.columns("ego_pose")["matrix"][first_sample : first_sample + num_frames]
    world_from_ego = stored_transforms(poses)
    yaw = np.unwrap(np.arctan2(world_from_ego[:, 1, 0], world_from_ego[:, 0, 0]))
    velocity = differentiate(world_from_ego[:, :2, 3])
    acceleration = differentiate(velocity)
    forward = normals(yaw)
    left = normals(yaw + np.pi / 2)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    yaw_rate = differentiate(yaw)
    unknown = np.full(num_frames, np.nan)
    moves = speed >= MIN_CURVATURE_SPEED
    return AgentMotion(
        time=timestamps(num_frames),
        speed=speed,
        acceleration=(acceleration * forward).sum(axis=1),
        lateral_acceleration=(acceleration * left).sum(axis=1),
        yaw_rate=yaw_rate,
        curvature=np.divide(yaw_rate, speed, out=unknown, where=moves),
    )


def differentiate(values: FloatArray) -> FloatArray:
    """Differentiate values (F, …) sampled at 10 Hz, per second.

    Differences are one-sided at the ends, and 0 for a single frame.
    """
    if len(values) < 2:
        return np.zeros_like(values)
    return np.gradient(values, FRAME_PERIOD, axis=0)
