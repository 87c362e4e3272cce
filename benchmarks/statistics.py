"""Measure all statistics over tables of the whole release's size, 8.6 M annotations, in a new
process.
"""

import json
import subprocess
import sys
from pathlib import Path

from benchmarks.measure import Figure, temporary_folder
from benchmarks.scale import write_whole_release

BOUND_S = 10.0
PROCESSES = 3

_PROBE = """
import json, sys, time
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.statistics import dataset_statistics
da = DeepAccident(dataroot=sys.argv[1], verbose=False)
start = time.perf_counter()
statistics = dataset_statistics(da)
seconds = time.perf_counter() - start
print(json.dumps({
    "statistics_annotations": statistics.counts["annotations"].total(),
    "statistics_s": seconds,
}))
"""


def measure() -> list[Figure]:
    with temporary_folder("statistics") as folder:
        root = write_whole_release(folder)
        runs = [probe(root) for _ in range(PROCESSES)]
    best = {name: min(run[name] for run in runs) for name in runs[0]}
    return [
        Figure("statistics_annotations", best["statistics_annotations"]),
        Figure("statistics_s", best["statistics_s"], "s", bound=BOUND_S),
    ]


def probe(root: Path) -> dict[str, float]:
    """Compute the statistics in a new process; only the files are cached."""
    process = subprocess.run(
        [sys.executable, "-c", _PROBE, str(root)], capture_output=True, text=True, check=True
    )
    return json.loads(process.stdout)
