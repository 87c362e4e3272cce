"""Releases of the tests' in zips, of several layouts."""

import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

from deepaccident_devkit import DeepAccident

KINDS = ("stored", "deflated")
_METHODS = {"stored": zipfile.ZIP_STORED, "deflated": zipfile.ZIP_DEFLATED}


def files_of(root: Path) -> list[Path]:
    """A release's own files, in order."""
    return [
        path
        for path in sorted(root.rglob("*"))
        if path.is_file() and ".deepaccident" not in path.parts
    ]


def packed(
    root: Path,
    archive: Path,
    method: str = "stored",
    above: str = "",
    chosen: Callable[[Path], bool] = lambda _: True,
    written: Callable[[str], str] = str,
) -> Path:
    """A zip of a release's files, by their paths from there, below the folders `above`, in another
    way if `written`.
    """
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", _METHODS[method]) as opened:
        for path in files_of(root):
            below = path.relative_to(root)
            if chosen(below):
                opened.writestr(
                    written(above + below.as_posix()), path.read_bytes(), _METHODS[method]
                )
    return archive


def packed_by_agent(root: Path, folder: Path, names: Iterable[str]) -> Path:
    """A folder with a zip for each agent and one of the meta files, below odd folders; split files
    lie beside them.
    """
    for number, name in enumerate(names):
        method, above = KINDS[number % 2], ("", "DeepAccident/", "./data/x/")[number % 3]
        packed(
            root,
            folder / ("", "more")[number % 2] / f"{name}.zip",
            method,
            above,
            lambda path: name in path.parts,  # noqa: B023
        )
    for path in root.glob("*.txt"):
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def image_sum(dataset: DeepAccident, sample: str) -> int:
    """Of a sample's front camera; here, so that spawned processes can import it."""
    return int(dataset.load_image(sample, "Camera_Front").sum())
