"""Samples with their sensor files as tar files of about equal size, for streaming.

docs/exports.md describes them.
"""

from __future__ import annotations

import io
import json
import math
import re
import tarfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, TypeAlias, get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.format import README, divide_into_shards, format_readme
from deepaccident_devkit.export.frames import FrameFiles, keyframes, select_files, sensor_files
from deepaccident_devkit.release import read_lidar
from deepaccident_devkit.release.images import image_size, read_image_bytes
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, CATEGORIES, CHANNELS, LIDAR
from deepaccident_devkit.v2x.agents import agents_of

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

# Name of each channel in shards, such as `camera_front_left` for `Camera_FrontLeft`.
_CAMERA_NAMES: Mapping[str, str] = {
    camera: re.sub(r"(?<=[a-z])(?=[A-Z])", "_", camera).lower() for camera in CAMERAS
}
# Types of a list and of a matrix of numbers.
_NUMBERS = ["float64"]
_ROWS = [_NUMBERS]
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
        for name in _CAMERA_NAMES.values()
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
"""Type of each field: a name, a list with a single type, or nested fields."""

JSON_FIELDS: Final = """\
| field | what |
|---|---|
| `token`, `scenario`, `agent`, `frame`, `split` | which sample it is; the split is null if \
unknown |
| `timestamp`, `time_to_end`, `time_to_impact` | seconds since the first frame, until the last \
frame and until the impact; the latter is \
null without an impact |
| `velocity` | velocity of the agent over the ground, in world; null if unknown |
| `world_from_ego`, `ego_from_lidar` | 4×4; `world_from_ego @ ego_from_lidar` maps LiDAR points \
to world |
| `cameras` | for each camera, `ego_from_camera` 4×4, `intrinsic` 3×3, and `width` and `height` of \
its image, \
or of calib if there is no image |
| `labelled` | whether there is a label; if not, there are no boxes |
| `boxes` | columns with an entry for each box: `center`, `size` (length, width, height), `yaw` \
and `velocity`, all in \
the LiDAR frame, `category`, `actor_id` (−100 the agent itself, −1 untracked), `num_lidar_pts`, \
`camera_visible`, \
`is_collider` |

An unknown velocity of a box is three nulls; `numpy.array(boxes["velocity"], dtype=float)` \
makes it NaN.
"""
FrameChoice = Literal["every", "keyframes"]
# Approximate size of the JSON of a sample and of the headers of its files, to plan shards.
_FACTS_BYTES = 20_000
# Facts for JSON by their names.
_Facts: TypeAlias = "dict[str, Any]"
_SHARD_CHANNELS = (*CAMERAS, LIDAR)
# Without these types `datasets` guesses them from five samples, and guesses wrongly if one of them
# lacks an image or an impact.
_TYPES: Mapping[str, Any] = {
    **{f"{name}.jpg": "image" for name in _CAMERA_NAMES.values()},
    "lidar.npy": [["float32"]],
    "json": JSON_TYPES,
    **dict.fromkeys(("__key__", "__url__"), "string"),
}
_BODY = """\
A sample is one agent at one frame. The names of its files begin with \
`<type>/<scenario>/<agent>/<NNN>`, in which a dot
is written as %2E. Samples are ordered by scenario, then frame, then agent, so the samples of one \
moment follow each other. The
agents of a scenario are in one shard.

| file | what |
|---|---|
| `camera_front.jpg`, … | the images of the six cameras, copied byte by byte from the release |
| `lidar.npy` | float32 (N, 4): x, y, z in the LiDAR frame, intensity |
| `json` | the fields below |

A file that is missing in the release is missing in the sample, too.

"""


def encode_sample(dataset: Dataset, sample: str, sizes: Mapping[str, tuple[int, int]]) -> bytes:
    """Encode a sample as JSON; raise TokenError if there is no such sample.

    Args:
        dataset: The release.
        sample: Token of the sample.
        sizes: Width and height of each camera's image, by camera; only cameras with an image.
    """
    record = dataset.sample.get(sample)
    cameras = {}
    for camera, name in _CAMERA_NAMES.items():
        cameras[name] = _describe_camera(dataset, sample, camera, sizes.get(camera))
    facts = {
        "token": sample,
        "scenario": record["scenario_token"],
        "agent": record["agent"],
        "frame": dataset.frame.get(record["frame_token"])["index"],
        "split": dataset.scenario.get(record["scenario_token"])["split"],
        "timestamp": record["timestamp"],
        "time_to_end": record["time_to_end"],
        "time_to_impact": record["time_to_impact"],
        "velocity": record["velocity"],
        "world_from_ego": dataset.world_from(sample, "ego").matrix.tolist(),
        "ego_from_lidar": dataset.ego_from(sample, LIDAR).matrix.tolist(),
        "cameras": cameras,
        "labelled": record["labelled"],
        "boxes": _describe_boxes(dataset, sample),
    }
    return json.dumps(facts, allow_nan=False).encode()


def _describe_camera(
    dataset: Dataset, sample: str, channel: str, size: tuple[int, int] | None
) -> _Facts:
    camera = dataset.camera(sample, channel)
    if size is not None:
        camera = camera.resized(*size)
    return {
        "ego_from_camera": dataset.ego_from(sample, channel).matrix.tolist(),
        "intrinsic": camera.intrinsic.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def _describe_boxes(dataset: Dataset, sample: str) -> _Facts:
    rows = dataset.annotation_rows(sample)
    columns = dataset.columns("annotation")
    plain_columns = ("actor_id", "num_lidar_pts", "camera_visible", "is_collider")
    return {
        "center": columns["translation"][rows].tolist(),
        "size": columns["size"][rows].tolist(),
        "velocity": _replace_nan(columns["velocity"][rows]),
        "yaw": columns["yaw"][rows].tolist(),
        "category": [CATEGORIES[code] for code in columns["category"][rows].tolist()],
        **{name: columns[name][rows].tolist() for name in plain_columns},
    }


def _replace_nan(rows: FloatArray) -> list[list[float | None]]:
    """Return rows as lists, with None instead of NaN, which JSON does not have."""
    lists = []
    for row in rows.tolist():
        lists.append([None if math.isnan(value) else value for value in row])
    return lists


@dataclass(frozen=True, kw_only=True)
class WebDataset(Format):
    """Shards for `webdataset` and `datasets`: `<split>-000000.tar`, and a README.md.

    Attributes:
        frames: Frames to export: `every` frame, or `keyframes`, which are two a second, counted
            back from the last frame, the impact.
        shard_size: Approximate size of a shard in bytes; since the agents of a scenario stay
            together, a shard can be larger.

    Raises:
        ChoiceError: If there is no such choice of frames.
        ConfigError: If `shard_size` is less than 1.
    """

    frames: FrameChoice = "every"
    shard_size: int = 10**9

    name: ClassVar[str] = "webdataset"
    unit_word: ClassVar[str] = "shard"

    def __post_init__(self) -> None:
        """Check the choices and the size of shards."""
        super().__post_init__()
        settle_choices(self, {"frames": get_args(FrameChoice)})
        if self.shard_size < 1:
            raise ConfigError(
                f"shard_size: expected a number of bytes from 1, found {self.shard_size}"
            )

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """Return a unit for each shard.

        Sizes are estimated from the first files, since it would take minutes to read all sizes.
        """
        sizes = {}
        for scenario in scenarios:
            sizes[scenario] = _Recording(dataset, scenario, self).estimate_size()
        units = []
        for split, shards in divide_into_shards(dataset, sizes, self.shard_size).items():
            for number, shard in enumerate(shards):
                units.append(Unit(name=f"{split}-{number:06d}", scenarios=shard))
        return units

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a shard in the format of GNU tar, which allows names of any length."""
        with (
            output.file(f"{unit.name}.tar") as path,
            tarfile.open(path, "w", format=tarfile.GNU_FORMAT, encoding="utf-8") as archive,
        ):
            for scenario in unit.scenarios:
                recording = _Recording(dataset, scenario, self)
                recording.count_data(output)
                recording.write(archive)

    def finish(
        self,
        dataset: Dataset,
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],  # noqa: ARG002 - units are complete files
    ) -> None:
        """Write README.md."""
        splits = dict.fromkeys(unit.name.split("-")[0] for unit in units)
        files = [{"split": split, "path": f"{split}-*.tar"} for split in splits]
        head = {
            "configs": [{"config_name": "default", "data_files": files}],
            "dataset_info": {"features": _list_features(_TYPES)},
        }
        text = format_readme(
            self, dataset, f"DeepAccident {dataset.version}: samples", head, _BODY + JSON_FIELDS
        )
        output.write(README, text)


class _Recording:
    """The samples of a scenario that belong to a shard.

    Attributes:
        samples: Number of samples.
    """

    def __init__(self, dataset: Dataset, scenario: str, form: WebDataset) -> None:
        """Select the agents and frames of the scenario."""
        self._dataset = dataset
        self._scenario = scenario
        self._requested_agents = form.agents
        self._frame_count = dataset.scenario.get(scenario)["num_frames"]
        self._numbers = range(1, self._frame_count + 1)
        if form.frames == "keyframes":
            self._numbers = keyframes(self._frame_count)
        self._all_agents = agents_of(dataset, scenario)
        self._agents: list[str] = [agent for agent in self._all_agents if agent in form.agents]
        self.samples = len(self._agents) * len(self._numbers)

    @cached_property
    def _files(self) -> dict[tuple[str, str], FrameFiles]:
        """Path and bytes of existing files, by agent and channel, then by frame."""
        files = {}
        for agent, channel in product(self._agents, CHANNELS):
            all_files = sensor_files(self._dataset, self._scenario, agent, channel)
            files[agent, channel] = select_files(all_files, self._numbers)
        return files

    def estimate_size(self) -> int:
        """Estimate the size in bytes, assuming that all files are as large as the first ones."""
        size = self.samples * _FACTS_BYTES
        for agent, channel in product(self._agents, _SHARD_CHANNELS):
            token = sample_token(self._scenario, agent, self._numbers[0])
            path = self._dataset.sensor_path(token, channel)
            if path.is_file():
                size += path.stat().st_size * len(self._numbers)
        return size

    def count_data(self, output: Output) -> None:
        """Count the samples, and the data that is not written."""
        output.tally.samples += self.samples
        num_frames = len(self._numbers)
        num_other_agents = len(self._all_agents) - len(self._agents)
        num_other_frames = self._frame_count - num_frames
        absent = [agent for agent in self._requested_agents if agent not in self._all_agents]
        counts = dict.fromkeys(CHANNELS, 0)
        for (_, channel), files in self._files.items():
            counts[channel] += len(files)
        num_images = sum(counts[camera] for camera in CAMERAS)
        num_missing_images = len(CAMERAS) * self.samples - num_images
        output.leave_out("agents of scenarios that are not in this release", len(absent))
        output.leave_out("samples of other agents", num_other_agents * num_frames)
        output.leave_out("samples between keyframes", num_other_frames * len(self._agents))
        output.leave_out("images that are not in this release", num_missing_images)
        output.leave_out("point clouds that are not in this release", self.samples - counts[LIDAR])
        output.leave_out("files of the BEV camera", counts[BEV_CAMERA])

    def write(self, archive: tarfile.TarFile) -> None:
        """Add the samples to an archive, all agents of a moment together."""
        for number, agent in product(self._numbers, self._agents):
            token = sample_token(self._scenario, agent, number)
            # Readers cut a name at its first dot.
            key = token.replace("%", "%25").replace(".", "%2E")
            sizes = {}
            for camera, name in _CAMERA_NAMES.items():
                if number in self._files[agent, camera]:
                    path, _ = self._files[agent, camera][number]
                    content = read_image_bytes(path)
                    sizes[camera] = image_size(path, content)
                    _add_file(archive, f"{key}.{name}.jpg", content)
            if number in self._files[agent, LIDAR]:
                path, _ = self._files[agent, LIDAR][number]
                _add_file(archive, f"{key}.lidar.npy", _encode_npy(path))
            _add_file(archive, f"{key}.json", encode_sample(self._dataset, token, sizes))


def _add_file(archive: tarfile.TarFile, name: str, content: bytes) -> None:
    """Add a file without time or owner to an archive, so that equal samples make equal shards."""
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    stream = io.BytesIO(content)
    archive.addfile(entry, stream)


def _encode_npy(path: ReleasePath) -> bytes:
    """Convert a LiDAR file to the content of a `.npy` file."""
    points = read_lidar(path).points.astype(np.float32)
    content = io.BytesIO()
    np.save(content, points, allow_pickle=False)
    return content.getvalue()


def _list_features(types: Mapping[str, Any]) -> list[_Facts]:
    """Convert the types of fields to the format of a README.md's YAML head."""
    features = []
    for name, field_type in types.items():
        features.append({"name": name, **_describe_type(field_type)})
    return features


def _describe_type(field_type: Any) -> _Facts:
    if isinstance(field_type, str):
        return {"dtype": field_type}
    if isinstance(field_type, list):
        (item_type,) = field_type
        if not isinstance(item_type, str):
            item_type = _describe_type(item_type)
        return {"list": item_type}
    return {"struct": _list_features(field_type)}
