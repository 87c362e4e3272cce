"""Bulk work on this process, on other processes of this machine, or on any executor; and its store.

Executors are of `concurrent.futures`. Every function that works on many scenarios or samples takes
`workers` and `executor`; none has a pool of its own.
"""

from deepaccident_devkit.support.parallel.batches import (
    Engine,
    Places,
    Progress,
    in_order,
    run_batch,
    run_unordered,
)
from deepaccident_devkit.support.parallel.executors import (
    FEWER_WORKERS,
    cluster_executor,
    keep_workers,
    own_threads,
    starting_workers,
)
from deepaccident_devkit.support.parallel.failures import Failure, Tried, check_failures
from deepaccident_devkit.support.parallel.store import Store, unfinished_folder

__all__ = [
    "FEWER_WORKERS",
    "Engine",
    "Failure",
    "Places",
    "Progress",
    "Store",
    "Tried",
    "check_failures",
    "cluster_executor",
    "in_order",
    "keep_workers",
    "own_threads",
    "run_batch",
    "run_unordered",
    "starting_workers",
    "unfinished_folder",
]
