"""Running batches of independent work: on one process, on a pool of them, or on the caller's own executor.

Results come back as they are ready. No more items are under way than the workers need to stay busy, so that the memory
of the caller does not grow with the work.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from typing import TYPE_CHECKING, Final, TypeAlias, TypedDict, TypeVar

from deepaccident_devkit.errors import ChoiceError, WorkerError
from deepaccident_devkit.parallel.calls import Call, Places, marked
from deepaccident_devkit.parallel.executors import fault_of_workers, width_of
from deepaccident_devkit.parallel.pool import main_module_hidden, own_workers, signals_put_off

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress: TypeAlias = "bool | Callable[[float], object]"
"""Whether to show a progress bar; or a function that gets each item's share of the work, for a bar of the caller's."""


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


_SAME_SIGNAL: Final = 0.1
"""Seconds in which a signal that ended a worker ends this process too, if it was sent to all processes of a job."""
_AHEAD: Final = 4
"""Items under way for each one that the workers do at once."""
_FAR_AHEAD: Final = 32
"""The same, counted from the oldest item that is not done: what is needed in order waits for it in memory."""
_WIDTH_SECONDS: Final = 5.0
"""Time after which an executor is asked again: workers join and leave."""


def run_batch(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    label: str = "",
    progress: Progress = False,
    places: Places | None = None,
) -> list[Result]:
    """Apply `work` to every item and return the results in the items' order.

    Args:
        work: an importable function of the devkit (workers import it by name).
        items: what it is applied to, one call an item.
        workers: processes to use; 1 runs in this one; None takes as many as there are cores, or this process
            alone if the work is too little for a pool or the caller is a worker itself.
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
        run_unordered(work, items, workers=workers, executor=executor, label=label, progress=progress, places=places)
    )
    return [results[position] for position in range(len(items))]


def run_unordered(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    label: str = "",
    progress: Progress = False,
    sizes: Sequence[int] | None = None,
    places: Places | None = None,
) -> Generator[tuple[int, Result], None, None]:
    """Apply `work` to every item; yields each one's position and result as soon as it is ready.

    Closing the generator cancels what has not begun, and ends its own workers, as an interruption does. Arguments and
    errors are those of `run_batch`; `progress` may be a function that gets each item's share of the work, and `sizes`
    is how far each item moves the progress bar; None for one step each.
    """
    from tqdm.auto import tqdm  # here: with asyncio and multiprocessing, a third of the package's import time

    count, steps = _worker_count(workers, len(items)), sizes or [1] * len(items)
    with tqdm(total=sum(steps), desc=label, disable=progress is not True, unit="") as bar, ExitStack() as stack:
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


def in_order(results: Generator[tuple[int, Result], None, None]) -> Generator[Result, None, None]:
    """The results of `run_unordered` in the order of their positions, each as soon as all before it are ready."""
    waiting: dict[int, Result] = {}
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
    return max(1, min(os.cpu_count() or 1, items // enough_work))


def _on(
    executor: Executor, calls: Sequence[Call[Item, Result]], *, cancel: bool
) -> Generator[tuple[int, Result], None, None]:
    """Positions and results of calls, as many of which are under way as keep the workers busy."""
    from queue import SimpleQueue

    done: SimpleQueue[Future[Result]] = SimpleQueue()
    running: dict[Future[Result], int] = {}
    upcoming, width, asked = 0, 1, float("-inf")
    try:
        while running or upcoming < len(calls):
            if time.monotonic() - asked >= _WIDTH_SECONDS:
                width, asked = width_of(executor), time.monotonic()
            oldest = next(iter(running.values()), upcoming)
            last = min(len(calls), upcoming + _AHEAD * width - len(running), oldest + _FAR_AHEAD * width)
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
