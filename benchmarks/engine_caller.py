"""Measure what a caller of bulk work sees of one engine, and print it as JSON.

The program's argument is a `Task` as JSON. With MPI it is started by `mpiexec`, as users do.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

from benchmarks.measure import best_of, one_core
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.export import bulk
from deepaccident_devkit.export.opencood import OpenCood
from deepaccident_devkit.support.parallel import cluster_executor, run_batch, store
from deepaccident_devkit.support.parallel.executors import own_workers

WARM_UP_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Task:
    """What to measure, and on which release.

    Attributes:
        dataroot: Folder of a release that is indexed.
        workers: Number of workers of the engine.
        address: Address of a cluster, or None for own workers; one own worker is this process.
        items: Number of items of no work, as large as the items of an export.
        batches: Number of batches of no work, with nothing to open; for memory.
        repeats: Number of exports; the fastest counts.
    """

    dataroot: str
    workers: int
    address: str | None
    items: int
    batches: int
    repeats: int


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What was measured of one engine.

    Attributes:
        samples: Number of samples of the export.
        export_s: Seconds of the whole call, with warm workers.
        outside_s: Seconds of the call outside of `run_batch`: before, between and after the work on
            scenarios.
        handed: Number of items that the call handed to `run_batch`.
        item_s: Seconds of an item of no work as large as that of an export, in a row of many: its
            dataset is opened for it.
        batch_s: Seconds of a batch of no work, in a row of many.
        batch_busy_s: Processor time of this process and of a dask scheduler, which workers do not
            share, for such a batch.
        growth_mb: Growth of this process's peak memory by all these batches.
    """

    samples: int
    export_s: float
    outside_s: float
    handed: int
    item_s: float
    batch_s: float
    batch_busy_s: float
    growth_mb: float


def main() -> None:
    task = Task(**json.loads(sys.argv[1]))
    with engine(task) as executor, one_core() if executor is None else nullcontext():
        print(json.dumps(asdict(run_task(task, executor))))


@contextmanager
def engine(task: Task) -> Iterator[Executor | None]:
    """Start the engine of a task; None if the task runs in this process."""
    if task.address is not None:
        engine_context = cluster_executor(task.address)
    else:
        engine_context = own_workers(task.workers)
    with engine_context as executor:
        yield None if task.address is None and task.workers == 1 else executor


def run_task(task: Task, executor: Executor | None) -> Measurement:
    """Measure an engine by a task."""
    dataset = DeepAccident(dataroot=task.dataroot, verbose=False)
    run_all = partial(run_batch, workers=1, executor=executor)
    run_all(sleep_for, [WARM_UP_S] * 4 * task.workers)
    token = dataset.scenario[0]["token"]
    batch = [token] * task.batches
    items = [(dataset, token)] * task.items
    peak_mb = peak_memory_mb()
    busy_s = busy_seconds(executor)
    batch_s = best_of(1, lambda: run_all(do_nothing, batch))
    batch_busy_s = busy_seconds(executor) - busy_s
    growth_mb = peak_memory_mb() - peak_mb
    item_s = best_of(1, lambda: run_all(do_nothing, items))
    exports = [time_export(dataset, executor) for _ in range(task.repeats)]
    export_s, outside_s, handed = min(exports)
    return Measurement(
        samples=len(dataset.sample),
        export_s=export_s,
        outside_s=outside_s,
        handed=handed,
        item_s=item_s / task.items,
        batch_s=batch_s / task.batches,
        batch_busy_s=batch_busy_s / task.batches,
        growth_mb=growth_mb,
    )


def time_export(dataset: DeepAccident, executor: Executor | None) -> tuple[float, float, int]:
    """Return the seconds of an export, its seconds outside of `run_batch`, and the number of items
    that `run_batch` got.
    """
    batch_seconds: list[float] = []
    batch_sizes: list[int] = []

    def timed(work: Callable[[Any], Any], items: list[Any], **options: Any) -> list[Any]:
        results: list[list[Any]] = []
        seconds = best_of(1, lambda: results.append(run_batch(work, items, **options)))
        batch_seconds.append(seconds)
        batch_sizes.append(len(items))
        return results[0]

    form = OpenCood(without_clouds=True)  # the release has only labels
    with (
        TemporaryDirectory(dir=dataset.dataroot.parent) as folder,
        mock.patch.object(store, "run_batch", timed),
    ):
        out = Path(folder) / "out"
        export = partial(bulk.export_release, dataset, out, form, workers=1, executor=executor)
        seconds = best_of(1, export)
    return seconds, seconds - sum(batch_seconds), sum(batch_sizes)


def busy_seconds(executor: Executor | None) -> float:
    """Return the processor time of this process so far, and of a dask scheduler if there is one."""
    client = getattr(executor, "_client", None)  # of a dask executor
    if client is None:
        return time.process_time()
    return time.process_time() + client.run_on_scheduler(time.process_time)


def peak_memory_mb() -> float:
    """Return the peak memory of this process in MB; not `ru_maxrss`, which begins with that of its
    parent.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    return int(status["VmHWM"].split()[0]) / 1024


def do_nothing(item: object) -> None:
    """Do no work."""


def sleep_for(seconds: float) -> None:
    """Sleep so long that every worker begins an item."""
    time.sleep(seconds)
