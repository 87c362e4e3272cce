"""Motion labels from boxes: which cells an actor takes, under which id, and where it is at the next frame.

Every frame is rasterised in its own ego frame (docs/released_code.md, Motion labels); `MotionLabels.to_present` warps
the maps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.exact.polygon_fill import topmost
from deepaccident_devkit.geometry.bev_grid import Axis, axes_of
from deepaccident_devkit.motion.config import MotionLabelConfig, label_config
from deepaccident_devkit.motion.drawing.box_polygons import FrameBoxes, FramePolygons, box_polygons
from deepaccident_devkit.motion.drawing.label_maps import CoveredCells, label_maps
from deepaccident_devkit.motion.drawing.next_centers import Footprints, following_centers
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.protocols import LabelProtocol
from deepaccident_devkit.motion.settings import count
from deepaccident_devkit.motion.warps.chains import frames_from_next
from deepaccident_devkit.motion.warps.warping import sampling_matrix
from deepaccident_devkit.support.arrays import AnyArray, IntArray, checked, checked_whole
from deepaccident_devkit.taxonomy import UNTRACKED_ID

_FAR: Final = 2**24
"""In cells: corners farther away are moved to this distance, which is far outside the grid."""
_MOST_IDS: Final = 2**24
"""The largest id: float32 holds all whole numbers up to here."""


def motion_labels_from_boxes(
    frames: Sequence[FrameBoxes | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig | str | None = None,
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
            as `v2x.future_egomotion` gives them; converted to float32.
        config: what labels show, or the name of a preset; None for the released ones in the devkit's orientation.
        valid: (R,) bool, which frames are in the recording; if None, all except those that are None in `frames`.
        is_vehicle: whether the agent is a vehicle, with a box of its own (the infrastructure has none).
        id_map: actor id → its id in an earlier sample. The released code keeps ids while a worker reads samples of one
            scenario and agent. With None ids start at 1.

    Raises:
        GeometryError: another number of frames or rows, or a motion that is not finite.
        ConfigError: a wrong id, or any id where the protocol does not keep ids between samples.
        ChoiceError: no such preset.
    """
    chosen = label_config(config)
    polygons = box_polygons(frames, chosen, is_vehicle=is_vehicle)
    return labels_from_polygons(polygons, egomotion, chosen, valid=valid, id_map=id_map)


def labels_from_polygons(
    polygons: Sequence[FramePolygons | None],
    egomotion: ArrayLike,
    config: MotionLabelConfig | str | None = None,
    *,
    valid: ArrayLike | None = None,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """The motion labels of footprints, each frame in its own ego frame; see `motion_labels_from_boxes`."""
    config = label_config(config)
    if len(polygons) != config.label_frames:
        raise GeometryError(
            f"frames: expected {config.label_frames}, the present and {config.future_frames} after it, "
            f"found {len(polygons)}; give None for frames beyond the recording"
        )
    motion = checked("egomotion", egomotion, (config.frames, 6), np.float32)
    if not np.isfinite(motion).all():
        raise GeometryError("egomotion: not all numbers are finite; set rows without a motion to zero")
    past = config.receptive_field - 1
    there = np.array([True] * past + [frame is not None for frame in polygons])
    known = there if valid is None else there & checked("valid", valid, (config.frames,), np.bool_)
    ids, continued = _numbered(polygons, config, _checked_ids(id_map, config))
    footprints = _footprints(polygons, ids, config)
    covered = _covered(footprints, config)
    centers = covered.centers()
    this_from_next = frames_from_next(motion[past:-1], config.rules, config.augmentation)
    following = following_centers(footprints, sampling_matrix(this_from_next, config.rules), config, covered.ids)
    following[np.isnan(centers)] = np.nan
    maps = label_maps(covered, centers, following, ~known[past:], config)
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


def _checked_ids(id_map: Mapping[int, int] | None, config: MotionLabelConfig) -> dict[int, int]:
    """A copy of the map to continue, or ConfigError."""
    if id_map is None:
        return {}
    if not config.rules.ids_kept_between_samples:
        raise ConfigError(
            "id_map: ids of this protocol count from 1 in every sample; leave it out, or choose a protocol with "
            "ids_kept_between_samples=True"
        )
    if not isinstance(id_map, Mapping):
        raise ConfigError(f"id_map: expected a mapping of actor ids to ids, found {id_map!r}")
    return {
        checked_whole("id_map", actor, "actor ids", ConfigError): count("id_map", given, "an id of labels", _MOST_IDS)
        for actor, given in id_map.items()
    }


def _numbered(
    polygons: Sequence[FramePolygons | None], config: MotionLabelConfig, id_map: dict[int, int]
) -> tuple[IntArray, dict[int, int]]:
    """The id of each polygon of all frames, and the extended map; ids count from 1 in the order of rasterising."""
    highest, ids = max(id_map.values(), default=0), []
    nobody = None if config.rules.untracked_share_an_id else UNTRACKED_ID
    for key in (key for frame in polygons if frame is not None for key in frame.key.tolist()):
        if key == nobody or key not in id_map:
            highest += 1
            if key != nobody:
                id_map[key] = highest
        ids.append(highest if key == nobody else id_map[key])
    return np.array(ids, dtype=np.int64), id_map


def _footprints(polygons: Sequence[FramePolygons | None], ids: IntArray, config: MotionLabelConfig) -> Footprints:
    """The polygons with these ids, rasterised in native orientation; later polygons lie on top."""
    native = config.grid.with_orientation(config.rules.native)
    there = [(number, frame) for number, frame in enumerate(polygons) if frame is not None]
    corners = np.concatenate([np.zeros((0, 4, 2), dtype=np.float32), *(frame.corners for _, frame in there)])
    frame = np.repeat([number for number, _ in there], [len(frame.key) for _, frame in there]).astype(np.int64)
    vertices = _raster_corners(corners, config)
    return Footprints(vertices, frame, ids, topmost(vertices, native.shape, frame, len(polygons)))


def _covered(footprints: Footprints, config: MotionLabelConfig) -> CoveredCells:
    """The cells of the footprints, in native orientation."""
    rows, columns = config.grid.with_orientation(config.rules.native).shape
    cells = np.flatnonzero(footprints.top != 0)  # of bools: twice as fast
    owner = footprints.top[cells] - 1
    frame = footprints.frame[owner]
    row = cells // columns  # rows of all frames, one frame after another
    return CoveredCells(
        frame=frame,
        row=row - frame * rows,
        column=cells - row * columns,
        identity=footprints.identity[owner],
        frames=len(footprints.top) // (rows * columns),
        ids=int(footprints.identity.max(initial=0)),
    )


def _raster_corners(corners: AnyArray, config: MotionLabelConfig) -> IntArray:
    """Native column and row (n, 4, 2) at which corners (n, 4, 2), x and y (left), metres, are rasterised."""
    rules = config.rules
    given = corners if rules.pose == "yaw" else corners.astype(np.float32, copy=False)
    native = config.grid.with_orientation(rules.native)
    x, y = given[..., 0], given[..., 1] if rules.right_handed else -given[..., 1]
    columns_and_rows = (y, x) if native.orientation == "fiery" else (x, y)
    axes = reversed(axes_of(native))
    return np.stack([_steps(values, axis, rules) for values, axis in zip(columns_and_rows, axes, strict=True)], axis=-1)


def _steps(values: AnyArray, axis: Axis, rules: LabelProtocol) -> IntArray:
    low, _, size = axis
    if not rules.half_cell_shift:
        cells: AnyArray = np.floor((values.astype(np.float64) - low) / size)
    else:
        first_center, cell = np.float32(low + size / 2), np.float32(size)
        cells = np.rint((values - first_center + cell / np.float32(2)) / cell)
    return np.clip(cells, -_FAR, _FAR).astype(np.int64)
