"""Collisions and errors of planned paths as UniAD, ST-P3, VAD and BEV-Planner count them: on cells, at 0.5 s steps.

The numbers of the four differ by definition alone; `CellRules` has a field for each quirk. docs/protocols.md, Planning,
names the lines of their code. Shapes: 6 steps at 0.5, 1, … 3 s; frame: the present's, x forward, y left, metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray, ShortRepr

STEPS: Final = 6
# Seconds.
STEP: Final = 0.5
# Seconds; each is two steps more.
HORIZONS: Final = (1, 2, 3)
# Metres from the ego to the edges of the grid.
HALF: Final = 50.0
# Metres from nuScenes' ego origin to its LiDAR.
LIDAR_AHEAD: Final = 0.985793
Over = Literal["step", "mean", "any"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CellRules(ShortRepr):
    """How one code counts; the quirks that were found in it, one field each.

    Attributes:
        whole_futures: whether samples without 3 s of recorded future are left out. If not, missing steps have an error
            of 0 and no collision, and count.
        error: at the step of the horizon, or the mean up to it.
        box_over: what is counted of the steps up to the horizon: the last one, their mean, or whether it is any.
        point_over: the same for collisions of the path's points.
        cell: metres.
        rows: what the rows of cells are: metres forward, their mirror image, or y (then columns are x).
        mirrored: whether columns are −y.
        drawn_ahead: metres that objects are drawn too far ahead.
        box_ahead: metres from the path's point to the centre of the ego's box.
        ego: length and width of that box; None for the agent's own.
        turned: whether the box turns with the path; below 1 m a step has no direction.
        point_far_off: whether the point's cell is 25 m away.
        objects: `vehicles` are all but pedestrians; those and pedestrians that are `seen` or `annotated` at the
            present.
    """

    whole_futures: bool = True
    error: Literal["step", "mean"] = "mean"
    box_over: Over = "mean"
    point_over: Over = "mean"
    cell: float = 0.5
    rows: Literal["forward", "backward", "sideways"] = "forward"
    mirrored: bool = True
    drawn_ahead: float = 0.0
    box_ahead: float = 0.5
    ego: tuple[float, float] | None = (4.084, 1.85)
    turned: bool = False
    point_far_off: bool = False
    objects: Literal["vehicles", "seen", "annotated"] = "vehicles"

    @property
    def size(self) -> int:
        """Cells along each side."""
        return round(2 * HALF / self.cell)

    @property
    def middle(self) -> float:
        """Metres from the centre of the first cell to the ego."""
        return HALF - self.cell / 2


def _own_box(rules: CellRules) -> CellRules:
    """The same rules for the agent's own box: here the path's point is the box's centre, up to 0.3 m."""
    return replace(rules, ego=None, box_ahead=0.0, drawn_ahead=0.0)


_PUBLIC: Final = {
    "uniad": CellRules(whole_futures=False, error="step", box_over="step", point_over="step"),
    "stp3": CellRules(mirrored=False, drawn_ahead=LIDAR_AHEAD, objects="seen"),
    "vad": CellRules(rows="backward", point_far_off=True, objects="annotated"),
    "bev_planner": CellRules(
        box_over="any",
        point_over="any",
        cell=0.1,
        rows="sideways",
        drawn_ahead=LIDAR_AHEAD,
        box_ahead=0.5 + LIDAR_AHEAD,
        turned=True,
    ),
}
CELL_PROTOCOLS: Final[Mapping[str, CellRules]] = MappingProxyType(
    _PUBLIC | {f"{name}_own_box": _own_box(rules) for name, rules in _PUBLIC.items()}
)
"""Name of the code → its rules; `…_own_box` are the same with the box of DeepAccident."""


def occupied(corners: FloatArray, rules: CellRules) -> BoolArray:
    """(H, W) the cells that boxes (N, 4, 2) cover."""
    x, y = corners[..., 0] + rules.drawn_ahead, corners[..., 1]
    along = -x if rules.rows == "backward" else x
    columns, rows = (along, y) if rules.rows == "sideways" else (-y if rules.mirrored else y, along)
    vertices = np.stack([columns, rows], axis=-1)
    if rules.cell == 0.5:
        cells = np.round((vertices + HALF) / rules.cell)
    else:
        cells = np.trunc(
            (vertices.astype(np.float32) + np.float32(rules.middle)) / np.float32(rules.cell)
        )
    import cv2

    drawn = np.zeros((rules.size, rules.size), dtype=np.uint8)
    there = (cells.max(axis=1) >= 0).all(axis=1) & (cells.min(axis=1) < rules.size).all(axis=1)
    for polygon in cells[there].astype(np.int32):
        cv2.fillPoly(drawn, [polygon], 1)
    return drawn.astype(bool)


def touching(
    path: FloatArray, cells: BoolArray, ego: tuple[float, float], rules: CellRules
) -> BoolArray:
    """(2, 6) whether the ego's box, and the path's point, is on an occupied one of the cells (6, H, W) of each step.

    Args:
        path: (6, 2).
        cells: from `occupied`.
        ego: length and width of the agent's own box.
        rules: the protocol.
    """
    steps = np.arange(len(path))
    row, column = _box(path, ego, rules)
    box = cells[steps[:, None], row, column].any(axis=1)
    row, column = _point(path, rules)
    inside = (row >= 0) & (row < rules.size) & (column >= 0) & (column < rules.size)
    point = inside & cells[steps, np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.stack([box, point])


def _box(path: FloatArray, ego: tuple[float, float], rules: CellRules) -> IntArray:
    """(2, 6, M) rows and columns of the box's cells, clipped to the grid."""
    spans = [
        [(side * extent / 2 + ahead + rules.middle) / rules.cell for side in (-1, 1)]
        for extent, ahead in zip(rules.ego or ego, (rules.box_ahead, 0.0), strict=True)
    ]
    along, across = np.meshgrid(
        *(np.arange(math.ceil(low), math.floor(high) + 1) for low, high in spans), indexing="ij"
    )
    ahead, aside = along.ravel(), across.ravel()
    x, y = path[:, :1] / rules.cell, path[:, 1:] / rules.cell
    if rules.turned:
        step = np.diff(path.astype(np.float32), axis=0, prepend=np.zeros((1, 2), dtype=np.float32))
        far = np.hypot(step[:, 0], step[:, 1]) >= _LEAST_STEP
        angle = np.where(far, np.arctan2(step[:, 1], step[:, 0]), 0.0)[:, None]
        centre = (rules.size - 1) / 2
        columns = (
            np.round((ahead - centre) * np.cos(angle) - (aside - centre) * np.sin(angle) + centre)
            + x
        )
        rows = (
            np.round((ahead - centre) * np.sin(angle) + (aside - centre) * np.cos(angle) + centre)
            + y
        )
    else:
        rows = rules.size - x - ahead if rules.rows == "backward" else x + ahead
        columns = aside + (-y if rules.mirrored else y)
    return np.clip(np.trunc(np.stack([rows, columns])), 0, rules.size - 1).astype(np.int64)


# Metres.
_LEAST_STEP: Final = 1.0


def _point(path: FloatArray, rules: CellRules) -> IntArray:
    """(2, 6) rows and columns of the path's points."""
    x, y = path.T
    if rules.point_far_off:
        cells = np.stack([rules.middle / 2 - x, rules.middle / 2 - y])
    else:
        cells = (
            np.stack([y, x] if rules.rows == "sideways" else [x, -y if rules.mirrored else y])
            + rules.middle
        )
    return np.trunc(cells / rules.cell).astype(np.int64)


def cell_numbers(
    path: FloatArray,
    recorded: FloatArray,
    valid: BoolArray,
    touched: tuple[BoolArray, BoolArray],
    rules: CellRules,
) -> dict[str, FloatArray]:
    """The numbers of a path (6, 2) beside the recorded one (6, 2), of which steps (6,) exist, at 1, 2 and 3 s.

    `touched` is what `touching` gives of the two. At steps at which the recorded path's box touches, nothing collides,
    and the step stays in the denominator: `left_out` is the share of such steps.

    Returns:
        Each (3,): `l2` metres, and `l2_endpoint`, which is at the horizon whatever the rules, NaN where nothing is
        recorded then; `collision`, `point_collision` and `left_out` shares. NaN if the sample does not count.
    """
    own, true = touched
    masked = true[0] | ~valid
    error = np.where(valid, np.hypot(*(path - recorded).T), 0.0)
    by_step: dict[str, tuple[AnyArray, Over]] = {
        "l2": (error, rules.error),
        "l2_endpoint": (np.where(valid, error, np.nan), "step"),
        "collision": (own[0] & ~masked, rules.box_over),
        "point_collision": (own[1] & ~masked, rules.point_over),
        "left_out": (masked, "mean" if rules.box_over == "any" else rules.box_over),
    }
    counts = valid.all() or not rules.whole_futures
    return {
        name: _over(values, how) if counts else np.full(3, np.nan)
        for name, (values, how) in by_step.items()
    }


def _over(values: AnyArray, how: Over) -> FloatArray:
    """(3,) the values (6,) of steps at the horizons."""
    upto = [values[: 2 * horizon].astype(np.float64) for horizon in HORIZONS]
    if how == "step":
        return np.array([each[-1] for each in upto])
    return np.array([each.max() if how == "any" else each.mean() for each in upto])
