"""Running batches of independent work: on one process, on a pool of them, or on the caller's own executor."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from deepaccident_devkit.errors import ChoiceError, WorkerError

if TYPE_CHECKING:
    from concurrent.futures import Executor, Future

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress: TypeAlias = "bool | Callable[[float], object]"
"""Whether to show a progress bar; or a function that gets each item's share of the work, for a bar of the caller's."""
_SAME_SIGNAL = 0.1
"""Seconds in which a signal that ended a worker ends this process too, if it was sent to all processes of a job."""


def run_batch(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    label: str = "",
    progress: bool = False,
) -> list[Result]:
    """Apply `work` to every item and return the results in the items' order.

    Args:
        work: an importable function of the devkit (workers import it by name).
        items: what it is applied to, one call an item.
        workers: processes to use; 1 runs in this one; None takes as many as there are cores, or this process
            alone if the work is too little for a pool or the caller is a worker itself.
        executor: any `concurrent.futures.Executor` to run on instead (a dask client's, a thread pool).
        label: text of the progress bar.
        progress: whether to show one.

    Raises:
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed.
    """
    results = dict(run_unordered(work, items, workers=workers, executor=executor, label=label, progress=progress))
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
) -> Generator[tuple[int, Result], None, None]:
    """Apply `work` to every item; yields each one's position and result as soon as it is ready.

    Closing the generator cancels what has not begun, and ends its own workers, as an interruption does. Arguments and
    errors are those of `run_batch`, but `progress` may be a function, and `sizes` is how far each item moves the
    progress bar; None for one step each.
    """
    from tqdm.auto import tqdm  # here: with asyncio and multiprocessing, a third of the package's import time

    count, steps = _worker_count(workers, len(items)), sizes or [1] * len(items)
    with tqdm(total=sum(steps), desc=label, disable=progress is not True, unit="") as bar, ExitStack() as stack:
        if executor is not None:
            results = _on(executor, work, items, cancel=True)
        elif count > 1:
            results = _on(stack.enter_context(_own_workers(count)), work, items, cancel=False)
        else:
            results = ((position, work(item)) for position, item in enumerate(items))
        for position, result in stack.enter_context(closing(results)):
            bar.update(steps[position])
            if callable(progress):
                progress(steps[position] / sum(steps))
            yield position, result


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
    executor: Executor, work: Callable[[Item], Result], items: Sequence[Item], *, cancel: bool
) -> Generator[tuple[int, Result], None, None]:
    from concurrent.futures import BrokenExecutor, as_completed

    futures: dict[Future[Result], int] = {}
    try:
        with _main_module_hidden(), _signals_put_off():
            futures.update((executor.submit(work, item), position) for position, item in enumerate(items))
        for future in as_completed(futures):
            yield futures.pop(future), future.result()
    except BrokenExecutor as error:
        time.sleep(_SAME_SIGNAL)
        raise WorkerError(
            f"a worker process was killed ({error}), perhaps because memory ran out; run it again with fewer workers"
        ) from error
    finally:
        for future in futures if cancel else ():
            future.cancel()


@contextmanager
def _own_workers(count: int) -> Iterator[Executor]:
    """A pool of spawned processes: an error of an item lets the others end what they do; all else ends them at once.

    The pool itself cancels what has not begun: if others did and a process was killed, a thread of it would fail. If
    one is killed while another begins, the pool would wait for that one for ever.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    pool = ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker)
    try:
        yield pool
    except BaseException as error:
        of_an_item = isinstance(error, Exception) and not isinstance(error, WorkerError)
        if not of_an_item:  # a killed worker, Ctrl-C, or the generator was closed
            for process in list((pool._processes or {}).values()):  # noqa: SLF001 - public from Python 3.14
                process.kill()
        pool.shutdown(wait=of_an_item, cancel_futures=of_an_item)
        raise
    pool.shutdown()


def _begin_worker() -> None:
    """Leave Ctrl-C, which a terminal sends to workers too, to the parent, and end when that ends."""
    from tqdm import tqdm

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tqdm.set_lock(threading.RLock())  # its own is one for all processes, and stays in the system if this one is killed
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()


def _end_with_parent() -> None:
    """Without this a worker whose parent was killed would wait for ever."""
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _signals_put_off() -> Iterator[None]:
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
        if signal.getsignal(number) is not None  # one of a program that embeds Python cannot be put back
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
def _main_module_hidden() -> Iterator[None]:
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
