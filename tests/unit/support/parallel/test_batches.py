"""Bulk work on executors: the order of results, bounded work under way, marks for workers, and
work that ends early.
"""

import os
import pickle
import pickletools
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from support import worker_functions
from support.expected_errors import assert_raises
from support.linux_processes import is_running, wait_for

from deepaccident_devkit.errors import ChoiceError, WorkerError
from deepaccident_devkit.support.parallel import (
    Places,
    Tried,
    in_order,
    keep_workers,
    run_batch,
    run_unordered,
)
from deepaccident_devkit.support.parallel.batches import Call, visible_paths
from deepaccident_devkit.support.parallel.executors import signals_deferred

pytestmark = pytest.mark.slow


class DelayingExecutor(Executor):
    """An executor that does the first item last, and counts the items under way."""

    _max_workers = 2

    def __init__(self) -> None:
        self.pending: list[tuple[Future[Any], Callable[[], Any]]] = []
        self.max_pending = 0
        self.num_submitted = 0

    def submit(self, function: Any, /, *_: Any, **__: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.pending.append((future, function))
        self.num_submitted += 1
        self.max_pending = max(self.max_pending, len(self.pending))
        threading.Timer(0.001, self.finish_one).start()
        return future

    def finish_one(self) -> None:
        delay_first = self.num_submitted < 60 and len(self.pending) > 1
        future, function = self.pending.pop(1 if delay_first else 0)
        future.set_result(function())


def test_any_executor_gives_the_same_results() -> None:
    function = worker_functions.next_number
    expected = [item + 1 for item in range(50)]
    with (
        ThreadPoolExecutor(3) as threads,
        ProcessPoolExecutor(2, mp_context=get_context("spawn")) as processes,
    ):
        for executor in (threads, processes):
            assert run_batch(function, range(50), executor=executor) == expected
            assert list(in_order(run_unordered(function, range(50), executor=executor))) == expected

    assert run_batch(function, [], executor=threads) == []


def test_work_under_way_is_bounded() -> None:
    """The caller's memory must not grow with the work, even if one item takes longer than all
    others.
    """
    executor = DelayingExecutor()
    results = run_batch(worker_functions.next_number, range(300), executor=executor)
    assert results == list(range(1, 301))
    assert executor.max_pending <= 4 * 2

    stuck_executor = DelayingExecutor()
    stuck_executor.finish_one = lambda: None  # type: ignore[method-assign] - no item is ever done
    results = run_unordered(worker_functions.next_number, range(300), executor=stuck_executor)
    threading.Thread(target=lambda: next(results), daemon=True).start()
    wait_for(lambda: stuck_executor.num_submitted >= 4 * 2)
    time.sleep(0.05)
    assert stuck_executor.num_submitted == 4 * 2


def test_pending_items_are_cancelled_when_the_generator_is_closed() -> None:
    executor = DelayingExecutor()
    executor.finish_one = lambda: None  # type: ignore[method-assign]
    results = run_unordered(worker_functions.next_number, range(3), executor=executor)
    threading.Timer(0.05, lambda: executor.pending[0][0].set_result(7)).start()

    assert next(results) == (0, 7)
    results.close()
    assert [future.cancelled() for future, _ in executor.pending] == [False, True, True]


def test_a_wrong_number_of_workers_is_refused() -> None:
    assert_raises(
        (
            lambda: run_batch(worker_functions.next_number, [1], workers=0),
            ChoiceError,
            ("workers", "at least 1", "0"),
        )
    )


def test_folders_are_marked_while_work_is_under_way(tmp_path: Path) -> None:
    input_folder = tmp_path / "in"
    output_folder = tmp_path / "out"
    input_folder.mkdir()
    with visible_paths(Places(reads=(input_folder,), writes=(output_folder,))) as paths:
        assert all(Path(path).exists() for path in paths)
        assert Call(worker_functions.next_number, 1, paths)() == 2
        assert len(list(output_folder.iterdir())) == 1

    assert not list(output_folder.iterdir())


def test_a_worker_with_another_folder_of_the_same_name_is_an_error(tmp_path: Path) -> None:
    with visible_paths(Places(writes=(tmp_path,))) as paths:
        for mark in tmp_path.iterdir():
            mark.unlink()  # as on a host where the folder is another one
        assert_raises(
            (
                Call(worker_functions.next_number, 1, paths),
                WorkerError,
                rf"does not see {tmp_path}; give",
            )
        )


def test_a_worker_with_another_version_is_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # the call is not checked yet in this process
    sent_call = pickle.dumps(Call(worker_functions.next_number, 1, (str(tmp_path),)))
    monkeypatch.setattr("deepaccident_devkit.support.parallel.batches.__version__", "9.9")
    assert_raises(
        (
            pickle.loads(sent_call),
            WorkerError,
            ("a worker on ", "deepaccident_devkit 9.9", "install"),
        )
    )


@pytest.mark.parametrize(
    "error",
    [
        ModuleNotFoundError("No module named 'deepaccident_devkit'"),
        AttributeError("Can't get attribute 'x' on <module 'deepaccident_devkit.v2x'>"),
    ],
)
def test_a_worker_without_the_package_is_an_error(error: Exception) -> None:
    failed: Future[Any] = Future()
    failed.set_exception(error)
    executor = Mock(spec=Executor, submit=lambda *_, **__: failed)

    assert_raises(
        (
            lambda: run_batch(worker_functions.next_number, [1], executor=executor),
            WorkerError,
            "^a worker cannot do the work",
        )
    )


def raise_full_disk(item: int) -> int:
    raise OSError(28, "No space left on device")


def test_a_full_disk_ends_the_batch() -> None:
    assert_raises(
        (lambda: run_batch(Tried(raise_full_disk), range(5), workers=1), OSError, "No space left")
    )


SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture(autouse=True)
def ctrl_c_handler() -> Iterator[None]:
    """Handle Ctrl+C as in a terminal: a runner in the background ignores it. Under load, xdist may
    run a test beside its main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_killed_worker_is_an_error_of_the_devkit() -> None:
    message = r"^a worker process was killed \(.*memory ran out; .* with fewer workers$"
    with pytest.raises(WorkerError, match=message):
        run_batch(worker_functions.kill_worker, range(6), workers=2)


def test_kept_workers_do_later_batches_until_one_is_killed_or_the_block_ends() -> None:
    run_workers = partial(run_batch, worker_functions.worker_process_id, range(6), workers=2)
    with keep_workers():
        with keep_workers():
            first_ids = run_workers()
        second_ids = run_workers()
        assert all(map(is_running, first_ids + second_ids))
        assert len({*first_ids, *second_ids}) <= 2
        with pytest.raises(WorkerError, match="was killed"):
            run_batch(worker_functions.kill_worker, range(6), workers=2)
        third_ids = run_workers()
        assert {*first_ids, *second_ids}.isdisjoint(third_ids)

    assert not any(map(is_running, first_ids + second_ids + third_ids))


def test_workers_leave_ctrl_c_to_the_parent() -> None:
    assert run_batch(worker_functions.interrupt_worker, range(4), workers=2) == [0, 1, 2, 3]


def wait_and_raise_ctrl_c(folder: Path) -> None:
    wait_for(lambda: len(list(folder.iterdir())) == 2)
    os.kill(os.getpid(), signal.SIGINT)


def assert_workers_end(folder: Path) -> None:
    """Wait until the workers that wrote their ids into files of a folder have ended."""
    texts = [path.read_text() for path in folder.iterdir()]
    worker_ids = [int(text) for text in texts if text]
    wait_for(lambda: not any(map(is_running, worker_ids)))


def test_ctrl_c_ends_the_workers_at_once(tmp_path: Path) -> None:
    """In a notebook, only the caller of the library handles signals."""
    handlers = [signal.getsignal(number) for number in SIGNALS]
    items = [str(tmp_path / str(item)) for item in range(6)]
    thread = threading.Thread(target=wait_and_raise_ctrl_c, args=(tmp_path,))
    thread.start()

    with pytest.raises(KeyboardInterrupt):
        run_batch(worker_functions.report_and_sleep, items, workers=2)
    thread.join()
    assert_workers_end(tmp_path)
    assert [signal.getsignal(number) for number in SIGNALS] == handlers


def test_items_under_way_are_finished_after_an_error(tmp_path: Path) -> None:
    items = [str(tmp_path / str(item)) for item in range(20)]
    with pytest.raises(ValueError, match=r"^broken$"):
        run_batch(worker_functions.report_or_fail, items, workers=2)
    assert 0 < len(list(tmp_path.iterdir())) < 10


@pytest.mark.parametrize("number", SIGNALS)
def test_signals_wait_for_the_start_of_processes(number: signal.Signals) -> None:
    received: list[int] = []
    handler = signal.signal(number, lambda signal_number, _: received.append(signal_number))
    try:
        with signals_deferred():
            os.kill(os.getpid(), number)
            assert not received
        assert received == [number]
    finally:
        signal.signal(number, handler)


def test_a_sent_call_needs_no_devkit_before_it_is_called() -> None:
    """A dask scheduler unpickles it as well, and a worker that cannot unpickle it ends silently."""
    sent_call = pickle.dumps(Call(worker_functions.next_number, 1, ()))
    names = []
    for code, argument, _ in pickletools.genops(sent_call):
        if "GLOBAL" in code.name or "UNI" in code.name:
            names.append(str(argument))

    assert names
    assert not any("deepaccident" in name or "workers" in name for name in names)
    assert pickle.loads(sent_call)() == 2
