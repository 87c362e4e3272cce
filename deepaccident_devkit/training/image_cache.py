"""Camera images, resized once and kept in a file for each scenario: training reads them in place of the release's.

`CachedImages` is the format that `deepaccident cache` writes, `ImageCache` reads it.

A scenario's file is a head, a table of where each image lies, and the images. The head is `_MAGIC`, then the numbers of
rows and cameras as little-endian int64. A row is an agent at a frame. The table (rows, cameras, 2) of such numbers has
each image's first byte in the file and its length, 0 for an image that the release lacked.
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
# Fields of `ImageConfig` that decide what is in a cache; the others can be chosen when it is read.
_KEPT: Final = ("resize", "crop", "cameras", "decode")
_JPEG_QUALITY: Final = 95
_MAGIC: Final = b"DAimages"
_NUMBER: Final = np.dtype("<i8")
_HEAD: Final = len(_MAGIC) + 2 * _NUMBER.itemsize
# Files that are mapped at once: each has a descriptor, of which a process may have 1024 or fewer.
_MOST_OPEN: Final = 128


@dataclass(frozen=True, kw_only=True)
class CachedImages(Format):
    """Resized images, for `V2XConfig(images_cache=…)`. A split or a filter is required: all scenarios take a terabyte.

    Attributes:
        images: how they are prepared; `resize` is required, and `dtype`, `mean` and `std` do not matter.
        codec: `raw` pixels, or `jpeg` of quality 95: an eighth of the room or less, more time, and other pixels.

    Raises:
        ConfigError: `images` has no `resize`.
        ChoiceError: no such codec.
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
        """Everything that decides what is written."""
        found = super().settings()
        return {**found, "images": {name: found["images"][name] for name in _KEPT}}

    def sensors(self) -> tuple[tuple[str, str], ...]:
        """The images that are kept."""
        return tuple(product(self.agents, self.images.cameras))

    def check(self, dataset: Dataset, folder: Path) -> None:
        """Refuse to write all scenarios; raises ConfigError."""
        if self.split is None and not self.where:
            size = len(dataset.sample) * len(self.images.cameras) * _pixels(self.images) * 3
            raise ConfigError(
                f"{folder}: all scenarios would take {size_text(size)} as raw images; choose a split or a filter "
                "(--split, --where)"
            )

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a scenario's file: all frames of the first agent, then of the next one."""
        (scenario,) = unit.scenarios
        frames = dataset.scenario.get(scenario)["num_frames"]
        there = self._there(dataset, scenario)

        def contents() -> Iterator[bytes | None]:
            for agent, number, camera in product(
                self.agents, range(1, frames + 1), self.images.cameras
            ):
                has = number in there.get((agent, camera), ())
                yield (
                    self._content(dataset, _camera_token(scenario, agent, number, camera))
                    if has
                    else None
                )

        with output.file(_images_path(scenario)) as path:
            _write_images(path, len(self.agents) * frames, len(self.images.cameras), contents())
        output.tally.samples += len(
            {(agent, number) for (agent, _), numbers in there.items() for number in numbers}
        )
        absent = [agent for agent in self.agents if (agent, self.images.cameras[0]) not in there]
        wanted = (len(self.agents) - len(absent)) * frames * len(self.images.cameras)
        output.leave_out("agents of scenarios that are not in this release", len(absent))
        output.leave_out(
            "images that are not in this release", wanted - sum(map(len, there.values()))
        )

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Nothing spans scenarios."""

    def _there(self, dataset: Dataset, scenario: str) -> dict[tuple[str, str], set[int]]:
        """Agent of the release and camera → frames whose images are in it."""
        here = [agent for agent in agents_of(dataset, scenario) if agent in self.agents]
        return {
            (agent, camera): set(sensor_files(dataset, scenario, agent, camera))
            for agent, camera in product(here, self.images.cameras)
        }

    def _content(self, dataset: Dataset, camera: str) -> bytes:
        image, _ = self.images.load(dataset, camera)
        if self.codec == "jpeg":
            return encode_jpeg(dataset.sensor_path(camera), image, _JPEG_QUALITY)
        return np.ascontiguousarray(image.transpose(2, 0, 1)).tobytes()  # as models take it


class _Settings(msgspec.Struct):
    """What is needed of the settings of a cache."""

    images: ImageConfig
    codec: Codec
    agents: Annotated[tuple[AgentName, ...], msgspec.Meta(min_length=1)]
    version: str


class ImageCache:
    """A folder that `deepaccident cache` wrote. Files are mapped when asked for; it is quick to pickle and to fork.

    Attributes:
        folder: where it is.
        images: how its images were prepared; `dtype`, `mean` and `std` are not in it.
        codec: `raw` or `jpeg`.
        agents: whose images it has.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Read its manifest; raises ConfigError if there is none, or if the cache is not complete."""
        self.folder = path_of(folder).absolute()
        try:
            manifest = Manifest.read(self.folder, CachedImages.name)
            settings = as_record(manifest.settings, _Settings)
            if absent := set(_KEPT) - manifest.settings["images"].keys():
                raise ValueError(f"its images have no {min(absent)}")
        except (ExportError, ValueError) as error:
            raise ConfigError(
                f"images_cache: {self.folder} holds no cache of images ({error}); make one with deepaccident cache"
            ) from error
        if manifest.release is None:
            raise ConfigError(
                f"images_cache: {self.folder} is not complete; run the deepaccident cache that makes it again, which "
                "continues it"
            )
        self.images, self._size = settings.images, _stored_size(settings.images)
        self.codec, self.agents, self._version = settings.codec, settings.agents, settings.version
        self._scenarios = manifest.release.scenarios
        self._file = lru_cache(_MOST_OPEN)(self._opened)

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process opens it again."""
        return type(self), (self.folder,)

    def __repr__(self) -> str:
        return (
            f"ImageCache({self.folder}, {counted(len(self._scenarios), 'scenario')}, {self.codec})"
        )

    def check(self, config: ImageConfig) -> None:
        """Refuse images that it cannot give. It can crop those that it has whole, and leave out cameras.

        Raises:
            ConfigError: its images were resized, cropped or decoded in another way, or it lacks a camera.
        """
        for name in _KEPT:
            has, wanted = getattr(self.images, name), getattr(config, name)
            if name == "crop" and has is None:
                continue
            if not set(wanted) <= set(has) if name == "cameras" else has != wanted:
                raise ConfigError(
                    f"images_cache: {self.folder} has {name}={has!r}, wanted is {wanted!r}; choose the same, or make "
                    "another cache"
                )

    def check_release(self, dataset: Dataset, agents: Sequence[str]) -> None:
        """Refuse another release, and agents whose images are not in it.

        The hashes of one scenario's label, meta and calib files are compared: all would take minutes, and the command
        that made the cache compares them when it runs again.

        Args:
            dataset: the release.
            agents: tokens of agents whose images will be asked for.

        Raises:
            ConfigError: it was made from another release, or another version or state of it, or lacks an agent.
            ReleaseError: a file cannot be read.
        """
        if self._version != dataset.version:
            raise self._other_release(f"version {self._version}, not {dataset.version}")
        for token in agents:
            self._row_of(token)
        if agents:
            scenario = agents[0].rpartition("/")[0]
            now = scenario_hashes(dataset, [scenario], workers=1).get(scenario)
            if now is None or not now.as_dict().items() <= self._scenarios[scenario].items():
                raise self._other_release(f"another state of {scenario}")

    def has(self, camera: str) -> bool:
        """Whether an image, by its token, was in the release when the cache was made; raises as `load` does."""
        file, row, column = self._located(camera)
        return file.has(row, column)

    def load(
        self, config: ImageConfig, dataset: Dataset, camera: str
    ) -> tuple[ByteArray, FloatArray]:
        """An image (h, w, 3) uint8 RGB, perhaps read-only, and its intrinsic (3, 3): as `ImageConfig.load` gives them.

        Raises:
            ConfigError: the cache lacks the scenario or the agent.
            MissingFileError: the release lacked the image when the cache was made.
            SensorFileError: the file cannot be read.
        """
        file, row, column = self._located(camera)
        content = file.image(row, column)
        if content is None:
            raise MissingFileError(
                f"{self.folder}: has no image {camera}, which the release lacked; unpack the archive that holds it and "
                "make the cache again, or leave out what is missing with on_missing='skip'"
            )
        image = self._decoded(content, camera)
        if self.images.crop is None:
            image = config.cropped(image)
        height, width = config.resize or self._size
        return image, config.intrinsic(dataset.camera(camera), (height, width))

    def _decoded(self, content: memoryview, camera: str) -> ByteArray:
        """The whole cached image (h, w, 3)."""
        height, width = self._size
        path = self.folder / _images_path(camera.rsplit("/", 3)[0])
        if self.codec == "jpeg":
            image = decode_image(path, bytes(content))
        elif len(content) == height * width * 3:
            image = (
                np.frombuffer(content, dtype=np.uint8).reshape(3, height, width).transpose(1, 2, 0)
            )
        else:
            image = np.zeros((0, 0, 3), dtype=np.uint8)
        if image.shape != (height, width, 3):
            raise SensorFileError(
                f"{path}: the image {camera} is not of {height} × {width}; remove the cache of images and make it again"
            )
        return image

    def _located(self, camera: str) -> tuple[_ImagesFile, int, int]:
        """The file of an image, and its row and column there."""
        agent, number, channel = camera.rsplit("/", 2)
        scenario, first = self._row_of(agent)
        file = self._file(scenario)
        frames = file.rows // len(self.agents)
        if int(number) > frames:
            raise self._other_release(f"{scenario} had {frames} frames")
        return file, first * frames + int(number) - 1, self.images.cameras.index(channel)

    def _row_of(self, agent: str) -> tuple[str, int]:
        """The scenario of an agent's token, and which agent it is; raises ConfigError."""
        scenario, _, name = agent.rpartition("/")
        if scenario not in self._scenarios or name not in self.agents:
            raise ConfigError(
                f"images_cache: {self.folder} has no images of {agent}; choose other samples or agents, or make a "
                "cache that has them"
            )
        return scenario, self.agents.index(name)

    def _opened(self, scenario: str) -> _ImagesFile:
        return _ImagesFile(self.folder / _images_path(scenario), len(self.images.cameras))

    def _other_release(self, why: str) -> ConfigError:
        return ConfigError(
            f"images_cache: {self.folder} was made from another release ({why}); make a cache of this one"
        )


def _write_images(path: Path, rows: int, cameras: int, images: Iterable[bytes | None]) -> None:
    """Write a file; the images are ordered by row, then camera, None for one that is not there."""
    table = np.zeros((rows, cameras, 2), dtype=_NUMBER)
    with path.open("wb") as file:
        file.write(_MAGIC + np.array([rows, cameras], dtype=_NUMBER).tobytes() + table.tobytes())
        for place, content in zip(np.ndindex(rows, cameras), images, strict=True):
            if content is not None:
                table[place] = file.tell(), len(content)
                file.write(content)
        file.seek(_HEAD)
        file.write(table.tobytes())


class _ImagesFile:
    """A file, mapped into memory. It is not pickled; who needs it elsewhere opens it there.

    Attributes:
        rows: agents at frames.
    """

    def __init__(self, path: Path, cameras: int) -> None:
        """Map it; raises SensorFileError if it is not there, not whole, or not of so many cameras."""
        try:
            self._bytes: Any = memoryview(mapped_file(path)).cast("B")
            self._table = self._checked_table(cameras)
        except (OSError, ValueError) as error:
            raise SensorFileError(
                f"{path}: {fault_text(error)}; remove the cache of images and make it again"
            ) from error
        self.rows = len(self._table)

    def image(self, row: int, camera: int) -> memoryview | None:
        """The bytes of an image, not copied; None if the release lacked it."""
        start, length = self._table[row, camera].tolist()
        return self._bytes[start : start + length] if length else None

    def has(self, row: int, camera: int) -> bool:
        """Whether an image is in it."""
        return bool(self._table[row, camera, 1])

    def _checked_table(self, wanted: int) -> IntArray:
        """The table; raises ValueError or OSError."""
        if len(self._bytes) < _HEAD or self._bytes[: len(_MAGIC)] != _MAGIC:
            raise ValueError("is no file of cached images")
        rows, cameras = np.frombuffer(
            self._bytes, dtype=_NUMBER, offset=len(_MAGIC), count=2
        ).tolist()
        if cameras != wanted:
            raise ValueError(f"has {cameras} cameras, and its cache {wanted}")
        end = _HEAD + rows * cameras * 2 * _NUMBER.itemsize
        check_size(end, "bundle", "its table")
        if rows < 0 or end > len(self._bytes):
            raise ValueError("is cut off")
        table = np.frombuffer(self._bytes, dtype=_NUMBER, offset=_HEAD, count=rows * cameras * 2)
        table = table.reshape(rows, cameras, 2)
        if table.size and (
            table.min() < 0
            or table.max() > len(self._bytes)
            or table.sum(axis=2).max() > len(self._bytes)
        ):
            raise ValueError("is cut off")
        check_size(int(table[..., 1].max(initial=0)), "image", "an image")
        return table.astype(np.int64, copy=False)


def _images_path(scenario: str) -> str:
    """The file of a scenario, in a cache's folder."""
    return f"{flat_name(scenario)}.images"


def _stored_size(images: ImageConfig) -> tuple[int, int]:
    """Height and width of a cache's images; `resize` must be there."""
    height, width = images.resize or (0, 0)
    return (height, width) if images.crop is None else images.crop[2:]


def _pixels(images: ImageConfig) -> int:
    height, width = _stored_size(images)
    return height * width


def _camera_token(scenario: str, agent: str, number: int, camera: str) -> str:
    return sample_data_token(sample_token(scenario, agent, number), camera)
