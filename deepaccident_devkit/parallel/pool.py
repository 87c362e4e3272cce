"""A pool of processes on this machine, which ends with the work: after an error, Ctrl-C, or the end of its parent."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from deepaccident_devkit.errors import WorkerError

if TYPE_CHECKING:
    from concurrent.futures import Executor, ThreadPoolExecutor


@contextmanager
def own_workers(count: int) -> Iterator[Executor]:
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


def own_threads() -> ThreadPoolExecutor:
    """Threads of this process, one for each core, in a `with` block: for work whose libraries let other threads run."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(os.cpu_count())


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
