"""Making a synthetic release, in a folder beside its place, so that a later call can continue after an interruption.

Several processes and hosts may record parts of its scenarios at once. One that has the folder alone puts them together.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth.plan import (
    ScenarioPlan,
    SynthConfig,
    plan_scenarios,
    plan_splits,
)
from deepaccident_devkit.plugins.synth.scenario import (
    RecordingJob,
    forget_scenario,
    part_count,
    record_scenario,
)
from deepaccident_devkit.plugins.synth.sensors.caster import require_embree
from deepaccident_devkit.release.store.members import SPLIT_FILE_FOLDER
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import (
    check_free,
    is_writable_folder,
    place_in,
    remove_in,
    temporary_of,
    write_bytes,
)
from deepaccident_devkit.support.json_text import parsed_json
from deepaccident_devkit.support.parallel import Places, Progress, Store
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.text import differing_text, path_of
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from concurrent.futures import Executor

_CONFIG_FILE = "config.json"
_MADE = "made"


@dataclass(frozen=True, slots=True)
class Unfinished:
    """The hidden folder of a release that is being made; cheap to pickle.

    Attributes:
        out: the place that the release will have; absolute.
    """

    out: Path

    @property
    def folder(self) -> Path:
        """Where it lies; raises OutputFolderError if it is a link."""
        return place_in(self.out.parent, f".{self.out.name}.unfinished", opened=True)

    @property
    def store(self) -> Store:
        """What says which parts are made, and keeps others from recording the same."""
        return Store(self.folder, self.out, "makes the release", ConfigError)

    @property
    def release(self) -> Path:
        """The release, as far as it is made."""
        return place_in(self.folder, "release", opened=True)

    def part(self, name: str) -> Path:
        """Where a part of a scenario is recorded, as in a release of its own."""
        return place_in(self.folder, f"parts/{name}", opened=True)

    def clear(self, name: str) -> None:
        """Remove the incomplete files of a part that was interrupted."""
        remove_in(self.folder, f"parts/{name}")

    def is_made(self, name: str) -> bool:
        """Whether a part is complete."""
        return self.store.kept(name, _MADE) is not None

    def note(self, name: str) -> None:
        """Remember that a part is complete; raises ConfigError if it was removed meanwhile."""
        if not (self.folder / _CONFIG_FILE).exists():
            raise ConfigError(
                f"{self.folder}: was removed while parts of the release were recorded; make it again"
            )
        self.store.keep(name, _MADE, b"")

    def gather(self, names: Iterable[str]) -> None:
        """Move the files of a scenario's parts into the release, if they are not there yet."""
        for name in names:
            if self.part(name).is_dir():
                _merge(self.part(name), self.release)

    def complete(self) -> None:
        """Move the release into its place, and remove the folder."""
        if self.out.is_dir():
            self.out.rmdir()
        self.release.replace(self.out)
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def unfinished_release(unfinished: Unfinished, config: SynthConfig) -> Iterator[Callable[[], bool]]:
    """Work on a release in the block; if nothing of it is made at the end, nothing is left.

    Yields a function that waits until this process has the folder alone; whether no other one has completed the
    release. Raises ConfigError: its place is taken, the unfinished release is of another configuration or version, or
    something cannot be written.
    """
    store, settings = unfinished.store, unfinished.folder / _CONFIG_FILE

    def begin() -> None:
        check_free(unfinished.out)  # who held the lock may have completed it
        _write_or_compare(settings, config)

    with store.shared(begin) as turn:
        _write_or_compare(settings, config)
        try:
            yield turn.alone
        finally:
            nothing = unfinished.folder.is_dir() and not any(unfinished.folder.glob("kept/*"))
            if nothing and turn.alone(wait=False):
                shutil.rmtree(unfinished.folder, ignore_errors=True)


def _write_or_compare(path: Path, config: SynthConfig) -> None:
    wanted = _as_json(config)
    if not path.exists():
        write_bytes(path, json.dumps(wanted, indent=1).encode())
        return
    there = _parsed(path)
    if differs := "spec" if there.get("spec") != wanted["spec"] else differing_text(there, wanted):
        raise ConfigError(
            f"{path.parent}: holds an unfinished release of another configuration ({differs}); ask for the same to "
            "finish it, or remove the folder"
        )


def _parsed(path: Path) -> dict[str, Any]:
    text = file_text(path)
    try:
        there = parsed_json(text.encode())
    except ValueError as error:
        raise ConfigError(f"{path}: {error}; remove its folder") from error
    return there if isinstance(there, dict) else {}


def file_text(path: Path) -> str:
    """A text file's content; raises ConfigError."""
    try:
        return read_bytes(path, "spec").decode()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {fault_text(error)}; make it readable, or remove it") from error


def _as_json(config: SynthConfig) -> dict[str, Any]:
    """All that the bytes of a release depend on, as JSON returns it; of the scenario file its text."""
    text = None if config.spec is None else file_text(config.spec)
    fields = {"version": __version__, **asdict(config), "image_size": config.pixels, "spec": text}
    as_read: dict[str, Any] = json.loads(json.dumps(fields))
    return as_read


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


# About how many frames a scenario has if the configuration does not say it.
_USUAL_FRAMES = 70


def make_release(
    out: Path,
    config: SynthConfig | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress = False,
) -> Path:
    """Write a complete synthetic release; returns its folder.

    The release is made in a hidden folder beside `out`, `.NAME.unfinished`, and renamed when it is complete. After an
    interruption (a full disk, a kill) the same call makes only what is still missing; several processes that make the
    same call share the scenarios.

    Args:
        out: the folder to make; it must be empty, or not exist yet.
        config: the settings of the release; `SynthConfig()` if None.
        workers: number of processes; several may record one scenario. With None the generator chooses. The files
            depend neither on it nor on interruptions.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a progress bar; or a function that is called after each part of the work, with its
            share of all that was to do.

    Raises:
        ConfigError: `out` is a file, is not empty or cannot be made; an unfinished release of another
            configuration is there; the scenario file cannot be read or simulated; or something cannot be written.
        OutputFolderError: a link in the hidden folder leads out of it; nothing is written there.
        ChoiceError: `workers` is less than 1.
        MissingExtraError: files of sensors are wanted and the package embreex is not installed.
        SomeFailedError: some parts cannot be recorded; the others are, and the same call continues.
        WorkerError: a worker was killed, or cannot do the work.
    """
    wanted = config or SynthConfig()
    out = path_of(out)
    check_free(out)
    if wanted.sensors != "none":
        require_embree()
    plans = plan_scenarios(wanted)
    if not is_writable_folder(out.parent):
        raise ConfigError(f"{out.parent}: cannot be written; choose another folder")
    unfinished = Unfinished(out.absolute())
    with unfinished_release(unfinished, wanted) as alone:
        count = workers or _worker_count(wanted, len(plans))
        parts = {
            name: part for plan in plans for name, part in _parts(unfinished, wanted, plan).items()
        }
        places = Places(writes=(unfinished.folder,))
        how: dict[str, Any] = {"workers": count, "executor": executor, "progress": progress}
        try:
            unfinished.store.run(
                partial(_record, unfinished), parts, label="recording", places=places, **how
            )
        finally:
            forget_scenario()
        if alone():
            unfinished.release.mkdir(exist_ok=True)
            unfinished.gather(parts)
            splits = plan_splits(plans)
            splits.save(unfinished.release, overwrite=True)
            if wanted.for_released_code:
                splits.save(
                    place_in(unfinished.release, SPLIT_FILE_FOLDER, opened=True), overwrite=True
                )
            unfinished.complete()
    return out


def _parts(
    unfinished: Unfinished, config: SynthConfig, plan: ScenarioPlan
) -> dict[str, RecordingJob]:
    """The parts of a scenario by their names."""
    if config.sensors == "accidents":
        config = replace(config, sensors="all" if plan.accident else "none")
    parts = part_count(config)
    names = {
        first: f"{plan.scenario_type}_{plan.name}_{first}of{parts}" for first in range(1, parts + 1)
    }
    return {
        name: RecordingJob(unfinished.part(name), config, plan, first, parts)
        for first, name in names.items()
    }


def _record(unfinished: Unfinished, job: RecordingJob) -> None:
    """Record a part of a scenario into the folder of an unfinished release, unless it is made."""
    name = job.root.name
    if not unfinished.is_made(name):
        unfinished.clear(name)
        record_scenario(job)
        unfinished.note(name)


def _worker_count(config: SynthConfig, scenarios: int) -> int:
    """One worker for each core, or 1 if the work is too short for it: a frame with sensors takes up to a second."""
    frames = scenarios * (config.frames or _USUAL_FRAMES)
    return usable_cores() if frames >= (400 if config.sensors == "none" else 20) else 1
