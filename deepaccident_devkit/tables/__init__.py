"""The release as relational tables: their columns, the index they are made into, and the opened store."""

from deepaccident_devkit.tables.clearing import Cleared, clear_index
from deepaccident_devkit.tables.findings import SEVERITIES, Finding, Severity
from deepaccident_devkit.tables.index import Index, open_index, place_outside
from deepaccident_devkit.tables.manifest import Problem
from deepaccident_devkit.tables.opened import OpenTables, RowArgument
from deepaccident_devkit.tables.report import IndexInfo, IndexReport, index_report
from deepaccident_devkit.tables.tables import Table, Tables, table_names
from deepaccident_devkit.tables.velocities import displacement_velocities
from deepaccident_devkit.tables.visibility import visible_ids, visible_mask

__all__ = [
    "SEVERITIES",
    "Cleared",
    "Finding",
    "Index",
    "IndexInfo",
    "IndexReport",
    "OpenTables",
    "Problem",
    "RowArgument",
    "Severity",
    "Table",
    "Tables",
    "clear_index",
    "displacement_velocities",
    "index_report",
    "open_index",
    "place_outside",
    "table_names",
    "visible_ids",
    "visible_mask",
]
