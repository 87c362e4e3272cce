"""`town_map`: the BEV cameras of a town's recordings, laid into one raster of the world.

A map is kept in the folder of the tables, and goes when they are made again. Where nothing can be written, it is not.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import IndexStoreError, NotAvailableError
from deepaccident_devkit.maps.counting import (
    GROUND_CLASSES,
    PixelCounts,
    TownMapConfig,
    Window,
    cells_around,
    count_scenario,
    hidden_ground,
    looks_of,
)
from deepaccident_devkit.maps.town_map import TownMap, classes_of
from deepaccident_devkit.support.arrays import IntArray, as_floats
from deepaccident_devkit.support.files import place_in
from deepaccident_devkit.support.parallel import Places, Store, run_unordered
from deepaccident_devkit.support.reading import byte_limit, open_zip, read_array
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.tables.tables import rows_of_scenarios
from deepaccident_devkit.taxonomy import BEV_CAMERA

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine

_DEFAULT = TownMapConfig()
_FOLDER: Final = "town_maps"
# Counts up whenever the same pictures give another map, or the file's form changes.
_FORMAT: Final = 2
_ARRAYS: Final = ("origin", "counts", "agents", "hidden")
_NUMBERS: Final = ("scenarios", "looks", "missing", "damaged")


def town_map(
    dataset: Dataset,
    town: str,
    *,
    config: TownMapConfig = _DEFAULT,
    scenarios: Iterable[RowArgument] | None = None,
    **how: Unpack[Engine],
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
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        ChoiceError: the release has no recording in this town.
        TokenError: no such scenario.
        NotAvailableError: none of the scenarios is in the town, or has a readable file of a BEV camera.
    """
    town, rows = _scenarios_in(dataset, town, scenarios)
    found = _read(dataset, town, rows, config)
    if found is not None and (
        not found.missing or found.missing == _missing(dataset, rows, config)
    ):
        return found
    work, places = partial(count_scenario, dataset, config), Places(reads=dataset.places)
    windows = run_unordered(work, rows, label=f"mapping {town}", places=places, **how)
    made = _joined(dataset, town, rows, config, (window for _, window in windows))
    _keep(dataset, _key(dataset, town, rows, config), made)
    return made


def kept_town_map(
    dataset: Dataset, town: str, *, config: TownMapConfig = _DEFAULT
) -> TownMap | None:
    """The map of a town from all its scenarios, as an earlier `town_map` has kept it; nothing is made.

    Raises:
        ChoiceError: the release has no recording in this town.
    """
    town, rows = _scenarios_in(dataset, town, None)
    return _read(dataset, town, rows, config)


def towns_of(dataset: Dataset, scenarios: Iterable[RowArgument] | None = None) -> list[str]:
    """The towns of a release's scenarios, or of some of them, in the order of their names.

    Raises:
        TokenError: no such scenario.
    """
    if scenarios is None:
        return sorted(dataset.columns("scenario")["town"].unique().to_pylist())
    return sorted({dataset.scenario[row]["town"] for row in rows_of_scenarios(dataset, scenarios)})


def _scenarios_in(
    dataset: Dataset, town: str, scenarios: Iterable[RowArgument] | None
) -> tuple[str, Sequence[int]]:
    """The town's name, and the rows of its scenarios, ascending."""
    town = choice("town", town, towns_of(dataset))
    rows = [
        dataset.getind("scenario", token) for token in dataset.field2token("scenario", "town", town)
    ]
    if scenarios is None:
        return town, rows
    wanted = set(rows_of_scenarios(dataset, scenarios))
    chosen = [row for row in rows if row in wanted]
    if not chosen:
        raise NotAvailableError(
            f"none of the {len(wanted)} scenarios given is in {town}; leave scenarios= out for all"
        )
    return town, chosen


def _missing(dataset: Dataset, rows: Sequence[int], config: TownMapConfig) -> int:
    """How many of the pictures that a map is made from are not there."""
    files = (
        path
        for row in rows
        for recording in looks_of(dataset, row, config)
        for path in recording.files(dataset)
    )
    return sum(not path.exists() for path in files)


def _key(dataset: Dataset, town: str, rows: Sequence[int], config: TownMapConfig) -> str:
    """A digest of all that was asked for."""
    text = repr((_FORMAT, town, tuple(dataset.scenario[row]["token"] for row in rows), config))
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def _store(dataset: Dataset) -> Store:
    """Nobody locks it: two processes write the same map, one after the other."""
    folder = place_in(dataset.tables_folder, _FOLDER, opened=True)
    return Store(folder, folder, "keeps town maps", IndexStoreError)


def _read(
    dataset: Dataset, town: str, rows: Sequence[int], config: TownMapConfig
) -> TownMap | None:
    """The map that is kept; None if there is none, or if its file is damaged."""
    store, key = _store(dataset), _key(dataset, town, rows, config)
    try:
        state = store.path(key).stat()
    except OSError:
        return None
    return _unpacked(
        store, key, town, config.resolution, (state.st_mtime_ns, state.st_size, state.st_ino)
    )


@lru_cache(maxsize=1)  # every picture of a video asks for the same one
def _unpacked(
    store: Store, key: str, town: str, resolution: float, _state: tuple[int, ...]
) -> TownMap | None:
    """The map in a file; its state tells it from another that takes its place."""
    content = store.kept(key, key, "index")
    if content is None:
        return None
    with open_zip(content) as archive:
        arrays: dict[str, Any] = {
            name: read_array(archive, name, "index") for name in (*_ARRAYS, "numbers")
        }
    numbers = dict(zip(_NUMBERS, arrays.pop("numbers").tolist(), strict=True))
    return TownMap(town=town, resolution=resolution, **arrays, **numbers)


def _keep(dataset: Dataset, key: str, made: TownMap) -> None:
    """Keep a map, if its file can be written and would be read again; the same map gives the same bytes."""
    content, numbers = (
        io.BytesIO(),
        np.array([getattr(made, name) for name in _NUMBERS], dtype=np.int64),
    )
    np.savez_compressed(content, **{name: getattr(made, name) for name in _ARRAYS}, numbers=numbers)
    if made.counts.nbytes <= byte_limit("index") and dataset.tables_folder.is_dir():
        with suppress(OSError):  # a folder that may not be written to
            _store(dataset).keep(key, key, content.getvalue())


def _joined(
    dataset: Dataset,
    town: str,
    rows: Sequence[int],
    config: TownMapConfig,
    windows: Iterable[Window],
) -> TownMap:
    """The map that the windows of all scenarios add up to, in any order, cut to what was seen."""
    poses = np.concatenate(
        [recording.poses for row in rows for recording in looks_of(dataset, row, config)]
    )
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
    return TownMap(
        town=town,
        resolution=config.resolution,
        origin=as_floats((low + first)[::-1] * config.resolution),
        counts=counts,
        agents=agents,
        hidden=hidden_ground(classes_of(counts), config.resolution),
        scenarios=len(rows),
        **tally,
    )


def _cut(counts: PixelCounts, agents: PixelCounts) -> tuple[IntArray, PixelCounts, PixelCounts]:
    """The first cell, the counts and the agents of what is left without the edges where nothing was seen."""
    rows, columns = (np.flatnonzero((agents > 0).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        rows = columns = np.zeros(1, dtype=np.int64)
    kept_rows, kept_columns = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return (
        np.array([rows[0], columns[0]]),
        counts[:, kept_rows, kept_columns].copy(),
        agents[kept_rows, kept_columns].copy(),
    )
