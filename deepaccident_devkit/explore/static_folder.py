"""The folder of an export: new, empty, or one that an earlier export wrote; it is written as a whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import path_of, replacing_folder, temporary_path, writable_folder, write_bytes
from deepaccident_devkit.reading import read_bytes

MARK: Final = ".deepaccident_pages"
"""The file by which an export knows the folder of an earlier one: it names all files that were written."""
_HEAD: Final = "DeepAccident pages"


def target_folder(folder: str | os.PathLike[str]) -> Path:
    """The real path of a folder for an export.

    Raises:
        ConfigError: it cannot be written to, is a file, or holds files that no export wrote.
    """
    target = path_of(folder, "expected a folder to write to").resolve()
    writable_folder(target.parent)
    if target.exists() and not target.is_dir():
        raise ConfigError(f"{target}: is a file; name a folder that does not exist yet")
    others = sorted(set(_files(target)) - set(_earlier(target)))
    if others:
        raise ConfigError(
            f"{target}: holds {others[0]}, which no export wrote; name a folder that is empty, or does not exist yet"
        )
    return target


@contextmanager
def exported(target: Path) -> Iterator[Path]:
    """Yield a new folder; if the block succeeds it takes the place of the target, and of an earlier export there."""
    aside = temporary_path(target)
    try:
        with replacing_folder(target) as made:
            yield made
            write_bytes(made / MARK, "".join(f"{line}\n" for line in (_HEAD, *sorted(_files(made)))).encode())
            if target.is_dir() and any(target.iterdir()):
                target.rename(aside)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _files(folder: Path) -> Iterator[str]:
    """All files and links below a folder, relative to it."""
    for path, folders, files in os.walk(folder):
        links = [name for name in folders if Path(path, name).is_symlink()]
        yield from (Path(path, name).relative_to(folder).as_posix() for name in (*links, *files))


def _earlier(folder: Path) -> list[str]:
    """The files that an earlier export wrote into a folder; none if there was none."""
    mark = folder / MARK
    if not mark.is_file() or mark.is_symlink():
        return []
    head, *names = read_bytes(mark, "index").decode(errors="replace").splitlines()
    return [*names, MARK] if head == _HEAD else []
