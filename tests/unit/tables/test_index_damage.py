"""An index with damaged files, and a release with files that changed but kept their size and time.

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
from click.testing import CliRunner
from support import tiny_release
from support.expected_errors import assert_raises
from support.tiny_release_index import (
    INDEX_FOLDER,
    OTHER_SCENARIO,
    folder_contents,
    label_path,
    open_release,
    replace_text,
)

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
    return tiny_release.write_tiny_release(tmp_path / "release")


def invoke_index(root: Path, command: str = "check index") -> None:
    result = CliRunner().invoke(deepaccident, [*command.split(), str(root)])
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("command", ["index", "check index"])
def test_a_value_that_was_restored_behind_its_size_and_time_is_seen_by_index(
    root: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a file system without ctimes, only `check index` sees it."""

    def number_of_points(release: DeepAccident) -> int:
        number: int = release.get("annotation", f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/002/1")[
            "num_lidar_pts"
        ]
        return number

    if command == "check index":
        monkeypatch.setattr(indexing, "times_digest", lambda _: "0" * 32)
    replace_text(label_path(root), " 1300 12 ", " 1300 72 ")
    open_release(root)
    replace_text(label_path(root), " 1300 72 ", " 1300 12 ")
    assert (
        number_of_points(open_release(root)) == 72
    )  # opening looks at folders; schema/README.md says so
    invoke_index(root, command)
    assert number_of_points(open_release(root)) == 12


def test_a_broken_scenario_that_was_restored_behind_its_size_and_time_opens(root: Path) -> None:
    open_release(root)
    replace_text(label_path(root), "van", "vat")
    assert CliRunner().invoke(deepaccident, ["check", "index", str(root)]).exit_code == 1
    assert_raises((lambda: open_release(root), BrokenReleaseError, "class is 'vat'"))
    replace_text(label_path(root), "vat", "van")
    assert len(open_release(root).scenario) == 1


def test_a_scenario_that_moved_to_another_split_is_found_there(tmp_path: Path) -> None:
    tiny_release.write_tiny_release(tmp_path / "train")
    assert [scenario["folder"] for scenario in open_release(tmp_path).scenario] == ["train"]
    (tmp_path / "train").rename(tmp_path / "val")  # no folder of the scenario's own has a new time
    release = open_release(tmp_path)
    assert [scenario["folder"] for scenario in release.scenario] == ["val"]
    assert release.get_sample_data_path(
        f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/001/lidar01"
    ).is_relative_to(tmp_path / "val")


def damage_bytes(content: bytes, seed: int) -> bytes:
    """Flip a bit, replace a number, or cut, insert or zero bytes.

    The damage is mostly where Arrow keeps its own numbers: near the start or the end.
    """
    source = random.Random(seed)  # noqa: S311 - the same damage every time
    offset = source.choice(
        (source.randrange(len(content)), source.randrange(2000), -1 - source.randrange(2500))
    )
    offset %= len(content)
    before, after = content[:offset], content[offset:]
    number = source.choice((b"\xff\xff\xff\xff", b"\0\0\0\x80", b"\xff\xff\xff\x7f", b"\1\0\0\0"))
    flipped = bytes([after[0] ^ 1 << source.randrange(8)]) + after[1:]
    replaced = number + after[4:]
    cut = b""
    inserted = bytes(8) + after
    zeroed = bytes(len(after[:64])) + after[64:]
    # bits are flipped twice as often
    return before + source.choice((flipped, flipped, replaced, cut, inserted, zeroed))


def read_all_tables(folder: Path) -> None:
    """Read every record by row and by token, every box, and every table as Arrow."""
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


def replace_file(path: Path, content: bytes) -> None:
    """Write a new file: the pages of the old one may still be mapped."""
    path.unlink()
    path.write_bytes(content)


def main(folder: Path) -> None:
    names = sorted(path.name for path in folder.iterdir())
    for seed in range(MUTATIONS):
        path = folder / names[seed % len(names)]
        content = path.read_bytes()
        replace_file(path, damage_bytes(content, seed))
        try:
            read_all_tables(folder)
            outcome = "read"
        except DeepAccidentError as error:
            is_short = len(str(error)) < 600
            outcome = type(error).__name__ if is_short else "a long message"
        except Exception as error:  # noqa: BLE001 - the test looks for these
            outcome = f"{path.name} {seed}: {error!r}"
        replace_file(path, content)
        print(outcome, flush=True)


@pytest.mark.slow
def test_damaged_tables_end_in_our_error_and_never_in_a_crash(root: Path, tmp_path: Path) -> None:
    shutil.copytree(open_release(root).tables_folder, tmp_path / "tables")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(tiny_release.__file__).parents[1]), *sys.path]),
    }
    command = [sys.executable, __file__, str(tmp_path / "tables")]
    process = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, env=environment
    )
    outcomes = Counter(process.stdout.splitlines())
    assert process.returncode == 0
    assert set(outcomes) <= {"read", "IndexStoreError", "TokenError"}
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
    """It is another text, or one entry is wrong while the checksum is right."""
    open_release(root)
    before = folder_contents(root / INDEX_FOLDER)
    path = root / INDEX_FOLDER / MANIFEST_FILE
    if isinstance(damage, dict):
        manifest = {**json.loads(path.read_text()), **damage}
        del manifest["checksum"]
        text = json.dumps(manifest, sort_keys=True)
        checksum = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
        damage = json.dumps({**manifest, "checksum": checksum})

    path.write_text(damage)
    assert len(open_release(root).scenario) == 1
    assert folder_contents(root / INDEX_FOLDER) == before


def test_a_damaged_manifest_is_made_again(root: Path) -> None:
    replace_text(label_path(root), "van", "vat")
    assert_raises((lambda: open_release(root), BrokenReleaseError, "class is 'vat'"))
    path = root / INDEX_FOLDER / MANIFEST_FILE
    before = path.read_bytes()
    for offset in range(0, len(before), len(before) // 25):
        path.write_bytes(before[:offset] + bytes([before[offset] ^ 1]) + before[offset + 1 :])
        assert_raises(
            (
                lambda: open_release(root),
                BrokenReleaseError,
                ("errors in 1 of 1 scenario", "class is 'vat'"),
            )
        )
        assert path.read_bytes() == before, offset


@pytest.mark.parametrize(
    "damage", [lambda track: track.write_bytes(track.read_bytes()[:100]), Path.unlink]
)
def test_damaged_tables_are_made_again(root: Path, damage: Callable[[Path], object]) -> None:
    tables = open_release(root).tables_folder
    before = folder_contents(tables)
    damage(tables / "track.arrow")
    assert folder_contents(open_release(root).tables_folder) == before


@pytest.mark.parametrize(
    "damage", [lambda rows: rows[:-1], lambda rows: rows[:9] + b"!" + rows[10:], lambda _: b""]
)
def test_damaged_rows_are_made_again(root: Path, damage: Callable[[bytes], bytes]) -> None:
    open_release(root)
    path = root / INDEX_FOLDER / "kept" / tiny_release.SCENARIO_TOKEN
    rows = path.read_bytes()
    path.write_bytes(damage(rows))
    tiny_release.write_tiny_release(root, name=OTHER_SCENARIO)
    assert len(open_release(root).scenario) == 2
    assert path.read_bytes() == rows


@pytest.mark.parametrize("name", [MANIFEST_FILE, f"kept/{tiny_release.SCENARIO_TOKEN}", "tables"])
def test_nobody_waits_for_a_pipe(root: Path, name: str) -> None:
    tables = open_release(root).tables_folder
    before = folder_contents(root / INDEX_FOLDER)
    path = tables / "track.arrow" if name == "tables" else root / INDEX_FOLDER / name
    path.unlink()
    os.mkfifo(path)
    if name == "tables":
        with pytest.raises(IndexStoreError, match=r"not a regular file \(a named pipe\)"):
            StoredTable(tables, table_spec("track"))
    invoke_index(root)
    assert folder_contents(root / INDEX_FOLDER) == before


def test_limits_that_cannot_be_understood_cost_no_index(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_release(root)
    before = folder_contents(root / INDEX_FOLDER)
    monkeypatch.setenv("DEEPACCIDENT_LIMITS", "labels=1G")
    assert_raises(
        (
            lambda: open_release(root),
            IndexStoreError,
            r"^DEEPACCIDENT_LIMITS: expected .* found 'labels=1G'$",
        )
    )
    assert folder_contents(root / INDEX_FOLDER) == before


def test_a_table_that_arrow_would_read_beyond_its_memory_is_refused(tmp_path: Path) -> None:
    spec = table_spec("category")
    write_table(tmp_path, spec, {"name": [0, -100], "index": [0, 1]})
    stored = StoredTable(tmp_path, spec)
    assert stored.num_rows == 2
    with pytest.raises(
        IndexStoreError, match=r"category\.arrow: damaged \(.*out of bounds.*check index DATAROOT"
    ):
        _ = stored.table


LINKS = (".lock", "kept", f"kept/{tiny_release.SCENARIO_TYPE}")


@pytest.mark.parametrize("name", LINKS)
def test_nothing_is_written_or_removed_through_a_link(
    root: Path, tmp_path: Path, name: str
) -> None:
    precious = tmp_path / "precious"
    (precious / "sub").mkdir(parents=True)
    (precious / "sub" / "own.arrow").write_bytes(b"precious")
    link = root / INDEX_FOLDER / name
    link.parent.mkdir(parents=True)
    link.symlink_to(precious / "sub" / "own.arrow" if name == ".lock" else precious)
    assert_raises(
        (
            lambda: open_release(root),
            OutputFolderError,
            "is a symbolic link, which the devkit never creates; remove it",
        )
    )
    assert folder_contents(precious) == {"sub/own.arrow": b"precious"}


if __name__ == "__main__":
    main(Path(sys.argv[1]))
