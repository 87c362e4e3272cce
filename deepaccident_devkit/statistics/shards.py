"""Statistics in shards: each keeps the tallies of its runs of scenarios in one file, and the last call adds them up."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit._version import __version__
from deepaccident_devkit.archives import DAMAGED_ARCHIVE, open_zip, read_array
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.files import path_of, replacing, writable_folder
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.parallel import Shard, ShardFiles, check_whole
from deepaccident_devkit.statistics.compute import Chosen, chosen_rows, runs_of, statistics_of, tallies_of
from deepaccident_devkit.statistics.report import DatasetStatistics
from deepaccident_devkit.statistics.results import CollisionPair
from deepaccident_devkit.statistics.tally import Tally

if TYPE_CHECKING:
    from concurrent.futures import Executor

_ARRAYS: Final = ("content", "values", "times")


def statistics_shard(
    dataset: Dataset,
    shard: Shard,
    out: str | os.PathLike[str],
    scenarios: Chosen = None,
    *,
    interactions: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> int:
    """Count a part of the scenarios, unless that is done, and keep the tallies for `merged_statistics`.

    Args:
        dataset: the release.
        shard: which part; of runs of neighbouring scenarios, so some of many shards may have none.
        out: the folder that the statistics are for; the shards lie beside it.
        scenarios: of all shards, as of `dataset_statistics`.
        interactions: whether to count these too.
        workers: processes.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Returns:
        How many scenarios the part has.

    Raises:
        ConfigError: nothing can be written into `out`, or beside it.
        TokenError, ChoiceError, WorkerError: as of `dataset_statistics`.
    """
    rows = chosen_rows(dataset, scenarios)
    runs, files = shard.of(runs_of(rows)), _shard_files(dataset, out, rows, interactions=interactions)
    for folder in (out, files.folder):
        writable_folder(folder)
    if _read(files.path(shard)).keys() != {run[0] for run in runs}:
        tallies = tallies_of(
            dataset, runs, interactions=interactions, workers=workers, executor=executor, progress=progress
        )
        _write(files.path(shard), {run[0]: tally for run, tally in zip(runs, tallies, strict=True)})
    return sum(len(run) for run in runs)


def merged_statistics(
    dataset: Dataset, out: str | os.PathLike[str], scenarios: Chosen = None, *, interactions: bool = False
) -> DatasetStatistics:
    """What `dataset_statistics` gives, from the files of all shards.

    Args:
        dataset: the release.
        out: the folder that the shards were given.
        scenarios: those that the shards were given.
        interactions: whether the shards counted these.

    Raises:
        UnfinishedError: some scenarios were not counted, or from another state of the release, or by another devkit.
        TokenError, ChoiceError: as of `dataset_statistics`.
    """
    rows = chosen_rows(dataset, scenarios)
    files = _shard_files(dataset, out, rows, interactions=interactions)
    tallies = {first: tally for path in files.found() for first, tally in _read(path).items()}
    tokens = {run[0]: [dataset.scenario[row]["token"] for row in run] for run in runs_of(rows)}
    done = {token for first in tallies for token in tokens[first]}
    check_whole([token for run in tokens.values() for token in run], done, files.folder)
    return statistics_of(dataset, tallies.values(), selected=scenarios is not None, interactions=interactions)


def remove_shards(
    dataset: Dataset, out: str | os.PathLike[str], scenarios: Chosen = None, *, interactions: bool = False
) -> None:
    """Remove what shards kept, once the whole is written; arguments and errors are those of `merged_statistics`."""
    _shard_files(dataset, out, chosen_rows(dataset, scenarios), interactions=interactions).remove()


def _shard_files(
    dataset: Dataset, out: str | os.PathLike[str], rows: Sequence[int], *, interactions: bool
) -> ShardFiles:
    """The files of the shards of these scenarios of this state of the release, with or without interactions."""
    text = repr((__version__, dataset.tables_folder.name, runs_of(rows), interactions))
    return ShardFiles(path_of(out).absolute(), hashlib.blake2b(text.encode(), digest_size=8).hexdigest(), ".npz")


def _write(path: Path, tallies: Mapping[int, Tally]) -> None:
    """Write tallies by the row of their first scenario; the same ones give the same bytes."""
    content, values, times = [], [np.zeros(0)], [np.zeros(0, dtype=np.int64)]
    for first, tally in tallies.items():
        lengths = []
        for key, parts in tally.values.items():
            values += [part for part, _ in parts]
            times += [part for _, part in parts]
            lengths.append([*key, sum(len(part) for part, _ in parts)])
        counts = [[*key, number] for key, number in tally.counts.items()]
        pairs = {row: asdict(pair) for row, pair in tally.pairs.items()}
        content.append({"first": first, "counts": counts, "lengths": lengths, "pairs": pairs})
    text = np.frombuffer(json.dumps(content).encode(), np.uint8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, content=text, values=np.concatenate(values), times=np.concatenate(times))


def _read(path: Path) -> dict[int, Tally]:
    """The tallies in a file, by the row of their first scenario; none if it is not there or damaged."""
    try:
        with open_zip(path) as archive:
            content, values, times = (read_array(archive, name, "results") for name in _ARRAYS)
        tallies, start = {}, 0
        for stored in parsed_json(content.tobytes(), constants=True):
            tally = tallies[stored["first"]] = Tally(
                counts=Counter({(table, word, group): number for table, word, group, number in stored["counts"]}),
                pairs={int(row): CollisionPair(**pair) for row, pair in stored["pairs"].items()},
            )
            for *key, length in stored["lengths"]:
                part = slice(start, start + length)
                tally.values[tuple(key)].append((values[part], times[part]))
                start += length
    except (*DAMAGED_ARCHIVE, TypeError, AttributeError):
        return {}
    return tallies if start == len(values) == len(times) else {}
