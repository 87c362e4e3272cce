"""The interactions of a scenario, or of many: computed from the tracks, or read where they are kept."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.interactions.compute import measured_pairs, pair_summaries
from deepaccident_devkit.interactions.config import InteractionConfig
from deepaccident_devkit.interactions.motion import actor_motion
from deepaccident_devkit.interactions.store import keep, kept_path, read_kept
from deepaccident_devkit.interactions.table import InteractionPairs, Interactions, array_names
from deepaccident_devkit.parallel import Places, Progress, in_order, run_unordered
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from concurrent.futures import Executor


def interactions(dataset: Dataset, scenario: RowArgument, config: InteractionConfig | None = None) -> Interactions:
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
        return _computed(dataset, token, chosen)
    kept = read_kept(dataset, token, chosen)
    if kept is not None:
        return kept
    found = _computed(dataset, token, chosen)
    if found.labelled:
        keep(dataset, found)
    return found


def interactions_of(
    dataset: Dataset,
    scenarios: Sequence[RowArgument] | None = None,
    config: InteractionConfig | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress = False,
) -> Iterator[Interactions]:
    """`interactions` of many scenarios, all by default, in their order; those that are not kept are made in parallel.

    Args:
        dataset: the release.
        scenarios: tokens or records.
        config: thresholds and assumptions; None for the default.
        workers: processes; None chooses by the amount of work.
        executor: any executor of `concurrent.futures` to run on, in place of own workers.
        progress: whether to show a bar.

    Raises:
        TokenError: no such scenario.
        ChoiceError: `workers` is less than 1.
        WorkerError: a worker was killed, or cannot do the work.
    """
    chosen = dataset.scenario[:] if scenarios is None else [dataset.get("scenario", each) for each in scenarios]
    tokens = [record["token"] for record in chosen]
    usual = (config or InteractionConfig()) == InteractionConfig()
    absent = [token for token in tokens if not (usual and kept_path(dataset, token).is_file())]
    made = run_unordered(
        partial(interactions, dataset, config=config),
        absent,
        workers=workers,
        executor=executor,
        label="interactions",
        progress=progress,
        places=Places(reads=dataset.places),
    )
    return _in_turn(dataset, tokens, set(absent), in_order(made))


def _in_turn(
    dataset: Dataset, tokens: Sequence[str], absent: Collection[str], made: Generator[Interactions, None, None]
) -> Iterator[Interactions]:
    """Those that were absent as they are made, the others as they are kept."""
    with closing(made):
        for token in tokens:
            yield next(made) if token in absent else interactions(dataset, token)


def _computed(dataset: Dataset, token: str, config: InteractionConfig) -> Interactions:
    tracks = scenario_tracks(dataset, token)
    motion = actor_motion(tracks, dataset.get("scenario", token)["num_frames"], config)
    measured = measured_pairs(motion, config)
    summaries = pair_summaries(motion, measured, config)
    frame, pair = np.nonzero(measured.rows.T)
    ids = motion.ids[measured.pairs]
    return Interactions(
        scenario=token,
        config=config,
        labelled=len(tracks.index) > 0,
        frame=frame + 1,
        actor_ids=ids[pair],
        pairs=InteractionPairs(
            scenario=token,
            actor_ids=ids,
            min_ttc_frame=summaries["min_ttc_frame"] + 1,
            min_gap_frame=summaries["min_gap_frame"] + 1,
            **{name: summaries[name] for name in array_names(InteractionPairs)},
        ),
        **{name: measured.values[name][pair, frame] for name in array_names(Interactions)},
    )
