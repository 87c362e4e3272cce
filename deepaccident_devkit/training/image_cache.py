"""Resized camera images in one file a scenario, read by training instead of the release's.

`CachedImages` is the format that `deepaccident cache` writes, `ImageCache` reads it.

A scenario's file has a head, a table with the position of each image, and the images. The head is
`_MAGIC`, then the numbers of rows and cameras as little-endian int64. A row is an agent at a frame.
The table (rows, cameras, 2) of such numbers has each image's first byte in the file and its length,
0 for an image that the release lacked.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

import msgspec
import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, ExportError, MissingFileError, SensorFileError
from deepaccident_devkit.export.bulk import Format, Manifest, Output, Unit, flat_name
from deepaccident_devkit.export.frames import sensor_files
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.release.fingerprints import scenario_hashes
from deepaccident_devkit.release.images import decode_image, encode_jpeg
from deepaccident_devkit.support.arrays import ByteArray, FloatArray, IntArray
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.reading import check_size, fault_text, mapped_file
from deepaccident_devkit.support.text import counted, path_of, settle_choices, size_text
from deepaccident_devkit.tables.tokens import sample_data_token, sample_token
from deepaccident_devkit.taxonomy import AgentName
from deepaccident_devkit.v2x.agents import agents_of

__all__ = ["CachedImages", "Codec", "ImageCache"]

Codec = Literal["raw", "jpeg"]
# Fields of `ImageConfig` that decide the content of a cache; the others can be chosen when it is
# read.
_STORED_FIELDS: Final = ("resize", "crop", "cameras", "decode")
_JPEG_QUALITY: Final = 95
_MAGIC: Final = b"DAimages"
_NUMBER_DTYPE: Final = np.dtype("<i8")
_HEAD_BYTES: Final = len(_MAGIC) + 2 * _NUMBER_DTYPE.itemsize
# Files that are mapped at the same time: each has a descriptor, and a process may have 1024 or
# fewer.
_MAX_OPEN_FILES: Final = 128


@dataclass(frozen=True, kw_only=True)
class CachedImages(Format):
    """Resized images, for `V2XConfig(images_cache=…)`.

    A split or a filter is required, because all scenarios take a terabyte.

    Attributes:
        images: Preparation of the images; `resize` is required, and `dtype`, `mean` and `std` do
            not matter.
        codec: `raw` pixels, or `jpeg` of quality 95: an eighth of the size or less, more time, and
            slightly different pixels.

    Raises:
        ConfigError: `images` has no `resize`.
        ChoiceError: There is no such codec.
    """

    images: ImageConfig
    codec: Codec = "raw"

    name: ClassVar[str] = "cache"
    nothing: ClassVar[str] = (
        "none of these images is in this release; unpack the archives that hold them"
    )

    def __post_init__(self) -> None:
        """Check the choices too."""
        super().__post_init__()
        settle_choices(self, {"codec": get_args(Codec)})
        if self.images.resize is None:
            raise ConfigError(
                "images: a cache holds images of one size; give ImageConfig(resize=(height, width))"
            )

    def settings(self) -> dict[str, Any]:
        """Return everything that decides the content of the files."""
        settings = super().settings()
        image_settings = settings["images"]
        stored_settings = {name: image_settings[name] for name in _STORED_FIELDS}
        return {**settings, "images": stored_settings}

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """Return the agents and cameras of the images."""
        return tuple(product(self.agents, self.images.cameras))

    def check(self, dataset: Dataset, folder: Path) -> None:
        """Refuse to write all scenarios; raises ConfigError."""
        if self.split is None and not self.where:
            size = len(dataset.sample) * len(self.images.cameras) * _pixel_count(self.images) * 3
            raise ConfigError(
                f"{folder}: all scenarios would take {size_text(size)} as raw images; choose a "
                "split or a filter (--split, --where)"
            )

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a scenario's file: all frames of one agent after another."""
        (scenario,) = unit.scenarios
        frames = dataset.scenario.get(scenario)["num_frames"]
        cameras = self.images.cameras
        present_frames = self._present_frames(dataset, scenario)

        def contents() -> Iterator[bytes | None]:
            for agent, number, camera in product(self.agents, range(1, frames + 1), cameras):
                if number in present_frames.get((agent, camera), ()):
                    token = _camera_token(scenario, agent, number, camera)
                    yield self._content(dataset, token)
                else:
                    yield None

        with output.file(_images_path(scenario)) as path:
            _write_images(path, len(self.agents) * frames, len(cameras), contents())
        samples = set[tuple[str, int]]()
        for (agent, _), numbers in present_frames.items():
            samples.update((agent, number) for number in numbers)
        output.tally.samples += len(samples)
        absent_agents = [
            agent for agent in self.agents if (agent, cameras[0]) not in present_frames
        ]
        expected_count = (len(self.agents) - len(absent_agents)) * frames * len(cameras)
        image_count = sum(map(len, present_frames.values()))
        output.leave_out("agents of scenarios that are not in this release", len(absent_agents))
        output.leave_out("images that are not in this release", expected_count - image_count)

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Do nothing, because no file spans scenarios."""

    def _present_frames(self, dataset: Dataset, scenario: str) -> dict[tuple[str, str], set[int]]:
        """Return the frames with images in the release, by agent of the release and camera."""
        agents = [agent for agent in agents_of(dataset, scenario) if agent in self.agents]
        frames: dict[tuple[str, str], set[int]] = {}
        for agent, camera in product(agents, self.images.cameras):
            frames[agent, camera] = set(sensor_files(dataset, scenario, agent, camera))
        return frames

    def _content(self, dataset: Dataset, camera: str) -> bytes:
        """Return the bytes of an image."""
        image, _ = self.images.load(dataset, camera)
        if self.codec == "jpeg":
            return encode_jpeg(dataset.sensor_path(camera), image, _JPEG_QUALITY)
        return np.ascontiguousarray(image.transpose(2, 0, 1)).tobytes()  # as models take it


class _Settings(msgspec.Struct):
    """The required settings of a cache."""

    images: ImageConfig
    codec: Codec
    agents: Annotated[tuple[AgentName, ...], msgspec.Meta(min_length=1)]
    version: str


class ImageCache:
    """A folder that `deepaccident cache` wrote.

    Files are mapped when they are needed; the cache is quick to pickle and to fork.

    Attributes:
        folder: Path of the folder.
        images: Preparation of its images, without `dtype`, `mean` and `std`.
        codec: `raw` or `jpeg`.
        agents: Agents with images in the cache.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Read its manifest; raises ConfigError if there is none, or if the cache is incomplete."""
        self.folder = path_of(folder).absolute()
        try:
            manifest = Manifest.read(self.folder, CachedImages.name)
            settings = as_record(manifest.settings, _Settings)
            missing_fields = set(_STORED_FIELDS) - manifest.settings["images"].keys()
            if missing_fields:
                raise ValueError(f"its images have no {min(missing_fields)}")
        except (ExportError, ValueError) as error:
            raise ConfigError(
                f"images_cache: {self.folder} holds no cache of images ({error}); make one with "
                "deepaccident cache"
            ) from error
        if manifest.release is None:
            raise ConfigError(
                f"images_cache: {self.folder} is not complete; run the deepaccident cache that "
                "makes it again, which continues it"
            )
        self.images, self._size = settings.images, _stored_size(settings.images)
        self.codec, self.agents, self._version = settings.codec, settings.agents, settings.version
        self._scenarios = manifest.release.scenarios
        self._file = lru_cache(_MAX_OPEN_FILES)(self._open_file)

    def __reduce__(self) -> tuple[Any, ...]:
        """Let another process open it again."""
        return type(self), (self.folder,)

    def __repr__(self) -> str:
        return (
            f"ImageCache({self.folder}, {counted(len(self._scenarios), 'scenario')}, {self.codec})"
        )

    def check(self, config: ImageConfig) -> None:
        """Refuse images that the cache does not have.

        It can crop images that it has without a crop, and leave out cameras.

        Raises:
            ConfigError: Its images were resized, cropped or decoded in another way, or it lacks a
                camera.
        """
        for name in _STORED_FIELDS:
            stored, requested = getattr(self.images, name), getattr(config, name)
            if name == "crop" and stored is None:
                continue
            if name == "cameras":
                is_available = set(requested) <= set(stored)
            else:
                is_available = stored == requested
            if not is_available:
                raise ConfigError(
                    f"images_cache: {self.folder} has {name}={stored!r}, wanted is {requested!r}; "
                    "choose the same, or make another cache"
                )

    def check_release(self, dataset: Dataset, agents: Sequence[str]) -> None:
        """Refuse another release, and agents without images in the cache.

        Only the hashes of one scenario's label, meta and calib files are compared: all of them
        would take minutes, and the command that wrote the cache compares them when it runs again.

        Args:
            dataset: The release.
            agents: Tokens of the agents of later images.

        Raises:
            ConfigError: The cache was written from another release, or another version or state of
                it, or lacks an agent.
            ReleaseError: A file cannot be read.
        """
        if self._version != dataset.version:
            raise self._other_release(f"version {self._version}, not {dataset.version}")
        for token in agents:
            self._scenario_and_agent(token)
        if agents:
            scenario = agents[0].rpartition("/")[0]
            hashes = scenario_hashes(dataset, [scenario], workers=1).get(scenario)
            stored_hashes = self._scenarios[scenario].items()
            if hashes is None or not hashes.as_dict().items() <= stored_hashes:
                raise self._other_release(f"another state of {scenario}")

    def has(self, camera: str) -> bool:
        """Return whether an image, by its token, was in the release when the cache was written.

        Raises as `load`.
        """
        file, row, column = self._location(camera)
        return file.has(row, column)

    def load(
        self, config: ImageConfig, dataset: Dataset, camera: str
    ) -> tuple[ByteArray, FloatArray]:
        """Return an image (h, w, 3) uint8 RGB and its intrinsic (3, 3), as `ImageConfig.load`.

        The image may be read-only.

        Raises:
            ConfigError: The cache lacks the scenario or the agent.
            MissingFileError: The release lacked the image when the cache was written.
            SensorFileError: The file cannot be read.
        """
        file, row, column = self._location(camera)
        content = file.image(row, column)
        if content is None:
            raise MissingFileError(
                f"{self.folder}: has no image {camera}, which the release lacked; unpack the "
                "archive that holds it and make the cache again, or leave out what is missing with "
                "on_missing='skip'"
            )
        image = self._decoded(content, camera)
        if self.images.crop is None:
            image = config.cropped(image)
        height, width = config.resize or self._size
        return image, config.intrinsic(dataset.camera(camera), (height, width))

    def _decoded(self, content: memoryview, camera: str) -> ByteArray:
        """Return the complete cached image (h, w, 3)."""
        height, width = self._size
        path = self.folder / _images_path(camera.rsplit("/", 3)[0])
        if self.codec == "jpeg":
            image = decode_image(path, bytes(content))
        elif len(content) == height * width * 3:
            values = np.frombuffer(content, dtype=np.uint8)
            image = values.reshape(3, height, width).transpose(1, 2, 0)
        else:
            image = np.zeros((0, 0, 3), dtype=np.uint8)
        if image.shape != (height, width, 3):
            raise SensorFileError(
                f"{path}: the image {camera} is not of {height} × {width}; remove the cache of "
                "images and make it again"
            )
        return image

    def _location(self, camera: str) -> tuple[_ImagesFile, int, int]:
        """Return the file of an image, and its row and column in the file."""
        agent, number, channel = camera.rsplit("/", 2)
        scenario, agent_index = self._scenario_and_agent(agent)
        file = self._file(scenario)
        frames = file.rows // len(self.agents)
        if int(number) > frames:
            raise self._other_release(f"{scenario} had {frames} frames")
        row = agent_index * frames + int(number) - 1
        return file, row, self.images.cameras.index(channel)

    def _scenario_and_agent(self, agent: str) -> tuple[str, int]:
        """Return the scenario of an agent's token, and the agent's index; raises ConfigError."""
        scenario, _, name = agent.rpartition("/")
        if scenario not in self._scenarios or name not in self.agents:
            raise ConfigError(
                f"images_cache: {self.folder} has no images of {agent}; choose other samples or "
                "agents, or make a cache that has them"
            )
        return scenario, self.agents.index(name)

    def _open_file(self, scenario: str) -> _ImagesFile:
        return _ImagesFile(self.folder / _images_path(scenario), len(self.images.cameras))

    def _other_release(self, reason: str) -> ConfigError:
        return ConfigError(
            f"images_cache: {self.folder} was made from another release ({reason}); make a cache "
            "of this one"
        )


def _write_images(path: Path, rows: int, cameras: int, images: Iterable[bytes | None]) -> None:
    """Write a file; the images are ordered by row, then camera, and None for missing ones."""
    table = np.zeros((rows, cameras, 2), dtype=_NUMBER_DTYPE)
    counts = np.array([rows, cameras], dtype=_NUMBER_DTYPE)
    with path.open("wb") as file:
        file.write(_MAGIC + counts.tobytes() + table.tobytes())
        for index, content in zip(np.ndindex(rows, cameras), images, strict=True):
            if content is not None:
                table[index] = file.tell(), len(content)
                file.write(content)
        file.seek(_HEAD_BYTES)
        file.write(table.tobytes())


class _ImagesFile:
    """A file, mapped into memory. It is not pickled; other processes open it themselves.

    Attributes:
        rows: Number of rows, which are agents at frames.
    """

    def __init__(self, path: Path, cameras: int) -> None:
        """Map a file; raises SensorFileError if it is missing, incomplete or of other cameras."""
        try:
            self._bytes: Any = memoryview(mapped_file(path)).cast("B")
            self._table = self._read_table(cameras)
        except (OSError, ValueError) as error:
            raise SensorFileError(
                f"{path}: {fault_text(error)}; remove the cache of images and make it again"
            ) from error
        self.rows = len(self._table)

    def image(self, row: int, camera: int) -> memoryview | None:
        """Return the bytes of an image without copying; None if the release lacked it."""
        start, length = self._table[row, camera].tolist()
        return self._bytes[start : start + length] if length else None

    def has(self, row: int, camera: int) -> bool:
        """Return whether an image is in the file."""
        return bool(self._table[row, camera, 1])

    def _read_table(self, expected_cameras: int) -> IntArray:
        """Return the checked table; raises ValueError or OSError."""
        size = len(self._bytes)
        if size < _HEAD_BYTES or self._bytes[: len(_MAGIC)] != _MAGIC:
            raise ValueError("is no file of cached images")
        counts = np.frombuffer(self._bytes, dtype=_NUMBER_DTYPE, offset=len(_MAGIC), count=2)
        rows, cameras = counts.tolist()
        if cameras != expected_cameras:
            raise ValueError(f"has {cameras} cameras, and its cache {expected_cameras}")
        number_count = rows * cameras * 2
        end = _HEAD_BYTES + number_count * _NUMBER_DTYPE.itemsize
        check_size(end, "bundle", "its table")
        if rows < 0 or end > size:
            raise ValueError("is cut off")
        numbers = np.frombuffer(
            self._bytes, dtype=_NUMBER_DTYPE, offset=_HEAD_BYTES, count=number_count
        )
        table = numbers.reshape(rows, cameras, 2)
        if table.size and (table.min() < 0 or table.max() > size or table.sum(axis=2).max() > size):
            raise ValueError("is cut off")
        check_size(int(table[..., 1].max(initial=0)), "image", "an image")
        return table.astype(np.int64, copy=False)


def _images_path(scenario: str) -> str:
    """Return the path of a scenario's file in a cache's folder."""
    return f"{flat_name(scenario)}.images"


def _stored_size(images: ImageConfig) -> tuple[int, int]:
    """Return the height and width of a cache's images; `resize` must be given."""
    height, width = images.resize or (0, 0)
    return (height, width) if images.crop is None else images.crop[2:]


def _pixel_count(images: ImageConfig) -> int:
    height, width = _stored_size(images)
    return height * width


def _camera_token(scenario: str, agent: str, number: int, camera: str) -> str:
    return sample_data_token(sample_token(scenario, agent, number), camera)
