"""Executors: of other libraries, of a dask cluster, and a pool of processes of this machine.

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
    MAX_REASON_LENGTH,
    DeepAccidentError,
    MissingExtraError,
    WorkerError,
    shortened,
)
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.reading import read_bytes, reason_text
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor

    from distributed import Client

logger = logging.getLogger(__name__)

# Number of simultaneous tasks of an executor that does not have it as an attribute.
_DEFAULT_WIDTH = 64
MPI: Final = "mpi"
# Seconds in which an empty file of a scheduler may still get its address.
ADDRESS_WAIT: Final = 10.0
FEWER_WORKERS: Final = (
    "if memory or shared memory (/dev/shm) ran out, use fewer workers, or none (for training: "
    "without --workers)"
)
_PACKAGE = __name__.partition(".")[0]
# Within `keep_workers`: number of processes → a pool of them that waits for work.
_idle_pools: ContextVar[dict[int, ProcessPoolExecutor] | None] = ContextVar("kept", default=None)


def width_of(executor: Executor) -> int:
    """Return how many tasks an executor does at once, as far as it is known."""
    # A dask executor has a client; its workers come and go.
    client: Client | None = getattr(executor, "_client", None)
    if client is not None:
        return sum(client.ncores().values()) or _DEFAULT_WIDTH
    for name in ("num_workers", "_max_workers"):  # MPI's name, and Python's
        width: int | None = getattr(executor, name, None)
        if width:
            return width
    return _DEFAULT_WIDTH


def describe_worker_fault(error: Exception) -> str | None:
    """Describe the fault of workers that an error reveals; None if the work itself has failed."""
    distributed = sys.modules.get("distributed")
    if distributed is not None and isinstance(error, distributed.KilledWorker):
        return (
            f"the dask worker of a task was killed several times ({error}), perhaps because memory "
            "ran out"
        )
    if isinstance(error, BrokenExecutor):
        return (
            f"a worker process was killed ({error}), perhaps because memory ran out; try again "
            "with fewer workers"
        )
    if isinstance(error, CancelledError):
        return (
            "the scheduler has ended, or cancelled a task; start the scheduler again, then run "
            "the same command: it does the rest"
        )
    is_import_fault = isinstance(error, ImportError) or str(error).startswith("Can't get attribute")
    if is_import_fault and _PACKAGE in str(error) and not isinstance(error, DeepAccidentError):
        return f"a worker cannot do the work ({error}); install {_PACKAGE} {__version__} there"
    return None


@contextmanager
def cluster_executor(
    address: str | None = None, scheduler_file: Path | None = None
) -> Iterator[Executor | None]:
    """Yield an executor on the workers of a cluster; None without a scheduler.

    All data to and from a scheduler is pickled: use only one that you trust.

    Args:
        address: Address of a dask scheduler, such as `tcp://10.0.0.5:8786`; or `mpi` for the other
            ranks of this MPI program, which was started by `mpiexec … python -m mpi4py.futures`.
        scheduler_file: File that a dask scheduler writes its address into, instead of `address`.

    Raises:
        MissingExtraError: If `distributed` or mpi4py is not installed.
        WorkerError: If no scheduler answers, or this is not an MPI program of several ranks.
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
    except (ImportError, OSError, RuntimeError) as error:  # RuntimeError: this machine has no MPI
        raise MissingExtraError(
            f"mpi4py cannot be imported ({error}); install an MPI library, then: pip install mpi4py"
        ) from error
    # If a rank other than the first ran this, all ranks would do the same work.
    if mpi.COMM_WORLD.size < 2 or mpi.COMM_WORLD.rank:
        raise WorkerError(
            "no other MPI ranks wait for work; start the command with: mpiexec -n 8 python -m "
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
            "dask is not installed; run pip install '.[distributed]' in a checkout"
        ) from error
    source = str(scheduler_file or address)
    try:
        if scheduler_file is not None:
            address = _read_address(scheduler_file)
        client = _connect_client(Client, address=address, set_as_default=False)
    except Exception as error:  # for an odd address, dask raises many kinds
        fault = shortened(reason_text(error), MAX_REASON_LENGTH)
        raise WorkerError(
            f"{source}: no dask scheduler answers ({fault}); start one with `dask scheduler`, and "
            "give its address"
        ) from error
    with client:
        if not client.ncores():
            logger.warning("%s: has no workers yet; waiting for them", source)
        yield client


def _connect_client(kind: Any, **options: Any) -> Client:
    """Return a connected dask client.

    A client that cannot connect is closed at once: its garbage collection may hang the next one.
    """
    client: Any = kind.__new__(kind)
    try:
        client.__init__(**options)
    except BaseException:
        with suppress(Exception):
            client.close(timeout=1)
        raise
    return client


def _read_address(file: Path) -> str:
    """Read the address that a dask scheduler writes into a file when it begins.

    Dask itself would wait for the file for ever, and read anything. Raises OSError or ValueError.
    """
    # Imported here, as it takes some milliseconds.
    from deepaccident_devkit.support.json_text import as_record, parsed_json

    deadline = time.monotonic() + ADDRESS_WAIT
    content = b""
    while not content:
        with suppress(FileNotFoundError):
            content = read_bytes(file, "spec")
        if not content and time.monotonic() > deadline:
            raise FileNotFoundError(errno.ENOENT, "there is no such file, or it is empty")
        time.sleep(0 if content else 0.1)
    return as_record(parsed_json(content)["address"], str)


@contextmanager
def keep_workers() -> Iterator[None]:
    """Keep own workers that begin in the block for later work in the same block.

    Starting a worker takes most of a second. They end with the outermost such block.
    """
    pools: dict[int, ProcessPoolExecutor] = {}
    token = _idle_pools.set(pools) if _idle_pools.get() is None else None
    try:
        yield
    finally:
        if token is not None:
            _idle_pools.reset(token)
        for pool in pools.values():
            pool.shutdown()


@contextmanager
def starting_workers() -> Iterator[None]:
    """Raise WorkerError if the system has no room for processes or their locks in shared memory."""
    try:
        yield
    except OSError as error:
        raise WorkerError(
            f"worker processes cannot be started ({error}); {FEWER_WORKERS}"
        ) from error


@contextmanager
def own_workers(count: int) -> Iterator[Executor]:
    """Yield a pool of spawned processes.

    After an error in an item, the other workers finish their items; anything else ends them at
    once. The pool itself cancels items that have not begun: if other code cancelled them and a
    process was killed, a thread of the pool would fail. If a process is killed while another one
    begins, the pool would wait for that one for ever.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    idle_pools = _idle_pools.get()
    pool = idle_pools.pop(count, None) if idle_pools else None
    if pool is None:
        with starting_workers():
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin_worker)
    try:
        yield pool
    except BaseException as error:
        is_item_error = isinstance(error, Exception) and not isinstance(error, WorkerError)
        if not is_item_error:  # a killed worker, Ctrl-C, or the generator was closed
            # Python 3.14 has a public method for this.
            for process in list((pool._processes or {}).values()):  # noqa: SLF001
                process.kill()
        pool.shutdown(wait=is_item_error, cancel_futures=is_item_error)
        raise
    if idle_pools is None or idle_pools.setdefault(count, pool) is not pool:
        pool.shutdown()


def own_threads() -> ThreadPoolExecutor:
    """Return a pool of threads for a `with` block, one thread for each usable core.

    It suits work in libraries that let other threads run.
    """
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(usable_cores())


def _begin_worker() -> None:
    """Prepare a worker: it ignores Ctrl-C, which its parent handles, and ends with its parent."""
    from tqdm import tqdm

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # tqdm's own lock is shared by all processes, and stays in the system if this one is killed.
    tqdm.set_lock(threading.RLock())
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()


def _end_with_parent() -> None:
    """End this worker with its parent; otherwise it would wait forever if the parent was killed."""
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Handle Ctrl-C and SIGTERM after the block, in which processes begin with Ctrl-C blocked.

    An exception amid the start of a process would leave a process that nobody knows; and a process
    that is not ready to ignore Ctrl-C would print a traceback.
    """
    if threading.current_thread() is not threading.main_thread():  # other threads get no signals
        yield
        return
    received: list[int] = []
    handlers = {
        number: signal.signal(number, lambda received_number, _: received.append(received_number))
        for number in (signal.SIGINT, signal.SIGTERM)
        # The handler of a program that embeds Python is None, and cannot be restored.
        if signal.getsignal(number) is not None
    }
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for received_number in received:
            handler = handlers[signal.Signals(received_number)]
            if callable(handler):
                handler(received_number, None)
            else:
                signal.raise_signal(received_number)


@contextmanager
def main_module_hidden() -> Iterator[None]:
    """Keep new processes from importing the user's script again.

    A spawned process runs the parent's main script again if the script has a file. This is not
    needed, since our work can always be imported from the package, and it does harm if the user's
    script has no `if __name__ == "__main__"` guard.
    """
    main = sys.modules["__main__"]
    names = [name for name in ("__file__", "__spec__") if hasattr(main, name)]
    attributes = {name: getattr(main, name) for name in names}
    try:
        for name in attributes:
            setattr(main, name, None)
        if "__file__" in attributes:
            del main.__file__
        yield
    finally:
        for name, value in attributes.items():
            setattr(main, name, value)
