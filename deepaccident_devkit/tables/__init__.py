"""The release as relational tables: their columns, their index, and the opened store."""

from deepaccident_devkit.tables.boxes import displacement_velocities, visible_ids, visible_mask
from deepaccident_devkit.tables.index import (
    Index,
    Problem,
    choose_outside_index_dir,
    clear_index,
    current_index,
    open_index,
)
from deepaccident_devkit.tables.scan import SEVERITIES, Finding, Severity
from deepaccident_devkit.tables.tables import OpenTables, RowArgument, Table, Tables, table_names

__all__ = [
    "SEVERITIES",
    "Finding",
    "Index",
    "OpenTables",
    "Problem",
    "RowArgument",
    "Severity",
    "Table",
    "Tables",
    "choose_outside_index_dir",
    "clear_index",
    "current_index",
    "displacement_velocities",
    "open_index",
    "table_names",
    "visible_ids",
    "visible_mask",
]
