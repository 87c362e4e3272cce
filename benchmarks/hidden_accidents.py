"""`python -m benchmarks.hidden_accidents RELEASE SPLIT`: the table of what there is to gain, on
docs/model.md.

Three ways to foresee accidents from labels, each alone and with all agents: constant velocity of
    whom they see; a weak
sight that finds a share of these, at wrong places and speeds, three seeds pooled; and a guess
without any sight: an alarm wherever ego arrives within 2 s at the place where its pair collides.
    Protocol `boxes`; intervals over pairs.
"""

import sys
from dataclasses import replace
from itertools import chain

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

SEEDS, FOUND, OFF, SPEED_OFF = (1, 2, 3), 0.5, 0.7, 1.5
"""Of the weak sight: seeds, the share of actors found, metres and m/s of its errors."""
WAYS = {
    "velocity": "constant velocity of whom they see",
    "weak": "the same of half of these, at wrong places",
}
HEAD = ("who foresees", "ego alone", "all agents", "difference", "decided from")
BEFORE = 1.5
"""Seconds before the end from which samples are taken, as in the recipes."""
SURE = 1.96 + 0.84
"""Standard errors of a difference that is decided at 5 % with a chance of 80 %."""


def weak(whole: Outlook, source: np.random.Generator) -> Outlook:
    """What is left of an outlook."""
    boxes = whole.seen.boxes
    own = boxes.actor_id == OWN_ACTOR_ID
    kept = np.flatnonzero(own | (source.random(len(boxes)) < FOUND))
    errors = source.normal(size=(2, len(kept), 3)) * (1, 1, 0) * ~own[kept, None]
    boxes = boxes.select(kept)
    boxes = replace(
        boxes,
        center=boxes.center + OFF * errors[0],
        velocity=boxes.velocity + SPEED_OFF * errors[1],
    )
    seen = replace(whole.seen, boxes=boxes, seen_by=whole.seen.seen_by[kept])
    return Outlook(seen=seen, turn_rate=whole.turn_rate[kept])


def guess(dataset: DeepAccident, token: str, place: np.ndarray) -> list[Accident]:
    """An alarm if ego drives towards a place in world (3,) and is there within 2 s."""
    x, y, _ = dataset.world_from(token, "ego").inverse().apply(place[None])[0]
    boxes = dataset.boxes(token, "ego")
    speed = float(np.linalg.norm(boxes.velocity[boxes.actor_id == OWN_ACTOR_ID][0, :2]))
    seconds = (x - 2) / max(speed, 0.5)  # its front is there
    near = abs(y) < 6 and 0 < seconds <= 2.05
    return (
        [Accident(positions=np.array([[x - 1, y], [x + 1, y]]), time=min(seconds, 2.0))]
        if near
        else []
    )


def main(root: str, split: str) -> None:
    """Write it."""
    dataset, setup = (
        DeepAccident("v1", root, verbose=False),
        EvaluationSetup(task="accident", protocol="boxes"),
    )
    hidden = {
        record["token"]: cluster_of(record["token"])
        for record in dataset.find(hidden_collider=True)
    }
    places = {
        hidden[each]: found.point
        for each in hidden
        if (found := dataset.collision(each)) is not None
    }
    listed = SampleSelection(
        split=split, scope="all", agents=("ego_vehicle",), horizon=BEFORE
    ).tokens(dataset)
    clusters: dict[str, list[str]] = {}
    for token in listed:
        if scenario_of(token) in hidden:
            clusters.setdefault(hidden[scenario_of(token)], []).append(token)
    rows = {
        (way, agents): [setup.evaluator() for _ in SEEDS]
        for way in WAYS
        for agents in ("single", "all")
    }
    guessed = setup.evaluator()
    for token in chain(*clusters.values()):
        context = accident_context(dataset, token, 2.0)
        guessed.update(
            token, guess(dataset, token, places[hidden[scenario_of(token)]]), None, context
        )
        for (way, agents), evaluators in rows.items():
            whole = outlook(dataset, token, agents=agents)
            for seed, evaluator in zip(SEEDS, evaluators, strict=True):
                source = np.random.default_rng([seed, agents == "all", len(evaluator.tokens)])
                evaluator.update(
                    token,
                    accidents_ahead(weak(whole, source) if way == "weak" else whole, 2.0),
                    None,
                    context,
                )
    lines = []
    for way, said in WAYS.items():
        pair = [
            [
                [each.counts[token] for token in tokens for each in rows[way, agents]]
                for tokens in clusters.values()
            ]
            for agents in ("single", "all")
        ]
        alone, both = (guessed.result_of([*chain(*counts)]).apa for counts in pair)
        low, high, error = difference_intervals(
            guessed, (pair[0], pair[1]), {"apa": both - alone}, Resampling()
        )
        more = f"{both - alone:+.2f} [{low[0]:.2f}, {high[0]:.2f}]"
        lines.append((said, f"{alone:.2f}", f"{both:.2f}", more, f"{SURE * error[0]:.2f}"))
    lines.append(("a guess without sight", *[f"{guessed.compute().apa:.2f}"] * 2, "0", "–"))
    told = (
        f"Of {len(guessed.tokens):,} samples of {len(clusters):,} pairs with a "
        f"hidden collider, APA by `boxes`:"
    )
    put("gain", f"{told}\n\n{table(HEAD, lines)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
