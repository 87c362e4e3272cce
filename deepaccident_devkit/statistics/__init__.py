"""The paper's statistics of a release, computed on the tables' columns."""

from deepaccident_devkit.statistics.compute import dataset_statistics
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
    "GROUPS",
    "PROBABILITIES",
    "CollisionPair",
    "CountTable",
    "DatasetStatistics",
    "Histogram",
    "LeftOut",
    "QuantileRow",
    "QuantileTable",
    "dataset_statistics",
    "writable_folder",
]
