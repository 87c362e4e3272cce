"""A motion prediction as the arrays that a shard holds, and back."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from typing import Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, FloatArray
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.evaluation.results.arrays_in_shards import member_name, take_array
from deepaccident_devkit.evaluation.results.faults import ContentError
from deepaccident_devkit.evaluation.results.form import MotionForm
from deepaccident_devkit.evaluation.results.paths import linked_paths, map_paths
from deepaccident_devkit.motion import predict_instances

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
    """Whether all arrays of a sample are as they should be; raises ContentError that begins with the array's name."""
    output, paths = stored_output(archive, token, form), stored_paths(archive, token, form)
    if output.instances is not None and paths:
        others = sorted(paths.keys() - set(np.unique(output.instances[-1]).tolist()))
        if others:
            raise ContentError(f"trajectory_id: the last prediction's instance maps have no id {others[0]}")
