"""Make releases to measure on: many scenarios at the cost of making two."""

import shutil
from pathlib import Path

from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release import find_release
from deepaccident_devkit.taxonomy import AGENTS

WHOLE_SAMPLES, WHOLE_BYTES = 285_000, 310e9
"""Number of samples of all five agents of the published release, and its unpacked size in bytes."""


def index_share_of_raw(index_bytes: float, samples: int) -> float:
    """Return the size of an index as a share of the raw data of as many samples."""
    return index_bytes / (WHOLE_BYTES * samples / WHOLE_SAMPLES)


def labels_only_release(root: Path, *, scenarios: int, frames: int) -> Path:
    """Make a release without sensor files: one accident and its twin, copied under other names."""
    config = SynthConfig(scenarios=2, frames=frames, sensors=False, designed=True)
    original = make_release(root / "made", config, workers=2)
    return copied_release(original, root / "release", scenarios=scenarios)


def copied_release(release: Path, out: Path, *, scenarios: int) -> Path:
    """Make a release of a number of scenarios, which are another release's by turns, copied under
    other names.
    """
    originals = find_release(release).scenarios
    for number in range(scenarios):
        original = originals[number % len(originals)]
        name = f"{original.name[:-5]}{number:05d}"
        target = out / original.scenario_type
        target.joinpath("meta").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(original.meta_path, target / "meta" / f"{name}.txt")
        for kind in original.kind_folder(AGENTS[0], "").parent.iterdir():
            for agent in AGENTS:
                folder = target / agent / kind.name / name
                folder.mkdir(parents=True)
                for file in original.kind_folder(agent, kind.name).iterdir():
                    file_name = file.name.replace(original.name, name)
                    shutil.copyfile(file, folder / file_name)
    return out
