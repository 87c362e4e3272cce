"""Interactions of one scenario or of many: computed from the tracks, or read from stored files.

There is one file for each scenario, in the folder of the tables, so that it goes when the tables
are made again.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

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
from deepaccident_devkit.support.arrays import BoolArray, FloatArray
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

FOLDER: Final = "interactions"
VERSION: Final = "1"
"""Version of the numbers.

It increases when the same tracks give other numbers, so that stored files are made again.
"""
# A progress bar is shown from this number of scenarios on: a few seconds of work if none is stored.
_MIN_SCENARIOS_FOR_BAR: Final = 32


def interactions_path(dataset: Dataset, scenario: str) -> Path:
    """Return the path of a scenario's stored interactions.

    Raises OutputFolderError if a link leads there.
    """
    return _store(dataset).path(scenario)


def read_interactions(
    dataset: Dataset, scenario: str, config: InteractionConfig
) -> Interactions | None:
    """Read the stored interactions of a scenario.

    Return None if there are none of this version, or the file is damaged.
    """
    import pyarrow as pa

    content = _store(dataset).kept(scenario, _key(config), "index")
    if content is None:
        return None
    tables = read_streams(pa.BufferReader(content), list(interaction_specs().values()))
    return None if tables is None else _from_columns(dataset, scenario, config, tables)


def store_interactions(dataset: Dataset, result: Interactions) -> bool:
    """Write the file of a scenario's interactions; return whether that succeeded."""
    if not dataset.tables_folder.is_dir():  # the tables have been made again in the meantime
        return False
    specs = interaction_specs().values()
    content = streams(list(zip(specs, _to_columns(dataset, result), strict=True)))
    try:
        _store(dataset).keep(result.scenario, _key(result.config), content)
    except OSError as error:
        logger.debug("%s: interactions are not kept: %s", result.scenario, error)
        return False
    return True


def _store(dataset: Dataset) -> Store:
    """Return the store of the interactions of a release.

    It needs no lock: two processes write the same file, one after the other.
    """
    folder = place_in(dataset.tables_folder, FOLDER, opened=True)
    return Store(folder, folder, "keeps interactions", IndexStoreError)


def _key(config: InteractionConfig) -> str:
    """Return the key of stored interactions: the version and the config."""
    return f"{VERSION} {config!r}"


def _to_columns(dataset: Dataset, result: Interactions) -> list[dict[str, Any]]:
    """Return the stored columns of both tables; keys are rows of the index's tables."""
    first_frame, actors, first_actor = _keys(dataset, result.scenario)
    pairs = result.pairs

    def actor_rows(actor_ids: Any) -> dict[str, Any]:
        rows = np.searchsorted(actors, actor_ids) + first_actor
        return {"first_row": rows[:, 0], "second_row": rows[:, 1]}

    def frame_rows(frames: Any) -> Any:
        return np.where(frames > 0, frames - 1 + first_frame, NULL_INTEGER)

    return [
        {
            "frame_row": frame_rows(result.frame),
            **actor_rows(result.actor_ids),
            **{name: getattr(result, name) for name in array_names(Interactions)},
        },
        {
            "scenario_row": np.full(len(pairs), dataset.getind("scenario", result.scenario)),
            **actor_rows(pairs.actor_ids),
            "min_ttc_frame_row": frame_rows(pairs.min_ttc_frame),
            "min_gap_frame_row": frame_rows(pairs.min_gap_frame),
            **{name: getattr(pairs, name) for name in array_names(InteractionPairs)},
        },
    ]


def _from_columns(
    dataset: Dataset, scenario: str, config: InteractionConfig, tables: Sequence[dict[str, Any]]
) -> Interactions:
    """Return the interactions of a scenario from the stored columns of both tables."""
    first_frame, actors, first_actor = _keys(dataset, scenario)
    moments, pairs = tables

    def actor_ids(table: dict[str, Any]) -> Any:
        rows = np.column_stack([table["first_row"], table["second_row"]])
        return actors[rows - first_actor]

    def frames(keys: Any) -> Any:
        return np.where(keys >= 0, keys.astype(np.int64) - first_frame + 1, 0)

    return Interactions(
        scenario=scenario,
        config=config,
        labelled=True,
        frame=frames(moments["frame_row"]),
        actor_ids=actor_ids(moments),
        pairs=InteractionPairs(
            scenario=scenario,
            actor_ids=actor_ids(pairs),
            min_ttc_frame=frames(pairs["min_ttc_frame_row"]),
            min_gap_frame=frames(pairs["min_gap_frame_row"]),
            **{name: pairs[name] for name in array_names(InteractionPairs)},
        ),
        **{name: moments[name] for name in array_names(Interactions)},
    )


def _keys(dataset: Dataset, scenario: str) -> tuple[int, Any, int]:
    """Return the keys of a scenario in the index's tables.

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

    For each pair there are distances, speeds and times to contact, seen from above, from the labels
    of all agents (`track`). With the default config they are computed once and stored with the
    index, if that can be written; with another config they are computed each time.

    Args:
        dataset: The release.
        scenario: Token or record.
        config: Thresholds and assumptions; None for the default.

    Returns:
        No rows for a scenario without labels; its `labelled` is then False.

    Raises:
        TokenError: No such scenario.
        ConfigError: A class has no mass.
    """
    token = dataset.scenario[dataset.getind("scenario", scenario)]["token"]
    full_config = InteractionConfig() if config is None else config
    if full_config != InteractionConfig():
        return computed_interactions(dataset, token, full_config)
    stored = read_interactions(dataset, token, full_config)
    if stored is not None:
        return stored
    result = computed_interactions(dataset, token, full_config)
    if result.labelled:
        store_interactions(dataset, result)
    return result


def interactions_of(
    dataset: Dataset,
    scenarios: Sequence[RowArgument] | None = None,
    config: InteractionConfig | None = None,
    **engine: Unpack[Engine],
) -> Iterator[Interactions]:
    """Return `interactions` of many scenarios, all by default, in their order.

    Interactions that are not stored are computed in parallel.

    Args:
        dataset: The release.
        scenarios: Tokens or records.
        config: Thresholds and assumptions; None for the default.
        **engine: `workers`, `executor` and `progress`, see `parallel.Engine`.

    Raises:
        TokenError: No such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: A worker was killed, or cannot do the work.
    """
    tokens = [dataset.scenario[row]["token"] for row in rows_of_scenarios(dataset, scenarios)]
    is_default = (config or InteractionConfig()) == InteractionConfig()
    missing = []
    for token in tokens:
        if not (is_default and interactions_path(dataset, token).is_file()):
            missing.append(token)
    results = run_unordered(
        partial(interactions, dataset, config=config),
        missing,
        label="interactions",
        places=Places(reads=dataset.places),
        **engine,
    )
    return _in_turn(dataset, tokens, set(missing), in_order(results))


def _in_turn(
    dataset: Dataset,
    tokens: Sequence[str],
    missing: Collection[str],
    computed: Generator[Interactions, None, None],
) -> Iterator[Interactions]:
    """Yield the missing interactions as they are computed, and the others as they are stored."""
    with closing(computed):
        for token in tokens:
            yield next(computed) if token in missing else interactions(dataset, token)


def _minimum(values: FloatArray) -> float:
    """Return the minimum, infinite without values."""
    return float(values.min(initial=math.inf))


# The fields of queries that measure the pairs in which both actors move at some frame.
_MEASURES: Final[Mapping[str, Callable[[InteractionPairs, BoolArray], float]]] = {
    "min_ttc": lambda pairs, moving: _minimum(pairs.min_ttc[moving]),
    "min_pet": lambda pairs, moving: _minimum(np.abs(pairs.pet[moving])),
    "min_gap": lambda pairs, moving: _minimum(pairs.min_gap[moving]),
    "max_drac": lambda pairs, moving: float(pairs.max_drac[moving].max(initial=0.0)),
}


def measures_of_moving_pairs(result: Interactions) -> dict[str, float | None]:
    """Return the fields of queries for a scenario's interactions; None without labels."""
    if not result.labelled:
        return dict.fromkeys(_MEASURES)
    pairs = result.pairs
    return {name: measure(pairs, pairs.moving) for name, measure in _MEASURES.items()}


def each_of_moving_pairs(
    name: str, dataset: Dataset, scenarios: Sequence[RowArgument]
) -> Iterator[float | None]:
    """Yield one field of `measures_of_moving_pairs` for each scenario, in their order."""
    show_bar = len(scenarios) >= _MIN_SCENARIOS_FOR_BAR
    for result in interactions_of(dataset, scenarios, progress=show_bar):
        yield measures_of_moving_pairs(result)[name]


def least_times(
    dataset: Dataset, scenarios: Sequence[RowArgument], **engine: Unpack[Engine]
) -> list[FloatArray]:
    """Return the minimum times to collision of each scenario's moving pairs, shape (L,), seconds.

    `engine` is as in `interactions_of`.
    """
    times = []
    for result in interactions_of(dataset, scenarios, **engine):
        times.append(result.pairs.min_ttc[result.pairs.moving])
    return times


def interactions_of_tracks(
    scenario: str, tracks: ScenarioTracks, num_frames: int, config: InteractionConfig
) -> Interactions:
    """Return the interactions of a scenario from its tracks.

    Args:
        scenario: Token.
        tracks: Tracks of the scenario.
        num_frames: Number of the scenario's frames.
        config: Thresholds and assumptions.

    Raises:
        ConfigError: A class has no mass.
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
    """Return the interactions of a scenario, computed anew."""
    num_frames = dataset.get("scenario", token)["num_frames"]
    return interactions_of_tracks(token, scenario_tracks(dataset, token), num_frames, config)
