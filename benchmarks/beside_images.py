"""Training images of one agent's six cameras, ours and `loader_rivals` by turns, through a
DataLoader: ms an item.

`full` is beside those that decode whole images, `scaled` beside those that decode them at half of
their size. Batches are of one item. The clock counts, since workers are other processes.
"""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.loader import RELEASE, SCENARIOS, ways
from benchmarks.loader_rivals import rivals
from benchmarks.measure import Figure, has_torch
from benchmarks.releases import copied_release
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.plugins.synth import make_release
from deepaccident_devkit.taxonomy import AGENTS

EPOCHS = 5


def measure() -> list[Figure]:
    if not has_torch("beside"):
        return []
    with tempfile.TemporaryDirectory() as folder:
        made = make_release(Path(folder) / "made", RELEASE, workers=2)
        release = copied_release(made, Path(folder) / "release", scenarios=SCENARIOS)
        items = ways(DeepAccident(dataroot=release, verbose=False), None, AGENTS[:1])
        return [figure for workers in (0, 1, 2) for figure in compared(items, workers)]


def compared(items: dict[str, Any], workers: int) -> Iterator[Figure]:
    """Each of ours beside each other of its kind."""
    from torch.utils.data import DataLoader

    loaders = {
        way: DataLoader(each, num_workers=workers, persistent_workers=workers > 0)
        for way, each in items.items()
    }
    taken: dict[str, list[float]] = {way: [] for way in loaders}
    for epoch in range(EPOCHS + 1):
        for way, loader in loaders.items():
            start = time.perf_counter()
            for _ in loader:
                pass
            if epoch:  # in the first one workers begin
                taken[way].append(1e3 * (time.perf_counter() - start) / len(items[way]))
    for name, rival in rivals().items():
        for kind in ("", "_normalised"):
            ours = f"{'scaled' if rival.scaled else 'full'}{kind}"
            yield Figure(
                name=f"beside_images_{ours}_{workers}_workers_{name}",
                value=median(taken[ours]),
                unit="ms",
                reference=median(taken[f"{name}{kind}"]),
            )
