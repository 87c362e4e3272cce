"""Validating a release by labels, calib, meta and file names."""

import tempfile
from pathlib import Path

from benchmarks.measure import Figure, best_of
from benchmarks.releases import WHOLE_SAMPLES, labels_only_release
from deepaccident_devkit.validation import validate_release

SCENARIOS, FRAMES, AGENTS = 48, 40, 5


def measure() -> list[Figure]:
    samples = SCENARIOS * FRAMES * AGENTS
    with tempfile.TemporaryDirectory() as folder:
        root = labels_only_release(Path(folder), scenarios=SCENARIOS, frames=FRAMES)
        rates = {
            workers: samples
            / best_of(2, lambda workers=workers: validate_release(root, workers=workers))
            for workers in (1, 2)
        }
    return [
        Figure(name="validation_samples", value=samples),
        Figure(name="validation_samples_per_s_1_worker", value=rates[1], unit="samples/s"),
        Figure(name="validation_samples_per_s_2_workers", value=rates[2], unit="samples/s"),
        Figure(
            name="validation_whole_release_s_2_workers",
            value=WHOLE_SAMPLES / rates[2],
            unit="s (extrapolated)",
        ),
    ]
