"""Bulk work on executors: order, how much is under way, what workers must see, and work that ends
early.
"""

import os
import pickle
import pickletools
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import workers
from processes import is_running, wait_for
from refusals import assert_refused

from deepaccident_devkit.errors import ChoiceError, WorkerError
from deepaccident_devkit.support.parallel import (
    Places,
    Tried,
    in_order,
    run_batch,
    run_unordered,
    workers_kept,
)
from deepaccident_devkit.support.parallel.batches import Call, visible_paths
from deepaccident_devkit.support.parallel.executors import signals_deferred

pytestmark = pytest.mark.slow


class Delayed(Executor):
    """Does the first item last, and remembers how many were under way."""

    _max_workers = 2

    def __init__(self) -> None:
        self.held: list[tuple[Future[Any], Callable[[], Any]]] = []
        self.most = 0
        self.given = 0

    def submit(self, function: Any, /, *_: Any, **__: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.held.append((future, function))
        self.given += 1
        self.most = max(self.most, len(self.held))
        threading.Timer(0.001, self.finish_one).start()
        return future

    def finish_one(self) -> None:
        first = self.given < 60 and len(self.held) > 1
        future, function = self.held.pop(1 if first else 0)
        future.set_result(function())


def test_any_executor_gives_the_same() -> None:
    expected = [item + 1 for item in range(50)]
    with (
        ThreadPoolExecutor(3) as threads,
        ProcessPoolExecutor(2, mp_context=get_context("spawn")) as processes,
    ):
        for executor in (threads, processes):
            assert run_batch(workers.following, range(50), executor=executor) == expected
            assert (
                list(in_order(run_unordered(workers.following, range(50), executor=executor)))
                == expected
            )
    assert run_batch(workers.following, [], executor=threads) == []


def test_what_is_under_way_is_bounded() -> None:
    """The caller's memory must not grow with the work, also where one item takes longer than all
    others.
    """
    executor = Delayed()
    assert run_batch(workers.following, range(300), executor=executor) == list(range(1, 301))
    assert executor.most <= 4 * 2
    first_last = Delayed()
    first_last.finish_one = lambda: None  # type: ignore[method-assign] - the first is never done, nor another
    results = run_unordered(workers.following, range(300), executor=first_last)
    threading.Thread(target=lambda: next(results), daemon=True).start()
    wait_for(lambda: first_last.given >= 4 * 2)
    time.sleep(0.05)
    assert first_last.given == 4 * 2


def test_cancelled_when_the_generator_is_closed() -> None:
    executor = Delayed()
    executor.finish_one = lambda: None  # type: ignore[method-assign]
    results = run_unordered(workers.following, range(3), executor=executor)
    threading.Timer(0.05, lambda: executor.held[0][0].set_result(7)).start()
    assert next(results) == (0, 7)
    results.close()
    assert [future.cancelled() for future, _ in executor.held] == [False, True, True]


def test_a_wrong_number_of_workers() -> None:
    assert_refused(
        (
            lambda: run_batch(workers.following, [1], workers=0),
            ChoiceError,
            ("workers", "at least 1", "0"),
        )
    )


def test_the_folders_are_marked_meanwhile(tmp_path: Path) -> None:
    inside, out = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    with visible_paths(Places(reads=(inside,), writes=(out,))) as seen:
        assert all(Path(each).exists() for each in seen)
        assert (Call(workers.following, 1, seen)(), len(list(out.iterdir()))) == (2, 1)
    assert not list(out.iterdir())


def test_a_worker_with_another_folder_of_the_same_name(tmp_path: Path) -> None:
    with visible_paths(Places(writes=(tmp_path,))) as seen:
        for mark in tmp_path.iterdir():
            mark.unlink()  # as on a host where the folder is another one
        assert_refused(
            (Call(workers.following, 1, seen), WorkerError, rf"does not see {tmp_path}; give")
        )


def test_a_worker_with_another_version(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sent = pickle.dumps(
        Call(workers.following, 1, (str(tmp_path),))
    )  # not checked yet in this process
    monkeypatch.setattr("deepaccident_devkit.support.parallel.batches.__version__", "9.9")
    assert_refused(
        (pickle.loads(sent), WorkerError, ("a worker on ", "deepaccident_devkit 9.9", "install"))
    )


@pytest.mark.parametrize(
    "error",
    [
        ModuleNotFoundError("No module named 'deepaccident_devkit'"),
        AttributeError("Can't get attribute 'x' on <module 'deepaccident_devkit.v2x'>"),
    ],
)
def test_a_worker_without_the_package(error: Exception) -> None:
    failed: Future[Any] = Future()
    failed.set_exception(error)
    executor = Mock(spec=Executor, submit=lambda *_, **__: failed)
    assert_refused(
        (
            lambda: run_batch(workers.following, [1], executor=executor),
            WorkerError,
            "^a worker cannot do the work",
        )
    )


def full_disk(item: int) -> int:
    raise OSError(28, "No space left on device")


def test_a_full_disk_ends_it_all() -> None:
    assert_refused(
        (lambda: run_batch(Tried(full_disk), range(5), workers=1), OSError, "No space left")
    )


SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture(autouse=True)
def ctrl_c_counts() -> Iterator[None]:
    """As in a terminal: a runner in the background ignores it. Under load, xdist may test beside
    its main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_killed_worker_is_our_error() -> None:
    with pytest.raises(
        WorkerError,
        match=r"^a worker process was killed \(.*memory ran out; .* with fewer workers$",
    ):
        run_batch(workers.killed, range(6), workers=2)


def test_kept_workers_do_what_comes_next_until_one_is_killed_or_the_block_ends() -> None:
    with workers_kept():
        with workers_kept():
            first = run_batch(workers.process, range(6), workers=2)
        second = run_batch(workers.process, range(6), workers=2)
        assert all(map(is_running, first + second))
        assert len({*first, *second}) <= 2
        with pytest.raises(WorkerError, match="was killed"):
            run_batch(workers.killed, range(6), workers=2)
        third = run_batch(workers.process, range(6), workers=2)
        assert {*first, *second}.isdisjoint(third)
    assert not any(map(is_running, first + second + third))


def test_workers_leave_ctrl_c_to_the_parent() -> None:
    assert run_batch(workers.interrupted, range(4), workers=2) == [0, 1, 2, 3]


def wait_and_raise_ctrl_c(folder: Path) -> None:
    wait_for(lambda: len(list(folder.iterdir())) == 2)
    os.kill(os.getpid(), signal.SIGINT)


def assert_workers_end(folder: Path) -> None:
    """Those that wrote their numbers into files of a folder."""
    numbers = [int(path.read_text()) for path in folder.iterdir() if path.read_text()]
    wait_for(lambda: not any(map(is_running, numbers)))


def test_ctrl_c_ends_the_workers_at_once(tmp_path: Path) -> None:
    """In a notebook: nobody but the caller of the library handles signals."""
    before = [signal.getsignal(number) for number in SIGNALS]
    waiting = threading.Thread(target=wait_and_raise_ctrl_c, args=(tmp_path,))
    waiting.start()
    with pytest.raises(KeyboardInterrupt):
        run_batch(
            workers.told_and_asleep, [str(tmp_path / str(item)) for item in range(6)], workers=2
        )
    waiting.join()
    assert_workers_end(tmp_path)
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_an_error_lets_others_end_what_they_do(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^broken$"):
        run_batch(
            workers.told_or_broken, [str(tmp_path / str(item)) for item in range(20)], workers=2
        )
    assert 0 < len(list(tmp_path.iterdir())) < 10


@pytest.mark.parametrize("number", SIGNALS)
def test_signals_wait_for_the_start_of_processes(number: signal.Signals) -> None:
    came: list[int] = []
    before = signal.signal(number, lambda each, _: came.append(each))
    try:
        with signals_deferred():
            os.kill(os.getpid(), number)
            assert not came
        assert came == [number]
    finally:
        signal.signal(number, before)


def test_what_is_sent_needs_no_devkit_before_it_is_called() -> None:
    """A dask scheduler unpickles it too, and a worker that cannot ends without a word."""
    sent = pickle.dumps(Call(workers.following, 1, ()))
    names = [
        argument
        for code, argument, _ in pickletools.genops(sent)
        if "GLOBAL" in code.name or "UNI" in code.name
    ]
    assert names
    assert not any("deepaccident" in str(name) or "workers" in str(name) for name in names)
    assert pickle.loads(sent)() == 2
