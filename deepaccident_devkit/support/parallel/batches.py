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
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypedDict, TypeVar

from deepaccident_devkit.errors import ChoiceError, WorkerError
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import temporary_path
from deepaccident_devkit.support.parallel.executors import (
    fault_of_workers,
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
# Whether to show a progress bar; or a function that gets each item's share of the work, for a bar
# of the caller's own.
Progress: TypeAlias = "bool | Callable[[float], object]"
# Seconds in which a signal that ended a worker ends this process too, if it was sent to all
# processes of a job.
_SIGNAL_DELAY_S: Final = 0.1
# Items under way for each one that the workers do at once; and the same counted from the oldest
# unfinished item, since results that are needed in order wait for it in memory.
_ITEMS_PER_WORKER, _MAX_ITEMS_AHEAD = 4, 32
# Time after which the number of workers of an executor is read again, since workers join and leave.
_WIDTH_SECONDS: Final = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Files and folders that all workers must see.

    Attributes:
        reads: Files and folders that they read.
        writes: Folders that they write into; made if necessary.
    """

    reads: tuple[Path, ...] = ()
    writes: tuple[Path, ...] = ()


class Engine(TypedDict, total=False):
    """How bulk work runs: arguments of every function that works on many scenarios or samples.

    All of these functions raise ChoiceError if `workers` is less than 1, and WorkerError if a
    worker was killed or cannot do the work.

    Attributes:
        workers: Number of processes; 1 for this one only, None for as many as the work is worth.
        executor: Any executor of `concurrent.futures` to run on, instead of own workers.
        progress: Whether to show a bar; or a function, see `run_unordered`.
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
        workers: Processes to use; 1 runs in this one; None takes as many as this process may use
            cores, or only this process if the work is too little for a pool or the caller is a
            worker itself.
        executor: Any `concurrent.futures.Executor` to run on instead (a dask client's, MPI's, a
            thread pool).
        label: Text of the progress bar.
        progress: Whether to show one; or a function, see `run_unordered`.
        places: Files and folders that the workers of an executor must see; checked before their
            first item.

    Raises:
        ChoiceError: `workers` is less than 1.
        WorkerError: A worker was killed; or a worker of an executor does not see the places, or has
            no devkit or another version of it.
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
) -> Generator[tuple[int, _Result], None, None]:
    """Apply `work` to every item; yield each one's position and result as soon as it is ready.

    Closing the generator cancels items that have not begun, and ends its own workers, as an
    interruption does. Arguments and errors are the same as of `run_batch`; `progress` may be a
    function that gets each item's share of the work, and `sizes` is how far each item moves the
    progress bar; None for one step each.
    """
    # Imported here: with asyncio and multiprocessing, it takes a third of the package's import
    # time.
    from tqdm.auto import tqdm

    count, steps = _worker_count(workers, len(items)), sizes or [1] * len(items)
    with (
        tqdm(total=sum(steps), desc=label, disable=progress is not True, unit="") as bar,
        ExitStack() as stack,
    ):
        if executor is not None:
            paths = stack.enter_context(visible_paths(places or Places()))
            results = _run_on(executor, [Call(work, item, paths) for item in items], cancel=True)
        elif count > 1:
            pool = stack.enter_context(own_workers(count))
            results = _run_on(pool, [Call(work, item, ()) for item in items], cancel=False)
        else:
            results = ((position, work(item)) for position, item in enumerate(items))
        for position, result in stack.enter_context(closing(results)):
            bar.update(steps[position])
            if callable(progress):
                progress(steps[position] / sum(steps))
            yield position, result


def in_order(results: Generator[tuple[int, _Result], None, None]) -> Generator[_Result, None, None]:
    """Yield the results of `run_unordered` in order, each as soon as all before it are ready."""
    waiting: dict[int, _Result] = {}
    next_position = 0
    with closing(results):
        for position, result in results:
            waiting[position] = result
            while next_position in waiting:
                yield waiting.pop(next_position)
                next_position += 1


def _worker_count(workers: int | None, items: int) -> int:
    import multiprocessing

    if workers is not None and workers < 1:
        raise ChoiceError(f"workers: expected a number of at least 1, or None, found {workers}")
    if multiprocessing.current_process().daemon:  # a DataLoader worker may not have children
        return 1
    if workers is not None:
        return min(workers, max(items, 1))
    items_per_worker = 8  # starting a pool costs a second, a scenario a tenth of one
    return max(1, min(usable_cores(), items // items_per_worker))


def _run_on(
    executor: Executor, calls: Sequence[Call[_Item, _Result]], *, cancel: bool
) -> Generator[tuple[int, _Result], None, None]:
    """Yield positions and results of calls; as many are under way as keep the workers busy."""
    from queue import SimpleQueue

    done: SimpleQueue[Future[_Result]] = SimpleQueue()
    running: dict[Future[_Result], int] = {}
    next_position, width, width_time = 0, 1, float("-inf")
    try:
        while running or next_position < len(calls):
            if time.monotonic() - width_time >= _WIDTH_SECONDS:
                width, width_time = width_of(executor), time.monotonic()
            oldest = next(iter(running.values()), next_position)
            end = min(
                len(calls),
                next_position + _ITEMS_PER_WORKER * width - len(running),
                oldest + _MAX_ITEMS_AHEAD * width,
            )
            if next_position < end:
                with main_module_hidden(), signals_deferred():
                    for position in range(next_position, end):
                        future = executor.submit(calls[position])
                        running[future] = position
                        future.add_done_callback(done.put)
                next_position = end
            future = done.get()
            yield running.pop(future), future.result()
    except Exception as error:
        fault = fault_of_workers(error)
        if fault is None:
            raise
        time.sleep(_SIGNAL_DELAY_S)
        raise WorkerError(fault) from error
    finally:
        for future in running if cancel else ():
            future.cancel()


@dataclass(frozen=True, slots=True)
class Call(Generic[_Item, _Result]):
    """The work on one item, called without arguments; raises WorkerError where it cannot be done.

    Attributes:
        work: Function that workers can import.
        item: Its argument.
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

        So a scheduler on the way needs no devkit, and a worker without one, or that cannot open the
        dataset of the item, reports it as the task's error; dask's workers end if a message cannot
        be unpickled.
        """
        # Imported here, as it takes ten milliseconds.
        from multiprocessing.reduction import ForkingPickler

        content = bytes(ForkingPickler.dumps((self.work, self.item)))
        result = _ResultWhenRead(content, self.paths)
        return partial, (ForkingPickler.loads, bytes(ForkingPickler.dumps(result)))


@dataclass(frozen=True, slots=True)
class _ResultWhenRead:
    """An object that pickle reads as the result of the work and item in `content`."""

    content: bytes
    paths: tuple[str, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return _check_and_run, (__version__, self.paths, self.content)


def _check_and_run(version: str, paths: tuple[str, ...], content: bytes) -> Any:
    from multiprocessing.reduction import ForkingPickler

    _check_worker(version, paths)
    work, item = ForkingPickler.loads(content)
    return work(item)


@contextmanager
def visible_paths(places: Places) -> Iterator[tuple[str, ...]]:
    """Yield the paths that workers must see.

    In folders that they write into, there is a file with a new name during the block: a folder of
    the same name on a worker's own disk has no such file.
    """
    with ExitStack() as stack:
        marks = []
        for folder in places.writes:
            folder.mkdir(parents=True, exist_ok=True)
            mark = temporary_path(folder / "seen")
            mark.touch()
            stack.callback(mark.unlink, missing_ok=True)
            marks.append(mark)
        yield tuple(map(str, (*places.reads, *marks)))


@lru_cache(maxsize=64)
def _check_worker(version: str, paths: tuple[str, ...]) -> None:
    """Raise WorkerError unless this process has the caller's devkit and sees these paths.

    This is checked once a process.
    """
    worker = f"a worker on {platform.node()}"
    if version != __version__:
        raise WorkerError(
            f"{worker} has deepaccident_devkit {__version__}, and this is {version}; install the "
            "same version on all"
        )
    for path in map(Path, paths):
        if not path.exists():
            missing = path.parent if path.suffix == ".tmp" else path
            raise WorkerError(
                f"{worker} does not see {missing}; give an absolute path on a file system that all "
                "workers share"
            )
