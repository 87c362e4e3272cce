"""Rows as Arrow tables with the content of their records: all fields by name, with tokens.

Record by record would take an hour for a complete release; these functions make each column at
once.
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
    """The tables of a release with the fields of their records."""

    def __init__(self, tables: OpenTables) -> None:
        """Make the words of tokens."""
        import pyarrow as pa

        self._tables = tables
        scenario = tables.columns("scenario")
        max_frames = int(scenario["num_frames"].max(initial=0))
        self._numbers = pa.array([f"{number:03d}" for number in range(max_frames + 1)])
        self._scenarios = _join(scenario["scenario_type"], scenario["name"])
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
        """Return table → rows of scenarios, in order, without `sensor` and `category`.

        Rows of recordings are restricted to `agents`; tracks and instances are merged from all
        agents. Raises TokenError.

        Args:
            scenarios: Tokens of scenarios.
            agents: Names of agents.
        """
        scenario_rows = np.array(
            [self._tables.getind("scenario", token) for token in scenarios], dtype=np.int64
        )
        agent = self._tables.columns("agent")
        sample = self._tables.columns("sample")
        codes = [AGENTS.index(name) for name in AGENTS if name in agents]
        agent_rows = self._rows_with("agent", "scenario_row", scenario_rows)
        agent_rows = agent_rows[np.isin(agent["name"][agent_rows], codes)]
        frames_of = self._tables.columns("scenario")["num_frames"]
        num_frames = frames_of[agent["scenario_row"][agent_rows]]
        samples = _spans(agent["first_sample_row"][agent_rows], num_frames)
        num_annotations = sample["num_annotations"][samples]
        return {
            "scenario": scenario_rows,
            "agent": agent_rows,
            "frame": self._rows_with("frame", "scenario_row", scenario_rows),
            "sample": samples,
            "sample_data": _spans(samples * len(CHANNELS), np.full(len(samples), len(CHANNELS))),
            "calibrated_sensor": self._rows_with("calibrated_sensor", "agent_row", agent_rows),
            "ego_pose": samples,
            "instance": self._rows_with("instance", "scenario_row", scenario_rows),
            "annotation": _spans(sample["first_annotation_row"][samples], num_annotations),
            "track": self._rows_with("track", "scenario_row", scenario_rows),
        }

    def table(self, name: str, rows: IntArray) -> Any:
        """Return rows (N,) of a table as a `pyarrow.Table`, a column a field.

        Choices are strings, matrices lists of lists. Lists have a fixed size where they are never
        null. Raises TableError and IndexStoreError.
        """
        import pyarrow as pa

        columns = table_spec(name).columns
        try:
            arrays = [self._values(name, column, rows) for column in columns]
        except IndexError as error:
            raise damaged_value(name) from error
        return pa.table(arrays, names=[column.field for column in columns])

    def tokens(self, table: str, rows: IntArray) -> Any:
        """Return the tokens of rows (N,) of a table, as an Arrow array."""
        return self._token_makers[table](rows)

    def _rows_with(self, table: str, key: str, targets: IntArray) -> IntArray:
        """Return the rows of a table with a `key` in rows `targets` of another table.

        The column `key` is sorted.
        """
        column = self._tables.columns(table)[key]
        start = np.searchsorted(column, targets.astype(column.dtype))
        stop = np.searchsorted(column, (targets + 1).astype(column.dtype))
        return _spans(start, stop - start)

    def _values(self, table: str, column: Column, rows: IntArray) -> Any:  # noqa: PLR0911 - one a kind
        if column.stored is None:
            if column.field == "filename":
                return self._filenames(rows)
            return self.tokens(table, rows)
        stored = self._tables.arrow(table)[column.stored]
        view = self._tables.columns(table)[column.stored]
        match column.kind:
            case Key(table=target):
                return self._keys(target, view[rows])
            case Choice(values=values):
                return _words(values, view[rows])
            case Subset(values=values):
                return _subsets(values, view[rows])
            case Vector(shape=shape) if column.nullable:
                return _nullable_lists(view[rows], shape)
            case Vector(shape=shape):
                return _fixed_lists(view[rows], shape)
            case Struct():
                return _open_lists(stored.take(rows))
            case _:
                return stored.take(rows)

    def _keys(self, table: str, targets: IntArray) -> Any:
        """Return tokens of rows of another table; null for −1."""
        known = targets >= 0
        return _spread(self.tokens(table, targets[known]), known)

    def _agent_tokens(self, rows: IntArray) -> Any:
        agent = self._tables.columns("agent")
        scenarios = self._scenarios.take(agent["scenario_row"][rows])
        return _join(scenarios, _words(AGENTS, agent["name"][rows]))

    def _frame_tokens(self, rows: IntArray) -> Any:
        frame = self._tables.columns("frame")
        scenarios = self._scenarios.take(frame["scenario_row"][rows])
        return _join(scenarios, self._numbers.take(frame["index"][rows]))

    def _sample_tokens(self, rows: IntArray) -> Any:
        agent = self._tables.columns("sample")["agent_row"][rows]
        return _join(self._agent_tokens(agent), self._number_words(rows, agent))

    def _number_words(self, samples: IntArray, agents: IntArray) -> Any:
        """Return the frame numbers `NNN` of samples of agents, both by row."""
        first_rows = self._tables.columns("agent")["first_sample_row"][agents]
        return self._numbers.take(samples - first_rows + 1)

    def _sample_data_tokens(self, rows: IntArray) -> Any:
        sample, channel = np.divmod(rows, len(CHANNELS))
        return _join(self._sample_tokens(sample), _words(CHANNELS, channel))

    def _calibrated_sensor_tokens(self, rows: IntArray) -> Any:
        import pyarrow.compute as pc

        view = self._tables.columns("calibrated_sensor")
        agents = self._agent_tokens(view["agent_row"][rows])
        unnumbered = _join(agents, _words(CHANNELS, view["sensor_row"][rows]))
        number = view["number"][rows]
        return pc.if_else(number == 1, unnumbered, _join(unnumbered, _digits(number)))

    def _instance_tokens(self, rows: IntArray) -> Any:
        scenarios = self._tables.columns("instance")["scenario_row"][rows]
        return self._actor_tokens("scenario", scenarios, rows)

    def _track_tokens(self, rows: IntArray) -> Any:
        track = self._tables.columns("track")
        return self._actor_tokens("frame", track["frame_row"][rows], track["instance_row"][rows])

    def _actor_tokens(self, table: str, rows: IntArray, instances: IntArray) -> Any:
        """Return the tokens of actors within rows of a table."""
        actors = self._tables.columns("instance")["actor_id"][instances]
        return _join(self.tokens(table, rows), ACTOR, _digits(actors))

    def _annotation_tokens(self, rows: IntArray) -> Any:
        sample = self._tables.columns("annotation")["sample_row"][rows]
        number = rows - self._tables.columns("sample")["first_annotation_row"][sample]
        return _join(self._sample_tokens(sample), _digits(number))

    def _filenames(self, rows: IntArray) -> Any:
        """Return the paths of sensor files in the dataroot."""
        import pyarrow.compute as pc

        sample, channel = np.divmod(rows, len(CHANNELS))
        agent = self._tables.columns("sample")["agent_row"][sample]
        agents = self._tables.columns("agent")
        scenario = agents["scenario_row"][agent]
        scenarios = self._tables.columns("scenario")
        name = scenarios["name"].take(scenario)
        folder = scenarios["folder"].take(scenario)
        extensions = [CHANNEL_FORMAT[channel_name] for channel_name in CHANNELS]
        stem = _join(name, self._number_words(sample, agent), separator="_")
        file_name = _join(stem, _words(extensions, channel), separator=".")
        path = _join(
            scenarios["scenario_type"].take(scenario),
            _words(AGENTS, agents["name"][agent]),
            _words(CHANNELS, channel),
            name,
            file_name,
        )
        return pc.if_else(pc.equal(folder, ""), path, _join(folder, path))


def _join(*words: Any, separator: str = "/") -> Any:
    import pyarrow.compute as pc

    return pc.binary_join_element_wise(*words, separator)


def _words(values: Sequence[str], codes: IntArray) -> Any:
    """Return the words of codes; null for −1."""
    import pyarrow as pa

    return pa.array(values).take(pa.array(codes, mask=codes < 0))


def _digits(numbers: IntArray) -> Any:
    import pyarrow as pa

    return pa.array(numbers).cast(pa.string())


def _spread(values: Any, known: BoolArray) -> Any:
    """Return values at the rows that are known; null at the others."""
    import pyarrow as pa

    return values.take(pa.array(np.cumsum(known) - 1, mask=~known))


def _subsets(values: Sequence[str], masks: IntArray) -> Any:
    """Return the lists of words of bit masks."""
    import pyarrow as pa

    subsets = []
    for mask in range(1 << len(values)):
        subsets.append([word for bit, word in enumerate(values) if mask >> bit & 1])
    return pa.array(subsets).take(pa.array(masks))


def _fixed_lists(data: FloatArray, shape: Sequence[int]) -> Any:
    import pyarrow as pa

    array = pa.array(data.reshape(-1))
    for length in reversed(shape):
        array = pa.FixedSizeListArray.from_arrays(array, length)
    return array


def _nullable_lists(data: FloatArray, shape: Sequence[int]) -> Any:
    """Return lists of no fixed size, which can be null.

    Arrow before 15 cannot read such lists of a fixed size from Parquet files.
    """
    import pyarrow as pa

    known = ~np.isnan(data[:, 0])
    array = pa.array(data[known].reshape(-1))
    for length in reversed(shape):
        offsets = np.arange(0, len(array) + 1, length, dtype=np.int32)
        array = pa.ListArray.from_arrays(offsets, array)
    return _spread(array, known)


def _open_lists(structs: Any) -> Any:
    """Return structs with lists of no fixed size, like `_nullable_lists`."""
    import pyarrow as pa

    fields = []
    for field in structs.type:
        is_fixed = pa.types.is_fixed_size_list(field.type)
        fields.append((field.name, pa.list_(field.type.value_type) if is_fixed else field.type))
    return pa.array(structs.to_pylist(), type=pa.struct(fields))


def _spans(start: IntArray, count: IntArray) -> IntArray:
    """Return `count` numbers from each `start` on, one run after the other."""
    before = np.cumsum(count) - count
    offsets = np.repeat(start.astype(np.int64) - before, count)
    return offsets + np.arange(count.sum())
