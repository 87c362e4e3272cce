"""Which cell of a frame's own raster a cell of warped labels takes its values from."""

from __future__ import annotations

import math

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.geometry.bev_grid import BevGrid, Orientation
from deepaccident_devkit.geometry.handedness import flip_pose
from deepaccident_devkit.motion.cells.parts import Cell, CellSource, Pair
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.orientations import cells_in
from deepaccident_devkit.motion.protocols import LABEL_PROTOCOLS
from deepaccident_devkit.motion.warps.chains import present_from_frames
from deepaccident_devkit.motion.warps.warping import OUTSIDE, WarpMode, rounded_points, sample_points, sampling_matrix


def poses_at_present(labels: MotionLabels) -> FloatArray:
    """(T, 4, 4) `present_from_frame` of the labels' egomotion and augmentation, right-handed, without any quirk."""
    exact = LABEL_PROTOCOLS["clean"]
    poses: FloatArray = flip_pose(present_from_frames(labels.label_egomotion, exact, labels.config.augmentation))
    return poses


def cell_source(labels: MotionLabels, t: int, cell: Cell, centerness: WarpMode | None) -> CellSource:
    """The source of a cell of frame t; `centerness` is how that map was sampled, None if that is not known."""
    config = labels.config
    pose = poses_at_present(labels)[t]
    motion = (*_pair(pose[:2, 3]), math.atan2(pose[1, 0], pose[0, 0]))
    if not (labels.at_present and t):
        middle = _pair(config.grid.centers()[cell])
        point = (float(cell[0]), float(cell[1]))
        return CellSource(
            warped=False,
            rule=config.rules.warp,
            motion=motion,
            sample_point=point,
            cell=cell,
            center=middle,
            centerness="nearest",
        )
    points = _points(labels, t)
    columns = config.grid.shape[1]
    index = int(rounded_points(points, config.grid, config.rules, config.grid.orientation)[cell[0] * columns + cell[1]])
    source = None if index == OUTSIDE else divmod(index, columns)
    native, given = config.rules.native, config.grid.orientation
    there = tuple(int(one) for one in place_in(*cell, config.grid, given, native))
    row, column = place_in(float(points[0][there]), float(points[1][there]), config.grid, native, given)
    return CellSource(
        warped=True,
        rule=config.rules.warp,
        motion=motion,
        sample_point=(row, column),
        cell=source,
        center=None if source is None else _pair(config.grid.centers()[source]),
        centerness=centerness,
        blended=_blended(row, column, config.grid.shape) if centerness == "bilinear" else (),
    )


def place_in(row: float, column: float, grid: BevGrid, source: Orientation, target: Orientation) -> Pair:
    """Row and column of a place, which may lie between cells, in another orientation of the grid."""
    shape = grid.with_orientation(source).shape
    down, along = cells_in(np.array(row), np.array(column), shape, source, target)
    return float(down), float(along)


def _points(labels: MotionLabels, t: int) -> tuple[AnyArray, AnyArray]:
    """Where `to_present` samples frame t, in native orientation."""
    rules = labels.config.rules
    transforms = present_from_frames(labels.label_egomotion, rules, labels.config.augmentation)
    return sample_points(sampling_matrix(transforms, rules)[t], labels.config.grid, rules)


def _blended(row: float, column: float, shape: tuple[int, int]) -> tuple[tuple[Cell, float], ...]:
    """The cells in the grid around a sample point, with the weights of bilinear sampling."""
    top, left = math.floor(row), math.floor(column)
    down, right = row - top, column - left
    return tuple(
        ((top + below, left + beside), weight)
        for below, beside, weight in (
            (0, 0, (1 - down) * (1 - right)),
            (0, 1, (1 - down) * right),
            (1, 0, down * (1 - right)),
            (1, 1, down * right),
        )
        if weight and 0 <= top + below < shape[0] and 0 <= left + beside < shape[1]
    )


def _pair(values: AnyArray) -> Pair:
    x, y = np.asarray(values, dtype=np.float64).tolist()
    return x, y
