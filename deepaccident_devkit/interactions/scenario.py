"""Interactions of one scenario or many: computed from the tracks, or read from stored files.

Each scenario has one file. It is in the folder of the index's tables, so that it is deleted
when the tables are rebuilt.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import IndexStoreError
from deepaccident_devkit.interactions.compute import actor_motion, measured_pairs, pair_summaries
from deepaccident_devkit.interactions.table import (
    InteractionConfig,
    InteractionPairs,
    Interactions,
    array_names,
    interaction_specs,
)
from deepaccident_devkit.support.arrays import FloatArray, IntArray
from deepaccident_devkit.support.files import place_in
from deepaccident_devkit.support.parallel import Places, Store, in_order, run_unordered
from deepaccident_devkit.tables.arrow_files import read_streams, streams
from deepaccident_devkit.tables.columns import NULL_INTEGER
from deepaccident_devkit.tables.tables import rows_of_scenarios
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.support.parallel import Engine


logger = logging.getLogger(__name__)

FOLDER = "interactions"
VERSION = "1"
"""Version of the stored values.

Increase it when the same tracks yield other values, so that stored files are made again.
"""
# Number of scenarios from which progress is shown: a few seconds of work if none is stored.
_MIN_SCENARIOS_FOR_BAR = 32
# Name of a stored column → its array.
_Columns = dict[str, Any]


def interactions_path(dataset: Dataset, scenario: str) -> Path:
    """Return where a scenario's interactions are stored.

    Raise an OutputFolderError if the folder is reached through a link.
    """
    return _open_store(dataset).path(scenario)


def read_interactions(
    dataset: Dataset, scenario: str, config: InteractionConfig
) -> Interactions | None:
    """Read the stored interactions of a scenario.

    Returns:
        The interactions; None if none of this version are stored, or the file is damaged.
    """
    import pyarrow as pa

    content = _open_store(dataset).read_result(scenario, _store_key(config), "index")
    if content is None:
        return None
    specs = list(interaction_specs().values())
    tables = read_streams(pa.BufferReader(content), specs)
    if tables is None:
        return None
    return _from_columns(dataset, scenario, config, tables)


def store_interactions(dataset: Dataset, result: Interactions) -> bool:
    """Write a scenario's interactions to their file; return whether they were written."""
    if not dataset.tables_folder.is_dir():  # the tables have been rebuilt in the meantime
        return False
    specs = interaction_specs().values()
    columns = _to_columns(dataset, result)
    content = streams(list(zip(specs, columns, strict=True)))
    try:
        _open_store(dataset).write_result(result.scenario, _store_key(result.config), content)
    except OSError as error:
        logger.debug("%s: interactions are not kept: %s", result.scenario, error)
        return False
    return True


def _open_store(dataset: Dataset) -> Store:
    """Open the store of a release's interactions.

    It needs no lock: two processes would write identical files, one after the other.
    """
    folder = place_in(dataset.tables_folder, FOLDER, opened=True)
    return Store(folder, folder, "is storing interactions", IndexStoreError)


def _store_key(config: InteractionConfig) -> str:
    """Return the key under which interactions are stored; it contains the version and config."""
    return f"{VERSION} {config!r}"


def _to_columns(dataset: Dataset, result: Interactions) -> list[_Columns]:
    """Convert both tables to the columns that are stored.

    Scenarios, actors and frames are stored as row numbers in the index's tables.
    """
    first_frame, actor_ids, first_actor = _index_keys(dataset, result.scenario)
    pairs = result.pairs

    def actor_columns(pair_ids: IntArray) -> _Columns:
        rows = np.searchsorted(actor_ids, pair_ids) + first_actor
        return {"first_row": rows[:, 0], "second_row": rows[:, 1]}

    def frame_rows(frames: IntArray) -> Any:
        return np.where(frames > 0, frames - 1 + first_frame, NULL_INTEGER)

    moment_columns = {
        "frame_row": frame_rows(result.frame),
        **actor_columns(result.actor_ids),
    }
    for name in array_names(Interactions):
        moment_columns[name] = getattr(result, name)
    pair_columns = {
        "scenario_row": np.full(len(pairs), dataset.getind("scenario", result.scenario)),
        **actor_columns(pairs.actor_ids),
        "min_ttc_frame_row": frame_rows(pairs.min_ttc_frame),
        "min_gap_frame_row": frame_rows(pairs.min_gap_frame),
    }
    for name in array_names(InteractionPairs):
        pair_columns[name] = getattr(pairs, name)
    return [moment_columns, pair_columns]


def _from_columns(
    dataset: Dataset, scenario: str, config: InteractionConfig, tables: Sequence[_Columns]
) -> Interactions:
    """Rebuild a scenario's interactions from the stored columns of both tables."""
    first_frame, actor_ids, first_actor = _index_keys(dataset, scenario)
    moments, pairs = tables

    def read_actor_ids(table: _Columns) -> Any:
        rows = np.column_stack([table["first_row"], table["second_row"]])
        return actor_ids[rows - first_actor]

    def read_frames(rows: IntArray) -> Any:
        frames = rows.astype(np.int64) - first_frame + 1
        return np.where(rows >= 0, frames, 0)

    return Interactions(
        scenario=scenario,
        config=config,
        labelled=True,
        frame=read_frames(moments["frame_row"]),
        actor_ids=read_actor_ids(moments),
        pairs=InteractionPairs(
            scenario=scenario,
            actor_ids=read_actor_ids(pairs),
            min_ttc_frame=read_frames(pairs["min_ttc_frame_row"]),
            min_gap_frame=read_frames(pairs["min_gap_frame_row"]),
            **{name: pairs[name] for name in array_names(InteractionPairs)},
        ),
        **{name: moments[name] for name in array_names(Interactions)},
    )


def _index_keys(dataset: Dataset, scenario: str) -> tuple[int, Any, int]:
    """Return what converts between a scenario's tokens and row numbers in the index's tables.

    Returns:
        Row of the scenario's first frame, ids of its actors, and row of the first of these actors.
    """
    row = dataset.getind("scenario", scenario)
    instances = dataset.columns("instance")
    begin, end = instances["scenario_row"].searchsorted((row, row + 1))
    first_frame = dataset.columns("scenario")["first_frame_row"].item(row)
    return first_frame, instances["actor_id"][begin:end], int(begin)


def interactions(
    dataset: Dataset, scenario: RowArgument, config: InteractionConfig | None = None
) -> Interactions:
    """Return the pairs of a scenario's road users that come close to each other.

    Distances, speeds and times to contact of each pair are computed in top view, from the labels of
    all agents (`track`). With the default config, they are computed once and stored with the index
    if its folder is writable. With another config, they are computed on each call.

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.
        config: Thresholds and assumptions; None for the default.

    Returns:
        The interactions; without rows, and with `labelled` False, if the scenario has no labels.

    Raises:
        TokenError: If the release has no such scenario.
        ConfigError: If an actor's class has no mass in the config.
    """
    token = dataset.scenario[dataset.getind("scenario", scenario)]["token"]
    if config is None:
        config = InteractionConfig()
    if config != InteractionConfig():
        return computed_interactions(dataset, token, config)
    stored = read_interactions(dataset, token, config)
    if stored is not None:
        return stored
    result = computed_interactions(dataset, token, config)
    if result.labelled:
        store_interactions(dataset, result)
    return result


def interactions_of(
    dataset: Dataset,
    scenarios: Sequence[RowArgument] | None = None,
    config: InteractionConfig | None = None,
    **engine: Unpack[Engine],
) -> Iterator[Interactions]:
    """Return the `interactions` of many scenarios in the order passed; of all by default.

    Interactions that are not stored are computed in parallel.

    Args:
        dataset: The release.
        scenarios: Tokens or records of scenarios; None for all.
        config: Thresholds and assumptions; None for the default.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.

    Raises:
        TokenError: If the release has no such scenario.
        ChoiceError: If `workers` is less than 1.
        WorkerError: If a worker was killed, or cannot do the work.
    """
    tokens = [dataset.scenario[row]["token"] for row in rows_of_scenarios(dataset, scenarios)]
    is_default = config is None or config == InteractionConfig()
    missing = []
    for token in tokens:
        is_stored = is_default and interactions_path(dataset, token).is_file()
        if not is_stored:
            missing.append(token)
    results = run_unordered(
        partial(interactions, dataset, config=config),
        missing,
        label="Measuring interactions",
        places=Places(reads=dataset.places),
        **engine,
    )
    return _yield_in_order(dataset, tokens, set(missing), in_order(results))


def _yield_in_order(
    dataset: Dataset,
    tokens: Sequence[str],
    missing: Collection[str],
    computed: Generator[Interactions, None, None],
) -> Iterator[Interactions]:
    """Yield the interactions of scenarios in their order.

    The ones in `missing` are taken from `computed`; the others are read from their files.
    """
    with closing(computed):
        for token in tokens:
            if token in missing:
                yield next(computed)
            else:
                yield interactions(dataset, token)


def _minimum(values: FloatArray) -> float:
    """Return the minimum; infinite if `values` is empty."""
    return float(values.min(initial=math.inf))


def measures_of_moving_pairs(result: Interactions) -> dict[str, float | None]:
    """Return the measures for queries, over the pairs in which both actors move.

    All are None for a scenario without labels.
    """
    pairs = result.pairs
    moving = pairs.moving
    measures: dict[str, float | None] = {
        "min_ttc": _minimum(pairs.min_ttc[moving]),
        "min_pet": _minimum(np.abs(pairs.pet[moving])),
        "min_gap": _minimum(pairs.min_gap[moving]),
        "max_drac": float(pairs.max_drac[moving].max(initial=0.0)),
    }
    if not result.labelled:
        return dict.fromkeys(measures)
    return measures


def iterate_measure(
    name: str, dataset: Dataset, scenarios: Sequence[RowArgument]
) -> Iterator[float | None]:
    """Yield one field of `measures_of_moving_pairs` for each scenario, in order."""
    show_bar = len(scenarios) >= _MIN_SCENARIOS_FOR_BAR
    for result in interactions_of(dataset, scenarios, progress=show_bar):
        yield measures_of_moving_pairs(result)[name]


def min_times_to_collision(
    dataset: Dataset, scenarios: Sequence[RowArgument], **engine: Unpack[Engine]
) -> list[FloatArray]:
    """Return each scenario's minimum times to collision of moving pairs in seconds, shape (L,).

    `engine` has the same options as for `interactions_of`.
    """
    times = []
    for result in interactions_of(dataset, scenarios, **engine):
        pairs = result.pairs
        times.append(pairs.min_ttc[pairs.moving])
    return times


def interactions_of_tracks(
    scenario: str, tracks: ScenarioTracks, num_frames: int, config: InteractionConfig
) -> Interactions:
    """Compute the interactions of a scenario from its tracks.

    Args:
        scenario: Token of the scenario.
        tracks: Tracks of the scenario.
        num_frames: Number of frames of the scenario.
        config: Thresholds and assumptions.

    Raises:
        ConfigError: If an actor's class has no mass in the config.
    """
    motion = actor_motion(tracks, num_frames, config)
    measured = measured_pairs(motion, config)
    summaries = pair_summaries(motion, measured, config)
    frame, pair = np.nonzero(measured.rows.T)
    actor_ids = motion.ids[measured.pairs]
    return Interactions(
        scenario=scenario,
        config=config,
        labelled=len(tracks.index) > 0,
        frame=frame + 1,
        actor_ids=actor_ids[pair],
        pairs=InteractionPairs(
            scenario=scenario,
            actor_ids=actor_ids,
            min_ttc_frame=summaries["min_ttc_frame"] + 1,
            min_gap_frame=summaries["min_gap_frame"] + 1,
            **{name: summaries[name] for name in array_names(InteractionPairs)},
        ),
        **{name: measured.values[name][pair, frame] for name in array_names(Interactions)},
    )


def computed_interactions(dataset: Dataset, token: str, config: InteractionConfig) -> Interactions:
    """Compute the interactions of a scenario, even if they are stored."""
    tracks = scenario_tracks(dataset, token)
    scenario = dataset.get("scenario", token)
    return interactions_of_tracks(token, tracks, scenario["num_frames"], config)
