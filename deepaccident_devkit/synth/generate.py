"""Making a synthetic release, as a whole or in shards."""

from __future__ import annotations

import os
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import is_writable_folder, path_of, place_in
from deepaccident_devkit.parallel import MERGE, Part, Places, Progress, Shard, check_whole, mine, part_of, run_unordered
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
    part: Part | str = None,
    progress: Progress = False,
) -> Path:
    """Write a complete synthetic release; returns its folder.

    The release is made in a hidden folder beside `out`, `.NAME.unfinished`, and renamed when it is complete. After an
    interruption (a full disk, a kill) the same call makes only what is still missing.

    Args:
        out: the folder to make; it must be empty, or not exist yet.
        config: the settings of the release; `SynthConfig()` if None.
        workers: number of processes; several may record one scenario. With None the generator chooses. The files
            depend neither on it nor on interruptions.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        part: `3/8` records the scenarios of the third of eight parts (docs/clusters.md), and leaves them in the hidden
            folder; `merge` makes the release of them once all are there.
        progress: whether to show a progress bar; or a function that is called after each part of the work, with its
            share of all that was to do.

    Raises:
        ConfigError: `out` is a file, is not empty or cannot be made; an unfinished release of another
            configuration is there, or another process makes it; the scenario file cannot be read or simulated.
        OutputFolderError: a link in the hidden folder leads out of it; nothing is written there.
        ChoiceError: there is no such part, or `workers` is less than 1.
        MissingExtraError: files of sensors are wanted and the package embreex is not installed.
        UnfinishedError: `part` is `merge`, and some scenarios are not recorded.
        WorkerError: a worker was killed, or cannot do the work.
    """
    wanted, part = config or SynthConfig(), part_of(part)
    out = path_of(out)
    check_free(out)
    if wanted.sensors != "none":
        require_embree()
    plans = plan_scenarios(wanted)
    if not is_writable_folder(out.parent):
        raise ConfigError(f"{out.parent}: cannot be written; choose another folder")
    with unfinished_release(out, wanted, shared=isinstance(part, Shard)) as unfinished:
        own = mine(part, plans)
        count = workers or _worker_count(wanted, len(own))
        draws = progress is True and count == 1 and executor is None
        scenarios = [_parts(unfinished, wanted, plan, progress=draws) for plan in own]
        if part == MERGE:
            check_whole([name for parts in scenarios for name in parts], unfinished.made(), out)
        recorded = _recorded(unfinished, scenarios, workers=count, executor=executor, progress=progress)
        with closing(recorded):
            for parts in recorded:
                if not isinstance(part, Shard):
                    unfinished.gather(parts)
        if isinstance(part, Shard):
            return out
        splits = plan_splits(plans)
        splits.save(unfinished.release, overwrite=True)
        if wanted.for_released_code:
            splits.save(place_in(unfinished.release, SPLIT_FILE_FOLDER, opened=True), overwrite=True)
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


def _recorded(
    unfinished: Unfinished,
    scenarios: Sequence[Mapping[str, _Part]],
    *,
    workers: int,
    executor: Executor | None,
    progress: Progress,
) -> Generator[Mapping[str, _Part], None, None]:
    """Record the parts that are not made yet; yields each scenario when all its parts are there."""
    made = set(unfinished.made())
    yield from (parts for parts in scenarios if made.issuperset(parts))
    left = [(part, parts) for parts in scenarios for name, part in parts.items() if name not in made]
    recorded = run_unordered(
        _record,
        [part for part, _ in left],
        workers=workers,
        executor=executor,
        label="recording",
        progress=progress,
        places=Places(writes=(unfinished.folder,)),
    )
    try:
        with closing(recorded):
            for position, _ in recorded:
                part, parts = left[position]
                made.add(part.name)
                if made.issuperset(parts):
                    yield parts
    finally:
        forget_scenario()


def _record(part: _Part) -> None:
    """Record a part, unless it is made."""
    unfinished, name = part.unfinished, part.name
    with unfinished.alone(name):  # a worker that a scheduler took for lost may be at it still
        if unfinished.is_made(name):
            return
        unfinished.clear(name)
        record_scenario(part.job)
        unfinished.note(name)


def _worker_count(config: SynthConfig, scenarios: int) -> int:
    """One worker for each core, or 1 if the work is too short for it: a frame with sensors takes up to a second."""
    frames = scenarios * (config.frames or _USUAL_FRAMES)
    return (os.cpu_count() or 1) if frames >= (400 if config.sensors == "none" else 20) else 1
