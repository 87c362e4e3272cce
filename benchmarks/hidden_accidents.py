"""Write the table on docs/model.md of what there is to gain: `python -m benchmarks.hidden_accidents
RELEASE SPLIT`.

Accidents are foreseen from labels in three ways, by ego only and by all agents: constant velocity
of the actors that they see; a weak perception that finds a share of these actors, at wrong places
and speeds, three seeds pooled; and a guess without any perception, which is an alarm wherever ego
arrives within 2 s at the place where its pair collides. Protocol `boxes`; intervals over pairs.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np

from benchmarks.pages.marks import put, table
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import Accident, Resampling
from deepaccident_devkit.evaluation.breakdowns import cluster_of
from deepaccident_devkit.evaluation.intervals import difference_intervals
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup, SampleSelection, scenario_of
from deepaccident_devkit.evaluation.truth import accident_context
from deepaccident_devkit.plugins.baselines import Outlook, outlook
from deepaccident_devkit.plugins.baselines.predict import accidents_ahead
from deepaccident_devkit.taxonomy import OWN_ACTOR_ID

SEEDS = (1, 2, 3)
FOUND_SHARE = 0.5
"""Share of the actors that the weak perception finds."""
POSITION_ERROR_M, SPEED_ERROR_MPS = 0.7, 1.5
"""Standard deviations of the weak perception."""
PREDICTORS = {
    "velocity": "constant velocity of the actors in view",
    "weak": "the same for half of these actors, with errors",
}
HEAD = ("prediction", "only ego", "all agents", "difference", "smallest decided")
AGENTS = ("single", "all")
HORIZON_S = 2.0
SAMPLED_S = 1.5
"""Seconds before the end from which samples are taken, as in the recipes."""
DECIDED_ERRORS = 1.96 + 0.84
"""Standard errors of a difference that is decided at 5 % with a chance of 80 %."""


def weaken(full: Outlook, source: np.random.Generator) -> Outlook:
    """Return the part of an outlook that a weak perception finds, with errors."""
    boxes = full.seen.boxes
    is_own = boxes.actor_id == OWN_ACTOR_ID
    is_found = source.random(len(boxes)) < FOUND_SHARE
    rows = np.flatnonzero(is_own | is_found)
    errors = source.normal(size=(2, len(rows), 3)) * (1, 1, 0) * ~is_own[rows, None]
    boxes = boxes.select(rows)
    boxes = replace(
        boxes,
        center=boxes.center + POSITION_ERROR_M * errors[0],
        velocity=boxes.velocity + SPEED_ERROR_MPS * errors[1],
    )
    seen = replace(full.seen, boxes=boxes, seen_by=full.seen.seen_by[rows])
    return Outlook(seen=seen, turn_rate=full.turn_rate[rows])


def guess(dataset: DeepAccident, token: str, point: np.ndarray) -> list[Accident]:
    """Return an alarm if ego drives towards a point in world (3,) and is there within 2 s."""
    x, y, _ = dataset.world_from(token, "ego").inverse().apply(point[None])[0]
    boxes = dataset.boxes(token, "ego")
    own_velocity = boxes.velocity[boxes.actor_id == OWN_ACTOR_ID][0, :2]
    speed = float(np.linalg.norm(own_velocity))
    seconds = (x - 2) / max(speed, 0.5)  # its front is there
    if abs(y) >= 6 or not 0 < seconds <= 2.05:
        return []
    positions = np.array([[x - 1, y], [x + 1, y]])
    return [Accident(positions=positions, time=min(seconds, HORIZON_S))]


def main(root: str, split: str) -> None:
    """Write the table."""
    dataset = DeepAccident("v1", root, verbose=False)
    setup = EvaluationSetup(task="accident", protocol="boxes")
    hidden = [record["token"] for record in dataset.find(hidden_collider=True)]
    cluster_by_scenario = {scenario: cluster_of(scenario) for scenario in hidden}
    points = {}
    for scenario, cluster in cluster_by_scenario.items():
        contact = dataset.collision(scenario)
        if contact is not None:
            points[cluster] = contact.point
    selection = SampleSelection(
        split=split, scope="all", agents=("ego_vehicle",), horizon=SAMPLED_S
    )
    clusters: dict[str, list[str]] = {}
    for token in selection.tokens(dataset):
        cluster = cluster_by_scenario.get(scenario_of(token))
        if cluster is not None:
            clusters.setdefault(cluster, []).append(token)
    evaluators = {
        (predictor, agents): [setup.evaluator() for _ in SEEDS]
        for predictor in PREDICTORS
        for agents in AGENTS
    }
    guessed = setup.evaluator()
    for cluster, tokens in clusters.items():
        for token in tokens:
            context = accident_context(dataset, token, HORIZON_S)
            guessed.update(token, guess(dataset, token, points[cluster]), None, context)
            for (predictor, agents), seeded in evaluators.items():
                full = outlook(dataset, token, agents=agents)
                for seed, evaluator in zip(SEEDS, seeded, strict=True):
                    source = np.random.default_rng([seed, agents == "all", len(evaluator.tokens)])
                    seen = weaken(full, source) if predictor == "weak" else full
                    accidents = accidents_ahead(seen, HORIZON_S)
                    evaluator.update(token, accidents, None, context)
    lines = []
    for predictor, description in PREDICTORS.items():
        single, cooperative = (
            [counts_of(evaluators[predictor, agents], tokens) for tokens in clusters.values()]
            for agents in AGENTS
        )
        single_apa = guessed.result_of([*chain(*single)]).apa
        cooperative_apa = guessed.result_of([*chain(*cooperative)]).apa
        gain = cooperative_apa - single_apa
        low, high, error = difference_intervals(
            guessed, (single, cooperative), {"apa": gain}, Resampling()
        )
        lines.append(
            (
                description,
                f"{single_apa:.2f}",
                f"{cooperative_apa:.2f}",
                f"{gain:+.2f} [{low[0]:.2f}, {high[0]:.2f}]",
                f"{DECIDED_ERRORS * error[0]:.2f}",
            )
        )
    guessed_apa = f"{guessed.compute().apa:.2f}"
    lines.append(("guess without perception", guessed_apa, guessed_apa, "0", "–"))
    caption = (
        f"APA by `boxes` over {len(guessed.tokens):,} samples of {len(clusters):,} pairs with a "
        f"hidden collider:"
    )
    put("gain", f"{caption}\n\n{table(HEAD, lines)}")


def counts_of(evaluators: Sequence[Any], tokens: Sequence[str]) -> list[Any]:
    """Return the counts of samples by all evaluators."""
    return [evaluator.counts[token] for token in tokens for evaluator in evaluators]


if __name__ == "__main__":
    main(*sys.argv[1:])
