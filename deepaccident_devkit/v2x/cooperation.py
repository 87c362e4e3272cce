"""The merged view of several agents: visible actors, and one box for each actor.

`seen_actors` returns every actor that is visible under the released rule (docs/released_code.md,
Visibility and attributes). The actors' states are true, except for the effects of the link.
"""

from dataclasses import dataclass

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

SAME_ACTOR_DISTANCE = 0.5
"""Untracked boxes of one class whose centres are closer than this, metres, are one actor."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CooperativeView(FrozenArrays):
    """The actors that several agents see at one time, with one box each; arrays are read-only.

    Attributes:
        boxes: N boxes in one coordinate frame: tracked actors by ascending id, then untracked ones
            (−1). An agent's own row has the agent's CARLA id. `num_lidar_pts` is the sum over the
            agents, and `camera_visible` is true if a camera of any agent sees the actor. For these
            two, agents' own rows do not count, nor do repetitions of an actor in one label. `row`
            is the row in the label of `source`.
        source: Indices into `taxonomy.AGENTS`, shape (N,), int8: the agent that the box comes from.
        seen_by: Bit masks over `taxonomy.AGENTS`, shape (N,), uint8: the agents that have a box of
            the actor; for an untracked actor only `source`, because rows of other labels are
            matched with it only by position.
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
        seen_by: Bit masks over `taxonomy.AGENTS`, shape (N,), uint8: the agents that see the actor
            (for the ego's own box, the ego).
        own_actor_id: Actor id of the ego; None if the ego is the infrastructure, or the meta file
            does not name it.
    """

    boxes: Boxes
    seen_by: AnyArray
    own_actor_id: int | None

    @property
    def has_own(self) -> bool:
        """Whether the ego has its own box, which the infrastructure does not."""
        is_own = self.boxes.actor_id == OWN_ACTOR_ID
        return bool(is_own.any())


def visible_instances(
    dataset: Dataset, sample: RowArgument, *, agents: Agents = None, link: Link | None = None
) -> list[str]:
    """Return the instances that at least one of several agents sees under the released rule.

    With all five agents and no link, these are the actors that the released labels count as visible
    (docs/released_code.md, Visibility and attributes). Agents' own rows and untracked rows never
    count.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the current one.
        agents: Names of agents, a configuration or its name relative to the ego, or None for all
            available agents.
        link: Effects of the link on the partners' data; None for a perfect link.

    Returns:
        Instance tokens by ascending actor id; agents without labels contribute nothing.

    Raises:
        TokenError: The sample is unknown.
        ChoiceError: An agent or the configuration is unknown.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is not a Link, or its latency reaches back before the recording.
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
        masks.append(_mask_released(message, boxes))
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
    """Return the actors that several agents annotated at a sample's time, with one box each.

    If several agents annotated an actor, the ego's box is used; if the ego did not, the first other
    agent's. An agent's own row (which gets the agent's id) is used only if no other agent annotated
    that agent, because it is off by up to 0.3 m. Untracked rows (−1) are merged by position: a row
    is left out if it is within 0.5 m of another agent's row of the same class, or of a tracked
    actor's box. `cooperative_view` also returns which agents saw which actor.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the current one.
        agents: Names of agents, a configuration or its name relative to the ego, or None for all
            available agents.
        frame: Coordinate frame of the result, at the sample's time: `world`, `ego`, `lidar` or a
            camera channel (optical).
        visible: None for all annotated actors, including agents' own rows; `camera` for the boxes
            that a camera of the annotating agent sees; `released` for the boxes that the annotating
            agent sees under the released rule (docs/released_code.md, Visibility and attributes).
        link: Effects of the link on the partners' data; None for a perfect link.

    Returns:
        Boxes as described for `CooperativeView.boxes`; actor ids are CARLA's, or −1 if untracked.

    Raises:
        TokenError: The sample is unknown.
        ChoiceError: An agent, the configuration, the frame or the visibility is unknown.
        NotAvailableError: An agent is not in this (partial) release.
        ConfigError: `link` is not a Link, or its latency reaches back before the recording.
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

    The arguments and errors are as in `cooperative_boxes`.
    """
    frame = dataset.frame_name(frame)
    visible = choice("visible", visible, VISIBLE)
    target_from_world = dataset.world_from(sample, frame).inverse()
    agent_boxes = []
    agent_actor_ids = []
    agent_codes = []
    for message in messages(dataset, sample, agents, link):
        boxes = dataset.boxes(message.sample, "lidar")
        actor_ids = dataset.actor_ids(message.sample)
        if visible is not None:
            mask = _mask_visible(message, boxes, visible)
            boxes = boxes.select(mask)
            actor_ids = actor_ids[mask]
        target_from_lidar = message.target_from(dataset, "lidar", target_from_world)
        agent_boxes.append(boxes.transform(target_from_lidar, frame))
        agent_actor_ids.append(actor_ids)
        code = AGENTS.index(message.agent)
        agent_codes.append(np.full(len(actor_ids), code, dtype=np.int8))
    if not agent_boxes:
        no_boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame=frame)
        return CooperativeView(
            boxes=no_boxes, source=np.zeros(0, dtype=np.int8), seen_by=np.zeros(0, dtype=np.uint8)
        )
    all_boxes = concatenate(agent_boxes, frame)
    all_actor_ids = np.concatenate(agent_actor_ids)
    all_codes = np.concatenate(agent_codes)
    return _merge_by_actor(all_boxes, all_actor_ids, all_codes)


def seen_actors(
    dataset: Dataset,
    sample: RowArgument,
    *,
    agents: Agents = "single",
    link: Link | None = None,
    frame: str = "ego",
) -> SeenActors:
    """Return the ego, and the actors that at least one of several agents sees.

    As in the released rule, a partner's box of itself does not count: another agent has to see it.
    Untracked actors (−1) never count as seen.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego, its frame the current one.
        agents: Cooperating agents, as for `v2x.cooperating_agents`.
        link: Effects of the link on the partners' data; None for a perfect link. A delay is not
            compensated: moving actors are at their earlier positions.
        frame: Coordinate frame of the boxes: `ego`, `world`, `lidar` or a camera channel of the
            sample.

    Raises:
        TokenError: The sample is unknown.
        NotAvailableError: The sample is not labelled, or an agent is not in this (partial) release.
        ChoiceError: An agent, the configuration or the frame is unknown.
        ConfigError: `link` is not a Link, or its latency reaches back before the recording.
    """
    record = dataset.get("sample", sample)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label (the test split ships without labels), so an "
            "oracle knows nothing; choose a labelled sample"
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


def _merge_by_actor(boxes: Boxes, actor_ids: IntArray, agents: AnyArray) -> CooperativeView:
    """Merge the boxes of all agents into one box for each actor.

    Args:
        boxes: N boxes of all agents, the preferred ones first.
        actor_ids: Actor ids, shape (N,).
        agents: Indices into `taxonomy.AGENTS`, shape (N,): the agents that the boxes come from.
    """
    is_own = boxes.actor_id == OWN_ACTOR_ID
    tracked = np.flatnonzero(actor_ids != UNTRACKED_ID)
    order = tracked[np.lexsort((is_own[tracked], actor_ids[tracked]))]
    order = order[_unrepeated_rows(actor_ids[order], agents[order])]
    ids, first_rows, actors = np.unique(actor_ids[order], return_index=True, return_inverse=True)
    tracked_rows = order[first_rows]
    count = len(ids)
    is_other = ~is_own[order]
    points_by_others = np.where(is_other, boxes.num_lidar_pts[order], 0)
    points = np.bincount(actors, points_by_others, count).astype(np.int64)
    seen_by_others = boxes.camera_visible[order] & is_other
    seen_by_camera = np.bincount(actors, seen_by_others, count) > 0
    seen_by = np.zeros(count, dtype=np.uint8)
    bits = np.left_shift(1, agents, dtype=np.uint8, casting="unsafe")
    np.bitwise_or.at(seen_by, actors, bits[order])

    untracked_rows = np.flatnonzero(actor_ids == UNTRACKED_ID)
    is_repeated = _find_repetitions(boxes, agents, untracked_rows, tracked_rows)
    untracked_rows = untracked_rows[~is_repeated]
    rows = np.concatenate([tracked_rows, untracked_rows])
    result = boxes.select(rows)
    columns = {}
    for name in ("center", "size", "rotation", "velocity", "category", "row"):
        columns[name] = getattr(result, name)
    columns["actor_id"] = actor_ids[rows]
    columns["num_lidar_pts"] = np.concatenate([points, boxes.num_lidar_pts[untracked_rows]])
    columns["camera_visible"] = np.concatenate(
        [seen_by_camera, boxes.camera_visible[untracked_rows]]
    )
    return CooperativeView(
        boxes=trusted_boxes(boxes.frame, columns, scenario=boxes.scenario),
        source=agents[rows],
        seen_by=np.concatenate([seen_by, bits[untracked_rows]]),
    )


def _unrepeated_rows(actor_ids: IntArray, agents: AnyArray) -> IntArray:
    """Return the first row of each (actor, agent) pair, in ascending order.

    A label may repeat an actor.
    """
    pair_codes = actor_ids * len(AGENTS) + agents
    _, rows = np.unique(pair_codes, return_index=True)
    first_rows: IntArray = np.sort(rows)
    return first_rows


def _find_repetitions(
    boxes: Boxes, agents: AnyArray, untracked_rows: IntArray, tracked_rows: IntArray
) -> BoolArray:
    """Mark the untracked rows that repeat a tracked actor or an earlier agent's untracked row.

    Args:
        boxes: Boxes of all agents.
        agents: Indices into `taxonomy.AGENTS` of all boxes.
        untracked_rows: Rows of untracked boxes, shape (U,).
        tracked_rows: Rows of the retained boxes of tracked actors.

    Returns:
        Truth values, shape (U,).
    """
    candidates = np.concatenate([tracked_rows, untracked_rows])
    offsets = boxes.center[untracked_rows][:, None] - boxes.center[candidates]
    distances: FloatArray = np.linalg.norm(offsets, axis=-1)
    categories = boxes.category[untracked_rows]
    is_same_category = categories[:, None] == boxes.category[candidates]
    is_same_actor = (distances < SAME_ACTOR_DISTANCE) & is_same_category
    untracked_agents = agents[untracked_rows]
    is_other_agent = untracked_agents[:, None] != untracked_agents
    is_same_actor[:, len(tracked_rows) :] &= np.tril(is_other_agent, k=-1)
    is_repeated: BoolArray = is_same_actor.any(axis=1)
    return is_repeated


def _mask_visible(message: Message, boxes: Boxes, visible: Visible) -> BoolArray:
    """Mark the boxes, in the LiDAR frame, that the sender sees under the rule `visible`."""
    if visible == "camera":
        return boxes.camera_visible
    is_other: BoolArray = boxes.actor_id != OWN_ACTOR_ID
    is_tracked: BoolArray = boxes.actor_id != UNTRACKED_ID
    return _mask_released(message, boxes) & is_other & is_tracked


def _mask_released(message: Message, boxes: Boxes) -> BoolArray:
    """Mark the boxes, in the LiDAR frame, that the sender's LiDAR points and cameras show."""
    return visible_mask(
        boxes.center[:, :2],
        boxes.category,
        boxes.num_lidar_pts,
        boxes.camera_visible,
        infrastructure=message.agent == INFRASTRUCTURE,
    )
