"""Executors of other libraries and of a dask cluster, and a pool of processes of this machine.

The pool ends with the work: after an error, Ctrl-C, or the end of its parent.
"""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, CancelledError
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from deepaccident_devkit.errors import (
    MOST_TOLD,
    DeepAccidentError,
    MissingExtraError,
    WorkerError,
    shortened,
)
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.reading import fault_text, read_bytes
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor

    from distributed import Client

logger = logging.getLogger(__name__)

# Tasks at once of an executor that does not say it.
_USUAL_WIDTH: Final = 64
MPI: Final = "mpi"
# How long an empty file of a scheduler may still get its address.
ADDRESS_WAIT: Final = 10.0
FEWER_WORKERS: Final = "if memory or shared memory (/dev/shm) ran out, use fewer workers, or none (for training: without --workers)"
_PACKAGE: Final = __name__.partition(".")[0]
# Within `workers_kept`: number of processes → a pool of them that waits for work.
_kept: ContextVar[dict[int, ProcessPoolExecutor] | None] = ContextVar("kept", default=None)


def width_of(executor: Executor) -> int:
    """How many tasks an executor does at once, as far as it says it."""
    client: Client | None = getattr(
        executor, "_client", None
    )  # of a dask executor, whose workers come and go
    if client is not None:
        return sum(client.ncores().values()) or _USUAL_WIDTH
    told: int | None = getattr(executor, "num_workers", None) or getattr(
        executor, "_max_workers", None
    )
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
def cluster_executor(
    address: str | None = None, scheduler_file: Path | None = None
) -> Iterator[Executor | None]:
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
    except (
        ImportError,
        OSError,
        RuntimeError,
    ) as error:  # the last: there is no MPI on this machine
        raise MissingExtraError(
            f"mpi4py cannot be imported ({error}); install an MPI, and: pip install mpi4py"
        ) from error
    if (
        mpi.COMM_WORLD.size < 2 or mpi.COMM_WORLD.rank
    ):  # a rank but the first runs this: all would do the same
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
        raise MissingExtraError(
            "dask is not installed; in a checkout: pip install '.[distributed]'"
        ) from error
    place = str(scheduler_file or address)
    try:
        if scheduler_file is not None:
            address = _address_in(scheduler_file)
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


def _address_in(file: Path) -> str:
    """The address that a dask scheduler wrote into a file; waits for one that has just begun.

    Raises OSError or ValueError. Dask itself would wait for it for ever, and read anything.
    """
    from deepaccident_devkit.support.json_text import (
        as_record,
        parsed_json,
    )  # here, as it takes some milliseconds

    end, content = time.monotonic() + ADDRESS_WAIT, b""
    while not content:
        with suppress(FileNotFoundError):
            content = read_bytes(file, "spec")
        if not content and time.monotonic() > end:
            raise FileNotFoundError(errno.ENOENT, "there is no such file, or it is empty")
        time.sleep(0 if content else 0.1)
    return as_record(parsed_json(content)["address"], str)


@contextmanager
def workers_kept() -> Iterator[None]:
    """Keep own workers that begin in the block for what comes after in it: to begin takes each most of a second.

    They end with the outermost such block.
    """
    pools: dict[int, ProcessPoolExecutor] = {}
    token = _kept.set(pools) if _kept.get() is None else None
    try:
        yield
    finally:
        if token is not None:
            _kept.reset(token)
        for pool in pools.values():
            pool.shutdown()


@contextmanager
def starting_workers() -> Iterator[None]:
    """Raise WorkerError if the system has no room for processes, or for their locks in shared memory."""
    try:
        yield
    except OSError as error:
        raise WorkerError(
            f"worker processes cannot be started ({error}); {FEWER_WORKERS}"
        ) from error


@contextmanager
def own_workers(count: int) -> Iterator[Executor]:
    """A pool of spawned processes: an error of an item lets the others end what they do; all else ends them at once.

    The pool itself cancels what has not begun: if others did and a process was killed, a thread of it would fail. If
    one is killed while another begins, the pool would wait for that one for ever.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    kept = _kept.get()
    pool = kept.pop(count, None) if kept else None
    if pool is None:
        with starting_workers():
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin_worker)
    try:
        yield pool
    except BaseException as error:
        of_an_item = isinstance(error, Exception) and not isinstance(error, WorkerError)
        if not of_an_item:  # a killed worker, Ctrl-C, or the generator was closed
            for process in list((pool._processes or {}).values()):  # noqa: SLF001 - public from Python 3.14
                process.kill()
        pool.shutdown(wait=of_an_item, cancel_futures=of_an_item)
        raise
    if kept is None or kept.setdefault(count, pool) is not pool:
        pool.shutdown()


def own_threads() -> ThreadPoolExecutor:
    """Threads of this process, one for each usable core, in a `with` block: for work whose libraries let others run."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(usable_cores())


def _begin_worker() -> None:
    """Leave Ctrl-C, which a terminal sends to workers too, to the parent, and end when that ends."""
    from tqdm import tqdm

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tqdm.set_lock(
        threading.RLock()
    )  # its own is one for all processes, and stays in the system if this one is killed
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()


def _end_with_parent() -> None:
    """Without this a worker whose parent was killed would wait for ever."""
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def signals_put_off() -> Iterator[None]:
    """Handle Ctrl-C and SIGTERM after the block, in which processes begin, and let those begin with Ctrl-C blocked.

    An exception amid the start of a process would leave one that nobody knows; and a process that is not ready to
    ignore Ctrl-C would print a traceback.
    """
    if threading.current_thread() is not threading.main_thread():  # others get no signals
        yield
        return
    came: list[int] = []
    handlers = {
        number: signal.signal(number, lambda each, _frame: came.append(each))
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number)
        is not None  # one of a program that embeds Python cannot be put back
    }
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for each in came:
            handler = handlers[signal.Signals(each)]
            handler(each, None) if callable(handler) else signal.raise_signal(each)


@contextmanager
def main_module_hidden() -> Iterator[None]:
    """Keep new processes from importing the user's script again.

    A spawned process runs the parent's main script unless that has no file. Our work is always importable from the
    package, and a user's three-line script has no `if __name__ == "__main__"` guard.
    """
    main = sys.modules["__main__"]
    hidden = {name: getattr(main, name) for name in ("__file__", "__spec__") if hasattr(main, name)}
    try:
        for name in hidden:
            setattr(main, name, None)
        if "__file__" in hidden:
            del main.__file__
        yield
    finally:
        for name, value in hidden.items():
            setattr(main, name, value)
