"""`town_map`: the BEV camera pictures of a town's recordings, combined in one raster of the world.

A map is stored in the folder of the tables, and removed when the tables are rebuilt. If the folder
is not writable, the map is not stored.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import IndexStoreError, NotAvailableError
from deepaccident_devkit.maps.counting import (
    GROUND_CLASSES,
    PixelCounts,
    TownMapConfig,
    Window,
    agent_pictures,
    cells_around,
    count_scenario,
    hidden_ground,
)
from deepaccident_devkit.maps.town_map import TownMap, classes_of
from deepaccident_devkit.support.arrays import IntArray, as_floats
from deepaccident_devkit.support.files import place_in
from deepaccident_devkit.support.parallel import Places, Store, run_unordered
from deepaccident_devkit.support.reading import byte_limit, open_zip, read_array
from deepaccident_devkit.support.text import choice, counted
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.tables.tables import rows_of_scenarios
from deepaccident_devkit.taxonomy import BEV_CAMERA

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

_DEFAULT_CONFIG = TownMapConfig()
_MAPS_FOLDER = "town_maps"
# Incremented whenever the same pictures would give another map, or the file format changes.
_FORMAT_VERSION = 2
_ARRAY_FIELDS = ("origin", "counts", "agents", "hidden")
_NUMBER_FIELDS = ("scenarios", "looks", "missing", "damaged")


def town_map(
    dataset: Dataset,
    town: str,
    *,
    config: TownMapConfig = _DEFAULT_CONFIG,
    scenarios: Iterable[RowArgument] | None = None,
    **engine: Unpack[Engine],
) -> TownMap:
    """Map a town's ground, as the BEV cameras of its recordings saw it.

    Classes are road, road line, sidewalk and other. The map is stored next to the tables, if their
    folder is writable, so that the next call with the same town, configuration and scenarios only
    reads it. It is made again if BEV camera files have been added or removed since.

    Args:
        dataset: The release.
        town: Name such as `Town03`.
        config: Cells of the map, and selection of its pictures.
        scenarios: Tokens or records; only scenarios in the town are used. None for all. Pass
            the scenarios of a split if a model that reads the map must not know the others.
        **engine: `workers`, `executor` and `progress` (`parallel.Engine`).

    Raises:
        ChoiceError: The release has no recording in this town.
        TokenError: A token names no scenario.
        NotAvailableError: None of the scenarios is in the town, or none of the ones that are has a
            readable BEV camera file.
    """
    town, rows = _scenarios_in(dataset, town, scenarios)
    stored_map = _read_map(dataset, town, rows, config)
    if stored_map is not None:
        if not stored_map.missing or stored_map.missing == _count_missing(dataset, rows, config):
            return stored_map
    work = partial(count_scenario, dataset, config)
    places = Places(reads=dataset.places)
    numbered_windows = run_unordered(work, rows, label=f"Mapping {town}", places=places, **engine)
    windows = (window for _, window in numbered_windows)
    new_map = _join_windows(dataset, town, rows, config, windows)
    key = _map_key(dataset, town, rows, config)
    _store_map(dataset, key, new_map)
    return new_map


def kept_town_map(
    dataset: Dataset, town: str, *, config: TownMapConfig = _DEFAULT_CONFIG
) -> TownMap | None:
    """Return the stored map of a town, made from all its scenarios; None if none is stored.

    Raises:
        ChoiceError: The release has no recording in this town.
    """
    town, rows = _scenarios_in(dataset, town, None)
    return _read_map(dataset, town, rows, config)


def towns_of(dataset: Dataset, scenarios: Iterable[RowArgument] | None = None) -> list[str]:
    """Return the towns of scenarios, by default of all in a release, in the order of their names.

    Raises:
        TokenError: A token names no scenario.
    """
    if scenarios is None:
        towns = dataset.columns("scenario")["town"].unique().to_pylist()
        return sorted(towns)
    rows = rows_of_scenarios(dataset, scenarios)
    return sorted({dataset.scenario[row]["town"] for row in rows})


def _scenarios_in(
    dataset: Dataset, town: str, scenarios: Iterable[RowArgument] | None
) -> tuple[str, Sequence[int]]:
    """Return the town's name, and the rows of its scenarios, ascending."""
    town = choice("town", town, towns_of(dataset))
    tokens = dataset.field2token("scenario", "town", town)
    rows = [dataset.getind("scenario", token) for token in tokens]
    if scenarios is None:
        return town, rows
    selected = set(rows_of_scenarios(dataset, scenarios))
    rows = [row for row in rows if row in selected]
    if not rows:
        raise NotAvailableError(
            f"none of the given scenarios ({len(selected)}) is in {town}; omit scenarios= to use "
            "all"
        )
    return town, rows


def _count_missing(dataset: Dataset, rows: Sequence[int], config: TownMapConfig) -> int:
    """Count the pictures for a map that have no file."""
    num_missing = 0
    for row in rows:
        for recording in agent_pictures(dataset, row, config):
            num_missing += sum(not path.exists() for path in recording.files(dataset))
    return num_missing


def _map_key(dataset: Dataset, town: str, rows: Sequence[int], config: TownMapConfig) -> str:
    """Return a digest of all that a map depends on, except the pictures."""
    tokens = tuple(dataset.scenario[row]["token"] for row in rows)
    text = repr((_FORMAT_VERSION, town, tokens, config))
    digest = hashlib.blake2b(text.encode(), digest_size=8)
    return digest.hexdigest()


def _store(dataset: Dataset) -> Store:
    """Return the store of maps; it needs no lock, since two processes write the same map."""
    folder = place_in(dataset.tables_folder, _MAPS_FOLDER, opened=True)
    return Store(folder, folder, "is storing town maps", IndexStoreError)


def _read_map(
    dataset: Dataset, town: str, rows: Sequence[int], config: TownMapConfig
) -> TownMap | None:
    """Return the stored map; None if there is none, or if its file is damaged."""
    store = _store(dataset)
    key = _map_key(dataset, town, rows, config)
    try:
        status = store.path(key).stat()
    except OSError:
        return None
    state = (status.st_mtime_ns, status.st_size, status.st_ino)
    return _unpack_map(store, key, town, config.resolution, state)


# The map is cached, since every picture of a video asks for the same one.
@lru_cache(maxsize=1)
def _unpack_map(
    store: Store, key: str, town: str, resolution: float, _state: tuple[int, ...]
) -> TownMap | None:
    """Read the map in a stored file; `_state` keeps the cache from returning an older file."""
    content = store.read_result(key, key, "index")
    if content is None:
        return None
    with open_zip(content) as archive:
        arrays: NamedValues = {
            name: read_array(archive, name, "index") for name in (*_ARRAY_FIELDS, "numbers")
        }
    numbers = dict(zip(_NUMBER_FIELDS, arrays.pop("numbers").tolist(), strict=True))
    return TownMap(town=town, resolution=resolution, **arrays, **numbers)


def _store_map(dataset: Dataset, key: str, new_map: TownMap) -> None:
    """Store a map, unless its file cannot be written or would be too large to be read again.

    The same map gives the same bytes.
    """
    content = io.BytesIO()
    numbers = np.array([getattr(new_map, name) for name in _NUMBER_FIELDS], dtype=np.int64)
    arrays = {name: getattr(new_map, name) for name in _ARRAY_FIELDS}
    np.savez_compressed(content, **arrays, numbers=numbers)
    if new_map.counts.nbytes <= byte_limit("index") and dataset.tables_folder.is_dir():
        # The folder may be read-only.
        with suppress(OSError):
            _store(dataset).write_result(key, key, content.getvalue())


def _join_windows(
    dataset: Dataset,
    town: str,
    rows: Sequence[int],
    config: TownMapConfig,
    windows: Iterable[Window],
) -> TownMap:
    """Add up the windows of all scenarios to a map, and cut off its unseen edges.

    The windows may be in any order.
    """
    recordings = [recording for row in rows for recording in agent_pictures(dataset, row, config)]
    poses = np.concatenate([recording.poses for recording in recordings])
    low, high = cells_around(poses, config.resolution)
    shape = tuple((high - low).tolist())
    counts = np.zeros((len(GROUND_CLASSES), *shape), dtype=np.uint16)
    agents = np.zeros(shape, dtype=np.uint16)
    tally = {"looks": 0, "missing": 0, "damaged": 0}
    for window in windows:
        row, column = (window.corner - low).tolist()
        height, width = window.agents.shape
        window_rows = slice(row, row + height)
        window_columns = slice(column, column + width)
        counts[:, window_rows, window_columns] += window.counts
        agents[window_rows, window_columns] += window.agents
        for name in tally:
            tally[name] += getattr(window, name)
    if not tally["looks"]:
        raise NotAvailableError(
            f"{town}: none of its {counted(len(rows), 'scenario')} has a readable file of the BEV "
            f"camera; unpack {BEV_CAMERA} of train or val (the test split has none)"
        )
    corner, counts, agents = _crop(counts, agents)
    return TownMap(
        town=town,
        resolution=config.resolution,
        origin=as_floats((low + corner)[::-1] * config.resolution),
        counts=counts,
        agents=agents,
        hidden=hidden_ground(classes_of(counts), config.resolution),
        scenarios=len(rows),
        **tally,
    )


def _crop(counts: PixelCounts, agents: PixelCounts) -> tuple[IntArray, PixelCounts, PixelCounts]:
    """Cut off unseen edges; return the lowest cell that remains, the counts and the agents.

    The lowest cell is its row and column, shape (2,). If no cell was seen, the first one remains.
    """
    seen = agents > 0
    if not seen.any():
        seen[0, 0] = True
    rows = np.flatnonzero(seen.any(axis=1))
    columns = np.flatnonzero(seen.any(axis=0))
    corner = np.array([rows[0], columns[0]])
    seen_rows = slice(rows[0], rows[-1] + 1)
    seen_columns = slice(columns[0], columns[-1] + 1)
    cropped_counts = counts[:, seen_rows, seen_columns].copy()
    cropped_agents = agents[seen_rows, seen_columns].copy()
    return corner, cropped_counts, cropped_agents
