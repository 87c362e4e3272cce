"""Batches that worker processes read.

A worker that fails ends the run with an error; otherwise the run would wait forever.
"""

import multiprocessing
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.queues import Queue
from typing import Any

from torch._utils import ExceptionWrapper
from torch.utils.data import DataLoader

from deepaccident_devkit.errors import DeepAccidentError, WorkerError, shortened
from deepaccident_devkit.support.parallel import FEWER_WORKERS, starting_workers
from deepaccident_devkit.support.values import NamedValues

# Torch's messages in this process when a worker failed, or when its data cannot be opened here.
_WORKER_FAULTS = re.compile(r"DataLoader worker|</torch_|ancdata")


def read_batches(
    data: Any, collate: Callable[..., Any], workers: int, **options: Any
) -> Iterator[NamedValues]:
    """Start to read batches in worker processes, or in this process (0 workers).

    Args:
        data: A map-style dataset of torch.
        collate: Function that makes a batch from items.
        workers: Number of processes that read.
        **options: Further options of `DataLoader`.

    Raises:
        WorkerError: The processes cannot be started.
    """
    with starting_workers():
        if workers:
            multiprocessing.Queue()  # torch would print tracebacks
        loader = DataLoader(
            data,
            collate_fn=collate,
            num_workers=workers,
            worker_init_fn=_send_faults,
            **options,
        )
        return iter(loader)


@contextmanager
def name_worker_faults() -> Iterator[None]:
    """Raise WorkerError if a worker of `read_batches` is killed or fails in another way.

    The devkit's own errors are passed on. Torch may raise a worker's error at any time while the
    workers run, so the block must contain everything that uses the batches.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, DeepAccidentError) or not _WORKER_FAULTS.search(str(error)):
            raise
        *_, cause = str(error).strip().splitlines()
        raise WorkerError(
            f"a worker that reads samples failed ({shortened(cause)}); {FEWER_WORKERS}"
        ) from error


def _send_faults(_: int) -> None:
    """Let this worker send the reason if it cannot send a batch.

    Otherwise it would print the reason, and the reading process would wait.
    """
    Queue._on_queue_feeder_error = _send_reason  # type: ignore[attr-defined] # noqa: SLF001 - multiprocessing's own hook


def _send_reason(queue: Any, _: Exception, unsent: tuple[int, Any]) -> None:
    """Send the exception that is being handled instead of a batch that cannot be sent."""
    batch_number, _batch = unsent
    reason = ExceptionWrapper(where="in DataLoader worker process")
    queue.put((batch_number, reason))
