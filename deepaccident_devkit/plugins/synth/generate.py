"""Making a synthetic release, in a hidden folder next to its final place.

A later call can continue after an interruption. Several processes and hosts may record parts of the
scenarios at the same time. The last of them to finish assembles the parts.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

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
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from concurrent.futures import Executor

_CONFIG_FILE = "config.json"
_MADE_NOTE = "made"
# Approximate number of frames of a scenario if the configuration gives none.
_USUAL_FRAMES = 70
# Smallest numbers of frames that are worth several workers, with sensors and without; a frame with
# sensors takes up to a second.
_MIN_PARALLEL_FRAMES = 20
_MIN_PARALLEL_FRAMES_WITHOUT_SENSORS = 400


@dataclass(frozen=True, slots=True)
class Unfinished:
    """The hidden folder of a release that is being made; cheap to pickle.

    Attributes:
        out: Folder that the release will have; absolute.
    """

    out: Path

    @property
    def folder(self) -> Path:
        """The hidden folder; raises OutputFolderError if it is a link."""
        name = f".{self.out.name}.unfinished"
        return place_in(self.out.parent, name, opened=True)

    @property
    def store(self) -> Store:
        """The store that notes complete parts, and prevents others from recording the same part."""
        return Store(self.folder, self.out, "is making the release", ConfigError)

    @property
    def release(self) -> Path:
        """The release, as far as it is made."""
        return place_in(self.folder, "release", opened=True)

    def part(self, name: str) -> Path:
        """Return the folder of a part of a scenario, which is recorded as a release of its own."""
        return place_in(self.folder, f"parts/{name}", opened=True)

    def clear(self, name: str) -> None:
        """Remove the incomplete files of a part that was interrupted."""
        remove_in(self.folder, f"parts/{name}")

    def is_made(self, name: str) -> bool:
        """Return whether a part is complete."""
        return self.store.read_result(name, _MADE_NOTE) is not None

    def note(self, name: str) -> None:
        """Note that a part is complete; raise ConfigError if it was removed meanwhile."""
        if not (self.folder / _CONFIG_FILE).exists():
            raise ConfigError(
                f"{self.folder}: was removed while the release was being made; run the command "
                "again"
            )
        self.store.write_result(name, _MADE_NOTE, b"")

    def gather(self, names: Iterable[str]) -> None:
        """Move the files of scenarios' parts into the release, unless they are already there."""
        for name in names:
            folder = self.part(name)
            if folder.is_dir():
                _move_files(folder, self.release)

    def complete(self) -> None:
        """Move the release into its place, and remove the folder."""
        if self.out.is_dir():
            self.out.rmdir()
        self.release.replace(self.out)
        shutil.rmtree(self.folder, ignore_errors=True)


@contextmanager
def unfinished_release(unfinished: Unfinished, config: SynthConfig) -> Iterator[Callable[[], bool]]:
    """Work on a release in the block.

    If no part is complete at the end, the folder is removed.

    Yields:
        A function that waits until this process has the folder to itself, and returns whether no
        other one has completed the release.

    Raises:
        ConfigError: The place of the release is taken, the unfinished release is of another
            configuration or version, or something cannot be written.
    """
    store = unfinished.store
    config_path = unfinished.folder / _CONFIG_FILE

    def begin() -> None:
        # The process that held the lock before may have completed the release.
        check_free(unfinished.out)
        _write_or_compare(config_path, config)

    with store.shared(begin) as turn:
        _write_or_compare(config_path, config)
        try:
            yield turn.alone
        finally:
            has_folder = unfinished.folder.is_dir()
            is_empty = has_folder and not any(unfinished.folder.glob("kept/*"))
            if is_empty and turn.alone(wait=False):
                shutil.rmtree(unfinished.folder, ignore_errors=True)


def _write_or_compare(path: Path, config: SynthConfig) -> None:
    """Write a configuration, or compare it with the one that was written before.

    Raises:
        ConfigError: They differ, or the file cannot be read.
    """
    settings = _list_settings(config)
    if not path.exists():
        write_bytes(path, json.dumps(settings, indent=1).encode())
        return
    written_settings = _read_settings(path)
    if written_settings.get("spec") != settings["spec"]:
        difference = "spec"
    else:
        difference = differing_text(written_settings, settings)
    if difference:
        raise ConfigError(
            f"{path.parent}: contains an unfinished release with other settings ({difference}); "
            "use the same settings to finish it, or remove the folder"
        )


def _read_settings(path: Path) -> NamedValues:
    """Read a JSON object; raise ConfigError if the file cannot be read.

    Returns:
        The object; an empty dictionary if the file contains another JSON value.
    """
    text = file_text(path)
    try:
        settings = parsed_json(text.encode())
    except ValueError as error:
        raise ConfigError(f"{path}: {error}; remove its folder") from error
    if not isinstance(settings, dict):
        return {}
    return settings


def file_text(path: Path) -> str:
    """Read a text file; raise ConfigError if it cannot be read."""
    try:
        return read_bytes(path, "spec").decode()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {fault_text(error)}; make it readable, or remove it") from error


def _list_settings(config: SynthConfig) -> NamedValues:
    """Return all settings that the bytes of a release depend on, as they are read from JSON.

    They contain the scenario file's text instead of its path.
    """
    text = None
    if config.spec is not None:
        text = file_text(config.spec)
    fields = {"version": __version__, **asdict(config), "image_size": config.pixels, "spec": text}
    settings: NamedValues = json.loads(json.dumps(fields))
    return settings


def _move_files(part: Path, release: Path) -> None:
    """Move a part's files to their places in the release, and remove the part.

    Temporary files are removed with it: they come only from processes with locks that do not
    exclude others, and the part is complete.
    """
    for folder, _, names in os.walk(part):
        relative_folder = Path(folder).relative_to(part)
        target = place_in(release, relative_folder, opened=True)
        target.mkdir(parents=True, exist_ok=True)
        for name in names:
            if temporary_of(name) is None:
                Path(folder, name).replace(target / name)
    shutil.rmtree(part)


def make_release(
    out: Path,
    config: SynthConfig | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress = False,
) -> Path:
    """Make a complete synthetic release, and return its folder.

    The release is made in a hidden folder next to `out`, `.NAME.unfinished`, and renamed when it is
    complete. After an interruption (a full disk, a kill) the same call makes only the missing
    parts; several processes that make the same call share the scenarios.

    Args:
        out: Folder to make; it must be empty, or not exist yet.
        config: Settings of the release; `SynthConfig()` if None.
        workers: Number of processes; several may record one scenario. With None the generator
            chooses. The files depend neither on it nor on interruptions.
        executor: Any executor of `concurrent.futures` to run on, instead of workers that this call
            starts.
        progress: Whether to show a progress bar; or a function that is called after each part of
            the work, with its share of the total work.

    Raises:
        ConfigError: `out` is a file, is not empty or cannot be made; an unfinished release of
            another configuration is there; the scenario file cannot be read or simulated; or
            something cannot be written.
        OutputFolderError: A link in the hidden folder points outside it; nothing is written there.
        ChoiceError: `workers` is less than 1.
        MissingExtraError: The release has files of sensors and the package embreex is not
            installed.
        SomeFailedError: Some parts cannot be recorded. All others are, and a repeated call tries
            only the missing ones.
        WorkerError: A worker was killed, or cannot do the work.
    """
    config = config or SynthConfig()
    out = path_of(out)
    check_free(out)
    if config.sensors != "none":
        require_embree()
    plans = plan_scenarios(config)
    if not is_writable_folder(out.parent):
        raise ConfigError(f"{out.parent}: cannot be written; choose another folder")
    unfinished = Unfinished(out.absolute())
    with unfinished_release(unfinished, config) as wait_until_alone:
        parts: dict[str, RecordingJob] = {}
        for plan in plans:
            parts.update(_list_parts(unfinished, config, plan))
        engine: NamedValues = {
            "workers": workers or _worker_count(config, len(plans)),
            "executor": executor,
            "progress": progress,
        }
        record = partial(_record_part, unfinished)
        places = Places(writes=(unfinished.folder,))
        try:
            unfinished.store.run(
                record, parts, label="Recording parts of scenarios", places=places, **engine
            )
        finally:
            forget_scenario()
        if wait_until_alone():
            unfinished.release.mkdir(exist_ok=True)
            unfinished.gather(parts)
            _save_splits(unfinished.release, config, plans)
            unfinished.complete()
    return out


def _save_splits(release: Path, config: SynthConfig, plans: Sequence[ScenarioPlan]) -> None:
    """Write the split files of a release."""
    splits = plan_splits(plans)
    splits.save(release, overwrite=True)
    if config.for_released_code:
        splits.save(place_in(release, SPLIT_FILE_FOLDER, opened=True), overwrite=True)


def _list_parts(
    unfinished: Unfinished, config: SynthConfig, plan: ScenarioPlan
) -> dict[str, RecordingJob]:
    """Return the parts of a scenario by their names."""
    if config.sensors == "accidents":
        config = replace(config, sensors="all" if plan.accident else "none")
    count = part_count(config)
    jobs = {}
    for first_frame in range(1, count + 1):
        name = f"{plan.scenario_type}_{plan.name}_{first_frame}of{count}"
        folder = unfinished.part(name)
        jobs[name] = RecordingJob(folder, config, plan, first_frame, count)
    return jobs


def _record_part(unfinished: Unfinished, job: RecordingJob) -> None:
    """Record a part of a scenario into the folder of an unfinished release, unless it is made."""
    name = job.root.name
    if not unfinished.is_made(name):
        unfinished.clear(name)
        record_scenario(job)
        unfinished.note(name)


def _worker_count(config: SynthConfig, scenarios: int) -> int:
    """Return the number of workers: one for each core, or 1 if the work is too short for it."""
    num_frames = scenarios * (config.frames or _USUAL_FRAMES)
    min_frames = _MIN_PARALLEL_FRAMES
    if config.sensors == "none":
        min_frames = _MIN_PARALLEL_FRAMES_WITHOUT_SENSORS
    if num_frames < min_frames:
        return 1
    return usable_cores()
