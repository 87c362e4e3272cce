"""The test scenarios that a model knows from its training.

These are scenarios of the training, their twins, and other recordings of either.
"""

from collections.abc import Collection

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.taxonomy import STATIC_ACTOR_ID

# Smallest share of actors that two recordings of the same scene have in common. In synthetic
# releases, nearly all twins share 0.9 or more; recordings of different scenes, less than 0.1.
_MIN_COMMON_SHARE = 0.7
# Small scenes may match by chance, so shares are computed as if they had this many actors.
_MIN_ACTOR_COUNT = 4
# A release, and tokens of some of its scenarios.
ReleaseScenarios = tuple[Dataset, Collection[str]]
# Actors of a scenario, each as (id, length, width, height).
_Actors = set[tuple[float, ...]]


def known_scenarios(learned: ReleaseScenarios, tested: ReleaseScenarios) -> list[str]:
    """Return the tested scenarios that a training contains, also as twins or other recordings.

    Twins and copies have the same actors, whatever scenarios and files are called, and whichever
    frames they contain. Within a release, twins also have the same name.
    """
    learned_dataset, learned_tokens = learned
    tested_dataset, tested_tokens = tested
    learned_clusters: set[str] = set()
    if learned_dataset.dataroot == tested_dataset.dataroot:
        learned_clusters |= {cluster_of(token) for token in learned_tokens}
    with_ids = "nuScenes" not in (learned_dataset.layout, tested_dataset.layout)
    learned_actors = _actors_by_scenario(learned_dataset, learned_tokens, with_ids=with_ids)
    tested_actors = _actors_by_scenario(tested_dataset, tested_tokens, with_ids=with_ids)
    known_tokens = []
    for token, actors in tested_actors.items():
        max_share = 0.0
        for other_actors in learned_actors.values():
            actor_count = max(min(len(actors), len(other_actors)), _MIN_ACTOR_COUNT)
            share = len(actors & other_actors) / actor_count
            max_share = max(max_share, share)
        if cluster_of(token) in learned_clusters or max_share >= _MIN_COMMON_SHARE:
            known_tokens.append(token)
    return known_tokens


def _actors_by_scenario(
    dataset: Dataset, scenarios: Collection[str], *, with_ids: bool
) -> dict[str, _Actors]:
    """Return the actors of each scenario, with sizes rounded to 0.01 m.

    Without ids, all ids are 0. With ids, parked actors are left out, because they are the same in
    all scenarios of a town.
    """
    instances = dataset.columns("instance")
    sizes = dataset.columns("annotation")["size"][instances["first_annotation_row"]]
    actors = np.column_stack([instances["actor_id"] * with_ids, np.round(sizes, 2)])
    actors_by_scenario = {}
    for token in scenarios:
        is_in_scenario = instances["scenario_row"] == dataset.getind("scenario", token)
        is_moving = (actors[:, 0] >= 0) & (actors[:, 0] < STATIC_ACTOR_ID)
        scenario_actors = actors[is_in_scenario & is_moving]
        actors_by_scenario[token] = {tuple(actor) for actor in scenario_actors.tolist()}
    return actors_by_scenario
