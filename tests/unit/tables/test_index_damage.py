"""An index whose files were damaged, and a release whose files changed behind their sizes and times.

As a script it is the process that opens damaged tables: `python test_index_damage.py FOLDER`.
"""

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

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import BrokenReleaseError, DeepAccidentError, IndexStoreError
from deepaccident_devkit.tables import OpenTables, Table, indexing
from deepaccident_devkit.tables.manifest import MANIFEST_FILE
from deepaccident_devkit.tables.specs import table_spec
from deepaccident_devkit.tables.store import StoredTable, write_table

MUTATIONS = 120
INDEX = Path(".deepaccident") / "v1"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tiny.write_tiny_release(tmp_path / "release")


def opened(root: Path, **arguments: object) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False, **arguments)  # type: ignore[arg-type]


def check(root: Path) -> None:
    result = CliRunner().invoke(deepaccident, ["index", str(root), "--check"])
    assert result.exit_code == 0, result.output


def state(root: Path) -> str:
    result = CliRunner().invoke(deepaccident, ["index", "info", str(root), "--check", "--json"])
    found: str = json.loads(result.stdout)["indexes"][0]["state"]
    return found


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def label(root: Path) -> Path:
    return root / tiny.TYPE / "ego_vehicle" / "label" / tiny.NAME / f"{tiny.NAME}_002.txt"


def rewrite(path: Path, old: str, new: str) -> None:
    """Change a file as a damaged disk or a restored archive does: its size and times stay, and its folder's too."""
    before, folder = path.stat(), path.parent.stat()
    path.write_text(path.read_text().replace(old, new))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    os.utime(path.parent, ns=(folder.st_atime_ns, folder.st_mtime_ns))
    assert path.stat().st_size == before.st_size


def test_a_value_that_was_restored_behind_its_size_and_time_is_seen_by_check(root: Path) -> None:
    def points(release: DeepAccident) -> int:
        number: int = release.get("annotation", f"{tiny.TOKEN}/ego_vehicle/002/1")["num_lidar_pts"]
        return number

    rewrite(label(root), " 1300 12 ", " 1300 72 ")
    damaged = opened(root).tables_folder
    rewrite(label(root), " 1300 72 ", " 1300 12 ")
    assert points(opened(root)) == 72  # opening compares no contents; schema/README.md says so
    assert state(root) == "out of date"
    check(root)
    assert (points(opened(root)), state(root)) == (12, "up to date")
    assert opened(root).tables_folder != damaged  # nobody's open tables are overwritten


def test_a_broken_scenario_that_was_restored_behind_its_size_and_time_opens(root: Path) -> None:
    opened(root)
    rewrite(label(root), "van", "vat")
    assert state(root) == "out of date"
    assert CliRunner().invoke(deepaccident, ["index", str(root), "--check"]).exit_code == 1
    with pytest.raises(BrokenReleaseError, match="class is 'vat'"):
        opened(root)
    rewrite(label(root), "vat", "van")
    assert len(opened(root).scenario) == 1


def test_a_scenario_that_moved_to_another_split_is_found_there(tmp_path: Path) -> None:
    tiny.write_tiny_release(tmp_path / "train")
    assert [scenario["folder"] for scenario in opened(tmp_path).scenario] == ["train"]
    (tmp_path / "train").rename(tmp_path / "val")  # no folder of the scenario's own has a new time
    release = opened(tmp_path)
    assert [scenario["folder"] for scenario in release.scenario] == ["val"]
    assert release.get_sample_data_path(f"{tiny.TOKEN}/ego_vehicle/001/lidar01").is_relative_to(tmp_path / "val")


def test_check_reads_no_scenario_again_without_a_cause(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(root / tiny.TYPE / "other_vehicle" / "calib")  # its labels are not read, but compared
    before = contents(opened(root).tables_folder.parent)
    monkeypatch.setattr(indexing, "read_scenario", lambda *_: pytest.fail("read again"))
    assert state(root) == "up to date"
    check(root)
    assert contents(root / INDEX) == before


def mutated(content: bytes, seed: int) -> bytes:
    """With a bit flipped, a number replaced, bytes cut, put in or zeroed; mostly where Arrow's own numbers are."""
    source = random.Random(seed)  # noqa: S311 - the same damage every time
    place = source.choice((source.randrange(len(content)), source.randrange(2000), -1 - source.randrange(2500)))
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
    OpenTables.__init__(release, dataroot=folder, version="v1", layout="A", split_files={}, tables_folder=folder)
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
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(tiny.__file__).parent), *sys.path])}
    command = [sys.executable, __file__, str(tmp_path / "tables")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=environment)
    outcomes = Counter(done.stdout.splitlines())
    assert (done.returncode, set(outcomes)) == (0, {"read", "IndexStoreError", "TokenError"} & set(outcomes))
    assert sum(outcomes.values()) == MUTATIONS
    assert outcomes["IndexStoreError"] > MUTATIONS / 3


@pytest.mark.slow
def test_check_finds_and_mends_every_damage(root: Path) -> None:
    folder = opened(root).tables_folder.parent
    before = contents(folder)
    names = [name for name in before if name.endswith((".arrow", MANIFEST_FILE))]
    for seed in range(2 * len(names)):
        path = folder / names[seed % len(names)]
        replace(path, mutated(path.read_bytes(), seed))
        if path.read_bytes() != before[names[seed % len(names)]]:
            assert state(root) != "up to date", path
        check(root)
        assert contents(folder) == before, path


def test_a_damaged_manifest_is_made_again(root: Path) -> None:
    rewrite(label(root), "van", "vat")
    with pytest.raises(BrokenReleaseError, match="class is 'vat'") as told:
        opened(root)
    path = root / INDEX / MANIFEST_FILE
    before = path.read_bytes()
    for place in range(0, len(before), len(before) // 25):
        path.write_bytes(before[:place] + bytes([before[place] ^ 1]) + before[place + 1 :])
        with pytest.raises(BrokenReleaseError, match="1 of 1 scenarios are broken") as again:
            opened(root)
        assert (str(again.value), path.read_bytes()) == (str(told.value), before), place


@pytest.mark.parametrize("name", [MANIFEST_FILE, f"shards/{tiny.TYPE}/{tiny.NAME}.arrow", "tables"])
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


def test_limits_that_cannot_be_understood_cost_no_index(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened(root)
    before = contents(root / INDEX)
    monkeypatch.setenv("DEEPACCIDENT_LIMITS", "labels=1G")
    with pytest.raises(IndexStoreError, match=r"^DEEPACCIDENT_LIMITS: expected .* found 'labels=1G'$"):
        opened(root)
    assert contents(root / INDEX) == before


def linked(path: Path, target: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(target)


LINKS: dict[str, Callable[[Path, Path], None]] = {
    "the shards": lambda index, target: linked(index / "shards", target),
    "some shards": lambda index, target: linked(index / "shards" / tiny.TYPE, target / "sub"),
    "the lock": lambda index, target: linked(index / ".lock", target / "sub" / "own.arrow"),
}


@pytest.mark.parametrize("what", LINKS)
def test_nothing_is_written_or_removed_through_a_link(root: Path, tmp_path: Path, what: str) -> None:
    precious = tmp_path / "precious"
    (precious / "sub").mkdir(parents=True)
    (precious / "sub" / "own.arrow").write_bytes(b"precious")
    LINKS[what](root / INDEX, precious)
    with pytest.raises(IndexStoreError, match="a symbolic link, which no devkit makes; remove it"):
        opened(root)
    assert contents(precious) == {"sub/own.arrow": b"precious"}


def test_a_table_that_arrow_would_read_beyond_its_memory_is_refused(tmp_path: Path) -> None:
    spec = table_spec("category")
    write_table(tmp_path, spec, {"name": [0, -100], "index": [0, 1]})
    stored = StoredTable(tmp_path, spec)
    assert stored.num_rows == 2
    with pytest.raises(IndexStoreError, match=r"category\.arrow: damaged \(.*out of bounds.*index DATAROOT --check"):
        _ = stored.table


if __name__ == "__main__":
    main(Path(sys.argv[1]))
