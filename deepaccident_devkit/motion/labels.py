"""`MotionLabels`: the maps that a motion model learns from, as one record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.conventions import flip_pose
from deepaccident_devkit.motion.batch_names import MAPS, BatchNames, from_batch, to_batch
from deepaccident_devkit.motion.config import MotionLabelConfig, resolved_label_config
from deepaccident_devkit.motion.reference_arithmetic.single_precision import (
    OUTSIDE,
    CellIndices,
    blend_cells,
    take_cells,
)
from deepaccident_devkit.motion.warping import (
    WarpMode,
    checked_mode,
    present_from_frames,
    rounded_points,
    sampling_lines,
    sampling_matrix,
)
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, FrozenArrays
from deepaccident_devkit.support.text import PictureRepr
from deepaccident_devkit.support.values import NamedValues


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionLabels(FrozenArrays, PictureRepr):
    """Labels of T = `config.label_frames` frames on H × W cells in `config.grid.orientation`.

    Arrays are read-only. The five maps share one block of memory, which is not freed while any of
    them is in use. To keep a few maps of many samples, copy them.

    Attributes:
        config: Configuration of the labels.
        segmentation: 1 where there is an actor, 0 elsewhere, shape (T, H, W), uint8.
        instance: Ids from 1 in the order of rasterising, 0 elsewhere, shape (T, H, W), int32.
            Missing frames that the protocol ignores are filled with `ignore_index`, which can also
            be an id: use `label_valid` to find the missing frames.
        centerness: Closeness to an instance's centre, shape (T, 1, H, W), float32 in [0, 1].
        offset: Rows and columns from a cell to its instance's centre, shape (T, 2, H, W), float32,
            cells; `ignore_index` elsewhere.
        flow: Rows and columns from an instance's centre to its position at the next frame, in this
            frame's ego frame, shape (T, 2, H, W), float32, cells; `ignore_index` elsewhere, and
            everywhere in the last frame.
        future_egomotion: `next_from_this` ego poses as right-handed 6-vectors, shape (R, 6),
            float32, R = `config.frames`, from the first past frame on; zero where one of the two
            frames is not in the recording.
        valid: Whether each frame, from the first past one on, is in the recording, shape (R,),
            bool.
        id_map: Actor id → id in `instance`. The ego's own box has the key −101; untracked rows that
            are separate instances are not included.
        at_present: Whether all frames were warped to the present ego frame; if not, each frame is
            in its own ego frame.
    """

    config: MotionLabelConfig
    segmentation: AnyArray
    instance: AnyArray
    centerness: AnyArray
    offset: AnyArray
    flow: AnyArray
    future_egomotion: AnyArray
    valid: BoolArray
    id_map: Mapping[int, int]
    at_present: bool = False

    def __post_init__(self) -> None:
        """Freeze arrays and map; copy small arrays, since callers may change the originals."""
        for name in ("future_egomotion", "valid"):
            object.__setattr__(self, name, np.array(getattr(self, name)))
        FrozenArrays.__post_init__(self)
        object.__setattr__(self, "id_map", MappingProxyType(dict(self.id_map)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle with a plain dictionary, since its read-only view cannot be pickled."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values["id_map"] = dict(self.id_map)
        return partial(MotionLabels, **values), ()

    def __repr__(self) -> str:
        """Return frames, cells, actors, protocol and coordinate frame."""
        protocol = self.config.protocol
        if not isinstance(protocol, str):
            protocol = "own protocol"
        ego_frame = "each frame in its own ego frame"
        if self.at_present:
            ego_frame = "all at the present"
        return (
            f"MotionLabels({len(self.segmentation)} frames of {self.config.grid.text}, "
            f"{len(self.id_map)} actors in id_map, {protocol}, {ego_frame})"
        )

    @property
    def label_valid(self) -> BoolArray:
        """Whether each label frame, from the present on, is in the recording, shape (T,), bool."""
        present = self.config.receptive_field - 1
        return self.valid[present:]

    @property
    def label_egomotion(self) -> FloatArray:
        """Egomotion from the present on, shape (T, 6), float32."""
        present = self.config.receptive_field - 1
        return self.future_egomotion[present:]

    def to_present(self, centerness: WarpMode = "nearest") -> MotionLabels:
        """Return the labels with every frame in the present ego frame.

        Training and evaluation use labels in this frame. `maps_to_present` describes the warp.
        Labels that are not warped equal the released code's in every cell; warped labels can differ
        in single cells where sampling is a tie (docs/training.md, "How equal they are").

        Args:
            centerness: How centerness is sampled: the released code trains with `nearest` and
                evaluates with `bilinear`. All other maps take the nearest cell's value.

        Raises:
            NotAvailableError: The labels are already in the present ego frame.
            ChoiceError: There is no such mode.
        """
        if self.at_present:
            raise NotAvailableError(
                "labels: these labels are already in the present frame; warp the "
                "labels that `motion_labels` returns"
            )
        maps = {name: getattr(self, name) for name in MAPS}
        missing = ~self.label_valid
        warped: NamedValues = maps_to_present(
            maps, self.label_egomotion, missing, self.config, centerness
        )
        return replace(self, **warped, at_present=True)

    @property
    def instance_center(self) -> AnyArray:
        """`centerness` under the name of the models' output."""
        return self.centerness

    @property
    def instance_offset(self) -> AnyArray:
        """`offset` under the name of the models' output."""
        return self.offset

    @property
    def instance_flow(self) -> AnyArray:
        """`flow` under the name of the models' output."""
        return self.flow

    def as_batch(self, names: BatchNames) -> dict[str, AnyArray]:
        """Return the labels as FIERY's, BEVerse's or DeepAccident's loader would return the sample.

        Names, axes, orientation and types are that loader's; `motion.batch_names` lists them. All
        arrays are new and writable. Raise ChoiceError if there is no such code base.
        """
        arrays = {name: getattr(self, name) for name in (*MAPS, "future_egomotion", "valid")}
        return to_batch(arrays, self.config, names)

    @classmethod
    def from_batch(
        cls,
        batch: Mapping[str, Any],
        config: MotionLabelConfig | str,
        names: BatchNames,
        *,
        at_present: bool = False,
    ) -> MotionLabels:
        """Convert a sample from another code base's loader to labels; the inverse of `as_batch`.

        Which actor each instance id belongs to is unknown.

        Args:
            batch: Arrays or tensors of one sample, without a batch axis.
            config: Configuration of the batch, or the name of a preset; it sets the orientation of
                the result.
            names: Name of the code base whose key names the batch uses.
            at_present: Whether the maps were warped to the present.

        Raises:
            ChoiceError: There is no such code base.
            FieldError: The batch lacks an array.
            GeometryError: An array's shape does not match the configuration.
        """
        label_config = resolved_label_config(config)
        arrays: NamedValues = from_batch(batch, label_config, names)
        return cls(config=label_config, id_map={}, at_present=at_present, **arrays)


def maps_to_present(
    maps: Mapping[str, AnyArray],
    label_egomotion: AnyArray,
    missing: BoolArray,
    config: MotionLabelConfig,
    centerness: WarpMode,
) -> dict[str, AnyArray]:
    """Return the maps of `MotionLabels` with every frame warped to the present ego frame.

    The present frame itself is not changed. Segmentation, instance, offset and flow take the
    nearest cell's values. The protocol decides the sampling rule (`warp`), the value of cells from
    outside the grid (`outside_is_zero`) and whether offset and flow turn with the frame
    (`vectors_not_rotated`). The configuration's augmentation A is applied on both sides, A C A⁻¹
    (docs/released_code.md, Warps).

    Args:
        maps: Maps by name, T frames each.
        label_egomotion: Egomotion from the present on, shape (T, 6).
        missing: Whether each frame lies outside the recording, shape (T,). A missing frame that is
            filled with `ignore_index` is not warped.
        config: Configuration of the labels.
        centerness: How centerness is sampled.
    """
    centerness = checked_mode(centerness)
    rules = config.rules
    transforms = present_from_frames(label_egomotion, rules, config.augmentation)
    ignored = missing
    if rules.missing_frames_are_empty:
        ignored = np.zeros_like(missing)
    warped = _allocate_like(maps)
    for name, raster in maps.items():
        warped[name][:1] = raster[:1]
        warped[name][ignored] = config.ignore_index
    frames = np.flatnonzero(~ignored[1:]) + 1
    grid = config.grid
    matrices = sampling_matrix(transforms[frames], rules)
    row_line, column_line = sampling_lines(matrices, grid, rules)
    for number, frame in enumerate(frames.tolist()):
        points = (row_line.points(number), column_line.points(number))
        indices = rounded_points(points, grid, rules, grid.orientation)
        source = {name: array[frame] for name, array in maps.items()}
        target = {name: array[frame] for name, array in warped.items()}
        turn = None
        if not rules.vectors_not_rotated:
            turn = _compute_vector_turn(transforms[frame], config)
        _warp_instances(source, target, indices, turn, config)
        if centerness == "nearest":
            flat_source = source["centerness"].reshape(-1)
            target["centerness"].reshape(-1)[:] = take_cells(flat_source, indices)
        else:
            native_source = grid.reorient(source["centerness"], rules.native)
            native_target = grid.reorient(target["centerness"], rules.native)
            native_target[...] = blend_cells(native_source, points)
    return warped


def _allocate_like(maps: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return empty arrays with the maps' shapes and types, in one block of memory.

    The allocator reuses the block for the next sample.

    Separate arrays would be returned to the system each time, and page faults would cost more than
    the warps.
    """
    num_bytes = sum(raster.nbytes for raster in maps.values())
    block = np.empty(num_bytes, dtype=np.uint8)
    result = {}
    start = 0
    # In reverse order, the bytes of the segmentation come last, so that all arrays are aligned.
    for name, raster in reversed(list(maps.items())):
        end = start + raster.nbytes
        values = block[start:end].view(raster.dtype)
        result[name] = values.reshape(raster.shape)
        start = end
    return result


def _warp_instances(
    source: dict[str, AnyArray],
    target: dict[str, AnyArray],
    indices: CellIndices,
    turn: FloatArray | None,
    config: MotionLabelConfig,
) -> None:
    """Fill one frame's instance, segmentation, offset and flow maps.

    For the last three maps, only the cells of instances are read: outside instances, segmentation
    is 0, and offset and flow are `ignore_index` (see `MotionLabels`).

    Args:
        source: Maps of the frame.
        target: Maps to fill.
        indices: Source cell of each target cell, shape (H · W,).
        turn: Matrix that rotates defined offsets and flows, shape (2, 2); None for no rotation.
        config: Configuration of the labels.
    """
    flat_instance = source["instance"].reshape(-1)
    target["instance"].reshape(-1)[:] = take_cells(flat_instance, indices)
    # A mask is seven times as fast as integers.
    target_cells = np.flatnonzero(target["instance"] != 0)
    source_cells = indices[target_cells]
    background = np.full(indices.size, config.ignore_index, dtype=target["offset"].dtype)
    if config.rules.outside_is_zero:
        background *= indices != OUTSIDE
    fills = (("segmentation", 0), ("offset", background), ("flow", background))
    for name, fill in fills:
        flat_source = source[name].reshape(-1, indices.size)
        flat_target = target[name].reshape(-1, indices.size)
        flat_target[...] = fill
        values = flat_source.take(source_cells, axis=1)
        if turn is not None and name != "segmentation":
            known = (values != config.ignore_index).any(axis=0)
            values[:, known] = turn @ values[:, known]
        flat_target[:, target_cells] = values


def _compute_vector_turn(present_from_frame: AnyArray, config: MotionLabelConfig) -> FloatArray:
    """Return the matrix by which a warp rotates offset and flow (rows, columns), shape (2, 2).

    `present_from_frame` is the warp's transform.
    """
    transform = present_from_frame
    if not config.rules.right_handed:
        transform = flip_pose(transform)
    metres_from_cells = _make_metres_matrix(config.grid)
    cells_from_metres = np.linalg.inv(metres_from_cells)
    rotation = transform[:2, :2]
    return np.asarray(cells_from_metres @ rotation @ metres_from_cells)


def _make_metres_matrix(grid: BevGrid) -> FloatArray:
    """Return the matrix from steps of rows and columns to right-handed metres, shape (2, 2)."""
    _, _, x = grid.x
    _, _, y = grid.y
    if grid.orientation == "fiery":
        return np.diag([x, y])
    if grid.orientation == "released":
        y = -y
    return np.array([[0, x], [y, 0]])
