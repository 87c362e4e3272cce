"""How a scenario's accident happened, from the actors' tracks."""

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
"""The largest gap at the last frame, metres, with which a pair can collide within the next tenth of a second."""
# Metres of a gap at the last frame, beside those of a tenth of a second, with which a pair can still collide.
_LEEWAY: Final = 0.3
# Metres; outlines this near touch, and overlap if they reach farther into each other; the direction of the shortest
# line between two outlines is used from there on.
_TOUCHING: Final = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contact(FrozenArrays):
    """The end of an accident scenario: world, right-handed, metres, seconds, radians; pairs in the meta file's order.

    Attributes:
        instances: tokens of the pair.
        actor_ids: their CARLA ids.
        frame: token of the last moment at which both are annotated: in a complete recording the last frame. The
            impact is at most 0.1 s later, or up to some tenths of a second before it.
        contact_frame: token of the first frame of the last run of frames in which the labelled outlines touch (seen
            from above, within 0.02 m). Contact began at most 0.1 s before it. None if they never touch.
        point: (3,) where they touch at `frame`, seen from above: the middle between their outlines where these are
            nearest; if they overlap, the middle of the overlap; at the mean height of their centres. Read-only.
        gap: metres between the outlines at `frame` seen from above, 0 if they overlap.
        speeds: m/s over the ground at the last frame before the outlines overlap, since later ones may be those after
            the blow: what the labels say there or, if that is `frame`, the displacements of 0.1 s. NaN if unknown.
        closing_speed: m/s with which they approach each other along the shortest line between their outlines (if they
            touch or overlap, along the normal of the sides that meet); negative if they part; NaN if unknown.
        impact_angle: angle between their headings at `contact_frame` (without one at `frame`), in [0, π]: 0 the same
            direction, π head-on.
        sides: the side of each that faces the other across the widest gap along any side's normal (the least overlap),
            at the same moment.
        disagreements: each contradiction of the meta file and the recording in words: a gap of more than 1.5 m, other
            classes or other agents than in the meta file, an end before the last frame, or a contact side in the meta
            file that is neither of the two sides.
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
        last, first = (int(token.rsplit("/", 1)[1]) for token in (self.frame, self.contact_frame))
        return round((last - first) * FRAME_PERIOD, 1)

    @property
    def apart(self) -> bool:
        """Whether the gap is wider than the two close in 0.1 s, and 0.3 m: then `frame` shows no collision."""
        return bool(self.gap > max(np.nan_to_num(self.closing_speed), 0.0) * FRAME_PERIOD + _LEEWAY)

    def __repr__(self) -> str:
        """Who, where, how fast: in one line."""
        who = " and ".join(
            f"{actor} ({side})" for actor, side in zip(self.actor_ids, self.sides, strict=True)
        )
        speeds = " and ".join(f"{speed:.1f}" for speed in self.speeds)
        x, y = self.point[:2].tolist()
        when = (
            "" if self.touching is None else f" touching from {self.touching:.1f} s before the end,"
        )
        return (
            f"Contact(actors {who} at x {x:.1f}, y {y:.1f} m in world:{when} gap {self.gap:.2f} m, {speeds} m/s, "
            f"closing at {self.closing_speed:.1f} m/s, {math.degrees(self.impact_angle):.0f}° between their headings)"
        )


def contact_words(touching: float | None, gap: float) -> str:
    """When outlines touch, `touching` seconds before the last frame that shows both, or how far apart they are then."""
    if touching is None:
        return f"outlines {gap:.2f} m apart at the last frame"
    moment = f"from {touching:.1f} s before" if touching else "at"
    return f"outlines touching {moment} the last frame (within 0.1 s)"


def first_accident(dataset: Dataset) -> str:
    """The first scenario that ends in an accident, preferably with labels of both; or NotAvailableError."""
    accidents = [record for record in dataset.scenario if record["collision"] is not None]
    for record in accidents:
        if (
            labelled_pair(record["collision"], scenario_tracks(dataset, record["token"]).actor_id)
            is not None
        ):
            return record["token"]
    if accidents:
        return accidents[0]["token"]
    others = f", or show another view of a scenario that is there, such as {dataset.scenario[0]['token']}"
    raise NotAvailableError(
        f"{dataset.dataroot}: no scenario ends in an accident that a meta file names; unpack an accident and its meta"
        f"{others if len(dataset.scenario) else ''}"
    )


def default_scenario(dataset: Dataset) -> str:
    """The first scenario that ends in an accident, or if none does, the first one; or NotAvailableError."""
    try:
        return first_accident(dataset)
    except NotAvailableError:
        if not len(dataset.scenario):
            raise
        return dataset.scenario[0]["token"]


def collision(dataset: Dataset, scenario: RowArgument) -> Contact | None:
    """How a scenario's accident happened: the pair that the meta file names, where they met and how fast.

    As the recording has 10 Hz, the last frame may still show a gap, up to a metre at 10 m/s.

    Args:
        dataset: the release.
        scenario: token or record.

    Returns:
        None if the meta file names no collision.

    Raises:
        TokenError: no such scenario.
        NotAvailableError: the scenario has no meta file, the file names one actor twice, or no label shows both of the
            pair at the same moment.
    """
    record = dataset.scenario[dataset.getind("scenario", scenario)]
    named = colliding_pair(record)
    if named is None:
        return None
    first, second = named
    tracks = scenario_tracks(dataset, record["token"])
    frames, rows = labelled_together(tracks, record["token"], named)
    outlines = (tracks.boxes.select(each) for each in rows)
    gaps = signed_gaps(
        *(np.column_stack([each.center[:, :2], each.size[:, :2], each.yaw]) for each in outlines)
    )
    begin, last = contact_begin(gaps), len(frames) - 1
    moment = last if begin is None else begin
    pair, met = (tracks.boxes.select(rows[:, at]) for at in (last, moment))
    point, gap, normal = _contact(pair, _facing(pair)[0])
    facing, sides = _facing(met)
    before = max(moment - 1, 0) if gaps[moment] < -_TOUCHING else moment
    if before == last:
        velocity = _velocities_into(dataset, frame_token(record["token"], int(frames[last])), pair)
    else:
        velocity = tracks.boxes.velocity[rows[:, before]]
    closing = float((velocity[0] - velocity[1])[:2] @ (normal if moment == last else facing))
    turn = met.yaw[0] - met.yaw[1]
    speeds = np.linalg.norm(velocity, axis=1)
    return Contact(
        instances=(instance_token(record["token"], first), instance_token(record["token"], second)),
        actor_ids=(first, second),
        frame=frame_token(record["token"], int(frames[last])),
        contact_frame=None if begin is None else frame_token(record["token"], int(frames[begin])),
        point=point,
        gap=gap,
        speeds=(float(speeds[0]), float(speeds[1])),
        closing_speed=closing,
        impact_angle=float(abs(np.arctan2(np.sin(turn), np.cos(turn)))),
        sides=sides,
        disagreements=tuple(_disagreements(dataset, record, pair, int(frames[last]), gap, sides)),
    )


def colliding_pair(record: ScenarioRecord) -> tuple[int, int] | None:
    """The actor ids of the pair that a scenario's meta file names; None if it names no collision.

    Raises:
        NotAvailableError: the scenario has no meta file, or the file names one actor twice.
    """
    if record["weather"] is None:
        raise NotAvailableError(
            f"{record['token']} has no meta file, which names the colliding pair; unpack meta"
        )
    if record["collision"] is None:
        return None
    first, second = record["collision"]["ids"]
    if first == second:
        raise NotAvailableError(
            f"{record['token']}: meta names actor {first} twice instead of a colliding pair; restore the meta file"
        )
    return first, second


def labelled_pair(collision: CollisionRecord | None, actor_ids: IntArray) -> tuple[int, int] | None:
    """The ids of the pair that collides, if `actor_ids` (N,) of labels have both; the one place that decides it.

    Meta may name one actor twice, or one that no label has: id 0, or of an agent that is not here.
    """
    first, second = (0, 0) if collision is None else collision["ids"]
    return (
        (first, second) if first != second and np.isin((first, second), actor_ids).all() else None
    )


def _velocities_into(dataset: Dataset, frame: str, pair: Boxes) -> FloatArray:
    """(2, 3) m/s in world, from the pair's displacements: a label's velocity may already be that after the impact.

    If a displacement is unknown, the label's velocity counts.
    """
    velocity = np.full((2, 3), np.nan)
    for own in (False, True):  # an agent's own row can be wrong by 0.3 m
        for sample in dataset.samples_of(frame):
            boxes, actors = dataset.boxes(sample, velocity="derived"), dataset.actor_ids(sample)
            for which, actor in enumerate(pair.actor_id.tolist()):
                rows = np.flatnonzero((actors == actor) & ((boxes.actor_id == OWN_ACTOR_ID) == own))
                if len(rows) and np.isnan(velocity[which, 0]):
                    velocity[which] = boxes.velocity[rows[0]]
    return np.where(np.isnan(velocity), pair.velocity, velocity)


def labelled_together(
    tracks: ScenarioTracks, scenario: str, pair: tuple[int, int]
) -> tuple[IntArray, IntArray]:
    """The frame numbers (F,), ascending, at which labels show both of a pair, and the rows (2, F) of tracks there.

    Raises NotAvailableError if there are none: `counterpart not recorded` if labels show one of the two alone.
    """
    own = [np.flatnonzero(tracks.actor_id == actor) for actor in pair]
    first, second = (tracks.index[each] for each in own)
    frames, *places = np.intersect1d(first, second, return_indices=True)
    absent = [actor for actor, each in zip(pair, own, strict=True) if not len(each)]
    if len(absent) == 1:
        raise NotAvailableError(
            f"{scenario}: counterpart not recorded: meta names actor {absent[0]}, which no label shows; the release "
            "has such accidents, and render_frame shows their moments"
        )
    if not len(frames):
        raise NotAvailableError(
            f"{scenario}: no label shows the colliding pair {pair[0]} and {pair[1]} at one moment; leave it out"
        )
    return frames, np.stack([each[place] for each, place in zip(own, places, strict=True)])


def contact_begin(gaps: FloatArray) -> int | None:
    """Where, in the signed gaps (F,) of a pair, the last run of touching frames begins; None if they never touch."""
    apart = gaps > _TOUCHING
    if apart.all():
        return None
    end = int(np.flatnonzero(~apart)[-1])
    return int(np.flatnonzero(apart[:end])[-1]) + 1 if apart[:end].any() else 0


def _contact(pair: Boxes, facing: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """The point of contact (3,), the gap from above, and the horizontal unit vector (2,) from first to second.

    That vector is along the shortest line between the outlines; if they touch, it is `facing`.

    To find the point, the second outline is moved a little into the first. The point is the middle of their overlap:
    for two parallel faces, the middle of the part where they are opposite each other.
    """
    from shapely import Polygon, get_coordinates, shortest_line
    from shapely.affinity import translate

    first, second = (Polygon(corners[:, :2]) for corners in pair.bottom_corners())
    gap = float(first.distance(second))
    normal = facing
    if gap > _TOUCHING:
        start, end = get_coordinates(shortest_line(first, second))
        normal = (end - start) / gap
    push = normal * (gap + _TOUCHING)
    shared = first.intersection(translate(second, *(-push).tolist()))
    if shared.is_empty:  # corners that nearly touch pass each other
        middle = get_coordinates(shortest_line(first, second)).mean(axis=0)
    else:
        middle = get_coordinates(shared.centroid)[0] + push / 2
    return np.array([*middle, pair.center[:, 2].mean()]), gap, normal


def _facing(pair: Boxes) -> tuple[FloatArray, tuple[ContactSide, ContactSide]]:
    """The normal (2,) along which the gap is widest, first to second, and the sides that face each other."""
    axes = quaternions.to_matrix(pair.rotation)[:, :2, :2]  # box, xy, along or across
    normals = np.concatenate([axes[0].T, axes[1].T])
    reach = np.einsum(
        "nbk,bk->n", np.abs(np.einsum("na,bak->nbk", normals, axes)), pair.size[:, :2] / 2
    )
    apart = normals @ (pair.center[1] - pair.center[0])[:2]
    best = int(np.argmax(np.abs(apart) - reach))
    toward_second = normals[best] * (1.0 if apart[best] >= 0 else -1.0)
    return toward_second, (_side(toward_second @ axes[0]), _side(-toward_second @ axes[1]))


def _side(direction: FloatArray) -> ContactSide:
    """The side of a box that faces a horizontal direction (2,) of the box's own frame."""
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
    told = record["collision"]
    if told is None:  # only for the type checker
        return []
    found = []
    if index != record["num_frames"]:
        found.append(f"the pair is last seen at frame {index:03d} of {record['num_frames']:03d}")
    if gap > CONTACT_GAP:
        found.append(f"the pair is {gap:.2f} m apart")
    if pair.category_names != told["classes"]:
        found.append(f"the classes are {pair.category_names}, meta says {told['classes']}")
    found += _other_agents(
        _agent_ids(dataset, record["token"]), pair.actor_id.tolist(), told["agents"]
    )
    word, _, aside = told["contact_side"].partition("_")
    fitting = {word, "left", "right"} if aside else {word}
    if word in ("front", "rear", "left", "right") and not fitting & {*sides}:
        found.append(f"the sides are {list(sides)}, meta says {told['contact_side']}")
    return found


def _agent_ids(dataset: Dataset, scenario: str) -> dict[str, int | None]:
    """The vehicles that recorded a scenario in this release → their actor ids; None if the meta file does not say."""
    agents = (dataset.agent.get(f"{scenario}/{name}") for name in agents_of(dataset, scenario))
    return {agent["name"]: agent["actor_id"] for agent in agents if not agent["is_infrastructure"]}


def _other_agents(
    ids: Mapping[str, int | None], pair: Sequence[int], told: Sequence[str | None] | None
) -> list[str]:
    """How the colliding agents in the meta file differ from those that have the pair's ids, in words.

    `ids` are the vehicles that are agents here → actor ids; `told` the meta file's names, None for no agent.
    """
    if told is None:
        return []
    owners = [next((name for name, actor in ids.items() if actor == one), None) for one in pair]
    strangers = set(owners) - set(told) - {None}
    absent = {name for name in told if name is not None and ids.get(name) is not None} - set(owners)
    if not strangers and not absent:
        return []
    return [f"the agents are {_words(owners)}, meta says {_words(told)}"]


def _words(agents: Sequence[str | None]) -> list[str]:
    return [agent or "none" for agent in agents]
