"""Whether the sizes, heights, headings, velocities and scores of detected boxes look swapped, turned or in other units.

Looked at are the true boxes that are found: pairs of a true box and the detection that is nearest to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray
from deepaccident_devkit.evaluation.runs.sanity.probes import SYMMETRIES, Group, Suspicion, nearer_tally, tally
from deepaccident_devkit.geometry import Boxes

NEAR: Final = 2.0
"""Metres on the ground: a true box with a detection as near is found."""
_TELLING_TURN: Final = np.deg2rad(40.0)
_QUARTER: Final = np.pi / 2
_ALIKE: Final = 0.999
"""Length of the mean of headings from which on they all point the same way: they are not predicted."""
_LEAST_CROOKED: Final = 0.4
_MARGIN_CROOKED: Final = 0.66
"""Of headings at random half is against each of a cross's four directions, of those 20 degrees off a third."""
_SPEED: Final = 2.0
"""m/s from which on a true velocity tells."""
_AXES: Final = ("length", "width", "height")
_SWAPPED: Final = "length and width swapped"
_ORDERS: Final = {
    _SWAPPED if order == (1, 0, 2) else f"sizes as {', '.join(_AXES[axis] for axis in order)}": order
    for order in permutations(range(3))
    if order != (0, 1, 2)
}
_FACTORS: Final = {"sizes halved": 0.5, "sizes doubled": 2.0}
_LEVELS: Final = {"center at the bottom": -0.5, "center at the top": 0.5}
"""Name → heights from the centre up to where it is found."""
_OFFSETS: Final[dict[str, tuple[float, str]]] = {
    "lidar frame by the ego pose": (-1.0, "boxes in the LiDAR frame were placed by the ego pose"),
    "ego frame by the lidar pose": (1.0, "boxes in the ego frame were placed by the LiDAR pose"),
}
"""Name → LiDAR's heights above the ego frame from the centre up to where it is found, and what is wrong then."""
_TURNS: Final[dict[str, tuple[str, Callable[[FloatArray], FloatArray]]]] = {
    "heading turned by 90°": ("headings are a quarter of a turn too far to the left", lambda yaw: yaw + _QUARTER),
    "heading turned by 180°": ("front and rear are swapped", lambda yaw: yaw + np.pi),
    "heading turned by 270°": ("headings are a quarter of a turn too far to the right", lambda yaw: yaw - _QUARTER),
}
_FLIPS: Final[dict[str, tuple[str, Callable[[FloatArray], FloatArray]]]] = {
    "heading negated": ("headings have the wrong sign", lambda yaw: -yaw),
    "heading clockwise from y": (
        "headings are counted clockwise from y, as by a compass,",
        lambda yaw: _QUARTER - yaw,
    ),
    "heading clockwise from -y": ("headings are counted clockwise from the negative y", lambda yaw: -_QUARTER - yaw),
    "heading clockwise from -x": ("headings are counted clockwise from the negative x", lambda yaw: np.pi - yaw),
    "heading in degrees": ("headings in degrees were taken for radians", np.rad2deg),
}
"""What is another thing in the agent's own frame than in the world."""
_IN_WORLD: Final = " in the world"
_HEADINGS: Final = {
    **_TURNS,
    **{name: (f"{says} in the agent's own frame", apply) for name, (says, apply) in _FLIPS.items()},
    **{name + _IN_WORLD: (f"{says} in the world frame", apply) for name, (says, apply) in _FLIPS.items()},
}
"""Name → what is wrong then, and from true to found."""
_OWN_HEADING: Final = "heading of the agent's frame"
_CROOKED_NAME: Final = "heading in degrees, or at random"
_CROOKED: Final = "share of the headings that are wrong"
_BY_CHANCE: Final = 0.5
_OWN_VELOCITY: Final = "velocity of the agent's frame"
_KMH: Final = "velocity in km/h"
_KMH_FACTOR: Final = 3.6
_RANKED: Final = "scores the wrong way round"


def pair_suspicions() -> list[Suspicion]:
    """What is looked for in the boxes that are found."""
    order = "in results files sizes are width, length, height, as in nuScenes; in Boxes they are length, width, height"
    result = [
        _suspicion(
            name,
            "size",
            f"length, width and height hold the values of {', '.join(_AXES[axis] for axis in axes)}",
            order,
        )
        for name, axes in _ORDERS.items()
    ]
    whole = "sizes are whole lengths, widths and heights in metres, not halves"
    result += [
        _suspicion(name, "size", f"sizes are {factor:g} times what they should be", whole)
        for name, factor in _FACTORS.items()
    ]
    result += [
        _suspicion(name, "height", f"z is that of the {name.split()[-1]} face", "z is that of the box's middle")
        for name in _LEVELS
    ]
    poses = 'the pose of LiDAR boxes is da.world_from(token, "lidar"), that of ego boxes da.world_from(token, "ego")'
    result += [_suspicion(name, "height", says, poses) for name, (_, says) in _OFFSETS.items()]
    upright = "a heading is counted counter-clockwise from x of the world, seen from above, in radians"
    headings = {name: says for name, (says, _) in _HEADINGS.items()}
    headings[_OWN_HEADING] = "headings are those of the agent's own frame, not of the world"
    headings[_CROOKED_NAME] = "headings are at random, which is also so if degrees were taken for radians"
    result += [_suspicion(name, "heading", says, upright) for name, says in headings.items()]
    result[-1] = replace(result[-1], measure=_CROOKED, least=_LEAST_CROOKED, margin=_MARGIN_CROOKED, chance=_BY_CHANCE)
    moving = "velocities are over the ground, along x and y of the world, m/s"
    velocities = {_velocity_name(each.name): f"{each.says} in the velocities" for each in SYMMETRIES}
    velocities[_OWN_VELOCITY] = "velocities are along the axes of the agent's own frame"
    velocities[_KMH] = "velocities are in km/h"
    result += [_suspicion(name, "velocity", says, moving) for name, says in velocities.items()]
    surer = "a surer detection must have a higher score: negate distances, costs and losses"
    return [*result, _suspicion(_RANKED, "score", "wrong detections have higher scores than right ones", surer)]


def pair_tallies(
    found: Boxes,
    raw: Boxes,
    scores: FloatArray,
    truth: Boxes,
    in_world: Boxes,
    velocity: FloatArray,
    lidar_height: float,
) -> dict[str, list[float]]:
    """What the boxes that are found say of each suspicion.

    Args:
        found: N detections in the frame of the metrics.
        raw: the same in the world frame.
        scores: (N,) theirs.
        truth: M true boxes in the frame of the metrics.
        in_world: the same in the world frame.
        velocity: (M, 2) m/s along x and y of the world; NaN where unknown.
        lidar_height: metres from the ego frame up to the LiDAR.
    """
    if not len(found) or not len(truth):
        return {}
    apart = np.linalg.norm(truth.center[:, None, :2] - found.center[:, :2], axis=-1)
    true = np.flatnonzero(apart.min(axis=1) < NEAR)
    which = apart.argmin(axis=1)[true]
    own_axes = truth.yaw[true] - in_world.yaw[true]
    return {
        **_size_tallies(found.size[which], truth.size[true]),
        **_height_tallies(found.center[which, 2], truth.center[true, 2], truth.size[true, 2], lidar_height),
        **_heading_tallies(found.yaw[which], raw.yaw[which], truth.yaw[true], in_world.yaw[true]),
        **_velocity_tallies(raw.velocity[which, :2], velocity[true], own_axes),
        _RANKED: _rank_tally(scores, apart.min(axis=0) < NEAR),
    }


_MEASURES: Final[dict[Group, tuple[str, float, float]]] = {
    "size": ("how near the sizes are to the true ones, from 0 to 1", 0.65, 60.0),
    "height": ("how near the heights are to the true ones, from 0 to 1", 0.65, 15.0),
    "heading": ("share of the boxes found whose heading is right", 0.65, 20.0),
    "velocity": ("how near the velocities are to the true ones, from 0 to 1", 0.65, 60.0),
    "score": ("share of the pairs of a right and a wrong detection in order", 0.65, 200.0),
}
"""Group → what its scores are, what they have to reach, and evidence: metres, boxes, m/s or pairs."""


def _suspicion(name: str, group: Group, says: str, remedy: str) -> Suspicion:
    measure, least, evidence = _MEASURES[group]
    return Suspicion(name=name, group=group, says=says, remedy=remedy, measure=measure, least=least, evidence=evidence)


def _nearer(found: FloatArray, true: FloatArray, wrong: FloatArray, order: int = 2) -> list[float]:
    """How much nearer rows (N, D) are to where a mistake takes the true ones."""
    before, after, change = (
        np.linalg.norm(one - other, ord=order, axis=-1) for one, other in ((found, true), (found, wrong), (wrong, true))
    )
    return nearer_tally(before, after, change, misfit=float(after.sum()))


def _size_tallies(found: FloatArray, true: FloatArray) -> dict[str, list[float]]:
    result = {name: _nearer(found, true, true[:, order], order=1) for name, order in _ORDERS.items()}
    return result | {name: _nearer(found, true, true * factor, order=1) for name, factor in _FACTORS.items()}


def _height_tallies(
    found: FloatArray, true: FloatArray, height: FloatArray, lidar_height: float
) -> dict[str, list[float]]:
    off = {name: share * height for name, share in _LEVELS.items()}
    off |= {name: np.full(len(true), sign * lidar_height) for name, (sign, _) in _OFFSETS.items()}
    return {name: _nearer(found[:, None], true[:, None], (true + each)[:, None]) for name, each in off.items()}


def _heading_tallies(
    found: FloatArray, raw: FloatArray, true: FloatArray, in_world: FloatArray
) -> dict[str, list[float]]:
    """Of headings in the frame of the metrics and in the world; nothing where all point the same way."""
    if any(len(each) and abs(np.exp(1j * each).mean()) > _ALIKE for each in (found, raw)) and len(found) > 1:
        return {}
    result = {
        name: _headings(*((raw, in_world) if name.endswith(_IN_WORLD) else (found, true)), apply)
        for name, (_, apply) in _HEADINGS.items()
    }
    result[_OWN_HEADING] = _headings(raw, in_world, lambda _: true)
    crooked = float((1 - np.cos(4 * (found - true))).sum()) / 2
    result[_CROOKED_NAME] = tally(crooked, len(true), len(true) - crooked, misfit=2 * np.pi * len(true))
    return result


def _headings(found: FloatArray, right: FloatArray, apply: Callable[[FloatArray], FloatArray]) -> list[float]:
    """Whether headings are changed so, of boxes where that shows."""
    change = _turn(apply(right), right)
    after, before = _turn(found, apply(right)), _turn(found, right)
    tells = change >= _TELLING_TURN
    fits, given = (int((tells & (each < change / 2)).sum()) for each in (after, before))
    return tally(fits, int(tells.sum()), given, misfit=float(after.sum()))


def _turn(first: AnyArray, second: AnyArray) -> FloatArray:
    """The smaller angle between headings, radians."""
    turn: FloatArray = np.abs((first - second + np.pi) % (2 * np.pi) - np.pi)
    return turn


def _velocity_tallies(found: FloatArray, true: FloatArray, own_axes: FloatArray) -> dict[str, list[float]]:
    """Of those whose both velocities are known and whose true one tells."""
    tells = np.isfinite(found).all(axis=-1) & (np.nan_to_num(np.linalg.norm(true, axis=-1)) >= _SPEED)
    found, true, turn = found[tells], true[tells], own_axes[tells]
    cosine, sine = np.cos(turn), np.sin(turn)
    own = np.column_stack([cosine * true[:, 0] - sine * true[:, 1], sine * true[:, 0] + cosine * true[:, 1]])
    wrong = {_velocity_name(each.name): each.apply(true) for each in SYMMETRIES}
    wrong |= {_OWN_VELOCITY: own, _KMH: true * _KMH_FACTOR}
    return {name: _nearer(found, true, each) for name, each in wrong.items()}


def _velocity_name(symmetry: str) -> str:
    return f"velocity {symmetry}"


def _rank_tally(scores: FloatArray, right: BoolArray) -> list[float]:
    """Pairs of a wrong detection and a right one in which the wrong one is the surer, and those in which it is not."""
    higher = scores[~right][:, None] - scores[right]
    return tally(int((higher > 0).sum()), higher.size, int((higher < 0).sum()))
