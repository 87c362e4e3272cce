"""The opened tables: `Table` returns rows as fresh records, `OpenTables` holds all tables."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, NoReturn, TypeVar, cast, get_args, overload

import numpy as np

from deepaccident_devkit.errors import (
    ChoiceError,
    FieldError,
    IndexStoreError,
    NotAvailableError,
    TableError,
    TokenError,
)
from deepaccident_devkit.release import read_split_file
from deepaccident_devkit.release.fingerprints import ScenarioHashes
from deepaccident_devkit.release.store import ReleasePath, places_of
from deepaccident_devkit.support.arrays import checked_number
from deepaccident_devkit.support.json_text import as_record, parsed_json
from deepaccident_devkit.support.nuscenes_names import field_remedy, with_keywords_named
from deepaccident_devkit.support.text import choice, meant_text, members_of, path_of, spelled
from deepaccident_devkit.tables.arrow_files import (
    DAMAGED_INDEX_REMEDY,
    HASHES,
    StoredTable,
    damaged_value,
)
from deepaccident_devkit.tables.columns import (
    NULL_INTEGER,
    Choice,
    Column,
    Key,
    Number,
    Subset,
    Vector,
)
from deepaccident_devkit.tables.index import Problem
from deepaccident_devkit.tables.records import table_spec, table_specs
from deepaccident_devkit.tables.tokens import ColumnViews, Resolver
from deepaccident_devkit.taxonomy import AGENTS, FRAME_PERIOD, MINI_SPLITS, SPLIT_CHOICES, OnError

if TYPE_CHECKING:
    from deepaccident_devkit.tables import records

_Record = TypeVar("_Record")
_Getter = Callable[[int], Any]
# Difference between a time and its frame, in frames.
_FRAME_TOLERANCE: Final = 1e-6
RowArgument = str | Mapping[str, Any]
"""A row as callers name it: by its token, or by its record."""


class OpenTables:
    """One release's tables: records by row and token, columns, splits.

    Attributes:
        dataroot: Folder of the release.
        version: `v1` or `v1-mini`.
        layout: Arrangement of the release on disk: `A`, `B` or `A+B` (docs/format.md, Tree).
        problems: Broken scenarios that were left out (`on_error='skip'`).
    """

    dataroot: ReleasePath
    version: str
    layout: str
    problems: tuple[Problem, ...]

    def __init__(
        self,
        *,
        dataroot: ReleasePath,
        version: str,
        layout: str,
        split_files: Mapping[str, ReleasePath],
        tables_folder: Path,
        problems: tuple[Problem, ...] = (),
        tables: Tables | None = None,
    ) -> None:
        """Open the tables of an index, or use opened ones; raises IndexStoreError."""
        self.dataroot = dataroot
        self.version = version
        self.layout = layout
        self.problems = problems
        self._split_files = dict(split_files)
        self._tables = tables or Tables(tables_folder)

    def __repr__(self) -> str:
        """Return kind, version and dataroot."""
        return f"{type(self).__name__}({self.version!r}, {str(self.dataroot)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle paths, not tables: the copy opens the same files again."""
        arguments = {
            "dataroot": self.dataroot,
            "version": self.version,
            "layout": self.layout,
            "split_files": self._split_files,
            "tables_folder": self.tables_folder,
            "problems": self.problems,
        }
        return _reopen, (type(self), arguments)

    @property
    def places(self) -> tuple[Path, ...]:
        """Folders that a worker on another host needs: those of the release and of its tables."""
        return *places_of(self.dataroot), self._tables.folder

    @property
    def tables_folder(self) -> Path:
        """The folder of the index's tables."""
        return self._tables.folder

    @property
    def table_names(self) -> list[str]:
        """The names of the tables."""
        return table_names()

    @property
    def scenario(self) -> Table[records.ScenarioRecord]:
        """Recordings."""
        return self._tables.table("scenario")

    @property
    def agent(self) -> Table[records.AgentRecord]:
        """Recorders of each scenario."""
        return self._tables.table("agent")

    @property
    def frame(self) -> Table[records.FrameRecord]:
        """Moments of each scenario."""
        return self._tables.table("frame")

    @property
    def sample(self) -> Table[records.SampleRecord]:
        """Agents at moments."""
        return self._tables.table("sample")

    @property
    def sample_data(self) -> Table[records.SampleDataRecord]:
        """Sensor files."""
        return self._tables.table("sample_data")

    @property
    def sensor(self) -> Table[records.SensorRecord]:
        """Kinds of sensors."""
        return self._tables.table("sensor")

    @property
    def calibrated_sensor(self) -> Table[records.CalibratedSensorRecord]:
        """Sensors on agents."""
        return self._tables.table("calibrated_sensor")

    @property
    def ego_pose(self) -> Table[records.EgoPoseRecord]:
        """Poses of agents."""
        return self._tables.table("ego_pose")

    @property
    def instance(self) -> Table[records.InstanceRecord]:
        """Actors of each scenario."""
        return self._tables.table("instance")

    @property
    def annotation(self) -> Table[records.AnnotationRecord]:
        """Boxes."""
        return self._tables.table("annotation")

    @property
    def track(self) -> Table[records.TrackRecord]:
        """Actors at moments, in world."""
        return self._tables.table("track")

    @property
    def category(self) -> Table[records.CategoryRecord]:
        """Classes of road users."""
        return self._tables.table("category")

    def indexed_hashes(self, scenario: str) -> ScenarioHashes | None:
        """Return the hashes of the files that a scenario's rows were made from; None if unknown.

        Raises:
            IndexStoreError: The table with the hashes is damaged.
        """
        return self._tables.hashes.get(scenario)

    @with_keywords_named
    def get(self, table: str, token: RowArgument) -> dict[str, Any]:
        """Return the record of a token, as a fresh dict; raises TableError or TokenError."""
        record: dict[str, Any] = self._tables.table(table).get(token_of(token))
        return record

    @with_keywords_named
    def getind(self, table: str, token: RowArgument) -> int:
        """Return the row of a token; raises TableError or TokenError."""
        return self._tables.table(table).row(token_of(token))

    @with_keywords_named
    def field2token(self, table: str, field: str, query: Any) -> list[str]:
        """Return the tokens of all rows with a field equal to `query`, in order.

        Raises TableError or FieldError.
        """
        return self._tables.table(table).tokens_where(field, query)

    def arrow(self, table: str) -> Any:
        """Return a table as `pyarrow.Table`, without copying.

        Its `…_row` columns hold row numbers instead of tokens.
        """
        return self._tables.table(table).arrow

    def columns(self, table: str) -> Mapping[str, Any]:
        """Return a table's stored columns by name as read-only arrays; raises TableError.

        Nothing is copied. Numbers are numpy views (row keys, choices as codes, null as −1 or NaN),
        words Arrow arrays.
        """
        return self._tables.views[self._tables.table(table).name]

    def get_sample(
        self,
        scenario: RowArgument,
        agent: str,
        frame: int | None = None,
        *,
        time_to_impact: float | None = None,
    ) -> records.SampleRecord:
        """Return the sample of an agent at a moment of a scenario.

        Args:
            scenario: Token or record.
            agent: Name of the agent.
            frame: Number of the frame, from 1.
            time_to_impact: Seconds before the impact, which is the last frame, as an alternative to
                `frame`; a multiple of 0.1.

        Raises:
            TokenError: The release has no such scenario, agent or frame; or not exactly one of
                `frame` and `time_to_impact` is given.
            NotAvailableError: The scenario has no collision, so that no impact is known.
        """
        if time_to_impact is not None and frame is None:
            frame = self._frame_before_impact(scenario, time_to_impact)
        elif time_to_impact is not None or not isinstance(frame, int | np.integer):
            raise TokenError(
                f"frame: expected a number from 1, found {frame!r}; or give time_to_impact= instead"
            )
        return self.sample.get(f"{token_of(scenario)}/{spelled(agent, AGENTS)}/{frame:03d}")

    def _frame_before_impact(self, scenario: RowArgument, seconds: float) -> int:
        record = self.scenario.get(token_of(scenario))
        if record["collision"] is None:
            raise NotAvailableError(
                f"{record['token']}: has no collision by its meta file; give frame= instead"
            )
        steps = checked_number("time_to_impact", seconds, "seconds", TokenError) / FRAME_PERIOD
        frames = round(steps) if np.isfinite(steps) else -1
        if not 0 <= frames < record["num_frames"] or abs(steps - frames) > _FRAME_TOLERANCE:
            longest = (record["num_frames"] - 1) / 10
            raise TokenError(
                f"time_to_impact: expected 0, 0.1, 0.2, … up to {longest} s, found {seconds}"
            )
        return record["num_frames"] - frames

    def samples_of(self, frame: RowArgument) -> list[records.SampleRecord]:
        """Return the samples of one moment, one for each agent, in the order of `AGENTS`."""
        record = self.frame[self.frame.row(token_of(frame))]
        resolver = self._tables.resolver
        agents = resolver.agents_of(self.scenario.row(record["scenario_token"])).values()
        return [self.sample[resolver.sample_at(agent, record["index"])] for agent in agents]

    def split_scenarios(
        self, split: str | os.PathLike[str], *, missing: OnError = "raise"
    ) -> set[str]:
        """Return the tokens of this release's scenarios that belong to a split.

        Args:
            split: `train`, `val`, `test`, `train_mini` or `val_mini`, or `all` for every scenario
                of the release. Or a split file of your own, as a path object or a text that ends in
                `.txt`: blank lines, CRLF and a byte order mark are fine, the same scenario in two
                lines is a fault.
            missing: Treatment of a file's scenarios that are not in this release: `raise`, or
                `skip` them.

        Raises:
            ChoiceError: The split is unknown, or `missing` is neither `raise` nor `skip`.
            NotAvailableError: The splits are unknown: there are no split files and no split
                folders; or scenarios of your file are not in this release.
            MissingFileError: Your file does not exist.
            SplitFileError: Your file is no split file: a line has not two words, or a scenario
                occurs twice.
        """
        missing = choice("missing", missing, get_args(OnError))
        if not isinstance(split, str | os.PathLike):
            raise ChoiceError(
                f"split: expected the name of one, or the path of a split file, found {split!r}"
            )
        if not isinstance(split, str) or split.endswith(".txt"):
            return self._listed_scenarios(path_of(split), missing)
        own_split = self._own_split_text().removeprefix("or ")
        remedy = f"; for scenarios whose split is unknown {own_split}"
        split = split_choice(split, elsewhere={"unknown": remedy})
        tokens = set(self._tables.resolver.scenario_tokens)
        if split == "all":
            return tokens
        if split in MINI_SPLITS:
            if split not in self._split_files:
                raise NotAvailableError(
                    f"{self.dataroot}: has no {split}.txt; put the release's split files there, "
                    f"{self._own_split_text()}"
                )
            return tokens.intersection(read_split_file(self._split_files[split]))
        if (self._tables.views["scenario"]["split"] < 0).all():
            raise NotAvailableError(
                f"{self.dataroot}: the split of its scenarios is unknown: it has neither split "
                f"files ({split}.txt) nor split folders ({split}/); put the release's split files "
                f"into it, {self._own_split_text()}"
            )
        return set(self.scenario.tokens_where("split", split))

    def _listed_scenarios(self, path: Path, missing: OnError) -> set[str]:
        """Return the scenarios of this release in a split file of the user."""
        tokens = set(self._tables.resolver.scenario_tokens)
        listed = read_split_file(path, unique=True)
        absent = [token for token in listed if token not in tokens]
        if absent and missing == "raise":
            more = ", …" if len(absent) > 3 else ""
            raise NotAvailableError(
                f"{path}: {len(absent)} of its {len(listed)} scenarios are not in {self.dataroot}: "
                f"{', '.join(absent[:3])}{more}; pass missing='skip' to go without them"
            )
        return tokens.intersection(listed)

    def _own_split_text(self) -> str:
        dataroot = shlex.quote(str(self.dataroot))
        command = f"deepaccident split {dataroot} --out mine.txt"
        return f"or make a split file of your own: {command}, then --split mine.txt"


class Tables:
    """All tables of an index, memory-mapped: readable even if another process remakes the index."""

    def __init__(
        self, folder: Path, resolver: Callable[[ColumnViews], Resolver] = Resolver
    ) -> None:
        """Open the tables in `folder`; raises IndexStoreError if they cannot be read.

        Args:
            folder: Folder with one Arrow file per table.
            resolver: Makes the resolver of rows, tokens and files; other datasets name their files
                differently.
        """
        self.folder = folder
        self._stored = {name: StoredTable(folder, spec) for name, spec in table_specs().items()}
        self._tables: dict[str, Table[Any]] = {}
        self.views = {name: stored.views for name, stored in self._stored.items()}
        try:
            self.resolver = resolver(self.views)
        except (IndexError, TypeError, ValueError) as error:
            raise IndexStoreError(
                f"{folder}: its scenarios and agents do not fit together; {DAMAGED_INDEX_REMEDY}"
            ) from error

    def __repr__(self) -> str:
        return f"Tables({str(self.folder)!r})"

    @cached_property
    def hashes(self) -> dict[str, ScenarioHashes]:
        """Hashes of the files that each scenario's rows were made from, by token.

        Raises IndexStoreError.
        """
        words = self._stored["scenario"].words.get(HASHES, "{}")
        try:
            return as_record(parsed_json(words.encode()), dict[str, ScenarioHashes])
        except ValueError as error:
            raise IndexStoreError(
                f"{self.folder}: the hashes of its files are damaged; {DAMAGED_INDEX_REMEDY}"
            ) from error

    def table(self, name: str) -> Table[Any]:
        """Return a table; raises TableError."""
        try:
            return self._tables[name]
        except KeyError:
            # `name` may be spelt otherwise than the table.
            table_name = table_spec(name).name
            if table_name not in self._tables:
                self._tables[table_name] = Table(self._stored[table_name], self.resolver)
            return self._tables[table_name]


class Table(Sequence[_Record], Generic[_Record]):
    """The rows of a table; each access makes a fresh dict, which belongs to the caller.

    Attributes:
        name: Name of the table.
    """

    def __init__(self, stored: StoredTable, resolver: Resolver) -> None:
        """Make the functions that read a stored table's fields."""
        self.name = stored.spec.name
        self._stored = stored
        self._resolver = resolver
        self._getters = [(column.field, self._getter(column)) for column in stored.spec.columns]

    @property
    def arrow(self) -> Any:
        """The table as a `pyarrow.Table` over the mapped memory, with row keys instead of tokens.

        Raises IndexStoreError if the file is so damaged that Arrow would read beyond its memory.
        """
        return self._stored.table

    def __len__(self) -> int:
        return self._stored.num_rows

    @overload
    def __getitem__(self, row: int) -> _Record: ...
    @overload
    def __getitem__(self, row: slice) -> list[_Record]: ...
    def __getitem__(self, row: int | slice) -> _Record | list[_Record]:
        """Return the record of a row, or the records of a slice."""
        if isinstance(row, slice):
            return [self._record(index) for index in range(*row.indices(len(self)))]
        if not isinstance(row, int | np.integer):
            raise TableError(
                f"table '{self.name}' counts its rows: expected a number, found {row!r}; "
                "use get(token)"
            )
        index = row + len(self) if row < 0 else row
        if not 0 <= index < len(self):
            raise IndexError(f"table '{self.name}' has {len(self)} rows, asked for row {row}")
        return self._record(index)

    def __iter__(self) -> Iterator[_Record]:
        return (self._record(row) for row in range(len(self)))

    def __repr__(self) -> str:
        fields = ", ".join(field for field, _ in self._getters)
        return f"<table '{self.name}': {len(self):,} rows of {fields}>"

    def get(self, token: str) -> _Record:
        """Return the record of a token; raises TokenError."""
        return self._record(self.row(token))

    def row(self, token: str) -> int:
        """Return the row of a token; raises TokenError."""
        return self._resolver.row(self.name, token)

    def tokens_where(self, field: str, value: Any) -> list[str]:
        """Return the tokens of the rows with a field equal to `value`, in order.

        Raises FieldError.
        """
        try:
            rows = self._rows_where(field, value)
            return [self._resolver.token(self.name, int(row)) for row in rows]
        except IndexError as error:
            raise damaged_value(self.name) from error

    def _record(self, row: int) -> _Record:
        try:
            values = {field: getter(row) for field, getter in self._getters}
            return cast(_Record, RecordDict(values))
        except IndexError as error:
            raise damaged_value(self.name) from error

    def _rows_where(self, field: str, value: Any) -> Sequence[int]:
        column = self._stored.spec.column(field)
        if column is None:
            fields = [name for name, _ in self._getters]
            suggestion = meant_text(field, fields)
            raise FieldError(
                f"table '{self.name}' has no field '{field}'; it has {', '.join(fields)}"
                f"{suggestion}"
            )
        stored_value = self._stored_value(column, value)
        view = self._stored.views.get(column.stored or "")
        if stored_value is not None and isinstance(view, np.ndarray):
            return np.flatnonzero(view == stored_value).tolist()
        getter = dict(self._getters)[field]
        return [row for row in range(len(self)) if getter(row) == value]

    def _stored_value(self, column: Column, value: Any) -> Any:
        """Return the stored form of `value`; None if rows must be compared one by one."""
        kind = column.kind
        if isinstance(kind, Key) and isinstance(value, str):
            try:
                return self._resolver.row(kind.table, value)
            except TokenError:
                return NULL_INTEGER - 1
        if isinstance(kind, Choice) and isinstance(value, str):
            word = spelled(value, kind.values)
            return kind.values.index(word) if word in kind.values else NULL_INTEGER - 1
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not isinstance(kind, Number) or not is_number:
            return None
        return None if column.nullable and value == NULL_INTEGER else value

    def _getter(self, column: Column) -> _Getter:  # noqa: PLR0911 - one a kind
        if column.stored is None:
            if column.field == "filename":
                return self._resolver.filename
            return self._resolver.token_makers[self.name]
        view: Any = self._stored.views[column.stored]
        match column.kind:
            case Key(table=table):
                make_token = self._resolver.token_makers[table]
                return _key_getter(view, make_token, nullable=column.nullable)
            case Choice(values=values):
                return _choice_getter(view, values)
            case Subset(values=values):
                return _subset_getter(view, values)
            case Vector(shape=shape):
                return _vector_getter(view, shape, nullable=column.nullable)
            case Number(dtype=dtype):
                return _number_getter(view, dtype, nullable=column.nullable)
            case _:
                return lambda row: view[row].as_py()


class RecordDict(dict[str, Any]):
    """A record: a dict that suggests a field for an unknown one. Its copies are plain dicts."""

    __slots__ = ()

    def __missing__(self, field: object) -> NoReturn:
        remedy = field_remedy(field) or f"; it has {', '.join(self)}{meant_text(field, self)}"
        raise FieldError(f"the record has no field {field!r}{remedy}")

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)


def table_names() -> list[str]:
    """Return the names of all tables."""
    return list(table_specs())


def split_choice(split: str, **remedies: Any) -> str:
    """Return the name of a split in its own spelling; raises ChoiceError.

    `remedies` are arguments of `choice`.
    """
    return choice(
        "split", split, SPLIT_CHOICES, also=", or a split file (its name ends in .txt)", **remedies
    )


def token_of(row: RowArgument) -> str:
    """Return the token of a row that is named by token or record; raises TokenError."""
    token = row.get("token") if isinstance(row, Mapping) else row
    if not isinstance(token, str):
        raise TokenError(f"expected a token or a record with one, found {row!r}")
    return token


def rows_of_scenarios(
    tables: OpenTables, scenarios: RowArgument | Iterable[RowArgument] | None
) -> Sequence[int]:
    """Return the rows of scenarios in their order, or of all for None.

    Raises TokenError or ChoiceError.
    """
    if scenarios is None:
        return range(len(tables.scenario))
    members = members_of("scenarios", scenarios, "tokens or records of scenarios")
    return [tables.getind("scenario", scenario) for scenario in members]


def _reopen(kind: type[OpenTables], arguments: dict[str, Any]) -> OpenTables:
    """Undo `OpenTables.__reduce__`, without looking for changes on disk.

    A worker gets a dataset with each item: it opens the files once, which takes as long as a
    sample's labels.
    """
    dataset = kind.__new__(kind)
    folder = arguments["tables_folder"]
    tables = _tables_of(folder, folder.stat().st_ino) if folder.is_dir() else None
    OpenTables.__init__(dataset, **arguments, tables=tables)
    return dataset


@lru_cache(maxsize=2)
def _tables_of(folder: Path, _number: int) -> Tables:
    """Return the tables in a folder.

    The system's number of the folder distinguishes it from a later folder with the same path.
    """
    return Tables(folder)


def _key_getter(view: Any, token_of: Callable[[int], str], *, nullable: bool) -> _Getter:
    item = view.item
    if not nullable:
        return lambda row: token_of(item(row))

    def get(row: int) -> str | None:
        target = item(row)
        if target == NULL_INTEGER:
            return None
        return token_of(target)

    return get


def _choice_getter(view: Any, values: Sequence[str]) -> _Getter:
    # Code −1 selects the last of these: None.
    words = (*values, None)
    item = view.item
    return lambda row: words[item(row)]


def _subset_getter(view: Any, values: Sequence[str]) -> _Getter:
    def get(row: int) -> list[str]:
        mask = view.item(row)
        return [value for bit, value in enumerate(values) if mask >> bit & 1]

    return get


def _vector_getter(view: Any, shape: tuple[int, ...], *, nullable: bool) -> _Getter:
    def get(row: int) -> Any:
        values = view[row]
        if nullable and np.isnan(values[0]):
            return None
        if len(shape) == 1:
            return values.tolist()
        return values.reshape(shape).tolist()

    return get


def _number_getter(view: Any, dtype: str, *, nullable: bool) -> _Getter:
    if dtype == "bool":
        return cast(_Getter, view.__getitem__)
    item = view.item
    if not nullable:
        return cast(_Getter, item)

    def get(row: int) -> Any:
        value = item(row)
        return None if value == NULL_INTEGER or value != value else value  # noqa: PLR0124 - NaN

    return get
