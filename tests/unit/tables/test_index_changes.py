"""Files that were restored, edited or replaced since the index was made: what opening sees, and
what mends the rest.
"""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import tiny
from tiny_index import INDEX, contents, opened
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.fingerprints import folder_hashes
from deepaccident_devkit.tables import Index, current_index, indexing
from deepaccident_devkit.tables import index as index_module
from deepaccident_devkit.validation import validate_release

LABEL, CALIB, META = "ego_vehicle/label", "ego_vehicle/calib", "meta"
Change = Callable[[Path, bytes], None]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tiny.write_tiny_release(tmp_path / "release")


def file_of(root: Path, kind: str) -> Path:
    folder = root / tiny.TYPE / kind
    return (
        folder / f"{tiny.NAME}.txt" if kind == META else min((folder / tiny.NAME).glob("*_002.*"))
    )


def edited(path: Path) -> bytes:
    """Other content that is as good, of the same length but for calib."""
    content = path.read_bytes()
    for old, new in ((b" 1300 12 ", b" 1300 72 "), (b"car 1212", b"car 1236")):
        content = content.replace(old, new)
    return (
        content + b" " if path.suffix == ".pkl" else content
    )  # after a pickle's end nothing is read


def keep_times(path: Path, change: Callable[[], object]) -> None:
    """Change a file, and put its time and that of its folder back."""
    before, folder = path.stat(), path.parent.stat()
    change()
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    os.utime(path.parent, ns=(folder.st_atime_ns, folder.st_mtime_ns))


def replaced(path: Path, content: bytes) -> None:
    path.with_name("new").write_bytes(content)
    path.with_name("new").replace(path)


def copied_folder(path: Path, content: bytes) -> None:
    folder, copy = path.parent, path.parent.with_name("copy")
    shutil.copytree(folder, copy)
    keep_times(copy / path.name, lambda: (copy / path.name).write_bytes(content))
    shutil.rmtree(folder)
    shutil.copystat(copy, copy)
    copy.rename(folder)


CHANGES: dict[str, Change] = {
    "replaced": replaced,
    "replaced, with all times kept": lambda path, content: keep_times(
        path, lambda: replaced(path, content)
    ),
    "its folder replaced by a copy with kept times": copied_folder,
}


def is_right(release: DeepAccident, root: Path) -> bool:
    (scenario,) = find_release(root).scenarios
    return release.indexed_hashes(scenario.token) == folder_hashes(scenario)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", [LABEL, CALIB, META])
def test_a_file_in_the_place_of_another_is_seen(root: Path, kind: str, change: str) -> None:
    before = opened(root)
    path = file_of(root, kind)
    CHANGES[change](path, edited(path))
    after = opened(root)
    assert (is_right(before, root), is_right(after, root)) == (False, True)
    assert opened(root).tables_folder == after.tables_folder != before.tables_folder


@pytest.mark.parametrize("kind", [LABEL, CALIB, META])
def test_what_was_written_in_place_is_seen_by_index_and_told_by_validate(
    root: Path, kind: str
) -> None:
    """Even if its size and time are those of before: its ctime is not."""
    before = opened(root)
    path = file_of(root, kind)
    keep = path.stat()
    path.write_bytes(edited(path))
    os.utime(path, ns=(keep.st_atime_ns, keep.st_mtime_ns))
    if path.stat().st_size == keep.st_size:
        assert opened(root).tables_folder == before.tables_folder
        (finding,) = [
            each
            for each in validate_release(root, workers=1).findings
            if each.code == "index-outdated"
        ]
        assert (finding.severity, finding.scenario) == ("warning", tiny.TOKEN)
        assert "deepaccident check index DATAROOT" in finding.remedy
    called("index", root)
    assert is_right(opened(root), root)
    assert "index-outdated" not in {
        finding.code for finding in validate_release(root, workers=1).findings
    }


def test_a_release_that_moved_with_its_index_is_indexed_once_more(
    root: Path, tmp_path: Path
) -> None:
    before = contents(opened(root).tables_folder)
    shutil.copytree(root, tmp_path / "copy")
    assert current_index(find_release(tmp_path / "copy")) is None
    assert contents(opened(tmp_path / "copy").tables_folder) == before
    assert current_index(find_release(tmp_path / "copy")) is not None


def test_an_index_of_an_earlier_devkit_is_made_again(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One without hashes, whose manifest has a digest of another kind."""
    with monkeypatch.context() as patch:
        patch.setattr(indexing, "HASHES", "contents")
        patch.setattr(index_module, "folder_digest", lambda *_: "0" * 32)
        earlier = opened(root)
    assert earlier.indexed_hashes(tiny.TOKEN) is None
    earlier.tables_folder.rename(root / INDEX / "tables-00")
    index = Index.read(root / INDEX)
    assert index is not None
    replace(index, tables="tables-00").write()
    assert is_right(opened(root), root)
    assert contents(root / INDEX / "kept").keys() == {tiny.TOKEN}


def test_a_damaged_list_of_hashes_is_refused_and_validate_goes_on(root: Path) -> None:
    release = opened(root)
    table = release.tables_folder / "scenario.arrow"
    content = table.read_bytes()
    table.unlink()
    table.write_bytes(content.replace(b'{"label"', b'["label"'))
    assert validate_release(root, workers=1).scenarios == 1
    with pytest.raises(
        index_module.IndexStoreError, match=r"hashes of its files are damaged; .* check index"
    ):
        opened(root).indexed_hashes(tiny.TOKEN)
