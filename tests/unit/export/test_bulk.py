"""Exports: what is written, whom a folder refuses, what is kept, and calls that are stopped or
share a folder.
"""

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

import killed
import pytest
from refusals import assert_refused
from tiny_format import KilledFormat, TinyFormat

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
from deepaccident_devkit.export.bulk import (
    Export,
    Exported,
    Format,
    LinkKind,
    Manifest,
    Output,
    export_release,
)
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.export.parquet import Parquet
from deepaccident_devkit.export.questions import Questions
from deepaccident_devkit.export.released_infos import ReleasedInfos
from deepaccident_devkit.export.webdataset import WebDataset
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.support.files import temporary_of, temporary_path
from deepaccident_devkit.support.parallel import Store
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.tables import current_index
from deepaccident_devkit.training.image_cache import CachedImages

pytestmark = pytest.mark.slow

SCENARIOS, PICTURES = 3, 18
MANIFEST, ARCHIVE = "tiny.manifest.json", ".deepaccident-tiny.zip"


Contents = dict[str, bytes | None]


def contents(folder: Path) -> Contents:
    """Path → content; None for a folder."""
    return {
        path.relative_to(folder).as_posix(): None if path.is_dir() else path.read_bytes()
        for path in folder.rglob("*")
    }


def states(folder: Path) -> dict[str, tuple[int, ...]]:
    """Path → what changes when something is written there."""
    return {
        str(path): (path.lstat().st_mtime_ns, path.lstat().st_ino, path.lstat().st_size)
        for path in [folder, *folder.rglob("*")]
    }


def written(
    dataset: DeepAccident, folder: Path, form: TinyFormat | None = None, **options: Any
) -> Exported:
    return export_release(dataset, folder, form or TinyFormat(), **{"workers": 1, **options})


def reopened(root: Path) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False)


def stopped(
    dataset: DeepAccident, folder: Path, units: int, form: TinyFormat | None = None
) -> None:
    """An export that comes to an end when so many units are done."""
    with pytest.MonkeyPatch.context() as patch:
        whole, left = TinyFormat.write, iter(range(units))

        def write(self: TinyFormat, *arguments: Any) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt
            whole(self, *arguments)

        patch.setattr(TinyFormat, "write", write)
        with pytest.raises(KeyboardInterrupt):
            written(dataset, folder, form)


def begun(dataset: DeepAccident, folder: Path, units: int) -> None:
    """An export that is complete, or comes to an end when so many units are done."""
    stopped(dataset, folder, units) if units < SCENARIOS else written(dataset, folder)


@pytest.fixture(scope="module")
def whole(small: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Contents:
    """What a whole export of the small release holds."""
    return contents(written(small, tmp_path_factory.mktemp("whole") / "out").folder)


def edit_label(root: Path, token: str) -> None:
    """Put a label file without its last box in the place of one."""
    scenario_type, name = token.split("/")
    path = root / scenario_type / "ego_vehicle" / "label" / name / f"{name}_002.txt"
    edited = path.with_name("edited")
    edited.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    edited.replace(path)


def remove_scenario(root: Path, token: str) -> None:
    scenario_type, name = token.split("/")
    for folder in (root / scenario_type).glob(f"*/*/{name}"):
        shutil.rmtree(folder)


def test_what_is_there(small: DeepAccident, tmp_path: Path) -> None:
    done = written(small, tmp_path / "deep" / "out")
    files = {
        name
        for name, content in contents(done.folder).items()
        if content is not None and name != ARCHIVE
    }
    assert len(files) == PICTURES + SCENARIOS * (1 + 3 + 1) + 1 + 1
    assert (done.written, done.kept, done.tally.samples, done.tally.files) == (
        3,
        0,
        PICTURES,
        SCENARIOS * 5 + 1,
    )
    told = json.loads((done.folder / MANIFEST).read_bytes())
    assert (told["written"], told["written"]["left_out"]) == (
        asdict(done.tally),
        {"clouds": PICTURES, "maps": 1},
    )
    assert told["written"]["bytes"] == sum(
        (done.folder / name).stat().st_size
        for name in files - {MANIFEST}
        if not name.endswith(".jpg")
    )
    hashes = scenario_hashes(small, [record["token"] for record in small.scenario])
    assert told["release"]["fingerprint"] == fingerprint(hashes)
    assert told["settings"].items() >= {"split": None, "greeting": "hello", "version": "v1"}.items()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("workers", lambda: nullcontext(2)),
        ("workers", nullcontext),
        ("executor", ThreadPoolExecutor),
        pytest.param("executor", lambda: ProcessPoolExecutor(2, get_context("spawn"))),
    ],
)
def test_workers_and_executors_write_the_same(
    small: DeepAccident, whole: Contents, tmp_path: Path, option: str, value: Callable[[], Any]
) -> None:
    with value() as given:
        assert contents(written(small, tmp_path / "out", **{option: given}).folder) == whole
        assert written(small, tmp_path / "out", **{option: given}).kept == SCENARIOS


def test_a_killed_worker_is_told_and_leaves_nothing_half_written(
    small: DeepAccident, whole: Contents, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert_refused(
        (lambda: export_release(small, out, KilledFormat(), workers=2), WorkerError, "was killed")
    )
    assert not [name for name in contents(out) if temporary_of(Path(name).name)]
    assert contents(written(small, out).folder) == whole


def test_a_complete_export_is_kept_as_it_is_whatever_the_way_of_links(
    small: DeepAccident, tmp_path: Path
) -> None:
    shares: list[float] = []
    first, before = (
        written(small, tmp_path / "out", progress=shares.append),
        states(tmp_path / "out"),
    )
    assert shares == pytest.approx([1 / SCENARIOS] * SCENARIOS)
    for form in (TinyFormat(), TinyFormat(link="copy")):
        again = written(small, tmp_path / "out", form)
        assert (again.written, again.kept, again.tally) == (0, SCENARIOS, first.tally)
        assert states(first.folder) == before


@pytest.mark.parametrize(
    ("form", "facts"),
    [
        (TinyFormat(greeting="hi"), "greeting: 'hello', asked for 'hi'"),
        (TinyFormat(split="train"), "split: None, asked for 'train'"),
        (
            TinyFormat(agents=("ego_vehicle",), where=("length>=1",)),
            r"'ego_vehicle'.*where: .*'length>=1'",
        ),
    ],
)
@pytest.mark.parametrize("units", [1, SCENARIOS])
def test_a_folder_of_other_settings_is_refused(
    small: DeepAccident, tmp_path: Path, form: TinyFormat, facts: str, units: int
) -> None:
    begun(small, tmp_path / "out", units)
    before = states(tmp_path)
    with pytest.raises(ConfigError, match=f"out: .*{facts}"):
        written(small, tmp_path / "out", form)
    assert states(tmp_path) == before


def test_a_folder_with_other_things_is_refused(small: DeepAccident, tmp_path: Path) -> None:
    notes, locked = tmp_path / "other" / "notes.txt", tmp_path / "locked"
    notes.parent.mkdir()
    notes.touch()
    (locked / ".deepaccident-parts" / ".lock").mkdir(parents=True)
    before = states(tmp_path)
    assert_refused(
        (
            lambda: written(small, notes.parent),
            ExportError,
            ("not empty (notes.txt)", "tiny", "choose a new folder"),
        ),
        (lambda: written(small, notes), ExportError, ("notes.txt: is a file", "give a folder")),
        (
            lambda: written(small, notes / "out"),
            ExportError,
            ("cannot be written", "Not a directory"),
        ),
        (
            lambda: written(small, Path("/proc/out")),
            ExportError,
            ("/proc/out: cannot be written", "make room there"),
        ),
        (lambda: written(small, locked), ExportError, "cannot be written"),
        (
            lambda: written(small, tmp_path / "out", workers=-3),
            ChoiceError,
            ("workers", "at least 1", "-3"),
        ),
    )
    assert states(tmp_path) == before


def test_what_was_left_before_the_manifest_is_no_other_thing(
    small: DeepAccident, whole: Contents, tmp_path: Path
) -> None:
    (tmp_path / ".deepaccident-parts" / "kept" / "tiny").mkdir(parents=True)
    (tmp_path / ".deepaccident-parts" / ".lock").touch()
    temporary_path(tmp_path / MANIFEST).touch()
    assert contents(written(small, tmp_path).folder) == whole


def test_a_damaged_archive_of_a_complete_export_is_named(changing: Path, tmp_path: Path) -> None:
    out = written(reopened(changing), tmp_path / "out").folder
    next(changing.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg")).unlink()
    whole = (out / ARCHIVE).read_bytes()
    for content in (b"", whole[:-40], whole[:200] + b"?" + whole[201:]):
        (out / ARCHIVE).write_bytes(content)
        assert_refused(
            (
                lambda: written(reopened(changing), out),
                ExportError,
                (ARCHIVE, "remove it", "as a whole"),
            )
        )
    for name in ("../../kept.txt", str(tmp_path / "kept.txt")):
        with zipfile.ZipFile(out / ARCHIVE, "w") as archive:
            archive.writestr(name, b"")
        assert_refused((lambda: written(reopened(changing), out), OutputFolderError, "kept.txt"))
    (out / ARCHIVE).unlink()
    assert written(reopened(changing), out).written == SCENARIOS
    assert contents(out) == contents(written(reopened(changing), tmp_path / "fresh").folder)
    assert not list(tmp_path.rglob("kept.txt"))


class TestRelease:
    """What it was made from has changed since."""

    def test_a_complete_export_is_refused(self, changing: Path, tmp_path: Path) -> None:
        dataset = reopened(changing)
        out = written(dataset, tmp_path / "out").folder
        before, token = states(out), dataset.scenario[1]["token"]
        edit_label(changing, token)
        sentence = (
            "another state of the release",
            "1 scenarios have changed, come or gone since",
            token,
        )
        assert_refused(*[(lambda: written(reopened(changing), out), ExportError, sentence)] * 2)
        assert states(out) == before

    def test_files_that_the_index_was_not_made_from_are_refused(
        self, changing: Path, tmp_path: Path
    ) -> None:
        """What is written comes from the index, and the hashes beside it would be of other
        files.
        """
        dataset = reopened(changing)
        token = dataset.scenario[1]["token"]
        label = next(changing.glob(f"{token.replace('/', '/ego_vehicle/label/')}/*_002.txt"))
        label.write_text(label.read_text() + "\n")
        named = ("the index is out of date", token, "deepaccident check index DATAROOT")
        assert_refused((lambda: written(dataset, tmp_path / "out"), IndexStoreError, named))
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize("grows", [True, False])
    def test_a_complete_export_of_another_split_file_is_refused(
        self, small: DeepAccident, tmp_path: Path, grows: bool
    ) -> None:
        names = [record["token"].replace("/", " ") for record in small.scenario]
        mine = tmp_path / "mine.txt"
        mine.write_text("\n".join(names[: 1 if grows else 3]))
        form = TinyFormat(split=mine)
        written(small, tmp_path / "out", form)
        mine.write_text("\n".join(names[:2]))
        assert_refused(
            (
                lambda: written(small, tmp_path / "out", form),
                ExportError,
                rf"1 scenarios .*such as {names[1 if grows else 2].replace(' ', '/')}",
            )
        )

    @pytest.mark.parametrize("units", [1, SCENARIOS])
    @pytest.mark.parametrize("change", ["comes", "goes", "another size"])
    def test_only_what_has_other_sensor_files_is_made_again(
        self, changing: Path, tmp_path: Path, units: int, change: str
    ) -> None:
        """Of a complete export, and of one that was stopped; then the same as one that was made
        now.
        """
        token = next(iter(DeepAccident(dataroot=changing, verbose=False).scenario))["token"]
        path, *_ = changing.glob(f"{token.replace('/', '/ego_vehicle/Camera_Front/')}/*_002.jpg")
        content = path.read_bytes()
        if change == "comes":
            path.unlink()
        out = tmp_path / "out"
        begun(reopened(changing), out, units)
        before = states(out)
        path.unlink(missing_ok=True)
        if change != "goes":
            path.write_bytes(content + (b"\0" if change == "another size" else b""))
        done = written(reopened(changing), out)
        assert (done.written, done.kept) == (SCENARIOS - units + 1, units - 1)
        fresh = written(reopened(changing), tmp_path / "fresh")
        assert (contents(out), done.tally) == (contents(fresh.folder), fresh.tally)
        kept = {
            name
            for name, state in states(out).items()
            if before.get(name) == state and name.endswith(".txt")
        }
        assert len(kept) >= (units - 1) * 4
        assert written(reopened(changing), out).written == 0

    def test_links_to_its_files_leave_the_index_as_it_is(
        self, changing: Path, tmp_path: Path
    ) -> None:
        """A link changes a file's ctime."""
        done = written(reopened(changing), tmp_path / "out")
        assert done.tally.linked
        assert current_index(find_release(changing)) is not None

    def test_sensor_files_that_a_format_does_not_need_change_nothing(
        self, changing: Path, tmp_path: Path
    ) -> None:
        form = TinyFormat(agents=("other_vehicle",))
        written(reopened(changing), tmp_path / "out", form)
        for path in changing.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg"):
            path.unlink()
        assert written(reopened(changing), tmp_path / "out", form).written == 0

    @pytest.mark.parametrize(
        "moment", ["Store.drop", "Store.remove", "Manifest.write", "Export._remove_other_units"]
    )
    def test_a_call_that_is_killed_as_it_packs_or_unpacks(
        self, changing: Path, tmp_path: Path, moment: str
    ) -> None:
        name, method = moment.split(".")
        kind = {"Store": Store, "Manifest": Manifest, "Export": Export}[name]
        out = written(reopened(changing), tmp_path / "out").folder
        next(changing.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg")).unlink()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kind, method, Mock(side_effect=KeyboardInterrupt))
            assert_refused((lambda: written(reopened(changing), out), KeyboardInterrupt, ()))
        assert written(reopened(changing), out).folder == out
        assert contents(out) == contents(written(reopened(changing), tmp_path / "fresh").folder)

    @pytest.mark.parametrize("units", [0, 1, 2])
    def test_nothing_is_left_of_what_went(self, changing: Path, tmp_path: Path, units: int) -> None:
        """Of a whole scenario, and of a frame; whether they were written before or not."""
        dataset = reopened(changing)
        stopped(dataset, tmp_path / "out", units)
        gone, shorter, _ = (record["token"] for record in dataset.scenario)
        remove_scenario(changing, gone)
        for path in changing.glob(f"{shorter.replace('/', '/*/*/')}/*_003.*"):
            path.unlink()
        dataset = reopened(changing)
        assert [record["num_frames"] for record in dataset.scenario] == [2, 3]
        done = written(dataset, tmp_path / "out")
        assert contents(done.folder) == contents(written(dataset, tmp_path / "fresh").folder)

    def test_a_scenario_that_went_after_opening_is_told(
        self, changing: Path, tmp_path: Path
    ) -> None:
        dataset = reopened(changing)
        token = dataset.scenario[2]["token"]
        remove_scenario(changing, token)
        assert_refused(
            (
                lambda: written(dataset, tmp_path / "out"),
                MissingFileError,
                f"scenario {token} is gone; open the release again",
            )
        )


def test_another_devkits_units_are_written_again(
    small: DeepAccident, whole: Contents, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("deepaccident_devkit.export.bulk.__version__", "0.0.1")
        stopped(small, tmp_path / "out", 2)
    done = written(small, tmp_path / "out")
    assert (done.written, contents(done.folder)) == (SCENARIOS, whole)


def test_splits_filters_and_agents_are_chosen(small: DeepAccident, tmp_path: Path) -> None:
    train = [record["token"] for record in small.scenario if record["split"] == "train"]
    accident = [token for token in train if "accident" in token]
    both = ["designed_accident=true", "length>=3"]
    for number, (options, tokens) in enumerate(
        (
            ({"split": "Train"}, train),
            ({"split": "train", "where": both}, accident),
            ({"split": "train", "where": both[0]}, accident),
        )
    ):
        folder = written(small, tmp_path / str(number), TinyFormat(**options)).folder
        assert list(json.loads((folder / MANIFEST).read_bytes())["release"]["scenarios"]) == tokens
    written(small, tmp_path / "out", TinyFormat(agents="Ego_Vehicle"))  # type: ignore[arg-type]
    pictures = {path.name for path in tmp_path.glob("out/folders/*/pictures/*")}
    assert pictures == {f"ego_vehicle-{number}.jpg" for number in (1, 2, 3)}


def test_a_file_that_cannot_be_read_costs_its_scenario(changing: Path, tmp_path: Path) -> None:
    """Also if it goes after the export is complete: then nothing is written."""
    dataset = reopened(changing)
    label = next(changing.glob("*/ego_vehicle/label/*/*_002.txt"))
    content = label.read_bytes()
    written(dataset, tmp_path / "whole")
    label.unlink()
    label.mkdir()
    assert_refused(
        *(
            (
                partial(written, dataset, tmp_path / name),
                SomeFailedError,
                (f"{name}: 1 of 3 failed:\n", f": {label}: not a regular file"),
            )
            for name in ("out", "whole")
        )
    )
    assert written(dataset, tmp_path / "out", dry_run=True).written == 1
    label.rmdir()
    label.write_bytes(content)
    assert [written(dataset, tmp_path / name).written for name in ("whole", "out")] == [0, 1]
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


@pytest.mark.parametrize("after", [0, 7, 14])
def test_a_disk_that_is_full_amid_writing(
    small: DeepAccident,
    whole: Contents,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    after: int,
) -> None:
    with monkeypatch.context() as patch:
        write, left = Path.write_bytes, iter(range(after))

        def filled(path: Path, content: bytes) -> int:
            if next(left, None) is None:
                raise OSError(28, "No space left on device", str(path))
            return write(path, content)

        patch.setattr(Path, "write_bytes", filled)
        assert_refused(
            (
                lambda: written(small, tmp_path / "out"),
                ExportError,
                r"cannot be written \(.*No space left.*make room there, or choose",
            )
        )
    assert not [name for name in contents(tmp_path / "out") if temporary_of(Path(name).name)]
    assert contents(written(small, tmp_path / "out").folder) == whole


class TestDamage:
    """What is in the way of a manifest or of a record."""

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
        small: DeepAccident,
        whole: Contents,
        tmp_path: Path,
        damage: str | tuple[str, object] | None,
    ) -> None:
        """A text, an entry with a wrong value, or a pipe in the file's place."""
        if damage is None:
            os.mkfifo(tmp_path / MANIFEST)
        elif isinstance(damage, str):
            (tmp_path / MANIFEST).write_text(damage)
        else:
            told = json.loads(whole[MANIFEST] or b"") | dict([damage])
            (tmp_path / MANIFEST).write_text(json.dumps(told).replace('"INFINITE"', "1e999"))
        assert_refused(
            (
                lambda: written(small, tmp_path),
                ExportError,
                (MANIFEST, "export again into an empty folder"),
            )
        )
        assert [path.name for path in tmp_path.iterdir()] == [MANIFEST]

    @pytest.mark.parametrize(
        "text", [*TEXTS, None, '{"devkit": "$", "scenarios": 3, "written": {}}']
    )
    def test_a_damaged_record_is_written_again(
        self, small: DeepAccident, whole: Contents, tmp_path: Path, text: str | None
    ) -> None:
        stopped(small, tmp_path / "out", 2)
        record = next((tmp_path / "out").glob(".deepaccident-parts/kept/tiny/*/done"))
        if text is None:
            record.unlink()
            os.mkfifo(record)
        else:
            record.write_text(text.replace("$", __version__))
        done = written(small, tmp_path / "out")
        assert (done.written, contents(done.folder)) == (2, whole)

    @pytest.mark.parametrize(
        "path", ["../kept.txt", "{root}/kept.txt", ".", "", "frames/../../kept.txt", "\udcff"]
    )
    def test_a_strange_path_in_a_journal_removes_nothing(
        self, small: DeepAccident, whole: Contents, tmp_path: Path, path: str
    ) -> None:
        """Somebody may have sent this folder."""
        stopped(small, tmp_path / "out", 1)
        kept = tmp_path / "kept.txt"
        kept.touch()
        for journal in (tmp_path / "out" / ".deepaccident-parts" / "kept" / "tiny").glob("*.paths"):
            with journal.open("ab") as file:
                file.write(f"{path.format(root=tmp_path)}\0".encode(errors="surrogateescape"))
            shutil.rmtree(
                journal.with_name(journal.name.removesuffix(".paths")), ignore_errors=True
            )
        assert contents(written(small, tmp_path / "out").folder) == whole
        assert kept.exists()


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.jpg"
    path.write_bytes(b"a picture")
    return path


def output_of(
    tmp_path: Path, link: LinkKind = "hard", note: Callable[[str], object] = lambda _: None
) -> Output:
    return Output(tmp_path / "out", tmp_path / "parts", link, note=note)


def refusing(code: int) -> Callable[..., None]:
    def make(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    return make


def names(folder: Path) -> list[str]:
    return sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()
    )


def test_files_are_noted_counted_and_whole(tmp_path: Path, source: Path) -> None:
    noted: list[str] = []
    output = output_of(tmp_path, note=noted.append)
    output.write("a/b.txt", b"12")
    with output.file("c.txt") as path:
        path.write_bytes(b"345")
    output.link(source, "d.jpg")
    with output.whole_folder("e/f") as folder:
        folder.write("g.txt", b"6")
        folder.link(source, "h/i.jpg")
    assert noted == ["a/b.txt", "c.txt", "d.jpg", "e/f"]
    assert names(tmp_path / "out") == ["a/b.txt", "c.txt", "d.jpg", "e/f/g.txt", "e/f/h/i.jpg"]
    assert (output.tally.files, output.tally.bytes, output.tally.linked) == (3, 6, Counter(hard=2))


class TestLinks:
    @pytest.mark.parametrize("link", ["hard", "symbolic", "copy"])
    @pytest.mark.parametrize("by_link", [False, True])
    def test_each_way(self, tmp_path: Path, source: Path, link: LinkKind, by_link: bool) -> None:
        given = source
        if by_link:  # a release may be a tree of links
            given = tmp_path / "given.jpg"
            given.symlink_to(source.name)
        output, target = output_of(tmp_path, link), tmp_path / "out" / "a" / "b.png"
        for _ in range(2):  # the second time over the first
            output.link(given, "a/b.png")
        assert (output.tally.linked, output.tally.files) == ({link: 2}, 0)
        assert (target.read_bytes(), list(target.parent.iterdir())) == (b"a picture", [target])
        assert (target.readlink() if target.is_symlink() else None) == (
            source if link == "symbolic" else None
        )
        assert (not target.is_symlink() and target.samefile(source)) == (link == "hard")

    @pytest.mark.parametrize("code", [errno.EXDEV, errno.EPERM, errno.ENOTSUP, errno.EMLINK])
    def test_the_next_way_where_one_cannot_be(
        self, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, code: int
    ) -> None:
        monkeypatch.setattr(os, "link", refusing(code))
        output = output_of(tmp_path)
        output.link(source, "a.jpg")
        monkeypatch.setattr(Path, "symlink_to", refusing(errno.EPERM))
        output.link(source, "b.jpg")
        assert (
            output.tally.linked,
            (tmp_path / "out" / "a.jpg").is_symlink(),
            (tmp_path / "out" / "b.jpg").is_symlink(),
        ) == (Counter(symbolic=1, copy=1), True, False)

    @pytest.mark.parametrize("link", ["hard", "symbolic"])
    def test_a_full_disk_is_no_reason_for_another_way(
        self, tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch, link: LinkKind
    ) -> None:
        monkeypatch.setattr(os, "link", refusing(errno.ENOSPC))
        monkeypatch.setattr(Path, "symlink_to", refusing(errno.ENOSPC))
        assert_refused(
            (lambda: output_of(tmp_path, link).link(source, "a.jpg"), OSError, "No space left")
        )
        assert names(tmp_path / "out") == []

    @pytest.mark.parametrize("link", ["hard", "symbolic", "copy"])
    @pytest.mark.parametrize(
        ("make", "words"),
        [
            (lambda _: None, r"cannot be read \(No such file or directory\)"),
            (os.mkfifo, r"not a regular file \(a named pipe\)"),
            (os.mkdir, r"not a regular file \(a folder\)"),
            (lambda path: path.symlink_to("nothing"), "No such file"),
            (lambda path: path.symlink_to(path.name), "Too many levels of symbolic links"),
        ],
        ids=["missing", "pipe", "folder", "link to nothing", "link to itself"],
    )
    def test_what_is_no_file(
        self, tmp_path: Path, make: Callable[[Path], None], words: str, link: LinkKind
    ) -> None:
        path = tmp_path / "odd.jpg"
        make(path)
        assert_refused(
            (
                lambda: output_of(tmp_path, link).link(path, "a.jpg"),
                SensorFileError,
                rf"odd.jpg: .*{words}.*; restore it from its archive",
            )
        )
        assert not (tmp_path / "out").exists()


def test_several_calls_share_the_scenarios(
    small: DeepAccident, whole: Contents, tmp_path: Path
) -> None:
    with ThreadPoolExecutor(3) as threads:
        done = list(threads.map(lambda _: written(small, tmp_path / "shared"), range(3)))
    assert (sum(each.written for each in done), {each.tally.files for each in done}) == (
        SCENARIOS,
        {SCENARIOS * 5 + 1},
    )
    assert contents(tmp_path / "shared") == whole


def test_a_worker_that_was_taken_for_lost_keeps_its_unit(
    small: DeepAccident, whole: Contents, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a scheduler that died: the next call neither takes its half-written files away nor writes
    beside it.
    """
    write_all, begun, go_on, first = (
        TinyFormat.write,
        threading.Event(),
        threading.Event(),
        iter([True]),
    )

    def write(self: TinyFormat, dataset: Any, unit: Any, output: Any) -> None:
        if next(first, False):
            with output.whole_folder(f"folders/{unit.name}") as folder:
                folder.write("names.json", b"half")
                begun.set()
                assert go_on.wait(60)
            output.tally.files, output.tally.bytes = 0, 0
        write_all(self, dataset, unit, output)

    monkeypatch.setattr(TinyFormat, "write", write)
    lost = threading.Thread(target=written, args=(small, tmp_path / "out"))
    lost.start()
    assert begun.wait(60)
    (tmp_path / "out" / ".deepaccident-parts" / ".making").unlink()  # of a caller that is dead
    again = threading.Thread(target=written, args=(small, tmp_path / "out"))
    again.start()
    time.sleep(0.3)
    assert again.is_alive()
    go_on.set()
    for each in (lost, again):
        each.join()
    found = contents(tmp_path / "out")
    locks = {
        name for name in found if name.startswith(".deepaccident-parts/locks")
    }  # of the lost one's next units
    assert {name: found[name] for name in found.keys() - locks} == whole


def test_what_another_host_left_of_a_unit_is_removed(small: DeepAccident, tmp_path: Path) -> None:
    stopped(small, tmp_path / "out", 2)
    kept = tmp_path / "out" / ".deepaccident-parts" / "kept" / "tiny"
    unit = min(each.name.removesuffix(".paths") for each in kept.glob("[!.]*.paths"))
    (kept / unit / "done").unlink()
    left = tmp_path / "out" / "folders" / f".{unit[:50]}.0123abcd-77-99-1.tmp"
    left.mkdir()
    written(small, tmp_path / "out")
    assert not left.exists()


ABSENT = ("infrastructure",)
IMAGES = ImageConfig(resize=(9, 16), cameras=("Camera_Back",))


@pytest.mark.parametrize(
    ("form", "told"),
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
        (Questions(agents=ABSENT), "no recording is long enough"),
        (OpenCood(agents=ABSENT, without_clouds=True), "no moment"),
        (
            TinyFormat(split="val", where=("length>=3", "designed_accident=false")),
            "is in that split and matches",
        ),
        *(
            (kind(agents=ABSENT), "no chosen agent recorded one of")
            for kind in (NuScenes, Parquet, WebDataset)
        ),
    ],
)
@pytest.mark.parametrize("dry_run", [False, True])
def test_nothing_to_write(
    small: DeepAccident, tmp_path: Path, form: Format, told: str, dry_run: bool
) -> None:
    assert_refused(
        (
            lambda: export_release(small, tmp_path / "out", form, workers=1, dry_run=dry_run),
            NotAvailableError,
            told,
        )
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("after", [False, True])
def test_killed_around_every_renaming_and_removal(
    small: DeepAccident, small_root: Path, tmp_path: Path, whole: Contents, after: bool
) -> None:
    command = [sys.executable, killed.__file__, "tiny_format"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as server:
        asked: Any = server.stdin
        answers: Any = server.stdout

        def status(step: int) -> int:
            """Of an export that is killed around its operation of that number."""
            call = {"function": ["tiny_format", "export_tiny"], "step": step, "after": after}
            asked.write(
                json.dumps({**call, "arguments": [str(small_root), str(tmp_path / str(step)), 1]})
                + "\n"
            )
            asked.flush()
            return int(json.loads(answers.readline())["status"])

        step = 0
        while status(step) == -9:
            written(small, tmp_path / str(step))
            assert contents(tmp_path / str(step)) == whole, step
            step += 1
        asked.close()
    assert step > 40
    assert contents(tmp_path / str(step)) == whole


def test_a_dry_run_writes_nothing_and_counts_what_is_left(
    small: DeepAccident, tmp_path: Path
) -> None:
    done = written(small, tmp_path / "out", dry_run=True)
    assert (done.written, done.kept, done.tally.samples, done.tally.files) == (
        SCENARIOS,
        0,
        PICTURES,
        5 * SCENARIOS,
    )
    copies = written(small, tmp_path / "out", TinyFormat(link="copy"), dry_run=True)
    assert (sum(done.tally.linked.values()), copies.tally.linked) == (PICTURES, {"copy": PICTURES})
    pictures = sum(path.stat().st_size for path in small.dataroot.glob("*/*/Camera_Front/*/*.jpg"))
    assert copies.tally.bytes == pytest.approx(done.tally.bytes + pictures, rel=0.1)
    assert not list(tmp_path.iterdir())
    stopped(small, tmp_path / "out", 2)
    left = written(small, tmp_path / "out", dry_run=True)
    assert (left.written, left.kept, left.tally.samples) == (1, 2, PICTURES // 3)
