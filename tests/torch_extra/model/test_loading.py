"""Batches of worker processes: when a worker fails, the error names the cause and a remedy."""

import multiprocessing
import os
import resource
import signal
from collections.abc import Callable
from typing import Any

import pytest
import torch
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import SensorFileError, WorkerError
from deepaccident_devkit.plugins.model.loading import name_worker_faults, read_batches

REMEDY = ("shared memory", "fewer workers", "without --workers")


class Unsendable:
    def __reduce__(self) -> Any:
        raise MemoryError("no room for the batch")


def kill_worker() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def fill_shared_memory() -> torch.Tensor:
    """Return a tensor while no file can grow, as when /dev/shm is full."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    return torch.zeros(100_000)


def raise_key_error() -> None:
    raise KeyError("a fault of the reader")


def raise_file_error() -> None:
    raise SensorFileError("image.jpg: cannot be read; restore it from its archive")


class Items:
    """Three items; a function, which may fail, makes the second one."""

    def __init__(self, make: Callable[[], object]) -> None:
        self.make = make

    def __len__(self) -> int:
        return 3

    def __getitem__(self, number: int) -> object:
        return self.make() if number == 1 else number


def read_items(make: Callable[[], object]) -> list[Any]:
    with name_worker_faults():
        return list(read_batches(Items(make), list, 1, timeout=60))


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize(
    ("make", "error", "facts"),
    [
        (kill_worker, WorkerError, ("DataLoader worker", *REMEDY)),
        (fill_shared_memory, WorkerError, ("shared memory", *REMEDY)),
        (raise_key_error, WorkerError, ("KeyError", "a fault of the reader", *REMEDY)),
        (Unsendable, WorkerError, ("no room for the batch", *REMEDY)),
        (raise_file_error, SensorFileError, ("image.jpg", "restore it")),
    ],
)
def test_a_worker_that_fails_ends_the_reading(
    make: Callable[[], object], error: type[Exception], facts: Any
) -> None:
    assert_raises((lambda: read_items(make), error, facts))


def test_workers_that_cannot_start_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def make_no_queue() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(multiprocessing, "Queue", make_no_queue)
    assert_raises(
        (lambda: read_items(int), WorkerError, ("cannot be started", "No space left", *REMEDY))
    )
