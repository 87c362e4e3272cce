"""`ImageCache`: images out of a cache's folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Any, Final

import msgspec
import numpy as np

from deepaccident_devkit.arrays import ByteArray, FloatArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, ExportError, MissingFileError, SensorFileError
from deepaccident_devkit.export.bulk.manifest import Manifest
from deepaccident_devkit.export.image_cache.file import ImagesFile
from deepaccident_devkit.export.image_cache.format import KEPT, NAME, Codec, images_path, stored_size
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.files import path_of
from deepaccident_devkit.json_text import as_record
from deepaccident_devkit.release.fingerprints import scenario_hashes
from deepaccident_devkit.release.images import decode_image
from deepaccident_devkit.taxonomy import AgentName

_MOST_OPEN: Final = 128
"""Files that are mapped at once: each has a descriptor, of which a process may have 1024 or fewer."""


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
            manifest = Manifest.read(self.folder, NAME)
            settings = as_record(manifest.settings, _Settings)
            if absent := set(KEPT) - manifest.settings["images"].keys():
                raise ValueError(f"its images have no {min(absent)}")
        except (ExportError, ValueError) as error:
            raise ConfigError(
                f"images_cache: {self.folder} holds no cache of images ({error}); make one with deepaccident cache"
            ) from error
        if not manifest.complete:
            raise ConfigError(
                f"images_cache: {self.folder} is not complete; run the deepaccident cache that makes it again, which "
                "continues it"
            )
        self.images, self._size = settings.images, stored_size(settings.images)
        self.codec, self.agents, self._version = settings.codec, settings.agents, settings.version
        self._scenarios = manifest.scenarios
        self._file = lru_cache(_MOST_OPEN)(self._opened)

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process opens it again."""
        return type(self), (self.folder,)

    def __repr__(self) -> str:
        return f"ImageCache({self.folder}, {len(self._scenarios)} scenarios, {self.codec})"

    def check(self, config: ImageConfig) -> None:
        """Refuse images that it cannot give. It can crop those that it has whole, and leave out cameras.

        Raises:
            ConfigError: its images were resized, cropped or decoded in another way, or it lacks a camera.
        """
        for name in KEPT:
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

    def load(self, config: ImageConfig, dataset: Dataset, camera: str) -> tuple[ByteArray, FloatArray]:
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
        path = self.folder / images_path(camera.rsplit("/", 3)[0])
        if self.codec == "jpeg":
            image = decode_image(path, bytes(content))
        elif len(content) == height * width * 3:
            image = np.frombuffer(content, dtype=np.uint8).reshape(3, height, width).transpose(1, 2, 0)
        else:
            image = np.zeros((0, 0, 3), dtype=np.uint8)
        if image.shape != (height, width, 3):
            raise SensorFileError(
                f"{path}: the image {camera} is not of {height} × {width}; remove the cache of images and make it again"
            )
        return image

    def _located(self, camera: str) -> tuple[ImagesFile, int, int]:
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

    def _opened(self, scenario: str) -> ImagesFile:
        return ImagesFile(self.folder / images_path(scenario), len(self.images.cameras))

    def _other_release(self, why: str) -> ConfigError:
        return ConfigError(
            f"images_cache: {self.folder} was made from another release ({why}); make a cache of this one"
        )
