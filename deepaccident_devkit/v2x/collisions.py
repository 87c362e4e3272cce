"""The course of a scenario's accident, from the tracks of its actors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

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
CONTACT_GAP: Final = 1.5
"""Largest gap at the last frame, metres, with which a pair can collide within the next 0.1 s."""
# A pair can still collide if its gap exceeds the distance closed in 0.1 s by at most this.
_GAP_TOLERANCE_M: Final = 0.3
# Outlines as near as this touch, and overlap if they reach farther into each other. The shortest
# line between two outlines has a reliable direction only if it is longer than this.
_TOUCHING_DISTANCE_M: Final = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contact(FrozenArrays):
    """The end of an accident scenario, in the right-handed world frame; arrays are read-only.

    Metres, seconds and radians; pairs are in the order of the meta file.

    Attributes:
        instances: Tokens of the pair.
        actor_ids: CARLA ids of the pair.
        frame: Token of the last moment at which both are annotated: in a complete recording the
            last frame. The impact is at most 0.1 s later, or up to some tenths of a second before
            it.
        contact_frame: Token of the first frame of the last run of frames in which the labelled
            outlines touch (seen from above, within 0.02 m). Contact began at most 0.1 s before it.
            None if they never touch.
        point: Point (3,) at which they touch at `frame`, seen from above: the middle between their
            outlines where these are nearest; if they overlap, the middle of the overlap; at the
            mean height of their centres.
        gap: Distance between the outlines at `frame` seen from above, metres; 0 if they overlap.
        speeds: Speeds over the ground, m/s, at the last frame before the outlines overlap, because
            later ones may already be changed by the impact: from the labels' velocities or, if that
            frame is `frame`, from the displacements over 0.1 s. NaN if unknown.
        closing_speed: Speed, m/s, with which they approach each other along the shortest line
            between their outlines (if they touch or overlap, along the normal of the sides that
            meet); negative if they part; NaN if unknown.
        impact_angle: Angle between their headings at `contact_frame` (without one at `frame`), in
            [0, π]: 0 the same direction, π head-on.
        sides: Side of each that faces the other across the widest gap along any side's normal (the
            least overlap), at the same moment.
        disagreements: Contradictions between the meta file and the recording in words: a gap of
            more than 1.5 m, other classes or other agents than in the meta file, an end before the
            last frame, or a contact side in the meta file that is neither of the two sides.
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
        return round((last_index - contact_index) * FRAME_PERIOD, 1)

    @property
    def apart(self) -> bool:
        """Whether the pair is too far apart at `frame` to collide there.

        Then the gap is wider than the distance that the two close in 0.1 s, plus 0.3 m.
        """
        approach_speed = max(np.nan_to_num(self.closing_speed), 0.0)
        return bool(self.gap > approach_speed * FRAME_PERIOD + _GAP_TOLERANCE_M)

    def __repr__(self) -> str:
        """Return the actors, the place and the speeds in one line."""
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
    """Describe in words how near the outlines of a colliding pair come.

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
    """Return the token of the first scenario with an accident, preferably with labels of both.

    Raises:
        NotAvailableError: No scenario ends in an accident that a meta file names.
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
            ", or show another view of a scenario that is there, "
            f"such as {dataset.scenario[0]['token']}"
        )
    raise NotAvailableError(
        f"{dataset.dataroot}: no scenario ends in an accident that a meta file names; "
        f"unpack an accident and its meta{suggestion}"
    )


def default_scenario(dataset: Dataset) -> str:
    """Return the token of the first scenario with an accident, or of the first scenario.

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
    """Reconstruct a scenario's accident: the colliding pair, where they met and how fast.

    As the recording has 10 Hz, the last frame may still show a gap, up to a metre at 10 m/s.

    Args:
        dataset: The release.
        scenario: Token or record of the scenario.

    Returns:
        None if the meta file names no collision.

    Raises:
        TokenError: There is no such scenario.
        NotAvailableError: The scenario has no meta file, the file names one actor twice, or no
            label shows both of the pair at the same moment.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    actor_ids = colliding_pair(record)
    if actor_ids is None:
        return None
    token = record["token"]
    tracks = scenario_tracks(dataset, token)
    indices, rows = labelled_together(tracks, token, actor_ids)
    gaps = signed_gaps(
        _outlines(tracks.boxes.select(rows[0])), _outlines(tracks.boxes.select(rows[1]))
    )
    begin = contact_begin(gaps)
    last = len(indices) - 1
    moment = last if begin is None else begin
    last_pair = tracks.boxes.select(rows[:, last])
    point, gap, normal = _contact(last_pair, _facing(last_pair)[0])
    meeting_pair = tracks.boxes.select(rows[:, moment])
    facing, sides = _facing(meeting_pair)
    last_frame = frame_token(token, int(indices[last]))
    contact_frame = None if begin is None else frame_token(token, int(indices[begin]))
    overlapping = gaps[moment] < -_TOUCHING_DISTANCE_M
    before = max(moment - 1, 0) if overlapping else moment
    if before == last:
        velocity = _velocities_into(dataset, last_frame, last_pair)
    else:
        velocity = tracks.boxes.velocity[rows[:, before]]
    direction = normal if moment == last else facing
    closing_speed = float((velocity[0] - velocity[1])[:2] @ direction)
    turn = meeting_pair.yaw[0] - meeting_pair.yaw[1]
    speeds = np.linalg.norm(velocity, axis=1)
    disagreements = _disagreements(dataset, record, last_pair, int(indices[last]), gap, sides)
    return Contact(
        instances=(instance_token(token, actor_ids[0]), instance_token(token, actor_ids[1])),
        actor_ids=actor_ids,
        frame=last_frame,
        contact_frame=contact_frame,
        point=point,
        gap=gap,
        speeds=(float(speeds[0]), float(speeds[1])),
        closing_speed=closing_speed,
        impact_angle=float(abs(np.arctan2(np.sin(turn), np.cos(turn)))),
        sides=sides,
        disagreements=tuple(disagreements),
    )


def colliding_pair(record: ScenarioRecord) -> tuple[int, int] | None:
    """Return the actor ids of the pair that a scenario's meta file names.

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
    """Return the ids of the pair that collides, if `actor_ids` (N,) of labels have both.

    This is the one place that decides it. Meta may name one actor twice, or one that no label has:
    id 0, or the id of an agent that is not in this release.
    """
    pair = (0, 0) if collision is None else collision["ids"]
    if pair[0] == pair[1] or not np.isin(pair, actor_ids).all():
        return None
    return pair[0], pair[1]


def _outlines(boxes: Boxes) -> FloatArray:
    """Return rows x, y, length, width, yaw (N, 5) of boxes seen from above."""
    return np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])


def _velocities_into(dataset: Dataset, frame: str, pair: Boxes) -> FloatArray:
    """Return velocities (2, 3), m/s in world, from the displacements of a pair up to a frame.

    The velocity of a label may already be the one after the impact; it counts only if the
    displacement is unknown.
    """
    velocity = np.full((2, 3), np.nan)
    for from_own_row in (False, True):  # an agent's own row can be wrong by 0.3 m
        for sample in dataset.samples_of(frame):
            boxes = dataset.boxes(sample, velocity="derived")
            actor_ids = dataset.actor_ids(sample)
            own_rows = boxes.actor_id == OWN_ACTOR_ID
            for member, actor in enumerate(pair.actor_id.tolist()):
                rows = np.flatnonzero((actor_ids == actor) & (own_rows == from_own_row))
                if len(rows) and np.isnan(velocity[member, 0]):
                    velocity[member] = boxes.velocity[rows[0]]
    return np.where(np.isnan(velocity), pair.velocity, velocity)


def labelled_together(
    tracks: ScenarioTracks, scenario: str, pair: tuple[int, int]
) -> tuple[IntArray, IntArray]:
    """Return the frames in which labels show both of a pair.

    Args:
        tracks: Tracks of the scenario.
        scenario: Token of the scenario, for messages.
        pair: Actor ids of the pair.

    Returns:
        Ascending frame numbers (F,), and the rows (2, F) of `tracks` there.

    Raises:
        NotAvailableError: There are no such frames; `counterpart not recorded` if labels show only
            one of the two.
    """
    rows_by_actor = [np.flatnonzero(tracks.actor_id == actor) for actor in pair]
    indices, *positions = np.intersect1d(
        tracks.index[rows_by_actor[0]], tracks.index[rows_by_actor[1]], return_indices=True
    )
    absent = [actor for actor, rows in zip(pair, rows_by_actor, strict=True) if not len(rows)]
    if len(absent) == 1:
        raise NotAvailableError(
            f"{scenario}: counterpart not recorded: meta names actor {absent[0]}, "
            "which no label shows; the release has such accidents, and render_frame shows "
            "their moments"
        )
    if not len(indices):
        raise NotAvailableError(
            f"{scenario}: no label shows the colliding pair {pair[0]} and {pair[1]} at one moment; "
            "leave it out"
        )
    shared_rows = [rows[position] for rows, position in zip(rows_by_actor, positions, strict=True)]
    return indices, np.stack(shared_rows)


def contact_begin(gaps: FloatArray) -> int | None:
    """Return the index at which the last run of touching frames begins.

    Args:
        gaps: Signed gaps (F,) of a pair, metres.

    Returns:
        None if they never touch.
    """
    apart = gaps > _TOUCHING_DISTANCE_M
    if apart.all():
        return None
    end = int(np.flatnonzero(~apart)[-1])
    if not apart[:end].any():
        return 0
    return int(np.flatnonzero(apart[:end])[-1]) + 1


def _contact(pair: Boxes, facing: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Compute where the outlines of a pair meet, seen from above.

    To find the point, the second outline is moved a little into the first. The point is the middle
    of their overlap: for two parallel faces, the middle of the part where they are opposite each
    other.

    Returns:
        The point of contact (3,), the gap in metres, and the horizontal unit vector (2,) from the
        first to the second of the pair. The vector is along the shortest line between the outlines;
        if they touch, it is `facing`.
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
    overlap = outline.intersection(translate(other_outline, *(-push).tolist()))
    if overlap.is_empty:  # corners that nearly touch pass each other
        middle = get_coordinates(shortest_line(outline, other_outline)).mean(axis=0)
    else:
        middle = get_coordinates(overlap.centroid)[0] + push / 2
    return np.array([*middle, pair.center[:, 2].mean()]), gap, normal


def _facing(pair: Boxes) -> tuple[FloatArray, tuple[ContactSide, ContactSide]]:
    """Find the sides of a pair that face each other.

    Returns:
        The normal (2,) along which the gap is widest, from the first to the second, and the facing
        side of each.
    """
    axes = quaternions.to_matrix(pair.rotation)[:, :2, :2]  # box, xy, along or across
    normals = np.concatenate([axes[0].T, axes[1].T])
    cosines = np.abs(np.einsum("na,bak->nbk", normals, axes))
    half_extents = np.einsum("nbk,bk->n", cosines, pair.size[:, :2] / 2)
    offsets = normals @ (pair.center[1] - pair.center[0])[:2]
    widest = int(np.argmax(np.abs(offsets) - half_extents))
    sign = 1.0 if offsets[widest] >= 0 else -1.0
    toward_second = normals[widest] * sign
    sides = (_side(toward_second @ axes[0]), _side(-toward_second @ axes[1]))
    return toward_second, sides


def _side(direction: FloatArray) -> ContactSide:
    """Return the side of a box that faces a horizontal direction (2,) of the box's own frame."""
    along, across = direction.tolist()
    if abs(along) >= abs(across):
        return "front" if along >= 0 else "rear"
    return "left" if across >= 0 else "right"


def _disagreements(
    dataset: Dataset,
    record: ScenarioRecord,
    pair: Boxes,
    index: int,
    gap: float,
    sides: tuple[ContactSide, ContactSide],
) -> list[str]:
    """Return the contradictions between the meta file and the labels of a pair, in words."""
    meta = record["collision"]
    if meta is None:  # only for the type checker
        return []
    findings = []
    if index != record["num_frames"]:
        findings.append(f"the pair is last seen at frame {index:03d} of {record['num_frames']:03d}")
    if gap > CONTACT_GAP:
        findings.append(f"the pair is {gap:.2f} m apart")
    if pair.category_names != meta["classes"]:
        findings.append(f"the classes are {pair.category_names}, meta says {meta['classes']}")
    agent_ids = _agent_ids(dataset, record["token"])
    findings += _other_agents(agent_ids, pair.actor_id.tolist(), meta["agents"])
    side, _, qualifier = meta["contact_side"].partition("_")
    fitting_sides = {side, "left", "right"} if qualifier else {side}
    if side in ("front", "rear", "left", "right") and not fitting_sides & {*sides}:
        findings.append(f"the sides are {list(sides)}, meta says {meta['contact_side']}")
    return findings


def _agent_ids(dataset: Dataset, scenario: str) -> dict[str, int | None]:
    """Return the actor ids of the vehicles that recorded a scenario in this release, by name.

    An id is None if the meta file does not name it.
    """
    agents = [dataset.agent.get(f"{scenario}/{name}") for name in agents_of(dataset, scenario)]
    vehicles = [agent for agent in agents if not agent["is_infrastructure"]]
    return {vehicle["name"]: vehicle["actor_id"] for vehicle in vehicles}


def _other_agents(
    ids_by_agent: Mapping[str, int | None],
    pair: Sequence[int],
    meta_agents: Sequence[str | None] | None,
) -> list[str]:
    """Describe how the colliding agents in the meta file differ from the agents with these ids.

    Args:
        ids_by_agent: Actor ids of the vehicles that are agents in this release, by name.
        pair: Actor ids of the pair.
        meta_agents: Names in the meta file, None for no agent; None if it names no agents.
    """
    if meta_agents is None:
        return []
    # In reverse order, so that the first agent with an id counts.
    agents_by_id = {actor: name for name, actor in reversed([*ids_by_agent.items()])}
    owners = [agents_by_id.get(actor) for actor in pair]
    unnamed = set(owners) - set(meta_agents) - {None}
    present = {
        name for name in meta_agents if name is not None and ids_by_agent.get(name) is not None
    }
    absent = present - set(owners)
    if not unnamed and not absent:
        return []
    return [f"the agents are {_words(owners)}, meta says {_words(meta_agents)}"]


def _words(agents: Sequence[str | None]) -> list[str]:
    """Return the names of agents, `none` for no agent."""
    return [agent or "none" for agent in agents]
