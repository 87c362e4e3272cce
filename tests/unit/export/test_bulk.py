"""Exports write complete files, refuse unfit folders, and survive stops and shared folders."""

import errno
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from support import stopped_index_process
from support.expected_errors import assert_raises
from support.tiny_format import KilledFormat, TinyFormat

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    ExportError,
    IndexStoreError,
    MissingFileError,
    NotAvailableError,
    OutputFolderError,
    SensorFileError,
    SomeFailedError,
    WorkerError,
)
from deepaccident_devkit.export.av2 import Av2
from deepaccident_devkit.export.bulk import (
    Export,
    Exported,
    Format,
    LinkKind,
    Manifest,
    Output,
    export_release,
)
from deepaccident_devkit.export.clips import Clips
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.questions import Questions
from deepaccident_devkit.export.release import ReleasePart
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.support.files import temporary_of, temporary_path
from deepaccident_devkit.support.parallel import Store
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables import current_index
from deepaccident_devkit.training.image_cache import CachedImages

pytestmark = pytest.mark.slow

NUM_SCENARIOS = 3
NUM_PICTURES = 18
MANIFEST = "tiny.manifest.json"
ARCHIVE = ".deepaccident-tiny.zip"


Contents = dict[str, bytes | None]


def read_contents(folder: Path) -> Contents:
    """Read the content of each path below a folder; it is None for a folder."""
    contents: Contents = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        contents[name] = None if path.is_dir() else path.read_bytes()
    return contents


def read_states(folder: Path) -> dict[str, tuple[int, ...]]:
    """Read the modification time, inode and size of each path, which change with any write."""
    states = {}
    for path in [folder, *folder.rglob("*")]:
        status = path.lstat()
        states[str(path)] = (status.st_mtime_ns, status.st_ino, status.st_size)
    return states


def export(
    dataset: DeepAccident, folder: Path, form: TinyFormat | None = None, **options: Any
) -> Exported:
    return export_release(
        dataset,
        folder,
        form or TinyFormat(),
        **{"workers": 1, **options},
    )


def open_release(root: Path) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False)


def stop_export(
    dataset: DeepAccident, folder: Path, units: int, form: TinyFormat | None = None
) -> None:
    """Begin an export and interrupt it when `units` units are done."""
    write_unit = TinyFormat.write
    remaining = iter(range(units))

    def write_or_stop(self: TinyFormat, *arguments: Any) -> None:
        if next(remaining, None) is None:
            raise KeyboardInterrupt
        write_unit(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TinyFormat, "write", write_or_stop)
        with pytest.raises(KeyboardInterrupt):
            export(dataset, folder, form)


def begin_export(dataset: DeepAccident, folder: Path, units: int) -> None:
    """Export all units, or interrupt the export when `units` units are done."""
    if units < NUM_SCENARIOS:
        stop_export(dataset, folder, units)
    else:
        export(dataset, folder)


@pytest.fixture(scope="module")
def whole_export(small_dataset: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Contents:
    """The contents of a complete export of the small release."""
    return read_contents(export(small_dataset, tmp_path_factory.mktemp("whole") / "out").folder)


def edit_label(root: Path, token: str) -> None:
    """Replace a label file by one without its last box."""
    scenario_type, name = token.split("/")
    path = root / scenario_type / "ego_vehicle" / "label" / name / f"{name}_002.txt"
    lines = path.read_text().splitlines(keepends=True)
    edited = path.with_name("edited")
    edited.write_text("".join(lines[:-1]))
    edited.replace(path)


def remove_scenario(root: Path, token: str) -> None:
    scenario_type, name = token.split("/")
    for folder in (root / scenario_type).glob(f"*/*/{name}"):
        shutil.rmtree(folder)


def test_an_export_counts_its_files_and_describes_itself(
    small_dataset: DeepAccident, tmp_path: Path
) -> None:
    done = export(small_dataset, tmp_path / "deep" / "out")
    files = set(list_files(done.folder)) - {ARCHIVE}
    assert len(files) == NUM_PICTURES + NUM_SCENARIOS * (1 + 3 + 1) + 1 + 1
    assert (done.written, done.kept) == (3, 0)
    assert (done.tally.samples, done.tally.files) == (NUM_PICTURES, NUM_SCENARIOS * 5 + 1)

    manifest = json.loads((done.folder / MANIFEST).read_bytes())
    assert manifest["written"] == asdict(done.tally)
    assert manifest["written"]["left_out"] == {"clouds": NUM_PICTURES, "maps": 1}

    own_files = [name for name in files - {MANIFEST} if not name.endswith(".jpg")]
    num_bytes = sum((done.folder / name).stat().st_size for name in own_files)
    assert manifest["written"]["bytes"] == num_bytes

    hashes = scenario_hashes(small_dataset, [record["token"] for record in small_dataset.scenario])
    assert manifest["release"]["fingerprint"] == fingerprint(hashes)

    settings = {"split": None, "greeting": "hello", "version": "v1"}
    assert manifest["settings"].items() >= settings.items()


@pytest.mark.parametrize(
    ("option", "open_value"),
    [
        ("workers", lambda: nullcontext(2)),
        ("workers", nullcontext),
        ("executor", ThreadPoolExecutor),
        pytest.param("executor", lambda: ProcessPoolExecutor(2, get_context("spawn"))),
    ],
)
def test_workers_and_executors_write_the_same(
    small_dataset: DeepAccident,
    whole_export: Contents,
    tmp_path: Path,
    option: str,
    open_value: Callable[[], Any],
) -> None:
    out = tmp_path / "out"
    with open_value() as value:
        export(small_dataset, out, **{option: value})
        assert read_contents(out) == whole_export
        assert export(small_dataset, out, **{option: value}).kept == NUM_SCENARIOS


def test_a_killed_worker_is_an_error_and_leaves_nothing_half_written(
    small_dataset: DeepAccident, whole_export: Contents, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with pytest.raises(WorkerError, match="was killed"):
        export_release(small_dataset, out, KilledFormat(), workers=2)
    assert not [name for name in read_contents(out) if temporary_of(Path(name).name)]
    assert read_contents(export(small_dataset, out).folder) == whole_export


def test_a_complete_export_stays_unchanged_for_any_kind_of_link(
    small_dataset: DeepAccident, tmp_path: Path
) -> None:
    shares: list[float] = []
    first = export(small_dataset, tmp_path / "out", progress=shares.append)
    before = read_states(tmp_path / "out")
    assert shares == pytest.approx([1 / NUM_SCENARIOS] * NUM_SCENARIOS)

    for form in (TinyFormat(), TinyFormat(link="copy")):
        second = export(small_dataset, tmp_path / "out", form)
        assert (second.written, second.kept) == (0, NUM_SCENARIOS)
        assert second.tally == first.tally
        assert read_states(first.folder) == before


@pytest.mark.parametrize(
    ("form", "message"),
    [
        (TinyFormat(greeting="hi"), "greeting: 'hello', asked for 'hi'"),
        (TinyFormat(split="train"), "split: None, asked for 'train'"),
        (
            TinyFormat(agents=("ego_vehicle",), where=("length>=1",)),
            r"'ego_vehicle'.*where: .*'length>=1'",
        ),
    ],
)
@pytest.mark.parametrize("units", [1, NUM_SCENARIOS])
def test_a_folder_of_other_settings_is_refused(
    small_dataset: DeepAccident, tmp_path: Path, form: TinyFormat, message: str, units: int
) -> None:
    begin_export(small_dataset, tmp_path / "out", units)
    before = read_states(tmp_path)
    with pytest.raises(ConfigError, match=f"out: .*{message}"):
        export(small_dataset, tmp_path / "out", form)
    assert read_states(tmp_path) == before


def test_a_folder_with_other_things_is_refused(small_dataset: DeepAccident, tmp_path: Path) -> None:
    notes = tmp_path / "other" / "notes.txt"
    locked = tmp_path / "locked"
    notes.parent.mkdir()
    notes.touch()
    (locked / ".deepaccident-parts" / ".lock").mkdir(parents=True)
    before = read_states(tmp_path)

    assert_raises(
        (
            lambda: export(small_dataset, notes.parent),
            ExportError,
            ("not empty (notes.txt)", "tiny", "choose a new folder"),
        ),
        (
            lambda: export(small_dataset, notes),
            ExportError,
            ("notes.txt: is a file", "give a folder"),
        ),
        (
            lambda: export(small_dataset, notes / "out"),
            ExportError,
            ("cannot be written", "Not a directory"),
        ),
        (
            lambda: export(small_dataset, Path("/proc/out")),
            ExportError,
            ("/proc/out: cannot be written", "free space there"),
        ),
        (lambda: export(small_dataset, locked), ExportError, "cannot be written"),
        (
            lambda: export(small_dataset, tmp_path / "out", workers=-3),
            ChoiceError,
            ("workers", "at least 1", "-3"),
        ),
    )
    assert read_states(tmp_path) == before


def test_leftovers_from_before_the_manifest_are_accepted(
    small_dataset: DeepAccident, whole_export: Contents, tmp_path: Path
) -> None:
    (tmp_path / ".deepaccident-parts" / "kept" / "tiny").mkdir(parents=True)
    (tmp_path / ".deepaccident-parts" / ".lock").touch()
    temporary_path(tmp_path / MANIFEST).touch()
    assert read_contents(export(small_dataset, tmp_path).folder) == whole_export


def test_a_damaged_archive_of_a_complete_export_is_named(
    release_copy: Path, tmp_path: Path
) -> None:
    out = export(open_release(release_copy), tmp_path / "out").folder
    next(release_copy.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg")).unlink()
    intact = (out / ARCHIVE).read_bytes()
    for content in (b"", intact[:-40], intact[:200] + b"?" + intact[201:]):
        (out / ARCHIVE).write_bytes(content)
        assert_raises(
            (
                lambda: export(open_release(release_copy), out),
                ExportError,
                (ARCHIVE, "remove this file", "the whole export again"),
            )
        )
    for name in ("../../kept.txt", str(tmp_path / "kept.txt")):
        with zipfile.ZipFile(out / ARCHIVE, "w") as archive:
            archive.writestr(name, b"")
        assert_raises(
            (lambda: export(open_release(release_copy), out), OutputFolderError, "kept.txt")
        )
    (out / ARCHIVE).unlink()

    assert export(open_release(release_copy), out).written == NUM_SCENARIOS
    assert read_contents(out) == read_contents(
        export(open_release(release_copy), tmp_path / "fresh").folder
    )
    assert not list(tmp_path.rglob("kept.txt"))


class TestRelease:
    """The release has changed since the export."""

    def test_a_complete_export_is_refused(self, release_copy: Path, tmp_path: Path) -> None:
        dataset = open_release(release_copy)
        out = export(dataset, tmp_path / "out").folder
        before = read_states(out)
        token = dataset.scenario[1]["token"]
        edit_label(release_copy, token)
        parts = (
            "the release or the split file has changed since this export",
            "1 scenario, such as",
            token,
        )

        for _ in range(2):
            assert_raises((lambda: export(open_release(release_copy), out), ExportError, parts))
        assert read_states(out) == before

    def test_files_that_the_index_was_not_made_from_are_refused(
        self, release_copy: Path, tmp_path: Path
    ) -> None:
        """Otherwise the export would hold data of the index with hashes of other files."""
        dataset = open_release(release_copy)
        token = dataset.scenario[1]["token"]
        label = next(release_copy.glob(f"{token.replace('/', '/ego_vehicle/label/')}/*_002.txt"))
        label.write_text(label.read_text() + "\n")
        parts = ("the index is out of date", token, "deepaccident check index DATAROOT")

        assert_raises((lambda: export(dataset, tmp_path / "out"), IndexStoreError, parts))
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize("grows", [True, False])
    def test_a_complete_export_of_another_split_file_is_refused(
        self, small_dataset: DeepAccident, tmp_path: Path, grows: bool
    ) -> None:
        names = [record["token"].replace("/", " ") for record in small_dataset.scenario]
        split_file = tmp_path / "mine.txt"
        split_file.write_text("\n".join(names[: 1 if grows else 3]))
        form = TinyFormat(split=split_file)
        export(small_dataset, tmp_path / "out", form)
        split_file.write_text("\n".join(names[:2]))
        changed = names[1 if grows else 2].replace(" ", "/")

        with pytest.raises(ExportError, match=rf"1 scenario, such as {changed}"):
            export(small_dataset, tmp_path / "out", form)

    @pytest.mark.parametrize("units", [1, NUM_SCENARIOS])
    @pytest.mark.parametrize("change", ["comes", "goes", "another size"])
    def test_only_scenarios_with_other_sensor_files_are_exported_again(
        self, release_copy: Path, tmp_path: Path, units: int, change: str
    ) -> None:
        """The folder, with a complete or a stopped export, ends up equal to a fresh export."""
        token = open_release(release_copy).scenario[0]["token"]
        pattern = f"{token.replace('/', '/ego_vehicle/Camera_Front/')}/*_002.jpg"
        picture = next(release_copy.glob(pattern))
        content = picture.read_bytes()
        if change == "comes":
            picture.unlink()
        out = tmp_path / "out"
        begin_export(open_release(release_copy), out, units)
        before = read_states(out)
        picture.unlink(missing_ok=True)
        if change != "goes":
            picture.write_bytes(content + (b"\0" if change == "another size" else b""))
        done = export(open_release(release_copy), out)

        assert (done.written, done.kept) == (NUM_SCENARIOS - units + 1, units - 1)

        fresh = export(open_release(release_copy), tmp_path / "fresh")
        assert read_contents(out) == read_contents(fresh.folder)
        assert done.tally == fresh.tally

        unchanged = read_states(out).items() & before.items()
        num_unchanged_texts = sum(name.endswith(".txt") for name, _ in unchanged)
        assert num_unchanged_texts >= (units - 1) * 4
        assert export(open_release(release_copy), out).written == 0

    def test_links_to_release_files_leave_the_index_valid(
        self, release_copy: Path, tmp_path: Path
    ) -> None:
        """A new link changes the ctime of a file."""
        done = export(open_release(release_copy), tmp_path / "out")
        assert done.tally.linked
        assert current_index(find_release(release_copy)) is not None

    def test_sensor_files_that_a_format_does_not_need_change_nothing(
        self, release_copy: Path, tmp_path: Path
    ) -> None:
        form = TinyFormat(agents=("other_vehicle",))
        export(open_release(release_copy), tmp_path / "out", form)
        for path in release_copy.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg"):
            path.unlink()
        assert export(open_release(release_copy), tmp_path / "out", form).written == 0

    @pytest.mark.parametrize(
        "moment", ["Store.drop", "Store.remove", "Manifest.write", "Export._remove_other_units"]
    )
    def test_a_call_that_is_killed_while_it_packs_or_unpacks_can_be_repeated(
        self, release_copy: Path, tmp_path: Path, moment: str
    ) -> None:
        name, method = moment.split(".")
        kind = {"Store": Store, "Manifest": Manifest, "Export": Export}[name]
        out = export(open_release(release_copy), tmp_path / "out").folder
        next(release_copy.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg")).unlink()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kind, method, Mock(side_effect=KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                export(open_release(release_copy), out)

        assert export(open_release(release_copy), out).folder == out
        assert read_contents(out) == read_contents(
            export(open_release(release_copy), tmp_path / "fresh").folder
        )

    @pytest.mark.parametrize("units", [0, 1, 2])
    def test_nothing_is_left_of_removed_scenarios_and_frames(
        self, release_copy: Path, tmp_path: Path, units: int
    ) -> None:
        """This holds whether they were exported before or not."""
        dataset = open_release(release_copy)
        stop_export(dataset, tmp_path / "out", units)
        removed, shortened, _ = (record["token"] for record in dataset.scenario)
        remove_scenario(release_copy, removed)
        for path in release_copy.glob(f"{shortened.replace('/', '/*/*/')}/*_003.*"):
            path.unlink()
        dataset = open_release(release_copy)

        assert [record["num_frames"] for record in dataset.scenario] == [2, 3]

        done = export(dataset, tmp_path / "out")
        assert read_contents(done.folder) == read_contents(
            export(dataset, tmp_path / "fresh").folder
        )

    def test_a_scenario_that_is_removed_after_opening_is_an_error(
        self, release_copy: Path, tmp_path: Path
    ) -> None:
        dataset = open_release(release_copy)
        token = dataset.scenario[2]["token"]
        remove_scenario(release_copy, token)
        with pytest.raises(
            MissingFileError, match=f"scenario {token} no longer exists; open the release again"
        ):
            export(dataset, tmp_path / "out")


def test_another_devkits_units_are_written_again(
    small_dataset: DeepAccident,
    whole_export: Contents,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("deepaccident_devkit.export.bulk.__version__", "0.0.1")
        stop_export(small_dataset, tmp_path / "out", 2)
    assert export(small_dataset, tmp_path / "out").written == NUM_SCENARIOS
    assert read_contents(tmp_path / "out") == whole_export


def test_splits_filters_and_agents_are_chosen(small_dataset: DeepAccident, tmp_path: Path) -> None:
    train = [record["token"] for record in small_dataset.scenario if record["split"] == "train"]
    accidents = [token for token in train if "accident" in token]
    filters = ["designed_accident=true", "length>=3"]
    cases = (
        ({"split": "Train"}, train),
        ({"split": "train", "where": filters}, accidents),
        ({"split": "train", "where": filters[0]}, accidents),
    )
    for number, (options, tokens) in enumerate(cases):
        folder = export(small_dataset, tmp_path / str(number), TinyFormat(**options)).folder
        assert list(json.loads((folder / MANIFEST).read_bytes())["release"]["scenarios"]) == tokens
    export(small_dataset, tmp_path / "out", TinyFormat(agents="Ego_Vehicle"))  # type: ignore[arg-type]
    pictures = {path.name for path in tmp_path.glob("out/folders/*/pictures/*")}

    assert pictures == {f"ego_vehicle-{number}.jpg" for number in (1, 2, 3)}


def test_a_file_that_cannot_be_read_costs_its_scenario(release_copy: Path, tmp_path: Path) -> None:
    """If the file is lost after the export is complete, nothing is written."""
    dataset = open_release(release_copy)
    label = next(release_copy.glob("*/ego_vehicle/label/*/*_002.txt"))
    content = label.read_bytes()
    export(dataset, tmp_path / "whole")
    label.unlink()
    label.mkdir()
    for name in ("out", "whole"):
        parts = (f"{name}: 1 of 3 failed:\n", f": {label}: not a regular file")
        assert_raises((partial(export, dataset, tmp_path / name), SomeFailedError, parts))

    assert export(dataset, tmp_path / "out", dry_run=True).written == 1

    label.rmdir()
    label.write_bytes(content)
    assert export(dataset, tmp_path / "whole").written == 0
    assert export(dataset, tmp_path / "out").written == 1
    assert read_contents(tmp_path / "out") == read_contents(tmp_path / "whole")


@pytest.mark.parametrize("num_files", [0, 7, 14])
def test_a_full_disk_is_an_error_and_the_export_can_be_completed(
    small_dataset: DeepAccident,
    whole_export: Contents,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    num_files: int,
) -> None:
    write = Path.write_bytes
    remaining = iter(range(num_files))

    def write_or_fail(path: Path, content: bytes) -> int:
        if next(remaining, None) is None:
            raise OSError(28, "No space left on device", str(path))
        return write(path, content)

    message = r"cannot be written \(.*No space left.*free space there, or choose"
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write_or_fail)
        with pytest.raises(ExportError, match=message):
            export(small_dataset, tmp_path / "out")

    assert not [name for name in read_contents(tmp_path / "out") if temporary_of(Path(name).name)]
    assert read_contents(export(small_dataset, tmp_path / "out").folder) == whole_export


class TestDamage:
    """Damaged manifests, records and journals."""

    TEXTS = (
        "",
        "{",
        "[]",
        "null",
        "1e999",
        "[" * 100_000,
        '{"what": "DeepAccident export", "format": "other"}',
    )

    @pytest.mark.parametrize(
        "damage",
        [
            *TEXTS,
            None,
            ("settings", 3),
            ("settings", "ab"),
            ("release", {"fingerprint": "a", "scenarios": {"b": 3}}),
            ("release", {"fingerprint": "a", "scenarios": ["b"]}),
            ("release", {"scenarios": {}}),
            ("written", 3),
            ("written", {"files": "x", "bytes": 0, "linked": {}, "left_out": {}}),
            ("written", {"files": "INFINITE", "bytes": 0, "linked": {}, "left_out": {}}),
        ],
    )
    def test_a_damaged_manifest_is_our_error(
        self,
        small_dataset: DeepAccident,
        whole_export: Contents,
        tmp_path: Path,
        damage: str | tuple[str, object] | None,
    ) -> None:
        """The damage is a wrong text, an entry with a wrong value, or a pipe."""
        if damage is None:
            os.mkfifo(tmp_path / MANIFEST)
        elif isinstance(damage, str):
            (tmp_path / MANIFEST).write_text(damage)
        else:
            entry, value = damage
            manifest = {**json.loads(whole_export[MANIFEST] or b""), entry: value}
            (tmp_path / MANIFEST).write_text(json.dumps(manifest).replace('"INFINITE"', "1e999"))
        parts = (MANIFEST, "export again into an empty folder")

        assert_raises((lambda: export(small_dataset, tmp_path), ExportError, parts))
        assert [path.name for path in tmp_path.iterdir()] == [MANIFEST]

    @pytest.mark.parametrize(
        "text", [*TEXTS, None, '{"devkit": "$", "scenarios": 3, "written": {}}']
    )
    def test_a_damaged_record_is_written_again(
        self, small_dataset: DeepAccident, whole_export: Contents, tmp_path: Path, text: str | None
    ) -> None:
        stop_export(small_dataset, tmp_path / "out", 2)
        record = next((tmp_path / "out").glob(".deepaccident-parts/kept/tiny/*/done"))
        if text is None:
            record.unlink()
            os.mkfifo(record)
        else:
            record.write_text(text.replace("$", __version__))

        assert export(small_dataset, tmp_path / "out").written == 2
        assert read_contents(tmp_path / "out") == whole_export

    @pytest.mark.parametrize(
        "path", ["../kept.txt", "{root}/kept.txt", ".", "", "frames/../../kept.txt", "\udcff"]
    )
    def test_a_strange_path_in_a_journal_removes_nothing(
        self, small_dataset: DeepAccident, whole_export: Contents, tmp_path: Path, path: str
    ) -> None:
        """The folder may come from somebody else."""
        stop_export(small_dataset, tmp_path / "out", 1)
        outside = tmp_path / "kept.txt"
        outside.touch()
        for journal in (tmp_path / "out" / ".deepaccident-parts" / "kept" / "tiny").glob("*.paths"):
            with journal.open("ab") as file:
                file.write(f"{path.format(root=tmp_path)}\0".encode(errors="surrogateescape"))
            shutil.rmtree(journal.with_suffix(""), ignore_errors=True)

        assert read_contents(export(small_dataset, tmp_path / "out").folder) == whole_export
        assert outside.exists()


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.jpg"
    path.write_bytes(b"a picture")
    return path


def make_output(
    tmp_path: Path, link: LinkKind = "hard", note: Callable[[str], object] = lambda _: None
) -> Output:
    return Output(
        tmp_path / "out",
        tmp_path / "parts",
        link,
        note=note,
    )


def make_refusal(code: int) -> Callable[..., None]:
    return Mock(side_effect=OSError(code, os.strerror(code)))


def list_files(folder: Path) -> list[str]:
    return sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()
    )


def test_files_are_noted_counted_and_whole(tmp_path: Path, source: Path) -> None:
    notes: list[str] = []
    output = make_output(tmp_path, note=notes.append)
    output.write("a/b.txt", b"12")
    with output.file("c.txt") as path:
        path.write_bytes(b"345")
    output.link(source, "d.jpg")
    with output.whole_folder("e/f") as folder:
        folder.write("g.txt", b"6")
        folder.link(source, "h/i.jpg")

    assert notes == ["a/b.txt", "c.txt", "d.jpg", "e/f"]
    assert list_files(tmp_path / "out") == ["a/b.txt", "c.txt", "d.jpg", "e/f/g.txt", "e/f/h/i.jpg"]
    assert (output.tally.files, output.tally.bytes) == (3, 6)
    assert output.tally.linked == Counter(hard=2)


class TestLinks:
    @pytest.mark.parametrize("link", ["hard", "symbolic", "copy"])
    @pytest.mark.parametrize("source_is_link", [False, True])
    def test_each_kind_of_link(
        self, tmp_path: Path, source: Path, link: LinkKind, source_is_link: bool
    ) -> None:
        path = source
        if source_is_link:  # a release may be a tree of links
            path = tmp_path / "given.jpg"
            path.symlink_to(source.name)
        output = make_output(tmp_path, link)
        for _ in range(2):  # the second link replaces the first
            output.link(path, "a/b.png")

        assert (output.tally.linked, output.tally.files) == ({link: 2}, 0)

        target = tmp_path / "out" / "a" / "b.png"
        assert list(target.parent.iterdir()) == [target]
        assert target.read_bytes() == b"a picture"

        if link == "symbolic":
            assert target.readlink() == source
        else:
            assert not target.is_symlink()
            assert target.samefile(source) == (link == "hard")

    @pytest.mark.parametrize("code", [errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK])
    def test_an_impossible_link_is_replaced_by_the_next_kind(
        self, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, code: int
    ) -> None:
        monkeypatch.setattr(os, "link", make_refusal(code))
        output = make_output(tmp_path)
        output.link(source, "a.jpg")
        monkeypatch.setattr(Path, "symlink_to", make_refusal(errno.EPERM))
        output.link(source, "b.jpg")

        assert output.tally.linked == Counter(symbolic=1, copy=1)
        assert (tmp_path / "out" / "a.jpg").is_symlink()
        assert not (tmp_path / "out" / "b.jpg").is_symlink()

    @pytest.mark.parametrize("link", ["hard", "symbolic"])
    def test_a_full_disk_is_no_reason_for_another_kind_of_link(
        self, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, link: LinkKind
    ) -> None:
        monkeypatch.setattr(os, "link", make_refusal(errno.ENOSPC))
        monkeypatch.setattr(Path, "symlink_to", make_refusal(errno.ENOSPC))
        with pytest.raises(OSError, match="No space left"):
            make_output(tmp_path, link).link(source, "a.jpg")
        assert list_files(tmp_path / "out") == []

    @pytest.mark.parametrize("link", ["hard", "symbolic", "copy"])
    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda _: None, r"cannot be read \(No such file or directory\)"),
            (os.mkfifo, r"not a regular file \(a named pipe\)"),
            (os.mkdir, r"not a regular file \(a folder\)"),
            (lambda path: path.symlink_to("nothing"), "No such file"),
            (lambda path: path.symlink_to(path.name), "Too many levels of symbolic links"),
        ],
        ids=["missing", "pipe", "folder", "link to nothing", "link to itself"],
    )
    def test_anything_but_a_file_is_refused(
        self, tmp_path: Path, make: Callable[[Path], None], message: str, link: LinkKind
    ) -> None:
        path = tmp_path / "odd.jpg"
        make(path)
        with pytest.raises(
            SensorFileError, match=rf"odd.jpg: .*{message}.*; restore it from its archive"
        ):
            make_output(tmp_path, link).link(path, "a.jpg")
        assert not (tmp_path / "out").exists()


def test_several_calls_share_the_scenarios(
    small_dataset: DeepAccident, whole_export: Contents, tmp_path: Path
) -> None:
    with ThreadPoolExecutor(3) as threads:
        exports = list(threads.map(lambda _: export(small_dataset, tmp_path / "shared"), range(3)))
    assert sum(done.written for done in exports) == NUM_SCENARIOS
    assert {done.tally.files for done in exports} == {NUM_SCENARIOS * 5 + 1}
    assert read_contents(tmp_path / "shared") == whole_export


def test_a_worker_that_seems_lost_keeps_its_unit(
    small_dataset: DeepAccident,
    whole_export: Contents,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its scheduler has died; the next call must neither remove its half-written files nor write
    beside it.
    """
    write_unit = TinyFormat.write
    has_begun = threading.Event()
    may_continue = threading.Event()
    is_first = iter([True])

    def write_slowly(self: TinyFormat, dataset: Any, unit: Any, output: Any) -> None:
        if next(is_first, False):
            with output.whole_folder(f"folders/{unit.name}") as folder:
                folder.write("names.json", b"half")
                has_begun.set()
                assert may_continue.wait(60)
            output.tally.files = output.tally.bytes = 0
        write_unit(self, dataset, unit, output)

    monkeypatch.setattr(TinyFormat, "write", write_slowly)
    out = tmp_path / "out"
    lost_call = threading.Thread(target=export, args=(small_dataset, out))
    lost_call.start()

    assert has_begun.wait(60)

    (out / ".deepaccident-parts" / ".making").unlink()  # the lock of the dead caller
    next_call = threading.Thread(target=export, args=(small_dataset, out))
    next_call.start()
    time.sleep(0.3)
    assert next_call.is_alive()

    may_continue.set()
    lost_call.join()
    next_call.join()

    contents = read_contents(out)
    for name in list(contents):  # locks of the units that the lost call tried next
        if name.startswith(".deepaccident-parts/locks"):
            del contents[name]

    assert contents == whole_export


def test_half_written_files_of_another_host_are_removed(
    small_dataset: DeepAccident, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    stop_export(small_dataset, out, 2)
    records = out / ".deepaccident-parts" / "kept" / "tiny"
    unit = min(path.stem for path in records.glob("[!.]*.paths"))
    (records / unit / "done").unlink()
    half_written = out / "folders" / f".{unit[:50]}.0123abcd-77-99-1.tmp"
    half_written.mkdir()
    export(small_dataset, out)

    assert not half_written.exists()


ABSENT_AGENTS = ("infrastructure",)
IMAGES = ImageConfig(resize=(9, 16), cameras=("Camera_Back",))


@pytest.mark.parametrize(
    ("form", "message"),
    [
        (
            ReleasedInfos(),
            (
                r"in the split files train\.txt or val\.txt .*; add these files, or "
                r"choose other scenarios"
            ),
        ),
        (OpenCood(), "has its point clouds; unpack the archives of lidar01"),
        (
            CachedImages(split="train", images=IMAGES),
            "none of these images is in this release; unpack",
        ),
        (Questions(agents=ABSENT_AGENTS), "no recording is long enough"),
        (OpenCood(agents=ABSENT_AGENTS, without_clouds=True), "no moment"),
        (
            TinyFormat(split="val", where=("length>=3", "designed_accident=false")),
            "is in that split and matches",
        ),
        (ReleasePart(agents=ABSENT_AGENTS), "none of the chosen agents recorded"),
        (NuScenes(agents=ABSENT_AGENTS), "none of the chosen agents recorded"),
        (Parquet(agents=ABSENT_AGENTS), "none of the chosen agents recorded"),
        (Av2(agents=ABSENT_AGENTS), "none of the chosen agents is a vehicle with labels"),
        (Clips(agents=ABSENT_AGENTS), "no chosen agent has all images of the chosen cameras"),
    ],
)
@pytest.mark.parametrize("dry_run", [False, True])
def test_an_empty_export_is_refused(
    small_dataset: DeepAccident, tmp_path: Path, form: Format, message: str, dry_run: bool
) -> None:
    with pytest.raises(NotAvailableError, match=message):
        export_release(small_dataset, tmp_path / "out", form, workers=1, dry_run=dry_run)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("after", [False, True])
def test_an_export_that_is_killed_around_any_file_operation_can_be_completed(
    small_dataset: DeepAccident,
    small_root: Path,
    tmp_path: Path,
    whole_export: Contents,
    after: bool,
) -> None:
    with subprocess.Popen(
        [sys.executable, stopped_index_process.__file__, "support.tiny_format"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    ) as server:
        requests: Any = server.stdin
        answers: Any = server.stdout

        def export_until(step: int) -> int:
            """Export in the other process, killed around a file operation; return its status."""
            request = {
                "function": ["support.tiny_format", "export_tiny"],
                "step": step,
                "after": after,
                "arguments": [str(small_root), str(tmp_path / str(step)), 1],
            }
            requests.write(json.dumps(request) + "\n")
            requests.flush()
            return int(json.loads(answers.readline())["status"])

        step = 0
        while export_until(step) == -9:
            export(small_dataset, tmp_path / str(step))
            assert read_contents(tmp_path / str(step)) == whole_export, step
            step += 1
        requests.close()

    assert step > 40
    assert read_contents(tmp_path / str(step)) == whole_export


def test_a_dry_run_writes_nothing_and_counts_what_is_left(
    small_dataset: DeepAccident, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    links = export(small_dataset, out, dry_run=True)
    assert (links.written, links.kept) == (NUM_SCENARIOS, 0)
    assert (links.tally.samples, links.tally.files) == (NUM_PICTURES, 5 * NUM_SCENARIOS)
    assert sum(links.tally.linked.values()) == NUM_PICTURES

    copies = export(small_dataset, out, TinyFormat(link="copy"), dry_run=True)
    assert copies.tally.linked == {"copy": NUM_PICTURES}

    pictures = small_dataset.dataroot.glob("*/*/Camera_Front/*/*.jpg")
    num_picture_bytes = sum(path.stat().st_size for path in pictures)
    expected_bytes = links.tally.bytes + num_picture_bytes
    assert copies.tally.bytes == pytest.approx(expected_bytes, rel=0.1)
    assert not list(tmp_path.iterdir())

    stop_export(small_dataset, out, 2)
    remaining = export(small_dataset, out, dry_run=True)
    assert (remaining.written, remaining.kept) == (1, 2)
    assert remaining.tally.samples == NUM_PICTURES // 3
