"""Which scenarios of a test a model knows from its training: the same ones, their twins, other recordings of both."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.taxonomy import STATIC_ACTOR_ID

# Of the actors of one of two recordings, which the other has too if both are of one scene. Of the generator, nearly
# all twins share 0.9 or more; recordings of different scenes share less than 0.1.
_LEAST_SHARE: Final = 0.7
# Actors; fewer may be alike by chance, so that these count as so many.
_FEW: Final = 4
# A release and the tokens of some of its scenarios.
ReleaseScenarios = tuple[Dataset, Collection[str]]
_Actors = set[tuple[float, ...]]


def known_scenarios(learned: ReleaseScenarios, tested: ReleaseScenarios) -> list[str]:
    """Return the tested scenarios that a training shows: themselves, their twins, or other recordings of either.

    Twins and copies have the same actors, whatever the names of scenarios and files, and whichever frames there are.
    Within a release twins also have the same name.
    """
    clusters = {
        cluster_of(token) for token in learned[1] if learned[0].dataroot == tested[0].dataroot
    }
    with_ids = "nuScenes" not in (learned[0].layout, tested[0].layout)
    known, found = (_actors(*each, with_ids=with_ids) for each in (learned, tested))
    shown = []
    for token, actors in found.items():
        shares = [
            len(actors & others) / max(min(len(actors), len(others)), _FEW)
            for others in known.values()
        ]
        if cluster_of(token) in clusters or max(shares, default=0.0) >= _LEAST_SHARE:
            shown.append(token)
    return shown


def _actors(dataset: Dataset, scenarios: Collection[str], *, with_ids: bool) -> dict[str, _Actors]:
    """Return the actors of each scenario: id, which is 0 without ids, and size in steps of 0.01 m.

    With ids, parked ones are left out: a town has the same in all of its scenarios.
    """
    instances = dataset.columns("instance")
    size = np.round(dataset.columns("annotation")["size"][instances["first_annotation_row"]], 2)
    actors = np.column_stack([instances["actor_id"] * with_ids, size])
    found = {}
    for token in scenarios:
        own = instances["scenario_row"] == dataset.getind("scenario", token)
        found[token] = {
            tuple(actor) for actor in actors[own].tolist() if 0 <= actor[0] < STATIC_ACTOR_ID
        }
    return found
