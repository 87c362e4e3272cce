"""The course of a scenario's accident, from the tracks of its actors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.geometry import Boxes, quaternions
from deepaccident_devkit.geometry.box_arrays import signed_gaps
from deepaccident_devkit.support.arrays import FloatArray, FrozenArrays, IntArray
from deepaccident_devkit.tables.tokens import frame_token, instance_token
from deepaccident_devkit.taxonomy import FRAME_PERIOD, OWN_ACTOR_ID
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.tracks import ScenarioTracks, scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import CollisionRecord, ScenarioRecord

ContactSide = Literal["front", "rear", "left", "right"]
CONTACT_GAP = 1.5
"""Largest gap in the last frame, metres, at which a pair can still collide within 0.1 s."""
# A pair can still collide if its gap exceeds the distance closed in 0.1 s by at most this.
_GAP_TOLERANCE_M = 0.3
# Outlines within this distance touch; they overlap if the overlap is deeper than this. The
# direction of the shortest line between two outlines is reliable only if the line is longer than
# this.
_TOUCHING_DISTANCE_M = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contact(FrozenArrays):
    """The end of an accident scenario, in the right-handed world frame, with read-only arrays.

    Units are metres, seconds and radians; pairs are in the order of the meta file.

    Attributes:
        instances: Tokens of the pair.
        actor_ids: CARLA ids of the pair.
        frame: Token of the last frame in which both are annotated: in a complete recording, the
            last one. The impact is between a few tenths of a second before it and 0.1 s after it.
        contact_frame: Token of the first of the final frames in which the labelled outlines touch
            without interruption (seen from above, within 0.02 m). Contact began at most 0.1 s
            before it. None if the outlines never touch.
        point: Point (3,) at which the outlines touch at `frame`: midway between them where they are
            nearest or, if they overlap, the middle of the overlap, seen from above. Its height is
            the mean of the centres'.
        gap: Distance between the outlines at `frame` seen from above, metres; 0 if they overlap.
        speeds: Speeds over the ground, m/s, in the last frame before the outlines overlap, because
            the impact may already have changed later ones. They are the labels' velocities or, if
            that frame is `frame`, the displacements over 0.1 s. NaN if unknown.
        closing_speed: Speed, m/s, at which the two approach each other along the shortest line
            between their outlines (if they touch or overlap, along the normal of the sides in
            contact); negative if they move apart; NaN if unknown.
        impact_angle: Angle between the headings at `contact_frame` (at `frame` if `contact_frame`
            is None), in [0, π]: 0 for the same direction, π for head-on.
        sides: Side of each actor that faces the other, in the same frame: across the normal along
            which the gap is widest (or the overlap smallest).
        disagreements: Contradictions between the meta file and the recording, in words: a gap of
            more than 1.5 m, classes or agents that differ from the meta file, `frame` before the
            last frame, or a contact side in the meta file that is neither of `sides`.
    """

    instances: tuple[str, str]
    actor_ids: tuple[int, int]
    frame: str
    contact_frame: str | None
    point: FloatArray
    gap: float
    speeds: tuple[float, float]
    closing_speed: float
    impact_angle: float
    sides: tuple[ContactSide, ContactSide]
    disagreements: tuple[str, ...]

    @property
    def touching(self) -> float | None:
        """Seconds from `contact_frame` to `frame`; None if the outlines never touch."""
        if self.contact_frame is None:
            return None
        last_index = int(self.frame.rsplit("/", 1)[1])
        contact_index = int(self.contact_frame.rsplit("/", 1)[1])
        seconds = (last_index - contact_index) * FRAME_PERIOD
        return round(seconds, 1)

    @property
    def apart(self) -> bool:
        """Whether the pair is too far apart at `frame` to collide there.

        This is so if the gap exceeds the distance that the two close in 0.1 s, plus 0.3 m.
        """
        approach_speed = max(np.nan_to_num(self.closing_speed), 0.0)
        return bool(self.gap > approach_speed * FRAME_PERIOD + _GAP_TOLERANCE_M)

    def __repr__(self) -> str:
        """Return the actors, the contact point and the speeds in one line."""
        pairs = zip(self.actor_ids, self.sides, strict=True)
        actors = " and ".join(f"{actor} ({side})" for actor, side in pairs)
        speeds = " and ".join(f"{speed:.1f}" for speed in self.speeds)
        x, y = self.point[:2].tolist()
        moment = ""
        if self.touching is not None:
            moment = f" touching from {self.touching:.1f} s before the end,"
        return (
            f"Contact(actors {actors} at x {x:.1f}, y {y:.1f} m in world:{moment} "
            f"gap {self.gap:.2f} m, {speeds} m/s, closing at {self.closing_speed:.1f} m/s, "
            f"{math.degrees(self.impact_angle):.0f}° between their headings)"
        )


def contact_words(touching: float | None, gap: float) -> str:
    """Describe in words how close the outlines of a colliding pair get.

    Args:
        touching: Seconds from the first contact to the last frame that shows both; None if the
            outlines never touch.
        gap: Distance between the outlines at that last frame, metres.
    """
    if touching is None:
        return f"outlines {gap:.2f} m apart at the last frame"
    moment = f"from {touching:.1f} s before" if touching else "at"
    return f"outlines touching {moment} the last frame (within 0.1 s)"


def first_accident(dataset: Dataset) -> str:
    """Return the token of the first accident scenario, preferably one that labels both actors.

    Raises:
        NotAvailableError: No scenario has a meta file that names an accident.
    """
    accidents = [record for record in dataset.scenario if record["collision"] is not None]
    for record in accidents:
        actor_ids = scenario_tracks(dataset, record["token"]).actor_id
        if labelled_pair(record["collision"], actor_ids) is not None:
            return record["token"]
    if accidents:
        return accidents[0]["token"]
    suggestion = ""
    if len(dataset.scenario):
        suggestion = (
            ", or show another view of a scenario in the release, such as "
            f"{dataset.scenario[0]['token']}"
        )
    raise NotAvailableError(
        f"{dataset.dataroot}: no scenario ends in an accident that a meta file names; "
        f"unpack an accident and its meta{suggestion}"
    )


def default_scenario(dataset: Dataset) -> str:
    """Return the token of the first accident scenario or, if there is none, of the first scenario.

    Raises:
        NotAvailableError: The release has no scenario.
    """
    try:
        return first_accident(dataset)
    except NotAvailableError:
        if not len(dataset.scenario):
            raise
        return dataset.scenario[0]["token"]


def collision(dataset: Dataset, scenario: RowArgument) -> Contact | None:
    """Reconstruct a scenario's accident: who collides, where and how fast.

    Because recordings are at 10 Hz, the last frame may still show a gap (up to 1 m at 10 m/s).

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.

    Returns:
        None if the meta file names no collision.

    Raises:
        TokenError: The scenario is unknown.
        NotAvailableError: The scenario has no meta file, the file names one actor twice, or there
            is no frame in which both actors are labelled.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    actor_ids = colliding_pair(record)
    if actor_ids is None:
        return None
    token = record["token"]
    tracks = scenario_tracks(dataset, token)
    indices, rows = labelled_together(tracks, token, actor_ids)
    outlines, other_outlines = (
        _outline_rows(tracks.boxes.select(actor_rows)) for actor_rows in rows
    )
    gaps = signed_gaps(outlines, other_outlines)
    begin = contact_begin(gaps)
    last = len(indices) - 1
    last_frame = frame_token(token, int(indices[last]))
    moment = last
    contact_frame = None
    if begin is not None:
        moment = begin
        contact_frame = frame_token(token, int(indices[begin]))
    last_pair = tracks.boxes.select(rows[:, last])
    last_direction, _ = _find_facing_sides(last_pair)
    point, gap, normal = _find_contact_point(last_pair, last_direction)
    meeting_pair = tracks.boxes.select(rows[:, moment])
    direction, sides = _find_facing_sides(meeting_pair)
    if moment == last:
        direction = normal
    before = moment
    if gaps[moment] < -_TOUCHING_DISTANCE_M:
        before = max(moment - 1, 0)
    if before == last:
        velocity = _velocities_at_frame(dataset, last_frame, last_pair)
    else:
        velocity = tracks.boxes.velocity[rows[:, before]]
    relative_velocity = velocity[0] - velocity[1]
    turn = meeting_pair.yaw[0] - meeting_pair.yaw[1]
    wrapped_turn = np.arctan2(np.sin(turn), np.cos(turn))
    speeds = np.linalg.norm(velocity, axis=1)
    disagreements = _find_disagreements(dataset, record, last_pair, int(indices[last]), gap, sides)
    return Contact(
        instances=(instance_token(token, actor_ids[0]), instance_token(token, actor_ids[1])),
        actor_ids=actor_ids,
        frame=last_frame,
        contact_frame=contact_frame,
        point=point,
        gap=gap,
        speeds=(float(speeds[0]), float(speeds[1])),
        closing_speed=float(relative_velocity[:2] @ direction),
        impact_angle=float(abs(wrapped_turn)),
        sides=sides,
        disagreements=tuple(disagreements),
    )


def colliding_pair(record: ScenarioRecord) -> tuple[int, int] | None:
    """Return the actor ids of the colliding pair in a scenario's meta file.

    Returns:
        None if the file names no collision.

    Raises:
        NotAvailableError: The scenario has no meta file, or the file names one actor twice.
    """
    if record["weather"] is None:
        raise NotAvailableError(
            f"{record['token']} has no meta file, which names the colliding pair; unpack meta"
        )
    if record["collision"] is None:
        return None
    actor, other_actor = record["collision"]["ids"]
    if actor == other_actor:
        raise NotAvailableError(
            f"{record['token']}: meta names actor {actor} twice instead of a colliding pair; "
            "restore the meta file"
        )
    return actor, other_actor


def labelled_pair(collision: CollisionRecord | None, actor_ids: IntArray) -> tuple[int, int] | None:
    """Return the ids of the colliding pair if both occur in `actor_ids` (N,), otherwise None.

    Meta may name one actor twice, or an actor that no label has: id 0, or an agent that is not in
    this release. All callers leave this decision to this function.
    """
    if collision is None:
        return None
    actor, other_actor = collision["ids"]
    if actor == other_actor or not np.isin((actor, other_actor), actor_ids).all():
        return None
    return actor, other_actor


def _outline_rows(boxes: Boxes) -> FloatArray:
    """Return the footprints of boxes: x, y, length, width, yaw, shape (N, 5)."""
    centers = boxes.center[:, :2]
    sizes = boxes.size[:, :2]
    return np.column_stack([centers, sizes, boxes.yaw])


def _velocities_at_frame(dataset: Dataset, frame: str, pair: Boxes) -> FloatArray:
    """Return a pair's velocities (2, 3) in world, m/s, from the displacements up to a frame.

    A label's velocity may already be the one after the impact, so it is used only if the
    displacement is unknown.
    """
    velocity = np.full((2, 3), np.nan)
    for from_own_row in (False, True):  # an agent's own row can be off by 0.3 m
        for sample in dataset.samples_of(frame):
            boxes = dataset.boxes(sample, velocity="derived")
            actor_ids = dataset.actor_ids(sample)
            is_source = (boxes.actor_id == OWN_ACTOR_ID) == from_own_row
            for member, actor in enumerate(pair.actor_id.tolist()):
                rows = np.flatnonzero((actor_ids == actor) & is_source)
                if len(rows) and np.isnan(velocity[member, 0]):
                    velocity[member] = boxes.velocity[rows[0]]
    return np.where(np.isnan(velocity), pair.velocity, velocity)


def labelled_together(
    tracks: ScenarioTracks, scenario: str, pair: tuple[int, int]
) -> tuple[IntArray, IntArray]:
    """Return the frames in which both actors of a pair are labelled.

    Args:
        tracks: Tracks of the scenario.
        scenario: Token of the scenario, for messages.
        pair: Actor ids of the pair.

    Returns:
        Ascending frame numbers (F,), and the rows (2, F) of `tracks` in these frames.

    Raises:
        NotAvailableError: There is no such frame; the message contains `counterpart not recorded`
            if only one of the two is labelled anywhere.
    """
    rows, other_rows = (np.flatnonzero(tracks.actor_id == actor) for actor in pair)
    indices, positions, other_positions = np.intersect1d(
        tracks.index[rows], tracks.index[other_rows], return_indices=True
    )
    if bool(len(rows)) != bool(len(other_rows)):
        absent = pair[1] if len(rows) else pair[0]
        raise NotAvailableError(
            f"{scenario}: counterpart not recorded: meta names actor {absent}, "
            "which no label shows; the release has such accidents, and render_frame shows "
            "their moments"
        )
    if not len(indices):
        raise NotAvailableError(
            f"{scenario}: no label shows the colliding pair {pair[0]} and {pair[1]} at one "
            "moment; exclude this scenario"
        )
    return indices, np.stack([rows[positions], other_rows[other_positions]])


def contact_begin(gaps: FloatArray) -> int | None:
    """Return the index at which the last run of touching frames begins.

    Args:
        gaps: Signed gaps of a pair in each frame, shape (F,), metres.

    Returns:
        Index into `gaps`; None if the two never touch.
    """
    is_apart = gaps > _TOUCHING_DISTANCE_M
    if is_apart.all():
        return None
    last_touch = int(np.flatnonzero(~is_apart)[-1])
    frames_apart = np.flatnonzero(is_apart[:last_touch])
    if not len(frames_apart):
        return 0
    return int(frames_apart[-1]) + 1


def _find_contact_point(pair: Boxes, facing: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Find the point where the outlines of a pair touch, seen from above.

    The second outline is moved slightly into the first; the point is the middle of their overlap.
    For two parallel sides, that is the middle of the part where they face each other.

    Returns:
        The point of contact (3,), the gap in metres, and the horizontal unit vector (2,) from the
        first to the second of the pair. The vector points along the shortest line between the
            outlines; if they touch, it is `facing`.
    """
    from shapely import Polygon, get_coordinates, shortest_line
    from shapely.affinity import translate

    outline, other_outline = (Polygon(corners[:, :2]) for corners in pair.bottom_corners())
    gap = float(outline.distance(other_outline))
    normal = facing
    if gap > _TOUCHING_DISTANCE_M:
        start, end = get_coordinates(shortest_line(outline, other_outline))
        normal = (end - start) / gap
    push = normal * (gap + _TOUCHING_DISTANCE_M)
    pushed_outline = translate(other_outline, *(-push).tolist())
    overlap = outline.intersection(pushed_outline)
    if overlap.is_empty:  # two corners nearly touch, but miss each other
        middle = get_coordinates(shortest_line(outline, other_outline)).mean(axis=0)
    else:
        middle = get_coordinates(overlap.centroid)[0] + push / 2
    height = pair.center[:, 2].mean()
    return np.array([*middle, height]), gap, normal


def _find_facing_sides(pair: Boxes) -> tuple[FloatArray, tuple[ContactSide, ContactSide]]:
    """Find the sides of a pair that face each other.

    Returns:
        The normal (2,) along which the gap is widest, from the first to the second, and the facing
        side of each.
    """
    axes = quaternions.to_matrix(pair.rotation)[:, :2, :2]  # axes: box, xy, length or width
    normals = np.concatenate([axes[0].T, axes[1].T])
    cosines = np.abs(np.einsum("na,bak->nbk", normals, axes))
    half_sizes = pair.size[:, :2] / 2
    half_extents = np.einsum("nbk,bk->n", cosines, half_sizes)
    center_offset = pair.center[1] - pair.center[0]
    offsets = normals @ center_offset[:2]
    gaps = np.abs(offsets) - half_extents
    widest = int(np.argmax(gaps))
    toward_second = normals[widest]
    if offsets[widest] < 0:
        toward_second = -toward_second
    side = _name_side(toward_second @ axes[0])
    other_side = _name_side(-toward_second @ axes[1])
    return toward_second, (side, other_side)


def _name_side(direction: FloatArray) -> ContactSide:
    """Return the side of a box that faces a horizontal direction (2,) in the box's frame."""
    forward, left = direction.tolist()
    if abs(forward) >= abs(left):
        return "front" if forward >= 0 else "rear"
    return "left" if left >= 0 else "right"


def _find_disagreements(
    dataset: Dataset,
    record: ScenarioRecord,
    pair: Boxes,
    index: int,
    gap: float,
    sides: tuple[ContactSide, ContactSide],
) -> list[str]:
    """Return the contradictions between the meta file and the labels of a pair, in words."""
    meta = record["collision"]
    if meta is None:  # never happens; for the type checker
        return []
    findings = []
    if index != record["num_frames"]:
        findings.append(f"the pair is last seen at frame {index:03d} of {record['num_frames']:03d}")
    if gap > CONTACT_GAP:
        findings.append(f"the pair is {gap:.2f} m apart")
    if pair.category_names != meta["classes"]:
        findings.append(f"the classes are {pair.category_names}, meta says {meta['classes']}")
    vehicle_ids: dict[str, int | None] = {}
    for name in agents_of(dataset, record["token"]):
        agent = dataset.agent.get(f"{record['token']}/{name}")
        if not agent["is_infrastructure"]:
            vehicle_ids[name] = agent["actor_id"]
    findings += _compare_agents(vehicle_ids, pair.actor_id.tolist(), meta["agents"])
    side, _, qualifier = meta["contact_side"].partition("_")
    fitting_sides = {side}
    if qualifier:
        fitting_sides |= {"left", "right"}
    if side in ("front", "rear", "left", "right") and fitting_sides.isdisjoint(sides):
        findings.append(f"the sides are {list(sides)}, meta says {meta['contact_side']}")
    return findings


def _compare_agents(
    ids_by_agent: Mapping[str, int | None],
    pair: Sequence[int],
    meta_agents: Sequence[str | None] | None,
) -> list[str]:
    """Describe how the colliding agents in the meta file differ from the agents with these ids.

    Args:
        ids_by_agent: Actor ids of the vehicles that are agents in this release, by name.
        pair: Actor ids of the pair.
        meta_agents: Names in the meta file, None for no agent; None if it names no agents.

    Returns:
        A list of one sentence, or an empty list.
    """
    if meta_agents is None:
        return []
    # In reverse order, so that the first agent with an id wins.
    agents_by_id = {actor: name for name, actor in reversed([*ids_by_agent.items()])}
    owners = [agents_by_id.get(actor) for actor in pair]
    unnamed = set(owners) - set(meta_agents) - {None}
    present = set()
    for name in meta_agents:
        if name is not None and ids_by_agent.get(name) is not None:
            present.add(name)
    absent = present - set(owners)
    if not unnamed and not absent:
        return []
    return [f"the agents are {_agent_names(owners)}, meta says {_agent_names(meta_agents)}"]


def _agent_names(agents: Sequence[str | None]) -> list[str]:
    """Return the names of agents, with `none` for None."""
    return [agent or "none" for agent in agents]
