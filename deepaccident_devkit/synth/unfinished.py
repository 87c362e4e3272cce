"""A release that is being made: a folder beside its place, so that a later call can continue after an interruption.

Several processes and hosts may record parts of its scenarios at once. One that has the folder alone puts them together.
"""

import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import held_lock, place_in, remove_in, temporary_of, write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.reading import fault_text, read_bytes, shortened
from deepaccident_devkit.synth.config import SynthConfig

_CONFIG_FILE, _CONFIG_LOCK, _LOCK = "config.json", ".config.lock", ".lock"


@dataclass(frozen=True, slots=True)
class Unfinished:
    """The folder of a release that is being made; cheap to pickle.

    Attributes:
        folder: hidden, beside the place that the release will have.
    """

    folder: Path

    @property
    def release(self) -> Path:
        """The release, as far as it is made."""
        return place_in(self.folder, "release", opened=True)

    def part(self, name: str) -> Path:
        """Where a part of a scenario is recorded, as in a release of its own."""
        return place_in(self.folder, f"parts/{name}", opened=True)

    @contextmanager
    def alone(self, name: str) -> Iterator[None]:
        """Keep other processes and hosts from recording the same part in the block.

        Raises:
            ConfigError: nobody makes the release any more.
        """
        self._check_there()
        lock = held_lock(self._locks / name, f"records {name}")
        try:
            yield
        finally:
            lock.release()

    def clear(self, name: str) -> None:
        """Remove the incomplete files of a part that was interrupted."""
        remove_in(self.folder, f"parts/{name}")

    def is_made(self, name: str) -> bool:
        """Whether a part is complete."""
        return self._note(name).exists()

    def made(self) -> frozenset[str]:
        """Names of the complete parts."""
        return frozenset(path.name for path in self._note("").glob("*"))

    def is_at_hand(self) -> bool:
        """Whether a part is being recorded, perhaps by a worker whose caller was stopped."""
        return any(map(_is_held, self._locks.glob("*")))

    def note(self, name: str) -> None:
        """Remember that a part is complete; raises ConfigError if it was removed meanwhile."""
        self._check_there()
        write_bytes(self._note(name), b"")

    def gather(self, names: Iterable[str]) -> None:
        """Move the files of a scenario's parts into the release, if they are not there yet."""
        for name in names:
            if self.part(name).is_dir():
                _merge(self.part(name), self.release)

    @property
    def _locks(self) -> Path:
        return place_in(self.folder, "locks", opened=True)

    def _note(self, name: str) -> Path:
        return place_in(self.folder, f"made/{name}")

    def _check_there(self) -> None:
        if not (self.folder / _CONFIG_FILE).exists():
            raise ConfigError(f"{self.folder}: was removed while parts of the release were recorded; make it again")


@contextmanager
def unfinished_release(out: Path, config: SynthConfig, *, shared: bool = False) -> Iterator[Unfinished]:
    """The release that becomes `out` when the block succeeds; if the block fails, a later call can continue it.

    Args:
        out: its place.
        config: its settings.
        shared: whether others may work on it too who share it, each on parts of its own; it does not become `out` then.

    Raises:
        ConfigError: `out` is taken, the unfinished release is of another configuration or version, or another process
            is making it.
    """
    place = out.absolute()
    unfinished = Unfinished(place_in(place.parent, f".{place.name}.unfinished", opened=True))
    try:
        lock = held_lock(unfinished.folder / _LOCK, "makes the release", shared=shared, wait=False)
    except BlockingIOError as error:
        raise ConfigError(
            f"{out}: another process is making it; wait for that one, or choose another folder"
        ) from error
    try:
        check_free(out)  # who held the lock may have completed it
        _agree(unfinished.folder, config)
        with nullcontext() if shared else _becoming(out, unfinished):
            yield unfinished
    finally:
        lock.release()


@contextmanager
def _becoming(out: Path, unfinished: Unfinished) -> Iterator[None]:
    """Make the release's folder, and move it to its place if the block succeeds; else keep it if anything is made."""
    unfinished.release.mkdir(exist_ok=True)
    try:
        yield
        _move_into_place(unfinished.release, out)
    finally:
        if not (unfinished.release.is_dir() and (unfinished.made() or unfinished.is_at_hand())):
            shutil.rmtree(unfinished.folder, ignore_errors=True)


def check_free(out: Path) -> None:
    """Raise ConfigError unless a release can be made there: nothing is, or an empty folder."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: exists and is not an empty folder; choose another folder, or remove this one")


def _is_held(lock: Path) -> bool:
    try:
        held_lock(lock, "records", wait=False).release()
    except BlockingIOError:
        return True
    return False


def _agree(folder: Path, config: SynthConfig) -> None:
    """Write the configuration beside the release, or compare it with the one that is there."""
    lock = held_lock(folder / _CONFIG_LOCK, "begins the release")  # those who share the folder may begin at once
    try:
        _write_or_compare(folder / _CONFIG_FILE, config)
    finally:
        lock.release()


def _write_or_compare(path: Path, config: SynthConfig) -> None:
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


def _merge(part: Path, release: Path) -> None:
    """Move a part's files to their places, and remove the part.

    Temporary files go with it: only those leave some whose locks do not keep others out, and the part is complete.
    """
    for folder, _, names in os.walk(part):
        place = place_in(release, Path(folder).relative_to(part), opened=True)
        place.mkdir(parents=True, exist_ok=True)
        for name in names:
            if temporary_of(name) is None:
                Path(folder, name).replace(place / name)
    shutil.rmtree(part)
