"""Measure validating a release by labels, calib, meta and file names."""

from functools import partial

from benchmarks.measure import Figure, best_of, temporary_folder
from benchmarks.releases import WHOLE_SAMPLES, labels_only_release
from deepaccident_devkit.validation import validate_release

SCENARIOS, FRAMES, AGENTS = 48, 40, 5


def measure() -> list[Figure]:
    samples = SCENARIOS * FRAMES * AGENTS
    rates = {}
    with temporary_folder() as folder:
        root = labels_only_release(folder, scenarios=SCENARIOS, frames=FRAMES)
        for workers in (1, 2):
            seconds = best_of(2, partial(validate_release, root, workers=workers))
            rates[workers] = samples / seconds
    return [
        Figure("validation_samples", samples),
        Figure("validation_samples_per_s_1_worker", rates[1], "samples/s"),
        Figure("validation_samples_per_s_2_workers", rates[2], "samples/s"),
        Figure(
            "validation_whole_release_s_2_workers",
            WHOLE_SAMPLES / rates[2],
            "s (extrapolated)",
        ),
    ]
