"""A motion prediction as the arrays that a shard holds, the members `<token>/<name>.npy` of a zip archive, and back.

Arrays are never unpickled, and never larger than expected.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from deepaccident_devkit.archives import DAMAGED_ARCHIVE, array_of, read_member
from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.evaluation.metrics.trajectories import instance_paths
from deepaccident_devkit.evaluation.results.header import ContentError, MotionForm, at
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LinkedInstances, predict_instances, trajectories

Length = int | range
"""Of an axis: how long it must be, or may be."""
_FIRST_DATE: Final = (1980, 1, 1, 0, 0, 0)
_WIDEST: Final = 8
"""Bytes of a number."""
_LONGEST_HEADER: Final = 1 << 16
_NPY: Final = b"\x93NUMPY\x01\x00"
"""How an array's member begins."""


def member_name(token: str, name: str) -> str:
    """The name of a sample's array in the archive."""
    return f"{token}/{name}.npy"


def put_array(archive: zipfile.ZipFile, token: str, name: str, array: AnyArray) -> None:
    """Add an array to an archive; the bytes do not depend on the time."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    entry = zipfile.ZipInfo(member_name(token, name), _FIRST_DATE)
    entry.external_attr = 0o644 << 16
    maps_of_floats = array.dtype.kind == "f" and array.ndim > 3  # noise: deflating takes a second and saves nothing
    way = zipfile.ZIP_STORED if maps_of_floats else zipfile.ZIP_DEFLATED
    archive.writestr(entry, buffer.getvalue(), way, compresslevel=6)


def take_array(archive: zipfile.ZipFile, token: str, name: str, shape: Sequence[Length], kinds: str) -> AnyArray:
    """An array of an archive.

    Args:
        archive: open.
        token: of the sample.
        name: of the array.
        shape: its shape; what is larger is not decompressed.
        kinds: numpy's letters of the kinds of element types that it may have.

    Raises:
        ContentError: begins with the array's name and says what is wrong with it.
    """
    with at(name):
        try:
            entry = archive.getinfo(member_name(token, name))
        except KeyError:
            raise ContentError(f"is missing; expected the member {member_name(token, name)}") from None
        most = math.prod(_range(each)[-1] for each in shape) * _WIDEST + _LONGEST_HEADER
        if entry.file_size > most:
            found = f"{entry.file_size:,} bytes"
            raise ContentError(f"expected shape {_shape_text(shape)}, which has at most {most:,} bytes, found {found}")
        try:
            content = read_member(archive, entry, "results")
            array = array_of(content, "results")
        except DAMAGED_ARCHIVE as error:
            raise ContentError(f"cannot be read ({error}); the file is damaged, copy it again") from error
        if not content.startswith(_NPY):
            raise ContentError("expected npy format 1.0, as numpy.save writes numbers")
        if array.dtype.kind not in kinds:
            raise ContentError(f"expected {' or '.join(_KINDS[kind] for kind in kinds)}, found {array.dtype}")
        if len(array.shape) != len(shape) or any(
            n not in _range(want) for want, n in zip(shape, array.shape, strict=True)
        ):
            raise ContentError(f"expected shape {_shape_text(shape)}, found {array.shape}")
        return array


_KINDS: Final = {"u": "unsigned whole numbers", "i": "whole numbers", "f": "floats"}


def _range(length: Length) -> range:
    return range(length, length + 1) if isinstance(length, int) else length


def _shape_text(shape: Sequence[Length]) -> str:
    texts = [str(each) if isinstance(each, int) else f"{each.start} to {each.stop - 1}" for each in shape]
    return f"({', '.join(texts)})" if len(texts) > 1 else f"({texts[0]},)"


def paths_of(output: MotionOutput, labels: str | None) -> dict[int, FloatArray]:
    """The paths of the instances in the first frame of the last prediction, in the present ego frame.

    Args:
        output: of a sample.
        labels: the label protocol that the model learned from; None if not known (`linked_paths`).

    Returns:
        Id, ascending → (T, 2).
    """
    if output.instances is not None:
        return map_paths(output.instances[-1], output.grid)
    heads = (output.heads or ())[-1]
    return linked_paths(predict_instances(heads, "motion"), output.grid, labels)


def linked_paths(linked: LinkedInstances, grid: BevGrid, labels: str | None) -> dict[int, FloatArray]:
    """Likewise of instances that were read off heads; without a label protocol a cell stands for its middle."""
    frames = len(linked.instance)
    points = trajectories(linked, grid, labels) if labels else trajectories(linked, grid, half_cell_shift=False)
    return {name: _in_frames(path, linked.paths[name].frames, frames) for name, path in points.items()}


def map_paths(instance: AnyArray, grid: BevGrid) -> dict[int, FloatArray]:
    """Likewise of instance maps (T, H, W); points are the means of the cells' centres."""
    present = [np.unique(frame) for frame in instance]
    return {
        name: _in_frames(path, np.flatnonzero([name in ids for ids in present]), len(instance))
        for name, path in instance_paths(instance, grid).items()
    }


def _in_frames(points: FloatArray, frames: AnyArray, count: int) -> FloatArray:
    result = np.full((count, 2), np.nan)
    result[frames] = points
    return result


HEADS: Final[Mapping[str, int]] = {"segmentation": 2, "centerness": 1, "offset": 2, "flow": 2}
"""Map → its channels."""
PATHS: Final = ("trajectory_id", "trajectory")
_HIGHEST_ID: Final = 2**31 - 1


def head_arrays(output: MotionOutput) -> dict[str, AnyArray]:
    """The heads of a prediction, each (K, T, channels, H, W) float32."""
    heads = output.heads or ()
    return {name: np.stack([getattr(each, name) for each in heads]) for name in HEADS}


def instance_arrays(output: MotionOutput, labels: str | None) -> dict[str, AnyArray]:
    """The instance maps of a prediction, and the paths of its last one; heads are post-processed for them.

    Args:
        output: heads, or instance maps, which are stored as they are.
        labels: the label protocol that the model learned from, None if not known.
    """
    if output.instances is not None:
        maps, paths = output.instances, map_paths(output.instances[-1], output.grid)
    else:
        linked = [predict_instances(each, "motion") for each in output.heads or ()]
        maps = np.stack([each.instance for each in linked])
        paths = linked_paths(linked[-1], output.grid, labels)
    highest = int(maps.max(initial=0))
    dtype = np.uint8 if highest < 2**8 else np.uint16 if highest < 2**16 else np.int32
    return {
        "instance": maps.astype(dtype),
        "trajectory_id": np.array(list(paths), dtype=np.int32),
        "trajectory": np.array(list(paths.values()), dtype=np.float32).reshape(len(paths), maps.shape[1], 2),
    }


def members(form: MotionForm) -> tuple[str, ...]:
    """The arrays that each sample has."""
    return tuple(HEADS) if form.stored == "heads" else ("instance",)


def stored_output(archive: zipfile.ZipFile, token: str, form: MotionForm) -> MotionOutput:
    """The prediction of a sample; raises ContentError that begins with the array's name."""
    count = range(1, form.predictions + 1)
    if form.stored == "instances":
        maps = take_array(archive, token, "instance", (count, form.frames, *form.grid.shape), "ui")
        if maps.min() < 0 or maps.max() > _HIGHEST_ID:
            raise ContentError(f"instance: expected ids from 0 to {_HIGHEST_ID}, found {maps.min()} to {maps.max()}")
        return MotionOutput(grid=form.grid, instances=maps.astype(np.int32))
    segmentation, centerness, offset, flow = (
        take_array(archive, token, name, (count, form.frames, channels, *form.grid.shape), "f")
        for name, channels in HEADS.items()
    )
    try:
        return MotionOutput.from_arrays(segmentation, centerness, offset, flow, grid=form.grid)
    except GeometryError as error:
        raise ContentError(str(error)) from error


def stored_paths(archive: zipfile.ZipFile, token: str, form: MotionForm) -> dict[int, FloatArray] | None:
    """The paths of a sample's last prediction, id → (T, 2); None if there are none.

    Raises:
        ContentError: begins with the array's name.
    """
    names = archive.NameToInfo
    if not any(member_name(token, name) in names for name in PATHS):
        return None
    several = range(form.grid.cells + 1)
    ids = take_array(archive, token, "trajectory_id", (several,), "ui")
    points = take_array(archive, token, "trajectory", (len(ids), form.frames, 2), "f")
    if len(ids) and not (ids.min() > 0 and ids.max() <= _HIGHEST_ID):
        raise ContentError(f"trajectory_id: expected ids from 1 to {_HIGHEST_ID}, found {ids.min()} to {ids.max()}")
    if len(np.unique(ids)) != len(ids):
        raise ContentError(f"trajectory_id: expected each id once, found {ids.tolist()}")
    unknown = np.isnan(points)
    wrong = (np.isinf(points) | (unknown != unknown[..., ::-1])).any(axis=(1, 2))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ContentError(
            f"trajectory: of id {ids[row]}: expected x and y in metres, or NaN for both, found {points[row].tolist()}"
        )
    return dict(zip(ids.tolist(), points.astype(np.float64), strict=True))


def check_sample(archive: zipfile.ZipFile, token: str, form: MotionForm) -> None:
    """Check all arrays of a sample; raises ContentError that begins with the array's name."""
    output, paths = stored_output(archive, token, form), stored_paths(archive, token, form)
    if output.instances is not None and paths:
        others = sorted(paths.keys() - set(np.unique(output.instances[-1]).tolist()))
        if others:
            raise ContentError(f"trajectory_id: the last prediction's instance maps have no id {others[0]}")
