"""Making an index from labels, calib and meta."""

import tempfile
from pathlib import Path

from benchmarks.measure import Figure, best_of
from benchmarks.releases import labels_only_release
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import open_index

SCENARIOS, FRAMES, AGENTS = 48, 40, 5


def measure() -> list[Figure]:
    samples = SCENARIOS * FRAMES * AGENTS
    with tempfile.TemporaryDirectory() as folder:
        layout = find_release(labels_only_release(Path(folder), scenarios=SCENARIOS, frames=FRAMES))
        rates = {}
        for workers in (1, 2):
            rounds = iter(range(100))
            rates[workers] = samples / best_of(
                2,
                lambda workers=workers, rounds=rounds: open_index(
                    layout, index_dir=Path(folder) / f"index {workers} {next(rounds)}", workers=workers
                ),
            )
    return [
        Figure(name="indexing_samples", value=samples),
        Figure(name="indexing_samples_per_s_1_worker", value=rates[1], unit="samples/s"),
        Figure(name="indexing_samples_per_s_2_workers", value=rates[2], unit="samples/s"),
        Figure(name="indexing_whole_release_s_2_workers", value=285_000 / rates[2], unit="s (extrapolated)"),
    ]
