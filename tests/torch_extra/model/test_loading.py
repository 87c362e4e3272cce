"""Batches of worker processes: whatever befalls a worker, its reader gets an error with the cause
and a remedy.
"""

import multiprocessing
import os
import resource
import signal
from collections.abc import Callable
from typing import Any

import pytest
import torch
from refusals import assert_refused

from deepaccident_devkit.errors import SensorFileError, WorkerError
from deepaccident_devkit.plugins.model.loading import read_batches, worker_faults_named

REMEDY = ("shared memory", "fewer workers", "without --workers")


class Unsendable:
    def __reduce__(self) -> Any:
        raise MemoryError("no room for the batch")


def killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def without_shared_memory() -> torch.Tensor:
    """As when /dev/shm is full: none of its files can grow."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    return torch.zeros(100_000)


def failing() -> None:
    raise KeyError("a fault of the reader")


def without_a_file() -> None:
    raise SensorFileError("image.jpg: cannot be read; restore it from its archive")


class Items:
    """Items of which the second is made by a function that may fail."""

    def __init__(self, make: Callable[[], object]) -> None:
        self.make = make

    def __len__(self) -> int:
        return 3

    def __getitem__(self, number: int) -> object:
        return self.make() if number == 1 else number


def read(make: Callable[[], object]) -> list[Any]:
    with worker_faults_named():
        return list(read_batches(Items(make), list, 1, timeout=60))


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize(
    ("make", "error", "facts"),
    [
        (killed, WorkerError, ("DataLoader worker", *REMEDY)),
        (without_shared_memory, WorkerError, ("shared memory", *REMEDY)),
        (failing, WorkerError, ("KeyError", "a fault of the reader", *REMEDY)),
        (Unsendable, WorkerError, ("no room for the batch", *REMEDY)),
        (without_a_file, SensorFileError, ("image.jpg", "restore it")),
    ],
)
def test_a_worker_that_fails_ends_the_reading(
    make: Callable[[], object], error: type[Exception], facts: Any
) -> None:
    assert_refused((lambda: read(make), error, facts))


def test_workers_that_cannot_start_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_room() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(multiprocessing, "Queue", no_room)
    assert_refused(
        (lambda: read(int), WorkerError, ("cannot be started", "No space left", *REMEDY))
    )
