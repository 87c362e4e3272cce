"""The common view of several agents: visible actors, and one box for each actor.

`seen_actors` returns every actor that is seen by the released rule (docs/released_code.md,
Visibility and attributes) with its true state, apart from the effects of the link.
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
"""Metres: boxes of one class in two agents' labels with centres nearer than this belong to the same
untracked actor."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CooperativeView(FrozenArrays):
    """The actors that several agents see at one moment, one box each; arrays are read-only.

    Attributes:
        boxes: N boxes in one coordinate frame, tracked actors by ascending id, then untracked ones
            (−1). An agent's own row has the agent's id. `num_lidar_pts` is the sum over the agents,
            and `camera_visible` is true if any of their cameras sees it (own rows do not count, and
            of rows that a label repeats only the first counts); `row` is the row in the label of
            `source`.
        source: Indices into `taxonomy.AGENTS`, shape (N,), int8: the agent that the box comes from.
        seen_by: Bit masks over `taxonomy.AGENTS`, shape (N,), uint8: the agents that have a box of
            the actor; for an untracked actor only the source, because its rows in other labels are
            known only by their position.
    """

    boxes: Boxes
    source: AnyArray
    seen_by: AnyArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenActors(FrozenArrays):
    """The actors that are known at a sample; arrays are read-only.

    Attributes:
        boxes: N boxes, one for each actor; the ego's own box is first and has the id −100, as in
            its label.
        seen_by: Bit masks over `taxonomy.AGENTS`, shape (N,), uint8: the agents that see the actor;
            for the ego's box, the ego.
        own_actor_id: Actor id of the ego; None for the infrastructure, or if the meta file does not
            name it.
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
    """Return the instances that at least one of several agents sees, by the released rule.

    With all five agents and no link, these are the actors that the released labels count as visible
    (docs/released_code.md, Visibility and attributes). Own rows and untracked rows never count.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the present.
        agents: Names of agents, a configuration or its name relative to the ego, or None for all
            available agents.
        link: Effects of the link on the partners' data; None for a perfect link.

    Returns:
        Instance tokens by ascending actor id; agents without labels add nothing.

    Raises:
        TokenError: There is no such sample.
        ChoiceError: There is no such agent or configuration.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    scenario = dataset.get("sample", sample)["scenario_token"]
    actor_ids = visible_actors(dataset, sample, agents=agents, link=link)
    return [instance_token(scenario, actor) for actor in actor_ids.tolist()]


def visible_actors(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = None, link: Link | None = None
) -> IntArray:
    """Return the ascending actor ids of `visible_instances`, with the same arguments and errors."""
    masks = []
    actor_ids = []
    for message in messages(dataset, sample, agents, link):
        boxes = dataset.boxes(message.sample, "lidar")
        masks.append(_released_mask(message, boxes))
        actor_ids.append(boxes.actor_id)
    return visible_ids(masks, actor_ids)


def cooperative_boxes(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = None,
    frame: str = "world",
    visible: Visible | None = None,
    link: Link | None = None,
) -> Boxes:
    """Return the actors that several agents annotated at a sample's moment, one box each.

    If several agents have an actor, the ego's box counts; without one, the box of the first other
    agent. An agent's own row (which becomes the agent's actor) counts only if no other agent has
    the actor, because it is wrong by up to 0.3 m. Untracked rows (−1) are retained once: a row
    within 0.5 m of another agent's row of the same class, or of a tracked actor's retained box, is
    left out. `cooperative_view` also returns which agents saw which actor.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the present.
        agents: Names of agents, a configuration or its name relative to the ego, or None for all
            available agents.
        frame: Coordinate frame of the result, at the sample: `world`, `ego`, `lidar` or a camera
            channel (optical).
        visible: None for all annotated actors, with own rows; `camera` for the actors that a camera
            of the same agent sees; `released` for the actors that the same agent sees by the
            released rule (docs/released_code.md, Visibility and attributes).
        link: Effects of the link on the partners' data; None for a perfect link.

    Returns:
        Boxes as described for `CooperativeView.boxes`; actor ids are CARLA's, or −1 for untracked.

    Raises:
        TokenError: There is no such sample.
        ChoiceError: There is no such agent, configuration, frame or visibility.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    view = cooperative_view(dataset, sample, agents=agents, frame=frame, visible=visible, link=link)
    return view.boxes


def cooperative_view(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = None,
    frame: str = "world",
    visible: Visible | None = None,
    link: Link | None = None,
) -> CooperativeView:
    """Return `cooperative_boxes` and the agents that saw each box.

    It has the same arguments and errors.
    """
    frame = dataset.frame_name(frame)
    visible = choice("visible", visible, VISIBLE)
    target_from_world = dataset.world_from(sample, frame).inverse()
    boxes_by_agent = []
    ids_by_agent = []
    codes_by_agent = []
    for message in messages(dataset, sample, agents, link):
        boxes = dataset.boxes(message.sample, "lidar")
        actor_ids = dataset.actor_ids(message.sample)
        if visible is not None:
            mask = _visible_mask(message, boxes, visible)
            boxes = boxes.select(mask)
            actor_ids = actor_ids[mask]
        target_from_lidar = message.target_from(dataset, "lidar", target_from_world)
        boxes_by_agent.append(boxes.transform(target_from_lidar, frame))
        ids_by_agent.append(actor_ids)
        agent_code = AGENTS.index(message.agent)
        codes_by_agent.append(np.full(len(actor_ids), agent_code, dtype=np.int8))
    if not boxes_by_agent:
        empty = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame=frame)
        return CooperativeView(
            boxes=empty, source=np.zeros(0, dtype=np.int8), seen_by=np.zeros(0, dtype=np.uint8)
        )
    all_boxes = concatenate(boxes_by_agent, frame)
    return _merged_by_actor(all_boxes, np.concatenate(ids_by_agent), np.concatenate(codes_by_agent))


def seen_actors(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    link: Link | None = None,
    frame: str = "ego",
) -> SeenActors:
    """Return the actors that at least one of several agents sees, and the ego itself.

    A partner's box of itself does not count, as in the released rule: another agent has to see it.
    Untracked actors (−1) never count as seen.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the present.
        agents: Cooperating agents, as in `v2x.cooperating_agents`.
        link: Effects of the link on the partners' data; None for a perfect link. A delay is not
            compensated: moving actors are at their earlier positions.
        frame: Coordinate frame of the boxes: `ego`, `world`, `lidar` or a camera channel of the
            sample.

    Raises:
        TokenError: There is no such sample.
        NotAvailableError: The sample has no label, or an agent is not in this (partial) release.
        ChoiceError: There is no such agent, configuration or frame.
        ConfigError: `link` is no Link, or its latency is longer than the scenario's past.
    """
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label (the test split ships without), so that an oracle "
            "knows nothing; choose a labelled sample"
        )
    view = cooperative_view(
        dataset, sample, agents=agents, frame=frame, visible="released", link=link
    )
    own_actor_id = dataset.get("agent", record["agent_token"])["actor_id"]
    ego_id = OWN_ACTOR_ID if own_actor_id is None else own_actor_id
    is_other = view.boxes.actor_id != ego_id
    labelled = dataset.boxes(sample, frame)
    own_rows = np.flatnonzero(labelled.actor_id == OWN_ACTOR_ID)
    own_box = labelled.select(own_rows[:1])
    ego: AgentName = record["agent"]
    own_bits = np.full(len(own_box), 1 << AGENTS.index(ego), dtype=np.uint8)
    return SeenActors(
        boxes=concatenate([own_box, view.boxes.select(is_other)], own_box.frame),
        seen_by=np.concatenate([own_bits, view.seen_by[is_other]]),
        own_actor_id=own_actor_id,
    )


def _merged_by_actor(boxes: Boxes, actor: IntArray, agent: AnyArray) -> CooperativeView:
    """Merge the boxes of all agents into one box for each actor.

    Args:
        boxes: N boxes of all agents, the preferred ones first.
        actor: Actor ids, shape (N,).
        agent: Indices into `taxonomy.AGENTS`, shape (N,): the agents that the boxes come from.
    """
    own = boxes.actor_id == OWN_ACTOR_ID
    tracked = np.flatnonzero(actor != UNTRACKED_ID)
    order = tracked[np.lexsort((own[tracked], actor[tracked]))]
    order = order[_unrepeated_rows(actor[order], agent[order])]
    ids, first_rows, group = np.unique(actor[order], return_index=True, return_inverse=True)
    tracked_rows = order[first_rows]
    count = len(ids)
    by_others = ~own[order]
    points_by_others = np.where(by_others, boxes.num_lidar_pts[order], 0)
    points = np.bincount(group, points_by_others, count).astype(np.int64)
    seen_by_camera = np.bincount(group, boxes.camera_visible[order] & by_others, count) > 0
    seen_by = np.zeros(count, dtype=np.uint8)
    bits = np.left_shift(1, agent, dtype=np.uint8, casting="unsafe")
    np.bitwise_or.at(seen_by, group, bits[order])

    untracked_rows = np.flatnonzero(actor == UNTRACKED_ID)
    repeated = _repeated(boxes, agent, untracked_rows, tracked_rows)
    untracked_rows = untracked_rows[~repeated]
    rows = np.concatenate([tracked_rows, untracked_rows])
    result = boxes.select(rows)
    columns = {
        name: getattr(result, name)
        for name in ("center", "size", "rotation", "velocity", "category", "row")
    }
    columns["actor_id"] = actor[rows]
    columns["num_lidar_pts"] = np.concatenate([points, boxes.num_lidar_pts[untracked_rows]])
    columns["camera_visible"] = np.concatenate(
        [seen_by_camera, boxes.camera_visible[untracked_rows]]
    )
    return CooperativeView(
        boxes=trusted_boxes(boxes.frame, columns),
        source=agent[rows],
        seen_by=np.concatenate([seen_by, bits[untracked_rows]]),
    )


def _unrepeated_rows(actor: IntArray, agent: AnyArray) -> IntArray:
    """Return the first row of each pair of an actor and an agent, ascending.

    A label may repeat an actor.
    """
    pair_codes = actor * len(AGENTS) + agent
    rows: IntArray = np.unique(pair_codes, return_index=True)[1]
    rows.sort()
    return rows


def _repeated(
    boxes: Boxes, agent: AnyArray, untracked_rows: IntArray, tracked_rows: IntArray
) -> BoolArray:
    """Mark untracked rows that repeat a tracked actor, or an untracked row of an earlier agent.

    Args:
        boxes: Boxes of all agents.
        agent: Indices into `taxonomy.AGENTS` of all boxes.
        untracked_rows: Rows of untracked boxes, shape (U,).
        tracked_rows: Rows of the retained boxes of tracked actors.

    Returns:
        Truth values, shape (U,).
    """
    candidates = np.concatenate([tracked_rows, untracked_rows])
    offsets = boxes.center[untracked_rows][:, None] - boxes.center[candidates][None]
    distances: FloatArray = np.linalg.norm(offsets, axis=-1)
    same_category = boxes.category[untracked_rows][:, None] == boxes.category[candidates]
    same_actor = (distances < SAME_ACTOR_DISTANCE) & same_category
    other_agent = agent[untracked_rows][:, None] != agent[untracked_rows]
    same_actor[:, len(tracked_rows) :] &= np.tril(other_agent, k=-1)
    result: BoolArray = same_actor.any(axis=1)
    return result


def _visible_mask(message: Message, boxes: Boxes, visible: Visible) -> BoolArray:
    """Mark the boxes, in the LiDAR frame, that the sender sees by the rule `visible`."""
    if visible == "camera":
        return boxes.camera_visible
    tracked: BoolArray = (boxes.actor_id != OWN_ACTOR_ID) & (boxes.actor_id != UNTRACKED_ID)
    return _released_mask(message, boxes) & tracked


def _released_mask(message: Message, boxes: Boxes) -> BoolArray:
    """Mark the boxes, in the LiDAR frame, that the sender sees by its own points and cameras."""
    return visible_mask(
        boxes.center[:, :2],
        boxes.category,
        boxes.num_lidar_pts,
        boxes.camera_visible,
        infrastructure=message.agent == INFRASTRUCTURE,
    )
