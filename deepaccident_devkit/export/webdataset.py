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
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.format import README, readme, shards
from deepaccident_devkit.export.frames import keyframes, sensor_files
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

# Channel → its name in shards: `Camera_FrontLeft` is `camera_front_left`.
_CAMERA_NAMES: Final[Mapping[str, str]] = {
    camera: re.sub(r"(?<=[a-z])(?=[A-Z])", "_", camera).lower() for camera in CAMERAS
}

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
"""Field → its type: a name, a list of a single type, or nested fields."""

JSON_FIELDS: Final = """\
| field | what |
|---|---|
| `token`, `scenario`, `agent`, `frame`, `split` | which sample it is; the split is null if \
unknown |
| `timestamp`, `time_to_end`, `time_to_impact` | seconds since the first frame, until the last \
one, until the impact; \
null without an impact |
| `velocity` | of the agent over the ground, in world; null if unknown |
| `world_from_ego`, `ego_from_lidar` | 4×4; `world_from_ego @ ego_from_lidar` maps LiDAR points \
to world |
| `cameras` | of each camera `ego_from_camera` 4×4, `intrinsic` 3×3, and `width` and `height` of \
its image; \
without an image those of calib |
| `labelled` | whether there is a label; if not, there are no boxes |
| `boxes` | columns with an entry a box: `center`, `size` (length, width, height), `yaw` and \
`velocity`, all in \
the LiDAR frame, `category`, `actor_id` (−100 the agent itself, −1 untracked), `num_lidar_pts`, \
`camera_visible`, \
`is_collider` |

An unknown velocity of a box is null three times; `numpy.array(boxes["velocity"], dtype=float)` \
makes it NaN.
"""
FrameChoice = Literal["every", "keyframes"]
# Approximate size of a sample's JSON and of the headers of its files, used to divide shards.
_FACTS_BYTES: Final = 20_000
_SHARD_CHANNELS: Final = (*CAMERAS, LIDAR)
# Without these types `datasets` guesses by five samples: wrongly if one of them lacks an image or
# an impact.
_TYPES: Final[Mapping[str, Any]] = {
    **{f"{name}.jpg": "image" for name in _CAMERA_NAMES.values()},
    "lidar.npy": [["float32"]],
    "json": JSON_TYPES,
    **dict.fromkeys(("__key__", "__url__"), "string"),
}
_BODY: Final = """\
A sample is one agent at one frame. The names of its files begin with \
`<type>/<scenario>/<agent>/<NNN>`, in which a dot
is written as %2E. Samples are ordered by scenario, then frame, then agent: those of one moment \
follow each other. The
agents of a scenario are in one shard.

| file | what |
|---|---|
| `camera_front.jpg`, … | the six cameras' images, byte by byte those of the release |
| `lidar.npy` | float32 (N, 4): x, y, z in the LiDAR frame, intensity |
| `json` | the fields below |

A file that the release at hand lacks is missing in the sample, too.

"""


def sample_json(dataset: Dataset, sample: str, sizes: Mapping[str, tuple[int, int]]) -> bytes:
    """Return the JSON of a sample; raises TokenError.

    Args:
        dataset: The release.
        sample: Token of the sample.
        sizes: Camera → width and height of its image, if it exists.
    """
    record = dataset.sample.get(sample)
    cameras = {}
    for camera, name in _CAMERA_NAMES.items():
        cameras[name] = _camera(dataset, sample, camera, sizes.get(camera))
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
        "boxes": _boxes(dataset, sample),
    }
    return json.dumps(facts, allow_nan=False).encode()


def _camera(
    dataset: Dataset, sample: str, channel: str, size: tuple[int, int] | None
) -> dict[str, Any]:
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
    """Return rows as lists, with None for NaN, which JSON does not have."""
    return [[None if math.isnan(value) else value for value in row] for row in rows.tolist()]


@dataclass(frozen=True, kw_only=True)
class WebDataset(Format):
    """Shards for `webdataset` and `datasets`: `<split>-000000.tar`, and a README.md.

    Attributes:
        frames: `every` frame, or the `keyframes`: two a second, counted back from the last one, the
            impact.
        shard_size: Approximate bytes of a shard; the agents of a scenario stay together, so it can
            be larger.

    Raises:
        ChoiceError: no such choice of frames.
        ConfigError: `shard_size` is less than 1.
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

        Sizes are estimated from the first files, since reading all sizes would take minutes.
        """
        sizes = {}
        for scenario in scenarios:
            sizes[scenario] = _Recording(dataset, scenario, self).estimated_size()
        units = []
        for split, groups in shards(dataset, sizes, self.shard_size).items():
            for number, group in enumerate(groups):
                units.append(Unit(name=f"{split}-{number:06d}", scenarios=group))
        return units

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a shard, in the format of GNU tar, which allows names of any length."""
        with (
            output.file(f"{unit.name}.tar") as path,
            tarfile.open(path, "w", format=tarfile.GNU_FORMAT, encoding="utf-8") as archive,
        ):
            for scenario in unit.scenarios:
                recording = _Recording(dataset, scenario, self)
                recording.count(output)
                recording.write(archive)

    def finish(
        self,
        dataset: Dataset,
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],  # noqa: ARG002 - units are complete files
    ) -> None:
        """Write the README.md."""
        splits = dict.fromkeys(unit.name.split("-")[0] for unit in units)
        files = [{"split": split, "path": f"{split}-*.tar"} for split in splits]
        head = {
            "configs": [{"config_name": "default", "data_files": files}],
            "dataset_info": {"features": _features(_TYPES)},
        }
        text = readme(
            self, dataset, f"DeepAccident {dataset.version}: samples", head, _BODY + JSON_FIELDS
        )
        output.write(README, text)


class _Recording:
    """Samples of a scenario that belong to a shard.

    Attributes:
        samples: Number of samples.
    """

    def __init__(self, dataset: Dataset, scenario: str, form: WebDataset) -> None:
        """Find the agents of the scenario."""
        self._dataset, self._scenario, self._requested = dataset, scenario, form.agents
        self._frame_count = dataset.scenario.get(scenario)["num_frames"]
        self._numbers = range(1, self._frame_count + 1)
        if form.frames == "keyframes":
            self._numbers = keyframes(self._frame_count)
        self._all_agents = agents_of(dataset, scenario)
        self._agents: list[str] = [agent for agent in self._all_agents if agent in form.agents]
        self.samples = len(self._agents) * len(self._numbers)

    @cached_property
    def _files(self) -> dict[tuple[str, str], dict[int, tuple[ReleasePath, int]]]:
        """Agent and channel → frame → path and bytes of existing files."""
        files = {}
        for agent, channel in product(self._agents, CHANNELS):
            all_files = sensor_files(self._dataset, self._scenario, agent, channel)
            files[agent, channel] = {
                number: all_files[number] for number in self._numbers if number in all_files
            }
        return files

    def estimated_size(self) -> int:
        """Return the bytes, as if all files were as large as the first ones."""
        size = self.samples * _FACTS_BYTES
        for agent, channel in product(self._agents, _SHARD_CHANNELS):
            token = sample_token(self._scenario, agent, self._numbers[0])
            path = self._dataset.sensor_path(token, channel)
            if path.is_file():
                size += path.stat().st_size * len(self._numbers)
        return size

    def count(self, output: Output) -> None:
        """Count the samples, and data that is not written."""
        output.tally.samples += self.samples
        absent = [agent for agent in self._requested if agent not in self._all_agents]
        counts = dict.fromkeys(CHANNELS, 0)
        for agent, channel in product(self._agents, CHANNELS):
            counts[channel] += len(self._files[agent, channel])
        images = sum(counts[camera] for camera in CAMERAS)
        output.leave_out("agents of scenarios that are not in this release", len(absent))
        output.leave_out(
            "samples of other agents",
            (len(self._all_agents) - len(self._agents)) * len(self._numbers),
        )
        output.leave_out(
            "samples between keyframes",
            (self._frame_count - len(self._numbers)) * len(self._agents),
        )
        output.leave_out(
            "images that are not in this release", len(CAMERAS) * self.samples - images
        )
        output.leave_out("point clouds that are not in this release", self.samples - counts[LIDAR])
        output.leave_out("files of the BEV camera", counts[BEV_CAMERA])

    def write(self, archive: tarfile.TarFile) -> None:
        """Add the samples, all agents of a moment together."""
        for number, agent in product(self._numbers, self._agents):
            token = sample_token(self._scenario, agent, number)
            # readers cut a name at its first dot
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
                _add_file(archive, f"{key}.lidar.npy", _npy_bytes(path))
            _add_file(archive, f"{key}.json", sample_json(self._dataset, token, sizes))


def _add_file(archive: tarfile.TarFile, name: str, content: bytes) -> None:
    """Add a file; its time is 0 and its owner nobody, so that equal samples make equal shards."""
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    archive.addfile(entry, io.BytesIO(content))


def _npy_bytes(path: ReleasePath) -> bytes:
    """Return a LiDAR file as the bytes of a `.npy` file."""
    cloud, content = read_lidar(path), io.BytesIO()
    np.save(content, cloud.points.astype(np.float32), allow_pickle=False)
    return content.getvalue()


def _features(types: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return types in the form of the heads of README.md files."""
    return [{"name": name, **_feature(kind)} for name, kind in types.items()]


def _feature(kind: Any) -> dict[str, Any]:
    if isinstance(kind, str):
        return {"dtype": kind}
    if isinstance(kind, list):
        (inner,) = kind
        return {"list": inner if isinstance(inner, str) else _feature(inner)}
    return {"struct": _features(kind)}
