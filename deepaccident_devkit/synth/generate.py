"""Making a whole synthetic release."""

import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import is_writable_folder
from deepaccident_devkit.parallel import Progress, run_unordered
from deepaccident_devkit.release.layout import SPLIT_FILE_FOLDER
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.plan import ScenarioPlan, plan_scenarios, plan_splits
from deepaccident_devkit.synth.recording import RecordingJob, forget_scenario, parts_of, record_scenario
from deepaccident_devkit.synth.sensors.caster import require_embree
from deepaccident_devkit.synth.unfinished import Unfinished, unfinished_release

_USUAL_FRAMES = 70
"""About how many frames a scenario has if the configuration does not say it."""


def make_release(
    out: Path, config: SynthConfig | None = None, *, workers: int | None = None, progress: Progress = False
) -> Path:
    """Write a complete synthetic release; returns its folder.

    The release is made in a hidden folder beside `out`, `.NAME.unfinished`, and renamed when it is complete. After an
    interruption (a full disk, a kill) the same call makes only what is still missing.

    Args:
        out: the folder to make; it must be empty, or not exist yet.
        config: the settings of the release; `SynthConfig()` if None.
        workers: number of processes; several may record one scenario. With None the generator chooses. The files
            depend neither on it nor on interruptions.
        progress: whether to show a progress bar; or a function that is called after each part of the work, with its
            share of all that was to do.

    Raises:
        ConfigError: `out` is a file, is not empty or cannot be made; an unfinished release of another
            configuration is there; the scenario file cannot be read or simulated.
        MissingExtraError: sensors are wanted and the package embreex is not installed.
        WorkerError: a worker was killed.
    """
    wanted = config or SynthConfig()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: exists and is not an empty folder; choose another folder, or remove this one")
    if wanted.sensors:
        require_embree()
    plans = plan_scenarios(wanted)
    if not is_writable_folder(out.parent):
        raise ConfigError(f"{out.parent}: cannot be written; choose another folder")
    with unfinished_release(out, wanted) as unfinished:
        count = workers or _worker_count(wanted, len(plans))
        jobs = [_jobs(unfinished, wanted, plan, progress=progress is True and count == 1) for plan in plans]
        _record_all(unfinished, jobs, count, progress=progress)
        splits = plan_splits(plans)
        splits.save(unfinished.release, overwrite=True)
        if wanted.for_released_code:
            splits.save(unfinished.release / SPLIT_FILE_FOLDER, overwrite=True)
    return out


def _jobs(
    unfinished: Unfinished, config: SynthConfig, plan: ScenarioPlan, *, progress: bool = False
) -> dict[str, RecordingJob]:
    """The parts of a scenario by their names; `progress` shows the draws, where no other process writes too."""
    parts = parts_of(config)
    names = {first: f"{plan.scenario_type}_{plan.name}_{first}of{parts}" for first in range(1, parts + 1)}
    return {
        name: RecordingJob(unfinished.part(name), config, plan, first, parts, progress) for first, name in names.items()
    }


def _record_all(
    unfinished: Unfinished, scenarios: Sequence[Mapping[str, RecordingJob]], workers: int, *, progress: Progress
) -> None:
    """Record the parts that are not made yet, and bring each scenario into the release when all its parts are there."""
    made = set(unfinished.made())
    for parts in scenarios:
        if made.issuperset(parts):
            unfinished.gather(parts)
    left = [(name, job, parts) for parts in scenarios for name, job in parts.items() if name not in made]
    for name, _, _ in left:
        unfinished.clear(name)
    jobs = [job for _, job, _ in left]
    recorded = run_unordered(record_scenario, jobs, workers=workers, label="recording", progress=progress)
    try:
        with closing(recorded):
            for position, _ in recorded:
                name, _, parts = left[position]
                unfinished.note(name)
                made.add(name)
                if made.issuperset(parts):
                    unfinished.gather(parts)
    finally:
        forget_scenario()


def _worker_count(config: SynthConfig, scenarios: int) -> int:
    """One worker for each core, or 1 if the work is too short for it: a frame with sensors takes up to a second."""
    frames = scenarios * (config.frames or _USUAL_FRAMES)
    return (os.cpu_count() or 1) if frames >= (20 if config.sensors else 400) else 1
