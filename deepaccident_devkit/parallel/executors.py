"""Executors of other libraries: how wide they are, what their errors mean, and those of a dask cluster."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, CancelledError
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import MOST_TOLD, DeepAccidentError, MissingExtraError, WorkerError, shortened
from deepaccident_devkit.support.reading import fault_text

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from distributed import Client

logger = logging.getLogger(__name__)

_USUAL_WIDTH: Final = 64
"""Tasks at once of an executor that does not say it."""
MPI: Final = "mpi"
_PACKAGE: Final = __name__.partition(".")[0]


def width_of(executor: Executor) -> int:
    """How many tasks an executor does at once, as far as it says it."""
    client: Client | None = getattr(executor, "_client", None)  # of a dask executor, whose workers come and go
    if client is not None:
        return sum(client.ncores().values()) or _USUAL_WIDTH
    told: int | None = getattr(executor, "num_workers", None) or getattr(executor, "_max_workers", None)
    return told or _USUAL_WIDTH  # the first is MPI's name, the second Python's


def fault_of_workers(error: Exception) -> str | None:
    """What an error says of the workers and not of the work; None if it says nothing of them."""
    distributed = sys.modules.get("distributed")
    if distributed is not None and isinstance(error, distributed.KilledWorker):
        return f"the dask worker of a task was killed several times ({error}), perhaps because memory ran out"
    if isinstance(error, BrokenExecutor):
        return f"a worker process was killed ({error}), perhaps because memory ran out; run it again with fewer workers"
    if isinstance(error, CancelledError):
        return "the scheduler has ended, or cancelled a task; start it again, then run the same: it does what is left"
    absent = isinstance(error, ImportError) or str(error).startswith("Can't get attribute")
    if absent and _PACKAGE in str(error) and not isinstance(error, DeepAccidentError):
        return f"a worker cannot do the work ({error}); install {_PACKAGE} {__version__} there"
    return None


@contextmanager
def cluster_executor(address: str | None = None, scheduler_file: Path | None = None) -> Iterator[Executor | None]:
    """An executor on the workers of a cluster, while the block runs; None without a scheduler.

    What is sent to a scheduler and comes back is pickled: it must be one that you trust.

    Args:
        address: of a dask scheduler, such as `tcp://10.0.0.5:8786`; or `mpi` for the other ranks of this MPI program,
            which was started by `mpiexec … python -m mpi4py.futures`.
        scheduler_file: the file that a dask scheduler writes its address into, in place of `address`.

    Raises:
        MissingExtraError: `distributed` or mpi4py is not installed.
        WorkerError: no scheduler answers, or this is no MPI program of several ranks.
    """
    if address is None and scheduler_file is None:
        yield None
    elif address == MPI:
        with _mpi_executor() as executor:
            yield executor
    else:
        with _dask_client(address, scheduler_file) as client:
            yield client.get_executor(pure=False)


@contextmanager
def _mpi_executor() -> Iterator[Executor]:
    try:
        from mpi4py import MPI as mpi  # noqa: N811 - the name of its C library
        from mpi4py.futures import MPIPoolExecutor
    except (ImportError, OSError, RuntimeError) as error:  # the last: there is no MPI on this machine
        raise MissingExtraError(
            f"mpi4py cannot be imported ({error}); install an MPI, and: pip install mpi4py"
        ) from error
    if mpi.COMM_WORLD.size < 2 or mpi.COMM_WORLD.rank:  # a rank but the first runs this: all would do the same
        raise WorkerError(
            "this is no MPI program whose other ranks wait for work; start it with: mpiexec -n 8 python -m "
            f"mpi4py.futures -m {_PACKAGE}.cli …"
        )
    with MPIPoolExecutor() as executor:
        yield executor


@contextmanager
def _dask_client(address: str | None, scheduler_file: Path | None) -> Iterator[Client]:
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError("dask is not installed; in a checkout: pip install '.[distributed]'") from error
    place = str(scheduler_file or address)
    try:
        if scheduler_file is not None:
            from deepaccident_devkit.parallel.scheduler_file import address_in  # it brings msgspec

            address = address_in(scheduler_file)
        client = _made(Client, address=address, set_as_default=False)
    except Exception as error:  # of an odd address dask raises many kinds
        said = shortened(fault_text(error), MOST_TOLD)
        raise WorkerError(
            f"{place}: no dask scheduler answers ({said}); start one with `dask scheduler`, and give its address"
        ) from error
    with client:
        if not client.ncores():
            logger.warning("%s: has no workers yet; waiting for them", place)
        yield client


def _made(kind: Any, **options: Any) -> Client:
    """A dask client; one that cannot connect is closed at once: when it is collected, that may hang the next one."""
    client: Any = kind.__new__(kind)
    try:
        client.__init__(**options)
    except BaseException:
        with suppress(Exception):
            client.close(timeout=1)
        raise
    return client
