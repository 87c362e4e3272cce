"""What a caller of bulk work sees of one engine: a program of its own, which prints it as JSON.

Its argument is a `Task` as JSON. With MPI it is started by `mpiexec`, as its users start theirs.
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

WARMING_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Task:
    """What to measure, and on what.

    Attributes:
        dataroot: of a release that is indexed.
        workers: of the engine.
        address: of a cluster, or None for own workers; one own worker is this process.
        items: of no work, as large as those of an export.
        batches: of no work, with nothing to open; for memory.
        repeats: how often the export runs; the fastest counts.
    """

    dataroot: str
    workers: int
    address: str | None
    items: int
    batches: int
    repeats: int


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What was measured.

    Attributes:
        samples: of the export.
        export_s: the whole call, with warm workers.
        outside_s: of these, outside of `run_batch`: before, between and after the work on
            scenarios.
        handed: items that the call handed to `run_batch`.
        item_s: an item of no work as large as that of an export, in a row of many: its dataset is
            opened for it.
        batch_s: a batch of no work, in a row of many.
        batch_busy_s: for that, processor time of this process and of a dask scheduler, which
            workers do not share.
        growth_mb: of this process's memory at its highest, by all those batches.
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
        print(json.dumps(asdict(seen(task, executor))))


@contextmanager
def engine(task: Task) -> Iterator[Executor | None]:
    alone = task.address is None and task.workers == 1
    with (
        own_workers(task.workers)
        if task.address is None
        else cluster_executor(task.address) as executor
    ):
        yield None if alone else executor


def seen(task: Task, executor: Executor | None) -> Seen:
    dataset = DeepAccident(dataroot=task.dataroot, verbose=False)
    run_all = partial(run_batch, workers=1, executor=executor)
    run_all(asleep, [WARMING_S] * 4 * task.workers)
    token = dataset.scenario[0]["token"]
    highest, busy = highest_mb(), busy_seconds(executor)
    batch_s = best_of(1, lambda: run_all(nothing, [token] * task.batches)) / task.batches
    batch_busy_s = (busy_seconds(executor) - busy) / task.batches
    growth_mb = highest_mb() - highest
    item_s = best_of(1, lambda: run_all(nothing, [(dataset, token)] * task.items)) / task.items
    export_s, outside_s, handed = min(exported(dataset, executor) for _ in range(task.repeats))
    return Seen(
        samples=len(dataset.sample),
        export_s=export_s,
        outside_s=outside_s,
        handed=handed,
        item_s=item_s,
        batch_s=batch_s,
        batch_busy_s=batch_busy_s,
        growth_mb=growth_mb,
    )


def exported(dataset: DeepAccident, executor: Executor | None) -> tuple[float, float, int]:
    """Seconds of an export, those outside of `run_batch`, and the items that it got."""
    batches: list[tuple[float, int]] = []

    def timed(work: Callable[[Any], Any], items: list[Any], **options: Any) -> list[Any]:
        results: list[list[Any]] = []
        seconds = best_of(1, lambda: results.append(run_batch(work, items, **options)))
        batches.append((seconds, len(items)))
        return results[0]

    form = OpenCood(without_clouds=True)  # the release has labels alone
    with (
        TemporaryDirectory(dir=dataset.dataroot.parent) as folder,
        mock.patch.object(store, "run_batch", timed),
    ):
        seconds = best_of(
            1,
            lambda: bulk.export_release(
                dataset, Path(folder) / "out", form, workers=1, executor=executor
            ),
        )
    inside, handed = map(sum, zip(*batches, strict=True))
    return seconds, seconds - inside, handed


def busy_seconds(executor: Executor | None) -> float:
    """Processor time of this process so far, and of the scheduler's if there is one."""
    client = getattr(executor, "_client", None)  # of a dask executor
    return time.process_time() + (
        client.run_on_scheduler(time.process_time) if client is not None else 0.0
    )


def highest_mb() -> float:
    """The most memory that this process has had; not `ru_maxrss`, which begins with that of its
    parent.
    """
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) / 1024


def nothing(item: object) -> None:
    """No work."""


def asleep(seconds: float) -> None:
    """Long enough that every worker begins one."""
    time.sleep(seconds)
