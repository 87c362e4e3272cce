"""Running batches of independent work: on one process, on a pool of them, or on the caller's own executor."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from deepaccident_devkit.errors import ChoiceError

if TYPE_CHECKING:
    from concurrent.futures import Executor

Item = TypeVar("Item")
Result = TypeVar("Result")


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
        workers: processes to use; 1 runs in this one; None takes as many as there are cores, and this process
            alone where there is too little work to pay for a pool, or where a worker already calls.
        executor: any `concurrent.futures.Executor` to run on instead (a dask client's, a thread pool).
        label: text of the progress bar.
        progress: whether to show one.

    Raises:
        ChoiceError: `workers` is less than 1.
    """
    from tqdm.auto import tqdm  # here: with asyncio and multiprocessing, a third of the package's import time

    count = _worker_count(workers, len(items))
    with tqdm(total=len(items), desc=label, disable=not progress, unit="") as bar:
        if executor is not None:
            return _on_executor(executor, work, items, bar)
        if count == 1:
            return [_counted(work(item), bar) for item in items]
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor

        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(count, mp_context=context, initializer=_end_with_parent) as pool:
            return _on_executor(pool, work, items, bar)


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


def _on_executor(executor: Executor, work: Callable[[Item], Result], items: Sequence[Item], bar: Any) -> list[Result]:
    from concurrent.futures import as_completed

    with _main_module_hidden():
        futures = {executor.submit(work, item): position for position, item in enumerate(items)}
    results: dict[int, Result] = {}
    try:
        for future in as_completed(futures):
            results[futures[future]] = _counted(future.result(), bar)
    except BaseException:
        for future in futures:
            future.cancel()
        raise
    return [results[position] for position in range(len(items))]


def _end_with_parent() -> None:
    """Watch the parent from a thread: a pool's worker whose parent was killed would wait for work for ever."""
    import multiprocessing
    import threading

    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="end-with-parent", daemon=True).start()


def _counted(result: Result, bar: Any) -> Result:
    bar.update()
    return result


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
