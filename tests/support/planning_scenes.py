"""Scenes for plans: the ego drives straight into a standing car at the last frame."""

from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.evaluation.planning import Plan, PlanningScene

# Length and width, metres.
CAR_FOOTPRINT = (4.0, 2.0)
PLAN_SOURCE = "given"
SCENARIO = "type1_subtype1_accident/Town01_type001_subtype0001_scenario00001"
STEP_S = 0.1


def straight_footprints(
    start: tuple[float, float], yaw: float, speed: float, frames: int
) -> np.ndarray:
    """Return the footprints of a car at constant speed, (frames, 5)."""
    distances = np.arange(frames) * STEP_S * speed
    return np.column_stack(
        [
            start[0] + distances * np.cos(yaw),
            start[1] + distances * np.sin(yaw),
            np.broadcast_to(CAR_FOOTPRINT, (frames, 2)),
            np.full(frames, yaw),
        ]
    )


def blocked_ego_scene(
    speed: float,
    seconds: float = 3.0,
    *,
    other_cars: Sequence[np.ndarray] = (),
    partner: bool = True,
) -> PlanningScene:
    """Make a scene in which the ego's front reaches a standing car, actor 1, after some seconds.

    The actors from 2 on are other cars, given by their footprints.
    """
    frames = round(seconds / STEP_S) + 1
    distances = np.arange(frames) * STEP_S * speed
    footprints = [footprint[:frames] for footprint in other_cars]
    if partner:
        position = (distances[-1] + CAR_FOOTPRINT[0], 0.0)
        footprints.insert(0, straight_footprints(position, 0.0, 0.0, frames))
    ids = np.arange(1 if partner else 2, 2 + len(other_cars))
    return PlanningScene(
        scenario=SCENARIO,
        recorded=np.column_stack([distances, np.zeros((frames, 2))]),
        before=np.array([speed, 0.0]),
        size=np.array(CAR_FOOTPRINT),
        offset=np.zeros(2),
        actor_id=ids,
        footprint=np.reshape(footprints, (len(ids), frames, 5)).swapaxes(0, 1),
        is_pedestrian=np.zeros(len(ids), dtype=bool),
        seen=np.ones(len(ids), dtype=bool),
        is_twin=False,
        is_collider=partner,
        partner=ids == 1,
        to_end=seconds,
        to_contact=np.nan,
    )


def constant_speed_plan(speed: float, seconds: float = 3.0) -> Plan:
    """Make a plan that goes straight on in steps of 0.5 s."""
    times = np.arange(1, round(seconds / 0.5) + 1) * 0.5
    return Plan(
        times=times,
        path=np.column_stack([times * speed, np.zeros(len(times))]),
    )
