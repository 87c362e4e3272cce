"""`seen_actors`: which actors a set of agents knows at a moment, with perfect detection.

Every actor that is seen by the released rule (docs/released_code.md, Visibility and attributes) is known exactly, apart
from the effects of the link. Velocities are those of the labels, decoded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.support.arrays import AnyArray, FrozenArrays
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, AgentName
from deepaccident_devkit.v2x.configurations import Agents
from deepaccident_devkit.v2x.cooperation import cooperative_view
from deepaccident_devkit.v2x.link import Link


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenActors(FrozenArrays):
    """Who is known at a sample; arrays are read-only.

    Attributes:
        boxes: N boxes, one for each actor; the ego's own box is first and has the id −100, as in its label.
        seen_by: (N,) uint8, bit mask over `taxonomy.AGENTS`: the agents that see it; for the ego's box, the ego.
        own_actor_id: the ego's id among the actors; None for the infrastructure, or if the meta file does not say it.
    """

    boxes: Boxes
    seen_by: AnyArray
    own_actor_id: int | None

    @property
    def has_own(self) -> bool:
        """Whether the ego has a box of its own; the infrastructure has none."""
        return bool((self.boxes.actor_id == OWN_ACTOR_ID).any())


def seen_actors(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    link: Link | None = None,
    frame: str = "ego",
) -> SeenActors:
    """The actors that at least one of some agents sees at a sample's moment, and the ego itself.

    A partner's box of itself does not count, as in the released rule: another agent has to see it. Untracked actors
    (−1) never count as seen.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: who cooperates, as in `v2x.cooperating_agents`.
        link: what happens to the partners' data; None for nothing. A delay is not compensated: moving actors are where
            they were.
        frame: coordinate frame of the boxes: `ego`, `world`, `lidar` or a camera channel of the sample.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or an agent is not in this (partial) release.
        ChoiceError: no such agent, configuration or frame.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label (the test split ships without), so that an oracle knows nothing; choose "
            "a labelled sample"
        )
    view = cooperative_view(dataset, sample, agents=agents, frame=frame, visible="released", link=link)
    own_actor_id = dataset.get("agent", record["agent_token"])["actor_id"]
    others = view.boxes.actor_id != (OWN_ACTOR_ID if own_actor_id is None else own_actor_id)
    labelled = dataset.boxes(sample, frame)
    own = labelled.select(np.flatnonzero(labelled.actor_id == OWN_ACTOR_ID)[:1])
    ego: AgentName = record["agent"]
    bits = np.full(len(own), 1 << AGENTS.index(ego), dtype=np.uint8)
    return SeenActors(
        boxes=concatenate([own, view.boxes.select(others)], own.frame),
        seen_by=np.concatenate([bits, view.seen_by[others]]),
        own_actor_id=own_actor_id,
    )
