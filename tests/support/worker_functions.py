"""Functions that tests run in other processes; a spawned process imports this module by name."""

import os
import signal
import time
from pathlib import Path

from deepaccident_devkit import DeepAccident


def num_boxes(release: DeepAccident, row: int) -> int:
    return len(release.boxes(release.sample[row]))


def kill_worker(item: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def interrupt_worker(item: int) -> int:
    """Interrupt this worker, as Ctrl-C in a terminal does, and return the item."""
    os.kill(os.getpid(), signal.SIGINT)
    return item


def report_and_sleep(path: str) -> None:
    if path:
        Path(path).write_text(str(os.getpid()))
        time.sleep(600)  # longer than any test waits


def report_or_fail(path: str) -> None:
    """Touch the path after a short time; fail for a path that ends in 0."""
    if path.endswith("0"):
        raise ValueError("broken")
    time.sleep(0.2)
    Path(path).touch()


def next_number(item: int) -> int:
    return item + 1


def worker_process_id(item: int) -> int:
    return os.getpid()
