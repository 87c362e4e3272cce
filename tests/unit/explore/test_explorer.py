"""What is kept: made once, within a bound, and never half."""

import io
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageColor
from replay_page import accident, normal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.explore import explorer
from deepaccident_devkit.explore.explorer import SIZE, Explorer, Kept, KeptFiles, thumbnail
from deepaccident_devkit.parallel import Store
from deepaccident_devkit.release.store import store
from deepaccident_devkit.render.styles import COLLIDER_COLOR, MISSING_COLOR


def test_several_threads_make_it_once() -> None:
    kept, made, go = Kept[int](10), [], threading.Event()

    def make() -> int:
        go.wait(5)
        made.append(1)
        return 7

    got: list[int] = []
    threads = [threading.Thread(target=lambda: got.append(kept.get("a", make))) for _ in range(8)]
    for thread in threads:
        thread.start()
    go.set()
    for thread in threads:
        thread.join()
    assert (made, got) == ([1], [7] * 8)


def test_what_was_not_asked_for_the_longest_goes() -> None:
    kept, made = Kept[bytes](10, len), []

    def get(name: str, size: int = 4) -> None:
        kept.get(name, lambda: made.append(name) or b"x" * size)

    for name in ("a", "b", "a", "c", "a", "b"):  # with c, b has to go
        get(name)
    assert made == ["a", "b", "c", "b"]
    get("large", 99)
    get("large", 99)
    assert made[4:] == ["large"]  # larger than the bound, and alone
    get("a")
    assert made[5:] == ["a"]


def test_a_failure_is_not_kept() -> None:
    kept: Kept[int] = Kept(10)
    with pytest.raises(ZeroDivisionError):
        kept.get("a", lambda: 1 // 0)
    assert kept.get("a", lambda: 5) == 5


def test_files_lie_beside_the_index(da_b: DeepAccident) -> None:
    files, made = KeptFiles(da_b), []

    def make() -> bytes:
        made.append(1)
        return b"content"

    for _ in range(2):
        assert KeptFiles(da_b).get("test of keeping", "thumbnail.jpg", make) == b"content"
    assert made == [1]
    assert files.folder.parent == da_b.tables_folder
    assert len([*files.folder.rglob("thumbnail.jpg")]) == 1
    assert files.get("another", "thumbnail.jpg", lambda: b"more") == b"more"


def test_where_the_index_cannot_be_written_the_users_cache_is_taken(
    da_b: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explorer, "is_writable_folder", lambda _: False)
    monkeypatch.setenv(store.FOLDER_VARIABLE, str(tmp_path / "cache" / "files"))
    files = KeptFiles(da_b)
    assert files.get("a", "thumbnail.jpg", lambda: b"1") == b"1"
    assert files.folder == tmp_path / "cache" / "thumbnails"
    assert len([*files.folder.rglob("thumbnail.jpg")]) == 1


def test_a_full_disk_keeps_nobody_from_the_picture(da_b: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Store, "keep", full)
    assert KeptFiles(da_b).get("full", "thumbnail.jpg", lambda: b"made") == b"made"


def pixels(jpeg: bytes) -> np.ndarray:
    image = Image.open(io.BytesIO(jpeg))
    assert image.size == SIZE
    return np.asarray(image, dtype=int)


def near(shown: np.ndarray, color: str, off: int = 60) -> int:
    """How many pixels are about of a colour."""
    return int((np.abs(shown - ImageColor.getrgb(color)).max(axis=-1) < off).sum())


def test_an_accident_has_red_boxes_and_a_normal_one_has_none(da: DeepAccident) -> None:
    shown = pixels(thumbnail(da, da.get("scenario", accident(da))))
    assert near(shown, COLLIDER_COLOR) > 40
    assert near(pixels(thumbnail(da, da.get("scenario", normal(da)))), COLLIDER_COLOR) < 10


def test_without_images_it_is_seen_from_above(da_b: DeepAccident) -> None:
    shown = pixels(thumbnail(da_b, da_b.get("scenario", accident(da_b))))
    assert near(shown, COLLIDER_COLOR) > 40
    assert near(shown, "#ffffff", 10) > shown.shape[0] * shown.shape[1] / 2


def test_without_labels_it_is_grey(own_release: Path) -> None:
    for folder in sorted(own_release.rglob("label")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    shown = pixels(thumbnail(dataset, dataset.scenario[0]))
    assert near(shown, MISSING_COLOR, 4) == shown.shape[0] * shown.shape[1]


def test_a_damaged_image_does_not_matter(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "damaged"
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"))
    for path in root.rglob("*.jpg"):
        path.write_bytes(b"no picture")
    dataset = DeepAccident("v1", root, verbose=False)
    assert near(pixels(thumbnail(dataset, dataset.get("scenario", accident(dataset)))), "#ffffff", 10) > 1000


def test_images_that_come_later_are_shown(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "later"
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "Camera_*"))
    explorer = Explorer(DeepAccident("v1", root, verbose=False))
    token = accident(explorer.dataset)  # type: ignore[arg-type]
    before = explorer.thumbnail(token)
    assert explorer.thumbnail(token) == before
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"), dirs_exist_ok=True)
    assert explorer.thumbnail(token) == thumbnail(da, da.get("scenario", token)) != before
