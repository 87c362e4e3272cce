"""`MotionLabels`: the maps that a motion model learns, as one record."""

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
    """Labels of T = `config.label_frames` frames on H × W cells in `config.grid.orientation`; arrays are read-only.

    The five maps share one block of memory, which stays as long as any of them is used. To keep some maps of many
    samples, copy them.

    Attributes:
        config: how they were made.
        segmentation: (T, H, W) uint8: 1 where an actor is, 0 elsewhere.
        instance: (T, H, W) int32: ids from 1 in the order rasterised, 0 elsewhere. Missing frames that a protocol
            ignores are all `ignore_index`, which can also be an id: `label_valid` says which frames are missing.
        centerness: (T, 1, H, W) float32 in [0, 1].
        offset: (T, 2, H, W) float32, cells (down the rows, along the columns) from a cell to its instance's centre;
            `ignore_index` elsewhere.
        flow: (T, 2, H, W) float32, cells (rows, columns) from an instance's centre to where it is at the next frame,
            seen from this frame's ego; `ignore_index` elsewhere, and all of the last frame.
        future_egomotion: (R, 6) float32, R = `config.frames`: `next_from_this` ego poses as right-handed 6-vectors,
            from the first past frame on; zero where either frame is not in the recording.
        valid: (R,) bool: which frames, from the first past one on, are in the recording.
        id_map: actor id → id in `instance`; the ego's own box is −101, and untracked actors that are each their own
            instance are not in it.
        at_present: whether all frames were warped to the present ego frame; if not, each is in its own.
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
        """Freeze arrays and map; the small arrays are copied, since callers may change theirs."""
        for name in ("future_egomotion", "valid"):
            object.__setattr__(self, name, np.array(getattr(self, name)))
        FrozenArrays.__post_init__(self)
        object.__setattr__(self, "id_map", MappingProxyType(dict(self.id_map)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a dict in place of its view, which cannot be pickled."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return partial(MotionLabels, **(values | {"id_map": dict(self.id_map)})), ()

    def __repr__(self) -> str:
        """Frames, cells, actors, protocol and coordinate frame."""
        protocol = self.config.protocol if isinstance(self.config.protocol, str) else "own protocol"
        where = "all at the present" if self.at_present else "each frame in its own ego frame"
        return (
            f"MotionLabels({len(self.segmentation)} frames of {self.config.grid.text}, {len(self.id_map)} actors in "
            f"id_map, {protocol}, {where})"
        )

    @property
    def label_valid(self) -> BoolArray:
        """(T,) bool: which label frames, from the present on, are in the recording."""
        return self.valid[self.config.receptive_field - 1 :]

    @property
    def label_egomotion(self) -> FloatArray:
        """(T, 6) float32: the egomotion from the present on."""
        return self.future_egomotion[self.config.receptive_field - 1 :]

    def to_present(self, centerness: WarpMode = "nearest") -> MotionLabels:
        """The labels with every frame in the present ego frame, as in training and evaluation.

        `maps_to_present` says how. Labels that are not warped equal the released code's in every cell; warped
        ones can differ in single cells, at ties of the sampling (docs/training.md, "How equal they are").

        Args:
            centerness: how to sample the centres' peaks: the released code trains with `nearest` and evaluates with
                `bilinear`. All other maps take the nearest cell's value.

        Raises:
            NotAvailableError: the labels are at the present already.
            ChoiceError: no such mode.
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
        """The labels as a sample of FIERY's, BEVerse's or DeepAccident's own loader: names, axes, orientation, types.

        `motion.batch_names` has the table; all arrays are new and writable. Raises ChoiceError.
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
        """Labels from a sample of another code's loader, the reverse of `as_batch`; the ids' actors are not known.

        Args:
            batch: arrays or tensors of one sample, without a batch axis.
            config: what they were made with, or the name of a preset; its orientation is that of the result.
            names: the code whose names they have.
            at_present: whether they were warped to the present.

        Raises:
            ChoiceError: no such code.
            FieldError: the batch lacks an array.
            GeometryError: an array has another shape than the configuration says.
        """
        chosen = resolved_label_config(config)
        arrays: dict[str, Any] = from_batch(batch, chosen, names)
        return cls(config=chosen, id_map={}, at_present=at_present, **arrays)


def maps_to_present(
    maps: Mapping[str, AnyArray],
    label_egomotion: AnyArray,
    missing: BoolArray,
    config: MotionLabelConfig,
    centerness: WarpMode,
) -> dict[str, AnyArray]:
    """The maps of `MotionLabels` with every frame warped to the present ego frame; the present itself stays as it is.

    Segmentation, instance, offset and flow take the nearest cell's values. The protocol says how (`warp`), what value
    cells from outside the grid have (`outside_is_zero`) and whether offset and flow turn with the frame
    (`vectors_not_rotated`). An augmentation of the configuration counts on both sides: A C A⁻¹ (docs/released_code.md,
    Warps). A missing frame (T,) that is all `ignore_index` is not warped. `label_egomotion` (T, 6) goes from the
    present on.
    """
    centerness = checked_mode(centerness)
    rules = config.rules
    transforms = present_from_frames(label_egomotion, rules, config.augmentation)
    ignored = np.zeros_like(missing) if rules.missing_frames_are_empty else missing
    warped = _empty_like(maps)
    for name, given in maps.items():
        warped[name][:1] = given[:1]
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
            target["centerness"].reshape(-1)[:] = take_cells(
                source["centerness"].reshape(-1), indices
            )
        else:
            native = config.grid.reorient(source["centerness"], rules.native)
            config.grid.reorient(target["centerness"], rules.native)[...] = blend_cells(
                native, points
            )
    return warped


def _empty_like(maps: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Arrays of these shapes in one block, which the allocator keeps for the next sample.

    Separate arrays would be returned to the system each time, and to get their pages again costs more than the warps.
    """
    block = np.empty(sum(given.nbytes for given in maps.values()), dtype=np.uint8)
    result, start = {}, 0
    for name, given in reversed(
        list(maps.items())
    ):  # segmentation's bytes last, so that all are aligned
        end = start + given.nbytes
        result[name] = block[start:end].view(given.dtype).reshape(given.shape)
        start = end
    return result


def _warp_instances(
    source: dict[str, AnyArray],
    target: dict[str, AnyArray],
    indices: CellIndices,
    turn: FloatArray | None,
    config: MotionLabelConfig,
) -> None:
    """Fill one frame's instance, segmentation, offset and flow; the last three differ from the background on few cells.

    Outside instances segmentation is 0, offset and flow are `ignore_index` (see `MotionLabels`), so only the cells of
    instances are fetched. Offset and flow, where they are known, turn by `turn`.
    """
    target["instance"].reshape(-1)[:] = take_cells(source["instance"].reshape(-1), indices)
    on_instance = np.flatnonzero(
        target["instance"] != 0
    )  # seven times as fast on a mask as on integers
    fetched = indices[on_instance]
    background = np.full(indices.size, config.ignore_index, dtype=target["offset"].dtype)
    if config.rules.outside_is_zero:
        background *= indices != OUTSIDE
    for name, beside in (("segmentation", 0), ("offset", background), ("flow", background)):
        cells, filled = (
            source[name].reshape(-1, indices.size),
            target[name].reshape(-1, indices.size),
        )
        filled[...] = beside
        values = cells.take(fetched, axis=1)
        if turn is not None and name != "segmentation":
            known = (values != config.ignore_index).any(axis=0)
            values[:, known] = turn @ values[:, known]
        filled[:, on_instance] = values


def _vector_turn(present_from_frame: AnyArray, config: MotionLabelConfig) -> FloatArray:
    """(2, 2) how offset and flow (rows, columns) of a frame turn when it is warped to the present."""
    transform = present_from_frame if config.rules.right_handed else flip_pose(present_from_frame)
    metres_from_cells = _metres_from_cells(config.grid)
    return np.asarray(np.linalg.inv(metres_from_cells) @ transform[:2, :2] @ metres_from_cells)


def _metres_from_cells(grid: BevGrid) -> FloatArray:
    """(2, 2) steps of a row and of a column → right-handed metres x and y."""
    x, y = grid.x[2], grid.y[2]
    if grid.orientation == "fiery":
        return np.diag([x, y])
    return np.array([[0, x], [y if grid.orientation == "devkit" else -y, 0]])
