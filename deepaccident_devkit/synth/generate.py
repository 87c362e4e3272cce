"""Making a whole synthetic release."""

import os
from collections.abc import Sequence
from pathlib import Path

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.files import is_writable_folder, replacing_folder
from deepaccident_devkit.parallel import run_batch
from deepaccident_devkit.release import write_split_file
from deepaccident_devkit.synth.caster import require_embree
from deepaccident_devkit.synth.config import SynthConfig
from deepaccident_devkit.synth.recording import RecordingJob, record_scenario
from deepaccident_devkit.synth.scenario import ScenarioPlan, plan_scenarios
from deepaccident_devkit.taxonomy import MINI_SPLITS, SPLITS


def make_release(
    out: Path, config: SynthConfig | None = None, *, workers: int | None = None, progress: bool = False
) -> Path:
    """Write a complete synthetic release; returns its folder.

    All splits are labelled, `test` too, which the real release leaves unlabelled. The release is made in a temporary
    folder beside `out` and renamed when it is whole.

    Args:
        out: the folder to make; must not exist or be empty.
        config: what the release is like; `SynthConfig()` if None.
        workers: processes, one a scenario; None chooses. The files do not depend on it.
        progress: whether to show a progress bar.

    Raises:
        ConfigError: `out` is a file, holds something or cannot be made.
        MissingExtraError: sensors are wanted and the package embreex is not installed.
    """
    wanted = config or SynthConfig()
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: exists and is not an empty folder; choose another folder, or remove this one")
    if not is_writable_folder(out.parent):
        raise ConfigError(f"{out.parent}: cannot be written; choose another folder")
    if wanted.sensors:
        require_embree()
    plans = plan_scenarios(wanted)
    with replacing_folder(out) as folder:
        jobs = [RecordingJob(folder, wanted, plan) for plan in plans]
        count = workers or _worker_count(wanted)
        run_batch(record_scenario, jobs, workers=count, label="scenarios", progress=progress)
        _write_splits(folder, plans)
    return out


def _worker_count(config: SynthConfig) -> int:
    """As many as there are cores, where that pays for starting processes: a frame with sensors costs up to a second."""
    frames = config.scenarios * config.frames
    return (os.cpu_count() or 1) if frames >= (20 if config.sensors else 400) else 1


def _write_splits(folder: Path, plans: Sequence[ScenarioPlan]) -> None:
    """Every split file, empty where nothing falls into it; the mini splits hold the first pair of theirs."""
    for split in SPLITS:
        write_split_file(folder / f"{split}.txt", [plan.token for plan in plans if plan.split == split])
    for mini in MINI_SPLITS:
        of_split = [plan for plan in plans if plan.split == mini.removesuffix("_mini")]
        tokens = [plan.token for plan in of_split if plan.pair == of_split[0].pair]
        write_split_file(folder / f"{mini}.txt", tokens)
