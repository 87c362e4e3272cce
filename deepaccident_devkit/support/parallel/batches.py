"""Running batches of independent work: on one process, on a pool of them, or on the caller's own executor.

Results come back as they are ready. No more items are under way than the workers need to stay busy, so that the memory
of the caller does not grow with the work.
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
    signals_put_off,
    width_of,
)
from deepaccident_devkit.support.version import __version__

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
# Whether to show a progress bar; or a function that gets each item's share of the work, for a bar of the caller's.
Progress: TypeAlias = "bool | Callable[[float], object]"
# Seconds in which a signal that ended a worker ends this process too, if it was sent to all processes of a job.
_SAME_SIGNAL: Final = 0.1
# Items under way for each one that the workers do at once; and counted from the oldest item that is not done, since
# what is needed in order waits for it in memory.
_AHEAD, _FAR_AHEAD = 4, 32
# Time after which an executor is asked again: workers join and leave.
_WIDTH_SECONDS: Final = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Files and folders that all workers must see.

    Attributes:
        reads: what they read.
        writes: folders that they write into; made where needed.
    """

    reads: tuple[Path, ...] = ()
    writes: tuple[Path, ...] = ()


class Engine(TypedDict, total=False):
    """How bulk work runs: every function that works on many scenarios or samples takes these, and raises these errors.

    ChoiceError: `workers` is less than 1. WorkerError: a worker was killed, or cannot do the work.

    Attributes:
        workers: processes; 1 for this one alone, None for as many as the work is worth.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar; or a function, as of `run_unordered`.
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
        work: an importable function of the devkit (workers import it by name).
        items: what it is applied to, one call an item.
        workers: processes to use; 1 runs in this one; None takes as many as this process may use cores, or this
            process alone if the work is too little for a pool or the caller is a worker itself.
        executor: any `concurrent.futures.Executor` to run on instead (a dask client's, MPI's, a thread pool).
        label: text of the progress bar.
        progress: whether to show one; or a function, as of `run_unordered`.
        places: what the workers of an executor must see; checked before their first item.

    Raises:
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed; or one of an executor does not see the places, or has no devkit or another
            version of it.
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
    """Apply `work` to every item; yields each one's position and result as soon as it is ready.

    Closing the generator cancels what has not begun, and ends its own workers, as an interruption does. Arguments and
    errors are those of `run_batch`; `progress` may be a function that gets each item's share of the work, and `sizes`
    is how far each item moves the progress bar; None for one step each.
    """
    from tqdm.auto import (
        tqdm,
    )  # here: with asyncio and multiprocessing, a third of the package's import time

    count, steps = _worker_count(workers, len(items)), sizes or [1] * len(items)
    with (
        tqdm(total=sum(steps), desc=label, disable=progress is not True, unit="") as bar,
        ExitStack() as stack,
    ):
        if executor is not None:
            seen = stack.enter_context(marked(places or Places()))
            results = _on(executor, [Call(work, item, seen) for item in items], cancel=True)
        elif count > 1:
            pool = stack.enter_context(own_workers(count))
            results = _on(pool, [Call(work, item, ()) for item in items], cancel=False)
        else:
            results = ((position, work(item)) for position, item in enumerate(items))
        for position, result in stack.enter_context(closing(results)):
            bar.update(steps[position])
            if callable(progress):
                progress(steps[position] / sum(steps))
            yield position, result


def in_order(results: Generator[tuple[int, _Result], None, None]) -> Generator[_Result, None, None]:
    """The results of `run_unordered` in the order of their positions, each as soon as all before it are ready."""
    waiting: dict[int, _Result] = {}
    upcoming = 0
    with closing(results):
        for position, result in results:
            waiting[position] = result
            while upcoming in waiting:
                yield waiting.pop(upcoming)
                upcoming += 1


def _worker_count(workers: int | None, items: int) -> int:
    import multiprocessing

    if workers is not None and workers < 1:
        raise ChoiceError(f"workers: expected a number of at least 1, or None, found {workers}")
    if multiprocessing.current_process().daemon:  # a DataLoader worker may not have children
        return 1
    if workers is not None:
        return min(workers, max(items, 1))
    enough_work = 8  # starting a pool costs a second, a scenario a tenth of one
    return max(1, min(usable_cores(), items // enough_work))


def _on(
    executor: Executor, calls: Sequence[Call[_Item, _Result]], *, cancel: bool
) -> Generator[tuple[int, _Result], None, None]:
    """Positions and results of calls, as many of which are under way as keep the workers busy."""
    from queue import SimpleQueue

    done: SimpleQueue[Future[_Result]] = SimpleQueue()
    running: dict[Future[_Result], int] = {}
    upcoming, width, asked = 0, 1, float("-inf")
    try:
        while running or upcoming < len(calls):
            if time.monotonic() - asked >= _WIDTH_SECONDS:
                width, asked = width_of(executor), time.monotonic()
            oldest = next(iter(running.values()), upcoming)
            last = min(
                len(calls), upcoming + _AHEAD * width - len(running), oldest + _FAR_AHEAD * width
            )
            if upcoming < last:
                with main_module_hidden(), signals_put_off():
                    for position in range(upcoming, last):
                        future = executor.submit(calls[position])
                        running[future] = position
                        future.add_done_callback(done.put)
                upcoming = last
            future = done.get()
            yield running.pop(future), future.result()
    except Exception as error:
        fault = fault_of_workers(error)
        if fault is None:
            raise
        time.sleep(_SAME_SIGNAL)
        raise WorkerError(fault) from error
    finally:
        for future in running if cancel else ():
            future.cancel()


@dataclass(frozen=True, slots=True)
class Call(Generic[_Item, _Result]):
    """The work on one item, called without arguments; raises WorkerError where it cannot be done.

    Attributes:
        work: a function that workers can import.
        item: what it is applied to.
        seen: paths that must be there.
    """

    work: Callable[[_Item], _Result]
    item: _Item
    seen: tuple[str, ...]

    def __call__(self) -> _Result:
        """Do the work."""
        _check_worker(__version__, self.seen)
        return self.work(self.item)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it so that work and item are read when it is called, and nothing of the devkit is needed before.

        So a scheduler on the way needs no devkit, and a worker without one, or that cannot open the dataset of the
        item, says so as the task's error; dask's workers end if a message cannot be unpickled.
        """
        from multiprocessing.reduction import (
            ForkingPickler,
        )  # here, as it takes ten milliseconds to import

        done_when_read = _DoneWhenRead(
            bytes(ForkingPickler.dumps((self.work, self.item))), self.seen
        )
        return partial, (ForkingPickler.loads, bytes(ForkingPickler.dumps(done_when_read)))


@dataclass(frozen=True, slots=True)
class _DoneWhenRead:
    """What becomes the result when it is read of the work whose pickle is `content`."""

    content: bytes
    seen: tuple[str, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return _checked_and_done, (__version__, self.seen, self.content)


def _checked_and_done(version: str, seen: tuple[str, ...], content: bytes) -> Any:
    from multiprocessing.reduction import ForkingPickler

    _check_worker(version, seen)
    work, item = ForkingPickler.loads(content)
    return work(item)


@contextmanager
def marked(places: Places) -> Iterator[tuple[str, ...]]:
    """The paths that workers must see. In folders that they write into a file is there meanwhile, of a new name.

    A folder of the same name on a worker's own disk has no such file.
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
def _check_worker(version: str, seen: tuple[str, ...]) -> None:
    """Raise WorkerError unless this process has the caller's devkit and sees these paths; asked once a process."""
    here = f"a worker on {platform.node()}"
    if version != __version__:
        raise WorkerError(
            f"{here} has deepaccident_devkit {__version__}, and this is {version}; install the same version on all"
        )
    for path in map(Path, seen):
        if not path.exists():
            unseen = path.parent if path.suffix == ".tmp" else path
            raise WorkerError(
                f"{here} does not see {unseen}; give an absolute path on a file system that all workers share"
            )
