"""A part of a release in the release's own layout, which every reader of a release can open.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.release import ReleasePart

    da = DeepAccident(dataroot="data/DeepAccident")
    form = ReleasePart(split="val", channels=("Camera_Front", "lidar01"), size=(640, 360))
    export_release(da, "data/part", form)

docs/reading.md, A part, describes what a part has.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ExportError, NotAvailableError, SensorFileError
from deepaccident_devkit.export.format import (
    README,
    Format,
    Output,
    Unit,
    check_names,
    format_readme,
)
from deepaccident_devkit.export.images import check_pixels
from deepaccident_devkit.geometry import conventions
from deepaccident_devkit.release import (
    ScenarioFolder,
    find_release,
    read_calib,
    read_image,
    read_split_file,
)
from deepaccident_devkit.release.calib import encode_raw_calib
from deepaccident_devkit.release.images import (
    aspect_fault,
    encode_jpeg,
    fitting_size,
    image_size,
)
from deepaccident_devkit.release.layout import encode_split_file, frame_sizes
from deepaccident_devkit.release.part import recording_name
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import counted, size_text
from deepaccident_devkit.tables.scan import SMALL_FILE_ENDINGS
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, CHANNEL_FORMAT, CHANNELS
from deepaccident_devkit.v2x.agents import agents_of

_ENDINGS = {**SMALL_FILE_ENDINGS, **CHANNEL_FORMAT}
_CONTENT_FILE = "content.json"
_LEFT_HANDED = (
    "The files are those of the release: left-handed, with CARLA's axes. The devkit's readers "
    "convert them."
)
_BODY = """\
It has the label, calib and meta files of these agents and the files of {channels}.
Images have {size}. Where the release has another size, they were resized by area, and the
intrinsics in calib were scaled; the released code assumes 1600x900. All other files are unchanged.

`release.manifest.json` says what this part should have: `deepaccident validate` on this folder
checks it. The split files name the scenarios that are here. Files that are hard links (the default)
share their content with the release, so an edit here also changes the release.
"""


@dataclass(frozen=True, kw_only=True)
class ReleasePart(Format):
    """A part of a release, with the same relative paths as in the release.

    Label, calib and meta files are always included, and split files name what is there. Files that
    are not resized are linked, or copied from zips.

    Attributes:
        channels: Sensors with files to include.
        size: Width and height to which images are resized by area, in pixels; None keeps them. The
            intrinsics in calib are scaled with them. The files of the BEV camera and point clouds
            stay as they are.

    Raises:
        ChoiceError: If there is no such channel.
        ConfigError: If a size is not two whole numbers of pixels.
    """

    channels: tuple[str, ...] = CHANNELS  # type: ignore[misc] # here the user chooses the sensors
    size: tuple[int, int] | None = None
    name: ClassVar[str] = "release"

    def __post_init__(self) -> None:
        """Check the choices, and give them their usual spelling and order."""
        super().__post_init__()
        object.__setattr__(self, "channels", check_names("channels", self.channels, CHANNELS))
        if self.size is not None:
            size = check_pixels("size", self.size, "width and height", (1, 1))
            object.__setattr__(self, "size", size)

    def survey(self, dataset: Dataset, scenarios: Sequence[str], folder: Path) -> str:
        """Count the chosen files of the release by listing its folders.

        Raises:
            ExportError: If the folder lies in the release.
            NotAvailableError: If the release lacks the chosen sensors, or images to resize.
            ConfigError: If the images do not fit the size.
        """
        root = os.path.realpath(str(dataset.dataroot))
        if Path(os.path.realpath(folder)).is_relative_to(root):
            raise ExportError(
                f"{folder}: lies in the release {dataset.dataroot}; choose a folder outside it"
            )
        file_sizes = []
        first_files: dict[str, ReleasePath] = {}
        for token in scenarios:
            for recording, path, size in self._find_files(dataset, token):
                file_sizes.append(size)
                first_files.setdefault(recording.rpartition("/")[2], path)
        cameras = first_files.keys() & CAMERAS if self.size else set()
        absent = [channel for channel in self.channels if channel not in first_files]
        # By default, a part has the sensors that are there.
        if (absent and self.channels != CHANNELS) or (self.size and not cameras):
            names = ", ".join(absent) or "cameras"
            raise NotAvailableError(
                f"{dataset.dataroot}: the chosen scenarios have no files of {names}; unpack their "
                "archives, or choose other channels, or no size if there are no images"
            )
        for camera in cameras:
            fitting_size(self.size, image_size(first_files[camera]))
        scenario_count = counted(len(scenarios), "scenario")
        file_count = counted(len(file_sizes), "file")
        return f"selected: {scenario_count}, {file_count}, {size_text(sum(file_sizes))}"

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the files of a scenario."""
        (token,) = unit.scenarios
        num_files = Counter[str]()
        for recording, path, size in self._find_files(dataset, token):
            kind = recording.rpartition("/")[2]
            target = _relative_path(dataset.dataroot, path)
            content = None
            if self.size and kind in CAMERAS:
                content = _resize_image(path, self.size)
            elif self.size and kind == "calib":
                content = _resize_cameras(path, self.size)
            if content is None:
                output.link(path, target)
            else:
                output.write(target, content)
            num_files[recording] += size > 0
            output.tally.samples += kind == "calib"
        write_bytes(output.parts / _CONTENT_FILE, json.dumps(num_files).encode())

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Write the split files and the README, and say in the manifest what the part has."""
        for unit in units:
            content = parsed_json(read_bytes(parts(unit) / _CONTENT_FILE, "bundle"))
            if content:
                output.contents[unit.scenarios[0]] = content
        layout = find_release(dataset.dataroot, dataset.version)
        for path in layout.split_files.values():
            tokens = [token for token in read_split_file(path) if token in output.contents]
            output.write(_relative_path(dataset.dataroot, path), encode_split_file(tokens))
        size = "the size of the release"
        if self.size is not None:
            width, height = self.size
            size = f"the size {width}x{height} (width x height)"
        body = _BODY.format(channels=", ".join(self.channels), size=size)
        readme = format_readme(self, dataset, "A part of DeepAccident", {}, body, _LEFT_HANDED)
        output.write(README, readme)

    def _find_files(self, dataset: Dataset, token: str) -> Iterator[tuple[str, ReleasePath, int]]:
        """Yield the name of the recording, the path and the size of each chosen file."""
        record = dataset.get("scenario", token)
        agents = [agent for agent in agents_of(dataset, token) if agent in self.agents]
        scenario = ScenarioFolder(
            dataset.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS
        )
        for agent, kind in product(agents, (*SMALL_FILE_ENDINGS, *self.channels)):
            ending = _ENDINGS[kind]
            for frame, size in frame_sizes(scenario.kind_folder(agent, kind), ending).items():
                if frame <= record["num_frames"]:
                    yield (
                        recording_name(agent, kind),
                        scenario.file(agent, kind, frame, ending),
                        size,
                    )
        meta = scenario.meta_path
        if agents and meta.is_file():
            yield "meta", meta, meta.stat().st_size


def _relative_path(root: ReleasePath, path: ReleasePath) -> str:
    return str(path).removeprefix(str(root)).lstrip("/")


def _resize_image(source: ReleasePath, size: tuple[int, int]) -> bytes | None:
    """Return a resized image as JPEG; None if the image already has this width and height.

    Raises SensorFileError if the file cannot be read, or if the size does not fit the image.
    """
    import cv2

    image = read_image(source)
    full_size = image.shape[1::-1]
    if full_size == size:
        return None
    fault = aspect_fault(size, full_size)
    if fault is not None:
        raise SensorFileError(f"{source}: {fault}")
    resized: Any = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return encode_jpeg(source, resized)


def _resize_cameras(source: ReleasePath, size: tuple[int, int]) -> bytes | None:
    """Return the content of a calib file with the intrinsics of resized images.

    It is None if all intrinsics are already for images of this width and height.
    """
    calib = read_calib(source, raw=True)
    keys = [f"intrinsic_{camera}" for camera in CAMERAS]
    intrinsics = conventions.intrinsic([calib[key] for key in keys])
    scales = size / np.rint(2 * intrinsics[:, :2, 2])
    if (scales == 1).all():
        return None
    for key, scale in zip(keys, scales, strict=True):
        calib[key] = np.diag([*scale, 1]) @ calib[key]
    return encode_raw_calib(calib)
