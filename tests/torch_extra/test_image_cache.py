"""Items whose images come out of a cache, and decoding at a smaller scale."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from refusals import assert_refused
from torch.utils.data import DataLoader
from torch_extra.compared import same

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, MissingFileError
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.training.image_cache import CachedImages
from deepaccident_devkit.training.torch import ImageConfig, V2XConfig, V2XDataset

IMAGES = ImageConfig(
    resize=(18, 30), crop=(2, 3, 12, 25), mean=(0.5, 0.4, 0.3), std=(0.2, 0.3, 0.4)
)
CONFIG = V2XConfig(agents="all", past=2, step=2, points=False, boxes=None, images=IMAGES)


def cached(dataset: DeepAccident, folder: Path, **fields: Any) -> Path:
    return export_release(
        dataset, folder, CachedImages(images=IMAGES, where=("length>=1",), **fields), workers=1
    ).folder


@pytest.fixture(scope="module")
def folder(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return cached(da, tmp_path_factory.mktemp("cache") / "raw")


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_a_cached_item_is_the_same(
    da: DeepAccident, folder: Path, tokens: list[str], dtype: Any
) -> None:
    images = (
        replace(IMAGES, dtype="uint8", mean=(0, 0, 0), std=(1, 1, 1))
        if dtype == "uint8"
        else IMAGES
    )
    config = replace(CONFIG, images=images)
    plain, quick = (
        V2XDataset(da, tokens[:3], each) for each in (config, replace(config, images_cache=folder))
    )
    for expected, found in zip(plain, quick, strict=True):
        assert same(expected, found)
        found["images"][:] = 0  # an item is its receiver's own
    assert same(plain[0], quick[0])


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_workers_read_the_cache(da: DeepAccident, folder: Path, tokens: list[str]) -> None:
    data = V2XDataset(da, tokens, replace(CONFIG, images_cache=folder))
    here = [data[index] for index in range(len(data))]  # files are open when workers are forked
    assert same(
        list(DataLoader(data, batch_size=None, num_workers=2, multiprocessing_context="fork")), here
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"images": replace(IMAGES, resize=(36, 60))},
            r"has resize=\(18, 30\), wanted is \(36, 60\)",
        ),
        ({"images": replace(IMAGES, decode="scaled")}, "has decode='full', wanted is 'scaled'"),
        ({"images_cache": "nowhere"}, "nowhere holds no cache of images"),
        ({"images": None}, "images_cache: changes nothing without images"),
        ({"images": ImageConfig(virtual_camera=(9, 9, 9))}, "leave out the virtual camera"),
    ],
)
def test_what_the_cache_cannot_serve_is_refused(
    da: DeepAccident, folder: Path, sample: str, changes: dict[str, Any], words: str
) -> None:
    assert_refused(
        (
            lambda: V2XDataset(da, [sample], replace(CONFIG, **{"images_cache": folder} | changes)),
            ConfigError,
            words,
        )
    )


def test_samples_and_agents_that_are_not_in_it_are_refused(
    da: DeepAccident, sample: str, tmp_path: Path
) -> None:
    alone = cached(da, tmp_path / "out", agents=("ego_vehicle",))
    config = replace(CONFIG, agents="single", images_cache=alone)
    assert V2XDataset(da, [sample], config)
    assert_refused(
        (
            lambda: V2XDataset(
                da, [sample, sample.replace("ego_vehicle", "other_vehicle")], config
            ),
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
    out = cached(da_partial, tmp_path / "out")
    token = sample.replace("ego_vehicle", "other_vehicle")
    config = V2XConfig(agents=("ego_vehicle",), points=False, images=IMAGES, images_cache=out)
    lacked = r"has no image .*/004/Camera_Front, which the release lacked"
    assert_refused((lambda: V2XDataset(da_partial, [token], config)[0], MissingFileError, lacked))
    item, expected = (
        V2XDataset(da_partial, [token], replace(config, on_missing="skip", images_cache=cache))[0]
        for cache in (out, None)
    )
    assert item["agent_valid"].tolist() == [[True], [False]]
    assert same(item, expected)
