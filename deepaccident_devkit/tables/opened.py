"""`OpenTables`: the tables of an index, opened: records, columns, and which scenario belongs to which split."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from deepaccident_devkit.errors import ChoiceError, NotAvailableError, TokenError
from deepaccident_devkit.release import read_split_file
from deepaccident_devkit.release.store import ReleasePath, places_of
from deepaccident_devkit.support.text import choice, path_of, spelled
from deepaccident_devkit.tables.index import Problem
from deepaccident_devkit.tables.tables import Table, Tables, table_names
from deepaccident_devkit.taxonomy import AGENTS, MINI_SPLITS, SPLITS, OnError

if TYPE_CHECKING:
    from deepaccident_devkit.tables import records

RowArgument = str | Mapping[str, Any]
"""How a caller names a row: by its token, or by its record."""


class OpenTables:
    """One release's tables: records by row and token, columns, splits.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        layout: how the release lies on disk: `A`, `B` or `A+B` (docs/format.md, Tree).
        problems: the broken scenarios that were left out (`on_error='skip'`).
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
        """Open the tables of an index, unless they are given; raises IndexStoreError if they cannot be read."""
        self.dataroot = dataroot
        self.version = version
        self.layout = layout
        self.problems = problems
        self._split_files = dict(split_files)
        self._tables = tables or Tables(tables_folder)

    def __repr__(self) -> str:
        """Kind, version and place."""
        return f"{type(self).__name__}({self.version!r}, {str(self.dataroot)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle paths, not tables: the copy opens the same files again."""
        return _reopened, (
            type(self),
            {
                "dataroot": self.dataroot,
                "version": self.version,
                "layout": self.layout,
                "split_files": self._split_files,
                "tables_folder": self.tables_folder,
                "problems": self.problems,
            },
        )

    @property
    def places(self) -> tuple[Path, ...]:
        """What a worker on another host must see to open it: the release's folder, and that of its tables."""
        return *places_of(self.dataroot), self.tables_folder

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

    def get(self, table: str, token: RowArgument) -> dict[str, Any]:
        """The record of a token, as a fresh dict; raises TableError or TokenError."""
        record: dict[str, Any] = self._tables.table(table).get(token_of(token))
        return record

    def getind(self, table: str, token: RowArgument) -> int:
        """The row of a token; raises TableError or TokenError."""
        return self._tables.table(table).row(token_of(token))

    def field2token(self, table: str, field: str, query: Any) -> list[str]:
        """The tokens of all rows of a table whose field equals `query`; raises TableError or FieldError."""
        return self._tables.table(table).tokens_where(field, query)

    def arrow(self, table: str) -> Any:
        """A table as `pyarrow.Table`, without copying; `…_row` columns hold row numbers instead of tokens."""
        return self._tables.table(table).arrow

    def columns(self, table: str) -> Mapping[str, Any]:
        """A table's stored columns by name as read-only arrays, without copying; raises TableError.

        Numbers are numpy views (row keys, choices as codes, null as −1 or NaN), words Arrow arrays.
        """
        return self._tables.views[self._tables.table(table).name]

    def get_sample(self, scenario: RowArgument, agent: str, frame: int) -> records.SampleRecord:
        """The sample of an agent at frame number `frame` (from 1) of a scenario; raises TokenError."""
        if not isinstance(frame, int | np.integer):
            raise TokenError(f"frame: expected a number from 1, found {frame!r}")
        return self.sample.get(f"{token_of(scenario)}/{spelled(agent, AGENTS)}/{frame:03d}")

    def samples_of(self, frame: RowArgument) -> list[records.SampleRecord]:
        """The samples of one moment, one for each agent that is there, in the order of `taxonomy.AGENTS`."""
        row = self.frame.row(token_of(frame))
        record = self.frame[row]
        scenario_row = self.scenario.row(record["scenario_token"])
        agents = self._tables.resolver.agents_of(scenario_row).values()
        return [self.sample[self._tables.resolver.sample_at(agent, record["index"])] for agent in agents]

    def split_scenarios(self, split: str | os.PathLike[str], *, missing: OnError = "raise") -> set[str]:
        """The tokens of this release's scenarios that belong to a split.

        Args:
            split: `train`, `val`, `test`, `train_mini` or `val_mini`: those of it that are here. Or a split file of
                your own, as a path object or a text that ends in `.txt`: blank lines, CRLF and a byte order mark are
                fine, the same scenario in two lines is a fault.
            missing: a file's scenarios that are not in this release: `raise`, or `skip` them.

        Raises:
            ChoiceError: no such split, or `missing` is neither `raise` nor `skip`.
            NotAvailableError: the splits are unknown: there are no split files and no split folders; or
                scenarios of your file are not in this release.
            MissingFileError: there is no such file.
            SplitFileError: your file is no split file: a line has not two words, or a scenario stands twice.
        """
        missing = choice("missing", missing, get_args(OnError))
        if not isinstance(split, str | os.PathLike):
            raise ChoiceError(f"split: expected the name of one, or the path of a split file, found {split!r}")
        if not isinstance(split, str) or split.endswith(".txt"):
            return self._listed_scenarios(path_of(split), missing)
        split = choice("split", split, (*SPLITS, *MINI_SPLITS))
        if split in MINI_SPLITS:
            if split not in self._split_files:
                raise NotAvailableError(
                    f"{self.dataroot}: has no {split}.txt; put the release's split files there, "
                    f"{self._own_split_text()}"
                )
            return set(read_split_file(self._split_files[split])) & set(self._tables.resolver.scenario_tokens)
        known = self._tables.views["scenario"]["split"]
        if (known < 0).all():
            raise NotAvailableError(
                f"{self.dataroot}: the split of its scenarios is unknown: it has neither split files ({split}.txt) nor "
                f"split folders ({split}/); put the release's split files into it, {self._own_split_text()}"
            )
        return set(self.scenario.tokens_where("split", split))

    def _own_split_text(self) -> str:
        place = shlex.quote(str(self.dataroot))
        return f"or make a split file of your own: deepaccident split {place} --out mine.txt, then --split mine.txt"

    def _listed_scenarios(self, path: Path, missing: OnError) -> set[str]:
        listed = read_split_file(path, unique=True)
        here = set(self._tables.resolver.scenario_tokens)
        absent = [token for token in listed if token not in here]
        if absent and missing == "raise":
            raise NotAvailableError(
                f"{path}: {len(absent)} of its {len(listed)} scenarios are not in {self.dataroot}: "
                f"{', '.join(absent[:3])}{', …' if len(absent) > 3 else ''}; pass missing='skip' to go without them"
            )
        return here.intersection(listed)


def _reopened(kind: type[OpenTables], arguments: dict[str, Any]) -> OpenTables:
    """Undo `OpenTables.__reduce__`, without looking for changes on disk.

    A worker gets a dataset with each item: it opens the files once, which takes as long as a sample's labels.
    """
    dataset, folder = kind.__new__(kind), arguments["tables_folder"]
    tables = _tables_of(folder, folder.stat().st_ino) if folder.is_dir() else None
    OpenTables.__init__(dataset, **arguments, tables=tables)
    return dataset


@lru_cache(maxsize=2)
def _tables_of(folder: Path, _number: int) -> Tables:
    """The tables in a folder; the system's number of the folder tells one from another that takes its place."""
    return Tables(folder)


def token_of(row: RowArgument) -> str:
    """The token of a row given by token or record, as the whole API takes it; raises TokenError."""
    token = row.get("token") if isinstance(row, Mapping) else row
    if not isinstance(token, str):
        raise TokenError(f"expected a token or a record with one, found {row!r}")
    return token
