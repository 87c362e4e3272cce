"""Batches of work that end early: a killed worker, Ctrl-C, an error."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import workers
from processes import is_running, wait_for

from deepaccident_devkit.errors import WorkerError
from deepaccident_devkit.parallel import run_batch, run_unordered
from deepaccident_devkit.parallel.executors import signals_put_off

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture(autouse=True)
def ctrl_c_counts() -> Iterator[None]:
    """As in a terminal: a runner in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_killed_worker_is_our_error() -> None:
    with pytest.raises(WorkerError, match=r"^a worker process was killed \(.*memory ran out; .* with fewer workers$"):
        run_batch(workers.killed, range(6), workers=2)


def test_workers_leave_ctrl_c_to_the_parent() -> None:
    assert run_batch(workers.interrupted, range(4), workers=2) == [0, 1, 2, 3]


def wait_and_raise_ctrl_c(folder: Path) -> None:
    wait_for(lambda: len(list(folder.iterdir())) == 2)
    os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_ends_the_workers_at_once(tmp_path: Path) -> None:
    """In a notebook: nobody but the caller of the library handles signals."""
    before = [signal.getsignal(number) for number in SIGNALS]
    waiting = threading.Thread(target=wait_and_raise_ctrl_c, args=(tmp_path,))
    waiting.start()
    with pytest.raises(KeyboardInterrupt):
        run_batch(workers.told_and_asleep, [str(tmp_path / str(item)) for item in range(6)], workers=2)
    waiting.join()
    numbers = [int(path.read_text()) for path in tmp_path.iterdir() if path.read_text()]
    wait_for(lambda: not any(map(is_running, numbers)), seconds=10)
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_closing_the_generator_ends_the_workers(tmp_path: Path) -> None:
    results = run_unordered(workers.told_and_asleep, ["", str(tmp_path / "1"), str(tmp_path / "2")], workers=2)
    next(results)
    wait_for(lambda: any(path.read_text() for path in tmp_path.iterdir()))
    results.close()
    numbers = [int(path.read_text()) for path in tmp_path.iterdir() if path.read_text()]
    wait_for(lambda: not any(map(is_running, numbers)), seconds=10)


def test_an_error_lets_others_end_what_they_do(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^broken$"):
        run_batch(workers.told_or_broken, [str(tmp_path / str(item)) for item in range(20)], workers=2)
    done = len(list(tmp_path.iterdir()))
    assert 0 < done < 10


@pytest.mark.parametrize("number", SIGNALS)
def test_signals_wait_for_the_start_of_processes(number: signal.Signals) -> None:
    came: list[int] = []
    before = signal.signal(number, lambda each, _: came.append(each))
    try:
        with signals_put_off():
            os.kill(os.getpid(), number)
            assert not came
        assert came == [number]
    finally:
        signal.signal(number, before)


def test_other_threads_get_no_signals_to_put_off() -> None:
    entered: list[bool] = []

    def enter() -> None:
        with signals_put_off():
            entered.append(True)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert entered


@pytest.mark.slow
def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    paths = [str(tmp_path / "a"), str(tmp_path / "b")]
    script = (
        "import workers\nfrom deepaccident_devkit.parallel import run_batch\n"
        f"run_batch(workers.told_and_asleep, {paths!r}, workers=2)"
    )
    path = os.pathsep.join([str(Path(workers.__file__).parent), *sys.path])
    parent = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": path})
    wait_for(lambda: len([file for file in tmp_path.iterdir() if file.read_text()]) == 2)
    numbers = [int(file.read_text()) for file in tmp_path.iterdir()]
    parent.kill()
    parent.wait()
    wait_for(lambda: not any(map(is_running, numbers)), seconds=20)


def test_run_batch_needs_no_items() -> None:
    assert run_batch(workers.following, [], workers=3) == []
