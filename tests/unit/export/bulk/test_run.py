"""An export as a whole: what is there afterwards, whom a folder refuses, what is kept, and how much room it needs."""

import json
import os
import pickle
import shutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
from refusals import assert_refused
from tiny_format import KilledFormat, TinyFormat

from deepaccident_devkit import DeepAccident
from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    ExportError,
    MissingFileError,
    NotAvailableError,
    SomeFailedError,
    WorkerError,
)
from deepaccident_devkit.export import bulk
from deepaccident_devkit.export.bulk import Exported, Tally, export_release
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.support.files import temporary_of, temporary_path
from deepaccident_devkit.taxonomy import AGENTS

SCENARIOS, PICTURES = 3, 18
MANIFEST = "tiny.manifest.json"


def contents(folder: Path) -> dict[str, bytes | None]:
    """Path → content; None for a folder."""
    return {
        path.relative_to(folder).as_posix(): None if path.is_dir() else path.read_bytes() for path in folder.rglob("*")
    }


def states(folder: Path) -> dict[str, tuple[int, ...]]:
    """Path → what changes when something is written there."""
    return {
        str(path): (path.lstat().st_mtime_ns, path.lstat().st_ino, path.lstat().st_size)
        for path in [folder, *folder.rglob("*")]
    }


def written(dataset: DeepAccident, folder: Path, form: TinyFormat | None = None, **options: Any) -> Exported:
    return export_release(dataset, folder, form or TinyFormat(), **{"workers": 1, **options})


def reopened(root: Path) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False)


def stopped(dataset: DeepAccident, folder: Path, units: int, form: TinyFormat | None = None) -> None:
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


@pytest.fixture(scope="module")
def whole(small: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(small, tmp_path_factory.mktemp("whole") / "out").folder


def edit_label(root: Path, token: str) -> None:
    """Take the last box out of a label file, in place."""
    scenario_type, name = token.split("/")
    path = root / scenario_type / "ego_vehicle" / "label" / name / f"{name}_002.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")


def remove_scenario(root: Path, token: str) -> None:
    scenario_type, name = token.split("/")
    for folder in (root / scenario_type).glob(f"*/*/{name}"):
        shutil.rmtree(folder)


def test_what_is_there(small: DeepAccident, tmp_path: Path) -> None:
    done = written(small, tmp_path / "deep" / "out")
    there = {name for name, content in contents(done.folder).items() if content is not None}
    files = {name for name in there if not name.startswith(".deepaccident-parts/")}
    assert len(files) == PICTURES + SCENARIOS * (1 + 3 + 1) + 1 + 1
    assert {MANIFEST, "counts.json"} < files
    assert (done.written, done.kept, done.tally.samples) == (SCENARIOS, 0, PICTURES)
    assert done.tally.files == SCENARIOS * 5 + 1
    told = json.loads((done.folder / MANIFEST).read_bytes())
    assert told["written"] == asdict(done.tally)
    assert told["written"]["left_out"] == {"clouds": PICTURES, "maps": 1}
    assert told["written"]["bytes"] == sum(
        (done.folder / name).stat().st_size for name in files - {MANIFEST} if not name.endswith(".jpg")
    )
    hashes = scenario_hashes(small, [record["token"] for record in small.scenario])
    assert told["release"]["fingerprint"] == fingerprint(hashes)
    states = told["release"]["scenarios"]
    assert all(len(state.pop("sensors")) == 32 for state in states.values())
    assert states == {token: each.as_dict() for token, each in hashes.items()}
    assert told["settings"] == {
        "split": None,
        "where": [],
        "agents": list(AGENTS),
        "greeting": "hello",
        "version": "v1",
    }


@pytest.mark.parametrize("workers", [2, pytest.param(None)])
def test_workers_write_the_same(small: DeepAccident, whole: Path, tmp_path: Path, workers: int | None) -> None:
    assert contents(written(small, tmp_path / "out", workers=workers).folder) == contents(whole)


@pytest.mark.parametrize("kind", [ThreadPoolExecutor, lambda: ProcessPoolExecutor(2, get_context("spawn"))])
def test_any_executor_writes_the_same(
    small: DeepAccident, whole: Path, tmp_path: Path, kind: Callable[[], ThreadPoolExecutor]
) -> None:
    with kind() as executor:
        assert contents(written(small, tmp_path / "out", executor=executor).folder) == contents(whole)
        assert written(small, tmp_path / "out", executor=executor).kept == SCENARIOS


def test_a_callers_bar_gets_all_of_the_work_once(small: DeepAccident, tmp_path: Path) -> None:
    shares: list[float] = []
    written(small, tmp_path / "out", progress=shares.append)
    assert shares == pytest.approx([1 / SCENARIOS] * SCENARIOS)


def test_a_killed_worker_is_told_and_leaves_nothing_half_written(small: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(WorkerError, match="was killed"):
        export_release(small, out, KilledFormat(), workers=2)
    assert not [name for name in contents(out) if temporary_of(Path(name).name)]
    assert contents(written(small, out).folder) == contents(written(small, tmp_path / "fresh").folder)


def test_a_complete_export_is_kept_as_it_is(small: DeepAccident, tmp_path: Path) -> None:
    first = written(small, tmp_path / "out")
    before = states(first.folder)
    again = written(small, tmp_path / "out")
    assert (again.written, again.kept, again.tally) == (0, SCENARIOS, first.tally)
    assert states(first.folder) == before


def test_another_way_of_links_is_the_same_export(small: DeepAccident, tmp_path: Path) -> None:
    written(small, tmp_path / "out")
    assert written(small, tmp_path / "out", TinyFormat(link="copy")).kept == SCENARIOS


def test_a_dry_run_writes_nothing(small: DeepAccident, tmp_path: Path) -> None:
    done = written(small, tmp_path / "out", dry_run=True)
    assert (done.written, done.kept, done.tally.samples, done.tally.files) == (SCENARIOS, 0, PICTURES, 5 * SCENARIOS)
    assert sum(done.tally.linked.values()) == PICTURES
    copies = written(small, tmp_path / "out", TinyFormat(link="copy"), dry_run=True)
    assert copies.tally.linked == {"copy": PICTURES}
    pictures = sum(path.stat().st_size for path in small.dataroot.glob("*/*/Camera_Front/*/*.jpg"))
    assert copies.tally.bytes == pytest.approx(done.tally.bytes + pictures, rel=0.1)
    assert not list(tmp_path.iterdir())


def test_a_dry_run_counts_what_is_left(small: DeepAccident, tmp_path: Path) -> None:
    stopped(small, tmp_path / "out", 2)
    done = written(small, tmp_path / "out", dry_run=True)
    assert (done.written, done.kept, done.tally.samples) == (1, 2, PICTURES // 3)
    written(small, tmp_path / "out")
    done = written(small, tmp_path / "out", dry_run=True)
    assert (done.written, done.kept, done.tally.samples) == (0, SCENARIOS, 0)


@pytest.mark.parametrize(
    ("form", "names"),
    [
        (TinyFormat(greeting="hi"), r"greeting: 'hello', asked for 'hi'"),
        (TinyFormat(split="train"), r"split: None, asked for 'train'"),
        (
            TinyFormat(agents=("ego_vehicle",), where=("length>=1",)),
            r"agents: \[.*\], asked for \['ego_vehicle'\]; where: \[\], asked for \['length>=1'\]",
        ),
    ],
)
@pytest.mark.parametrize("units", [1, SCENARIOS])
def test_a_folder_of_other_settings_is_refused(
    small: DeepAccident, tmp_path: Path, form: TinyFormat, names: str, units: int
) -> None:
    if units < SCENARIOS:
        stopped(small, tmp_path / "out", units)
    else:
        written(small, tmp_path / "out")
    before = states(tmp_path)
    with pytest.raises(
        ConfigError, match=rf"out: holds an export to tiny with other settings \({names}\); choose another"
    ):
        written(small, tmp_path / "out", form)
    assert states(tmp_path) == before


def test_a_folder_with_other_things_is_refused(small: DeepAccident, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    before = states(tmp_path)
    assert_refused(
        (
            lambda: written(small, tmp_path),
            ExportError,
            r"is not empty \(notes.txt\) and holds no tiny export; choose a new folder",
        ),
        (lambda: written(small, tmp_path / "notes.txt"), ExportError, r"notes.txt: is a file; give a folder"),
        (lambda: written(small, tmp_path / "notes.txt" / "out"), ExportError, r"cannot be written \(.*Not a directory"),
    )
    assert states(tmp_path) == before


def test_what_was_left_before_the_manifest_is_no_other_thing(small: DeepAccident, whole: Path, tmp_path: Path) -> None:
    (tmp_path / ".deepaccident-parts" / "kept" / "tiny").mkdir(parents=True)
    (tmp_path / ".deepaccident-parts" / ".lock").touch()
    temporary_path(tmp_path / MANIFEST).touch()
    assert contents(written(small, tmp_path).folder) == contents(whole)


def test_a_place_that_cannot_be_written_to(small: DeepAccident, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"/proc/out: cannot be written .*; make room there, or choose"):
        written(small, Path("/proc/out"))
    (tmp_path / ".deepaccident-parts" / ".lock").mkdir(parents=True)
    with pytest.raises(ExportError, match="cannot be written"):
        written(small, tmp_path)


def test_an_export_beside_another(small: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Beside(TinyFormat):
        name = "beside"
        beside = ("tiny",)

    out = written(small, tmp_path / "out").folder
    before = contents(out)
    monkeypatch.setattr(Beside, "write", lambda *given: given[-1].tally.add(Tally(samples=1)))
    monkeypatch.setattr(Beside, "finish", lambda *_: None)
    written(small, out, Beside())
    new = contents(out).keys() - before.keys()
    assert {name for name in new if not name.startswith(".deepaccident-parts/kept/beside")} == {"beside.manifest.json"}
    assert written(small, out).kept == SCENARIOS
    with pytest.raises(ExportError, match="is not empty"):
        written(small, written(small, tmp_path / "other", Beside()).folder)


class TestRelease:
    """What it was made from has changed since."""

    def test_a_complete_export_is_refused(self, changing: Path, tmp_path: Path) -> None:
        dataset = reopened(changing)
        out = written(dataset, tmp_path / "out").folder
        before = states(out)
        token = dataset.scenario[1]["token"]
        edit_label(changing, token)
        sentence = rf"another state of the release.*\(1 scenarios have changed, come or gone since, such as {token}\)"
        for _ in range(2):
            with pytest.raises(ExportError, match=sentence):
                written(reopened(changing), out)
        assert states(out) == before

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
        with pytest.raises(ExportError, match=rf"1 scenarios .*such as {names[1 if grows else 2].replace(' ', '/')}"):
            written(small, tmp_path / "out", form)

    @pytest.mark.parametrize("units", [1, SCENARIOS])
    @pytest.mark.parametrize("change", ["comes", "goes", "another size"])
    def test_only_what_has_other_sensor_files_is_made_again(
        self, changing: Path, tmp_path: Path, units: int, change: str
    ) -> None:
        """Of a complete export, and of one that was stopped; then the same as one that was made now."""
        token = next(iter(DeepAccident(dataroot=changing, verbose=False).scenario))["token"]
        path, *_ = changing.glob(f"{token.replace('/', '/ego_vehicle/Camera_Front/')}/*_002.jpg")
        content = path.read_bytes()
        if change == "comes":
            path.unlink()
        out = tmp_path / "out"
        if units < SCENARIOS:
            stopped(reopened(changing), out, units)
        else:
            written(reopened(changing), out)
        before = states(out)
        path.unlink(missing_ok=True)
        if change != "goes":
            path.write_bytes(content + (b"\0" if change == "another size" else b""))
        done = written(reopened(changing), out)
        assert (done.written, done.kept) == (SCENARIOS - units + 1, units - 1)
        fresh = written(reopened(changing), tmp_path / "fresh")
        assert (contents(out), done.tally) == (contents(fresh.folder), fresh.tally)
        kept = {name for name, state in states(out).items() if before.get(name) == state and name.endswith(".txt")}
        assert len(kept) >= (units - 1) * 4
        assert written(reopened(changing), out).written == 0

    def test_sensor_files_that_a_format_does_not_need_change_nothing(self, changing: Path, tmp_path: Path) -> None:
        written(reopened(changing), tmp_path / "out", TinyFormat(agents=("other_vehicle",)))
        for path in changing.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg"):
            path.unlink()
        assert written(reopened(changing), tmp_path / "out", TinyFormat(agents=("other_vehicle",))).written == 0

    def test_parts_that_went_are_made_again_with_the_rest(self, changing: Path, tmp_path: Path) -> None:
        out = written(reopened(changing), tmp_path / "out").folder
        shutil.rmtree(out / ".deepaccident-parts")
        assert written(reopened(changing), out).written == 0
        next(changing.glob("*/ego_vehicle/Camera_Front/*/*_002.jpg")).unlink()
        assert written(reopened(changing), out).written == SCENARIOS

    def test_an_unfinished_export_is_continued_with_the_new_state(self, changing: Path, tmp_path: Path) -> None:
        dataset = reopened(changing)
        stopped(dataset, tmp_path / "out", 2)
        edit_label(changing, dataset.scenario[0]["token"])
        done = written(reopened(changing), tmp_path / "out")
        assert (done.written, done.kept) == (2, 1)
        assert contents(done.folder) == contents(written(reopened(changing), tmp_path / "fresh").folder)

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

    def test_nothing_is_left_of_another_selection(self, small: DeepAccident, tmp_path: Path) -> None:
        names = [record["token"].replace("/", " ") for record in small.scenario]
        mine = tmp_path / "mine.txt"
        mine.write_text("\n".join(names[:2]))
        form = TinyFormat(split=mine)
        stopped(small, tmp_path / "out", 1, form)
        mine.write_text("\n".join(names[1:]))
        done = written(small, tmp_path / "out", form)
        assert contents(done.folder) == contents(written(small, tmp_path / "fresh", form).folder)

    def test_a_scenario_that_went_after_opening_is_told(self, changing: Path, tmp_path: Path) -> None:
        dataset = reopened(changing)
        token = dataset.scenario[2]["token"]
        remove_scenario(changing, token)
        with pytest.raises(MissingFileError, match=f"scenario {token} is gone; open the release again"):
            written(dataset, tmp_path / "out")


def test_another_devkits_units_are_written_again(
    small: DeepAccident, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("deepaccident_devkit.export.bulk.__version__", "0.0.1")
        stopped(small, tmp_path / "out", 2)
    done = written(small, tmp_path / "out")
    assert (done.written, contents(done.folder)) == (SCENARIOS, contents(whole))


class TestSelection:
    def tokens(self, dataset: DeepAccident, tmp_path: Path, **options: Any) -> list[str]:
        folder = tmp_path / "out"
        shutil.rmtree(folder, ignore_errors=True)
        written(dataset, folder, TinyFormat(**options))
        return list(json.loads((folder / MANIFEST).read_bytes())["release"]["scenarios"])

    def test_splits_filters_and_agents(self, small: DeepAccident, tmp_path: Path) -> None:
        records = list(small.scenario)
        train = [record["token"] for record in records if record["split"] == "train"]
        assert self.tokens(small, tmp_path, split="Train") == train
        accident = [token for token in train if "accident" in token]
        assert len(accident) == 1
        assert self.tokens(small, tmp_path, split="train", where=["designed_accident=true", "length>=3"]) == accident
        assert self.tokens(small, tmp_path, split="train", where="designed_accident=true") == accident
        self.tokens(small, tmp_path, agents="Ego_Vehicle")
        assert {path.name for path in tmp_path.glob("out/folders/*/pictures/*")} == {
            f"ego_vehicle-{number}.jpg" for number in (1, 2, 3)
        }

    def test_nothing_left_to_export(self, small: DeepAccident, tmp_path: Path) -> None:
        with pytest.raises(NotAvailableError, match="no scenario of this release is in that split and matches"):
            self.tokens(small, tmp_path, split="val", where=("length>=3", "designed_accident=false"))
        assert not (tmp_path / "out").exists()


def test_what_goes_to_workers_is_small(small: DeepAccident, tmp_path: Path) -> None:
    """A release has 691 scenarios, and each job has it all."""
    assert len(pickle.dumps(bulk._Export(small, TinyFormat(), tmp_path).write)) < 3000


def test_wrong_workers_make_no_folder(small: DeepAccident, tmp_path: Path) -> None:
    with pytest.raises(ChoiceError, match="workers: expected a number of at least 1, or None, found -3"):
        written(small, tmp_path / "out", workers=-3)
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_read_costs_its_scenario(changing: Path, tmp_path: Path) -> None:
    """Also if it goes after the export is complete: then nothing is written."""
    dataset = reopened(changing)
    label = next(changing.glob("*/ego_vehicle/label/*/*_002.txt"))
    content = label.read_bytes()
    written(dataset, tmp_path / "whole")
    label.unlink()
    label.mkdir()
    for name in ("out", "whole"):
        with pytest.raises(SomeFailedError, match=rf"{name}: 1 of 3 failed:\n  \S+: {label}: not a regular file"):
            written(dataset, tmp_path / name)
    label.rmdir()
    label.write_bytes(content)
    assert [written(dataset, tmp_path / name).written for name in ("whole", "out")] == [0, 1]
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


@pytest.mark.parametrize("after", [0, 7, 14])
def test_a_disk_that_is_full_amid_writing(
    small: DeepAccident, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after: int
) -> None:
    with monkeypatch.context() as patch:
        write, left = Path.write_bytes, iter(range(after))

        def filled(path: Path, content: bytes) -> int:
            if next(left, None) is None:
                raise OSError(28, "No space left on device", str(path))
            return write(path, content)

        patch.setattr(Path, "write_bytes", filled)
        with pytest.raises(ExportError, match=r"cannot be written \(.*No space left.*make room there, or choose"):
            written(small, tmp_path / "out")
    assert not [name for name in contents(tmp_path / "out") if temporary_of(Path(name).name)]
    assert contents(written(small, tmp_path / "out").folder) == contents(whole)


class TestDamage:
    """What is in the way of a manifest or of a record."""

    TEXTS = ("", "{", "[]", "null", "1e999", "[" * 100_000, '{"what": "DeepAccident export", "format": "other"}')

    @pytest.mark.parametrize("text", TEXTS)
    def test_a_damaged_manifest_is_our_error(self, small: DeepAccident, tmp_path: Path, text: str) -> None:
        (tmp_path / MANIFEST).write_text(text)
        self.refused(small, tmp_path)

    @pytest.mark.parametrize(
        ("name", "value"),
        [
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
    def test_a_wrong_entry_is_our_error(
        self, small: DeepAccident, whole: Path, tmp_path: Path, name: str, value: object
    ) -> None:
        told = {**json.loads((whole / MANIFEST).read_bytes()), name: value}
        (tmp_path / MANIFEST).write_text(json.dumps(told).replace('"INFINITE"', "1e999"))
        self.refused(small, tmp_path)

    def test_a_pipe_is_our_error(self, small: DeepAccident, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / MANIFEST)
        self.refused(small, tmp_path)

    def refused(self, dataset: DeepAccident, out: Path) -> None:
        with pytest.raises(ExportError, match=rf"{MANIFEST}: .*; export again into an empty folder"):
            written(dataset, out)
        assert [path.name for path in out.iterdir()] == [MANIFEST]

    @pytest.mark.parametrize("text", [*TEXTS, None, '{"devkit": "$", "scenarios": 3, "written": {}}'])
    def test_a_damaged_record_is_written_again(
        self, small: DeepAccident, whole: Path, tmp_path: Path, text: str | None
    ) -> None:
        stopped(small, tmp_path / "out", 2)
        record = next((tmp_path / "out").glob(".deepaccident-parts/kept/tiny/*/done"))
        if text is None:
            record.unlink()
            os.mkfifo(record)
        else:
            record.write_text(text.replace("$", __version__))
        done = written(small, tmp_path / "out")
        assert (done.written, contents(done.folder)) == (2, contents(whole))

    @pytest.mark.parametrize("path", ["../kept.txt", "{root}/kept.txt", ".", "", "frames/../../kept.txt", "\udcff"])
    def test_a_strange_path_in_a_journal_removes_nothing(
        self, small: DeepAccident, whole: Path, tmp_path: Path, path: str
    ) -> None:
        """Somebody may have sent this folder."""
        stopped(small, tmp_path / "out", 1)
        kept = tmp_path / "kept.txt"
        kept.touch()
        for journal in (tmp_path / "out" / ".deepaccident-parts" / "kept" / "tiny").glob("*.paths"):
            with journal.open("ab") as file:
                file.write(f"{path.format(root=tmp_path)}\0".encode(errors="surrogateescape"))
            shutil.rmtree(journal.with_name(journal.name.removesuffix(".paths")), ignore_errors=True)
        assert contents(written(small, tmp_path / "out").folder) == contents(whole)
        assert kept.exists()

    def test_a_second_journal_of_a_unit_removes_nothing(self, small: DeepAccident, whole: Path, tmp_path: Path) -> None:
        """As a program leaves it that copies a folder over itself."""
        stopped(small, tmp_path / "out", 2)
        for journal in (tmp_path / "out" / ".deepaccident-parts" / "tiny").glob("*.paths"):
            shutil.copy(journal, journal.with_name(f"{journal.name.removesuffix('.paths')} (1).paths"))
        assert contents(written(small, tmp_path / "out").folder) == contents(whole)
