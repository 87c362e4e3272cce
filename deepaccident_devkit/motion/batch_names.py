"""The names and axes that the codes of FIERY, BEVerse and DeepAccident have for labels.

| ours | FIERY's batch | BEVerse's and DeepAccident's batch | heads of their models |
|---|---|---|---|
| segmentation (T, H, W) | segmentation (R, 1, H, W) | motion_segmentation (T, H, W) | segmentation |
| instance (T, H, W) | instance (R, H, W) | motion_instance (T, H, W) | – |
| centerness (T, 1, H, W) | centerness (R, 1, H, W) | instance_centerness (T, 1, H, W) | instance_center |
| offset (T, 2, H, W) | offset (R, 2, H, W) | instance_offset (T, 2, H, W) | instance_offset |
| flow (T, 2, H, W) | flow (R, 2, H, W) | instance_flow (T, 2, H, W) | instance_flow |
| future_egomotion (R, 6) | future_egomotion (R, 6) | future_egomotions (R, 6) | – |
| valid (R,) | – | img_is_valid (R,), has_invalid_frame | – |

Whole numbers are int64 there, all others float32; one sample has no batch axis. FIERY's maps start with the past
frames, which its trainer cuts off: they are empty here. The orientation of FIERY's cells is `fiery`, of BEVerse's
`devkit`, and of DeepAccident's `released`: it keeps CARLA's left-handed coordinate frames, in its egomotion too.
Sources: fiery/data.py and fiery/trainer.py of wayveai/fiery; projects/mmdet3d_plugin/datasets of zhangyp15/BEVerse and
of tianqi-wang1996/DeepAccident.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from deepaccident_devkit.arrays import AnyArray
from deepaccident_devkit.geometry.bev_grid import Orientation
from deepaccident_devkit.geometry.handedness import flip_six_vector
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.motion.orientations import to_orientation
from deepaccident_devkit.text import choice

BatchNames = Literal["fiery", "beverse", "deepaccident"]
MAPS: Final = ("segmentation", "instance", "centerness", "offset", "flow")
VECTOR_MAPS: Final = ("offset", "flow")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Batch:
    """The labels of one code: our name → its name, and its peculiarities."""

    names: Mapping[str, str]
    orientation: Orientation
    left_handed: bool = False
    past_frames: bool = False
    validity: bool = True


_BEVERSE: Final = {
    "segmentation": "motion_segmentation",
    "instance": "motion_instance",
    "centerness": "instance_centerness",
    "offset": "instance_offset",
    "flow": "instance_flow",
    "future_egomotion": "future_egomotions",
}
_BATCHES: Final[Mapping[str, _Batch]] = {
    "fiery": _Batch(
        names={name: name for name in (*MAPS, "future_egomotion")},
        orientation="fiery",
        past_frames=True,
        validity=False,
    ),
    "beverse": _Batch(names=_BEVERSE, orientation="devkit"),
    "deepaccident": _Batch(names=_BEVERSE, orientation="released", left_handed=True),
}


def to_batch(labels: Mapping[str, AnyArray], config: MotionLabelConfig, names: BatchNames) -> dict[str, AnyArray]:
    """Our maps, `future_egomotion` and `valid` under a code's names, as its sample has them; new, writable arrays.

    Raises:
        ChoiceError: no such code.
    """
    batch = _BATCHES[choice("names", names, _BATCHES)]
    result = {}
    for ours in MAPS:
        values = to_orientation(
            labels[ours],
            vectors=ours in VECTOR_MAPS,
            source=config.grid.orientation,
            target=batch.orientation,
            ignore=config.ignore_index,
        )
        if batch.past_frames:
            empty = config.ignore_index if ours in VECTOR_MAPS else 0
            past = np.full((config.receptive_field - 1, *values.shape[1:]), empty, dtype=values.dtype)
            values = np.concatenate([past, values])
            if ours == "segmentation":
                values = values[:, None]
        result[batch.names[ours]] = np.array(values, dtype=np.int64 if values.dtype.kind in "iu" else None, order="C")
    motion = labels["future_egomotion"]
    result[batch.names["future_egomotion"]] = np.array(
        flip_six_vector(motion) if batch.left_handed else motion, dtype=np.float32
    )
    if batch.validity:
        result["img_is_valid"] = np.array(labels["valid"])
        result["has_invalid_frame"] = np.array(not labels["valid"].all())
    return result
