"""Making a synthetic release."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import is_writable_folder, path_of, place_in
from deepaccident_devkit.parallel import Places, Progress
from deepaccident_devkit.release.store.names import SPLIT_FILE_FOLDER
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.plan import ScenarioPlan, plan_scenarios, plan_splits
from deepaccident_devkit.synth.recording import RecordingJob, forget_scenario, parts_of, record_scenario
from deepaccident_devkit.synth.sensors.caster import require_embree
from deepaccident_devkit.synth.unfinished import Unfinished, check_free, unfinished_release

if TYPE_CHECKING:
    from concurrent.futures import Executor

_USUAL_FRAMES = 70
"""About how many frames a scenario has if the configuration does not say it."""


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
        draws = progress is True and count == 1 and executor is None
        parts = {
            name: part for plan in plans for name, part in _parts(unfinished, wanted, plan, progress=draws).items()
        }
        places = Places(writes=(unfinished.folder,))
        how: dict[str, Any] = {"workers": count, "executor": executor, "progress": progress}
        try:
            unfinished.store.run(_record, parts, label="recording", places=places, **how)
        finally:
            forget_scenario()
        if alone():
            unfinished.release.mkdir(exist_ok=True)
            unfinished.gather(parts)
            splits = plan_splits(plans)
            splits.save(unfinished.release, overwrite=True)
            if wanted.for_released_code:
                splits.save(place_in(unfinished.release, SPLIT_FILE_FOLDER, opened=True), overwrite=True)
            unfinished.complete()
    return out


@dataclass(frozen=True, slots=True)
class _Part:
    """A part of a scenario to record into the folder of an unfinished release."""

    unfinished: Unfinished
    name: str
    job: RecordingJob


def _parts(
    unfinished: Unfinished, config: SynthConfig, plan: ScenarioPlan, *, progress: bool = False
) -> dict[str, _Part]:
    """The parts of a scenario by their names; `progress` shows the draws, where no other process writes too."""
    parts = parts_of(config)
    names = {first: f"{plan.scenario_type}_{plan.name}_{first}of{parts}" for first in range(1, parts + 1)}
    return {
        name: _Part(unfinished, name, RecordingJob(unfinished.part(name), config, plan, first, parts, progress))
        for first, name in names.items()
    }


def _record(part: _Part) -> None:
    """Record a part, unless it is made."""
    unfinished, name = part.unfinished, part.name
    if not unfinished.is_made(name):
        unfinished.clear(name)
        record_scenario(part.job)
        unfinished.note(name)


def _worker_count(config: SynthConfig, scenarios: int) -> int:
    """One worker for each core, or 1 if the work is too short for it: a frame with sensors takes up to a second."""
    frames = scenarios * (config.frames or _USUAL_FRAMES)
    return (os.cpu_count() or 1) if frames >= (400 if config.sensors == "none" else 20) else 1
