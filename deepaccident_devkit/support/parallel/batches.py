"""Batches of independent work: on one process, on a pool of them, or on the caller's own executor.

Results come back as they are ready. No more items are under way than the workers need to stay busy,
so that the memory of the caller does not grow with the work.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypedDict, TypeVar

from deepaccident_devkit.errors import ChoiceError, WorkerError
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import temporary_path
from deepaccident_devkit.support.parallel.executors import (
    describe_worker_fault,
    main_module_hidden,
    own_workers,
    signals_deferred,
    width_of,
)
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
# Position of an item, and its result, as soon as it is ready.
_Results: TypeAlias = Generator[tuple[int, _Result], None, None]
# Whether to show a progress bar, or a function that is called with each item's share of the work,
# for a progress bar of the caller's own.
Progress: TypeAlias = "bool | Callable[[float], object]"
# Seconds in which a signal that ended a worker ends this process too, if it was sent to all
# processes of a job.
_SIGNAL_DELAY_S = 0.1
# Number of items that are submitted for each item that the workers can process at once.
_ITEMS_PER_WORKER = 4
# Largest number of items from the oldest unfinished to the newest submitted one, for each item that
# the workers can process at once. Results that are needed in order wait in memory for the oldest.
_MAX_ITEMS_AHEAD = 32
# Seconds after which an executor's number of workers is read again, since workers join and leave.
_WIDTH_SECONDS = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Files and folders that all workers must be able to access.

    Attributes:
        reads: Files and folders that the workers read.
        writes: Folders that the workers write into. They are created if they do not exist.
    """

    reads: tuple[Path, ...] = ()
    writes: tuple[Path, ...] = ()


class Engine(TypedDict, total=False):
    """How bulk work runs: arguments of every function that works on many scenarios or samples.

    All these functions raise ChoiceError if `workers` is less than 1, and WorkerError if a worker
    was killed or cannot do the work.

    Attributes:
        workers: Number of processes; 1 for this process only, None for as many as speed up the
            work.
        executor: Any `concurrent.futures.Executor` to use instead of own workers.
        progress: Whether to show a progress bar, or a function, as described in `run_unordered`.
    """

    workers: int | None
    executor: Executor | None
    progress: Progress


def run_batch(
    work: Callable[[_Item], _Result],
    items: Sequence[_Item],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    label: str = "",
    progress: Progress = False,
    places: Places | None = None,
) -> list[_Result]:
    """Apply `work` to every item and return the results in the items' order.

    Args:
        work: Importable function of the devkit (workers import it by name).
        items: Arguments of the function, one call for each.
        workers: Number of worker processes. With 1, this process does the work. With None, there is
            one worker for each core that this process can use, unless the work is too little for a
            pool or the caller is a worker itself: then this process does the work.
        executor: Any `concurrent.futures.Executor` to use instead of own workers (a dask client's,
            MPI's, a thread pool).
        label: Text of the progress bar.
        progress: Whether to show a progress bar, or a function, as described in `run_unordered`.
        places: Files and folders that the workers of an executor must be able to access. Each
            worker checks them before its first item.

    Raises:
        ChoiceError: If `workers` is less than 1.
        WorkerError: If a worker was killed, or if a worker of an executor cannot access the places
            or does not have this version of the devkit.
    """
    results = dict(
        run_unordered(
            work,
            items,
            workers=workers,
            executor=executor,
            label=label,
            progress=progress,
            places=places,
        )
    )
    return [results[position] for position in range(len(items))]


def run_unordered(
    work: Callable[[_Item], _Result],
    items: Sequence[_Item],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    label: str = "",
    progress: Progress = False,
    sizes: Sequence[int] | None = None,
    places: Places | None = None,
) -> _Results[_Result]:
    """Apply `work` to every item; yield each one's position and result as soon as it is ready.

    Closing the generator cancels items that have not begun, and ends its own workers, as an
    interruption does. Arguments and errors are as in `run_batch`. In addition, `progress` may be
    a function that gets each item's share of the work, and `sizes` are the steps by which each item
    moves the progress bar; None for one step each.
    """
    # Imported here: with asyncio and multiprocessing, it takes a third of the package's import
    # time.
    from tqdm.auto import tqdm

    count = _choose_worker_count(workers, len(items))
    steps = sizes or [1] * len(items)
    with (
        tqdm(total=sum(steps), desc=label, disable=progress is not True, unit="") as bar,
        ExitStack() as stack,
    ):
        if executor is not None:
            paths = stack.enter_context(visible_paths(places or Places()))
            results = _run_calls(executor, [Call(work, item, paths) for item in items], cancel=True)
        elif count > 1:
            pool = stack.enter_context(own_workers(count))
            results = _run_calls(pool, [Call(work, item, ()) for item in items], cancel=False)
        else:
            results = ((position, work(item)) for position, item in enumerate(items))
        for position, result in stack.enter_context(closing(results)):
            bar.update(steps[position])
            if callable(progress):
                progress(steps[position] / sum(steps))
            yield position, result


def in_order(results: _Results[_Result]) -> Generator[_Result, None, None]:
    """Yield the results of `run_unordered` in order, each as soon as all before it are ready."""
    waiting = {}
    next_position = 0
    with closing(results):
        for position, result in results:
            waiting[position] = result
            while next_position in waiting:
                yield waiting.pop(next_position)
                next_position += 1


def _choose_worker_count(workers: int | None, items: int) -> int:
    import multiprocessing

    if workers is not None and workers < 1:
        raise ChoiceError(f"workers: expected a number of at least 1, or None, found {workers}")
    if multiprocessing.current_process().daemon:  # a DataLoader worker may not have children
        return 1
    if workers is not None:
        return min(workers, max(items, 1))
    items_per_worker = 8  # starting a pool costs a second, a scenario a tenth of one
    return max(1, min(usable_cores(), items // items_per_worker))


def _run_calls(
    executor: Executor, calls: Sequence[Call[_Item, _Result]], *, cancel: bool
) -> _Results[_Result]:
    """Yield positions and results of calls; as many are under way as keep the workers busy."""
    from queue import SimpleQueue

    finished: SimpleQueue[Future[_Result]] = SimpleQueue()
    running: dict[Future[_Result], int] = {}
    next_position = 0
    width = 1
    width_time = float("-inf")
    try:
        while running or next_position < len(calls):
            if time.monotonic() - width_time >= _WIDTH_SECONDS:
                width = width_of(executor)
                width_time = time.monotonic()
            oldest = next(iter(running.values()), next_position)
            stop = min(
                len(calls),
                next_position + _ITEMS_PER_WORKER * width - len(running),
                oldest + _MAX_ITEMS_AHEAD * width,
            )
            if next_position < stop:
                with main_module_hidden(), signals_deferred():
                    for position in range(next_position, stop):
                        future = executor.submit(calls[position])
                        running[future] = position
                        future.add_done_callback(finished.put)
                next_position = stop
            future = finished.get()
            yield running.pop(future), future.result()
    except Exception as error:
        fault = describe_worker_fault(error)
        if fault is None:
            raise
        time.sleep(_SIGNAL_DELAY_S)
        raise WorkerError(fault) from error
    finally:
        if cancel:
            for future in running:
                future.cancel()


@dataclass(frozen=True, slots=True)
class Call(Generic[_Item, _Result]):
    """The work on one item, called without arguments; raises WorkerError where it cannot be done.

    Attributes:
        work: Function that workers can import.
        item: Argument of the function.
        paths: Paths that must exist.
    """

    work: Callable[[_Item], _Result]
    item: _Item
    paths: tuple[str, ...]

    def __call__(self) -> _Result:
        """Do the work."""
        _check_worker(__version__, self.paths)
        return self.work(self.item)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the call so that work and item are only unpickled when it is called.

        A scheduler on the way then needs no devkit. A worker that has none, or that cannot open the
        item's dataset, reports this as the task's error; dask's workers would end if a message
        could not be unpickled.
        """
        # Imported here, as it takes ten milliseconds.
        from multiprocessing.reduction import ForkingPickler

        content = bytes(ForkingPickler.dumps((self.work, self.item)))
        result = _ResultWhenRead(content, self.paths)
        pickled_result = bytes(ForkingPickler.dumps(result))
        return partial, (ForkingPickler.loads, pickled_result)


@dataclass(frozen=True, slots=True)
class _ResultWhenRead:
    """An object that pickle reads as the result of the work and item in `content`."""

    content: bytes
    paths: tuple[str, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return _check_and_run, (__version__, self.paths, self.content)


def _check_and_run(version: str, paths: tuple[str, ...], content: bytes) -> Any:
    """Check this process and apply the pickled work to the pickled item."""
    from multiprocessing.reduction import ForkingPickler

    _check_worker(version, paths)
    work, item = ForkingPickler.loads(content)
    return work(item)


@contextmanager
def visible_paths(places: Places) -> Iterator[tuple[str, ...]]:
    """Yield the paths that workers must see.

    During the block, the folders that they write into have a file with a new name, which a folder
    of the same name on a worker's own disk lacks.
    """
    with ExitStack() as stack:
        mark_files = []
        for folder in places.writes:
            folder.mkdir(parents=True, exist_ok=True)
            mark_file = temporary_path(folder / "seen")
            mark_file.touch()
            stack.callback(mark_file.unlink, missing_ok=True)
            mark_files.append(mark_file)
        yield tuple(map(str, (*places.reads, *mark_files)))


@lru_cache(maxsize=64)
def _check_worker(version: str, paths: tuple[str, ...]) -> None:
    """Raise WorkerError unless this process has the caller's devkit and sees these paths.

    This is checked once a process.
    """
    worker = f"a worker on {platform.node()}"
    if version != __version__:
        raise WorkerError(
            f"{worker} has deepaccident_devkit {__version__}, but this machine has {version}; "
            "install the same version on all machines"
        )
    for path in map(Path, paths):
        if not path.exists():
            missing = path.parent if path.suffix == ".tmp" else path
            raise WorkerError(
                f"{worker} does not see {missing}; give an absolute path on a file system that all "
                "workers share"
            )
