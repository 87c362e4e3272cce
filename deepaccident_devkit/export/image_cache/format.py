"""`CachedImages`: resized camera images, a file for each scenario."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.bulk import Format, Output, Plan, Unit, flat_name
from deepaccident_devkit.export.image_cache.file import file_bytes, write_images
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.sensor_files import sensor_files
from deepaccident_devkit.release.images import encode_jpeg
from deepaccident_devkit.tables.tokens import sample_data_token, sample_token
from deepaccident_devkit.text import choice, size_text
from deepaccident_devkit.v2x.configurations import agents_of

Codec = Literal["raw", "jpeg"]
NAME: Final = "cache"
KEPT: Final = ("resize", "crop", "cameras", "decode")
"""Fields of `ImageConfig` that decide what is in a cache; the others can be chosen when it is read."""
_JPEG_QUALITY: Final = 95


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

    name: ClassVar[str] = NAME
    nothing: ClassVar[str] = "none of these images is in this release; unpack the archives that hold them"

    def __post_init__(self) -> None:
        """Check the choices too."""
        super().__post_init__()
        object.__setattr__(self, "codec", choice("codec", self.codec, get_args(Codec)))
        if self.images.resize is None:
            raise ConfigError("images: a cache holds images of one size; give ImageConfig(resize=(height, width))")

    def settings(self) -> dict[str, Any]:
        """Everything that decides what is written."""
        found = super().settings()
        return {**found, "images": {name: found["images"][name] for name in KEPT}}

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

    def plan(self, dataset: Dataset, unit: Unit) -> Plan:
        """By the number of images that are there, and for JPEG by the size of one."""
        (scenario,) = unit.scenarios
        frames = dataset.scenario.get(scenario)["num_frames"]
        there = self._there(dataset, scenario)
        each, count = _pixels(self.images) * 3, sum(map(len, there.values()))
        if self.codec == "jpeg" and count:
            (agent, camera), numbers = next((key, numbers) for key, numbers in there.items() if numbers)
            each = len(self._content(dataset, _camera_token(scenario, agent, min(numbers), camera)))
        rows = len(self.agents) * frames
        size = file_bytes(rows, len(self.images.cameras), count * each)
        samples = {(agent, number) for (agent, _), numbers in there.items() for number in numbers}
        return Plan(samples=len(samples), files=1, bytes=size)

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a scenario's file: all frames of the first agent, then of the next one."""
        (scenario,) = unit.scenarios
        frames = dataset.scenario.get(scenario)["num_frames"]
        there = self._there(dataset, scenario)

        def contents() -> Iterator[bytes | None]:
            for agent, number, camera in product(self.agents, range(1, frames + 1), self.images.cameras):
                has = number in there.get((agent, camera), ())
                yield self._content(dataset, _camera_token(scenario, agent, number, camera)) if has else None

        with output.file(images_path(scenario)) as path:
            write_images(path, len(self.agents) * frames, len(self.images.cameras), contents())
        absent = [agent for agent in self.agents if (agent, self.images.cameras[0]) not in there]
        wanted = (len(self.agents) - len(absent)) * frames * len(self.images.cameras)
        output.leave_out("agents of scenarios that are not in this release", len(absent))
        output.leave_out("images that are not in this release", wanted - sum(map(len, there.values())))

    def finish(self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]) -> None:
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


def images_path(scenario: str) -> str:
    """The file of a scenario, in a cache's folder."""
    return f"{flat_name(scenario)}.images"


def stored_size(images: ImageConfig) -> tuple[int, int]:
    """Height and width of a cache's images; `resize` must be there."""
    height, width = images.resize or (0, 0)
    return (height, width) if images.crop is None else images.crop[2:]


def _pixels(images: ImageConfig) -> int:
    height, width = stored_size(images)
    return height * width


def _camera_token(scenario: str, agent: str, number: int, camera: str) -> str:
    return sample_data_token(sample_token(scenario, agent, number), camera)
