"""Names and axes of labels in the code bases of FIERY, BEVerse and DeepAccident, and conversions.

| devkit | FIERY's batch | BEVerse's, DeepAccident's batch | models' heads |
|---|---|---|---|
| segmentation (T, H, W) | same (R, 1, H, W) | motion_segmentation (T, H, W) | segmentation |
| instance (T, H, W) | same (R, H, W) | motion_instance (T, H, W) | – |
| centerness (T, 1, H, W) | same (R, 1, H, W) | instance_centerness (T, 1, H, W) | instance_center |
| offset (T, 2, H, W) | same (R, 2, H, W) | instance_offset (T, 2, H, W) | instance_offset |
| flow (T, 2, H, W) | same (R, 2, H, W) | instance_flow (T, 2, H, W) | instance_flow |
| future_egomotion (R, 6) | same (R, 6) | future_egomotions (R, 6) | – |
| valid (R,) | – | img_is_valid (R,), has_invalid_frame | – |

Integers are int64 in these code bases, all other numbers float32; a sample has no batch axis.
FIERY's maps start with the past frames, which its trainer cuts off; here these frames are empty.
Cells have the orientation `fiery` in FIERY, `devkit` in BEVerse, and `released` in DeepAccident,
which keeps CARLA's left-handed coordinate frames, also in its egomotion. Sources: fiery/data.py and
fiery/trainer.py of wayveai/fiery; projects/mmdet3d_plugin/datasets of zhangyp15/BEVerse and of
tianqi-wang1996/DeepAccident.
"""

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
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues

BatchNames = Literal["fiery", "beverse", "deepaccident"]
MAPS: Final = ("segmentation", "instance", "centerness", "offset", "flow")
VECTOR_MAPS: Final = ("offset", "flow")
# Channel axes of the maps, between frame and cell axes; and dtypes of maps that are not float32.
_MAP_CHANNELS = {
    "segmentation": (),
    "instance": (),
    "centerness": (1,),
    "offset": (2,),
    "flow": (2,),
}
_MAP_DTYPES = {"segmentation": np.uint8, "instance": np.int32}
HEAD_NAMES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "segmentation": "segmentation",
        "centerness": "instance_center",
        "offset": "instance_offset",
        "flow": "instance_flow",
    }
)
"""The devkit's map → the model output that learns it, in all three code bases."""
_BEVERSE = {
    "segmentation": "motion_segmentation",
    "instance": "motion_instance",
    "centerness": "instance_centerness",
    "offset": "instance_offset",
    "flow": "instance_flow",
    "future_egomotion": "future_egomotions",
}
# The devkit's setting → path of the setting in the other code bases' arguments.
_CONVERTER_SETTINGS = {
    "receptive_field": ("receptive_field",),
    "future_frames": ("future_frames",),
    "x": ("grid_conf", "xbound"),
    "y": ("grid_conf", "ybound"),
    "ignore_index": ("ignore_index",),
    "only_vehicle": ("only_vehicle",),
    "filter_invisible": ("filter_invisible",),
}
_SETTINGS = {
    "fiery": {
        "receptive_field": ("TIME_RECEPTIVE_FIELD",),
        "future_frames": ("N_FUTURE_FRAMES",),
        "x": ("LIFT", "X_BOUND"),
        "y": ("LIFT", "Y_BOUND"),
        "ignore_index": ("DATASET", "IGNORE_INDEX"),
        "filter_invisible": ("DATASET", "FILTER_INVISIBLE_VEHICLES"),
    },
    "beverse": _CONVERTER_SETTINGS,
    "deepaccident": _CONVERTER_SETTINGS,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Batch:
    """Layout of one code base's labels.

    Attributes:
        names: Name in the devkit → name in the code base.
        orientation: Orientation of the cells.
        left_handed: Whether the egomotion is left-handed.
        past_frames: Whether the maps start with the past frames.
        validity: Whether the batch contains which of its frames are valid.
    """

    names: Mapping[str, str]
    orientation: Orientation
    left_handed: bool = False
    past_frames: bool = False
    validity: bool = True


_BATCHES: Mapping[str, _Batch] = {
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
    """Convert maps, `future_egomotion` and `valid` to a code base's names and layout.

    All arrays are new and writable. Raise ChoiceError if there is no such code base.
    """
    code = _find_batch_form(names)
    result = {}
    for name in MAPS:
        is_vector = name in VECTOR_MAPS
        values = to_orientation(
            labels[name],
            vectors=is_vector,
            source=config.grid.orientation,
            target=code.orientation,
            ignore=config.ignore_index,
        )
        if code.past_frames:
            empty = config.ignore_index if is_vector else 0
            past_shape = (config.receptive_field - 1, *values.shape[1:])
            past_values = np.full(past_shape, empty, dtype=values.dtype)
            values = np.concatenate([past_values, values])
            if name == "segmentation":
                values = values[:, None]
        dtype = np.int64 if values.dtype.kind in "iu" else None
        result[code.names[name]] = np.array(values, dtype=dtype, order="C")
    motion = labels["future_egomotion"]
    if code.left_handed:
        motion = flip_six_vector(motion)
    result[code.names["future_egomotion"]] = np.array(motion, dtype=np.float32)
    if code.validity:
        result["img_is_valid"] = np.array(labels["valid"])
        result["has_invalid_frame"] = np.array(not labels["valid"].all())
    return result


def from_batch(
    batch: ReadOnlyValues, config: MotionLabelConfig, names: BatchNames
) -> dict[str, AnyArray]:
    """Convert a sample of another code base to maps, `future_egomotion` and `valid`.

    This is the inverse of `to_batch`.

    Args:
        batch: Arrays of any framework, without a batch axis.
        config: Configuration of the labels.
        names: Name of the code base.

    Raises:
        FieldError: An array is missing.
        ChoiceError: There is no such code base.
        GeometryError: An array's shape does not match the configuration.
    """
    code = _find_batch_form(names)
    missing = sorted(set(code.names.values()) - set(batch))
    if missing:
        raise FieldError(
            f"batch: {names} labels have {missing[0]!r}; there are {', '.join(sorted(batch))}"
        )
    grid_shape = config.grid.with_orientation(code.orientation).shape
    past_frames = 0
    channels: dict[str, tuple[int, ...]] = dict(_MAP_CHANNELS)
    if code.past_frames:
        past_frames = config.receptive_field - 1
        channels["segmentation"] = (1,)
    result = {}
    for name in MAPS:
        batch_name = code.names[name]
        shape = (past_frames + config.label_frames, *channels[name], *grid_shape)
        dtype = _MAP_DTYPES.get(name, np.float32)
        values = checked(batch_name, batch[batch_name], shape, dtype)[past_frames:]
        if name == "segmentation" and code.past_frames:
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
    valid: Any = np.ones(config.frames, dtype=bool)
    if "img_is_valid" in batch:
        valid = batch["img_is_valid"]
    result["valid"] = checked("img_is_valid", valid, (config.frames,), np.bool_)
    return result


def config_from_names(settings: Mapping[str, Any], names: BatchNames) -> MotionLabelConfig:
    """Return a code base's preset, changed by settings under that code base's own names.

    FIERY's settings are its `cfg` as nested dictionaries (TIME_RECEPTIVE_FIELD, N_FUTURE_FRAMES,
    LIFT.X_BOUND, LIFT.Y_BOUND, DATASET.IGNORE_INDEX, DATASET.FILTER_INVISIBLE_VEHICLES). BEVerse's
    and DeepAccident's are `receptive_field`, `future_frames`, and the arguments of
    ConvertMotionLabels: `grid_conf` (xbound, ybound), `ignore_index`, `only_vehicle`,
    `filter_invisible`. Missing settings keep the preset's values; keys that do not concern labels
    are ignored.

    Raises:
        ChoiceError: There is no such code base.
        ConfigError: A value is not valid.
    """
    names = choice("names", names, get_args(BatchNames))
    changes: NamedValues = {}
    for name, path in _SETTINGS[names].items():
        value = _find_setting(settings, path)
        if value is not None:
            changes[name] = value
    preset = MotionLabelConfig.preset(names)
    x = changes.pop("x", None)
    y = changes.pop("y", None)
    if x is not None or y is not None:
        if names == "deepaccident" and y is not None:  # left-handed
            low, high, size = _read_bound(y)
            y = (-high, -low, size)
        if x is None:
            x = preset.grid.x
        if y is None:
            y = preset.grid.y
        changes["grid"] = BevGrid(x, y)
    return MotionLabelConfig.preset(names, **changes)


def _find_setting(settings: ReadOnlyValues, path: tuple[str, ...]) -> Any:
    """Return a nested setting; None if it is missing."""
    value: Any = settings
    for name in path:
        if not isinstance(value, Mapping) or name not in value:
            return None
        value = value[name]
    return value


def _read_bound(bound: Any) -> tuple[float, float, float]:
    """Return start, end and cell size, metres; raise ConfigError unless they are three numbers."""
    try:
        low, high, size = map(float, bound)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"ybound: expected start, end and cell size in metres, found {bound!r}"
        ) from error
    return low, high, size


def _find_batch_form(names: str) -> _Batch:
    """Return the layout of a code base's labels; raise ChoiceError if it is unknown."""
    return _BATCHES[choice("names", names, _BATCHES)]
