"""Motion labels from boxes: who is drawn where, under which id, and where that is at the next frame.

Every frame is drawn in its own ego frame (evaluation.md a and h); `MotionLabels.to_present` warps the maps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.arrays import AnyArray, IntArray, checked
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry.bev_grid import Axis
from deepaccident_devkit.geometry.handedness import flip_pose, flip_six_vector
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.drawing.box_polygons import FrameBoxes, FramePolygons, box_polygons
from deepaccident_devkit.motion.drawing.label_maps import CoveredCells, label_maps
from deepaccident_devkit.motion.drawing.polygon_fill import filled_cells
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.warps import single_precision
from deepaccident_devkit.motion.warps.single_precision import Float32Array
from deepaccident_devkit.motion.warps.warping import native_orientation, nearest_indices, sampling_matrix
from deepaccident_devkit.taxonomy import UNTRACKED_ID

__all__ = ["FrameBoxes", "FramePolygons", "labels_from_polygons", "motion_labels_from_boxes"]


def motion_labels_from_boxes(
    frames: Sequence[FrameBoxes | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig,
    *,
    valid: ArrayLike | None = None,
    is_vehicle: bool = True,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """The motion labels of boxes, each frame in its own ego frame.

    Args:
        frames: what the agent annotated at each of `config.label_frames` moments from the present on; None where there
            is no recording.
        egomotion: (R, 6) `next_from_this` ego poses, right-handed, R = `config.frames`, from the first past frame on,
            as `v2x.future_egomotion` gives them; taken as float32.
        config: what labels show.
        valid: (R,) bool, which frames are in the recording; those of `frames` and all past ones, if None.
        is_vehicle: whether the agent is one and has a box of its own to draw (the roadside pole has none).
        id_map: actor id → id that a sample before this one had: the released code keeps them for a scenario and agent
            as long as a worker meets no other. None starts at 1.

    Raises:
        GeometryError: another number of frames or rows, or a motion that is not finite.
    """
    polygons = box_polygons(frames, config, is_vehicle=is_vehicle)
    return labels_from_polygons(polygons, egomotion, config, valid=valid, id_map=id_map)


def labels_from_polygons(
    polygons: Sequence[FramePolygons | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig,
    *,
    valid: ArrayLike | None = None,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """The motion labels of footprints, each frame in its own ego frame; arguments as in `motion_labels_from_boxes`.

    Raises:
        GeometryError: another number of frames or rows, or a motion that is not finite.
    """
    if len(polygons) != config.label_frames:
        raise GeometryError(
            f"frames: expected {config.label_frames}, the present and {config.future_frames} after it, "
            f"found {len(polygons)}; give None for those beyond the recording"
        )
    motion = checked("egomotion", egomotion, (config.frames, 6), np.float32)
    if not np.isfinite(motion).all():
        raise GeometryError("egomotion: not all numbers are finite; rows without a motion are zero")
    past = config.receptive_field - 1
    there = [True] * past + [frame is not None for frame in polygons]
    known = checked("valid", there if valid is None else valid, (config.frames,), np.bool_)
    ids, continued = _numbered(polygons, config, dict(id_map or {}))
    covered = _covered(polygons, ids, config)
    centers = covered.centers()
    following = _following_centers(covered, _flow_matrices(motion[past:-1], config), config)
    following[np.isnan(centers)] = np.nan
    missing = np.array([frame is None for frame in polygons])
    maps = label_maps(covered, centers, following, missing, config)
    return MotionLabels(
        config=config,
        segmentation=maps.segmentation,
        instance=maps.instance,
        centerness=maps.centerness,
        offset=maps.offset,
        flow=maps.flow,
        future_egomotion=motion,
        valid=known,
        id_map=continued,
    )


def _numbered(
    polygons: Sequence[FramePolygons | None], config: MotionLabelConfig, id_map: dict[int, int]
) -> tuple[IntArray, dict[int, int]]:
    """The id of each polygon of all frames, and the map continued: ids from 1 in the order drawn."""
    highest, ids = max(id_map.values(), default=0), []
    nobody = None if config.rules.untracked_share_an_id else UNTRACKED_ID
    for key in (key for frame in polygons if frame is not None for key in frame.key.tolist()):
        if key == nobody or key not in id_map:
            highest += 1
            if key != nobody:
                id_map[key] = highest
        ids.append(highest if key == nobody else id_map[key])
    return np.array(ids, dtype=np.int64), id_map


def _covered(polygons: Sequence[FramePolygons | None], ids: IntArray, config: MotionLabelConfig) -> CoveredCells:
    """The native cells of the polygons with these ids; later ones lie on top."""
    native = config.grid.with_orientation(native_orientation(config.rules.warp))
    there = [(number, frame) for number, frame in enumerate(polygons) if frame is not None]
    corners = np.concatenate([np.zeros((0, 4, 2), dtype=np.float32), *(frame.corners for _, frame in there)])
    image = np.repeat([number for number, _ in there], [len(frame.key) for _, frame in there]).astype(np.int64)
    cells, owner = filled_cells(_vertices(corners, config), native.shape, image, len(polygons))
    frame = image[owner]
    row = cells // native.shape[1]  # of all frames on end
    return CoveredCells(
        frame=frame,
        row=row - frame * native.shape[0],
        column=cells - row * native.shape[1],
        identity=ids[owner],
        frames=len(polygons),
        ids=int(ids.max(initial=0)),
    )


def _vertices(corners: AnyArray, config: MotionLabelConfig) -> IntArray:
    """Native column and row that corners (n, 4, 2), x and y (left), metres, are drawn at."""
    fiery, (low, high, size) = native_orientation(config.rules.warp) == "fiery", config.grid.y
    along_x = _steps(corners[..., 0], config.grid.x, config)
    if fiery:
        return np.stack([_steps(corners[..., 1], config.grid.y, config), along_x], axis=-1)
    return np.stack([along_x, _steps(-corners[..., 1], (-high, -low, size), config)], axis=-1)


def _steps(values: AnyArray, axis: Axis, config: MotionLabelConfig) -> IntArray:
    low, _, size = axis
    if not config.rules.half_cell_shift:
        cells: AnyArray = np.floor((values.astype(np.float64) - low) / size)
    else:
        first_center, cell = np.float32(low + size / 2), np.float32(size)
        cells = np.rint((values - first_center + cell / np.float32(2)) / cell)
    return cells.astype(np.int64)


def _flow_matrices(motion: Float32Array, config: MotionLabelConfig) -> AnyArray:
    """For each right-handed motion (n, 6): (n, 4, 4) native points of this frame in the next one's."""
    rule = config.rules.warp
    fiery = native_orientation(rule) == "fiery"
    native = motion if fiery else flip_six_vector(motion)
    backward = single_precision.inverse(single_precision.pose_matrices(native))
    if config.augmentation is not None:
        transform = config.augmentation.matrix if fiery else flip_pose(config.augmentation.matrix)
        moved = np.broadcast_to(transform.astype(np.float32), backward.shape)
        backward = single_precision.product(
            single_precision.product(moved, backward), single_precision.inverse(moved.copy())
        )
    return sampling_matrix(backward, rule)


def _following_centers(covered: CoveredCells, next_from_this: AnyArray, config: MotionLabelConfig) -> Float32Array:
    """(T, 1 + ids, 2) centres of the instances at the next frame, warped to each frame; NaN where they are not seen."""
    columns = config.grid.with_orientation(native_orientation(config.rules.warp)).shape[1]
    identity = np.zeros((covered.frames, config.grid.cells + 1), dtype=np.int32)  # the last one for OUTSIDE, −1
    identity[covered.frame, covered.row * columns + covered.column] = covered.identity
    targets, sources = [], []
    for matrix, following in zip(next_from_this, identity[1:], strict=True):
        sampled = following.take(nearest_indices(matrix, config.grid, config.rules.warp))
        seen = np.flatnonzero(sampled != 0)
        targets.append(seen)
        sources.append(sampled[seen])
    target = np.concatenate(targets)
    warped = CoveredCells(
        frame=np.repeat(np.arange(len(targets)), [len(seen) for seen in targets]),
        row=target // columns,
        column=target % columns,
        identity=np.concatenate(sources),
        frames=covered.frames,
        ids=covered.ids,
    )
    return warped.centers()
