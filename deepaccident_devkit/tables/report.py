"""What indexes a release has on disk: the text behind `deepaccident info --index`."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from deepaccident_devkit.arrays import ShortRepr
from deepaccident_devkit.errors import DatarootError, IndexStoreError, VersionError
from deepaccident_devkit.release import ReleaseLayout, find_release
from deepaccident_devkit.release.store import Dataroot, open_dataroot
from deepaccident_devkit.reports import Report
from deepaccident_devkit.tables.clearing import holds_index, megabytes, sizes_in
from deepaccident_devkit.tables.index import Index, index_folders, is_current
from deepaccident_devkit.tables.indexing import SHARDS_FOLDER, edited_scenarios, is_unfinished
from deepaccident_devkit.tables.manifest import (
    MANIFEST_FILE,
    SCHEMA_VERSION,
    TABLES_PREFIX,
    read_manifest,
    stored_schema_version,
)
from deepaccident_devkit.tables.scan import folder_digest
from deepaccident_devkit.tables.specs import table_specs
from deepaccident_devkit.tables.store import StoredTable
from deepaccident_devkit.taxonomy import VERSIONS

IndexState = Literal[
    "up to date", "out of date", "unfinished", "a newer devkit's", "an older devkit's", "unreadable", "no release"
]
_NAMED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexInfo(ShortRepr):
    """An index on disk.

    Attributes:
        folder: where it lies.
        version: of the release.
        state: `up to date`; `out of date`, `unfinished`, `an older devkit's` and `unreadable` are remade when the
            release is opened; `a newer devkit's` is refused; `no release`: the dataroot has none of this version.
        schema_version: its manifest's, None if there is none.
        devkit_schema_version: this devkit's.
        tables_bytes: size of the tables on disk.
        shards_bytes: size of the scenarios' shards.
        total_bytes: size of the whole folder.
        tables: table → rows; empty where they cannot be read.
        left_out: broken scenario → what is wrong with it.
        notices: what else was left aside.
        edited: the scenarios whose files are not those it was made from; None if they were not compared.
    """

    folder: str
    version: str
    state: IndexState
    schema_version: int | None
    devkit_schema_version: int = SCHEMA_VERSION
    tables_bytes: int
    shards_bytes: int
    total_bytes: int
    tables: Mapping[str, int] = field(default_factory=dict)
    left_out: Mapping[str, Sequence[str]] = field(default_factory=dict)
    notices: Sequence[str] = ()
    edited: Sequence[str] | None = None

    @property
    def scenarios(self) -> int:
        """How many scenarios it was made from."""
        return self.tables.get("scenario", 0)

    def to_text(self) -> str:
        """Some lines for a terminal."""
        sizes = f"tables {megabytes(self.tables_bytes)}, shards {megabytes(self.shards_bytes)}"
        lines = [
            f"{self.folder}: {self.state}",
            f"  release    {self.version}, {self.scenarios} scenarios, {len(self.left_out)} left out",
            f"  files      {self._files()}",
            f"  size       {megabytes(self.total_bytes)} ({sizes})",
            f"  schema     {self.schema_version} (this devkit's: {self.devkit_schema_version})",
            *(f"  {name:<20}{rows:>14,} rows" for name, rows in self.tables.items()),
        ]
        for token, messages in self.left_out.items():
            lines += [f"  left out: {token}", *(f"    {message}" for message in messages[:_NAMED])]
            lines += [f"    … and {len(messages) - _NAMED} more"] if len(messages) > _NAMED else []
        return "\n".join([*lines, *(f"  {notice}" for notice in self.notices)])

    def _files(self) -> str:
        if self.edited is None:
            return "not compared; --check does"
        if not self.edited:
            return "compared: no scenario was edited"
        more = f" and {len(self.edited) - _NAMED} more" if len(self.edited) > _NAMED else ""
        return f"{len(self.edited)} scenarios were edited: {', '.join(self.edited[:_NAMED])}{more}"


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexReport(Report):
    """The indexes of one dataroot.

    Attributes:
        dataroot: the release's folder.
        indexes: the first choice first.
        looked_in: the folders where one could be.
    """

    dataroot: str
    indexes: Sequence[IndexInfo]
    looked_in: Sequence[str]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "indexes": [{**asdict(info), "scenarios": info.scenarios} for info in self.indexes]}

    def to_text(self) -> str:
        """Some lines an index for a terminal."""
        none = "\n".join([f"{self.dataroot}: no index; looked in", *(f"  {folder}" for folder in self.looked_in)])
        return "\n\n".join(info.to_text() for info in self.indexes) or none


def index_report(
    dataroot: Dataroot, *, version: str | None = None, index_dir: Path | None = None, check_files: bool = False
) -> IndexReport:
    """Look at the indexes of a dataroot, in its own folder and in the user's cache; changes none.

    Args:
        dataroot: the release, as of `DeepAccident`.
        version: whose indexes; None looks for every version's.
        index_dir: the only place to look in, where given.
        check_files: compare the content of every label, calib and meta file, and of the tables, with the index.

    Raises:
        DatarootError: the folder is missing, or holds neither a release nor an index.
        VersionError: the version is unknown.
        SplitFileError: a split file cannot be read; with `check_files` alone.
    """
    infos, looked_in, missing = [], [], []
    versions = VERSIONS if version is None else (version,)
    for each in versions:
        try:
            layout: ReleaseLayout | None = find_release(open_dataroot(dataroot, index_dir), each)
        except (DatarootError, VersionError) as error:
            layout = None
            missing.append(error)
        for folder in index_folders(dataroot, each, index_dir):
            looked_in.append(str(folder))
            if holds_index(folder):
                infos.append(_info(folder, each, layout, check_files=check_files))
    if not infos and len(missing) == len(versions):
        raise missing[0]
    return IndexReport(dataroot=str(dataroot), indexes=infos, looked_in=looked_in)


def _info(folder: Path, version: str, layout: ReleaseLayout | None, *, check_files: bool) -> IndexInfo:
    manifest = read_manifest(folder)
    sizes = sizes_in(folder)
    index = Index(folder=folder, manifest=manifest) if manifest else None
    state = _state(folder, index, layout)
    edited = None
    if check_files and index and layout:
        edited, joined = edited_scenarios(layout, folder, index.manifest)
        state = "out of date" if state == "up to date" and (edited or not joined) else state
    return IndexInfo(
        folder=str(folder),
        version=version,
        state=state,
        schema_version=stored_schema_version(folder),
        tables_bytes=sum(size for path, size in sizes.items() if path.parts[0].startswith(TABLES_PREFIX)),
        shards_bytes=sum(size for path, size in sizes.items() if path.parts[0] == SHARDS_FOLDER),
        total_bytes=sum(sizes.values()),
        tables=_rows(index) if index else {},
        left_out={problem.scenario: problem.messages for problem in manifest.problems} if manifest else {},
        notices=manifest.notices if manifest else (),
        edited=edited,
    )


def _state(folder: Path, index: Index | None, layout: ReleaseLayout | None) -> IndexState:
    if index is None:
        stored = stored_schema_version(folder)
        if stored is not None and stored != SCHEMA_VERSION:
            return "a newer devkit's" if stored > SCHEMA_VERSION else "an older devkit's"
        return "unreadable" if (folder / MANIFEST_FILE).exists() else "unfinished"
    if layout is None:
        return "no release"
    if not is_current(layout, index, folder_digest(layout.scenarios, layout.split_files.values())):
        return "out of date"
    return "unfinished" if is_unfinished(folder) else "up to date"


def _rows(index: Index) -> dict[str, int]:
    try:
        return {name: StoredTable(index.tables_folder, spec).num_rows for name, spec in table_specs().items()}
    except IndexStoreError:
        return {}
