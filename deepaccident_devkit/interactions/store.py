"""Files of interactions: one a scenario, in the folder of the tables, so that they go when these are made again."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.files import place_in
from deepaccident_devkit.interactions.config import InteractionConfig
from deepaccident_devkit.interactions.records import interaction_specs
from deepaccident_devkit.interactions.table import InteractionPairs, Interactions, array_names
from deepaccident_devkit.parallel import Store
from deepaccident_devkit.tables.columns import NULL_INTEGER
from deepaccident_devkit.tables.store import read_streams, streams

logger = logging.getLogger(__name__)

FOLDER: Final = "interactions"
VERSION: Final = "1"
"""Counted up where the same tracks give other numbers, so that kept files are made again."""


def kept_path(dataset: Dataset, scenario: str) -> Path:
    """Where the interactions of a scenario are kept; raises OutputFolderError if that is behind a link."""
    return _store(dataset).path(scenario)


def read_kept(dataset: Dataset, scenario: str, config: InteractionConfig) -> Interactions | None:
    """The kept interactions of a scenario; None if there are none of this version, or the file is damaged."""
    import pyarrow as pa

    content = _store(dataset).kept(scenario, _key(config), "index")
    if content is None:
        return None
    tables = read_streams(pa.BufferReader(content), list(interaction_specs().values()))
    return None if tables is None else _from_columns(dataset, scenario, config, tables)


def keep(dataset: Dataset, found: Interactions) -> bool:
    """Write the file of a scenario's interactions; whether that could be done."""
    if not dataset.tables_folder.is_dir():  # made again meanwhile
        return False
    content = streams(list(zip(interaction_specs().values(), _to_columns(dataset, found), strict=True)))
    try:
        _store(dataset).keep(found.scenario, _key(found.config), content)
    except OSError as error:
        logger.debug("%s: interactions are not kept: %s", found.scenario, error)
        return False
    return True


def _store(dataset: Dataset) -> Store:
    """Nobody locks it: two processes write the same file, one after the other."""
    folder = place_in(dataset.tables_folder, FOLDER, opened=True)
    return Store(folder, folder, "keeps interactions", IndexStoreError)


def _key(config: InteractionConfig) -> str:
    return f"{VERSION} {config!r}"


def _to_columns(dataset: Dataset, found: Interactions) -> list[dict[str, Any]]:
    """The stored columns of both tables; keys count in the tables of the index."""
    first_frame, actors, first_actor = _keys(dataset, found.scenario)
    pairs = found.pairs

    def rows(ids: Any) -> dict[str, Any]:
        positions = np.searchsorted(actors, ids) + first_actor
        return {"first_row": positions[:, 0], "second_row": positions[:, 1]}

    def frame_row(frames: Any) -> Any:
        return np.where(frames > 0, frames - 1 + first_frame, NULL_INTEGER)

    return [
        {
            "frame_row": frame_row(found.frame),
            **rows(found.actor_ids),
            **{name: getattr(found, name) for name in array_names(Interactions)},
        },
        {
            "scenario_row": np.full(len(pairs), dataset.getind("scenario", found.scenario)),
            **rows(pairs.actor_ids),
            "min_ttc_frame_row": frame_row(pairs.min_ttc_frame),
            "min_gap_frame_row": frame_row(pairs.min_gap_frame),
            **{name: getattr(pairs, name) for name in array_names(InteractionPairs)},
        },
    ]


def _from_columns(
    dataset: Dataset, scenario: str, config: InteractionConfig, tables: Sequence[dict[str, Any]]
) -> Interactions:
    first_frame, actors, first_actor = _keys(dataset, scenario)
    rows, pairs = tables

    def ids(table: dict[str, Any]) -> Any:
        return actors[np.column_stack([table["first_row"], table["second_row"]]) - first_actor]

    def frames(keys: Any) -> Any:
        return np.where(keys >= 0, keys.astype(np.int64) - first_frame + 1, 0)

    return Interactions(
        scenario=scenario,
        config=config,
        labelled=True,
        frame=frames(rows["frame_row"]),
        actor_ids=ids(rows),
        pairs=InteractionPairs(
            scenario=scenario,
            actor_ids=ids(pairs),
            min_ttc_frame=frames(pairs["min_ttc_frame_row"]),
            min_gap_frame=frames(pairs["min_gap_frame_row"]),
            **{name: pairs[name] for name in array_names(InteractionPairs)},
        ),
        **{name: rows[name] for name in array_names(Interactions)},
    )


def _keys(dataset: Dataset, scenario: str) -> tuple[int, Any, int]:
    """The row of a scenario's first frame, the ids of its actors, and the row of the first of these."""
    row = dataset.getind("scenario", scenario)
    instances = dataset.columns("instance")
    first, last = instances["scenario_row"].searchsorted((row, row + 1))
    return dataset.columns("scenario")["first_frame_row"].item(row), instances["actor_id"][first:last], int(first)
