"""Bulk work on each engine: this process on one core (`here`), own processes, dask workers, ranks
of MPI.

The work is an OpenCOOD export of labels, from scenarios about as long as real ones, with workers
that have imported all they need; the caller is a process of its own, and so is dask's scheduler.
With two workers on two cores they share these with both.

An item of no work, for `…_overhead_ms`, is as large as a scenario's, with the dataset; one for
`…_batch_ms` is a token alone, and so the engine's own time.

The serial share is what does not get faster with more workers, against the seconds of one core: the
    part of the call
outside of `run_batch` (choosing, the manifest, files of the whole), and for each item that is
handed to workers the processor time of the caller and of dask's scheduler, as measured on batches
of no work. It is rather too high: the former is taken to grow with the release, which not all of it
    does; and MPI's caller asks for messages all the time.

Figures `…_by_amdahl_N` are computed from that share and not measured: speed-up = 1 / (s + (1 - s) /
N). Shared disks and networks that are slower than this machine's are not in them, nor that 512
cores do 691 scenarios in two rounds.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from benchmarks import engine_caller
from benchmarks.engine_caller import Seen, Task
from benchmarks.measure import Figure
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
    kinds = {kind: counts for kind, counts in ENGINES.items() if installed(kind)}
    with tempfile.TemporaryDirectory(prefix="deepaccident_engine_") as folder:
        root = labels_only_release(Path(folder), scenarios=SCENARIOS, frames=FRAMES)
        DeepAccident(dataroot=root, verbose=False)
        found = {
            kind: {workers: probe(root, kind, workers) for workers in counts}
            for kind, counts in kinds.items()
        }
    here = found["here"][1]
    figures = [Figure(name="engine_samples", value=here.samples)]
    for kind, runs in found.items():
        figures += [
            figure
            for workers, seen in runs.items()
            for figure in of_run(f"engine_{kind}", workers, seen)
        ]
        if kind != "here":
            figures += of_engine(f"engine_{kind}", here, runs.get(1, here), runs[2])
    return figures


def installed(kind: str) -> bool:
    """Whether an engine is on this machine; says so if it is not."""
    needs = {
        "dask": importlib.util.find_spec("distributed"),
        "mpi": shutil.which("mpiexec") and importlib.util.find_spec("mpi4py"),
    }
    if needs.get(kind, True):
        return True
    print(f"engine: {kind} is not installed; its figures are left out", file=sys.stderr)
    return False


def probe(root: Path, kind: str, workers: int) -> Seen:
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
        line = ranks if kind == "mpi" else [sys.executable]
        done = subprocess.run(
            [*line, "-m", "benchmarks.engine", json.dumps(asdict(task))],
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            cwd=TOP,
            env={**os.environ, **MPI_SETTINGS},
        )
    return Seen(**json.loads(done.stdout))


@contextmanager
def cluster(kind: str, workers: int) -> Iterator[str | None]:
    """The address of an engine that has one."""
    if kind != "dask":
        yield "mpi" if kind == "mpi" else None
        return
    from distributed import LocalCluster

    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0") as started:
        yield started.scheduler_address


def of_run(name: str, workers: int, seen: Seen) -> list[Figure]:
    ending = f"{workers}_worker{'s' * (workers > 1)}"
    return [
        Figure(
            name=f"{name}_samples_per_s_{ending}",
            value=seen.samples / seen.export_s,
            unit="samples/s",
        ),
        Figure(name=f"{name}_overhead_ms_{ending}", value=1e3 * seen.item_s, unit="ms a scenario"),
        Figure(name=f"{name}_batch_ms_{ending}", value=1e3 * seen.batch_s, unit="ms a batch"),
    ]


def of_engine(name: str, here: Seen, one: Seen, two: Seen) -> list[Figure]:
    """Figures of an engine from its runs with one and two workers, and from the one without it."""
    share = serial_share(here, two)
    speed_ups = {cores: amdahl(share, cores) for cores in CORES}
    minutes = WHOLE_SAMPLES / here.samples * here.export_s / 60
    return [
        Figure(name=f"{name}_efficiency_2_workers", value=one.export_s / two.export_s / 2),
        Figure(
            name=f"{name}_caller_mb", value=two.growth_mb, unit=f"MB more for {BATCHES:,} batches"
        ),
        Figure(name=f"{name}_serial_share", value=share),
        *(
            Figure(
                name=f"{name}_speed_up_by_amdahl_{cores}", value=speed_up, unit="times (computed)"
            )
            for cores, speed_up in speed_ups.items()
        ),
        *(
            Figure(
                name=f"{name}_whole_release_by_amdahl_{cores}",
                value=minutes / speed_up,
                unit="minutes (computed)",
            )
            for cores, speed_up in speed_ups.items()
        ),
    ]


def serial_share(here: Seen, engine: Seen) -> float:
    """The part of one core's time that more workers of an engine do not make shorter."""
    return (engine.outside_s + engine.handed * engine.batch_busy_s) / here.export_s


def amdahl(serial: float, cores: int) -> float:
    """How many times faster than one core, if a share of the work stays with one."""
    return 1 / (serial + (1 - serial) / cores)


if __name__ == "__main__":  # not in the other module: workers import its functions by name
    engine_caller.main()
