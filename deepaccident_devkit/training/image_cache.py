"""Resized camera images in one file per scenario, which training reads instead of the release.

`CachedImages` is the format that `deepaccident cache` writes, and `ImageCache` reads it.

A scenario's file has a header, a table of image positions, and the images. The header is `_MAGIC`,
then the numbers of rows and cameras as little-endian int64. A row is one agent in one frame. The
int64 table (rows, cameras, 2) has the offset of each image in the file and its length in bytes,
which is 0 if the release lacked the image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

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
from deepaccident_devkit.support.text import PathType, counted, path_of, settle_choices, size_text
from deepaccident_devkit.tables.tokens import sample_data_token, sample_token
from deepaccident_devkit.taxonomy import AgentName
from deepaccident_devkit.v2x.agents import agents_of

__all__ = ["CachedImages", "Codec", "ImageCache"]

Codec = Literal["raw", "jpeg"]
# Fields of `ImageConfig` that determine the content of a cache; the others can be chosen when the
# cache is read.
_STORED_FIELDS = ("resize", "crop", "cameras", "decode")
_JPEG_QUALITY = 95
_MAGIC = b"DAimages"
_NUMBER_DTYPE = np.dtype("<i8")
_HEAD_BYTES = len(_MAGIC) + 2 * _NUMBER_DTYPE.itemsize
# Largest number of files that are mapped at the same time: each needs a file descriptor, and a
# process may be limited to 1024.
_MAX_OPEN_FILES = 128


@dataclass(frozen=True, kw_only=True)
class CachedImages(Format):
    """Resized images, for `V2XConfig(images_cache=…)`.

    A split or a filter is required, because all scenarios take a terabyte.

    Attributes:
        images: Preparation of the images; `resize` is required, and `dtype`, `mean` and `std` do
            not matter.
        codec: `raw` pixels, or `jpeg` of quality 95, which takes at most an eighth of the size,
            more time, and changes pixels slightly.

    Raises:
        ConfigError: If `images` has no `resize`.
        ChoiceError: If there is no such codec.
    """

    images: ImageConfig
    codec: Codec = "raw"

    name: ClassVar[str] = "cache"
    empty_reason: ClassVar[str] = (
        "none of these images is in this release; unpack the archives that contain them"
    )

    def __post_init__(self) -> None:
        """Check the images and the codec, after the checks of every format."""
        super().__post_init__()
        settle_choices(self, {"codec": get_args(Codec)})
        if self.images.resize is None:
            raise ConfigError(
                "images: a cache has images of one size; give ImageConfig(resize=(height, width))"
            )

    def settings(self) -> dict[str, Any]:
        """Return all settings that determine the content of the files."""
        settings = super().settings()
        image_settings = settings["images"]
        stored_settings = {name: image_settings[name] for name in _STORED_FIELDS}
        return settings | {"images": stored_settings}

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """Return (agent, camera) of all images."""
        return tuple(product(self.agents, self.images.cameras))

    def check(self, dataset: Dataset, folder: Path) -> None:
        """Raise ConfigError if all scenarios were selected, because they are too large."""
        if self.split is None and not self.where:
            image_count = len(dataset.sample) * len(self.images.cameras)
            height, width = _stored_size(self.images)
            size = image_count * height * width * 3
            raise ConfigError(
                f"{folder}: all scenarios would take {size_text(size)} as raw images; choose a "
                "split or a filter (--split, --where)"
            )

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a scenario's file: the frames of each agent, one agent after another."""
        (scenario,) = unit.scenarios
        frame_count = dataset.scenario.get(scenario)["num_frames"]
        cameras = self.images.cameras
        present_frames = self._present_frames(dataset, scenario)

        def image_contents() -> Iterator[bytes | None]:
            numbers = range(1, frame_count + 1)
            for agent, number, camera in product(self.agents, numbers, cameras):
                if number in present_frames.get((agent, camera), ()):
                    token = sample_data_token(sample_token(scenario, agent, number), camera)
                    yield self._content(dataset, token)
                else:
                    yield None

        with output.file(_images_path(scenario)) as path:
            _write_images(path, len(self.agents) * frame_count, len(cameras), image_contents())
        samples: set[tuple[str, int]] = set()
        present_agents = set()
        image_count = 0
        for (agent, _), numbers in present_frames.items():
            present_agents.add(agent)
            image_count += len(numbers)
            samples.update(product([agent], numbers))
        output.tally.samples += len(samples)
        absent_count = len(self.agents) - len(present_agents)
        expected_count = len(present_agents) * frame_count * len(cameras)
        output.leave_out("agents of scenarios that are not in this release", absent_count)
        output.leave_out("images that are not in this release", expected_count - image_count)

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Do nothing, because no file spans scenarios."""

    def _present_frames(self, dataset: Dataset, scenario: str) -> dict[tuple[str, str], set[int]]:
        """Return (agent, camera) → numbers of the frames whose images exist in the release.

        Agents that are not in the release are left out.
        """
        frames: dict[tuple[str, str], set[int]] = {}
        for agent, camera in product(agents_of(dataset, scenario), self.images.cameras):
            if agent in self.agents:
                frames[agent, camera] = set(sensor_files(dataset, scenario, agent, camera))
        return frames

    def _content(self, dataset: Dataset, camera: str) -> bytes:
        """Return the bytes to store for an image."""
        image, _ = self.images.load(dataset, camera)
        if self.codec == "jpeg":
            return encode_jpeg(dataset.sensor_path(camera), image, _JPEG_QUALITY)
        return np.ascontiguousarray(image.transpose(2, 0, 1)).tobytes()  # as models expect


class _Settings(msgspec.Struct):
    """The settings that a cache must have."""

    images: ImageConfig
    codec: Codec
    agents: Annotated[tuple[AgentName, ...], msgspec.Meta(min_length=1)]
    version: str


class ImageCache:
    """The images in a folder that `deepaccident cache` wrote.

    Files are mapped when they are first needed; the cache is cheap to pickle and to fork.

    Attributes:
        folder: Path of the folder.
        images: Preparation of the images, without `dtype`, `mean` and `std`.
        codec: `raw` or `jpeg`.
        agents: Agents with images in the cache.
    """

    def __init__(self, folder: PathType) -> None:
        """Read the manifest of the cache.

        Raises:
            ConfigError: If the manifest is missing or damaged, or the cache is incomplete.
        """
        self.folder = path_of(folder).absolute()
        try:
            manifest = Manifest.read(self.folder, CachedImages.name)
            settings = as_record(manifest.settings, _Settings)
            missing_fields = set(_STORED_FIELDS) - manifest.settings["images"].keys()
            if missing_fields:
                raise ValueError(f"its images have no {min(missing_fields)}")
        except (ExportError, ValueError) as error:
            raise ConfigError(
                f"images_cache: {self.folder} contains no cache of images ({error}); make one with "
                "deepaccident cache"
            ) from error
        if manifest.release is None:
            raise ConfigError(
                f"images_cache: {self.folder} is not complete; run the same deepaccident cache "
                "command again to continue it"
            )
        self.images = settings.images
        self.codec = settings.codec
        self.agents = settings.agents
        self._version = settings.version
        self._size = _stored_size(settings.images)
        self._scenarios = manifest.release.scenarios
        self._file = lru_cache(_MAX_OPEN_FILES)(self._open_file)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the folder, so that another process opens the cache again."""
        return type(self), (self.folder,)

    def __repr__(self) -> str:
        scenarios = counted(len(self._scenarios), "scenario")
        return f"ImageCache({self.folder}, {scenarios}, {self.codec})"

    def check(self, config: ImageConfig) -> None:
        """Check that the cache has the images for a configuration.

        Images that are stored uncropped can still be cropped, and cameras can be left out.

        Raises:
            ConfigError: If the images in the cache were resized, cropped or decoded differently, or
                the cache lacks a camera.
        """
        for name in _STORED_FIELDS:
            stored = getattr(self.images, name)
            requested = getattr(config, name)
            if name == "crop" and stored is None:
                continue
            if name == "cameras":
                is_available = set(requested) <= set(stored)
            else:
                is_available = stored == requested
            if not is_available:
                raise ConfigError(
                    f"images_cache: {self.folder} has {name}={stored!r}, expected {requested!r}; "
                    "choose the same, or make another cache"
                )

    def check_release(self, dataset: Dataset, agents: Sequence[str]) -> None:
        """Check that the cache was written from this release and has images of these agents.

        Only the hashes of one scenario's label, meta and calib files are compared. Comparing all of
        them would take minutes; `deepaccident cache` does so when it runs again.

        Args:
            dataset: The release.
            agents: Tokens of the agents whose images will be loaded.

        Raises:
            ConfigError: If the cache was written from another release, version or state of the
                release, or lacks an agent.
            ReleaseError: If a file cannot be read.
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
        """Return whether the release had the image `camera` (a token) when the cache was written.

        ConfigError and SensorFileError are raised as by `load`.
        """
        file, row, column = self._location(camera)
        return file.has(row, column)

    def load(
        self, config: ImageConfig, dataset: Dataset, camera: str
    ) -> tuple[ByteArray, FloatArray]:
        """Return an image (h, w, 3) uint8 RGB and its K (3, 3), like `ImageConfig.load`.

        The image may be read-only.

        Raises:
            ConfigError: If the cache lacks the scenario or the agent.
            MissingFileError: If the release lacked the image when the cache was written.
            SensorFileError: If the file cannot be read.
        """
        file, row, column = self._location(camera)
        content = file.image(row, column)
        if content is None:
            raise MissingFileError(
                f"{self.folder}: has no image {camera}, which was missing in the release; unpack "
                "the archive that contains it and make the cache again, or skip missing files with "
                "on_missing='skip'"
            )
        image = self._decode(content, camera)
        if self.images.crop is None:
            image = config.cropped(image)
        height, width = config.resize or self._size
        return image, config.intrinsic(dataset.camera(camera), (height, width))

    def _decode(self, content: memoryview, camera: str) -> ByteArray:
        """Decode the bytes of an image, before any crop, to shape (h, w, 3)."""
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
                f"{path}: the image {camera} does not have {height} × {width} pixels; remove the "
                "cache of images and make it again"
            )
        return image

    def _location(self, camera: str) -> tuple[_ImagesFile, int, int]:
        """Return the file of an image, and its row and column in the file's table."""
        agent, number, channel = camera.rsplit("/", 2)
        scenario, agent_index = self._scenario_and_agent(agent)
        file = self._file(scenario)
        frame_count = file.rows // len(self.agents)
        frame = int(number)
        if frame > frame_count:
            raise self._other_release(f"{scenario} had {frame_count} frames")
        row = agent_index * frame_count + frame - 1
        return file, row, self.images.cameras.index(channel)

    def _scenario_and_agent(self, agent: str) -> tuple[str, int]:
        """Return an agent token's scenario and index; raise ConfigError if it has no images."""
        scenario, _, name = agent.rpartition("/")
        if scenario not in self._scenarios or name not in self.agents:
            raise ConfigError(
                f"images_cache: {self.folder} has no images of {agent}; choose other samples or "
                "agents, or make a cache that has them"
            )
        return scenario, self.agents.index(name)

    def _open_file(self, scenario: str) -> _ImagesFile:
        path = self.folder / _images_path(scenario)
        return _ImagesFile(path, len(self.images.cameras))

    def _other_release(self, reason: str) -> ConfigError:
        return ConfigError(
            f"images_cache: {self.folder} was made from another release ({reason}); make a cache "
            "of this one"
        )


def _write_images(path: Path, rows: int, cameras: int, images: Iterable[bytes | None]) -> None:
    """Write a scenario's file of images.

    Args:
        path: Path of the file.
        rows: Number of rows.
        cameras: Number of cameras.
        images: Encoded images by row, then by camera; None for a missing image.
    """
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
    """A scenario's file of camera images, mapped into memory.

    This object is not pickled; other processes open the file themselves.

    Attributes:
        rows: Number of rows; a row is one agent in one frame.
    """

    def __init__(self, path: Path, cameras: int) -> None:
        """Map a file.

        Raises:
            SensorFileError: If the file is missing or incomplete, or its number of cameras is
                wrong.
        """
        try:
            self._bytes: Any = memoryview(mapped_file(path)).cast("B")
            self._table = self._read_table(cameras)
        except (OSError, ValueError) as error:
            raise SensorFileError(
                f"{path}: {fault_text(error)}; remove the cache of images and make it again"
            ) from error
        self.rows = len(self._table)

    def image(self, row: int, camera: int) -> memoryview | None:
        """Return a view of an image's bytes; None if the release lacked the image."""
        start, length = self._table[row, camera].tolist()
        if not length:
            return None
        content: memoryview = self._bytes[start : start + length]
        return content

    def has(self, row: int, camera: int) -> bool:
        """Return whether an image is in the file."""
        return bool(self._table[row, camera, 1])

    def _read_table(self, expected_cameras: int) -> IntArray:
        """Return the checked table; raise ValueError or OSError if the file is damaged."""
        size = len(self._bytes)
        if size < _HEAD_BYTES or self._bytes[: len(_MAGIC)] != _MAGIC:
            raise ValueError("is not a file of cached images")
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
    """Return the height and width of a cache's images, which have a `resize`."""
    if images.crop is not None:
        return images.crop[2:]
    return images.resize or (0, 0)
