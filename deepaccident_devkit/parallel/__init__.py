"""Bulk work: on this process, on others of this machine, or on any executor of `concurrent.futures`; or in shards.

Every function that works on many scenarios or samples takes `workers` and `executor`; none has a pool of its own.
"""

from deepaccident_devkit.parallel.batches import Progress, in_order, run_batch, run_unordered
from deepaccident_devkit.parallel.calls import Places
from deepaccident_devkit.parallel.executors import cluster_executor
from deepaccident_devkit.parallel.failures import Failure, Tried, check_failures
from deepaccident_devkit.parallel.pool import own_threads
from deepaccident_devkit.parallel.shard import (
    MERGE,
    Part,
    Shard,
    ShardFiles,
    check_whole,
    mine,
    part_of,
    unfinished_folder,
)
from deepaccident_devkit.parallel.store import Store, Turn

__all__ = [
    "MERGE",
    "Failure",
    "Part",
    "Places",
    "Progress",
    "Shard",
    "ShardFiles",
    "Store",
    "Tried",
    "Turn",
    "check_failures",
    "check_whole",
    "cluster_executor",
    "in_order",
    "mine",
    "own_threads",
    "part_of",
    "run_batch",
    "run_unordered",
    "unfinished_folder",
]
