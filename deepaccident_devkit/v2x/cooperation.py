"""What a set of agents sees together: visible actors, and one box for each actor.

`seen_actors` knows every actor that is seen by the released rule exactly (docs/released_code.md, Visibility and
attributes), apart from the effects of the link.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from deepaccident_devkit.dataset import VISIBLE, Dataset, RowArgument, Visible
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.geometry.boxes import concatenate, trusted_boxes
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
)
from deepaccident_devkit.support.text import choice
from deepaccident_devkit.tables import visible_ids, visible_mask
from deepaccident_devkit.tables.tokens import instance_token
from deepaccident_devkit.taxonomy import (
    AGENTS,
    INFRASTRUCTURE,
    OWN_ACTOR_ID,
    UNTRACKED_ID,
    AgentName,
)
from deepaccident_devkit.v2x.agents import Agents
from deepaccident_devkit.v2x.messages import Link, Message, messages

SAME_ACTOR_DISTANCE: Final = 0.5
"""Metres: two agents' boxes of one class whose centres are nearer than this are of the same untracked actor."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CooperativeView(FrozenArrays):
    """What several agents see at one moment, one box for each actor; arrays are read-only.

    Attributes:
        boxes: N boxes in one coordinate frame, tracked actors by ascending id, then untracked ones (−1). An agent's
            own row has the agent's id. `num_lidar_pts` is the sum over the agents, and `camera_visible` says whether
            any of their cameras sees it (own rows do not count, and of rows that a label repeats only the first
            counts); `row` is the row in the label of `source`.
        source: (N,) int8, index into `taxonomy.AGENTS`: whose box it is.
        seen_by: (N,) uint8, bit mask over `taxonomy.AGENTS`: the agents that have a box of it; for an untracked actor
            only the source, because its rows in other labels are known only by their place.
    """

    boxes: Boxes
    source: AnyArray
    seen_by: AnyArray


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


def visible_instances(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = None, link: Link | None = None
) -> list[str]:
    """The instances that at least one of some agents sees at a sample's moment, by the released rule.

    With all five agents and no link, these are the actors that the released labels count as visible
    (docs/released_code.md, Visibility and attributes). Own rows and untracked rows never count.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: names of agents, a configuration or its name as seen from the ego, or None for all that are there.
        link: what happens to the partners' data; None for nothing.

    Returns:
        Tokens by ascending actor id; agents without labels add nothing.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such agent or configuration.
        NotAvailableError: an agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    scenario = dataset.get("sample", sample)["scenario_token"]
    seen = visible_actors(dataset, sample, agents=agents, link=link)
    return [instance_token(scenario, actor) for actor in seen.tolist()]


def visible_actors(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = None, link: Link | None = None
) -> IntArray:
    """The actor ids of `visible_instances`, ascending; it has the same arguments and errors."""
    masks, ids = [], []
    for message in messages(dataset, sample, agents, link):
        boxes = dataset.boxes(message.sample, "lidar")
        masks.append(_released_mask(message, boxes))
        ids.append(boxes.actor_id)
    return visible_ids(masks, ids)


def cooperative_boxes(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = None,
    frame: str = "world",
    visible: Visible | None = None,
    link: Link | None = None,
) -> Boxes:
    """The actors that some agents annotated at a sample's moment, one box for each actor, in one coordinate frame.

    If several agents have an actor, the ego's box counts; without one, the box of the first other agent. An agent's
    own row (which becomes the agent's actor) counts only if no other agent has the actor, because it is wrong by up to
    0.3 m. Untracked rows (−1) are kept once: a row within 0.5 m of another agent's row of the same class, or of a
    tracked actor's chosen box, is left out. `cooperative_view` also says who saw what.

    Args:
        dataset: the release.
        sample: token or record: its agent is the ego, its frame the present.
        agents: names of agents, a configuration or its name as seen from the ego, or None for all that are there.
        frame: coordinate frame of the result, at the sample: `world`, `ego`, `lidar` or a camera channel (optical).
        visible: None for all that is annotated, with own rows; `camera` for what a camera of the same agent sees;
            `released` for what the same agent sees by the released rule (docs/released_code.md, Visibility and
            attributes).
        link: what happens to the partners' data; None for nothing.

    Returns:
        The boxes as `CooperativeView.boxes` says; actor ids are CARLA's, or −1 for untracked.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such agent, configuration, frame or visibility.
        NotAvailableError: an agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    return cooperative_view(
        dataset, sample, agents=agents, frame=frame, visible=visible, link=link
    ).boxes


def cooperative_view(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = None,
    frame: str = "world",
    visible: Visible | None = None,
    link: Link | None = None,
) -> CooperativeView:
    """`cooperative_boxes`, and who saw each of them; it has the same arguments and errors."""
    frame, visible = dataset.frame_name(frame), choice("visible", visible, VISIBLE)
    target_from_world = dataset.world_from(sample, frame).inverse()
    parts, actors, agent_codes = [], [], []
    for message in messages(dataset, sample, agents, link):
        boxes, ids = dataset.boxes(message.sample, "lidar"), dataset.actor_ids(message.sample)
        if visible is not None:
            seen = _visible_mask(message, boxes, visible)
            boxes, ids = boxes.select(seen), ids[seen]
        parts.append(
            boxes.transform(message.target_from(dataset, "lidar", target_from_world), frame)
        )
        actors.append(ids)
        agent_codes.append(np.full(len(ids), AGENTS.index(message.agent), dtype=np.int8))
    if not parts:
        empty = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame=frame)
        return CooperativeView(
            boxes=empty, source=np.zeros(0, dtype=np.int8), seen_by=np.zeros(0, dtype=np.uint8)
        )
    return _one_an_actor(
        concatenate(parts, frame), np.concatenate(actors), np.concatenate(agent_codes)
    )


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
    view = cooperative_view(
        dataset, sample, agents=agents, frame=frame, visible="released", link=link
    )
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


def _one_an_actor(boxes: Boxes, actor: IntArray, agent: AnyArray) -> CooperativeView:
    """Merge all agents' boxes (N), the preferred ones first, with their actors and agents (N,)."""
    own = boxes.actor_id == OWN_ACTOR_ID
    tracked = np.flatnonzero(actor != UNTRACKED_ID)
    order = tracked[np.lexsort((own[tracked], actor[tracked]))]
    order = order[_first_of_each(actor[order], agent[order])]
    ids, first, group = np.unique(actor[order], return_index=True, return_inverse=True)
    chosen = order[first]
    from_outside = ~own[order]
    count = len(ids)
    points = np.bincount(
        group, np.where(from_outside, boxes.num_lidar_pts[order], 0), count
    ).astype(np.int64)
    camera = np.bincount(group, boxes.camera_visible[order] & from_outside, count) > 0
    seen_by = np.zeros(count, dtype=np.uint8)
    bits = np.left_shift(1, agent, dtype=np.uint8, casting="unsafe")
    np.bitwise_or.at(seen_by, group, bits[order])

    loose = np.flatnonzero(actor == UNTRACKED_ID)
    loose = loose[~_repeated(boxes, agent, loose, chosen)]
    picked = np.concatenate([chosen, loose])
    result = boxes.select(picked)
    columns = {
        name: getattr(result, name)
        for name in ("center", "size", "rotation", "velocity", "category", "row")
    }
    merged = trusted_boxes(
        boxes.frame,
        {
            **columns,
            "actor_id": actor[picked],
            "num_lidar_pts": np.concatenate([points, boxes.num_lidar_pts[loose]]),
            "camera_visible": np.concatenate([camera, boxes.camera_visible[loose]]),
        },
    )
    return CooperativeView(
        boxes=merged, source=agent[picked], seen_by=np.concatenate([seen_by, bits[loose]])
    )


def _first_of_each(actor: IntArray, agent: AnyArray) -> IntArray:
    """The first row of each pair of an actor and an agent, ascending: a label may repeat an actor."""
    first: IntArray = np.unique(actor * len(AGENTS) + agent, return_index=True)[1]
    first.sort()
    return first


def _repeated(boxes: Boxes, agent: AnyArray, loose: IntArray, chosen: IntArray) -> BoolArray:
    """Which untracked rows are at the place of a tracked actor, or of an untracked row of an earlier agent."""
    against = np.concatenate([chosen, loose])
    apart: FloatArray = np.linalg.norm(
        boxes.center[loose][:, None] - boxes.center[against][None], axis=-1
    )
    same = (apart < SAME_ACTOR_DISTANCE) & (
        boxes.category[loose][:, None] == boxes.category[against]
    )
    earlier = np.tril(agent[loose][:, None] != agent[loose], k=-1)
    same[:, len(chosen) :] &= earlier
    result: BoolArray = same.any(axis=1)
    return result


def _visible_mask(message: Message, boxes: Boxes, visible: Visible) -> BoolArray:
    if visible == "camera":
        return boxes.camera_visible
    tracked: BoolArray = (boxes.actor_id != OWN_ACTOR_ID) & (boxes.actor_id != UNTRACKED_ID)
    return _released_mask(message, boxes) & tracked


def _released_mask(message: Message, boxes: Boxes) -> BoolArray:
    """What an agent sees by its own points and cameras, of boxes in its LiDAR frame."""
    return visible_mask(
        boxes.center[:, :2],
        boxes.category,
        boxes.num_lidar_pts,
        boxes.camera_visible,
        infrastructure=message.agent == INFRASTRUCTURE,
    )
