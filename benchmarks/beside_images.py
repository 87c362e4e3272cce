"""Load training images of one agent's six cameras, ours and `loader_rivals` by turns, through a
DataLoader: milliseconds per item.

`full` is compared with the rivals that decode whole images, `scaled` with the ones that decode them
at half of their size. Batches are of one item. Elapsed time is measured, since workers are other
processes.
"""

import time
from collections.abc import Iterator
from statistics import median
from typing import Any

from benchmarks.loader import RELEASE, SCENARIOS, make_datasets
from benchmarks.loader_rivals import rivals
from benchmarks.measure import Figure, has_torch, temporary_folder
from benchmarks.releases import copied_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import make_release
from deepaccident_devkit.taxonomy import AGENTS

EPOCHS = 5


def measure() -> list[Figure]:
    if not has_torch("beside"):
        return []
    with temporary_folder() as folder:
        original = make_release(folder / "made", RELEASE, workers=2)
        release = copied_release(original, folder / "release", scenarios=SCENARIOS)
        dataset = DeepAccident(dataroot=release, verbose=False)
        datasets = make_datasets(dataset, None, AGENTS[:1])
        return [figure for workers in (0, 1, 2) for figure in compare(datasets, workers)]


def compare(datasets: dict[str, Any], workers: int) -> Iterator[Figure]:
    """Compare each of ours with each rival of its kind."""
    from torch.utils.data import DataLoader

    loaders = {
        name: DataLoader(dataset, num_workers=workers, persistent_workers=workers > 0)
        for name, dataset in datasets.items()
    }
    milliseconds = {name: [] for name in loaders}
    for epoch in range(EPOCHS + 1):
        for name, loader in loaders.items():
            start = time.perf_counter()
            for _ in loader:
                pass
            seconds = time.perf_counter() - start
            if epoch:  # in the first one workers begin
                milliseconds[name].append(1e3 * seconds / len(datasets[name]))
    for name, rival in rivals().items():
        decoding = "scaled" if rival.scaled else "full"
        for suffix in ("", "_normalised"):
            ours = f"{decoding}{suffix}"
            yield Figure(
                f"beside_images_{ours}_{workers}_workers_{name}",
                median(milliseconds[ours]),
                "ms",
                reference=median(milliseconds[f"{name}{suffix}"]),
            )
