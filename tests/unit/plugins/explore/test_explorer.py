"""Values, files and thumbnails that the explorer keeps: made once, within a bound, never half."""

import io
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image, ImageColor
from support.replay_page import accident_scenario, normal_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.explore import explorer
from deepaccident_devkit.plugins.explore.explorer import (
    PICTURE_SIZE,
    Explorer,
    FileStore,
    ValueCache,
    thumbnail,
)
from deepaccident_devkit.release.store import store
from deepaccident_devkit.render.styles import COLLIDER_COLOR, MISSING_COLOR
from deepaccident_devkit.support.parallel import Store


def test_several_threads_make_a_value_once() -> None:
    cache, go_on, make = ValueCache[int](10), threading.Event(), Mock(return_value=7)

    def make_slowly() -> int:
        return go_on.wait(60) and make()

    with ThreadPoolExecutor(8) as pool:
        futures = [pool.submit(cache.get, "a", make_slowly) for _ in range(8)]
        go_on.set()
    assert [future.result() for future in futures] == [7] * 8
    assert make.call_count == 1


def test_the_least_recently_used_value_is_evicted() -> None:
    cache = ValueCache[bytes](10, len)
    make = Mock(return_value=b"four")
    for name in ("a", "b", "a", "c", "a", "b"):  # c evicts b
        cache.get(name, partial(make, name))
    assert [call.args[0] for call in make.call_args_list] == ["a", "b", "c", "b"]


def test_files_lie_beside_the_index(da_b: DeepAccident) -> None:
    make = Mock(return_value=b"content")
    for _ in range(2):
        assert FileStore(da_b).get("test of keeping", "thumbnail.jpg", make) == b"content"
    files = FileStore(da_b)
    assert (make.call_count, files.folder.parent) == (1, da_b.tables_folder)
    assert len([*files.folder.rglob("thumbnail.jpg")]) == 1
    assert files.get("another", "thumbnail.jpg", lambda: b"more") == b"more"


def test_where_the_index_cannot_be_written_the_users_cache_is_used(
    da_b: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explorer, "is_writable_folder", lambda _: False)
    monkeypatch.setenv(store.FOLDER_VARIABLE, str(tmp_path / "cache" / "files"))
    assert FileStore(da_b).get("a", "thumbnail.jpg", lambda: b"1") == b"1"
    (path,) = tmp_path.rglob("*.jpg")
    assert path.relative_to(tmp_path).parts[:2] == ("cache", "thumbnails")


def test_a_full_disk_does_not_prevent_the_picture(
    da_b: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        Store, "write_result", Mock(side_effect=OSError(28, "No space left on device"))
    )
    assert FileStore(da_b).get("full", "thumbnail.jpg", lambda: b"made") == b"made"


def decode_picture(jpeg: bytes) -> np.ndarray:
    image = Image.open(io.BytesIO(jpeg))
    assert image.size == PICTURE_SIZE
    return np.asarray(image, dtype=int)


def count_pixels_near(image: np.ndarray, color: str, tolerance: int = 60) -> int:
    differences = np.abs(image - ImageColor.getrgb(color)).max(axis=-1)
    return int((differences < tolerance).sum())


def thumbnail_pixels(da: DeepAccident, scenario: str) -> np.ndarray:
    return decode_picture(thumbnail(da, da.get("scenario", scenario)))


def open_copy(da: DeepAccident, root: Path, *ignored: str) -> DeepAccident:
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", *ignored))
    return DeepAccident("v1", root, verbose=False)


def test_an_accident_has_red_boxes_and_a_normal_one_has_none(da: DeepAccident) -> None:
    accident = thumbnail_pixels(da, accident_scenario(da))
    normal = thumbnail_pixels(da, normal_scenario(da))
    assert count_pixels_near(accident, COLLIDER_COLOR) > 40
    assert count_pixels_near(normal, COLLIDER_COLOR) < 10


def test_without_images_the_thumbnail_shows_the_scenario_from_above(da_b: DeepAccident) -> None:
    image = thumbnail_pixels(da_b, accident_scenario(da_b))
    assert count_pixels_near(image, COLLIDER_COLOR) > 40
    assert count_pixels_near(image, "#ffffff", 10) > image[..., 0].size / 2


def test_without_labels_the_thumbnail_is_grey(da_b: DeepAccident, tmp_path: Path) -> None:
    dataset = open_copy(da_b, tmp_path / "r", "label")
    image = thumbnail_pixels(dataset, dataset.scenario[0]["token"])
    assert count_pixels_near(image, MISSING_COLOR, 4) == image[..., 0].size


def test_a_damaged_image_does_not_matter(da: DeepAccident, tmp_path: Path) -> None:
    dataset = open_copy(da, tmp_path / "r")
    for path in (tmp_path / "r").rglob("*.jpg"):
        path.write_bytes(b"no picture")
    image = thumbnail_pixels(dataset, accident_scenario(dataset))
    assert count_pixels_near(image, "#ffffff", 10) > 1000


def test_images_that_come_later_are_shown(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "r"
    explorer, token = Explorer(open_copy(da, root, "Camera_*")), accident_scenario(da)
    before = explorer.thumbnail(token)
    assert explorer.thumbnail(token) == before

    ignore = shutil.ignore_patterns(".deepaccident")
    shutil.copytree(da.dataroot, root, ignore=ignore, dirs_exist_ok=True)
    after = explorer.thumbnail(token)
    assert after == thumbnail(da, da.get("scenario", token))
    assert after != before
