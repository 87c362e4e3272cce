"""Collisions and errors of planned paths as UniAD, ST-P3, VAD and BEV-Planner count them: on cells, at 0.5 s steps.

The numbers of the four differ by definition alone; `CellRules` has a field for each quirk. docs/protocols.md, Planning,
names the lines of their code. Shapes: 6 steps at 0.5, 1, … 3 s; frame: the present's, x forward, y left, metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray

STEPS: Final = 6
STEP: Final = 0.5
"""Seconds."""
HORIZONS: Final = (1, 2, 3)
"""Seconds; each is two steps more."""
HALF: Final = 50.0
"""Metres from the ego to the edges of the grid."""
LIDAR_AHEAD: Final = 0.985793
"""Metres from nuScenes' ego origin to its LiDAR."""
Rows = Literal["forward", "backward", "sideways"]
Over = Literal["step", "mean", "any"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CellRules:
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
    rows: Rows = "forward"
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


class Steps(NamedTuple):
    """What happens at each of the 6 steps of a path.

    Attributes:
        box: whether the ego's box touches an occupied cell.
        point: whether the path's point lies in one.
    """

    box: BoolArray
    point: BoolArray


def occupied(corners: FloatArray, rules: CellRules) -> BoolArray:
    """(H, W) the cells that boxes (N, 4, 2) cover."""
    x, y = corners[..., 0] + rules.drawn_ahead, corners[..., 1]
    along = -x if rules.rows == "backward" else x
    columns, rows = (along, y) if rules.rows == "sideways" else (-y if rules.mirrored else y, along)
    vertices = np.stack([columns, rows], axis=-1)
    if rules.cell == 0.5:
        cells = np.round((vertices + HALF) / rules.cell)
    else:
        cells = np.trunc((vertices.astype(np.float32) + np.float32(rules.middle)) / np.float32(rules.cell))
    import cv2

    drawn = np.zeros((rules.size, rules.size), dtype=np.uint8)
    for polygon in cells.astype(np.int32):
        cv2.fillPoly(drawn, [polygon], 1)
    return drawn.astype(bool)


def touching(path: FloatArray, cells: BoolArray, ego: tuple[float, float], rules: CellRules) -> Steps:
    """What a path (6, 2) touches of the cells (6, H, W) of its steps, with a box of this length and width."""
    along, across = _box(ego, rules)
    if rules.turned:
        rows, columns = _turned_box(path, along, across, rules)
    else:
        rows, columns = _box_beside(path, along, across, rules)
    steps = np.arange(len(path))
    box = np.asarray(cells[steps[:, None], rows, columns].any(axis=1))
    row, column = _point(path, rules)
    inside = (row >= 0) & (row < rules.size) & (column >= 0) & (column < rules.size)
    point = np.zeros(len(path), dtype=bool)
    point[inside] = cells[steps[inside], row[inside], column[inside]]
    return Steps(box=box, point=point)


def _box(ego: tuple[float, float], rules: CellRules) -> tuple[IntArray, IntArray]:
    """The cells along and across of the box at the origin."""
    length, width = rules.ego or ego
    spans = []
    for extent, ahead in ((length, rules.box_ahead), (width, 0.0)):
        low, high = ((side * extent / 2 + ahead + rules.middle) / rules.cell for side in (-1, 1))
        spans.append(np.arange(math.ceil(low), math.floor(high) + 1))
    return spans[0], spans[1]


def _box_beside(path: FloatArray, along: IntArray, across: IntArray, rules: CellRules) -> tuple[IntArray, IntArray]:
    """(6, M) rows and columns of the box's cells, moved without turning and clipped to the grid."""
    forward, aside = path[:, :1] / rules.cell, (-path[:, 1:] if rules.mirrored else path[:, 1:]) / rules.cell
    ahead = np.repeat(along, len(across))
    rows = rules.size - forward - ahead if rules.rows == "backward" else forward + ahead
    columns = aside + np.tile(across, len(along))
    row, column = (np.clip(np.trunc(each), 0, rules.size - 1).astype(np.int64) for each in (rows, columns))
    return row, column


def _turned_box(path: FloatArray, along: IntArray, across: IntArray, rules: CellRules) -> tuple[IntArray, IntArray]:
    """(6, M) rows (y) and columns (x) of the box's cells, turned with the path."""
    step = np.diff(path.astype(np.float32), axis=0, prepend=np.zeros((1, 2), dtype=np.float32))
    far = np.hypot(step[:, 0], step[:, 1]) >= _LEAST_STEP
    angle = np.where(far, np.arctan2(step[:, 1], step[:, 0]), 0.0)[:, None]
    centre = (rules.size - 1) / 2
    a, b = np.repeat(along, len(across)) - centre, np.tile(across, len(along)) - centre
    x = np.round(a * np.cos(angle) - b * np.sin(angle) + centre)
    y = np.round(a * np.sin(angle) + b * np.cos(angle) + centre)
    columns, rows = (np.trunc(each + path[:, axis, None] / rules.cell) for axis, each in enumerate((x, y)))
    row, column = (np.clip(each, 0, rules.size - 1).astype(np.int64) for each in (rows, columns))
    return row, column


_LEAST_STEP: Final = 1.0
"""Metres."""


def _point(path: FloatArray, rules: CellRules) -> tuple[IntArray, IntArray]:
    """(6,) row and column of the path's points."""
    x, y = path.T
    if rules.point_far_off:
        quarter = rules.middle / 2
        rows, columns = (quarter - x) / rules.cell, (quarter - y) / rules.cell
    elif rules.rows == "sideways":
        rows, columns = (y + rules.middle) / rules.cell, (x + rules.middle) / rules.cell
    else:
        rows, columns = (x + rules.middle) / rules.cell, ((-y if rules.mirrored else y) + rules.middle) / rules.cell
    return np.trunc(rows).astype(np.int64), np.trunc(columns).astype(np.int64)


class CellNumbers(NamedTuple):
    """Of one path, at the horizons of 1, 2 and 3 s; NaN where the sample does not count.

    Attributes:
        l2: (3,) metres.
        collision: (3,) share of the box's collisions.
        point_collision: (3,) share of the points'.
        left_out: (3,) share of steps that cannot collide, since the recorded path touches there.
    """

    l2: FloatArray
    collision: FloatArray
    point_collision: FloatArray
    left_out: FloatArray


def cell_numbers(
    path: FloatArray, recorded: FloatArray, valid: BoolArray, found: tuple[Steps, Steps], rules: CellRules
) -> CellNumbers:
    """The numbers of a path (6, 2) beside the recorded one (6, 2), of which steps (6,) exist.

    `found` is what the two touch. At steps at which the recorded path's box touches, nothing collides, and the step
    stays in the denominator.
    """
    if rules.whole_futures and not valid.all():
        nothing = np.full(len(HORIZONS), np.nan)
        return CellNumbers(nothing, nothing, nothing, nothing)
    own, true = found
    masked = true.box | ~valid
    error = np.where(valid, np.hypot(*(path - recorded).T), 0.0)
    return CellNumbers(
        l2=_over(error, rules.error),
        collision=_over(own.box & ~masked, rules.box_over),
        point_collision=_over(own.point & ~masked, rules.point_over),
        left_out=_over(masked, "mean" if rules.box_over == "any" else rules.box_over),
    )


def _over(values: AnyArray, how: Over) -> FloatArray:
    """(3,) the values (6,) of steps at the horizons."""
    upto = [values[: 2 * horizon].astype(np.float64) for horizon in HORIZONS]
    if how == "step":
        return np.array([each[-1] for each in upto])
    return np.array([each.max() if how == "any" else each.mean() for each in upto])
