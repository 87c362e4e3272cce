"""Whether detected boxes look mirrored, scaled, in another frame, a step off in time, or their sizes or headings so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.metrics.detection import DetectedBoxes
from deepaccident_devkit.evaluation.runs.sanity.probes import SCALES, SYMMETRIES, Suspicion, scale_says, tally
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

_NEAR: Final = 2.0
"""Metres on the ground: a true box with a detection as near is found."""
_NEAR_IN_3D: Final = 1.0
"""Metres: nearer, since frames of one agent differ by the height of its LiDAR alone."""
_FAR: Final = 10.0
_MOVED: Final = 2.0
"""Metres that an actor has to move within the step for its box to tell of the time."""
_OBLONG: Final = 1.3
"""Length over width from which on a box tells of the order of its sizes."""
_TELLING_TURN: Final = np.deg2rad(40.0)
_STEP_FRAMES: Final = 5
_LEAST: Final = 0.25
_LEAST_PAIRS: Final = 0.7
_LEAST_SIZES: Final = 0.8
_BOXES: Final = 20
_LAGS: Final = {"0.5 s late": -_STEP_FRAMES, "0.5 s early": _STEP_FRAMES}
_FRAMES: Final = ("ego", "lidar")
_LEFT_HANDED: Final = "left-handed world"
_HEADINGS: Final[dict[str, tuple[str, Callable[[FloatArray], FloatArray]]]] = {
    "heading turned by 90°": ("headings are a quarter of a turn too far to the left", lambda yaw: yaw + np.pi / 2),
    "heading turned by 180°": ("front and rear have changed places", lambda yaw: yaw + np.pi),
    "heading turned by 270°": ("headings are a quarter of a turn too far to the right", lambda yaw: yaw - np.pi / 2),
    "heading negated": ("headings have the other sign in the agent's own frame", lambda yaw: -yaw),
    "heading negated in the world": ("headings have the other sign in the world frame", lambda yaw: -yaw),
}
"""Name → what is wrong then, and from true to found."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DetectionMoments:
    """What the detections of a sample are compared with.

    Attributes:
        truth: the true boxes at the sample, in the frame of the metrics.
        world_from_frame: from there to the world.
        own_frames: frame of the agent → from the world's numbers, taken for its own, to the frame of the metrics.
        moved: lag in recorded frames → (M, 2, 3) centres in the world of the actors that move, at the sample and then.
    """

    truth: Boxes
    world_from_frame: SE3
    own_frames: dict[str, SE3]
    moved: dict[int, FloatArray]


def detection_moments(dataset: Dataset, token: str, truth: Boxes) -> DetectionMoments:
    """Of a sample and its true boxes; raises TokenError."""
    frame_from_world = dataset.world_from(token, truth.frame).inverse()
    return DetectionMoments(
        truth=truth.select(truth.actor_id != OWN_ACTOR_ID),
        world_from_frame=dataset.world_from(token, truth.frame),
        own_frames={name: frame_from_world @ dataset.world_from(token, name) for name in _FRAMES},
        moved={lag: _moved(dataset, token, lag) for lag in _LAGS.values()},
    )


def detection_suspicions() -> list[Suspicion]:
    """What is looked for in detections."""
    places = {
        **{each.name: f"{each.says} around the agent" for each in SYMMETRIES},
        **{name: scale_says(scale) for name, scale in SCALES.items()},
        **{f"{name} frame": f"boxes are given in the agent's {name} frame" for name in _FRAMES},
        _LEFT_HANDED: "y has the other sign in the world frame, as in CARLA",
    }
    result = [
        _suspicion(name, "place", says, "translations are in the right-handed world frame, metres", _LEAST)
        for name, says in places.items()
    ]
    result += [
        _suspicion(
            name,
            "time",
            f"boxes are where the actors are 0.5 s {'before' if lag < 0 else 'after'} the sample",
            "give what is there at the sample itself",
            _LEAST_PAIRS,
        )
        for name, lag in _LAGS.items()
    ]
    result.append(
        _suspicion(
            "length and width swapped",
            "size",
            "boxes are as wide as they should be long",
            "in results files sizes are width, length, height, as in nuScenes; in Boxes they are length, width, height",
            _LEAST_SIZES,
        )
    )
    return result + [
        _suspicion(
            name, "heading", says, "a heading is counter-clockwise from x of the world, seen from above", _LEAST_PAIRS
        )
        for name, (says, _) in _HEADINGS.items()
    ]


def detection_tallies(raw: DetectedBoxes, found: DetectedBoxes, moments: DetectionMoments) -> dict[str, list[float]]:
    """What a sample says of each suspicion.

    Args:
        raw: the detections in the world frame, as the results hold them.
        found: the same in the frame of the metrics.
        moments: the truth.
    """
    truth = moments.truth
    surest = np.argsort(-found.scores, kind="stable")[: 2 * len(truth)]
    center, in_world = found.boxes.center[surest], raw.boxes.center[surest]
    right = truth.center
    level = _found(center, right, 2, _NEAR)
    above = _found(center, right, 3, _NEAR_IN_3D)
    result = {each.name: _place(_moved_flat(center, each.undo), right, level) for each in SYMMETRIES}
    for name, scale in SCALES.items():
        result[name] = _place(center / (scale, scale, 1.0), right, level)
    for name, frame_from_own in moments.own_frames.items():
        result[f"{name} frame"] = _place(frame_from_own @ in_world, right, above, axes=3, near=_NEAR_IN_3D)
    mirrored = moments.world_from_frame.inverse() @ (in_world * (1.0, -1.0, 1.0))
    result[_LEFT_HANDED] = _place(mirrored, right, level)
    for name, lag in _LAGS.items():
        result[name] = _time(in_world, moments.moved[lag])
    return result | _pair_tallies(found.boxes.select(surest), raw.boxes.select(surest), moments)


def _suspicion(name: str, group: str, says: str, remedy: str, least: float) -> Suspicion:
    measures = {
        "place": "share of the true boxes that are found",
        "time": "share of the moving actors that are found there",
        "size": "share of the boxes found whose size fits better",
        "heading": "share of the boxes found whose heading is right",
    }
    return Suspicion(
        name=name,
        group=group,  # type: ignore[arg-type]  # one of the keys above
        says=says,
        remedy=remedy,
        measure=measures[group],
        least=least,
        evidence=_BOXES,
    )


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


def _place(center: FloatArray, right: FloatArray, given: int, axes: int = 2, near: float = _NEAR) -> list[float]:
    found = _found(center, right, axes, near)
    misfit = float(np.minimum(_distances(center, right, 3), _FAR).sum())
    return tally(found, len(right), given, misfit=misfit)


def _time(center: FloatArray, moved: FloatArray) -> list[float]:
    """Whether detections are nearer than half the way to where the moving actors are then, or to where they are."""
    half = np.linalg.norm(moved[:, 1, :2] - moved[:, 0, :2], axis=-1) / 2
    here, then = (int(np.count_nonzero(_distances(center, moved[:, side], 2) < half)) for side in (0, 1))
    return tally(then, len(moved), here)


def _pair_tallies(found: Boxes, raw: Boxes, moments: DetectionMoments) -> dict[str, list[float]]:
    """What the sizes and headings say of those true boxes that are found."""
    truth = moments.truth
    if not len(found) or not len(truth):
        return {}
    apart = np.linalg.norm(truth.center[:, None, :2] - found.center[:, :2], axis=-1)
    nearest = apart.argmin(axis=1)
    true = np.flatnonzero(apart.min(axis=1) < _NEAR)
    which = nearest[true]
    yaw_in_world = truth.transform(moments.world_from_frame, "world").yaw[true]
    result = {"length and width swapped": _sizes(found.size[which], truth.size[true])}
    for name, (_, apply) in _HEADINGS.items():
        sides = (raw.yaw[which], yaw_in_world) if name.endswith("world") else (found.yaw[which], truth.yaw[true])
        result[name] = _headings(*sides, apply)
    return result


def _sizes(found: FloatArray, right: FloatArray) -> list[float]:
    """Whether length and width fit better the other way round, of oblong boxes."""
    stretch = right[:, 0] / np.maximum(right[:, 1], 1e-6)
    tells = np.maximum(stretch, 1 / np.maximum(stretch, 1e-6)) >= _OBLONG
    misfit, swapped = (np.abs(found[:, order] - right[:, :2]).sum(axis=1)[tells] for order in ([0, 1], [1, 0]))
    return tally(int((swapped < misfit).sum()), int(tells.sum()), int((misfit <= swapped).sum()))


def _headings(found: FloatArray, right: FloatArray, apply: Callable[[FloatArray], FloatArray]) -> list[float]:
    """Whether headings are changed so, of boxes where that shows. All changes here move by a turn or mirror."""
    change = _turn(apply(right), right)
    after, before = _turn(found, apply(right)), _turn(found, right)
    tells = change >= _TELLING_TURN
    fits, given = (int((tells & (each < change / 2)).sum()) for each in (after, before))
    return tally(fits, int(tells.sum()), given, misfit=float(after.sum()))


def _turn(first: AnyArray, second: AnyArray) -> FloatArray:
    """The smaller angle between headings, radians."""
    turn: FloatArray = np.abs((first - second + np.pi) % (2 * np.pi) - np.pi)
    return turn
