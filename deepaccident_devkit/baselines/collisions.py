"""Accidents that an outlook foresees: pairs whose boxes come too near to each other."""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.baselines.outlook import Outlook
from deepaccident_devkit.evaluation import Accident
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD, OWN_ACTOR_ID

DANGER_DISTANCE: Final = 0.25
"""Metres: actors that come nearer to each other collide. The evaluation's 1 m, which allows for cells, would be an
alarm for every car that passes a cyclist."""
_SITE: Final = 10.0
"""Metres within which two alarms are of one accident: the surer one is kept."""
_MOVES: Final = 0.5
"""Metres that an actor must cover to count as moving."""
_SAME_WAY: Final = np.radians(20)
"""Between the headings of two that drive one behind the other."""
_SAME_LANE: Final = 1.0
"""Metres to the side within which one is straight ahead of the other."""
_PEDESTRIAN: Final = CATEGORIES.index("pedestrian")


def accidents_ahead(outlook: Outlook, horizon: float, danger_distance: float = DANGER_DISTANCE) -> list[Accident]:
    """The accidents of an outlook, the surest first.

    A pair is named at the first moment, in steps of 0.1 s, at which the gap between its boxes is below the danger
    distance. There is no danger for two that stand, for two that are already near and come no nearer, and for two
    pedestrians. A driver behind somebody straight ahead brakes: at constant velocity every queue would be an accident.
    The score is (1 − least gap / danger distance) / (1 + seconds to that moment): 1 for two that touch now. Later the
    place of an accident is no longer the same, so of alarms within 10 m the surest is kept.

    Args:
        outlook: the known actors, and how they go on.
        horizon: seconds to look ahead.
        danger_distance: metres.

    Returns:
        Positions in the present ego frame; ids of actors, None for a pair with the ego where its own is not known.
    """
    times = np.arange(round(horizon / FRAME_PERIOD) + 1, dtype=np.float64) * FRAME_PERIOD
    poses = outlook.poses(times)
    first, second = _candidates(outlook, poses, danger_distance)
    if not len(first):
        return []
    gap = _gaps(outlook, poses, first, second)
    near = gap < danger_distance
    moment = np.argmax(near, axis=0)
    least = gap.min(axis=0)
    approaching = (moment > 0) | (least < gap[0])
    approaching = (approaching & ~_is_driving_up(poses[0], first, second)) | (gap[0] == 0)
    score = (1 - least / danger_distance) / (1 + times[moment])
    alarms = [
        _accident(outlook, poses, (int(first[row]), int(second[row])), int(moment[row]), float(score[row]))
        for row in np.flatnonzero(near.any(axis=0) & approaching)
    ]
    return _one_a_site(alarms)


def _candidates(outlook: Outlook, poses: FloatArray, danger_distance: float) -> tuple[IntArray, IntArray]:
    """Pairs (rows of the boxes) whose circles meet at some moment, not both standing nor both on foot."""
    place, size = poses[..., :2], outlook.seen.boxes.size
    reach = np.hypot(size[:, 0], size[:, 1]) / 2
    apart = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1).min(axis=0, initial=np.inf)
    moves = np.linalg.norm(np.ptp(place, axis=0), axis=-1) >= _MOVES
    drives = outlook.seen.boxes.category != _PEDESTRIAN
    near = (apart < reach[:, None] + reach + danger_distance) & (moves[:, None] | moves) & (drives[:, None] | drives)
    first, second = np.nonzero(np.triu(near, 1))
    return first, second


def _is_driving_up(poses: FloatArray, first: IntArray, second: IntArray) -> BoolArray:
    """(P,) pairs of which one is straight ahead of the other and heads the same way; `poses` (N, 3) of the present."""
    way = poses[second] - poses[first]
    turn, yaw = np.arctan2(np.sin(way[:, 2]), np.cos(way[:, 2])), poses[first, 2]
    aside = np.cos(yaw) * way[:, 1] - np.sin(yaw) * way[:, 0]
    is_ahead: BoolArray = (np.abs(turn) < _SAME_WAY) & (np.abs(aside) < _SAME_LANE)
    return is_ahead


def _gaps(outlook: Outlook, poses: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """(T, P) metres between the boxes of P pairs."""
    size = np.broadcast_to(outlook.seen.boxes.size[:, :2], (*poses.shape[:2], 2))
    footprints = np.concatenate([poses[..., :2], size, poses[..., 2:]], axis=-1)
    return gaps_of_pairs(footprints[:, first], footprints[:, second])


def _accident(outlook: Outlook, poses: FloatArray, pair: tuple[int, int], moment: int, score: float) -> Accident:
    one, other = (_actor_id(outlook, row) for row in pair)
    return Accident(
        positions=poses[moment, list(pair), :2],
        time=moment * FRAME_PERIOD,
        score=score,
        ids=None if one is None or other is None else (one, other),
    )


def _actor_id(outlook: Outlook, row: int) -> int | None:
    actor: int = outlook.seen.boxes.actor_id.item(row)
    return outlook.seen.own_actor_id if actor == OWN_ACTOR_ID else actor


def _one_a_site(alarms: list[Accident]) -> list[Accident]:
    """The surest alarm of each place; the earliest of equally sure ones, then by place and ids."""
    kept: list[Accident] = []
    for alarm in sorted(alarms, key=lambda each: (-each.score, each.time, each.positions.tolist(), each.ids or ())):
        middle = alarm.positions.mean(axis=0)
        if all(np.linalg.norm(middle - other.positions.mean(axis=0)) >= _SITE for other in kept):
            kept.append(alarm)
    return kept
