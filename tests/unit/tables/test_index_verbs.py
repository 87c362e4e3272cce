"""`deepaccident index` and `index --clear`, and the functions behind them."""

import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
from click.testing import CliRunner
from refusals import assert_refused
from tiny_index import INDEX, contents, opened

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import IndexStoreError, VersionError
from deepaccident_devkit.support import files
from deepaccident_devkit.tables import clear_index
from deepaccident_devkit.tables import index as index_module
from deepaccident_devkit.tables.index import MANIFEST_FILE, SCHEMA_VERSION


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def run(*arguments: object) -> str:
    result = CliRunner().invoke(deepaccident, ["index", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def index_in_the_cache(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(index_module, "is_writable_folder", lambda path: root not in path.parents)
        opened(root)


@pytest.mark.parametrize("arguments", ["index", "index a b", "index a --clear --check"])
def test_wrong_usage_is_status_2(arguments: str) -> None:
    result = CliRunner().invoke(deepaccident, arguments.split())
    assert result.exit_code == 2
    assert "Usage: " in result.output


def test_clear_removes_every_index_and_says_what(root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release = contents(root)
    index_in_the_cache(root, monkeypatch)
    own = root / INDEX
    shutil.copytree(next(cache.rglob("v1")), own)
    left = (
        ".tables-01.1.tmp/.track.arrow.1.tmp",
        ".manifest.json.1.tmp",
        "shards/type/a.arrow",
        ".unfinished",
        ".making",
    )
    kept = ("tables-01/interactions/kept/type/a", "tables-01/town_map-01.npz", "tables-01/thumbnails/01/a.jpg")
    for name in (*left, *kept):
        (own / name).parent.mkdir(parents=True, exist_ok=True)
        (own / name).touch()
    (found,) = cache.rglob("v1")
    assert run(root, "--clear").splitlines() == [f"removed {own}", f"removed {found}"]
    assert contents(root) == release
    assert not own.parent.exists()
    assert not list(cache.rglob("v1"))
    assert run(root, "--clear") == f"{root}: no index to remove\n"


def test_clear_of_a_given_folder_leaves_the_others(root: Path, tmp_path: Path) -> None:
    run(root)
    run(root, "--index-dir", tmp_path / "given")
    for place in (("--index-dir", tmp_path / "given"), ("--version", "v1-mini")):
        run(root, *place, "--clear")
        assert (root / INDEX / MANIFEST_FILE).exists()
    assert list((tmp_path / "given").iterdir()) == []
    (root / INDEX / MANIFEST_FILE).unlink()
    assert len(clear_index(root)) == 1  # what a stopped process left is an index too
    assert_refused((lambda: clear_index(root, version="v2"), VersionError, ("version", "v1, v1-mini", "'v2'")))


@pytest.mark.parametrize(
    "name", ["notes.txt", "images/1.png", "shards/train/000.tar", "tables-01/notes.txt", "tables-01/linked"]
)
def test_clear_refuses_what_is_no_index(root: Path, tmp_path: Path, name: str) -> None:
    folder, path = tmp_path / "given", tmp_path / "given" / "v1" / name
    path.parent.mkdir(parents=True)
    path.symlink_to(root) if name.endswith("linked") else path.write_text("{}")
    before = contents(folder)
    if "tables" not in name:
        assert clear_index(root, index_dir=folder) == []
    run(root, "--index-dir", folder)
    path.parent.mkdir(parents=True, exist_ok=True)  # what looks like tables was removed
    path.write_text("{}")
    assert_refused((lambda: clear_index(root, index_dir=folder), IndexStoreError, ("v1: not removed", f"{name};")))
    assert contents(folder).items() > before.items()


def test_clear_leaves_another_manifest(root: Path, tmp_path: Path) -> None:
    (tmp_path / "v1").mkdir()
    (tmp_path / "v1" / MANIFEST_FILE).write_text("{}")
    assert clear_index(root, index_dir=tmp_path) == []
    assert (tmp_path / "v1" / MANIFEST_FILE).exists()


def test_clear_follows_no_symbolic_link(root: Path, tmp_path: Path) -> None:
    run(root)
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "one.arrow").touch()
    (root / INDEX / "tables-linked").symlink_to(precious)
    assert_refused((lambda: clear_index(root), IndexStoreError, "no part of an index: tables-linked"))
    assert (precious / "one.arrow").exists()
    assert (root / INDEX / MANIFEST_FILE).exists()


def test_an_index_on_another_disk_is_cleared_there(root: Path, tmp_path: Path) -> None:
    run(root)
    (root / INDEX).rename(tmp_path / "v1")
    (root / INDEX).symlink_to(tmp_path / "v1")
    assert len(clear_index(root)) == 1
    assert not list((tmp_path / "v1").iterdir())


def test_a_newer_devkits_index_is_refused_and_kept_until_it_is_cleared(root: Path, tmp_path: Path) -> None:
    run(root)
    path = root / INDEX / MANIFEST_FILE
    path.write_text(json.dumps({**json.loads(path.read_text()), "schema_version": SCHEMA_VERSION + 1}))
    before = contents(root)
    sentence = (
        rf"{path}: a newer devkit's index \(schema version {SCHEMA_VERSION + 1}, this devkit's is {SCHEMA_VERSION}\); "
        r"update the devkit, give another index_dir=, or remove the index with: deepaccident index DATAROOT --clear"
    )
    assert_refused((lambda: opened(root), IndexStoreError, sentence))
    assert (contents(root), len(opened(root, tmp_path / "own").scenario)) == (before, 2)
    run(root, "--clear")
    assert len(opened(root).scenario) == 2


def test_clear_of_a_folder_that_cannot_be_emptied(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(root)
    monkeypatch.setattr(files.shutil, "rmtree", Mock(side_effect=PermissionError(13, "Permission denied")))
    assert_refused((lambda: clear_index(root), IndexStoreError, r"v1: cannot be removed \(.*Permission denied"))
