"""What is kept: made once, within a bound, and never half."""

import threading
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.explore import explorer
from deepaccident_devkit.explore.explorer import Kept, KeptFiles
from deepaccident_devkit.parallel import Store
from deepaccident_devkit.release.store import store


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
