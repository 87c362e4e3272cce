"""Scenes for plans: the ego drives straight into a standing car at the last frame."""

from collections.abc import Sequence

import numpy as np

from deepaccident_devkit.evaluation.planning import Plan, PlanningScene

CAR = (4.0, 2.0)
GIVEN = "given"
SCENARIO = "type1_subtype1_accident/Town01_type001_subtype0001_scenario00001"
STEP = 0.1


def straight(start: tuple[float, float], yaw: float, speed: float, frames: int) -> np.ndarray:
    """(F, 5) footprints of a car at constant speed."""
    way = np.arange(frames) * STEP * speed
    poses = [start[0] + way * np.cos(yaw), start[1] + way * np.sin(yaw)]
    return np.column_stack([*poses, np.broadcast_to(CAR, (frames, 2)), np.full(frames, yaw)])


def scene(
    speed: float, seconds: float = 3.0, *, others: Sequence[np.ndarray] = (), partner: bool = True
) -> PlanningScene:
    """The ego's front reaches a standing car, actor 1, after some seconds; others are actors from 2
    on.
    """
    frames = round(seconds / STEP) + 1
    way = np.arange(frames) * STEP * speed
    ahead = straight((way[-1] + CAR[0], 0.0), 0.0, 0.0, frames)
    actors = [*([ahead] if partner else []), *(each[:frames] for each in others)]
    ids = np.arange(1 if partner else 2, 2 + len(others))
    return PlanningScene(
        scenario=SCENARIO,
        recorded=np.column_stack([way, np.zeros((frames, 2))]),
        before=np.array([speed, 0.0]),
        size=np.array(CAR),
        offset=np.zeros(2),
        actor_id=ids,
        footprint=np.stack(actors, axis=1) if actors else np.zeros((frames, 0, 5)),
        is_pedestrian=np.zeros(len(ids), dtype=bool),
        seen=np.ones(len(ids), dtype=bool),
        is_twin=False,
        is_collider=partner,
        partner=ids == 1,
        to_end=seconds,
        to_contact=np.nan,
    )


def plan_at(speed: float, seconds: float = 3.0) -> Plan:
    """Straight on in steps of 0.5 s."""
    times = np.arange(1, round(seconds / 0.5) + 1) * 0.5
    return Plan(times=times, path=np.column_stack([times * speed, np.zeros(len(times))]))
