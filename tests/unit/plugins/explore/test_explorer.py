"""What is kept: made once, within a bound, and never half."""

import io
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image, ImageColor
from replay_page import accident, normal

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


def test_several_threads_make_it_once() -> None:
    kept, go, make = ValueCache[int](10), threading.Event(), Mock(return_value=7)
    with ThreadPoolExecutor(8) as pool:
        got = [pool.submit(kept.get, "a", lambda: go.wait(60) and make()) for _ in range(8)]
        go.set()
    assert ([each.result() for each in got], make.call_count) == ([7] * 8, 1)


def test_what_was_not_asked_for_the_longest_goes() -> None:
    kept, made = ValueCache[bytes](10, len), []
    for name in ("a", "b", "a", "c", "a", "b"):  # with c, b has to go
        kept.get(name, lambda name=name: made.append(name) or b"four")
    assert made == ["a", "b", "c", "b"]


def test_files_lie_beside_the_index(da_b: DeepAccident) -> None:
    make = Mock(return_value=b"content")
    for _ in range(2):
        assert FileStore(da_b).get("test of keeping", "thumbnail.jpg", make) == b"content"
    files = FileStore(da_b)
    assert (make.call_count, files.folder.parent) == (1, da_b.tables_folder)
    assert len([*files.folder.rglob("thumbnail.jpg")]) == 1
    assert files.get("another", "thumbnail.jpg", lambda: b"more") == b"more"


def test_where_the_index_cannot_be_written_the_users_cache_is_taken(
    da_b: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explorer, "is_writable_folder", lambda _: False)
    monkeypatch.setenv(store.FOLDER_VARIABLE, str(tmp_path / "cache" / "files"))
    assert FileStore(da_b).get("a", "thumbnail.jpg", lambda: b"1") == b"1"
    assert [path.relative_to(tmp_path).parts[:2] for path in tmp_path.rglob("*.jpg")] == [
        ("cache", "thumbnails")
    ]


def test_a_full_disk_keeps_nobody_from_the_picture(
    da_b: DeepAccident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Store, "keep", Mock(side_effect=OSError(28, "No space left on device")))
    assert FileStore(da_b).get("full", "thumbnail.jpg", lambda: b"made") == b"made"


def pixels(jpeg: bytes) -> np.ndarray:
    image = Image.open(io.BytesIO(jpeg))
    assert image.size == PICTURE_SIZE
    return np.asarray(image, dtype=int)


def near(shown: np.ndarray, color: str, off: int = 60) -> int:
    """How many pixels are about of a colour."""
    return int((np.abs(shown - ImageColor.getrgb(color)).max(axis=-1) < off).sum())


def shown_of(da: DeepAccident, scenario: str) -> np.ndarray:
    return pixels(thumbnail(da, da.get("scenario", scenario)))


def reopened(da: DeepAccident, root: Path, *gone: str) -> DeepAccident:
    """A copy of a release without some files."""
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", *gone))
    return DeepAccident("v1", root, verbose=False)


def test_an_accident_has_red_boxes_and_a_normal_one_has_none(da: DeepAccident) -> None:
    assert near(shown_of(da, accident(da)), COLLIDER_COLOR) > 40
    assert near(shown_of(da, normal(da)), COLLIDER_COLOR) < 10


def test_without_images_it_is_seen_from_above(da_b: DeepAccident) -> None:
    shown = shown_of(da_b, accident(da_b))
    assert near(shown, COLLIDER_COLOR) > 40
    assert near(shown, "#ffffff", 10) > shown[..., 0].size / 2


def test_without_labels_it_is_grey(da_b: DeepAccident, tmp_path: Path) -> None:
    dataset = reopened(da_b, tmp_path / "r", "label")
    shown = shown_of(dataset, dataset.scenario[0]["token"])
    assert near(shown, MISSING_COLOR, 4) == shown[..., 0].size


def test_a_damaged_image_does_not_matter(da: DeepAccident, tmp_path: Path) -> None:
    dataset = reopened(da, tmp_path / "r")
    for path in (tmp_path / "r").rglob("*.jpg"):
        path.write_bytes(b"no picture")
    assert near(shown_of(dataset, accident(dataset)), "#ffffff", 10) > 1000


def test_images_that_come_later_are_shown(da: DeepAccident, tmp_path: Path) -> None:
    explorer, token = Explorer(reopened(da, tmp_path / "r", "Camera_*")), accident(da)
    before = explorer.thumbnail(token)
    assert explorer.thumbnail(token) == before
    shutil.copytree(
        da.dataroot,
        tmp_path / "r",
        ignore=shutil.ignore_patterns(".deepaccident"),
        dirs_exist_ok=True,
    )
    assert explorer.thumbnail(token) == thumbnail(da, da.get("scenario", token)) != before
