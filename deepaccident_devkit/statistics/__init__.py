"""The paper's statistics of a release, computed from table columns."""

from deepaccident_devkit.statistics.compute import dataset_statistics
from deepaccident_devkit.statistics.real_facts import FACTS, Fact
from deepaccident_devkit.statistics.release_facts import ReleaseFacts, release_facts
from deepaccident_devkit.statistics.report import DatasetStatistics
from deepaccident_devkit.statistics.results import (
    ENDS,
    GROUPS,
    PROBABILITIES,
    CollisionPair,
    CountTable,
    Histogram,
    LeftOut,
    QuantileRow,
    QuantileTable,
)
from deepaccident_devkit.support.files import writable_folder

__all__ = [
    "ENDS",
    "FACTS",
    "GROUPS",
    "PROBABILITIES",
    "CollisionPair",
    "CountTable",
    "DatasetStatistics",
    "Fact",
    "Histogram",
    "LeftOut",
    "QuantileRow",
    "QuantileTable",
    "ReleaseFacts",
    "dataset_statistics",
    "release_facts",
    "writable_folder",
]
