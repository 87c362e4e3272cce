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

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results.header import ContentError, MotionForm, at
from deepaccident_devkit.motion import predict_instances
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.reading import DAMAGED_ARCHIVE, array_of, read_member

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


def take_array(archive: zipfile.ZipFile, token: str, name: str, shape: Sequence[int], kinds: str) -> AnyArray:
    """An array of an archive.

    Args:
        archive: open.
        token: of the sample.
        name: of the array.
        shape: its shape, of which the first axis may be shorter; what is larger is not decompressed.
        kinds: numpy's letters of the kinds of element types that it may have.

    Raises:
        ContentError: begins with the array's name and says what is wrong with it.
    """
    with at(name):
        try:
            entry = archive.getinfo(member_name(token, name))
        except KeyError:
            raise ContentError(f"is missing; expected the member {member_name(token, name)}") from None
        expected = f"expected shape (1 to {shape[0]}, {', '.join(map(str, shape[1:]))})"
        most = math.prod(shape) * _WIDEST + _LONGEST_HEADER
        if entry.file_size > most:
            raise ContentError(f"{expected}, which has at most {most:,} bytes, found {entry.file_size:,} bytes")
        try:
            content = read_member(archive, entry, "results")
            array = array_of(content, "results")
        except DAMAGED_ARCHIVE as error:
            raise ContentError(f"cannot be read ({error}); the file is damaged, copy it again") from error
        if not content.startswith(_NPY):
            raise ContentError("expected npy format 1.0, as numpy.save writes numbers")
        if array.dtype.kind not in kinds:
            raise ContentError(f"expected {' or '.join(_KINDS[kind] for kind in kinds)}, found {array.dtype}")
        if array.ndim != len(shape) or not 1 <= len(array) <= shape[0] or array.shape[1:] != tuple(shape[1:]):
            raise ContentError(f"{expected}, found {array.shape}")
        return array


_KINDS: Final = {"u": "unsigned whole numbers", "i": "whole numbers", "f": "floats"}
HEADS: Final[Mapping[str, int]] = {"segmentation": 2, "centerness": 1, "offset": 2, "flow": 2}
"""Map → its channels."""
NOT_READ: Final = ("trajectory_id", "trajectory")
"""Arrays that earlier files have beside their maps, which say the same."""
_HIGHEST_ID: Final = 2**31 - 1


def head_arrays(output: MotionOutput) -> dict[str, AnyArray]:
    """The heads of a prediction, each (K, T, channels, H, W) float32."""
    heads = output.heads or ()
    return {name: np.stack([getattr(each, name) for each in heads]) for name in HEADS}


def instance_arrays(output: MotionOutput) -> dict[str, AnyArray]:
    """The instance maps of a prediction; heads are post-processed for them."""
    maps = output.instances
    if maps is None:
        maps = np.stack([predict_instances(each, "motion").instance for each in output.heads or ()])
    highest = int(maps.max(initial=0))
    dtype = np.uint8 if highest < 2**8 else np.uint16 if highest < 2**16 else np.int32
    return {"instance": maps.astype(dtype)}


def members(form: MotionForm) -> tuple[str, ...]:
    """The arrays that each sample has."""
    return tuple(HEADS) if form.stored == "heads" else ("instance",)


def stored_output(archive: zipfile.ZipFile, token: str, form: MotionForm) -> MotionOutput:
    """The prediction of a sample; raises ContentError that begins with the array's name."""
    if form.stored == "instances":
        maps = take_array(archive, token, "instance", (form.predictions, form.frames, *form.grid.shape), "ui")
        if maps.min() < 0 or maps.max() > _HIGHEST_ID:
            raise ContentError(f"instance: expected ids from 0 to {_HIGHEST_ID}, found {maps.min()} to {maps.max()}")
        return MotionOutput(grid=form.grid, instances=maps.astype(np.int32))
    segmentation, centerness, offset, flow = (
        take_array(archive, token, name, (form.predictions, form.frames, channels, *form.grid.shape), "f")
        for name, channels in HEADS.items()
    )
    try:
        return MotionOutput.from_arrays(segmentation, centerness, offset, flow, grid=form.grid)
    except GeometryError as error:
        raise ContentError(str(error)) from error
