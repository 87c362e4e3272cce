"""Rows as Arrow tables of what their records show: every field by its own name, tokens in place of row numbers.

A record at a time would take an hour for a whole release; here each column is made at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.tables.arrow_files import damaged_value
from deepaccident_devkit.tables.columns import Choice, Column, Key, Struct, Subset, Vector
from deepaccident_devkit.tables.records import table_spec
from deepaccident_devkit.tables.tokens import ACTOR
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, CHANNEL_FORMAT, CHANNELS

if TYPE_CHECKING:
    from deepaccident_devkit.tables.tables import OpenTables


class RecordTables:
    """The tables of a release as their records show them."""

    def __init__(self, tables: OpenTables) -> None:
        """Make the words that tokens consist of."""
        import pyarrow as pa

        self._tables = tables
        scenario = tables.columns("scenario")
        longest = int(scenario["num_frames"].max(initial=0))
        self._numbers = pa.array([f"{number:03d}" for number in range(longest + 1)])
        self._scenarios = _joined(scenario["scenario_type"], scenario["name"])
        self._token_makers = {
            "scenario": self._scenarios.take,
            "agent": self._agent_tokens,
            "frame": self._frame_tokens,
            "sample": self._sample_tokens,
            "sample_data": self._sample_data_tokens,
            "sensor": lambda rows: _words(CHANNELS, rows),
            "calibrated_sensor": self._calibrated_sensor_tokens,
            "ego_pose": self._sample_tokens,
            "instance": self._instance_tokens,
            "annotation": self._annotation_tokens,
            "track": self._track_tokens,
            "category": lambda rows: _words(CATEGORIES, rows),
        }

    def rows(self, scenarios: Sequence[str], agents: Sequence[str] = AGENTS) -> dict[str, IntArray]:
        """Table → its rows of some scenarios (tokens), in order; without `sensor` and `category`; raises TokenError.

        Rows of what an agent recorded are only those of `agents`; tracks and instances are merged from all agents'.
        """
        chosen = np.array(
            [self._tables.getind("scenario", token) for token in scenarios], dtype=np.int64
        )
        agent, sample = self._tables.columns("agent"), self._tables.columns("sample")
        codes = [AGENTS.index(name) for name in AGENTS if name in agents]
        recorders = self._rows_with("agent", "scenario_row", chosen)
        recorders = recorders[np.isin(agent["name"][recorders], codes)]
        num_frames = self._tables.columns("scenario")["num_frames"][
            agent["scenario_row"][recorders]
        ]
        samples = _spans(agent["first_sample_row"][recorders], num_frames)
        return {
            "scenario": chosen,
            "agent": recorders,
            "frame": self._rows_with("frame", "scenario_row", chosen),
            "sample": samples,
            "sample_data": _spans(samples * len(CHANNELS), np.full(len(samples), len(CHANNELS))),
            "calibrated_sensor": self._rows_with("calibrated_sensor", "agent_row", recorders),
            "ego_pose": samples,
            "instance": self._rows_with("instance", "scenario_row", chosen),
            "annotation": _spans(
                sample["first_annotation_row"][samples], sample["num_annotations"][samples]
            ),
            "track": self._rows_with("track", "scenario_row", chosen),
        }

    def table(self, name: str, rows: IntArray) -> Any:
        """Rows (N,) of a table as a `pyarrow.Table`, a column a field; raises TableError and IndexStoreError.

        Choices are strings, matrices lists of lists. Lists have a fixed size where they are never null.
        """
        import pyarrow as pa

        columns = table_spec(name).columns
        try:
            arrays = [self._values(name, column, rows) for column in columns]
        except IndexError as error:
            raise damaged_value(name) from error
        return pa.table(arrays, names=[column.field for column in columns])

    def tokens(self, table: str, rows: IntArray) -> Any:
        """The tokens of rows (N,) of a table, as an Arrow array."""
        return self._token_makers[table](rows)

    def _rows_with(self, table: str, key: str, targets: IntArray) -> IntArray:
        """The rows of a table whose `key`, which is sorted, is one of the rows `targets` of another table."""
        column = self._tables.columns(table)[key]
        first, last = (
            np.searchsorted(column, (targets + each).astype(column.dtype)) for each in (0, 1)
        )
        return _spans(first, last - first)

    def _values(self, table: str, column: Column, rows: IntArray) -> Any:  # noqa: PLR0911 - one a kind
        if column.stored is None:
            return self._filenames(rows) if column.field == "filename" else self.tokens(table, rows)
        stored, view = (
            self._tables.arrow(table)[column.stored],
            self._tables.columns(table)[column.stored],
        )
        match column.kind:
            case Key(table=target):
                return self._keys(target, view[rows])
            case Choice(values=values):
                return _words(values, view[rows])
            case Subset(values=values):
                return _subsets(values, view[rows])
            case Vector(shape=shape):
                return (_nullable_lists if column.nullable else _fixed_lists)(view[rows], shape)
            case Struct():
                return _of_open_lists(stored.take(rows))
            case _:
                return stored.take(rows)

    def _keys(self, table: str, targets: IntArray) -> Any:
        """Tokens of rows of another table; null for −1."""
        known = targets >= 0
        return _spread(self.tokens(table, targets[known]), known)

    def _agent_tokens(self, rows: IntArray) -> Any:
        agent = self._tables.columns("agent")
        return _joined(
            self._scenarios.take(agent["scenario_row"][rows]), _words(AGENTS, agent["name"][rows])
        )

    def _frame_tokens(self, rows: IntArray) -> Any:
        frame = self._tables.columns("frame")
        return _joined(
            self._scenarios.take(frame["scenario_row"][rows]),
            self._numbers.take(frame["index"][rows]),
        )

    def _sample_tokens(self, rows: IntArray) -> Any:
        agent = self._tables.columns("sample")["agent_row"][rows]
        return _joined(self._agent_tokens(agent), self._number_words(rows, agent))

    def _number_words(self, samples: IntArray, agents: IntArray) -> Any:
        """The frame numbers `NNN` of samples of agents, both by row."""
        return self._numbers.take(
            samples - self._tables.columns("agent")["first_sample_row"][agents] + 1
        )

    def _sample_data_tokens(self, rows: IntArray) -> Any:
        sample, channel = np.divmod(rows, len(CHANNELS))
        return _joined(self._sample_tokens(sample), _words(CHANNELS, channel))

    def _calibrated_sensor_tokens(self, rows: IntArray) -> Any:
        import pyarrow.compute as pc

        view = self._tables.columns("calibrated_sensor")
        first = _joined(
            self._agent_tokens(view["agent_row"][rows]), _words(CHANNELS, view["sensor_row"][rows])
        )
        return pc.if_else(
            view["number"][rows] == 1, first, _joined(first, _digits(view["number"][rows]))
        )

    def _instance_tokens(self, rows: IntArray) -> Any:
        return self._actor_tokens(
            "scenario", self._tables.columns("instance")["scenario_row"][rows], rows
        )

    def _track_tokens(self, rows: IntArray) -> Any:
        track = self._tables.columns("track")
        return self._actor_tokens("frame", track["frame_row"][rows], track["instance_row"][rows])

    def _actor_tokens(self, table: str, rows: IntArray, instances: IntArray) -> Any:
        """The tokens of actors in what the rows of a table are."""
        actors = self._tables.columns("instance")["actor_id"][instances]
        return _joined(self.tokens(table, rows), ACTOR, _digits(actors))

    def _annotation_tokens(self, rows: IntArray) -> Any:
        sample = self._tables.columns("annotation")["sample_row"][rows]
        number = rows - self._tables.columns("sample")["first_annotation_row"][sample]
        return _joined(self._sample_tokens(sample), _digits(number))

    def _filenames(self, rows: IntArray) -> Any:
        """The paths of sensor files below the dataroot."""
        import pyarrow.compute as pc

        sample, channel = np.divmod(rows, len(CHANNELS))
        agent = self._tables.columns("sample")["agent_row"][sample]
        scenario = self._tables.columns("agent")["scenario_row"][agent]
        words = self._tables.columns("scenario")
        name = words["name"].take(scenario)
        folder, agents = (
            words["folder"].take(scenario),
            _words(AGENTS, self._tables.columns("agent")["name"][agent]),
        )
        file = _joined(name, self._number_words(sample, agent), separator="_")
        file = _joined(
            file, _words([CHANNEL_FORMAT[each] for each in CHANNELS], channel), separator="."
        )
        path = _joined(
            words["scenario_type"].take(scenario), agents, _words(CHANNELS, channel), name, file
        )
        return pc.if_else(pc.equal(folder, ""), path, _joined(folder, path))


def _joined(*words: Any, separator: str = "/") -> Any:
    import pyarrow.compute as pc

    return pc.binary_join_element_wise(*words, separator)


def _words(values: Sequence[str], codes: IntArray) -> Any:
    """The words that codes stand for; null for −1."""
    import pyarrow as pa

    return pa.array(values).take(pa.array(codes, mask=codes < 0))


def _digits(numbers: IntArray) -> Any:
    import pyarrow as pa

    return pa.array(numbers).cast(pa.string())


def _spread(values: Any, known: BoolArray) -> Any:
    """The values of the rows that are known, each at its row; null at the others."""
    import pyarrow as pa

    return values.take(pa.array(np.cumsum(known) - 1, mask=~known))


def _subsets(values: Sequence[str], masks: IntArray) -> Any:
    """The lists of words that bit masks stand for."""
    import pyarrow as pa

    lists = [
        [word for bit, word in enumerate(values) if mask >> bit & 1]
        for mask in range(1 << len(values))
    ]
    return pa.array(lists).take(pa.array(masks))


def _fixed_lists(data: FloatArray, shape: Sequence[int]) -> Any:
    import pyarrow as pa

    array = pa.array(data.reshape(-1))
    for length in reversed(shape):
        array = pa.FixedSizeListArray.from_arrays(array, length)
    return array


def _nullable_lists(data: FloatArray, shape: Sequence[int]) -> Any:
    """Lists that can be null: of no fixed size, since Arrow before 15 cannot read such from Parquet files."""
    import pyarrow as pa

    known = ~np.isnan(data[:, 0])
    array = pa.array(data[known].reshape(-1))
    for length in reversed(shape):
        array = pa.ListArray.from_arrays(
            np.arange(0, len(array) + 1, length, dtype=np.int32), array
        )
    return _spread(array, known)


def _of_open_lists(structs: Any) -> Any:
    """Structs whose lists have no fixed size, for the same reason."""
    import pyarrow as pa

    fields = [(field.name, field.type) for field in structs.type]
    opened = {
        name: pa.list_(kind.value_type) if pa.types.is_fixed_size_list(kind) else kind
        for name, kind in fields
    }
    return pa.array(structs.to_pylist(), type=pa.struct(list(opened.items())))


def _spans(first: IntArray, count: IntArray) -> IntArray:
    """The numbers from each `first` on, `count` of them, one after the other."""
    before = np.cumsum(count) - count
    return np.repeat(first.astype(np.int64) - before, count) + np.arange(count.sum())
