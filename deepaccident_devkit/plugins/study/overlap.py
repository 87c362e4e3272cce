"""Which scenarios of a test a model knows from its training.

These are the same scenarios, their twins, and other recordings of either.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.taxonomy import STATIC_ACTOR_ID

# Share of one recording's actors that the other must have too, for both to be of the same scene. In
# the generator's releases nearly all twins share 0.9 or more, and recordings of different scenes
# less than 0.1.
_MIN_COMMON_SHARE: Final = 0.7
# Smaller scenes may match by chance, so their shares are computed as if they had this many actors.
_MIN_ACTOR_COUNT: Final = 4
# A release and the tokens of some of its scenarios.
ReleaseScenarios = tuple[Dataset, Collection[str]]
_Actors = set[tuple[float, ...]]


def known_scenarios(learned: ReleaseScenarios, tested: ReleaseScenarios) -> list[str]:
    """Return the tested scenarios that a training shows.

    These are the training's own scenarios, their twins, and other recordings of either. Twins and
    copies have the same actors, whatever the names of scenarios and files, and whichever frames
    they have. Within a release twins also have the same name.
    """
    learned_dataset, learned_tokens = learned
    tested_dataset, tested_tokens = tested
    learned_clusters = set()
    for token in learned_tokens:
        if learned_dataset.dataroot == tested_dataset.dataroot:
            learned_clusters.add(cluster_of(token))
    with_ids = "nuScenes" not in (learned_dataset.layout, tested_dataset.layout)
    learned_actors = _actors_by_scenario(learned_dataset, learned_tokens, with_ids=with_ids)
    tested_actors = _actors_by_scenario(tested_dataset, tested_tokens, with_ids=with_ids)
    known_tokens = []
    for token, actors in tested_actors.items():
        shares = []
        for other_actors in learned_actors.values():
            actor_count = max(min(len(actors), len(other_actors)), _MIN_ACTOR_COUNT)
            shares.append(len(actors & other_actors) / actor_count)
        if cluster_of(token) in learned_clusters or max(shares, default=0.0) >= _MIN_COMMON_SHARE:
            known_tokens.append(token)
    return known_tokens


def _actors_by_scenario(
    dataset: Dataset, scenarios: Collection[str], *, with_ids: bool
) -> dict[str, _Actors]:
    """Return the actors of each scenario: id, which is 0 without ids, and size in steps of 0.01 m.

    With ids, parked actors are left out, because all scenarios of a town have the same parked ones.
    """
    instances = dataset.columns("instance")
    sizes = dataset.columns("annotation")["size"][instances["first_annotation_row"]]
    actors = np.column_stack([instances["actor_id"] * with_ids, np.round(sizes, 2)])
    actors_by_scenario = {}
    for token in scenarios:
        in_scenario = instances["scenario_row"] == dataset.getind("scenario", token)
        scenario_actors = [tuple(actor) for actor in actors[in_scenario].tolist()]
        actors_by_scenario[token] = {
            actor for actor in scenario_actors if 0 <= actor[0] < STATIC_ACTOR_ID
        }
    return actors_by_scenario
