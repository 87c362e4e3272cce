"""Folders of a stranger: no link in them leads what is written or removed out of them."""

import math
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from refusals import assert_refused
from tiny_format import TinyFormat

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
    """Two scenarios with a camera."""
    root = tmp_path_factory.mktemp("small") / "release"
    wanted = SmallRelease(
        splits=("train",), agents=("ego_vehicle",), frames=8, channels=("Camera_Front",)
    )
    write_small_release(root, wanted)
    return DeepAccident(dataroot=root, verbose=False)


def an_export(dataset: DeepAccident, folder: Path) -> None:
    export_release(dataset, folder / EXPORT, TinyFormat(link="symbolic"), workers=1)


def half_an_export(dataset: DeepAccident, folder: Path) -> None:
    """One that was stopped at its second scenario."""
    whole, left = TinyFormat.write, iter(range(1))

    def write(self: TinyFormat, *arguments: Any) -> None:
        whole(self, *arguments)
        if next(left, None) is None:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TinyFormat, "write", write)
        assert_refused((lambda: an_export(dataset, folder), KeyboardInterrupt, ()))


def labels(dataset: DeepAccident, folder: Path) -> None:
    tokens = [f"{row['token']}/ego_vehicle/003" for row in dataset.scenario]
    config = MotionLabelConfig(future_frames=1, agents="available")
    write_label_files(dataset, folder / "out", tokens, config, workers=1)


def a_release(_: DeepAccident, folder: Path, left: float = math.inf) -> None:
    def record(job: RecordingJob) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        for kind in ("label", "calib"):
            write_bytes(
                job.root / job.folder.scenario_type / "ego_vehicle" / kind / f"{job.plan.name}.txt",
                b"recorded",
            )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generate, "record_scenario", record)
        make_release(
            folder / "out", SynthConfig(scenarios=2, frames=1, sensors=False, seed=7), workers=1
        )


def half_a_release(dataset: DeepAccident, folder: Path) -> None:
    assert_refused((lambda: a_release(dataset, folder, 1), KeyboardInterrupt, ()))


def an_index(dataset: DeepAccident, folder: Path) -> None:
    if not (folder / "release").exists():
        shutil.copytree(
            dataset.dataroot, folder / "release", ignore=shutil.ignore_patterns(".deepaccident")
        )
    opened = DeepAccident(dataroot=folder / "release", verbose=False)
    for row in opened.scenario:
        opened.interactions(row["token"])
    FileStore(opened).get("one", "a.jpg", lambda: b"made")


WRITERS: dict[str, tuple[Writer, Writer]] = {
    "an export": (half_an_export, an_export),
    "labels": (labels, labels),
    "a release": (half_a_release, a_release),
    "an index": (an_index, an_index),
}
"""What is made → what an earlier call left, and what is called then."""
USERS_OWN = {"out", "release", "release/.deepaccident", "release/.deepaccident/v1"}
"""Folders that the user named, or may have put elsewhere."""


def spots(folder: Path) -> Iterator[str]:
    """Each folder, and one file of each."""
    for path, folders, files in os.walk(folder):
        inside = Path(path).relative_to(folder)
        yield from (
            (inside / name).as_posix()
            for name in [*folders, *sorted(files)[:1], *sorted(files)[-1:]]
        )


def states(folder: Path) -> dict[str, tuple[int, bytes | None]]:
    return {
        str(path): (path.lstat().st_mtime_ns, path.read_bytes() if path.is_file() else None)
        for path in [folder, *folder.rglob("*")]
    }


@pytest.mark.slow
@pytest.mark.parametrize("dangling", [False, True], ids=["to something", "dangling"])
@pytest.mark.parametrize("what", WRITERS)
def test_a_link_in_any_place_leads_nothing_out(
    small: DeepAccident, tmp_path: Path, what: str, dangling: bool
) -> None:
    begin, go = WRITERS[what]
    begun, done, outside, folder = (
        tmp_path / name for name in ("begun", "done", "outside", "folder")
    )
    for each in (begun, outside):
        each.mkdir()
    begin(small, begun)
    shutil.copytree(begun, done, symlinks=True)
    go(small, done)
    places = {name: path / name for path in (done, begun) for name in spots(path)}
    if what == "a release":
        places |= {
            name.replace("out", ".out.unfinished/release", 1): path for name, path in places.items()
        }
    elif what == "an index":
        places = {name: path for name, path in places.items() if "/.deepaccident/" in name}
    refused = 0
    for number, name in enumerate(sorted(places.keys() - USERS_OWN)):
        if not dangling:
            precious_copy(places[name], outside / str(number))
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(begun, folder, symlinks=True)
        remove_in(folder, name)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(outside / str(number))
        before = states(outside)
        try:
            go(small, folder)
        except (
            DeepAccidentError,
            OSError,
            ValueError,
        ) as error:  # the last of a format that reads a stranger's part
            refused += isinstance(error, OutputFolderError)
        assert states(outside) == before, name
    assert refused


def precious_copy(real: Path, target: Path) -> None:
    """The same files and folders, of which each file is precious."""
    shutil.copytree(real, target) if real.is_dir() else target.touch()
    for path in (each for each in (target, *target.rglob("*")) if not each.is_dir()):
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
    """Its lines are paths of which an unfinished export removes those that it does not write
    again.
    """
    half_an_export(small, tmp_path)
    out, outside, line = tmp_path / EXPORT, tmp_path / "outside", ATTACKS[attack]
    outside.mkdir()
    (outside / "precious").write_bytes(PRECIOUS)
    (out / "linked").symlink_to(outside)
    (journal,) = (tmp_path / PARTS).glob("*normal*.paths")
    content = line if isinstance(line, bytes) else line.format(outside=outside).encode()
    (journal.with_name("another.paths") if of_another else journal).write_bytes(content + b"\0")
    before = states(outside)
    if attack == "a link to a folder":
        told = ("linked: a symbolic link, which no devkit makes; remove",)
        assert_refused((lambda: an_export(small, tmp_path), OutputFolderError, told))
    else:
        an_export(small, tmp_path)
        assert {path.name for path in out.iterdir()} >= {"tiny.manifest.json", "counts.json"}
        assert (out / "linked").is_symlink() == (attack != "a link")
    assert states(outside) == before


def test_a_journal_is_a_new_file(small: DeepAccident, tmp_path: Path) -> None:
    """An export's files may be those of the release, by hard links: nothing is added to one."""
    half_an_export(small, tmp_path)
    (journal,) = (tmp_path / PARTS).glob("*normal*.paths")
    (tmp_path / "precious").write_bytes(PRECIOUS)
    journal.unlink()
    os.link(tmp_path / "precious", journal)
    an_export(small, tmp_path)
    assert (tmp_path / "precious").read_bytes() == PRECIOUS


@pytest.mark.parametrize("path", ["/absolute", "..", "a/../b", "link/b", "a/link/b", "", "."])
def test_what_leads_out_is_refused(tmp_path: Path, path: str) -> None:
    root, outside, named = (tmp_path / name for name in ("root", "outside", "named"))
    for folder in (root / "a", outside / "b"):
        folder.mkdir(parents=True)
    for link, target in ((root / "link", outside), (root / "a" / "link", outside), (named, root)):
        link.symlink_to(target)
    linked = ("link: a symbolic link, ", "; remove it, or give another folder than ")
    assert_refused(
        (lambda: place_in(root, path), OutputFolderError, r"a symbolic link|is no path below it"),
        (lambda: remove_in(root, path), OutputFolderError, r"a symbolic link|is no path below it"),
        (lambda: place_in(root, "link", opened=True), OutputFolderError, linked),
    )
    assert (place_in(named, "a/b/c"), place_in(root, "link")) == (
        named / "a" / "b" / "c",
        root / "link",
    )
    for name in ("link", "a", "not there", "a/not/there"):
        remove_in(root, name)
    assert ([*root.iterdir()], (outside / "b").is_dir()) == ([], True)
