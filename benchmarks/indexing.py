"""Measure making an index from labels, calib and meta, its size on disk against the raw data's, and
the start of commands.
"""

import os
import subprocess
import sys
from pathlib import Path

from benchmarks.measure import Figure, best_of, temporary_folder
from benchmarks.releases import WHOLE_SAMPLES, index_share_of_raw, labels_only_release
from deepaccident_devkit.release import find_release
from deepaccident_devkit.tables import open_index

SCENARIOS, FRAMES, AGENTS = 48, 40, 5
STARTED_SCENARIOS, STARTED_FRAMES = 24, 80
STARTS = 12


def measure() -> list[Figure]:
    samples = SCENARIOS * FRAMES * AGENTS
    rates = {}
    with temporary_folder() as folder:
        layout = find_release(labels_only_release(folder, scenarios=SCENARIOS, frames=FRAMES))
        for workers in (1, 2):
            index_dirs = iter([folder / f"index {workers} {number}" for number in range(2)])
            seconds = best_of(
                2,
                lambda workers=workers, index_dirs=index_dirs: open_index(
                    layout, index_dir=next(index_dirs), workers=workers
                ),
            )
            rates[workers] = samples / seconds
        (size,) = {size_of(index) for index in folder.glob("index *")}
    return [
        Figure("indexing_samples", samples),
        Figure("indexing_samples_per_s_1_worker", rates[1], "samples/s"),
        Figure("indexing_samples_per_s_2_workers", rates[2], "samples/s"),
        Figure(
            "indexing_whole_release_s_2_workers",
            WHOLE_SAMPLES / rates[2],
            "s (extrapolated)",
        ),
        Figure("indexing_index_kb_per_sample", size / samples / 1e3, "kB"),
        Figure("indexing_index_share_of_raw", index_share_of_raw(size, samples), bound=0.01),
        *commands(),
    ]


def commands() -> list[Figure]:
    """Measure whole commands, the start of their process included: elapsed time of `index`,
    otherwise processor time.
    """
    with temporary_folder() as folder:
        release = labels_only_release(folder, scenarios=STARTED_SCENARIOS, frames=STARTED_FRAMES)
        files = sum(path.is_file() for path in release.rglob("*"))
        index_dirs = iter([f"{folder}/index {number}" for number in range(3)])
        indexing = best_of(3, lambda: run("index", str(release), "--index-dir", next(index_dirs)))
        info = ("info", str(release), "--index-dir", f"{folder}/index 0")
        return [
            Figure(
                "indexing_files_per_s_command",
                files / indexing,
                "files/s",
                bound=6000,
                higher_is_better=True,
            ),
            Figure("start_help_s", start_seconds("--help"), bound=0.15),
            Figure("start_info_s", start_seconds(*info), bound=0.25),
        ]


def run(*arguments: str) -> None:
    subprocess.run(
        [sys.executable, "-m", "deepaccident_devkit", *arguments], check=True, capture_output=True
    )


def start_seconds(*arguments: str) -> float:
    """Return the least processor time of a command and its children."""
    return min(processor_seconds(*arguments) for _ in range(STARTS))


def processor_seconds(*arguments: str) -> float:
    """Return the processor time of a command and its children."""
    before = os.times()
    run(*arguments)
    after = os.times()
    user = after.children_user - before.children_user
    return user + after.children_system - before.children_system


def size_of(folder: Path) -> int:
    """Return the bytes of all files below a folder."""
    files = filter(Path.is_file, folder.rglob("*"))
    return sum(file.stat().st_size for file in files)
