"""Items with images from a cache."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises
from torch.utils.data import DataLoader
from torch_extra.compared import are_identical
from torch_extra.items import load_item

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, MissingFileError
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.training.image_cache import CachedImages
from deepaccident_devkit.training.torch import ImageConfig, V2XConfig, V2XDataset

IMAGES = ImageConfig(
    resize=(18, 30), crop=(2, 3, 12, 25), mean=(0.5, 0.4, 0.3), std=(0.2, 0.3, 0.4)
)
CONFIG = V2XConfig(agents="all", past=2, step=2, points=False, boxes=None, images=IMAGES)


def write_cache(dataset: DeepAccident, folder: Path, **fields: Any) -> Path:
    cached_images = CachedImages(images=IMAGES, where=("length>=1",), **fields)
    return export_release(dataset, folder, cached_images, workers=1).folder


@pytest.fixture(scope="module")
def cache(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_cache(da, tmp_path_factory.mktemp("cache") / "raw")


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_a_cached_item_is_the_same(
    da: DeepAccident, cache: Path, tokens: list[str], dtype: Any
) -> None:
    images = IMAGES
    if dtype == "uint8":
        images = replace(IMAGES, dtype="uint8", mean=(0, 0, 0), std=(1, 1, 1))
    config = replace(CONFIG, images=images)
    plain_data = V2XDataset(da, tokens[:3], config)
    cached_data = V2XDataset(da, tokens[:3], replace(config, images_cache=cache))

    for expected, item in zip(plain_data, cached_data, strict=True):
        assert are_identical(expected, item)
        item["images"][:] = 0  # changes only this item, not the cache
    assert are_identical(plain_data[0], cached_data[0])


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_workers_read_the_cache(da: DeepAccident, cache: Path, tokens: list[str]) -> None:
    data = V2XDataset(da, tokens, replace(CONFIG, images_cache=cache))
    expected = [data[index] for index in range(len(data))]  # opens files before workers are forked
    loader = DataLoader(data, batch_size=None, num_workers=2, multiprocessing_context="fork")
    assert are_identical(list(loader), expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"images": replace(IMAGES, resize=(36, 60))},
            r"has resize=\(18, 30\), expected \(36, 60\)",
        ),
        ({"images": replace(IMAGES, decode="scaled")}, "has decode='full', expected 'scaled'"),
        ({"images_cache": "nowhere"}, "nowhere contains no cache of images"),
        ({"images": None}, "images_cache: has no effect without images"),
        ({"images": ImageConfig(virtual_camera=(9, 9, 9))}, "remove the virtual camera"),
    ],
)
def test_requests_that_the_cache_cannot_serve_are_refused(
    da: DeepAccident, cache: Path, sample: str, changes: dict[str, Any], message: str
) -> None:
    fields = {"images_cache": cache} | changes
    assert_raises(
        (lambda: V2XDataset(da, [sample], replace(CONFIG, **fields)), ConfigError, message)
    )


def test_samples_and_agents_that_the_cache_lacks_are_refused(
    da: DeepAccident, sample: str, tmp_path: Path
) -> None:
    config = replace(
        CONFIG,
        agents="single",
        images_cache=write_cache(da, tmp_path / "out", agents=("ego_vehicle",)),
    )
    assert V2XDataset(da, [sample], config)

    tokens = [sample, sample.replace("ego_vehicle", "other_vehicle")]
    assert_raises(
        (
            lambda: V2XDataset(da, tokens, config),
            ConfigError,
            r"has no images of .*/other_vehicle; choose other samples or agents",
        ),
        (
            lambda: V2XDataset(da, [sample], replace(config, agents="+infrastructure")),
            ConfigError,
            r"has no images of .*/infrastructure; choose other samples or agents",
        ),
    )


def test_images_that_the_release_lacked_are_skipped_or_refused(
    da_partial: DeepAccident, sample: str, tmp_path: Path
) -> None:
    cache = write_cache(da_partial, tmp_path / "out")
    token = sample.replace("ego_vehicle", "other_vehicle")
    fields = {"agents": ("ego_vehicle",), "points": False, "images": IMAGES}

    assert_raises(
        (
            lambda: load_item(da_partial, token, **fields, images_cache=cache),
            MissingFileError,
            r"has no image .*/004/Camera_Front, which was missing in the release",
        )
    )

    item = load_item(da_partial, token, **fields, images_cache=cache, on_missing="skip")
    expected = load_item(da_partial, token, **fields, on_missing="skip")
    assert item["agent_valid"].tolist() == [[True], [False]]
    assert are_identical(item, expected)
