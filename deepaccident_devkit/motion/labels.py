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
from deepaccident_devkit.support.text import Pictured


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionLabels(FrozenArrays, Pictured):
    """Labels of T = `config.label_frames` frames on H × W cells in `config.grid.orientation`.

    Arrays are read-only. The five maps share one block of memory, which stays as long as any of
    them is used. To keep some maps of many samples, copy them.

    Attributes:
        config: Configuration of the labels.
        segmentation: 1 where an actor is, 0 elsewhere, shape (T, H, W), uint8.
        instance: Ids from 1 in the order of rasterising, 0 elsewhere, shape (T, H, W), int32.
            Missing frames that a protocol ignores are all `ignore_index`, which can also be an id:
            `label_valid` has the missing frames.
        centerness: Closeness to an instance's centre, shape (T, 1, H, W), float32 in [0, 1].
        offset: Rows and columns from a cell to its instance's centre, shape (T, 2, H, W), float32,
            cells; `ignore_index` elsewhere.
        flow: Rows and columns from an instance's centre to its position at the next frame, in this
            frame's ego frame, shape (T, 2, H, W), float32, cells; `ignore_index` elsewhere, and in
            all of the last frame.
        future_egomotion: `next_from_this` ego poses as right-handed 6-vectors, shape (R, 6),
            float32, R = `config.frames`, from the first past frame on; zero where either frame is
            not in the recording.
        valid: Whether each frame, from the first past one on, is in the recording, shape (R,),
            bool.
        id_map: Actor id → id in `instance`; the ego's own box is −101, and untracked actors that
            are an instance each are not in it.
        at_present: Whether all frames were warped to the present ego frame; if not, each is in its
            own.
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
        """Freeze arrays and map; small arrays are copied, since callers may change their own."""
        for name in ("future_egomotion", "valid"):
            object.__setattr__(self, name, np.array(getattr(self, name)))
        FrozenArrays.__post_init__(self)
        object.__setattr__(self, "id_map", MappingProxyType(dict(self.id_map)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return a form with a plain dictionary, since its read-only view cannot be pickled."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values["id_map"] = dict(self.id_map)
        return partial(MotionLabels, **values), ()

    def __repr__(self) -> str:
        """Return frames, cells, actors, protocol and coordinate frame."""
        protocol = self.config.protocol if isinstance(self.config.protocol, str) else "own protocol"
        ego_frame = "all at the present" if self.at_present else "each frame in its own ego frame"
        return (
            f"MotionLabels({len(self.segmentation)} frames of {self.config.grid.text}, "
            f"{len(self.id_map)} actors in id_map, {protocol}, {ego_frame})"
        )

    @property
    def label_valid(self) -> BoolArray:
        """Whether each label frame, from the present on, is in the recording, shape (T,), bool."""
        return self.valid[self.config.receptive_field - 1 :]

    @property
    def label_egomotion(self) -> FloatArray:
        """Egomotion from the present on, shape (T, 6), float32."""
        return self.future_egomotion[self.config.receptive_field - 1 :]

    def to_present(self, centerness: WarpMode = "nearest") -> MotionLabels:
        """Return the labels with every frame in the present ego frame.

        Training and evaluation use them. `maps_to_present` describes the warp. Labels that are not
        warped equal the released code's in every cell; warped labels can differ in single cells, at
        ties of the sampling (docs/training.md, "How equal they are").

        Args:
            centerness: How to sample the centres' peaks: the released code trains with `nearest`
                and evaluates with `bilinear`. All other maps have the nearest cell's value.

        Raises:
            NotAvailableError: The labels are already at the present.
            ChoiceError: No such mode.
        """
        if self.at_present:
            raise NotAvailableError(
                "labels: they are in the present frame already; warp the labels of `motion_labels`"
            )
        maps = {name: getattr(self, name) for name in MAPS}
        warped: dict[str, Any] = maps_to_present(
            maps, self.label_egomotion, ~self.label_valid, self.config, centerness
        )
        return replace(self, **warped, at_present=True)

    @property
    def instance_center(self) -> AnyArray:
        """`centerness`, under the name of the models' output."""
        return self.centerness

    @property
    def instance_offset(self) -> AnyArray:
        """`offset`, under the name of the models' output."""
        return self.offset

    @property
    def instance_flow(self) -> AnyArray:
        """`flow`, under the name of the models' output."""
        return self.flow

    def as_batch(self, names: BatchNames) -> dict[str, AnyArray]:
        """Return the labels as a sample of FIERY's, BEVerse's or DeepAccident's own loader.

        Names, axes, orientation and types are that loader's; `motion.batch_names` has the table.
        All arrays are new and writable. Raises ChoiceError.
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
        """Return labels from a sample of another code's loader, the reverse of `as_batch`.

        The actors of the ids are unknown.

        Args:
            batch: Arrays or tensors of one sample, without a batch axis.
            config: Configuration of the batch, or the name of a preset; its orientation is that of
                the result.
            names: Code with the names of the batch.
            at_present: Whether the maps were warped to the present.

        Raises:
            ChoiceError: No such code.
            FieldError: The batch lacks an array.
            GeometryError: An array has another shape than in the configuration.
        """
        label_config = resolved_label_config(config)
        arrays: dict[str, Any] = from_batch(batch, label_config, names)
        return cls(config=label_config, id_map={}, at_present=at_present, **arrays)


def maps_to_present(
    maps: Mapping[str, AnyArray],
    label_egomotion: AnyArray,
    missing: BoolArray,
    config: MotionLabelConfig,
    centerness: WarpMode,
) -> dict[str, AnyArray]:
    """Return the maps of `MotionLabels` with every frame warped to the present ego frame.

    The present itself does not change. Segmentation, instance, offset and flow have the nearest
    cell's values. The protocol decides the sampling rule (`warp`), the value of cells from outside
    the grid (`outside_is_zero`) and whether offset and flow turn with the frame
    (`vectors_not_rotated`). An augmentation of the configuration counts on both sides: A C A⁻¹
    (docs/released_code.md, Warps).

    Args:
        maps: Maps by name, T frames each.
        label_egomotion: Egomotion from the present on, shape (T, 6).
        missing: Whether each frame is not in the recording, shape (T,). A missing frame that is all
            `ignore_index` is not warped.
        config: Configuration of the labels.
        centerness: How to sample the centres' peaks.
    """
    centerness = checked_mode(centerness)
    rules = config.rules
    transforms = present_from_frames(label_egomotion, rules, config.augmentation)
    ignored = np.zeros_like(missing) if rules.missing_frames_are_empty else missing
    warped = _empty_like(maps)
    for name, raster in maps.items():
        warped[name][:1] = raster[:1]
        warped[name][ignored] = config.ignore_index
    frames = np.flatnonzero(~ignored[1:]) + 1
    lines = sampling_lines(sampling_matrix(transforms[frames], rules), config.grid, rules)
    for number, frame in enumerate(frames.tolist()):
        points = (lines[0].points(number), lines[1].points(number))
        indices = rounded_points(points, config.grid, rules, config.grid.orientation)
        source = {name: array[frame] for name, array in maps.items()}
        target = {name: array[frame] for name, array in warped.items()}
        turn = None if rules.vectors_not_rotated else _vector_turn(transforms[frame], config)
        _warp_instances(source, target, indices, turn, config)
        if centerness == "nearest":
            flat_source = source["centerness"].reshape(-1)
            target["centerness"].reshape(-1)[:] = take_cells(flat_source, indices)
        else:
            native_source = config.grid.reorient(source["centerness"], rules.native)
            native_target = config.grid.reorient(target["centerness"], rules.native)
            native_target[...] = blend_cells(native_source, points)
    return warped


def _empty_like(maps: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Return arrays of these shapes in one block, which the allocator keeps for the next sample.

    Separate arrays would be returned to the system each time, and page faults would cost more than
    the warps.
    """
    block = np.empty(sum(raster.nbytes for raster in maps.values()), dtype=np.uint8)
    result = {}
    start = 0
    # In reverse order the bytes of the segmentation are last, so that all arrays are aligned.
    for name, raster in reversed(list(maps.items())):
        end = start + raster.nbytes
        result[name] = block[start:end].view(raster.dtype).reshape(raster.shape)
        start = end
    return result


def _warp_instances(
    source: dict[str, AnyArray],
    target: dict[str, AnyArray],
    indices: CellIndices,
    turn: FloatArray | None,
    config: MotionLabelConfig,
) -> None:
    """Fill one frame's instance, segmentation, offset and flow.

    The last three differ from the background on few cells: outside instances segmentation is 0,
    offset and flow are `ignore_index` (see `MotionLabels`), so that only the cells of instances are
    read.

    Args:
        source: Maps of the frame.
        target: Maps to fill.
        indices: Source cell of each target cell, shape (H · W,).
        turn: Matrix that turns known offsets and flows, shape (2, 2); None for no turn.
        config: Configuration of the labels.
    """
    target["instance"].reshape(-1)[:] = take_cells(source["instance"].reshape(-1), indices)
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


def _vector_turn(present_from_frame: AnyArray, config: MotionLabelConfig) -> FloatArray:
    """Return the matrix by which offset and flow (rows, columns) turn in a warp, shape (2, 2).

    The warp is from a frame to the present.
    """
    transform = present_from_frame if config.rules.right_handed else flip_pose(present_from_frame)
    metres_from_cells = _metres_from_cells(config.grid)
    return np.asarray(np.linalg.inv(metres_from_cells) @ transform[:2, :2] @ metres_from_cells)


def _metres_from_cells(grid: BevGrid) -> FloatArray:
    """Return the matrix from steps of rows and columns to right-handed metres, shape (2, 2)."""
    x = grid.x[2]
    y = grid.y[2]
    if grid.orientation == "fiery":
        return np.diag([x, y])
    return np.array([[0, x], [y if grid.orientation == "devkit" else -y, 0]])
