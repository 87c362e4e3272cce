"""Making an index from labels, calib and meta, and its size on disk against the raw data's."""

import tempfile
from pathlib import Path

from benchmarks.measure import Figure, best_of
from benchmarks.releases import WHOLE_SAMPLES, index_share_of_raw, labels_only_release
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
        (size,) = {size_of(index) for index in Path(folder).glob("index *")}
    return [
        Figure(name="indexing_samples", value=samples),
        Figure(name="indexing_samples_per_s_1_worker", value=rates[1], unit="samples/s"),
        Figure(name="indexing_samples_per_s_2_workers", value=rates[2], unit="samples/s"),
        Figure(name="indexing_whole_release_s_2_workers", value=WHOLE_SAMPLES / rates[2], unit="s (extrapolated)"),
        Figure(name="indexing_index_kb_per_sample", value=size / samples / 1e3, unit="kB"),
        Figure(name="indexing_index_share_of_raw", value=index_share_of_raw(size, samples), bound=0.01),
    ]


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
