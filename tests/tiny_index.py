"""Releases of `tiny`, opened; and what lies in their indexes."""

import os
from pathlib import Path

import tiny

from deepaccident_devkit import DeepAccident

OTHER = "Town05_type001_subtype0001_scenario00007"
THIRD = "Town01_type001_subtype0001_scenario00001"
INDEX = Path(".deepaccident") / "v1"


def opened(
    root: Path | str, index_dir: Path | str | None = None, **arguments: object
) -> DeepAccident:
    return DeepAccident(dataroot=root, index_dir=index_dir, verbose=False, **arguments)  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def label(root: Path, agent: str = "ego_vehicle", frame: int = 2, name: str = tiny.NAME) -> Path:
    return root / tiny.TYPE / agent / "label" / name / f"{name}_{frame:03d}.txt"


def edit(root: Path, name: str = tiny.NAME) -> None:
    """Take the last box out of a label file, in place: no folder's time moves."""
    path = label(root, name=name)
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")


def rewrite(path: Path, old: str, new: str) -> None:
    """Change a file in place, and put its time back: its size and time stay, and its folder's state
    too.
    """
    before = path.stat()
    path.write_text(path.read_text().replace(old, new))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
