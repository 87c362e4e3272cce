"""Names and axes of labels in the codes of FIERY, BEVerse and DeepAccident, and conversions.

| devkit | FIERY's batch | BEVerse's, DeepAccident's batch | models' heads |
|---|---|---|---|
| segmentation (T, H, W) | same (R, 1, H, W) | motion_segmentation (T, H, W) | segmentation |
| instance (T, H, W) | same (R, H, W) | motion_instance (T, H, W) | – |
| centerness (T, 1, H, W) | same (R, 1, H, W) | instance_centerness (T, 1, H, W) | instance_center |
| offset (T, 2, H, W) | same (R, 2, H, W) | instance_offset (T, 2, H, W) | instance_offset |
| flow (T, 2, H, W) | same (R, 2, H, W) | instance_flow (T, 2, H, W) | instance_flow |
| future_egomotion (R, 6) | same (R, 6) | future_egomotions (R, 6) | – |
| valid (R,) | – | img_is_valid (R,), has_invalid_frame | – |

Whole numbers are int64 in these codes, all others float32; one sample has no batch axis. FIERY's
maps start with the past frames, which its trainer cuts off: they are empty here. The orientation of
FIERY's cells is `fiery`, of BEVerse's `devkit`, and of DeepAccident's `released`: it keeps CARLA's
left-handed coordinate frames, also in its egomotion. Sources: fiery/data.py and fiery/trainer.py of
wayveai/fiery; projects/mmdet3d_plugin/datasets of zhangyp15/BEVerse and of
tianqi-wang1996/DeepAccident.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError, FieldError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import Orientation, to_orientation
from deepaccident_devkit.geometry.conventions import flip_six_vector
from deepaccident_devkit.motion.config import MotionLabelConfig
from deepaccident_devkit.support.arrays import AnyArray, checked
from deepaccident_devkit.support.text import choice

BatchNames = Literal["fiery", "beverse", "deepaccident"]
MAPS: Final = ("segmentation", "instance", "centerness", "offset", "flow")
VECTOR_MAPS: Final = ("offset", "flow")
HEAD_NAMES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "segmentation": "segmentation",
        "centerness": "instance_center",
        "offset": "instance_offset",
        "flow": "instance_flow",
    }
)
"""Map of the devkit → output of the models that learns it, in all three codes."""
_BEVERSE: Final = {
    "segmentation": "motion_segmentation",
    "instance": "motion_instance",
    "centerness": "instance_centerness",
    "offset": "instance_offset",
    "flow": "instance_flow",
    "future_egomotion": "future_egomotions",
}
_CONVERTER: Final = {
    "receptive_field": ("receptive_field",),
    "future_frames": ("future_frames",),
    "x": ("grid_conf", "xbound"),
    "y": ("grid_conf", "ybound"),
    "ignore_index": ("ignore_index",),
    "only_vehicle": ("only_vehicle",),
    "filter_invisible": ("filter_invisible",),
}
_SETTINGS: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "fiery": {
        "receptive_field": ("TIME_RECEPTIVE_FIELD",),
        "future_frames": ("N_FUTURE_FRAMES",),
        "x": ("LIFT", "X_BOUND"),
        "y": ("LIFT", "Y_BOUND"),
        "ignore_index": ("DATASET", "IGNORE_INDEX"),
        "filter_invisible": ("DATASET", "FILTER_INVISIBLE_VEHICLES"),
    },
    "beverse": _CONVERTER,
    "deepaccident": _CONVERTER,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Batch:
    """Form of the labels of one code.

    Attributes:
        names: Name in the devkit → name in the code.
        orientation: Orientation of the cells.
        left_handed: Whether the egomotion is left-handed.
        past_frames: Whether the maps start with the past frames.
        validity: Whether the batch has the validity of its frames.
    """

    names: Mapping[str, str]
    orientation: Orientation
    left_handed: bool = False
    past_frames: bool = False
    validity: bool = True


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


def to_batch(
    labels: Mapping[str, AnyArray], config: MotionLabelConfig, names: BatchNames
) -> dict[str, AnyArray]:
    """Return maps, `future_egomotion` and `valid` under a code's names.

    All arrays are new and writable. Raises ChoiceError.
    """
    batch = _batch(names)
    result = {}
    for name in MAPS:
        is_vector = name in VECTOR_MAPS
        values = to_orientation(
            labels[name],
            vectors=is_vector,
            source=config.grid.orientation,
            target=batch.orientation,
            ignore=config.ignore_index,
        )
        if batch.past_frames:
            empty = config.ignore_index if is_vector else 0
            past_shape = (config.receptive_field - 1, *values.shape[1:])
            past = np.full(past_shape, empty, dtype=values.dtype)
            values = np.concatenate([past, values])
            if name == "segmentation":
                values = values[:, None]
        dtype = np.int64 if values.dtype.kind in "iu" else None
        result[batch.names[name]] = np.array(values, dtype=dtype, order="C")
    motion = labels["future_egomotion"]
    if batch.left_handed:
        motion = flip_six_vector(motion)
    result[batch.names["future_egomotion"]] = np.array(motion, dtype=np.float32)
    if batch.validity:
        result["img_is_valid"] = np.array(labels["valid"])
        result["has_invalid_frame"] = np.array(not labels["valid"].all())
    return result


def from_batch(
    batch: Mapping[str, Any], config: MotionLabelConfig, names: BatchNames
) -> dict[str, AnyArray]:
    """Return maps, `future_egomotion` and `valid` from a sample of another code.

    This is the reverse of `to_batch`.

    Args:
        batch: Arrays of any framework, without a batch axis.
        config: Configuration of the labels.
        names: The code.

    Raises:
        FieldError: An array is missing.
        ChoiceError: No such code.
        GeometryError: An array has another shape than in the configuration.
    """
    code = _batch(names)
    missing = sorted(set(code.names.values()) - set(batch))
    if missing:
        raise FieldError(
            f"batch: {names} labels have {missing[0]!r}; there are {', '.join(sorted(batch))}"
        )
    grid_shape = config.grid.with_orientation(code.orientation).shape
    past = config.receptive_field - 1 if code.past_frames else 0
    all_channels = {
        "segmentation": (1,) if code.past_frames else (),
        "instance": (),
        "centerness": (1,),
    }
    dtypes = {"segmentation": np.uint8, "instance": np.int32}
    result = {}
    for name in MAPS:
        batch_name = code.names[name]
        channels = all_channels.get(name, (2,))
        shape = (past + config.label_frames, *channels, *grid_shape)
        dtype = dtypes.get(name, np.float32)
        values = checked(batch_name, batch[batch_name], shape, dtype)[past:]
        if name == "segmentation" and channels:
            values = values[:, 0]
        result[name] = to_orientation(
            values,
            vectors=name in VECTOR_MAPS,
            source=code.orientation,
            target=config.grid.orientation,
            ignore=config.ignore_index,
        )
    batch_name = code.names["future_egomotion"]
    motion = checked(batch_name, batch[batch_name], (config.frames, 6), np.float32)
    if code.left_handed:
        motion = flip_six_vector(motion).astype(np.float32)
    result["future_egomotion"] = motion
    valid = batch["img_is_valid"] if "img_is_valid" in batch else np.ones(config.frames, dtype=bool)
    result["valid"] = checked("img_is_valid", valid, (config.frames,), np.bool_)
    return result


def config_from_names(settings: Mapping[str, Any], names: BatchNames) -> MotionLabelConfig:
    """Return a code's preset with changes from the code's own settings.

    FIERY's settings are its `cfg` as nested dictionaries (TIME_RECEPTIVE_FIELD, N_FUTURE_FRAMES,
    LIFT.X_BOUND, LIFT.Y_BOUND, DATASET.IGNORE_INDEX, DATASET.FILTER_INVISIBLE_VEHICLES). BEVerse's
    and DeepAccident's are `receptive_field`, `future_frames`, and the arguments of
    ConvertMotionLabels: `grid_conf` (xbound, ybound), `ignore_index`, `only_vehicle`,
    `filter_invisible`. Missing settings stay as in the preset; keys that do not concern labels are
    ignored.

    Raises:
        ChoiceError: No such code.
        ConfigError: An impossible value.
    """
    names = choice("names", names, get_args(BatchNames))
    changes: dict[str, Any] = {}
    for name, path in _SETTINGS[names].items():
        value = _setting(settings, path)
        if value is not None:
            changes[name] = value
    preset = MotionLabelConfig.preset(names)
    bounds = {axis: changes.pop(axis) for axis in ("x", "y") if axis in changes}
    if bounds:
        grid = {"x": preset.grid.x, "y": preset.grid.y, **bounds}
        if names == "deepaccident" and "y" in bounds:  # left-handed
            low, high, size = _checked_bound(grid["y"])
            grid["y"] = (-high, -low, size)
        changes["grid"] = BevGrid(grid["x"], grid["y"])
    return MotionLabelConfig.preset(names, **changes)


def _setting(settings: Mapping[str, Any], path: tuple[str, ...]) -> Any:
    """Return a nested setting; None if it is missing."""
    value: Any = settings
    for name in path:
        if not isinstance(value, Mapping) or name not in value:
            return None
        value = value[name]
    return value


def _checked_bound(bound: Any) -> tuple[float, float, float]:
    """Return start, end and cell size in metres, or raise ConfigError."""
    try:
        low, high, size = (float(number) for number in bound)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"ybound: expected start, end and cell size in metres, found {bound!r}"
        ) from error
    return low, high, size


def _batch(names: str) -> _Batch:
    """Return the form of a code's labels; raises ChoiceError."""
    return _BATCHES[choice("names", names, _BATCHES)]
