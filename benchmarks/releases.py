"""Releases to measure on: many scenarios at the cost of making two."""

import shutil
from pathlib import Path

from deepaccident_devkit.release import find_release
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.taxonomy import AGENTS

WHOLE_SAMPLES, WHOLE_BYTES = 285_000, 310e9
"""Of the published release: five agents' samples, and its size unpacked."""


def index_share_of_raw(index_bytes: float, samples: int) -> float:
    """The size of the index of some samples as a share of the raw data's of as many."""
    return index_bytes / (WHOLE_BYTES * samples / WHOLE_SAMPLES)


def labels_only_release(root: Path, *, scenarios: int, frames: int) -> Path:
    """A release without sensor files: one accident and its twin, copied under other names."""
    made = make_release(root / "made", SynthConfig(scenarios=2, frames=frames, sensors=False), workers=2)
    out = root / "release"
    originals = find_release(made).scenarios
    for number in range(scenarios):
        original = originals[number % 2]
        name = f"{original.name[:-5]}{number:05d}"
        target = out / original.scenario_type
        target.joinpath("meta").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(original.meta_path, target / "meta" / f"{name}.txt")
        for agent in AGENTS:
            for kind in ("calib", "label"):
                folder = target / agent / kind / name
                folder.mkdir(parents=True)
                for file in original.kind_folder(agent, kind).iterdir():
                    shutil.copyfile(file, folder / file.name.replace(original.name, name))
    return out
