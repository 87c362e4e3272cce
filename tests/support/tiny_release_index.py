"""Open tiny releases, and read and change their files and indexes."""

import os
from pathlib import Path

from deepaccident_devkit import DeepAccident
from support import tiny_release

OTHER_SCENARIO = "Town05_type001_subtype0001_scenario00007"
THIRD_SCENARIO = "Town01_type001_subtype0001_scenario00001"
INDEX_FOLDER = Path(".deepaccident") / "v1"


def open_release(
    root: Path | str, index_dir: Path | str | None = None, **arguments: object
) -> DeepAccident:
    return DeepAccident(dataroot=root, index_dir=index_dir, verbose=False, **arguments)  # type: ignore[arg-type]


def folder_contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def label_path(
    root: Path, agent: str = "ego_vehicle", frame: int = 2, name: str = tiny_release.SCENARIO_NAME
) -> Path:
    folder = root / tiny_release.SCENARIO_TYPE / agent / "label" / name
    return folder / f"{name}_{frame:03d}.txt"


def remove_last_box(root: Path, name: str = tiny_release.SCENARIO_NAME) -> None:
    """Take the last box out of a label file in place, so that no folder's time changes."""
    path = label_path(root, name=name)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-1]) + "\n")


def replace_text(path: Path, old: str, new: str) -> None:
    """Change a file in place and restore its time; its size and its folder's state stay too."""
    before = path.stat()
    path.write_text(path.read_text().replace(old, new))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
