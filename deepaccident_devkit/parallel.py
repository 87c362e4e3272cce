"""Running batches of independent work: on one process, on a pool of them, or on the caller's own executor."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from deepaccident_devkit.errors import ChoiceError

if TYPE_CHECKING:
    from concurrent.futures import Executor

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress: TypeAlias = "bool | Callable[[float], object]"
"""Whether to show a progress bar; or a function that gets each item's share of the work, for a bar of the caller's."""


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

    Closing the generator cancels what has not begun. Arguments and errors are those of `run_batch`, but `progress` may
    be a function, and `sizes` is how far each item moves the progress bar; None for one step each.
    """
    from tqdm.auto import tqdm  # here: with asyncio and multiprocessing, a third of the package's import time

    count, steps = _worker_count(workers, len(items)), sizes or [1] * len(items)
    with tqdm(total=sum(steps), desc=label, disable=progress is not True, unit="") as bar, ExitStack() as stack:
        if executor is None and count > 1:
            import multiprocessing
            from concurrent.futures import ProcessPoolExecutor

            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_parent)
            executor = stack.enter_context(pool)
        results = ((n, work(item)) for n, item in enumerate(items)) if executor is None else _on(executor, work, items)
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
    executor: Executor, work: Callable[[Item], Result], items: Sequence[Item]
) -> Generator[tuple[int, Result], None, None]:
    from concurrent.futures import as_completed

    with _main_module_hidden():
        futures = {executor.submit(work, item): position for position, item in enumerate(items)}
    try:
        for future in as_completed(futures):
            yield futures.pop(future), future.result()
    finally:
        for future in futures:
            future.cancel()


def _end_with_parent() -> None:
    """Watch the parent from a thread: without it a worker whose parent was killed would wait for ever."""
    import multiprocessing
    import threading

    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


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
