"""The files around the videos of clips: a LeRobotDataset v3, and its rows as CSV."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.bulk import Output
from deepaccident_devkit.export.clip_rows import CLIP_COLUMNS, ClipColumn, ClipRows
from deepaccident_devkit.support.arrays import AnyArray
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.values import NamedValues, ReadOnlyValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD

FPS: Final = round(1 / FRAME_PERIOD)
"""Frames per second of recordings and videos."""
_TASK = "drive"
_VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
# Columns of a table of episodes that number its own file and the file of the rows.
_FILE_NUMBERS = (
    *("data/chunk_index", "data/file_index"),
    *("meta/episodes/chunk_index", "meta/episodes/file_index"),
)
# Key of the record of an episode in the metadata of its rows.
_RECORD_KEY = b"episode"
# Columns with the same text in all rows of an episode.
_EPISODE_FACTS = ("scenario", "agent", "split", "group")
_OTHER_COLUMNS = {
    "timestamp": ("float32", "seconds since the first frame of the episode"),
    "frame_index": ("int64", "number of the frame in the episode, from 0"),
    "episode_index": ("int64", "number of the episode, from 0"),
    "index": ("int64", "number of the row, from 0"),
    "task_index": ("int64", f"always 0, the only task: {_TASK}"),
    "scenario": ("string", "token of the scenario"),
    "agent": ("string", "agent that recorded the clip"),
    "split": ("string", "split of the scenario, or `unknown`"),
    "group": ("string", "the same for all recordings of a scenario and of its twin"),
}
ROW_COLUMNS: Final[Mapping[str, ClipColumn]] = {
    **{name: ClipColumn(dtype=dtype, doc=doc) for name, (dtype, doc) in _OTHER_COLUMNS.items()},
    **CLIP_COLUMNS,
}
"""Columns of the rows by name."""


def video_path(channel: str, place: tuple[int, int]) -> str:
    """Return the path of a camera's video from the numbers of its folder and of its file."""
    chunk, file = place
    return _VIDEO_PATH.format(video_key=_video_key(channel), chunk_index=chunk, file_index=file)


def describe_video(
    channel: str, place: tuple[int, int], size: tuple[int, int], length: int
) -> NamedValues:
    """Return what the record of an episode says about a camera's video.

    Args:
        channel: The camera.
        place: Numbers of the video's folder and of its file.
        size: Width and height, pixels.
        length: Number of pictures.
    """
    key = f"videos/{_video_key(channel)}"
    chunk, file = place
    return {
        f"video.{channel}": video_path(channel, place),
        f"size.{channel}": list(size),
        f"{key}/chunk_index": chunk,
        f"{key}/file_index": file,
        f"{key}/from_timestamp": 0.0,
        f"{key}/to_timestamp": length / FPS,
    }


def write_episode(path: Path, clip: ClipRows, record: ReadOnlyValues) -> None:
    """Write the rows of an episode and its record, without numbers, into a file."""
    import pyarrow as pa
    from pyarrow.parquet import write_table

    columns = {}
    for name in _EPISODE_FACTS:
        columns[name] = pa.array([record[name]] * len(clip))
    for name, values in clip.columns.items():
        columns[name] = pa.array(values.tolist(), _arrow_type(CLIP_COLUMNS[name]))
    rows = pa.table(columns, metadata={_RECORD_KEY: json.dumps(record)})
    with replacing(path) as temporary:
        write_table(rows, temporary)


def read_episode(path: Path) -> tuple[Any, NamedValues]:
    """Return the rows and the record that `write_episode` wrote."""
    from pyarrow.parquet import read_table

    rows = read_table(path)
    record = json.loads(rows.schema.metadata[_RECORD_KEY])
    return rows.replace_schema_metadata(None), record


def write_files(
    episodes: Sequence[tuple[Any, NamedValues]], cameras: Sequence[str], output: Output
) -> None:
    """Write everything but the videos.

    Args:
        episodes: Rows and record of each episode, in the order of their numbers.
        cameras: The cameras of the videos.
        output: The folder.

    Raises:
        ConfigError: If images of a camera have different sizes.
    """
    import pyarrow as pa
    from pyarrow.csv import write_csv
    from pyarrow.parquet import write_table

    records = [record for _, record in episodes]
    rows = _number_rows([rows for rows, _ in episodes])
    task_column = {"name": "task", "field_name": "task"}
    task_column |= {"pandas_type": "unicode", "numpy_type": "object"}
    # pandas describes its index so; it cannot read an index without the column.
    task_index = {"index_columns": ["task"], "columns": [task_column], "column_indexes": []}
    tasks = pa.table({"task_index": [0], "task": [_TASK]})
    tables = {
        _DATA_PATH.format(chunk_index=0, file_index=0): rows,
        _EPISODES_PATH: pa.Table.from_pylist(_number_episodes(records)),
        # without this LeRobot takes the text of the task for 0
        "meta/tasks.parquet": tasks.replace_schema_metadata({"pandas": json.dumps(task_index)}),
    }
    for path, table in tables.items():
        with output.file(path) as temporary:
            write_table(table, temporary, compression="zstd")
    with output.file("frames.csv") as temporary:
        write_csv(_flatten_lists(rows), temporary)
    contents = {
        "meta/info.json": _describe_dataset(records, cameras, len(rows)),
        "meta/stats.json": _compute_statistics(records, cameras, rows),
    }
    for path, content in contents.items():
        text = json.dumps(content, indent=1, allow_nan=False)
        output.write(path, text.encode())


def _video_key(channel: str) -> str:
    return f"observation.images.{channel}"


def _arrow_type(column: ClipColumn) -> Any:
    """Return the Arrow type of a column: a value, or a list of a fixed number of values."""
    import pyarrow as pa

    value_type = pa.type_for_alias(column.dtype)
    return pa.list_(value_type, len(column.names)) if column.names else value_type


def _number_rows(tables: Sequence[Any]) -> Any:
    """Join the rows of episodes, and add the columns that LeRobot requires."""
    import pyarrow as pa

    lengths = list(map(len, tables))
    rows = pa.concat_tables(tables)
    frame_index = np.concatenate(list(map(np.arange, lengths)))
    columns = {
        "timestamp": np.float32(frame_index * FRAME_PERIOD),
        "frame_index": frame_index,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(len(rows)),
        "task_index": np.zeros(len(rows), np.int64),
    }
    for name, values in columns.items():
        rows = rows.append_column(name, pa.array(values))
    return rows.select(list(ROW_COLUMNS))


def _number_episodes(records: Sequence[ReadOnlyValues]) -> list[NamedValues]:
    """Return the records of the table of episodes."""
    start = 0
    numbered_records = []
    for number, record in enumerate(records):
        end = start + record["length"]
        numbers = {
            "episode_index": number,
            "tasks": [_TASK],
            "dataset_from_index": start,
            "dataset_to_index": end,
            **dict.fromkeys(_FILE_NUMBERS, 0),
        }
        numbered_records.append({**numbers, **record})
        start = end
    return numbered_records


def _flatten_lists(rows: Any) -> Any:
    """Replace each column of lists by a column for each of its numbers."""
    import pyarrow as pa
    from pyarrow.compute import list_element

    columns = {}
    for name, column in ROW_COLUMNS.items():
        if not column.names:
            columns[name] = rows[name]
        for place, number_name in enumerate(column.names):
            columns[f"{name}.{number_name}"] = list_element(rows[name], place)
    return pa.table(columns)


def _compute_statistics(
    records: Sequence[ReadOnlyValues], cameras: Sequence[str], rows: Any
) -> NamedValues:
    """Return the statistics of each column of numbers, and of some pixels of each camera."""
    statistics = {}
    for name, column in ROW_COLUMNS.items():
        if column.dtype != "string":
            values = np.array(rows[name].to_pylist(), dtype=np.float64)
            statistics[name] = _summarise(values.reshape(len(rows), -1))
    for channel in cameras:
        pixels = np.concatenate([record[f"pixels.{channel}"] for record in records])
        summary: NamedValues = _summarise(pixels / 255)
        for name in ("min", "max", "mean", "std"):
            summary[name] = [[[value]] for value in summary[name]]
        statistics[_video_key(channel)] = summary
    return statistics


def _summarise(values: AnyArray) -> dict[str, list[float]]:
    """Return the statistics of rows (N, K) without NaN, which JSON lacks; 0 if none is left."""
    known_rows = values[~np.isnan(values).any(axis=1)]
    num_known = len(known_rows)
    shown_rows = known_rows if num_known else np.zeros((1, values.shape[1]))
    return {
        "min": shown_rows.min(axis=0).tolist(),
        "max": shown_rows.max(axis=0).tolist(),
        "mean": shown_rows.mean(axis=0).tolist(),
        "std": shown_rows.std(axis=0).tolist(),
        "count": [num_known],
    }


def _describe_dataset(
    records: Sequence[ReadOnlyValues], cameras: Sequence[str], num_frames: int
) -> NamedValues:
    """Return the content of info.json."""
    features: NamedValues = {}
    for channel in cameras:
        features[_video_key(channel)] = _describe_pictures(records, channel)
    for name, column in ROW_COLUMNS.items():
        names = list(column.names) or None
        features[name] = {"dtype": column.dtype, "shape": list(column.shape), "names": names}
    splits = [record["split"] for record in records]
    ranges = {}
    for split in dict.fromkeys(splits):
        start = splits.index(split)
        ranges[split] = f"{start}:{start + splits.count(split)}"
    return {
        "codebase_version": "v3.0",
        "robot_type": "deepaccident",
        "fps": FPS,
        "total_episodes": len(records),
        "total_frames": num_frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": _DATA_PATH,
        "video_path": _VIDEO_PATH,
        "splits": ranges,
        "features": features,
    }


def _describe_pictures(records: Sequence[ReadOnlyValues], channel: str) -> NamedValues:
    """Return the feature of a camera; raise ConfigError if its pictures have different sizes."""
    sizes = sorted({tuple(record[f"size.{channel}"]) for record in records})
    if len(sizes) > 1:
        texts = [f"{width}x{height}" for width, height in sizes]
        raise ConfigError(
            f"size: images of {channel} have the sizes {', '.join(texts)}; choose one with --size"
        )
    width, height = sizes[0]
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.fps": FPS,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "has_audio": False,
        },
    }
