"""Whether detected boxes look mirrored, scaled, in another frame, or a step off in time; of those found see `pairs`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.metrics.detection.boxes import columns_of
from deepaccident_devkit.evaluation.runs.sanity.pairs import NEAR, pair_suspicions, pair_tallies
from deepaccident_devkit.evaluation.runs.sanity.probes import SCALES, SYMMETRIES, Group, Suspicion, scale_says, tally
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

_NEAR_IN_3D: Final = 1.0
"""Metres: nearer, since frames of one agent differ by the height of its LiDAR alone."""
_FAR: Final = 10.0
_MOVED: Final = 2.0
"""Metres that an actor has to move within the step for its box to show the time."""
_THEN: Final = 0.8
"""Share of that way from which on a detection is where the actor is then: a slight delay is less than a step."""
_STEP_FRAMES: Final = 5
_LEAST: Final = 0.25
_MARGIN_OF_EDGES: Final = 1.5
"""Small boxes are found from their corners, too."""
_LEAST_MOVING: Final = 0.6
_BOXES: Final = 20
_LAGS: Final = {"0.5 s late": -_STEP_FRAMES, "0.5 s early": _STEP_FRAMES}
_FRAMES: Final = ("ego", "lidar")
_LEFT_HANDED: Final = "left-handed world"
_OWN_ORIGIN: Final = "world axes around the agent"
_EDGES: Final = {
    "front left corner": (1, 1),
    "front right corner": (1, -1),
    "rear left corner": (-1, 1),
    "rear right corner": (-1, -1),
    "front end": (1, 0),
    "rear end": (-1, 0),
}
"""What may be given instead of the centre → half lengths and half widths from there to it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionMoments:
    """What the detections of a sample are compared with.

    Attributes:
        truth: the true boxes at the sample, in the frame of the metrics.
        world_from_frame: from there to the world.
        in_world: the same boxes in the world frame.
        velocity: (M, 2) theirs over the ground, along x and y of the world, m/s; NaN where unknown.
        own_frames: frame of the agent → from the world's numbers, taken for its own, to the frame of the metrics.
        moved: lag in recorded frames → (M, 2, 3) centres in the world of the actors that move, at the sample and then.
    """

    truth: Boxes
    in_world: Boxes
    velocity: FloatArray
    world_from_frame: SE3
    own_frames: dict[str, SE3]
    moved: dict[int, FloatArray]


def detection_moments(dataset: Dataset, token: str, truth: Boxes) -> DetectionMoments:
    """Of a sample and its true boxes; raises TokenError."""
    world_from_frame = dataset.world_from(token, truth.frame)
    frame_from_world = world_from_frame.inverse()
    others = truth.select(truth.actor_id != OWN_ACTOR_ID)
    return DetectionMoments(
        truth=others,
        in_world=others.transform(world_from_frame, "world"),
        velocity=_velocity(dataset, token, others),
        world_from_frame=world_from_frame,
        own_frames={name: frame_from_world @ dataset.world_from(token, name) for name in _FRAMES},
        moved={lag: _moved(dataset, token, lag) for lag in _LAGS.values()},
    )


def detection_suspicions() -> list[Suspicion]:
    """What is looked for in detections."""
    places = {
        **{each.name: f"{each.says} around the agent" for each in SYMMETRIES},
        **{name: scale_says(scale) for name, scale in SCALES.items()},
        **{f"{name} frame": f"boxes are given in the agent's {name} frame" for name in _FRAMES},
        **{
            f"left-handed {name} frame": f"boxes are given in the agent's {name} frame, with y to the right"
            for name in _FRAMES
        },
        _LEFT_HANDED: "y has the wrong sign in the world frame, as in CARLA",
        _OWN_ORIGIN: "translations are counted from the agent, along x and y of the world",
        **{name: f"translations are those of the boxes' {name}, not of their centres" for name in _EDGES},
    }
    remedy = "translations are the boxes' centres in the right-handed world frame, in metres"
    result = [
        _suspicion(name, "place", says, remedy, "share of the true boxes that are found", _LEAST)
        for name, says in places.items()
    ]
    result = [replace(each, margin=_MARGIN_OF_EDGES) if each.name in _EDGES else each for each in result]
    result += [
        _suspicion(
            name,
            "time",
            f"boxes are where the actors are 0.5 s {'before' if lag < 0 else 'after'} the sample",
            "give the boxes of the sample's own moment",
            "share of the moving actors that are found there",
            _LEAST_MOVING,
        )
        for name, lag in _LAGS.items()
    ]
    return result + pair_suspicions()


def detection_tallies(raw: DetectedBoxes, found: DetectedBoxes, moments: DetectionMoments) -> dict[str, list[float]]:
    """What a sample says of each suspicion.

    Args:
        raw: the detections in the world frame, as the results hold them.
        found: the same in the frame of the metrics.
        moments: the truth.
    """
    truth = moments.truth
    surest = columns_of(found.boxes, found.scores).surest_first[: 2 * len(truth)]
    center, in_world = found.boxes.center[surest], raw.boxes.center[surest]
    right = truth.center
    level = _found(center, right, 2, NEAR)
    above = _found(center, right, 3, _NEAR_IN_3D)
    result = {each.name: _place(_moved_flat(center, each.undo), right, level) for each in SYMMETRIES}
    for name, scale in SCALES.items():
        result[name] = _place(center / (scale, scale, 1.0), right, level)
    for name, frame_from_own in moments.own_frames.items():
        for side, sign in (("", 1.0), ("left-handed ", -1.0)):
            own = frame_from_own @ (in_world * (1.0, sign, 1.0))
            result[f"{side}{name} frame"] = _place(own, right, above, axes=3, near=_NEAR_IN_3D)
    frame_from_world = moments.world_from_frame.inverse()
    result[_LEFT_HANDED] = _place(frame_from_world @ (in_world * (1.0, -1.0, 1.0)), right, level)
    result[_OWN_ORIGIN] = _place(frame_from_world @ (in_world + moments.world_from_frame.translation), right, level)
    boxes = found.boxes.select(surest)
    for name, edge in _EDGES.items():
        result[name] = _place(center - _from_center(boxes, edge), right, level)
    for name, lag in _LAGS.items():
        result[name] = _time(in_world, moments.moved[lag])
    raw_boxes, scores = raw.boxes.select(surest), found.scores[surest]
    ego_from_lidar = moments.own_frames["ego"].inverse() @ moments.own_frames["lidar"]
    return result | pair_tallies(
        *(boxes, raw_boxes, scores, truth, moments.in_world, moments.velocity), float(ego_from_lidar.translation[2])
    )


def _suspicion(name: str, group: Group, says: str, remedy: str, measure: str, least: float) -> Suspicion:
    return Suspicion(name=name, group=group, says=says, remedy=remedy, measure=measure, least=least, evidence=_BOXES)


def _velocity(dataset: Dataset, token: str, truth: Boxes) -> FloatArray:
    """(M, 2) m/s in the world of true boxes, by their actors; a protocol's own may be in another frame."""
    there = dataset.boxes(token, "world")
    actor, row = np.unique(there.actor_id, return_index=True)
    at = np.minimum(np.searchsorted(actor, truth.actor_id), len(actor) - 1)
    known = (truth.actor_id >= 0) & (actor[at] == truth.actor_id) if len(actor) else np.zeros(len(truth), dtype=bool)
    velocity = np.full((len(truth), 2), np.nan)
    velocity[known] = there.velocity[row[at[known]], :2]
    return velocity


def _from_center(boxes: Boxes, edge: tuple[int, int]) -> FloatArray:
    """(N, 3) metres from the boxes' centres to the middle of a corner or an end."""
    along, across = (boxes.size[:, :2] / 2 * edge).T
    cosine, sine = np.cos(boxes.yaw), np.sin(boxes.yaw)
    return np.column_stack([cosine * along - sine * across, sine * along + cosine * across, np.zeros(len(boxes))])


def _moved(dataset: Dataset, token: str, lag: int) -> FloatArray:
    """(M, 2, 3) where actors are in the world at a sample and so many frames later, of those that move enough."""
    row, agent = dataset.getind("sample", token), dataset.columns("sample")["agent_row"]
    if not 0 <= row + lag < len(agent) or agent[row + lag] != agent[row]:
        return np.zeros((0, 2, 3))
    here, there = (dataset.boxes(dataset.sample[each]["token"], "world") for each in (row, row + lag))
    mine, its = (each.select(each.actor_id >= 0) for each in (here, there))
    _, first, second = np.intersect1d(mine.actor_id, its.actor_id, return_indices=True)
    both = np.stack([mine.center[first], its.center[second]], axis=1)
    moved: FloatArray = both[np.linalg.norm(both[:, 1, :2] - both[:, 0, :2], axis=-1) >= _MOVED]
    return moved


def _moved_flat(center: FloatArray, undo: Callable[[FloatArray], FloatArray]) -> FloatArray:
    return np.column_stack([undo(center[:, :2]), center[:, 2]])


def _distances(center: FloatArray, right: FloatArray, axes: int) -> FloatArray:
    """(G,) metres from each true centre to the nearest detected one; infinite without any."""
    if not len(center):
        return np.full(len(right), np.inf)
    apart = np.linalg.norm(right[:, None, :axes] - center[None, :, :axes], axis=-1)
    nearest: FloatArray = apart.min(axis=1)
    return nearest


def _found(center: FloatArray, right: FloatArray, axes: int, near: float) -> int:
    return int(np.count_nonzero(_distances(center, right, axes) < near))


def _place(center: FloatArray, right: FloatArray, given: int, axes: int = 2, near: float = NEAR) -> list[float]:
    found = _found(center, right, axes, near)
    misfit = float(np.minimum(_distances(center, right, 3), _FAR).sum())
    return tally(found, len(right), given, misfit=misfit)


def _time(center: FloatArray, moved: FloatArray) -> list[float]:
    """Whether detections are where the moving actors are then, or on the way from where they are.

    Of each actor the detection counts that is nearest to that way, if it is near it.
    """
    if not len(center) or not len(moved):
        return tally(0, 0, 0)
    way = moved[:, 1, :2] - moved[:, 0, :2]
    length = np.linalg.norm(way, axis=-1)
    off = center[None, :, :2] - moved[:, 0, None, :2]
    share = (off * way[:, None]).sum(axis=-1) / length[:, None] ** 2
    aside = np.linalg.norm(off - np.clip(share, 0, 1)[..., None] * way[:, None], axis=-1)
    nearest = aside.argmin(axis=1)[:, None]
    at = np.take_along_axis(share, nearest, axis=1)[:, 0]
    there = np.take_along_axis(aside, nearest, axis=1)[:, 0] < length / 2
    then = int(np.count_nonzero(there & (at >= _THEN)))
    return tally(then, int(np.count_nonzero(there)), int(np.count_nonzero(there)) - then)
