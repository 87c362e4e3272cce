"""Rows as Arrow tables with the content of their records: all fields by name, with tokens.

Columns are computed as a whole: for a complete release, building record after record would take an
hour.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from deepaccident_devkit.support.arrays import BoolArray, FloatArray, IntArray, concatenate_ranges
from deepaccident_devkit.tables.arrow_files import damaged_value
from deepaccident_devkit.tables.columns import Choice, Column, Key, Struct, Subset, Vector
from deepaccident_devkit.tables.records import table_spec
from deepaccident_devkit.taxonomy import ACTOR, AGENTS, CATEGORIES, CHANNEL_FORMAT, CHANNELS

if TYPE_CHECKING:
    from deepaccident_devkit.tables.tables import OpenTables


class RecordTables:
    """The tables of a release with the fields of their records."""

    def __init__(self, tables: OpenTables) -> None:
        """Prepare the words that tokens consist of."""
        self._tables = tables
        scenario = tables.columns("scenario")
        max_frames = int(scenario["num_frames"].max(initial=0))
        self._numbers = pa.array([f"{number:03d}" for number in range(max_frames + 1)])
        self._scenarios = _join_words(scenario["scenario_type"], scenario["name"])
        self._token_makers = {
            "scenario": self._scenarios.take,
            "agent": self._make_agent_tokens,
            "frame": self._make_frame_tokens,
            "sample": self._make_sample_tokens,
            "sample_data": self._make_sample_data_tokens,
            "sensor": lambda rows: _decode_words(CHANNELS, rows),
            "calibrated_sensor": self._make_calibrated_sensor_tokens,
            "ego_pose": self._make_sample_tokens,
            "instance": self._make_instance_tokens,
            "annotation": self._make_annotation_tokens,
            "track": self._make_track_tokens,
            "category": lambda rows: _decode_words(CATEGORIES, rows),
        }

    def rows(self, scenarios: Sequence[str], agents: Sequence[str] = AGENTS) -> dict[str, IntArray]:
        """Return table → row numbers that belong to scenarios, without `sensor` and `category`.

        Recordings are restricted to `agents`; tracks and instances are merged from all agents.
        TokenError is raised if a scenario is unknown.

        Args:
            scenarios: Tokens of scenarios.
            agents: Names of agents.
        """
        scenario_rows = np.array(
            [self._tables.getind("scenario", token) for token in scenarios], dtype=np.int64
        )
        agent = self._tables.columns("agent")
        sample = self._tables.columns("sample")
        codes = [code for code, name in enumerate(AGENTS) if name in agents]
        agent_rows = self._find_rows("agent", "scenario_row", scenario_rows)
        agent_rows = agent_rows[np.isin(agent["name"][agent_rows], codes)]
        scenario = self._tables.columns("scenario")
        num_frames = scenario["num_frames"][agent["scenario_row"][agent_rows]]
        samples = concatenate_ranges(agent["first_sample_row"][agent_rows], num_frames)
        num_annotations = sample["num_annotations"][samples]
        return {
            "scenario": scenario_rows,
            "agent": agent_rows,
            "frame": self._find_rows("frame", "scenario_row", scenario_rows),
            "sample": samples,
            "sample_data": concatenate_ranges(
                samples * len(CHANNELS), np.full(len(samples), len(CHANNELS))
            ),
            "calibrated_sensor": self._find_rows("calibrated_sensor", "agent_row", agent_rows),
            "ego_pose": samples,
            "instance": self._find_rows("instance", "scenario_row", scenario_rows),
            "annotation": concatenate_ranges(
                sample["first_annotation_row"][samples], num_annotations
            ),
            "track": self._find_rows("track", "scenario_row", scenario_rows),
        }

    def table(self, name: str, rows: IntArray) -> Any:
        """Return rows (N,) of a table as a `pyarrow.Table` with a column for each field.

        Choices are strings, and matrices are lists of lists. Lists have a fixed size if they are
        never null. TableError is raised if the table is unknown, IndexStoreError if it is damaged.
        """
        columns = table_spec(name).columns
        try:
            arrays = [self._make_column(name, column, rows) for column in columns]
        except IndexError as error:
            raise damaged_value(name) from error
        return pa.table(arrays, names=[column.field for column in columns])

    def tokens(self, table: str, rows: IntArray) -> Any:
        """Return the tokens of rows (N,) of a table, as an Arrow array."""
        return self._token_makers[table](rows)

    def _find_rows(self, table: str, key: str, targets: IntArray) -> IntArray:
        """Return the rows of a table whose `key` is one of the rows `targets` of another table.

        The column `key` must be sorted.
        """
        column = self._tables.columns(table)[key]
        start = np.searchsorted(column, targets.astype(column.dtype))
        stop = np.searchsorted(column, (targets + 1).astype(column.dtype))
        return concatenate_ranges(start, stop - start)

    def _make_column(self, table: str, column: Column, rows: IntArray) -> Any:  # noqa: PLR0911 - one a kind
        if column.stored is None:
            if column.field == "filename":
                return self._make_filenames(rows)
            return self.tokens(table, rows)
        stored = self._tables.arrow(table)[column.stored]
        view = self._tables.columns(table)[column.stored]
        match column.kind:
            case Key(table=target):
                return self._make_key_tokens(target, view[rows])
            case Choice(values=values):
                return _decode_words(values, view[rows])
            case Subset(values=values):
                return _decode_subsets(values, view[rows])
            case Vector(shape=shape) if column.nullable:
                return _make_nullable_lists(view[rows], shape)
            case Vector(shape=shape):
                return _make_fixed_lists(view[rows], shape)
            case Struct():
                return _make_open_lists(stored.take(rows))
            case _:
                return stored.take(rows)

    def _make_key_tokens(self, table: str, targets: IntArray) -> Any:
        """Return the tokens of rows of another table; null for −1."""
        is_known = targets >= 0
        tokens = self.tokens(table, targets[is_known])
        return _spread_values(tokens, is_known)

    def _make_agent_tokens(self, rows: IntArray) -> Any:
        agent = self._tables.columns("agent")
        scenarios = self._scenarios.take(agent["scenario_row"][rows])
        return _join_words(scenarios, _decode_words(AGENTS, agent["name"][rows]))

    def _make_frame_tokens(self, rows: IntArray) -> Any:
        frame = self._tables.columns("frame")
        scenarios = self._scenarios.take(frame["scenario_row"][rows])
        return _join_words(scenarios, self._numbers.take(frame["index"][rows]))

    def _make_sample_tokens(self, rows: IntArray) -> Any:
        agent = self._tables.columns("sample")["agent_row"][rows]
        return _join_words(self._make_agent_tokens(agent), self._make_frame_numbers(rows, agent))

    def _make_frame_numbers(self, samples: IntArray, agents: IntArray) -> Any:
        """Return the frame numbers, as `NNN`, of samples, from the rows of samples and agents."""
        first_rows = self._tables.columns("agent")["first_sample_row"][agents]
        return self._numbers.take(samples - first_rows + 1)

    def _make_sample_data_tokens(self, rows: IntArray) -> Any:
        sample, channel = np.divmod(rows, len(CHANNELS))
        return _join_words(self._make_sample_tokens(sample), _decode_words(CHANNELS, channel))

    def _make_calibrated_sensor_tokens(self, rows: IntArray) -> Any:
        view = self._tables.columns("calibrated_sensor")
        agents = self._make_agent_tokens(view["agent_row"][rows])
        channels = _decode_words(CHANNELS, view["sensor_row"][rows])
        unnumbered = _join_words(agents, channels)
        number = view["number"][rows]
        numbered = _join_words(unnumbered, _format_numbers(number))
        return pc.if_else(number == 1, unnumbered, numbered)

    def _make_instance_tokens(self, rows: IntArray) -> Any:
        scenarios = self._tables.columns("instance")["scenario_row"][rows]
        return self._make_actor_tokens("scenario", scenarios, rows)

    def _make_track_tokens(self, rows: IntArray) -> Any:
        track = self._tables.columns("track")
        return self._make_actor_tokens(
            "frame", track["frame_row"][rows], track["instance_row"][rows]
        )

    def _make_actor_tokens(self, table: str, rows: IntArray, instances: IntArray) -> Any:
        """Return the tokens of instances within rows of a table."""
        actors = self._tables.columns("instance")["actor_id"][instances]
        return _join_words(self.tokens(table, rows), ACTOR, _format_numbers(actors))

    def _make_annotation_tokens(self, rows: IntArray) -> Any:
        sample = self._tables.columns("annotation")["sample_row"][rows]
        number = rows - self._tables.columns("sample")["first_annotation_row"][sample]
        return _join_words(self._make_sample_tokens(sample), _format_numbers(number))

    def _make_filenames(self, rows: IntArray) -> Any:
        """Return the paths of sensor files in the dataroot."""
        sample, channel = np.divmod(rows, len(CHANNELS))
        agent = self._tables.columns("sample")["agent_row"][sample]
        agents = self._tables.columns("agent")
        scenario = agents["scenario_row"][agent]
        scenarios = self._tables.columns("scenario")
        name = scenarios["name"].take(scenario)
        folder = scenarios["folder"].take(scenario)
        extensions = [CHANNEL_FORMAT[channel_name] for channel_name in CHANNELS]
        stem = _join_words(name, self._make_frame_numbers(sample, agent), separator="_")
        file_name = _join_words(stem, _decode_words(extensions, channel), separator=".")
        path = _join_words(
            scenarios["scenario_type"].take(scenario),
            _decode_words(AGENTS, agents["name"][agent]),
            _decode_words(CHANNELS, channel),
            name,
            file_name,
        )
        return pc.if_else(pc.equal(folder, ""), path, _join_words(folder, path))


def _join_words(*words: Any, separator: str = "/") -> Any:
    return pc.binary_join_element_wise(*words, separator)


def _decode_words(values: Sequence[str], codes: IntArray) -> Any:
    """Return the word for each code; null for −1."""
    return pa.array(values).take(pa.array(codes, mask=codes < 0))


def _format_numbers(numbers: IntArray) -> Any:
    return pa.array(numbers).cast(pa.string())


def _spread_values(values: Any, is_known: BoolArray) -> Any:
    """Spread values over the rows that are known; all other rows are null."""
    positions = np.cumsum(is_known) - 1
    return values.take(pa.array(positions, mask=~is_known))


def _decode_subsets(values: Sequence[str], masks: IntArray) -> Any:
    """Return the list of words that each bit mask represents."""
    subsets = []
    for mask in range(1 << len(values)):
        subsets.append([word for bit, word in enumerate(values) if mask >> bit & 1])
    return pa.array(subsets).take(pa.array(masks))


def _make_fixed_lists(data: FloatArray, shape: Sequence[int]) -> Any:
    array = pa.array(data.reshape(-1))
    for length in reversed(shape):
        array = pa.FixedSizeListArray.from_arrays(array, length)
    return array


def _make_nullable_lists(data: FloatArray, shape: Sequence[int]) -> Any:
    """Return lists without a fixed size, which can be null.

    Arrow before version 15 cannot read such lists from Parquet files if they have a fixed size.
    """
    is_known = ~np.isnan(data[:, 0])
    array = pa.array(data[is_known].reshape(-1))
    for length in reversed(shape):
        offsets = np.arange(0, len(array) + 1, length, dtype=np.int32)
        array = pa.ListArray.from_arrays(offsets, array)
    return _spread_values(array, is_known)


def _make_open_lists(structs: Any) -> Any:
    """Convert lists in structs to lists without a fixed size, as `_make_nullable_lists` does."""
    fields = []
    for field in structs.type:
        field_type = field.type
        if pa.types.is_fixed_size_list(field_type):
            field_type = pa.list_(field_type.value_type)
        fields.append((field.name, field_type))
    return pa.array(structs.to_pylist(), type=pa.struct(fields))
