"""`town_map`: the BEV cameras of a town's recordings, laid into one raster of the world."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.arrays import IntArray, as_floats
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.maps.counting import GROUND_CLASSES, Counts, Window, cells_around, count_scenario
from deepaccident_devkit.maps.hidden import hidden_ground
from deepaccident_devkit.maps.keeping import keep_map, map_path, read_map
from deepaccident_devkit.maps.looks import TownMapConfig, looks_of
from deepaccident_devkit.maps.town_map import TownMap, classes_of
from deepaccident_devkit.parallel import Places, run_unordered
from deepaccident_devkit.taxonomy import BEV_CAMERA
from deepaccident_devkit.text import choice

if TYPE_CHECKING:
    from concurrent.futures import Executor

_DEFAULT = TownMapConfig()


def town_map(
    dataset: Dataset,
    town: str,
    *,
    config: TownMapConfig = _DEFAULT,
    scenarios: Iterable[RowArgument] | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: bool = False,
) -> TownMap:
    """Map a town's ground: what the BEV cameras of its recordings saw as road, road line, sidewalk or something else.

    The map is kept beside the tables, where these can be written, so that the next call with the same town,
    configuration and scenarios only reads it. It is made again when files of the BEV cameras that were missing are
    there, or the other way round.

    Args:
        dataset: the release.
        town: such as `Town03`.
        config: its cells, and which pictures are read.
        scenarios: tokens or records of scenarios; those in the town are looked through. None for all of them. Give
            those of a split, if a model that reads the map must not know the others.
        workers: processes; None chooses by the number of scenarios.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        ChoiceError: the release has no recording in this town, or `workers` is less than 1.
        TokenError: no such scenario.
        NotAvailableError: none of the scenarios is in the town, or has a readable file of a BEV camera.
        WorkerError: a worker was killed, or cannot do the work.
    """
    town, rows = _scenarios_in(dataset, town, scenarios)
    path = map_path(dataset, town, _tokens(dataset, rows), config)
    kept = _kept(dataset, town, rows, config)
    if kept is not None:
        return kept
    windows = run_unordered(
        partial(count_scenario, dataset, config),
        rows,
        workers=workers,
        executor=executor,
        label=f"mapping {town}",
        progress=progress,
        places=Places(reads=dataset.places),
    )
    made = _joined(dataset, town, rows, config, (window for _, window in windows))
    keep_map(path, made)
    return made


def kept_town_map(dataset: Dataset, town: str, *, config: TownMapConfig = _DEFAULT) -> TownMap | None:
    """The map of a town from all its scenarios, as an earlier `town_map` has kept it; nothing is made.

    Raises:
        ChoiceError: the release has no recording in this town.
    """
    town, rows = _scenarios_in(dataset, town, None)
    return read_map(map_path(dataset, town, _tokens(dataset, rows), config), town, config.resolution)


def towns_of(dataset: Dataset, scenarios: Iterable[RowArgument] | None = None) -> list[str]:
    """The towns of a release's scenarios, or of some of them, in the order of their names.

    Raises:
        TokenError: no such scenario.
    """
    if scenarios is None:
        return sorted(dataset.columns("scenario")["town"].unique().to_pylist())
    return sorted({dataset.scenario[dataset.getind("scenario", each)]["town"] for each in scenarios})


def _scenarios_in(dataset: Dataset, town: str, scenarios: Iterable[RowArgument] | None) -> tuple[str, Sequence[int]]:
    """The town's name, and the rows of its scenarios, ascending."""
    town = choice("town", town, towns_of(dataset))
    rows = [dataset.getind("scenario", token) for token in dataset.field2token("scenario", "town", town)]
    if scenarios is None:
        return town, rows
    if isinstance(scenarios, str):
        raise ChoiceError(f"scenarios: expected several tokens or records, found {scenarios!r}; put it into a list")
    wanted = {dataset.getind("scenario", each) for each in scenarios}
    chosen = [row for row in rows if row in wanted]
    if not chosen:
        raise NotAvailableError(f"none of the {len(wanted)} scenarios given is in {town}; leave scenarios= out for all")
    return town, chosen


def _tokens(dataset: Dataset, rows: Sequence[int]) -> list[str]:
    return [dataset.scenario[row]["token"] for row in rows]


def _kept(dataset: Dataset, town: str, rows: Sequence[int], config: TownMapConfig) -> TownMap | None:
    """The kept map, unless the files that it was made from are no longer those that are there."""
    found = read_map(map_path(dataset, town, _tokens(dataset, rows), config), town, config.resolution)
    if found is None or not found.missing:
        return found
    files = (path for row in rows for recording in looks_of(dataset, row, config) for path in recording.files(dataset))
    return found if sum(not path.exists() for path in files) == found.missing else None


def _joined(
    dataset: Dataset, town: str, rows: Sequence[int], config: TownMapConfig, windows: Iterable[Window]
) -> TownMap:
    """The map that the windows of all scenarios add up to, in any order, cut to what was seen."""
    poses = np.concatenate([recording.poses for row in rows for recording in looks_of(dataset, row, config)])
    low, high = cells_around(poses, config.resolution)
    shape = tuple((high - low).tolist())
    counts = np.zeros((len(GROUND_CLASSES), *shape), dtype=np.uint16)
    agents = np.zeros(shape, dtype=np.uint16)
    tally = {"looks": 0, "missing": 0, "damaged": 0}
    for window in windows:
        row, column = (np.array(window.corner) - low).tolist()
        height, width = window.agents.shape
        rows_in, columns_in = slice(row, row + height), slice(column, column + width)
        counts[:, rows_in, columns_in] += window.counts
        agents[rows_in, columns_in] += window.agents
        for name in tally:
            tally[name] += getattr(window, name)
    if not tally["looks"]:
        raise NotAvailableError(
            f"{town}: none of its {len(rows)} scenarios has a readable file of the BEV camera; unpack {BEV_CAMERA} of "
            "train or val (the test split ships without)"
        )
    first, counts, agents = _cut(counts, agents)
    origin = as_floats((low + first)[::-1] * config.resolution)
    return TownMap(
        town=town,
        resolution=config.resolution,
        origin=origin,
        counts=counts,
        agents=agents,
        hidden=hidden_ground(classes_of(counts), config.resolution),
        scenarios=len(rows),
        **tally,
    )


def _cut(counts: Counts, agents: Counts) -> tuple[IntArray, Counts, Counts]:
    """The first cell, the counts and the agents of what is left without the edges where nothing was seen."""
    rows, columns = (np.flatnonzero((agents > 0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        rows = columns = np.zeros(1, dtype=np.int64)
    kept_rows, kept_columns = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    first = np.array([rows[0], columns[0]])
    return first, counts[:, kept_rows, kept_columns].copy(), agents[kept_rows, kept_columns].copy()
