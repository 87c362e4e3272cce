"""Zip the tests' releases in several layouts."""

import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

from deepaccident_devkit import DeepAccident

ZIP_METHODS = ("stored", "deflated")
_METHODS = {"stored": zipfile.ZIP_STORED, "deflated": zipfile.ZIP_DEFLATED}


def release_files(root: Path) -> list[Path]:
    """List a release's own files, in order."""
    return [
        path
        for path in sorted(root.rglob("*"))
        if path.is_file() and ".deepaccident" not in path.parts
    ]


def zip_release(
    root: Path,
    archive: Path,
    method: str = "stored",
    above: str = "",
    includes: Callable[[Path], bool] = lambda _: True,
    rename: Callable[[str], str] = str,
) -> Path:
    """Zip the files of a release that `includes` accepts.

    A member's name is `rename(above + path)`, where `path` is relative to the release.
    """
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", _METHODS[method]) as opened:
        for path in release_files(root):
            relative_path = path.relative_to(root)
            if includes(relative_path):
                name = rename(above + relative_path.as_posix())
                opened.writestr(name, path.read_bytes(), _METHODS[method])
    return archive


def zip_agents(root: Path, folder: Path, names: Iterable[str]) -> Path:
    """Make a zip of each agent and one of the meta files below odd folders, and put the split files
    beside them.
    """
    for number, name in enumerate(names):
        zip_release(
            root,
            folder / ("", "more")[number % 2] / f"{name}.zip",
            method=ZIP_METHODS[number % 2],
            above=("", "DeepAccident/", "./data/x/")[number % 3],
            includes=lambda path: name in path.parts,  # noqa: B023
        )
    for path in root.glob("*.txt"):
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def image_sum(dataset: DeepAccident, sample: str) -> int:
    """Sum the pixels of a sample's front camera; spawned processes import this function."""
    return int(dataset.load_image(sample, "Camera_Front").sum())
