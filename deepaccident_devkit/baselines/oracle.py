"""Turn rates, by the labels, of the actors that a set of agents sees (`v2x.seen`)."""

from __future__ import annotations

from typing import Final

import numpy as np

from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import Agents, Link
from deepaccident_devkit.v2x.seen import SeenActors, seen_actors

__all__ = ["HISTORY", "SeenActors", "seen_actors", "turn_rates"]

HISTORY: Final = 5
"""Recorded frames that turn rates look back, at most: 0.5 s."""


def turn_rates(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = "single", link: Link | None = None
) -> FloatArray:
    """The turn rates of the actors of `seen_actors`, by their headings at the present and up to 0.5 s before it.

    For each actor the earliest of these moments counts at which the agents saw it. Arguments and errors as of
    `seen_actors`.

    Returns:
        (N,) radians a second, counter-clockwise; 0 for actors not seen before.
    """
    scenario, agent, number = dataset.get("sample", sample)["token"].rsplit("/", 2)
    present = seen_actors(dataset, sample, agents=agents, link=link, frame="world").boxes
    rate, known = np.zeros(len(present)), np.zeros(len(present), dtype=bool)
    delay = 0 if link is None else link.latency_frames
    for back in range(min(HISTORY, int(number) - 1 - delay), 0, -1):
        if known.all():
            break
        token = sample_token(scenario, agent, int(number) - back)
        before = seen_actors(dataset, token, agents=agents, link=link, frame="world").boxes
        _, now, then = np.intersect1d(present.actor_id, before.actor_id, return_indices=True)
        turned = present.yaw[now] - before.yaw[then]
        found = np.zeros(len(present), dtype=bool)
        found[now] = True
        values = np.zeros(len(present))
        values[now] = np.arctan2(np.sin(turned), np.cos(turned)) / (back * FRAME_PERIOD)
        fresh = found & ~known
        rate[fresh], known = values[fresh], known | found
    return rate
