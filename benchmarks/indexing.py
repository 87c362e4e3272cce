"""Making an index from labels, calib and meta, and its size on disk against the raw data's; how
commands start.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.measure import Figure, best_of
from benchmarks.releases import WHOLE_SAMPLES, index_share_of_raw, labels_only_release
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import open_index

SCENARIOS, FRAMES, AGENTS = 48, 40, 5
STARTED_SCENARIOS, STARTED_FRAMES = 24, 80
STARTS = 12


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
                    layout,
                    index_dir=Path(folder) / f"index {workers} {next(rounds)}",
                    workers=workers,
                ),
            )
        (size,) = {size_of(index) for index in Path(folder).glob("index *")}
    return [
        Figure(name="indexing_samples", value=samples),
        Figure(name="indexing_samples_per_s_1_worker", value=rates[1], unit="samples/s"),
        Figure(name="indexing_samples_per_s_2_workers", value=rates[2], unit="samples/s"),
        Figure(
            name="indexing_whole_release_s_2_workers",
            value=WHOLE_SAMPLES / rates[2],
            unit="s (extrapolated)",
        ),
        Figure(name="indexing_index_kb_per_sample", value=size / samples / 1e3, unit="kB"),
        Figure(
            name="indexing_index_share_of_raw", value=index_share_of_raw(size, samples), bound=0.01
        ),
        *commands(),
    ]


def commands() -> list[Figure]:
    """Whole commands, the start of their process included: the clock's time of `index`, else
    processor time.
    """
    with tempfile.TemporaryDirectory() as folder:
        release = labels_only_release(
            Path(folder), scenarios=STARTED_SCENARIOS, frames=STARTED_FRAMES
        )
        files = sum(path.is_file() for path in release.rglob("*"))
        rounds = iter(range(100))
        indexing = best_of(
            3, lambda: run("index", str(release), "--index-dir", f"{folder}/index {next(rounds)}")
        )
        info = ("info", str(release), "--index-dir", f"{folder}/index 0")
        return [
            Figure(
                name="indexing_files_per_s_command",
                value=files / indexing,
                unit="files/s",
                bound=6000,
                higher_is_better=True,
            ),
            Figure(
                name="start_help_s",
                value=min(processor_seconds("--help") for _ in range(STARTS)),
                bound=0.15,
            ),
            Figure(
                name="start_info_s",
                value=min(processor_seconds(*info) for _ in range(STARTS)),
                bound=0.25,
            ),
        ]


def run(*arguments: str) -> None:
    subprocess.run(
        [sys.executable, "-m", "deepaccident_devkit", *arguments], check=True, capture_output=True
    )


def processor_seconds(*arguments: str) -> float:
    """Of a command and its children."""
    before = os.times()
    run(*arguments)
    after = os.times()
    return (
        after.children_user - before.children_user + after.children_system - before.children_system
    )


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
