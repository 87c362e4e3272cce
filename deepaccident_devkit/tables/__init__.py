"""The release as relational tables: their columns, the index they are made into, and the opened store."""

from deepaccident_devkit.tables.index import Index, open_index
from deepaccident_devkit.tables.manifest import Problem
from deepaccident_devkit.tables.tables import Table, Tables, table_names
from deepaccident_devkit.tables.visibility import visible_ids, visible_mask

__all__ = ["Index", "Problem", "Table", "Tables", "open_index", "table_names", "visible_ids", "visible_mask"]
