"""The opened tables: `Table` returns rows as fresh records, `OpenTables` holds all tables."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeVar, cast, get_args, overload

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
from deepaccident_devkit.support.text import (
    PathType,
    choice,
    counted,
    match_spelling,
    meant_text,
    members_of,
    path_of,
)
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
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
# Largest difference between a time and a frame, in frames.
_FRAME_TOLERANCE = 1e-6
RowArgument = str | ReadOnlyValues
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
        """Open an index's tables, or use open ones; raise IndexStoreError if they are damaged."""
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
        """Pickle paths instead of tables: the copy opens the same files again."""
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
        """Folders that a worker on another host needs: the release's and its tables'."""
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
            IndexStoreError: If the table with the hashes is damaged.
        """
        return self._tables.hashes.get(scenario)

    @with_keywords_named
    def get(self, table: str, token: RowArgument) -> dict[str, Any]:
        """Return a record as a new dict; raise TableError or TokenError if the name is unknown."""
        record: NamedValues = self._tables.table(table).get(token_of(token))
        return record

    @with_keywords_named
    def getind(self, table: str, token: RowArgument) -> int:
        """Return the row with a token; raise TableError or TokenError if the name is unknown."""
        return self._tables.table(table).row(token_of(token))

    @with_keywords_named
    def field2token(self, table: str, field: str, query: Any) -> list[str]:
        """Return the tokens of all rows whose `field` equals `query`, in order.

        TableError or
        FieldError is raised if the table or the field is unknown.
        """
        return self._tables.table(table).tokens_where(field, query)

    def arrow(self, table: str) -> Any:
        """Return a table as a `pyarrow.Table`, without copying it.

        Its `…_row` columns hold row numbers instead of tokens.
        """
        return self._tables.table(table).arrow

    def columns(self, table: str) -> Mapping[str, Any]:
        """Return stored column name → read-only array; raise TableError if the table is unknown.

        Nothing is copied. Numbers are numpy views: keys are row numbers, choices are codes, and
        null is −1 or NaN. Words are Arrow arrays.
        """
        name = self._tables.table(table).name
        return self._tables.views[name]

    def get_sample(
        self,
        scenario: RowArgument,
        agent: str,
        frame: int | None = None,
        *,
        time_to_impact: float | None = None,
    ) -> records.SampleRecord:
        """Return an agent's sample in a frame of a scenario.

        Args:
            scenario: Token or record.
            agent: Name of the agent.
            frame: Number of the frame, from 1.
            time_to_impact: Alternative to `frame`: seconds before the impact, which is the last
                frame; a multiple of 0.1.

        Raises:
            TokenError: If the release has no such scenario, agent or frame; or if not exactly one
                of `frame` and `time_to_impact` is passed.
            NotAvailableError: If the scenario has no collision, so that no impact is known.
        """
        if time_to_impact is not None and frame is None:
            frame = self._find_frame_before_impact(scenario, time_to_impact)
        elif time_to_impact is not None or not isinstance(frame, int | np.integer):
            raise TokenError(
                f"frame: expected a number from 1, found {frame!r}; or pass time_to_impact= instead"
            )
        agent_name = match_spelling(agent, AGENTS)
        return self.sample.get(f"{token_of(scenario)}/{agent_name}/{frame:03d}")

    def _find_frame_before_impact(self, scenario: RowArgument, seconds: float) -> int:
        record = self.scenario.get(token_of(scenario))
        if record["collision"] is None:
            raise NotAvailableError(
                f"{record['token']}: its meta file names no collision; pass frame= instead"
            )
        num_frames = record["num_frames"]
        steps = checked_number("time_to_impact", seconds, "seconds", TokenError) / FRAME_PERIOD
        frames_before = round(steps) if np.isfinite(steps) else -1
        is_between_frames = abs(steps - frames_before) > _FRAME_TOLERANCE
        if not 0 <= frames_before < num_frames or is_between_frames:
            longest_time = (num_frames - 1) / 10
            raise TokenError(
                f"time_to_impact: expected 0, 0.1, 0.2, … up to {longest_time} s, found {seconds}"
            )
        return num_frames - frames_before

    def samples_of(self, frame: RowArgument) -> list[records.SampleRecord]:
        """Return all agents' samples of a frame, in the order of `AGENTS`."""
        record = self.frame.get(token_of(frame))
        resolver = self._tables.resolver
        scenario_row = self.scenario.row(record["scenario_token"])
        agents = resolver.agents_of(scenario_row).values()
        rows = [resolver.sample_at(agent, record["index"]) for agent in agents]
        return [self.sample[row] for row in rows]

    def split_scenarios(self, split: PathType, *, missing: OnError = "raise") -> set[str]:
        """Return the tokens of this release's scenarios that belong to a split.

        Args:
            split: `train`, `val`, `test`, `train_mini` or `val_mini`, or `all` for every scenario
                of the release. Or your own split file, as a path object or a text that ends in
                `.txt`. Blank lines, CRLF and a byte order mark are allowed; a scenario in two lines
                is an error.
            missing: What to do about listed scenarios that are not in this release: `raise`, or
                `skip` them.

        Raises:
            ChoiceError: If the split is unknown, or `missing` is neither `raise` nor `skip`.
            NotAvailableError: If the splits are unknown because there are no split files and no
                split folders; or if scenarios of your file are not in this release.
            MissingFileError: If your file does not exist.
            SplitFileError: If a line of your file does not have two words, or if a scenario occurs
                twice.
        """
        missing = choice("missing", missing, get_args(OnError))
        if not isinstance(split, str | os.PathLike):
            raise ChoiceError(
                f"split: expected the name of a split, or the path of a split file, found {split!r}"
            )
        if not isinstance(split, str) or split.endswith(".txt"):
            return self._read_listed_scenarios(path_of(split), missing)
        own_split = self._describe_own_split().removeprefix("or ")
        remedy = f"; for scenarios of an unknown split, {own_split}"
        split = split_choice(split, elsewhere={"unknown": remedy})
        tokens = set(self._tables.resolver.scenario_tokens)
        if split == "all":
            return tokens
        if split in MINI_SPLITS:
            if split not in self._split_files:
                raise NotAvailableError(
                    f"{self.dataroot}: has no {split}.txt; put the release's split files there, "
                    f"{self._describe_own_split()}"
                )
            return tokens.intersection(read_split_file(self._split_files[split]))
        if (self._tables.views["scenario"]["split"] < 0).all():
            raise NotAvailableError(
                f"{self.dataroot}: the splits of the scenarios are unknown, as there are neither "
                f"split files ({split}.txt) nor split folders ({split}/); put the release's split "
                f"files there, {self._describe_own_split()}"
            )
        return set(self.scenario.tokens_where("split", split))

    def _read_listed_scenarios(self, path: Path, missing: OnError) -> set[str]:
        """Return the scenarios of this release that a user's split file lists."""
        tokens = set(self._tables.resolver.scenario_tokens)
        listed_tokens = read_split_file(path, unique=True)
        absent_tokens = [token for token in listed_tokens if token not in tokens]
        if absent_tokens and missing == "raise":
            examples = ", ".join(absent_tokens[:3])
            if len(absent_tokens) > 3:
                examples += ", …"
            raise NotAvailableError(
                f"{path}: {len(absent_tokens)} of its {len(listed_tokens)} scenarios are not in "
                f"{self.dataroot}: {examples}; pass missing='skip' to ignore them"
            )
        return tokens.intersection(listed_tokens)

    def _describe_own_split(self) -> str:
        dataroot = shlex.quote(str(self.dataroot))
        command = f"deepaccident split {dataroot} --out mine.txt"
        return f"or make a split file of your own: {command}, then --split mine.txt"


class Tables:
    """All tables of an index, memory-mapped: readable even after another process rebuilds it."""

    def __init__(
        self, folder: Path, resolver: Callable[[ColumnViews], Resolver] = Resolver
    ) -> None:
        """Open the tables in `folder`; raise IndexStoreError if they cannot be read.

        Args:
            folder: Folder with one Arrow file per table.
            resolver: Function that makes the `Resolver` of rows, tokens and files; other datasets
                pass their own, because they name files differently.
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

        IndexStoreError is raised if the table with the hashes is damaged.
        """
        words = self._stored["scenario"].words.get(HASHES, "{}")
        try:
            return as_record(parsed_json(words.encode()), dict[str, ScenarioHashes])
        except ValueError as error:
            raise IndexStoreError(
                f"{self.folder}: the hashes of its files are damaged; {DAMAGED_INDEX_REMEDY}"
            ) from error

    def table(self, name: str) -> Table[Any]:
        """Return a table; raise TableError if its name is unknown."""
        try:
            return self._tables[name]
        except KeyError:
            # `name` may be in another case than the table's name.
            table_name = table_spec(name).name
            if table_name not in self._tables:
                self._tables[table_name] = Table(self._stored[table_name], self.resolver)
            return self._tables[table_name]


class Table(Sequence[_Record], Generic[_Record]):
    """The rows of a table; each access returns a new dict, which the caller may change.

    Attributes:
        name: Name of the table.
    """

    def __init__(self, stored: StoredTable, resolver: Resolver) -> None:
        """Prepare the functions that read a stored table's fields."""
        self.name = stored.spec.name
        self._stored = stored
        self._resolver = resolver
        self._getters = [
            (column.field, self._make_getter(column)) for column in stored.spec.columns
        ]

    @property
    def arrow(self) -> Any:
        """Table as a `pyarrow.Table` over the mapped memory, with row keys instead of tokens.

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
            return [self._make_record(index) for index in range(*row.indices(len(self)))]
        if not isinstance(row, int | np.integer):
            raise TableError(
                f"table '{self.name}' takes row numbers: expected a number, found {row!r}; "
                "use get(token) for a token"
            )
        index = row
        if row < 0:
            index = row + len(self)
        if not 0 <= index < len(self):
            rows = counted(len(self), "row")
            raise IndexError(f"table '{self.name}' has {rows}, asked for row {row}")
        return self._make_record(index)

    def __iter__(self) -> Iterator[_Record]:
        return map(self._make_record, range(len(self)))

    def __repr__(self) -> str:
        fields = ", ".join([field for field, _ in self._getters])
        return f"<table '{self.name}': {counted(len(self), 'row')} of {fields}>"

    def get(self, token: str) -> _Record:
        """Return the record with a token; raise TokenError if it is unknown."""
        return self._make_record(self.row(token))

    def row(self, token: str) -> int:
        """Return the row with a token; raise TokenError if it is unknown."""
        return self._resolver.row(self.name, token)

    def tokens_where(self, field: str, value: Any) -> list[str]:
        """Return the tokens of the rows whose `field` equals `value`, in order.

        FieldError is raised if the field is unknown.
        """
        try:
            rows = self._find_rows(field, value)
            return [self._resolver.token(self.name, int(row)) for row in rows]
        except IndexError as error:
            raise damaged_value(self.name) from error

    def _make_record(self, row: int) -> _Record:
        try:
            values = {field: getter(row) for field, getter in self._getters}
            return cast(_Record, RecordDict(values))
        except IndexError as error:
            raise damaged_value(self.name) from error

    def _find_rows(self, field: str, value: Any) -> Sequence[int]:
        column = self._stored.spec.column(field)
        if column is None:
            fields = [name for name, _ in self._getters]
            suggestion = meant_text(field, fields)
            raise FieldError(
                f"table '{self.name}' has no field '{field}'; it has {', '.join(fields)}"
                f"{suggestion}"
            )
        stored_value = self._encode_value(column, value)
        view = self._stored.views.get(column.stored or "")
        if stored_value is not None and isinstance(view, np.ndarray):
            return np.flatnonzero(view == stored_value).tolist()
        getter = dict(self._getters)[field]
        return [row for row in range(len(self)) if getter(row) == value]

    def _encode_value(self, column: Column, value: Any) -> Any:
        """Encode a field's value as it is stored; None if each record must be compared."""
        kind = column.kind
        if isinstance(kind, Key) and isinstance(value, str):
            try:
                return self._resolver.row(kind.table, value)
            except TokenError:
                return NULL_INTEGER - 1
        if isinstance(kind, Choice) and isinstance(value, str):
            word = match_spelling(value, kind.values)
            if word in kind.values:
                return kind.values.index(word)
            return NULL_INTEGER - 1
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        is_null = is_number and column.nullable and value == NULL_INTEGER
        if not isinstance(kind, Number) or not is_number or is_null:
            return None
        return value

    def _make_getter(self, column: Column) -> _Getter:  # noqa: PLR0911 - one a kind
        if column.stored is None:
            if column.field == "filename":
                return self._resolver.filename
            return self._resolver.token_makers[self.name]
        view: Any = self._stored.views[column.stored]
        match column.kind:
            case Key(table=table):
                make_token = self._resolver.token_makers[table]
                return _make_key_getter(view, make_token, nullable=column.nullable)
            case Choice(values=values):
                return _make_choice_getter(view, values)
            case Subset(values=values):
                return _make_subset_getter(view, values)
            case Vector(shape=shape):
                return _make_vector_getter(view, shape, nullable=column.nullable)
            case Number(dtype=dtype):
                return _make_number_getter(view, dtype, nullable=column.nullable)
            case _:
                return lambda row: view[row].as_py()


class RecordDict(dict[str, Any]):
    """A record: a dict that suggests a field for an unknown one. Its copies are plain dicts."""

    __slots__ = ()

    def __missing__(self, field: object) -> NoReturn:
        remedy = field_remedy(field)
        if not remedy:
            remedy = f"; it has {', '.join(self)}{meant_text(field, self)}"
        raise FieldError(f"the record has no field {field!r}{remedy}")

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)


def table_names() -> list[str]:
    """Return the names of all tables."""
    return list(table_specs())


def split_choice(split: str, **remedies: Any) -> str:
    """Return a split's name in canonical spelling; raise ChoiceError if it is unknown.

    `remedies` are further arguments of `choice`.
    """
    return choice(
        "split", split, SPLIT_CHOICES, also=", or a split file (its name ends in .txt)", **remedies
    )


def token_of(row: RowArgument) -> str:
    """Return the token in a token or record; raise TokenError if `row` is neither."""
    token = row.get("token") if isinstance(row, Mapping) else row
    if not isinstance(token, str):
        raise TokenError(f"expected a token or a record with one, found {row!r}")
    return token


def rows_of_scenarios(
    tables: OpenTables, scenarios: RowArgument | Iterable[RowArgument] | None
) -> Sequence[int]:
    """Return the rows of scenarios in the caller's order; None means all scenarios.

    TokenError is raised if a scenario is unknown, ChoiceError if the argument is no collection.
    """
    if scenarios is None:
        return range(len(tables.scenario))
    members = members_of("scenarios", scenarios, "tokens or records of scenarios")
    return [tables.getind("scenario", scenario) for scenario in members]


def _reopen(kind: type[OpenTables], arguments: NamedValues) -> OpenTables:
    """Make the copy that `OpenTables.__reduce__` describes, without looking for changes on disk.

    A worker receives a dataset with each item. It opens the files only once, because opening them
    takes as long as reading a sample's labels.
    """
    dataset = kind.__new__(kind)
    folder = arguments["tables_folder"]
    tables = None
    if folder.is_dir():
        tables = _open_tables(folder, folder.stat().st_ino)
    OpenTables.__init__(dataset, **arguments, tables=tables)
    return dataset


@lru_cache(maxsize=2)
def _open_tables(folder: Path, _number: int) -> Tables:
    """Return the tables in a folder.

    The system's number of the folder distinguishes it from a later folder with the same path.
    """
    return Tables(folder)


def _make_key_getter(view: Any, make_token: Callable[[int], str], *, nullable: bool) -> _Getter:
    item = view.item
    if not nullable:
        return lambda row: make_token(item(row))

    def get_token(row: int) -> str | None:
        target_row = item(row)
        if target_row == NULL_INTEGER:
            return None
        return make_token(target_row)

    return get_token


def _make_choice_getter(view: Any, values: Sequence[str]) -> _Getter:
    # Code −1 selects the last element, None.
    words = (*values, None)
    item = view.item
    return lambda row: words[item(row)]


def _make_subset_getter(view: Any, values: Sequence[str]) -> _Getter:
    def get_words(row: int) -> list[str]:
        mask = view.item(row)
        return [value for bit, value in enumerate(values) if mask >> bit & 1]

    return get_words


def _make_vector_getter(view: Any, shape: tuple[int, ...], *, nullable: bool) -> _Getter:
    def get_values(row: int) -> Any:
        values = view[row]
        if nullable and np.isnan(values[0]):
            return None
        if len(shape) == 1:
            return values.tolist()
        return values.reshape(shape).tolist()

    return get_values


def _make_number_getter(view: Any, dtype: str, *, nullable: bool) -> _Getter:
    if dtype == "bool":
        return cast(_Getter, view.__getitem__)
    item = view.item
    if not nullable:
        return cast(_Getter, item)

    def get_number(row: int) -> Any:
        value = item(row)
        if value == NULL_INTEGER or value != value:  # noqa: PLR0124 - NaN
            return None
        return value

    return get_number
