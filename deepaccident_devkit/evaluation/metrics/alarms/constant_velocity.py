"""Alarms of the simplest predictor: all keep their velocity, and two that touch within 3 s collide."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from deepaccident_devkit.evaluation.metrics.predictions import Accident
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.conflicts import time_to_collision

ALARM_TIME: Final = 3.0
"""Seconds of time to collision below which there is an alarm."""
_MOVES: Final = 0.1
"""Relative speeds below this, in m/s, are no danger, such as those of parked cars."""


def constant_velocity_alarms(boxes: Boxes, names: Mapping[int, int | None], own: int | None) -> tuple[Accident, ...]:
    """The pairs of actors whose time to collision is below 3 s, the soonest first.

    Args:
        boxes: N actors at the present, in its ego frame, with velocities over the ground; unknown ones stand.
        names: actor ids that stand for others: a label's own row, −100; None if it is not known which.
        own: the actor that must be in the pair; None for any pair.

    Returns:
        Positions are those at the contact; the score falls from 1 at the contact to 0 at 3 s.
    """
    ids = [names.get(actor, actor) for actor in boxes.actor_id.tolist()]
    velocity = np.nan_to_num(boxes.velocity[:, :2])
    first, second = np.triu_indices(len(ids), 1)
    near = np.linalg.norm(velocity[second] - velocity[first], axis=1) >= _MOVES
    if own is not None:
        mine = np.array([actor == own for actor in ids], dtype=bool)
        near &= mine[first] | mine[second]
    first, second = first[near], second[near]
    footprint = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
    seconds = time_to_collision(footprint[first], footprint[second], velocity[first], velocity[second])
    alarms = []
    for row in np.flatnonzero(seconds < ALARM_TIME)[np.argsort(seconds[seconds < ALARM_TIME], kind="stable")]:
        pair = [int(first[row]), int(second[row])]
        one, other = (ids[each] for each in pair)
        alarms.append(
            Accident(
                positions=boxes.center[pair, :2] + velocity[pair] * seconds[row],
                time=float(seconds[row]),
                score=1 - float(seconds[row]) / ALARM_TIME,
                ids=None if one is None or other is None else (one, other),
            )
        )
    return tuple(alarms)
