"""The JSON of a sample in a shard: pose, calibration, times, boxes; what each field is, and its type."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.taxonomy import CAMERAS, CATEGORIES, LIDAR

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

CAMERA_NAMES: Final[Mapping[str, str]] = {
    camera: re.sub(r"(?<=[a-z])(?=[A-Z])", "_", camera).lower() for camera in CAMERAS
}
"""Our channel → its name in shards: `Camera_FrontLeft` is `camera_front_left`."""

_NUMBERS: Final = ["float64"]
_ROWS: Final = [_NUMBERS]
JSON_TYPES: Final[Mapping[str, Any]] = {
    **dict.fromkeys(("token", "scenario", "agent"), "string"),
    "frame": "int64",
    "split": "string",
    **dict.fromkeys(("timestamp", "time_to_end", "time_to_impact"), "float64"),
    "velocity": _NUMBERS,
    "world_from_ego": _ROWS,
    "ego_from_lidar": _ROWS,
    "cameras": {
        name: {"ego_from_camera": _ROWS, "intrinsic": _ROWS, "width": "int64", "height": "int64"}
        for name in CAMERA_NAMES.values()
    },
    "labelled": "bool",
    "boxes": {
        **dict.fromkeys(("center", "size", "velocity"), _ROWS),
        "yaw": _NUMBERS,
        "category": ["string"],
        "actor_id": ["int64"],
        "num_lidar_pts": ["int64"],
        "camera_visible": ["bool"],
        "is_collider": ["bool"],
    },
}
"""Field → its type: a word, a list of one type, or fields of its own."""

JSON_FIELDS: Final = """\
| field | what |
|---|---|
| `token`, `scenario`, `agent`, `frame`, `split` | which sample it is; the split is null if unknown |
| `timestamp`, `time_to_end`, `time_to_impact` | seconds since the first frame, until the last one, until the impact; \
null without an impact |
| `velocity` | of the agent over the ground, in world; null if unknown |
| `world_from_ego`, `ego_from_lidar` | 4×4; `world_from_ego @ ego_from_lidar` maps LiDAR points to world |
| `cameras` | of each camera `ego_from_camera` 4×4, `intrinsic` 3×3, and `width` and `height` of its image; \
without an image those of calib |
| `labelled` | whether there is a label; if not, there are no boxes |
| `boxes` | columns with an entry a box: `center`, `size` (length, width, height), `yaw` and `velocity`, all in \
the LiDAR frame, `category`, `actor_id` (−100 the agent itself, −1 untracked), `num_lidar_pts`, `camera_visible`, \
`is_collider` |

An unknown velocity of a box is null three times; `numpy.array(boxes["velocity"], dtype=float)` makes it NaN.
"""


def sample_json(dataset: Dataset, sample: str, sizes: Mapping[str, tuple[int, int]]) -> bytes:
    """The JSON of a sample, given by its token; `sizes` has width and height of its images that are there.

    Raises TokenError.
    """
    record = dataset.sample.get(sample)
    frame = dataset.frame.get(record["frame_token"])
    facts = {
        "token": sample,
        "scenario": record["scenario_token"],
        "agent": record["agent"],
        "frame": frame["index"],
        "split": dataset.scenario.get(record["scenario_token"])["split"],
        **{name: record[name] for name in ("timestamp", "time_to_end", "time_to_impact", "velocity")},
        "world_from_ego": dataset.world_from(sample, "ego").matrix.tolist(),
        "ego_from_lidar": dataset.ego_from(sample, LIDAR).matrix.tolist(),
        "cameras": {name: _camera(dataset, sample, camera, sizes.get(camera)) for camera, name in CAMERA_NAMES.items()},
        "labelled": record["labelled"],
        "boxes": _boxes(dataset, sample),
    }
    return json.dumps(facts, allow_nan=False).encode()


def _camera(dataset: Dataset, sample: str, channel: str, size: tuple[int, int] | None) -> dict[str, Any]:
    calibrated = dataset.camera(sample, channel)
    camera = calibrated if size is None else calibrated.resized(*size)
    return {
        "ego_from_camera": dataset.ego_from(sample, channel).matrix.tolist(),
        "intrinsic": camera.intrinsic.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def _boxes(dataset: Dataset, sample: str) -> dict[str, Any]:
    rows, columns = dataset.annotation_rows(sample), dataset.columns("annotation")
    numbers = ("actor_id", "num_lidar_pts", "camera_visible", "is_collider")
    return {
        "center": columns["translation"][rows].tolist(),
        "size": columns["size"][rows].tolist(),
        "velocity": _nan_as_null(columns["velocity"][rows]),
        "yaw": columns["yaw"][rows].tolist(),
        "category": [CATEGORIES[code] for code in columns["category"][rows].tolist()],
        **{name: columns[name][rows].tolist() for name in numbers},
    }


def _nan_as_null(rows: FloatArray) -> list[list[float | None]]:
    """As lists; JSON has no NaN."""
    return [[None if value != value else value for value in row] for row in rows.tolist()]  # noqa: PLR0124 - NaN
