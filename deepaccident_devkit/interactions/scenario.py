"""The interactions of a scenario, or of many: computed from the tracks, or read where they are kept.

They are kept in files, one a scenario, in the folder of the tables, so that they go when these are made again.
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
"""Counted up where the same tracks give other numbers, so that kept files are made again."""
# Scenarios whose interactions take some seconds, if none are kept.
_WORTH_A_BAR: Final = 32


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
    content = streams(
        list(zip(interaction_specs().values(), _to_columns(dataset, found), strict=True))
    )
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
    return (
        dataset.columns("scenario")["first_frame_row"].item(row),
        instances["actor_id"][first:last],
        int(first),
    )


def interactions(
    dataset: Dataset, scenario: RowArgument, config: InteractionConfig | None = None
) -> Interactions:
    """The pairs of a scenario's road users that come near each other: how near, how fast, how soon they would touch.

    Seen from above, from the labels of all agents (`track`). With the default config they are computed once and kept
    with the index, where that can be written; with another one they are computed each time.

    Args:
        dataset: the release.
        scenario: token or record.
        config: thresholds and assumptions; None for the default.

    Returns:
        No rows for a scenario without labels, whose `labelled` is then False.

    Raises:
        TokenError: no such scenario.
        ConfigError: a class has no mass.
    """
    token = dataset.scenario[dataset.getind("scenario", scenario)]["token"]
    chosen = InteractionConfig() if config is None else config
    if chosen != InteractionConfig():
        return computed_interactions(dataset, token, chosen)
    kept = read_kept(dataset, token, chosen)
    if kept is not None:
        return kept
    found = computed_interactions(dataset, token, chosen)
    if found.labelled:
        keep(dataset, found)
    return found


def interactions_of(
    dataset: Dataset,
    scenarios: Sequence[RowArgument] | None = None,
    config: InteractionConfig | None = None,
    **how: Unpack[Engine],
) -> Iterator[Interactions]:
    """`interactions` of many scenarios, all by default, in their order; those that are not kept are made in parallel.

    Args:
        dataset: the release.
        scenarios: tokens or records.
        config: thresholds and assumptions; None for the default.
        **how: `workers`, `executor` and `progress`, as `parallel.Engine` says.

    Raises:
        TokenError: no such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    tokens = [dataset.scenario[row]["token"] for row in rows_of_scenarios(dataset, scenarios)]
    usual = (config or InteractionConfig()) == InteractionConfig()
    absent = [token for token in tokens if not (usual and kept_path(dataset, token).is_file())]
    made = run_unordered(
        partial(interactions, dataset, config=config),
        absent,
        label="interactions",
        places=Places(reads=dataset.places),
        **how,
    )
    return _in_turn(dataset, tokens, set(absent), in_order(made))


def _in_turn(
    dataset: Dataset,
    tokens: Sequence[str],
    absent: Collection[str],
    made: Generator[Interactions, None, None],
) -> Iterator[Interactions]:
    """Those that were absent as they are made, the others as they are kept."""
    with closing(made):
        for token in tokens:
            yield next(made) if token in absent else interactions(dataset, token)


def _least(values: FloatArray) -> float:
    return float(values.min(initial=math.inf))


# The fields of queries that are measures of the pairs each of which moves at some frame.
_MEASURES: Final[Mapping[str, Callable[[InteractionPairs, BoolArray], float]]] = {
    "min_ttc": lambda pairs, moving: _least(pairs.min_ttc[moving]),
    "min_pet": lambda pairs, moving: _least(np.abs(pairs.pet[moving])),
    "min_gap": lambda pairs, moving: _least(pairs.min_gap[moving]),
    "max_drac": lambda pairs, moving: float(pairs.max_drac[moving].max(initial=0.0)),
}


def measures_of_moving_pairs(found: Interactions) -> dict[str, float | None]:
    """These measures of a scenario's interactions; None without labels."""
    moving = found.pairs.moving
    return {
        name: measure(found.pairs, moving) if found.labelled else None
        for name, measure in _MEASURES.items()
    }


def each_of_moving_pairs(
    name: str, dataset: Dataset, scenarios: Sequence[RowArgument]
) -> Iterator[float | None]:
    """One of these measures of each scenario, in their order."""
    for found in interactions_of(dataset, scenarios, progress=len(scenarios) >= _WORTH_A_BAR):
        yield measures_of_moving_pairs(found)[name]


def least_times(
    dataset: Dataset, scenarios: Sequence[RowArgument], **how: Unpack[Engine]
) -> list[FloatArray]:
    """The least times to collision (L,) of each scenario's moving pairs, seconds; `how` as of `interactions_of`."""
    return [
        each.pairs.min_ttc[each.pairs.moving] for each in interactions_of(dataset, scenarios, **how)
    ]


def interactions_of_tracks(
    scenario: str, tracks: ScenarioTracks, num_frames: int, config: InteractionConfig
) -> Interactions:
    """The interactions of a scenario (its token) of so many frames, from its tracks; raises ConfigError."""
    motion = actor_motion(tracks, num_frames, config)
    measured = measured_pairs(motion, config)
    summaries = pair_summaries(motion, measured, config)
    frame, pair = np.nonzero(measured.rows.T)
    ids = motion.ids[measured.pairs]
    return Interactions(
        scenario=scenario,
        config=config,
        labelled=len(tracks.index) > 0,
        frame=frame + 1,
        actor_ids=ids[pair],
        pairs=InteractionPairs(
            scenario=scenario,
            actor_ids=ids,
            min_ttc_frame=summaries["min_ttc_frame"] + 1,
            min_gap_frame=summaries["min_gap_frame"] + 1,
            **{name: summaries[name] for name in array_names(InteractionPairs)},
        ),
        **{name: measured.values[name][pair, frame] for name in array_names(Interactions)},
    )


def computed_interactions(dataset: Dataset, token: str, config: InteractionConfig) -> Interactions:
    """The interactions of a scenario, made anew."""
    return interactions_of_tracks(
        token, scenario_tracks(dataset, token), dataset.get("scenario", token)["num_frames"], config
    )
