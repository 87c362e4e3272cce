"""Sources of a release's files: real folders, zip archives, or URLs.

Only `release` knows the kind of the source.
"""

from deepaccident_devkit.release.store.opening import (
    INDEX_FOLDER,
    index_places,
    list_files_in,
    open_dataroot,
    refused_archives,
)
from deepaccident_devkit.release.store.paths import (
    REMEDY,
    Dataroot,
    FolderEntry,
    ReleasePath,
    StorePath,
    checksums_compared,
    fetched,
    folder_entries,
    is_folder,
    leads_back,
    places_of,
    read_content,
    read_lines,
    real_path,
)

__all__ = [
    "INDEX_FOLDER",
    "REMEDY",
    "Dataroot",
    "FolderEntry",
    "ReleasePath",
    "StorePath",
    "checksums_compared",
    "fetched",
    "folder_entries",
    "index_places",
    "is_folder",
    "leads_back",
    "list_files_in",
    "open_dataroot",
    "places_of",
    "read_content",
    "read_lines",
    "real_path",
    "refused_archives",
]
