"""`deepaccident index`, `index --clear` and `info --index`, and the functions behind them."""

import json
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import tiny
from click.testing import CliRunner
from filelock import FileLock

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import DatarootError, IndexStoreError, VersionError
from deepaccident_devkit.release.store import INDEX_FOLDER
from deepaccident_devkit.tables import clear_index, index_report, indexing
from deepaccident_devkit.tables import index as index_module
from deepaccident_devkit.tables.manifest import SCHEMA_VERSION

OTHER = "Town05_type001_subtype0001_scenario00007"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two scenarios; the path has a blank in it."""
    tiny.write_tiny_release(tmp_path / "deep accident")
    return tiny.write_tiny_release(tmp_path / "deep accident", name=OTHER)


def run(*arguments: object, verb: str = "index") -> str:
    result = CliRunner().invoke(deepaccident, [verb, *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def info(*arguments: object) -> str:
    return run(*arguments, "--index", verb="info")


def report(*arguments: object) -> list[dict[str, Any]]:
    indexes: list[dict[str, Any]] = json.loads(info(*arguments, "--json"))["indexes"]
    return indexes


def label(root: Path) -> Path:
    return root / tiny.TYPE / "ego_vehicle" / "label" / tiny.NAME / f"{tiny.NAME}_002.txt"


def index_in_the_cache(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(index_module, "is_writable_folder", lambda path: root not in path.parents)
        DeepAccident(dataroot=root, verbose=False)


@pytest.mark.parametrize(
    "arguments",
    ["index", "index a b", "index a --clear --check", "info a --check", "info a --index --where town=Town03"],
)
def test_wrong_usage_is_status_2(arguments: str) -> None:
    result = CliRunner().invoke(deepaccident, arguments.split())
    assert result.exit_code == 2
    assert "Usage: " in result.output


def test_info_tells_what_there_is(root: Path) -> None:
    run(root)
    (found,) = report(root)
    folder = root / ".deepaccident" / "v1"
    sizes = {path: path.stat().st_size for path in folder.rglob("*") if path.is_file()}
    assert found["folder"] == str(folder)
    assert (found["state"], found["version"], found["edited"]) == ("up to date", "v1", None)
    assert (found["schema_version"], found["scenarios"], found["left_out"]) == (SCHEMA_VERSION, 2, {})
    assert found["total_bytes"] == sum(sizes.values())
    assert found["shards_bytes"] == sum(size for path, size in sizes.items() if "shards" in path.parts)
    assert found["tables_bytes"] == sum(size for path, size in sizes.items() if path.parent.name.startswith("tables-"))
    assert (found["tables"]["sample"], len(found["tables"])) == (40, 12)
    text = info(root)
    assert text.startswith(f"{folder}: up to date\n")
    assert "2 scenarios, 0 left out" in text
    assert "not compared; --check does" in text


def test_info_sees_edits_with_check_alone_and_changes_nothing(root: Path) -> None:
    run(root)
    label(root).write_text("\n".join(label(root).read_text().splitlines()[:-1]) + "\n")
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    assert report(root)[0]["state"] == "up to date"
    (found,) = report(root, "--check")
    assert (found["state"], found["edited"]) == ("out of date", [tiny.TOKEN])
    assert f"1 scenarios were edited: {tiny.TOKEN}" in info(root, "--check")
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before
    run(root, "--check")
    assert report(root, "--check")[0]["edited"] == []
    assert "compared: no scenario was edited" in info(root, "--check")


def test_info_sees_a_refresh_that_failed_half_way(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(root)
    label(root).write_text("0.0 1.0\n")
    with monkeypatch.context() as patch:
        patch.setattr(indexing, "join_tables", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
        assert CliRunner().invoke(deepaccident, ["index", str(root), "--check"]).exit_code == 1
    (found,) = report(root, "--check")
    assert (found["state"], found["edited"]) == ("out of date", [])  # the shard is new, the tables are not


@pytest.mark.parametrize(
    ("version", "text", "state"),
    [(9, None, "a newer devkit's"), (0, None, "an older devkit's"), (1, "{", "unreadable"), (1, "gone", "unfinished")],
)
def test_info_of_an_index_that_cannot_be_opened(root: Path, version: int, text: str | None, state: str) -> None:
    run(root)
    path = root / ".deepaccident" / "v1" / "manifest.json"
    content = json.dumps({**json.loads(path.read_text()), "schema_version": version})
    path.write_text(content if text is None else text)
    if text == "gone":
        path.unlink()
    (found,) = report(root)
    assert (found["state"], found["tables"]) == (state, {})
    assert f": {state}\n" in info(root, "--check")


def test_info_of_indexes_in_more_than_one_place(root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index_in_the_cache(root, monkeypatch)
    run(root)  # the cached one is found
    assert [cache in Path(found["folder"]).parents for found in report(root)] == [True]
    label(root).write_text("0 0\ncar 1 2")
    label(root).with_name("now.tmp").touch()
    assert CliRunner().invoke(deepaccident, ["index", str(root), "--on-error", "skip"]).exit_code == 0
    own, cached = report(root)
    assert (own["state"], cached["state"]) == ("up to date", "out of date")
    assert "found 3" in own["left_out"][tiny.TOKEN][0]
    assert f"left out: {tiny.TOKEN}" in info(root)
    assert report(root, "--index-dir", root.parent / "nowhere") == []
    assert "no index; looked in" in info(root, "--index-dir", root.parent / "nowhere")
    shutil.rmtree(root / tiny.TYPE)
    assert {found["state"] for found in report(root)} == {"no release"}


def test_info_of_no_release(tmp_path: Path) -> None:
    with pytest.raises(DatarootError, match="does not exist"):
        index_report(tmp_path / "nowhere")
    with pytest.raises(VersionError, match="unknown version 'v2'"):
        index_report(tmp_path, version="v2")


def test_clear_removes_every_index_and_says_what(root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    index_in_the_cache(root, monkeypatch)
    own = INDEX_FOLDER
    shutil.copytree(next(cache.rglob("v1")), root / own / "v1")
    (root / own / "v1" / ".tables-0123.abcd").mkdir()
    (root / own / "v1" / ".tables-0123.abcd" / ".track.size.part").write_bytes(b"half")
    (root / own / "v1" / ".manifest.json.1.tmp").write_bytes(b"half")
    (root / own / "v1" / indexing.MARK_FILE).touch()
    release = {path: path.read_bytes() for path in root.rglob("*") if path.is_file() and own not in path.parts}
    lines = run(root, "--clear").splitlines()
    assert lines[0].startswith(f"removed {root / own / 'v1'}: 18 files, 0.")
    assert lines[1].startswith(f"removed {cache}")
    assert len(lines) == 2
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == release
    assert not (root / own).exists()
    assert not list(cache.rglob("v1"))
    assert run(root, "--clear") == f"{root}: no index to remove\n"


def test_clear_of_a_given_folder_leaves_the_others(root: Path, tmp_path: Path) -> None:
    run(root)
    run(root, "--index-dir", tmp_path / "given")
    run(root, "--index-dir", tmp_path / "given", "--clear")
    assert list((tmp_path / "given").iterdir()) == []
    assert report(root)[0]["state"] == "up to date"
    run(root, "--version", "v1-mini", "--clear")
    assert report(root)[0]["state"] == "up to date"
    (root / ".deepaccident" / "v1" / "manifest.json").unlink()
    assert len(clear_index(root)) == 1  # what a stopped process left is an index too
    with pytest.raises(VersionError, match="version: expected one of v1, v1-mini, found 'v2'"):
        clear_index(root, version="v2")


FOREIGN = {
    "a file": "notes.txt",
    "a folder": "images/1.png",
    "a file of shards": "shards/train/000.tar",
    "a file in tables": "tables-01/notes.txt",
    "another manifest": "manifest.json",
}


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.parametrize("beside_an_index", [False, True])
def test_clear_refuses_what_is_no_index(root: Path, tmp_path: Path, name: str, beside_an_index: bool) -> None:
    folder = tmp_path / "given"
    if beside_an_index:
        if name == "another manifest":
            pytest.skip("beside shards and tables it is a damaged one")
        run(root, "--index-dir", folder)
    path = folder / "v1" / FOREIGN[name]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("{}")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(IndexStoreError, match=r"v1: not removed: it holds what is no part of an index: .*;"):
        clear_index(root, index_dir=folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_clear_follows_no_symbolic_link(root: Path, tmp_path: Path) -> None:
    run(root)
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "one.arrow").touch()
    (root / ".deepaccident" / "v1" / "tables-linked").symlink_to(precious)
    with pytest.raises(IndexStoreError, match="no part of an index: tables-linked"):
        clear_index(root)
    assert (precious / "one.arrow").exists()
    (root / ".deepaccident" / "v1" / "tables-linked").unlink()
    (root / ".deepaccident" / "v1").rename(precious / "v1")
    (root / ".deepaccident" / "v1").symlink_to(precious / "v1")  # the whole index on another disk
    assert len(clear_index(root)) == 1
    assert not list((precious / "v1").iterdir())


def test_clear_waits_for_a_process_that_indexes(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    run(root)
    lock = FileLock(root / ".deepaccident" / "v1" / ".lock")
    lock.acquire()
    thread = threading.Thread(target=clear_index, args=(root,))
    thread.start()
    while "another process makes an index there; waiting" not in caplog.text and thread.is_alive():
        time.sleep(0.01)
    assert (root / ".deepaccident" / "v1" / "manifest.json").exists()
    lock.release()
    thread.join(timeout=60)
    assert not (root / ".deepaccident").exists()


def test_clear_of_a_folder_that_cannot_be_emptied(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(root)

    def closed(*_arguments: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(shutil, "rmtree", closed)
    with pytest.raises(IndexStoreError, match=r"v1: cannot be removed \(.*Permission denied"):
        clear_index(root)
