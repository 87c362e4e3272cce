"""Collisions and errors of plans as UniAD, ST-P3, VAD and BEV-Planner count them, on cells.

The numbers of the four differ only by their definitions; `CellRules` has a field for each quirk.
docs/protocols.md, Planning, names the lines of their code. Shapes: 6 steps at 0.5, 1, … 3 s; frame:
the present ego frame, x forward, y left, metres.
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
# Seconds from one step to the next.
STEP: Final = 0.5
# Seconds; each horizon is two steps longer than the one before.
HORIZONS: Final = (1, 2, 3)
# Metres from the ego to the edges of the grid.
HALF: Final = 50.0
# Metres from nuScenes' ego origin to its LiDAR.
LIDAR_AHEAD: Final = 0.985793
# Metres; a shorter step has no direction.
_MIN_STEP_M: Final = 1.0
Over = Literal["step", "mean", "any"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CellRules(ShortRepr):
    """How one code counts, one field per quirk that was found in it.

    Attributes:
        whole_futures: Whether samples without 3 s of recorded future are left out. If not, missing
            steps have an error of 0 and no collision, and count.
        error: Whether the error is that of the horizon's step, or the mean up to it.
        box_over: Reduction over the steps up to the horizon: `step`: the value at the last step;
            `mean`: the mean; `any`: whether any step collides.
        point_over: The same for collisions of the path's points.
        cell: Side of a cell, metres.
        rows: What the rows of cells are: metres forward, their mirror image, or y (then columns are
            x).
        mirrored: Whether columns are −y.
        drawn_ahead: Metres by which objects are drawn too far ahead.
        box_ahead: Metres from the path's point to the centre of the ego's box.
        ego: Length and width of that box, metres; None for the agent's own.
        turned: Whether the box turns with the path; a step shorter than 1 m has no direction.
        point_far_off: Whether the point's cell is 25 m away.
        objects: `vehicles`: all but pedestrians; `seen` or `annotated`: vehicles and pedestrians
            that are seen or annotated at the present.
    """

    # what is averaged over which steps
    whole_futures: bool = True
    error: Literal["step", "mean"] = "mean"
    box_over: Over = "mean"
    point_over: Over = "mean"
    # the grid
    cell: float = 0.5
    rows: Literal["forward", "backward", "sideways"] = "forward"
    mirrored: bool = True
    # the boxes and points that are compared on it
    drawn_ahead: float = 0.0
    box_ahead: float = 0.5
    ego: tuple[float, float] | None = (4.084, 1.85)
    turned: bool = False
    point_far_off: bool = False
    objects: Literal["vehicles", "seen", "annotated"] = "vehicles"

    @property
    def size(self) -> int:
        """Number of cells along each side."""
        return round(2 * HALF / self.cell)

    @property
    def middle(self) -> float:
        """Metres from the centre of the first cell to the ego."""
        return HALF - self.cell / 2


def _own_box(rules: CellRules) -> CellRules:
    """Return the same rules for the agent's own box.

    Here the path's point is the centre of the box, up to 0.3 m.
    """
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
    """Return the cells that boxes with corners (N, 4, 2) cover, shape (H, W)."""
    import cv2

    x = corners[..., 0] + rules.drawn_ahead
    y = corners[..., 1]
    rows = -x if rules.rows == "backward" else x
    columns = -y if rules.mirrored else y
    if rules.rows == "sideways":
        rows = y
        columns = x
    vertices = np.stack([columns, rows], axis=-1)
    if rules.cell == 0.5:
        cells = np.round((vertices + HALF) / rules.cell)
    else:
        offsets = vertices.astype(np.float32) + np.float32(rules.middle)
        cells = np.trunc(offsets / np.float32(rules.cell))
    drawn = np.zeros((rules.size, rules.size), dtype=np.uint8)
    high = cells.max(axis=1)
    low = cells.min(axis=1)
    touches_grid = (high >= 0).all(axis=1) & (low < rules.size).all(axis=1)
    for polygon in cells[touches_grid].astype(np.int32):
        cv2.fillPoly(drawn, [polygon], 1)
    return drawn.astype(bool)


def touching(
    path: FloatArray, cells: BoolArray, ego: tuple[float, float], rules: CellRules
) -> BoolArray:
    """Return whether the ego's box, and the path's point, is on an occupied cell at each step.

    Args:
        path: (6, 2) positions, metres.
        cells: (6, H, W) occupied cells of each step, from `occupied`.
        ego: Length and width of the agent's own box, metres.
        rules: The protocol.

    Returns:
        (2, 6), first for the box, then for the point.
    """
    steps = np.arange(len(path))
    row, column = _box(path, ego, rules)
    box = cells[steps[:, None], row, column].any(axis=1)
    row, column = _point(path, rules)
    is_inside = (row >= 0) & (row < rules.size) & (column >= 0) & (column < rules.size)
    row = np.where(is_inside, row, 0)
    column = np.where(is_inside, column, 0)
    return np.stack([box, is_inside & cells[steps, row, column]])


def _box(path: FloatArray, ego: tuple[float, float], rules: CellRules) -> IntArray:
    """Return rows and columns of the M cells of the box, clipped to the grid, shape (2, 6, M)."""
    length, width = rules.ego or ego
    along, across = np.meshgrid(
        _spanned_cells(length, rules.box_ahead, rules),
        _spanned_cells(width, 0.0, rules),
        indexing="ij",
    )
    ahead = along.ravel()
    aside = across.ravel()
    x = path[:, :1] / rules.cell
    y = path[:, 1:] / rules.cell
    if rules.turned:
        angle = _directions(path)[:, None]
        centre = (rules.size - 1) / 2
        cosine = np.cos(angle)
        sine = np.sin(angle)
        columns = np.round((ahead - centre) * cosine - (aside - centre) * sine + centre) + x
        rows = np.round((ahead - centre) * sine + (aside - centre) * cosine + centre) + y
    else:
        rows = x + ahead
        if rules.rows == "backward":
            rows = rules.size - x - ahead
        columns = aside + (-y if rules.mirrored else y)
    return np.clip(np.trunc(np.stack([rows, columns])), 0, rules.size - 1).astype(np.int64)


def _spanned_cells(extent: float, ahead: float, rules: CellRules) -> IntArray:
    """Return the numbers of the cells that an extent spans, `ahead` metres ahead of the ego."""
    half = extent / 2
    low = (-half + ahead + rules.middle) / rules.cell
    high = (half + ahead + rules.middle) / rules.cell
    first_cell = math.ceil(low)
    end_cell = math.floor(high) + 1
    return np.arange(first_cell, end_cell)


def _directions(path: FloatArray) -> FloatArray:
    """Return the direction of each step (6,), radians; 0 for short steps."""
    origin = np.zeros((1, 2), dtype=np.float32)
    step = np.diff(path.astype(np.float32), axis=0, prepend=origin)
    has_direction = np.hypot(step[:, 0], step[:, 1]) >= _MIN_STEP_M
    return np.where(has_direction, np.arctan2(step[:, 1], step[:, 0]), 0.0)


def _point(path: FloatArray, rules: CellRules) -> IntArray:
    """Return rows and columns of the path's points, shape (2, 6)."""
    x, y = path.T
    if rules.point_far_off:
        cells = np.stack([rules.middle / 2 - x, rules.middle / 2 - y])
    elif rules.rows == "sideways":
        cells = np.stack([y, x]) + rules.middle
    else:
        cells = np.stack([x, -y if rules.mirrored else y]) + rules.middle
    return np.trunc(cells / rules.cell).astype(np.int64)


def plan_displacement_errors(path: FloatArray, recorded: FloatArray) -> FloatArray:
    """Return the distance of a planned path from the recorded one at each step (L2), metres.

    As in UniAD (`planning_metrics.py`) and ST-P3 (`metrics.py`), before their mean over steps.

    >>> import numpy as np
    >>> plan_displacement_errors(np.array([[3.0, 4.0], [6.0, 0.0]]), np.zeros((2, 2))).tolist()
    [5.0, 6.0]

    Args:
        path: (T, 2) planned positions, metres.
        recorded: (T, 2) recorded positions at the same times, in the same frame, metres.

    Returns:
        (T,) metres.
    """
    return np.asarray(np.hypot(*(path - recorded).T))


def collision_rate(
    touched: BoolArray, recorded_touched: BoolArray, valid: BoolArray, over: Over = "mean"
) -> FloatArray:
    """Return the collision rate of one plan at 1, 2 and 3 s, as the four public codes define it.

    Steps at which the recorded path touches as well, or is not recorded, cannot collide, but stay
    in the denominator. The rate of many plans is the mean over them.

    >>> import numpy as np
    >>> touched = np.array([False, False, True, True, True, True])
    >>> recorded_touched = np.array([False, False, False, False, False, True])
    >>> collision_rate(touched, recorded_touched, np.ones(6, dtype=bool)).tolist()
    [0.0, 0.5, 0.5]

    Args:
        touched: (6,) whether the plan touches an object at steps of 0.5 s.
        recorded_touched: (6,) whether the recorded path does.
        valid: (6,) whether the step is recorded.
        over: Reduction over the steps up to the horizon: `step`: value at the last step; `mean`;
            `any`: whether any step collides.

    Returns:
        (3,) shares in [0, 1].
    """
    return _at_horizons(touched & ~(recorded_touched | ~valid), over)


def cell_numbers(
    path: FloatArray,
    recorded: FloatArray,
    valid: BoolArray,
    touched: tuple[BoolArray, BoolArray],
    rules: CellRules,
) -> dict[str, FloatArray]:
    """Return the numbers of a path beside the recorded one, at 1, 2 and 3 s.

    At steps at which the recorded path's box touches, nothing collides, and the step stays in the
    denominator: `left_out` is the share of such steps.

    Args:
        path: (6, 2) planned positions, metres.
        recorded: (6, 2) recorded positions, metres.
        valid: (6,) whether the steps are recorded.
        touched: What `touching` returns for the planned and for the recorded path.
        rules: The protocol.

    Returns:
        Arrays (3,): `l2`, metres; `l2_endpoint`, metres at the horizon by any rules, NaN where
        nothing is recorded there; `collision`, `point_collision` and `left_out`, shares. NaN if the
        sample does not count.
    """
    if rules.whole_futures and not valid.all():
        names = ("l2", "l2_endpoint", "collision", "point_collision", "left_out")
        return {name: np.full(3, np.nan) for name in names}
    (box, point), (recorded_box, _) = touched
    errors = plan_displacement_errors(path, recorded)
    left_out_over = "mean" if rules.box_over == "any" else rules.box_over
    return {
        "l2": _at_horizons(np.where(valid, errors, 0.0), rules.error),
        "l2_endpoint": _at_horizons(np.where(valid, errors, np.nan), "step"),
        "collision": collision_rate(box, recorded_box, valid, rules.box_over),
        "point_collision": collision_rate(point, recorded_box, valid, rules.point_over),
        "left_out": _at_horizons(recorded_box | ~valid, left_out_over),
    }


def _at_horizons(values: AnyArray, over: Over) -> FloatArray:
    """Return values (6,) of steps reduced to the horizons, shape (3,)."""
    reduced = []
    for horizon in HORIZONS:
        steps = values[: 2 * horizon].astype(np.float64)
        if over == "step":
            reduced.append(steps[-1])
        elif over == "any":
            reduced.append(steps.max())
        else:
            reduced.append(steps.mean())
    return np.array(reduced)
