"""Measure bulk work on each engine: this process on one core (`here`), own processes, dask workers,
and ranks of MPI.

The work is an OpenCOOD export of labels, from scenarios about as long as real ones, with workers
that have imported all they need. The caller is a process of its own, and so is dask's scheduler.
Two workers on two cores share these with both.

For `…_overhead_ms`, an item of no work is as large as a scenario's, with the dataset. For
`…_batch_ms` it is only a token, so that only the engine's own time is measured.

The serial share is the time that does not shrink with more workers, divided by the seconds of one
core. It consists of the part of the call outside of `run_batch` (choosing, the manifest, files of
the whole), and for each item that is handed to workers the processor time of the caller and of
dask's scheduler, as measured on batches of no work. It is rather too high: the first part is
assumed to grow with the release, which not all of it does, and MPI's caller polls for messages all
the time.

Figures `…_by_amdahl_N` are computed from that share and not measured: speed-up = 1 / (s + (1 - s) /
N). They ignore shared disks and networks that are slower than this machine's, and that 512 cores
need two rounds for 691 scenarios.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from benchmarks import engine_caller
from benchmarks.engine_caller import Measurement, Task
from benchmarks.measure import Figure, temporary_folder
from benchmarks.releases import WHOLE_SAMPLES, labels_only_release
from deepaccident_devkit import DeepAccident

ENGINES = {"here": (1,), "own": (2,), "dask": (1, 2), "mpi": (1, 2)}
"""Name → numbers of workers."""
SCENARIOS, FRAMES = 8, 80
ITEMS, BATCHES = 500, 35_000
REPEATS = 2
CORES = (64, 512)
TOP = Path(__file__).parents[1]
MPI_SETTINGS = {
    "OMPI_ALLOW_RUN_AS_ROOT": "1",
    "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
    "OMPI_MCA_rmaps_base_oversubscribe": "1",
}
"""Containers have one user, and a machine may have fewer cores than ranks."""


def measure() -> list[Figure]:
    kinds = {kind: counts for kind, counts in ENGINES.items() if is_installed(kind)}
    runs: dict[str, dict[int, Measurement]] = {}
    with temporary_folder("engine") as folder:
        root = labels_only_release(folder, scenarios=SCENARIOS, frames=FRAMES)
        DeepAccident(dataroot=root, verbose=False)
        for kind, counts in kinds.items():
            runs[kind] = {workers: probe(root, kind, workers) for workers in counts}
    one_core = runs["here"][1]
    figures = [Figure("engine_samples", one_core.samples)]
    for kind, run_by_workers in runs.items():
        for workers, run in run_by_workers.items():
            figures += of_run(f"engine_{kind}", workers, run)
        if kind != "here":
            one_worker = run_by_workers.get(1, one_core)
            figures += of_engine(f"engine_{kind}", one_core, one_worker, run_by_workers[2])
    return figures


def is_installed(kind: str) -> bool:
    """Return whether an engine is on this machine; report on stderr if it is not."""
    requirements = {
        "dask": importlib.util.find_spec("distributed"),
        "mpi": shutil.which("mpiexec") and importlib.util.find_spec("mpi4py"),
    }
    if requirements.get(kind, True):
        return True
    print(f"engine: {kind} is not installed; its figures are left out", file=sys.stderr)
    return False


def probe(root: Path, kind: str, workers: int) -> Measurement:
    """Measure an engine from a new process."""
    with cluster(kind, workers) as address:
        batches = BATCHES if workers == 2 else ITEMS
        task = Task(
            dataroot=str(root),
            workers=workers,
            address=address,
            items=ITEMS,
            batches=batches,
            repeats=REPEATS,
        )
        ranks = ["mpiexec", "-n", str(workers + 1), sys.executable, "-m", "mpi4py.futures"]
        command = ranks if kind == "mpi" else [sys.executable]
        process = subprocess.run(
            [*command, "-m", "benchmarks.engine", json.dumps(asdict(task))],
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            cwd=TOP,
            env={**os.environ, **MPI_SETTINGS},
        )
    return Measurement(**json.loads(process.stdout))


@contextmanager
def cluster(kind: str, workers: int) -> Iterator[str | None]:
    """Start an engine of a kind, and yield its address if it has one."""
    if kind != "dask":
        yield "mpi" if kind == "mpi" else None
        return
    from distributed import LocalCluster

    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0") as dask:
        yield dask.scheduler_address


def of_run(name: str, workers: int, run: Measurement) -> list[Figure]:
    """Return the figures of one run of an engine."""
    suffix = f"{workers}_worker{'s' * (workers > 1)}"
    return [
        Figure(
            f"{name}_samples_per_s_{suffix}",
            run.samples / run.export_s,
            "samples/s",
        ),
        Figure(f"{name}_overhead_ms_{suffix}", 1e3 * run.item_s, "ms a scenario"),
        Figure(f"{name}_batch_ms_{suffix}", 1e3 * run.batch_s, "ms a batch"),
    ]


def of_engine(
    name: str, one_core: Measurement, one_worker: Measurement, two_workers: Measurement
) -> list[Figure]:
    """Return the figures of an engine from its runs with one and two workers, and from the run
    without it on one core.
    """
    share = serial_share(one_core, two_workers)
    speed_ups = {cores: amdahl(share, cores) for cores in CORES}
    minutes = WHOLE_SAMPLES / one_core.samples * one_core.export_s / 60
    growth_unit = f"MB more for {BATCHES:,} batches"
    figures = [
        Figure(
            f"{name}_efficiency_2_workers",
            one_worker.export_s / two_workers.export_s / 2,
        ),
        Figure(f"{name}_caller_mb", two_workers.growth_mb, growth_unit),
        Figure(f"{name}_serial_share", share),
    ]
    figures += [
        Figure(f"{name}_speed_up_by_amdahl_{cores}", speed_up, "times (computed)")
        for cores, speed_up in speed_ups.items()
    ]
    figures += [
        Figure(
            f"{name}_whole_release_by_amdahl_{cores}",
            minutes / speed_up,
            "minutes (computed)",
        )
        for cores, speed_up in speed_ups.items()
    ]
    return figures


def serial_share(one_core: Measurement, engine: Measurement) -> float:
    """Return the share of one core's time that more workers of an engine do not make shorter."""
    busy_s = engine.handed * engine.batch_busy_s
    return (engine.outside_s + busy_s) / one_core.export_s


def amdahl(serial: float, cores: int) -> float:
    """Return the speed-up over one core, if a share of the work stays with one core."""
    return 1 / (serial + (1 - serial) / cores)


if __name__ == "__main__":  # not in the other module: workers import its functions by name
    engine_caller.main()
