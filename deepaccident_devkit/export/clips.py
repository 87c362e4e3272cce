"""Videos of the cameras' images, with a row of numbers for each frame.

docs/exports.md describes them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

from deepaccident_devkit.errors import ConfigError, SensorFileError
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.clip_files import (
    FPS,
    ROW_COLUMNS,
    describe_video,
    read_episode,
    video_path,
    write_episode,
    write_files,
)
from deepaccident_devkit.export.clip_rows import clip_cameras, clip_rows
from deepaccident_devkit.export.format import README, check_names, flat_name, format_readme
from deepaccident_devkit.export.frames import FrameFiles, sensor_files
from deepaccident_devkit.export.images import check_pixels
from deepaccident_devkit.release.images import (
    ImageSize,
    aspect_fault,
    decode_image,
    fitting_size,
    image_size,
    read_image_bytes,
)
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.support.arrays import ByteArray
from deepaccident_devkit.support.mp4 import MP4_QUALITY, check_pyav, write_mp4
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, SPLITS
from deepaccident_devkit.v2x.agents import agents_of

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

KEYFRAME_STEP: Final = 10
"""Number of pictures from one keyframe of a video to the next one."""
# Preset of x264: a third faster than the default, with files at most a seventh larger.
_PRESET = "faster"
# Statistics use this many rows and columns of pixels of the first picture in each second.
_GRID_SIZE = 6
_UNKNOWN_SPLIT = "unknown"
_SPLIT_ORDER = (*SPLITS, _UNKNOWN_SPLIT)
_BODY = """\
A LeRobotDataset v3, which `LeRobotDataset(name, root=folder, video_backend="pyav")` opens. An \
episode is the recording of
one agent, with an MP4 for each camera, in which every tenth picture is a keyframe. Do not divide \
a `group` between
training and testing.

| file | what |
|---|---|
| `frames.csv`, `data/…/*.parquet` | a row for each frame, in the order of the episodes |
| `meta/episodes/…/*.parquet` | a row for each episode: its rows, and for each camera `video` \
(the file), `size`, \
`intrinsic` (in pixels of the video), `ego_from_camera` and `pixels` (some, for statistics) |
| `meta/info.json`, `meta/stats.json` | columns, the episodes of each split, and statistics |

| column | what |
|---|---|"""


@dataclass(frozen=True, kw_only=True)
class Clips(Format):
    """Videos of recordings and a row for each frame, as a LeRobotDataset v3.

    An episode is the recording of an agent in a scenario, with a video for each camera. An agent
    that lacks an image is left out of its scenario.

    Attributes:
        cameras: Cameras whose images to export.
        size: Width and height of the pictures, pixels; None keeps the size of the images.
        quality: Quality of the videos, from 0 (best) to 51 (worst).

    Raises:
        ChoiceError: If there is no such split, agent or camera.
        ConfigError: If the size is not two whole numbers of pixels, or the quality is not a number
            from 0 to 51.
    """

    cameras: tuple[str, ...] = CAMERAS[:1]
    size: tuple[int, int] | None = None
    quality: int = MP4_QUALITY

    name: ClassVar[str] = "clips"
    empty_reason: ClassVar[str] = (
        "no chosen agent has all images of the chosen cameras in any scenario; unpack the images, "
        "or choose other agents, cameras or scenarios"
    )

    def __post_init__(self) -> None:
        """Check the cameras, the size and the quality."""
        super().__post_init__()
        object.__setattr__(self, "cameras", check_names("cameras", self.cameras, CAMERAS))
        if self.size is not None:
            size = check_pixels("size", self.size, "width and height", (1, 1))
            object.__setattr__(self, "size", size)
        if self.quality not in range(52):
            raise ConfigError(f"quality: expected a number from 0 to 51, found {self.quality}")

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """Return the agents and cameras whose images decide what is written."""
        return tuple(product(self.agents, self.cameras))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """Return a unit for each scenario, with the number of its videos' folder in its name.

        Raises:
            ConfigError: If the images cannot have this size, or if a scenario and its twin are in
                different splits.
            MissingExtraError: If the extra `video` is not installed.
        """
        check_pyav("export clips")
        self._check_splits(dataset, scenarios)
        self._check_size(dataset, scenarios)
        units = []
        for token in scenarios:
            name = f"{dataset.getind('scenario', token):05d}-{flat_name(token)}"
            units.append(Unit(name=name, scenarios=(token,)))
        return units

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the videos of all recordings, and the rows of each into a part."""
        (scenario,) = unit.scenarios
        recorded_agents = agents_of(dataset, scenario)
        num_frames = dataset.scenario.get(scenario)["num_frames"]
        for agent in self.agents:
            if agent not in recorded_agents:
                output.leave_out("agents of scenarios that are not in this release")
                continue
            images = self._find_images(dataset, scenario, agent)
            if any(len(files) < num_frames for files in images.values()):
                output.leave_out("recordings that lack images in this release")
                continue
            self._write_recording(dataset, f"{scenario}/{agent}", images, output)

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Write the files that describe the episodes, which are numbered by split.

        Raises:
            ConfigError: If images of a camera have different sizes, and `size` is None.
        """
        paths = [parts(unit) / f"{agent}.parquet" for unit, agent in product(units, AGENTS)]
        episodes = [read_episode(path) for path in paths if path.exists()]
        splits = {record["split"] for _, record in episodes}
        order = [split for split in _SPLIT_ORDER if split in splits] or list(splits)
        episodes.sort(key=lambda episode: order.index(episode[1]["split"]))
        write_files(episodes, self.cameras, output)
        lines = [_BODY]
        for name, column in ROW_COLUMNS.items():
            numbers = f" ({', '.join(column.names)})" if column.names else ""
            lines.append(f"| `{name}`{numbers} | {column.doc} |")
        title = f"DeepAccident {dataset.version}: clips"
        text = "\n".join([*lines, ""])
        output.write(README, format_readme(self, dataset, title, {}, text))

    def _check_splits(self, dataset: Dataset, scenarios: Sequence[str]) -> None:
        splits: dict[str, str] = {}
        for token in scenarios:
            split = self._find_split(dataset, token)
            twin_split = splits.setdefault(dataset.scenario.get(token)["name"], split)
            if split != twin_split:
                raise ConfigError(
                    f"{token}: is in split {split}, but its twin is in {twin_split}, so a test "
                    "would not be fair; export one split (--split), or correct the split files"
                )

    def _find_split(self, dataset: Dataset, scenario: str) -> str:
        """Return a scenario's split; with a split file, the name of the file."""
        if self.split is not None and os.fspath(self.split).endswith(".txt"):
            return Path(self.split).stem
        return dataset.scenario.get(scenario)["split"] or _UNKNOWN_SPLIT

    def _check_size(self, dataset: Dataset, scenarios: Sequence[str]) -> None:
        """Check that the first image can have the size."""
        for scenario, agent in product(scenarios, self.agents):
            if agent in agents_of(dataset, scenario):
                for files in self._find_images(dataset, scenario, agent).values():
                    for path, _ in files.values():
                        self._choose_size(path)
                        return

    def _choose_size(self, path: ReleasePath) -> ImageSize:
        """Return the width and height of the pictures of an image's video."""
        size = fitting_size(self.size, image_size(path))
        width, height = size
        if width % 2 or height % 2:
            raise ConfigError(
                f"size: expected an even width and height, as MP4 requires, found {width}x{height};"
                " choose another size of the same aspect ratio (--size)"
            )
        return size

    def _find_images(self, dataset: Dataset, scenario: str, agent: str) -> dict[str, FrameFiles]:
        """Return the existing images of a recording by camera and frame."""
        images = {}
        for channel in self.cameras:
            files = sensor_files(dataset, scenario, agent, channel)
            images[channel] = dict(sorted(files.items()))
        return images

    def _write_recording(
        self, dataset: Dataset, token: str, images: dict[str, FrameFiles], output: Output
    ) -> None:
        """Write the videos and the rows of a recording with all its images.

        Args:
            dataset: The release.
            token: Token of the agent.
            images: Images by camera and frame.
            output: The folder.
        """
        clip = clip_rows(dataset, token)
        scenario, agent = token.rsplit("/", 1)
        split = self._find_split(dataset, scenario)
        scenario_row = dataset.getind("scenario", scenario)
        place = (scenario_row, AGENTS.index(agent))
        record: NamedValues = {**clip.episode, "split": split, "length": len(clip)}
        for channel, files in images.items():
            paths = [path for path, _ in files.values()]
            size = self._choose_size(paths[0])
            pixels: list[list[int]] = []
            path = video_path(channel, place)
            with output.file(path) as temporary:
                pictures = _read_pictures(paths, size, pixels)
                write_mp4(
                    temporary,
                    pictures,
                    FPS,
                    quality=self.quality,
                    preset=_PRESET,
                    keyframe_step=KEYFRAME_STEP,
                )
            record |= describe_video(channel, place, size, len(clip))
            record[f"pixels.{channel}"] = pixels
            for name, matrix in clip_cameras(dataset, token, [channel], size).items():
                record[name] = matrix.tolist()
        write_episode(output.parts / f"{agent}.parquet", clip, record)
        output.tally.samples += len(clip)


def _read_pictures(
    paths: Sequence[ReleasePath], size: ImageSize, pixels: list[list[int]]
) -> Iterator[ByteArray]:
    """Yield images as pictures of a size, resized by area, and collect some of their pixels.

    Raises SensorFileError if an image cannot be read or have this size.
    """
    import cv2

    column_step, row_step = (-(-side // _GRID_SIZE) for side in size)
    for number, path in enumerate(paths):
        content = read_image_bytes(path)
        fault = aspect_fault(size, image_size(path, content))
        if fault is not None:
            raise SensorFileError(f"{path}: {fault}")
        picture: Any = decode_image(path, content, min_size=size[::-1])
        if picture.shape[1::-1] != size:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        if number % FPS == 0:
            grid = picture[row_step // 2 :: row_step, column_step // 2 :: column_step]
            pixels += grid.reshape(-1, 3).tolist()
        yield picture
