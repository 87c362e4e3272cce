"""Files that were restored, edited or replaced since the index was made.

Opening a release sees some of these changes; the other tests say which command mends the index.
"""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from support import tiny_release
from support.command_calls import invoke_command
from support.tiny_release_index import INDEX_FOLDER, folder_contents, open_release

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
    return tiny_release.write_tiny_release(tmp_path / "release")


def find_file(root: Path, kind: str) -> Path:
    folder = root / tiny_release.SCENARIO_TYPE / kind
    if kind == META:
        return folder / f"{tiny_release.SCENARIO_NAME}.txt"
    return min((folder / tiny_release.SCENARIO_NAME).glob("*_002.*"))


def edit_content(path: Path) -> bytes:
    """Return other content that is valid; only that of calib has another length."""
    content = path.read_bytes()
    for old, new in ((b" 1300 12 ", b" 1300 72 "), (b"car 1212", b"car 1236")):
        content = content.replace(old, new)
    if path.suffix == ".pkl":
        content += b" "  # nothing is read after a pickle's end
    return content


def keep_times(path: Path, change: Callable[[], object]) -> None:
    """Change a file, and put its time and that of its folder back."""
    before, folder = path.stat(), path.parent.stat()
    change()
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    os.utime(path.parent, ns=(folder.st_atime_ns, folder.st_mtime_ns))


def replace_file(path: Path, content: bytes) -> None:
    path.with_name("new").write_bytes(content)
    path.with_name("new").replace(path)


def replace_folder(path: Path, content: bytes) -> None:
    folder, copy = path.parent, path.parent.with_name("copy")
    shutil.copytree(folder, copy)
    keep_times(copy / path.name, lambda: (copy / path.name).write_bytes(content))
    shutil.rmtree(folder)
    shutil.copystat(copy, copy)
    copy.rename(folder)


CHANGES: dict[str, Change] = {
    "replaced": replace_file,
    "replaced, with all times kept": lambda path, content: keep_times(
        path, lambda: replace_file(path, content)
    ),
    "its folder replaced by a copy with kept times": replace_folder,
}


def has_current_hashes(release: DeepAccident, root: Path) -> bool:
    (scenario,) = find_release(root).scenarios
    return release.indexed_hashes(scenario.token) == folder_hashes(scenario)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("kind", [LABEL, CALIB, META])
def test_a_file_in_the_place_of_another_is_seen(root: Path, kind: str, change: str) -> None:
    before = open_release(root)
    path = find_file(root, kind)
    CHANGES[change](path, edit_content(path))
    after = open_release(root)
    assert not has_current_hashes(before, root)
    assert has_current_hashes(after, root)
    assert open_release(root).tables_folder == after.tables_folder != before.tables_folder


@pytest.mark.parametrize("kind", [LABEL, CALIB, META])
def test_what_was_written_in_place_is_seen_by_index_and_told_by_validate(
    root: Path, kind: str
) -> None:
    """A file may keep its size and time, but its ctime is new."""
    release = open_release(root)
    path = find_file(root, kind)
    before = path.stat()
    path.write_bytes(edit_content(path))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    if path.stat().st_size == before.st_size:
        assert open_release(root).tables_folder == release.tables_folder
        report = validate_release(root, workers=1)
        (finding,) = [finding for finding in report.findings if finding.code == "index-outdated"]
        assert finding.severity == "warning"
        assert finding.scenario == tiny_release.SCENARIO_TOKEN
        assert "deepaccident check index DATAROOT" in finding.remedy

    invoke_command("index", root)
    assert has_current_hashes(open_release(root), root)
    codes = {finding.code for finding in validate_release(root, workers=1).findings}
    assert "index-outdated" not in codes


def test_a_release_that_moved_with_its_index_is_indexed_once_more(
    root: Path, tmp_path: Path
) -> None:
    before = folder_contents(open_release(root).tables_folder)
    shutil.copytree(root, tmp_path / "copy")
    assert current_index(find_release(tmp_path / "copy")) is None
    assert folder_contents(open_release(tmp_path / "copy").tables_folder) == before
    assert current_index(find_release(tmp_path / "copy")) is not None


def test_an_index_of_an_earlier_devkit_is_made_again(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has no hashes, and its manifest has a digest of another kind."""
    with monkeypatch.context() as patch:
        patch.setattr(indexing, "HASHES", "contents")
        patch.setattr(index_module, "folder_digest", lambda *_: "0" * 32)
        earlier = open_release(root)
    assert earlier.indexed_hashes(tiny_release.SCENARIO_TOKEN) is None
    earlier.tables_folder.rename(root / INDEX_FOLDER / "tables-00")
    index = Index.read(root / INDEX_FOLDER)
    assert index is not None
    replace(index, tables="tables-00").write()
    assert has_current_hashes(open_release(root), root)
    assert folder_contents(root / INDEX_FOLDER / "kept").keys() == {tiny_release.SCENARIO_TOKEN}


def test_a_damaged_list_of_hashes_is_refused_and_validate_goes_on(root: Path) -> None:
    release = open_release(root)
    table = release.tables_folder / "scenario.arrow"
    content = table.read_bytes()
    table.unlink()
    table.write_bytes(content.replace(b'{"label"', b'["label"'))
    assert validate_release(root, workers=1).scenarios == 1
    with pytest.raises(
        index_module.IndexStoreError, match=r"hashes of its files are damaged; .* check index"
    ):
        open_release(root).indexed_hashes(tiny_release.SCENARIO_TOKEN)
