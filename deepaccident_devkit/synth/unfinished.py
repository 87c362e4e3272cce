"""A release that is being made: a folder beside its place, so that a later call can continue after an interruption."""

import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.reading import fault_text, read_bytes, shortened
from deepaccident_devkit.synth.config import SynthConfig

_CONFIG_FILE, _MADE_FILE, _LOCK_FILE = "config.json", "made.txt", ".lock"


@dataclass(frozen=True, slots=True)
class Unfinished:
    """The folder of a release that is being made.

    Attributes:
        folder: hidden, beside the place that the release will have.
    """

    folder: Path

    @property
    def release(self) -> Path:
        """The release, as far as it is made."""
        return self.folder / "release"

    def part(self, name: str) -> Path:
        """Where a part of a scenario is recorded, as in a release of its own."""
        return self.folder / "parts" / name

    def clear(self, name: str) -> None:
        """Remove the incomplete files of a part that was interrupted."""
        shutil.rmtree(self.part(name), ignore_errors=True)

    def made(self) -> frozenset[str]:
        """Names of the complete parts; a last line without its end does not count."""
        path = self.folder / _MADE_FILE
        return frozenset(_text(path).split("\n")[:-1] if path.exists() else ())

    def note(self, name: str) -> None:
        """Remember that a part is complete."""
        with (self.folder / _MADE_FILE).open("a", encoding="utf-8") as file:
            file.write(f"{name}\n")

    def gather(self, names: Iterable[str]) -> None:
        """Move the files of a scenario's parts into the release, if they are not there yet."""
        for name in names:
            if self.part(name).is_dir():
                _merge(self.part(name), self.release)


@contextmanager
def unfinished_release(out: Path, config: SynthConfig) -> Iterator[Unfinished]:
    """The release that becomes `out` when the block succeeds; if the block fails, a later call can continue it.

    Raises:
        ConfigError: the unfinished release is of another configuration or version, or another process is making it.
    """
    from filelock import FileLock, Timeout

    place = out.absolute()
    folder = place.with_name(f".{place.name}.unfinished")
    folder.mkdir(exist_ok=True)
    try:
        with FileLock(folder / _LOCK_FILE, timeout=0):
            unfinished = Unfinished(folder)
            _agree(folder / _CONFIG_FILE, config)
            unfinished.release.mkdir(exist_ok=True)
            try:
                yield unfinished
                _move_into_place(unfinished.release, out)
            finally:
                if out.is_dir() or not unfinished.made():
                    shutil.rmtree(folder, ignore_errors=True)
    except Timeout as error:
        raise ConfigError(
            f"{out}: another process is making it; wait for that one, or choose another folder"
        ) from error


def _agree(path: Path, config: SynthConfig) -> None:
    """Write the configuration beside the release, or compare it with the one that is there."""
    wanted = _as_json(config)
    if not path.exists():
        write_bytes(path, json.dumps(wanted, indent=1).encode())
        return
    there = _parsed(path)
    for name, value in wanted.items():
        found = there.get(name)
        if found != value:
            differs = "spec" if name == "spec" else f"{name}: {shortened(repr(found))} there, {value!r} asked for"
            raise ConfigError(
                f"{path.parent}: holds an unfinished release of another configuration ({differs}); ask for the same "
                "to finish it, or remove the folder"
            )


def _parsed(path: Path) -> dict[str, Any]:
    text = _text(path)
    try:
        there = parsed_json(text.encode())
    except ValueError as error:
        raise ConfigError(f"{path}: {error}; remove its folder") from error
    return there if isinstance(there, dict) else {}


def _text(path: Path) -> str:
    """A text file's content; raises ConfigError."""
    try:
        return read_bytes(path, "spec").decode()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {fault_text(error)}; make it readable, or remove it") from error


def _as_json(config: SynthConfig) -> dict[str, Any]:
    """All that the bytes of a release depend on, as JSON returns it; of the scenario file its text."""
    text = None if config.spec is None else _text(config.spec)
    fields = {"version": __version__, **asdict(config), "image_size": config.pixels, "spec": text}
    as_read: dict[str, Any] = json.loads(json.dumps(fields))
    return as_read


def _move_into_place(release: Path, out: Path) -> None:
    if out.is_dir():
        out.rmdir()
    release.replace(out)


def _merge(source: Path, target: Path) -> None:
    """Move a folder's contents into another one."""
    for path in source.iterdir():
        place = target / path.name
        if path.is_dir() and place.is_dir():
            _merge(path, place)
        else:
            path.replace(place)
    source.rmdir()
