"""Bulk work on executors: order, how much is under way, what workers must see."""

import pickle
import pickletools
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
import workers

from deepaccident_devkit.errors import ChoiceError, ReleaseError, SomeFailedError, WorkerError
from deepaccident_devkit.parallel import Failure, Places, Tried, check_failures, in_order, run_batch, run_unordered
from deepaccident_devkit.parallel.batches import Call, marked


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
    with ThreadPoolExecutor(3) as threads, ProcessPoolExecutor(2, mp_context=get_context("spawn")) as processes:
        for executor in (threads, processes):
            assert run_batch(workers.following, range(50), executor=executor) == expected
            assert list(in_order(run_unordered(workers.following, range(50), executor=executor))) == expected
    assert run_batch(workers.following, [], executor=threads) == []


def test_what_is_under_way_is_bounded() -> None:
    """The caller's memory must not grow with the work, also where one item takes longer than all others."""
    executor = Delayed()
    assert run_batch(workers.following, range(300), executor=executor) == list(range(1, 301))
    assert executor.most <= 4 * 2
    first_last = Delayed()
    first_last.finish_one = lambda: None  # type: ignore[method-assign] - the first is never done, nor another
    results = run_unordered(workers.following, range(300), executor=first_last)
    thread = threading.Thread(target=lambda: next(results), daemon=True)
    thread.start()
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
    with pytest.raises(ChoiceError, match=r"^workers: expected a number of at least 1, or None, found 0$"):
        run_batch(workers.following, [1], workers=0)


def test_the_folders_are_marked_meanwhile(tmp_path: Path) -> None:
    inside, out = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    with marked(Places(reads=(inside,), writes=(out,))) as seen:
        assert all(Path(each).exists() for each in seen)
        assert Call(workers.following, 1, seen)() == 2
        assert len(list(out.iterdir())) == 1
    assert not list(out.iterdir())


def test_a_worker_that_does_not_see_a_place(tmp_path: Path) -> None:
    message = rf"^a worker on \S+ does not see {tmp_path}/gone; give an absolute path on a file system that all workers"
    with ThreadPoolExecutor(2) as threads, pytest.raises(WorkerError, match=message):
        run_batch(workers.following, range(4), executor=threads, places=Places(reads=(tmp_path / "gone",)))


def test_a_worker_with_another_folder_of_the_same_name(tmp_path: Path) -> None:
    with marked(Places(writes=(tmp_path,))) as seen:
        for mark in tmp_path.iterdir():
            mark.unlink()  # as on a host where the folder is another one
        with pytest.raises(WorkerError, match=rf"does not see {tmp_path}; give"):
            Call(workers.following, 1, seen)()


def test_a_worker_with_another_version(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    sent = pickle.dumps(Call(workers.following, 1, (str(tmp_path),)))  # not checked yet in this process
    monkeypatch.setattr("deepaccident_devkit.parallel.batches.__version__", "9.9")
    with pytest.raises(WorkerError, match=r"^a worker on \S+ has deepaccident_devkit 9\.9, and this is .*; install"):
        pickle.loads(sent)()


def test_what_is_sent_needs_no_devkit_before_it_is_called() -> None:
    """A dask scheduler unpickles it too, and a worker that cannot ends without a word."""
    sent = pickle.dumps(Call(workers.following, 1, ()))
    names = [argument for code, argument, _ in pickletools.genops(sent) if "GLOBAL" in code.name or "UNI" in code.name]
    assert names
    assert not any("deepaccident" in str(name) or "workers" in str(name) for name in names)
    assert pickle.loads(sent)() == 2


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ModuleNotFoundError("No module named 'deepaccident_devkit'"), "a worker cannot do the work"),
        (AttributeError("Can't get attribute 'x' on <module 'deepaccident_devkit.v2x'>"), "a worker cannot do"),
    ],
)
def test_a_worker_without_the_package(error: Exception, told: str) -> None:
    class Failing(Executor):
        def submit(self, _function: Any, /, *_: Any, **__: Any) -> Future[Any]:
            future: Future[Any] = Future()
            future.set_exception(error)
            return future

    with pytest.raises(WorkerError, match=f"^{told}"):
        run_batch(workers.following, [1], executor=Failing())


def broken_if_odd(item: int) -> int:
    if item % 2:
        raise ReleaseError(f"{item} is broken")
    return item


def full_disk(item: int) -> int:
    raise OSError(28, "No space left on device")


def test_what_failed_is_listed_and_the_rest_done() -> None:
    results = run_batch(Tried(broken_if_odd), range(5), workers=1)
    assert results == [0, Failure("1 is broken"), 2, Failure("3 is broken"), 4]
    with pytest.raises(SomeFailedError, match="2 of 5") as raised:
        check_failures(zip("abcde", results, strict=True), "out")
    assert str(raised.value).splitlines() == [
        "out: 2 of 5 failed:",
        "  b: 1 is broken",
        "  d: 3 is broken",
        "The others are done; mend these, and run the same again: it does what is left.",
    ]
    check_failures([("a", 0)], "out")


def test_a_full_disk_ends_it_all() -> None:
    with pytest.raises(OSError, match="No space left"):
        run_batch(Tried(full_disk), range(5), workers=1)
