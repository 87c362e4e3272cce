"""Collisions and errors of plans on grid cells, as UniAD, ST-P3, VAD and BEV-Planner count them.

The numbers of the four differ only by their definitions; `CellRules` has a field for each quirk.
The section "Planning" of docs/protocols.md names the commits of their code. A path has 6 steps, at
0.5, 1, … 3 s. Positions are in the current ego frame: x forward, y left, metres.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray, ShortRepr

# Number of steps of a path.
STEPS: Final = 6
# Seconds from one step to the next.
STEP: Final = 0.5
# Seconds; each horizon is two steps longer than the previous one.
HORIZONS: Final = (1, 2, 3)
# Metres from the ego to the edges of the grid.
HALF: Final = 50.0
# Distance, in metres, by which nuScenes' LiDAR is in front of its ego origin.
LIDAR_AHEAD: Final = 0.985793
# A step shorter than this has no direction, metres.
_MIN_STEP_M = 1.0
# How values at the steps up to a horizon are reduced to one.
Over = Literal["step", "mean", "any"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CellRules(ShortRepr):
    """Rules of one public implementation, with one field per quirk that was found.

    Attributes:
        whole_futures: Whether samples without 3 s of recorded future are left out. Otherwise
            missing steps count, with an error of 0 and no collision.
        error: Which error is reported at a horizon: `step`, the error at the horizon's step, or
            `mean`, the mean over all steps up to it.
        box_over: How collisions of the box are reduced over the steps up to a horizon. `step`:
            whether the last step collides; `mean`: the mean; `any`: whether any step collides.
        point_over: How collisions of the path's points are reduced, as for `box_over`.
        cell: Side length of a cell, metres.
        rows: What the rows of the grid are: `forward`, x; `backward`, x mirrored; `sideways`, y
            (then columns are x).
        mirrored: Whether columns are −y instead of y.
        drawn_ahead: By how many metres objects are drawn too far ahead.
        box_ahead: By how many metres the centre of the ego's box is in front of the path's point.
        ego: Length and width of the ego's box, metres; None for the size of the agent's own box.
        turned: Whether the box turns with the path; a step shorter than 1 m has no direction.
        point_far_off: Whether the cell that is checked for the path's point is 25 m away from it, a
            bug.
        objects: Which objects count. `vehicles`: all but pedestrians; `seen` and `annotated`: the
            vehicles and pedestrians that are seen, or annotated, in the current frame.
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
    # the boxes and points that are drawn on the grid
    drawn_ahead: float = 0.0
    box_ahead: float = 0.5
    ego: tuple[float, float] | None = (4.084, 1.85)
    turned: bool = False
    point_far_off: bool = False
    objects: Literal["vehicles", "seen", "annotated"] = "vehicles"

    @property
    def size(self) -> int:
        """Number of cells along each side of the grid."""
        return round(2 * HALF / self.cell)

    @property
    def middle(self) -> float:
        """Distance from the centre of the first cell to the ego along one axis, metres."""
        return HALF - self.cell / 2


def _with_own_box(rules: CellRules) -> CellRules:
    """Adapt rules to the agent's own box, whose centre is on the path (± 0.3 m)."""
    return replace(rules, ego=None, box_ahead=0.0, drawn_ahead=0.0)


_PUBLIC_CODES = {
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
    _PUBLIC_CODES
    | {f"{name}_own_box": _with_own_box(rules) for name, rules in _PUBLIC_CODES.items()}
)
"""Name of the implementation → its rules; `…_own_box` uses DeepAccident's boxes instead."""


def occupied(corners: FloatArray, rules: CellRules) -> BoolArray:
    """Mark the cells that boxes with corners (N, 4, 2) in metres cover, shape (H, W) bool."""
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
    reaches_first_cell = (cells.max(axis=1) >= 0).all(axis=1)
    reaches_last_cell = (cells.min(axis=1) < rules.size).all(axis=1)
    is_on_grid = reaches_first_cell & reaches_last_cell
    image = np.zeros((rules.size, rules.size), dtype=np.uint8)
    for polygon in cells[is_on_grid].astype(np.int32):
        cv2.fillPoly(image, [polygon], 1)
    return image.astype(bool)


def touching(
    path: FloatArray, cells: BoolArray, ego: tuple[float, float], rules: CellRules
) -> BoolArray:
    """Find the steps at which the ego's box, or the path's point, is on an occupied cell.

    Args:
        path: (6, 2) planned positions, metres.
        cells: (6, H, W) bool, the occupied cells at each step, from `occupied`.
        ego: Length and width of the agent's own box, metres.
        rules: Rules of the implementation.

    Returns:
        (2, 6) bool: the first row for the box, the second for the point.
    """
    steps = np.arange(len(path))
    row, column = _box_cells(path, ego, rules)
    box_touches = cells[steps[:, None], row, column].any(axis=1)
    row, column = _point_cells(path, rules)
    is_on_grid = (row >= 0) & (row < rules.size) & (column >= 0) & (column < rules.size)
    row[~is_on_grid] = 0
    column[~is_on_grid] = 0
    point_touches = is_on_grid & cells[steps, row, column]
    return np.stack([box_touches, point_touches])


def _box_cells(path: FloatArray, ego: tuple[float, float], rules: CellRules) -> IntArray:
    """Return the rows and columns of the box's M cells, clipped to the grid, shape (2, 6, M)."""
    length, width = rules.ego or ego
    cells_ahead, cells_aside = np.meshgrid(
        _spanned_cells(length, rules.box_ahead, rules),
        _spanned_cells(width, 0.0, rules),
        indexing="ij",
    )
    ahead = cells_ahead.ravel()
    aside = cells_aside.ravel()
    x = path[:, :1] / rules.cell
    y = path[:, 1:] / rules.cell
    if rules.turned:
        angle = _directions(path)[:, None]
        cosine = np.cos(angle)
        sine = np.sin(angle)
        centre = (rules.size - 1) / 2
        from_centre_x = ahead - centre
        from_centre_y = aside - centre
        columns = np.round(from_centre_x * cosine - from_centre_y * sine + centre) + x
        rows = np.round(from_centre_x * sine + from_centre_y * cosine + centre) + y
    else:
        rows = x + ahead
        if rules.rows == "backward":
            rows = rules.size - x - ahead
        columns = aside + (-y if rules.mirrored else y)
    cells = np.trunc(np.stack([rows, columns]))
    return cells.clip(0, rules.size - 1).astype(np.int64)


def _spanned_cells(extent: float, ahead: float, rules: CellRules) -> IntArray:
    """Return the indices of the cells that the box spans along one axis.

    Args:
        extent: Length of the box along the axis, metres.
        ahead: Offset of its centre along the axis, metres.
        rules: Rules of the implementation.
    """
    half = extent / 2
    low = (-half + ahead + rules.middle) / rules.cell
    high = (half + ahead + rules.middle) / rules.cell
    first_cell = math.ceil(low)
    end_cell = math.floor(high) + 1
    return np.arange(first_cell, end_cell)


def _directions(path: FloatArray) -> FloatArray:
    """Return the direction of each step, (6,) radians; 0 for steps shorter than 1 m."""
    origin = np.zeros((1, 2), dtype=np.float32)
    steps = np.diff(path.astype(np.float32), axis=0, prepend=origin)
    dx, dy = steps.T
    has_direction = np.hypot(dx, dy) >= _MIN_STEP_M
    return np.where(has_direction, np.arctan2(dy, dx), 0.0)


def _point_cells(path: FloatArray, rules: CellRules) -> IntArray:
    """Return the rows and columns of the cells that contain the path's points, shape (2, 6)."""
    x, y = path.T
    if rules.point_far_off:
        offsets = rules.middle / 2 - path.T
    elif rules.rows == "sideways":
        offsets = np.stack([y, x]) + rules.middle
    else:
        offsets = np.stack([x, -y if rules.mirrored else y]) + rules.middle
    return np.trunc(offsets / rules.cell).astype(np.int64)


def plan_displacement_errors(path: FloatArray, recorded: FloatArray) -> FloatArray:
    """Return the distance (L2) of a planned path from the recorded path at each step, metres.

    UniAD (`planning_metrics.py`) and ST-P3 (`metrics.py`) compute the same distances before they
    average over steps.

    >>> import numpy as np
    >>> plan_displacement_errors(np.array([[3.0, 4.0], [6.0, 0.0]]), np.zeros((2, 2))).tolist()
    [5.0, 6.0]

    Args:
        path: (T, 2) planned positions, metres.
        recorded: (T, 2) recorded positions at the same times, in the same frame, metres.

    Returns:
        Distances, shape (T,), metres.
    """
    dx, dy = (path - recorded).T
    return np.asarray(np.hypot(dx, dy))


def collision_rate(
    touched: BoolArray, recorded_touched: BoolArray, valid: BoolArray, over: Over = "mean"
) -> FloatArray:
    """Return the collision rate of one plan at 1, 2 and 3 s, as the public implementations do.

    A step does not collide if the recorded path touches an object, too, or if the step is not
    recorded; such steps still count in the denominator. Rates of several plans are averaged.

    >>> import numpy as np
    >>> touched = np.array([False, False, True, True, True, True])
    >>> recorded_touched = np.array([False, False, False, False, False, True])
    >>> collision_rate(touched, recorded_touched, np.ones(6, dtype=bool)).tolist()
    [0.0, 0.5, 0.5]

    Args:
        touched: (6,) bool, steps (of 0.5 s) at which the plan touches an object.
        recorded_touched: (6,) bool, steps at which the recorded path touches an object.
        valid: (6,) bool, steps that are recorded.
        over: How the steps up to a horizon are reduced. `step`: whether the last step collides;
            `mean`: the mean; `any`: whether any step collides.

    Returns:
        Shares in [0, 1], shape (3,).
    """
    collides = touched & ~recorded_touched & valid
    return _at_horizons(collides, over)


def cell_numbers(
    path: FloatArray,
    recorded: FloatArray,
    valid: BoolArray,
    touched: tuple[BoolArray, BoolArray],
    rules: CellRules,
) -> dict[str, FloatArray]:
    """Compute the errors and collisions of a planned path at 1, 2 and 3 s.

    A step does not collide if the box on the recorded path touches an object, or if the step is not
    recorded; such steps still count in the denominator.

    Args:
        path: (6, 2) planned positions, metres.
        recorded: (6, 2) recorded positions, metres.
        valid: (6,) bool, steps that are recorded.
        touched: Results of `touching` for the planned and for the recorded path.
        rules: Rules of the implementation.

    Returns:
        Arrays (3,). `l2`: error by the rules, metres. `l2_endpoint`: error at the horizon itself,
        metres; NaN if that step is not recorded. `collision`, `point_collision`: shares.
        `left_out`: share of the steps that cannot collide. All are NaN if the sample does not
        count.
    """
    if rules.whole_futures and not valid.all():
        names = ("l2", "l2_endpoint", "collision", "point_collision", "left_out")
        return {name: np.full(3, np.nan) for name in names}
    box, point = touched[0]
    recorded_box, _ = touched[1]
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
    """Reduce the values at steps (6,) up to each horizon, shape (3,)."""
    reduced_values = []
    for horizon in HORIZONS:
        step_values = values[: 2 * horizon].astype(np.float64)
        if over == "step":
            reduced_values.append(step_values[-1])
        elif over == "any":
            reduced_values.append(step_values.max())
        else:
            reduced_values.append(step_values.mean())
    return np.array(reduced_values)
