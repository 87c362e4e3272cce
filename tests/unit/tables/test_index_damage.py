"""An index whose files were damaged, and a release whose files changed behind their sizes and
times.

As a script it is the process that opens damaged tables: `python test_index_damage.py FOLDER`.
"""

import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
import tiny
from click.testing import CliRunner
from refusals import assert_refused
from tiny_index import INDEX, OTHER, contents, label, opened, rewrite

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import (
    BrokenReleaseError,
    DeepAccidentError,
    IndexStoreError,
    OutputFolderError,
)
from deepaccident_devkit.tables import OpenTables, Table, indexing
from deepaccident_devkit.tables.arrow_files import StoredTable, write_table
from deepaccident_devkit.tables.index import MANIFEST_FILE
from deepaccident_devkit.tables.records import table_spec

MUTATIONS = 120


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tiny.write_tiny_release(tmp_path / "release")


def check(root: Path, verb: str = "check index") -> None:
    result = CliRunner().invoke(deepaccident, [*verb.split(), str(root)])
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("mend", ["index", "check index"])
def test_a_value_that_was_restored_behind_its_size_and_time_is_seen_by_index(
    root: Path, mend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a file system without ctimes by `check index` alone."""

    def points(release: DeepAccident) -> int:
        number: int = release.get("annotation", f"{tiny.TOKEN}/ego_vehicle/002/1")["num_lidar_pts"]
        return number

    if mend == "check index":
        monkeypatch.setattr(indexing, "times_digest", lambda _: "0" * 32)
    rewrite(label(root), " 1300 12 ", " 1300 72 ")
    opened(root)
    rewrite(label(root), " 1300 72 ", " 1300 12 ")
    assert points(opened(root)) == 72  # opening looks at folders; schema/README.md says so
    check(root, mend)
    assert points(opened(root)) == 12


def test_a_broken_scenario_that_was_restored_behind_its_size_and_time_opens(root: Path) -> None:
    opened(root)
    rewrite(label(root), "van", "vat")
    assert CliRunner().invoke(deepaccident, ["check", "index", str(root)]).exit_code == 1
    assert_refused((lambda: opened(root), BrokenReleaseError, "class is 'vat'"))
    rewrite(label(root), "vat", "van")
    assert len(opened(root).scenario) == 1


def test_a_scenario_that_moved_to_another_split_is_found_there(tmp_path: Path) -> None:
    tiny.write_tiny_release(tmp_path / "train")
    assert [scenario["folder"] for scenario in opened(tmp_path).scenario] == ["train"]
    (tmp_path / "train").rename(tmp_path / "val")  # no folder of the scenario's own has a new time
    release = opened(tmp_path)
    assert [scenario["folder"] for scenario in release.scenario] == ["val"]
    assert release.get_sample_data_path(f"{tiny.TOKEN}/ego_vehicle/001/lidar01").is_relative_to(
        tmp_path / "val"
    )


def mutated(content: bytes, seed: int) -> bytes:
    """With a bit flipped, a number replaced, bytes cut, put in or zeroed; mostly where Arrow's own
    numbers are.
    """
    source = random.Random(seed)  # noqa: S311 - the same damage every time
    place = source.choice(
        (source.randrange(len(content)), source.randrange(2000), -1 - source.randrange(2500))
    )
    place %= len(content)
    before, after = content[:place], content[place:]
    word = source.choice((b"\xff\xff\xff\xff", b"\0\0\0\x80", b"\xff\xff\xff\x7f", b"\1\0\0\0"))
    ways = (
        bytes([after[0] ^ 1 << source.randrange(8)]) + after[1:],
        word + after[4:],
        b"",
        bytes(8) + after,
        bytes(len(after[:64])) + after[64:],
    )
    return before + source.choice((ways[0], *ways))


def read_all(folder: Path) -> None:
    """Every record by row and by token, every box, and every table as Arrow."""
    release = DeepAccident.__new__(DeepAccident)
    OpenTables.__init__(
        release, dataroot=folder, version="v1", layout="A", split_files={}, tables_folder=folder
    )
    for name in release.table_names:
        table: Table[dict[str, object]] = getattr(release, name)
        table.arrow.to_pylist()
        for record in table:
            table.row(str(record.get("token")))
    for sample in release.sample:
        release.boxes(sample, "world")


def replace(path: Path, content: bytes) -> None:
    """Write a new file: the pages of the old one may still be mapped."""
    path.unlink()
    path.write_bytes(content)


def main(folder: Path) -> None:
    names = sorted(path.name for path in folder.iterdir())
    for seed in range(MUTATIONS):
        path = folder / names[seed % len(names)]
        whole = path.read_bytes()
        replace(path, mutated(whole, seed))
        try:
            read_all(folder)
            outcome = "read"
        except DeepAccidentError as error:
            outcome = type(error).__name__ if len(str(error)) < 600 else "a long message"
        except Exception as error:  # noqa: BLE001 - what is looked for
            outcome = f"{path.name} {seed}: {error!r}"
        replace(path, whole)
        print(outcome, flush=True)


@pytest.mark.slow
def test_damaged_tables_end_in_our_error_and_never_in_a_crash(root: Path, tmp_path: Path) -> None:
    shutil.copytree(opened(root).tables_folder, tmp_path / "tables")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(tiny.__file__).parent), *sys.path]),
    }
    command = [sys.executable, __file__, str(tmp_path / "tables")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, env=environment
    )
    outcomes = Counter(done.stdout.splitlines())
    assert (done.returncode, set(outcomes)) == (
        0,
        {"read", "IndexStoreError", "TokenError"} & set(outcomes),
    )
    assert sum(outcomes.values()) == MUTATIONS
    assert outcomes["IndexStoreError"] > MUTATIONS / 3


TEXTS = (
    "",
    "{",
    "[]",
    "null",
    '{"schema_version": "2"}',
    "[" * 100_000,
    '{"schema_version": true}',
    "\0",
)


@pytest.mark.parametrize(
    "damage",
    [*TEXTS, {"table_files": {}}, {"tables": "../../elsewhere"}, {"tables": 5}, {"problems": 5}],
)
def test_a_manifest_of_something_else_is_made_again(
    root: Path, damage: str | dict[str, object]
) -> None:
    """A text, or an entry that is wrong under a checksum that is right."""
    opened(root)
    before, path = contents(root / INDEX), root / INDEX / MANIFEST_FILE
    if isinstance(damage, dict):
        content = {**json.loads(path.read_text()), **damage}
        del content["checksum"]
        digest = hashlib.blake2b(
            json.dumps(content, sort_keys=True).encode(), digest_size=16
        ).hexdigest()
        damage = json.dumps({**content, "checksum": digest})
    path.write_text(damage)
    assert (len(opened(root).scenario), contents(root / INDEX)) == (1, before)


def test_a_damaged_manifest_is_made_again(root: Path) -> None:
    rewrite(label(root), "van", "vat")
    assert_refused((lambda: opened(root), BrokenReleaseError, "class is 'vat'"))
    path = root / INDEX / MANIFEST_FILE
    before = path.read_bytes()
    for place in range(0, len(before), len(before) // 25):
        path.write_bytes(before[:place] + bytes([before[place] ^ 1]) + before[place + 1 :])
        assert_refused(
            (
                lambda: opened(root),
                BrokenReleaseError,
                ("1 of 1 scenarios are broken", "class is 'vat'"),
            )
        )
        assert path.read_bytes() == before, place


@pytest.mark.parametrize(
    "damage", [lambda track: track.write_bytes(track.read_bytes()[:100]), Path.unlink]
)
def test_damaged_tables_are_made_again(root: Path, damage: Callable[[Path], object]) -> None:
    tables = opened(root).tables_folder
    before = contents(tables)
    damage(tables / "track.arrow")
    assert contents(opened(root).tables_folder) == before


@pytest.mark.parametrize(
    "damage", [lambda whole: whole[:-1], lambda whole: whole[:9] + b"!" + whole[10:], lambda _: b""]
)
def test_damaged_rows_are_made_again(root: Path, damage: Callable[[bytes], bytes]) -> None:
    opened(root)
    path = root / INDEX / "kept" / tiny.TOKEN
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    tiny.write_tiny_release(root, name=OTHER)
    assert (len(opened(root).scenario), path.read_bytes()) == (2, whole)


@pytest.mark.parametrize("name", [MANIFEST_FILE, f"kept/{tiny.TOKEN}", "tables"])
def test_nobody_waits_for_a_pipe(root: Path, name: str) -> None:
    tables = opened(root).tables_folder
    before = contents(root / INDEX)
    path = tables / "track.arrow" if name == "tables" else root / INDEX / name
    path.unlink()
    os.mkfifo(path)
    if name == "tables":
        with pytest.raises(IndexStoreError, match=r"not a regular file \(a named pipe\)"):
            StoredTable(tables, table_spec("track"))
    check(root)
    assert contents(root / INDEX) == before


def test_limits_that_cannot_be_understood_cost_no_index(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened(root)
    before = contents(root / INDEX)
    monkeypatch.setenv("DEEPACCIDENT_LIMITS", "labels=1G")
    assert_refused(
        (
            lambda: opened(root),
            IndexStoreError,
            r"^DEEPACCIDENT_LIMITS: expected .* found 'labels=1G'$",
        )
    )
    assert contents(root / INDEX) == before


def test_a_table_that_arrow_would_read_beyond_its_memory_is_refused(tmp_path: Path) -> None:
    spec = table_spec("category")
    write_table(tmp_path, spec, {"name": [0, -100], "index": [0, 1]})
    stored = StoredTable(tmp_path, spec)
    assert stored.num_rows == 2
    with pytest.raises(
        IndexStoreError, match=r"category\.arrow: damaged \(.*out of bounds.*check index DATAROOT"
    ):
        _ = stored.table


LINKS = (".lock", "kept", f"kept/{tiny.TYPE}")


@pytest.mark.parametrize("name", LINKS)
def test_nothing_is_written_or_removed_through_a_link(
    root: Path, tmp_path: Path, name: str
) -> None:
    precious = tmp_path / "precious"
    (precious / "sub").mkdir(parents=True)
    (precious / "sub" / "own.arrow").write_bytes(b"precious")
    (root / INDEX / name).parent.mkdir(parents=True)
    (root / INDEX / name).symlink_to(
        precious / "sub" / "own.arrow" if name == ".lock" else precious
    )
    assert_refused(
        (
            lambda: opened(root),
            OutputFolderError,
            "a symbolic link, which no devkit makes; remove it",
        )
    )
    assert contents(precious) == {"sub/own.arrow": b"precious"}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
