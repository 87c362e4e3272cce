"""Links that a stranger planted in a folder lead nothing that is written or removed out of it."""

import math
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises
from support.tiny_format import TinyFormat

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import DeepAccidentError, OutputFolderError
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.motion import MotionLabelConfig, write_label_files
from deepaccident_devkit.plugins.explore.explorer import FileStore
from deepaccident_devkit.plugins.synth import SynthConfig, generate, make_release
from deepaccident_devkit.plugins.synth.scenario import RecordingJob
from deepaccident_devkit.support.files import place_in, remove_in, write_bytes
from deepaccident_devkit.testing import SmallRelease, write_small_release

PRECIOUS = b"precious\0"
EXPORT, PARTS = "out", "out/.deepaccident-parts/kept/tiny"
Writer = Callable[[DeepAccident, Path], object]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """A release of two scenarios with one camera."""
    root = tmp_path_factory.mktemp("small") / "release"
    options = SmallRelease(
        splits=("train",), agents=("ego_vehicle",), frames=8, channels=("Camera_Front",)
    )
    write_small_release(root, options)
    return DeepAccident(dataroot=root, verbose=False)


def make_export(dataset: DeepAccident, folder: Path) -> None:
    export_release(dataset, folder / EXPORT, TinyFormat(link="symbolic"), workers=1)


def stop_export(dataset: DeepAccident, folder: Path) -> None:
    """Make an export that is stopped at its second scenario."""
    write_scenario = TinyFormat.write
    num_written = 0

    def write_and_stop(self: TinyFormat, *arguments: Any) -> None:
        nonlocal num_written
        write_scenario(self, *arguments)
        num_written += 1
        if num_written == 2:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TinyFormat, "write", write_and_stop)
        assert_raises((lambda: make_export(dataset, folder), KeyboardInterrupt, ()))


def write_labels(dataset: DeepAccident, folder: Path) -> None:
    tokens = [f"{row['token']}/ego_vehicle/003" for row in dataset.scenario]
    config = MotionLabelConfig(future_frames=1, agents="available")
    write_label_files(dataset, folder / "out", tokens, config, workers=1)


def generate_release(_: DeepAccident, folder: Path, max_scenarios: float = math.inf) -> None:
    num_recorded = 0

    def record_or_stop(job: RecordingJob) -> None:
        nonlocal num_recorded
        num_recorded += 1
        if num_recorded > max_scenarios:
            raise KeyboardInterrupt
        agent_folder = job.root / job.folder.scenario_type / "ego_vehicle"
        for kind in ("label", "calib"):
            write_bytes(agent_folder / kind / f"{job.plan.name}.txt", b"recorded")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generate, "record_scenario", record_or_stop)
        config = SynthConfig(scenarios=2, frames=1, sensors=False, seed=7)
        make_release(folder / "out", config, workers=1)


def stop_release(dataset: DeepAccident, folder: Path) -> None:
    assert_raises((lambda: generate_release(dataset, folder, 1), KeyboardInterrupt, ()))


def make_index(dataset: DeepAccident, folder: Path) -> None:
    root = folder / "release"
    if not root.exists():
        shutil.copytree(dataset.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident"))
    da = DeepAccident(dataroot=root, verbose=False)
    for scenario in da.scenario:
        da.interactions(scenario["token"])
    FileStore(da).get("one", "a.jpg", lambda: b"made")


WRITERS: dict[str, tuple[Writer, Writer]] = {
    "an export": (stop_export, make_export),
    "labels": (write_labels, write_labels),
    "a release": (stop_release, generate_release),
    "an index": (make_index, make_index),
}
"""What is made → the writer that leaves something, and the one that is called afterwards."""
USER_FOLDERS = {"out", "release", "release/.deepaccident", "release/.deepaccident/v1"}
"""Folders that the user named, or may have put elsewhere."""


def list_places(folder: Path) -> Iterator[str]:
    """Yield each folder, and the first and last file of each."""
    for path, folders, files in os.walk(folder):
        relative_folder = Path(path).relative_to(folder)
        for name in [*folders, *sorted(files)[:1], *sorted(files)[-1:]]:
            yield (relative_folder / name).as_posix()


def read_states(folder: Path) -> dict[str, tuple[int, bytes | None]]:
    return {
        str(path): (path.lstat().st_mtime_ns, path.read_bytes() if path.is_file() else None)
        for path in [folder, *folder.rglob("*")]
    }


@pytest.mark.slow
@pytest.mark.parametrize("dangling", [False, True], ids=["to something", "dangling"])
@pytest.mark.parametrize("product", WRITERS)
def test_a_link_in_any_place_leads_nothing_out(
    small: DeepAccident, tmp_path: Path, product: str, dangling: bool
) -> None:
    begin, finish = WRITERS[product]
    begun = tmp_path / "begun"
    begun.mkdir()
    begin(small, begun)
    finished = tmp_path / "finished"
    shutil.copytree(begun, finished, symlinks=True)
    finish(small, finished)
    places = {name: path / name for path in (finished, begun) for name in list_places(path)}
    if product == "a release":
        places |= {
            name.replace("out", ".out.unfinished/release", 1): path for name, path in places.items()
        }
    elif product == "an index":
        places = {name: path for name, path in places.items() if "/.deepaccident/" in name}

    outside = tmp_path / "outside"
    outside.mkdir()
    folder = tmp_path / "folder"
    num_refused = 0
    for number, name in enumerate(sorted(places.keys() - USER_FOLDERS)):
        target = outside / str(number)
        if not dangling:
            copy_as_precious(places[name], target)
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(begun, folder, symlinks=True)
        remove_in(folder, name)
        link = folder / name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(target)
        before = read_states(outside)
        try:
            finish(small, folder)
        except (DeepAccidentError, OSError, ValueError) as error:
            # a format that reads a stranger's part may raise ValueError
            num_refused += isinstance(error, OutputFolderError)
        assert read_states(outside) == before, name
    assert num_refused


def copy_as_precious(original: Path, target: Path) -> None:
    """Copy the names of files and folders, with precious bytes in each file."""
    if original.is_dir():
        shutil.copytree(original, target)
    else:
        target.touch()
    for path in (target, *target.rglob("*")):
        if not path.is_dir():
            path.unlink()
            path.write_bytes(PRECIOUS)


ATTACKS = {
    "absolute": "{outside}/precious",
    "above": "../outside/precious",
    "above, later": "folders/../../outside/precious",
    "a link to a folder": "linked/precious",
    "a link": "linked",
    "the lock": ".deepaccident-parts/.lock",
    "what is kept": ".deepaccident-parts/kept/tiny",
    "the manifest": "tiny.manifest.json",
    "the folder": ".",
    "nothing": "",
    "a folder's end": "linked/",
    "a long name": "a" * 300,
    "a deep one": "a/" * 300_000 + "a",
    "below a file": "counts.json/below/it",
    "no UTF-8": b"\xff\xfe",
}


@pytest.mark.parametrize("of_another", [False, True], ids=["of the unit", "of another unit"])
@pytest.mark.parametrize("attack", ATTACKS)
def test_a_journal_removes_nothing_outside(
    small: DeepAccident, tmp_path: Path, attack: str, of_another: bool
) -> None:
    """Its lines are paths, which an unfinished export removes unless it writes them again."""
    stop_export(small, tmp_path)
    out = tmp_path / EXPORT
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_bytes(PRECIOUS)
    (out / "linked").symlink_to(outside)
    (journal,) = (tmp_path / PARTS).glob("*normal*.paths")
    line = ATTACKS[attack]
    if isinstance(line, str):
        line = line.format(outside=outside).encode()
    if of_another:
        journal = journal.with_name("another.paths")
    journal.write_bytes(line + b"\0")
    before = read_states(outside)
    if attack == "a link to a folder":
        message = ("linked: is a symbolic link, which the devkit never creates; remove",)
        assert_raises((lambda: make_export(small, tmp_path), OutputFolderError, message))
    else:
        make_export(small, tmp_path)
        assert {path.name for path in out.iterdir()} >= {"tiny.manifest.json", "counts.json"}
        assert (out / "linked").is_symlink() == (attack != "a link")
    assert read_states(outside) == before


def test_a_journal_is_a_new_file(small: DeepAccident, tmp_path: Path) -> None:
    """An export's files may be hard links to the release: nothing is appended to one."""
    stop_export(small, tmp_path)
    (journal,) = (tmp_path / PARTS).glob("*normal*.paths")
    (tmp_path / "precious").write_bytes(PRECIOUS)
    journal.unlink()
    os.link(tmp_path / "precious", journal)
    make_export(small, tmp_path)
    assert (tmp_path / "precious").read_bytes() == PRECIOUS


@pytest.mark.parametrize("path", ["/absolute", "..", "a/../b", "link/b", "a/link/b", "", "."])
def test_what_leads_out_is_refused(tmp_path: Path, path: str) -> None:
    root = tmp_path / "root"
    outside = tmp_path / "outside"
    (root / "a").mkdir(parents=True)
    (outside / "b").mkdir(parents=True)
    (root / "link").symlink_to(outside)
    (root / "a" / "link").symlink_to(outside)
    linked_root = tmp_path / "linked"
    linked_root.symlink_to(root)
    message = ("link: is a symbolic link, ", "; remove it, or give another folder than ")
    assert_raises(
        (
            lambda: place_in(root, path),
            OutputFolderError,
            r"a symbolic link|is not a path below it",
        ),
        (
            lambda: remove_in(root, path),
            OutputFolderError,
            r"a symbolic link|is not a path below it",
        ),
        (lambda: place_in(root, "link", opened=True), OutputFolderError, message),
    )
    assert place_in(linked_root, "a/b/c") == linked_root / "a" / "b" / "c"
    assert place_in(root, "link") == root / "link"

    for name in ("link", "a", "not there", "a/not/there"):
        remove_in(root, name)
    assert list(root.iterdir()) == []
    assert (outside / "b").is_dir()
