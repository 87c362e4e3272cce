"""What one scenario's labels, meta and calib say about each fact that others measured (docs/validation.md, Facts).

A fact's values are an array a scenario, a value a case: true or false of shares. `release_facts` puts them together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.accidents.twins import twin_of
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs, side_gaps
from deepaccident_devkit.release import Meta, read_meta
from deepaccident_devkit.release.labels import turned, world_from_label_velocity
from deepaccident_devkit.release.layout import ScenarioFolder
from deepaccident_devkit.support.arrays import AnyArray, BoolArray, FloatArray, IntArray, as_floats
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CATEGORIES,
    DIRECTIONS,
    INFRASTRUCTURE,
    OWN_ACTOR_ID,
    RELEASED_VELOCITY_FRAME,
    ROAD_TYPES,
    SPAWN_SIDES,
    STATIC_ACTOR_ID,
    UNTRACKED_ID,
    VEHICLE_AGENTS,
    WEATHERS,
)
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

MOVING: Final = 0.5
"""m/s; up to it an actor stands."""
SECONDS: Final = (1, 2, 3, 4, 5)
"""The seconds ahead in which a collision is to be foreseen, and at which positions are."""
_SECOND, _BACK = 10, 5
"""Frames in a second, and over which a velocity is measured."""
_AHEAD: Final = (5, 10, 15, 20)
"""Frames after a decision at which the recorded future is looked at."""
_PEDESTRIAN: Final = CATEGORIES.index("pedestrian")
_LEAST_MOTION = 2.0
"""m/s from which a velocity tells its frame."""
_WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    "weather": WEATHERS,
    "road_type": ROAD_TYPES,
    "spawn_side": SPAWN_SIDES,
    "ego_direction": DIRECTIONS,
    "other_direction": DIRECTIONS,
}
"""Field of meta → its known words; a spawn side begins with one."""
RELATIONS: Final = ("same", "opposite")
CONTACTS: Final = ("front", "front_side", "rear", "rear_side")
"""Meta's words of tokens 7 and 8."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFacts:
    """What one scenario has of each fact.

    Attributes:
        values: key of a fact → (N,) values or (N, 2) values and whether the collision came; a fact of which the
            scenario has nothing is not there.
        counts: what is counted, such as `weather` → word → how often.
    """

    values: Mapping[str, FloatArray]
    counts: Mapping[str, Counter[str]]


def scenario_facts(dataset: Dataset, record: ScenarioRecord) -> ScenarioFacts:
    """The facts of one scenario; raises MetaError where its meta file has become unreadable."""
    folder = ScenarioFolder(dataset.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS)
    meta = None if record["weather"] is None else read_meta(folder.meta_path)
    seen = _Seen(dataset, record)
    found = {"twins": [twin_of(dataset, record) is not None], "lights": [record["signalized"]]}
    values = {**found, **_of_files(seen), **_of_agents(seen), **_of_labels(seen)}
    counts = {
        "agents with labels": Counter([str(seen.labelled_agents)]),
        "velocity frame": Counter([record["velocity_frame"] or "unknown"]),
        "label ids": _id_counts(seen.annotations["actor_id"][seen.rows]),
    }
    if meta is not None:
        values |= _of_meta(record, meta)
        counts |= {name: Counter([str(getattr(meta, name))]) for name in _WORDS}
        if meta.collision is not None:
            counts["token 7"] = Counter([meta.collision.spawn_relation])
            counts["token 8"] = Counter([meta.collision.contact_side])
    if len(seen.ids):
        values |= _of_ego_labels(seen) | _foreseen(seen, meta) | _extrapolated(seen)
        if meta is not None and meta.collision is not None and set(meta.collision.ids) <= set(seen.ids.tolist()):
            values |= _of_contact(seen, meta.collision.ids)
    arrays = {key: as_floats(each) for key, each in values.items()}
    known = {
        key: each[np.isfinite(each if each.ndim > 1 else each[:, None]).all(axis=1)] for key, each in arrays.items()
    }
    return ScenarioFacts(values={key: each for key, each in known.items() if len(each)}, counts=counts)


class _Seen:
    """What a scenario's tables hold: A actors at F frames in world, and the rows of its samples and annotations.

    Attributes:
        ids: (A,) ascending.
        boxes: (A, F, 5) outlines, metres and radians; NaN where nobody annotated the actor.
        velocity: (A, F, 2) m/s.
        by_ego: (A, F) whether ego's label has the actor, or it is ego.
        vehicle: (A,) whether the actor is no pedestrian.
    """

    def __init__(self, dataset: Dataset, record: ScenarioRecord) -> None:
        self.dataset, self.record, self.frames = dataset, record, record["num_frames"]
        tracks = scenario_tracks(dataset, record["token"])
        self.ids, first, actor = np.unique(tracks.actor_id, return_index=True, return_inverse=True)
        shape, place = (len(self.ids), self.frames), (actor.reshape(-1), tracks.index - 1)
        self.boxes, self.velocity = np.full((*shape, 5), np.nan), np.full((*shape, 2), np.nan)
        boxes = tracks.boxes
        self.boxes[place] = np.column_stack([boxes.center[:, :2], boxes.size[:, :2], boxes.yaw])
        self.velocity[place] = boxes.velocity[:, :2]
        self.by_ego = np.zeros(shape, dtype=bool)
        self.by_ego[place] = tracks.agents & 1
        self.vehicle: BoolArray = boxes.category[first] != _PEDESTRIAN
        samples, self.annotations = dataset.columns("sample"), dataset.columns("annotation")
        row = dataset.getind("scenario", record["token"])
        self.samples = slice(*samples["scenario_row"].searchsorted(np.array([row, row + 1], dtype=np.int32)).tolist())
        ends = np.array([self.samples.start, self.samples.stop], dtype=np.int32)
        self.rows = slice(*self.annotations["sample_row"].searchsorted(ends).tolist())
        self.agent: AnyArray = samples["agent"][self.samples]
        self.drives: BoolArray = self.agent != AGENTS.index(INFRASTRUCTURE)
        self.labelled: BoolArray = samples["labelled"][self.samples]
        self.labelled_agents = len(np.unique(self.agent[self.labelled]))

    def column(self, table: str, name: str) -> AnyArray:
        """A column of the sample table, or of that of poses, of this scenario."""
        column: AnyArray = self.dataset.columns(table)[name][self.samples]
        return column

    @property
    def poses(self) -> FloatArray:
        """(S, 4, 4) `world_from_ego` of every sample."""
        return self.column("ego_pose", "matrix").reshape(-1, 4, 4)

    @cached_property
    def recent(self) -> FloatArray:
        """(A, F, 2) m/s: the mean of the last half second; as the label says where nobody saw the actor before it."""
        before = np.full_like(self.velocity, np.nan)
        before[:, _BACK:] = (self.boxes[:, _BACK:, :2] - self.boxes[:, :-_BACK, :2]) * (_SECOND / _BACK)
        return np.where(np.isnan(before), self.velocity, before)


def _of_meta(record: ScenarioRecord, meta: Meta) -> dict[str, list[object]]:
    """What follows from the meta file and the folder's name."""
    accident, frames, collision, ids = record["designed_accident"], record["num_frames"], meta.collision, meta.agent_ids
    collided = collision is not None
    kind = "accident" if accident else "normal"
    values: dict[str, list[object]] = {
        "accident_without" if accident else "normal_with": [collided != accident],
        "folder_right": [collided == accident],
        f"{kind}_frames": [frames],
        "length": [(frames, collided)],
        "known_words": [
            word is None or word in known or (name == "spawn_side" and word.startswith(known))
            for name, known in _WORDS.items()
            for word in [getattr(meta, name)]
        ],
    }
    if ids is not None:
        values["ids_ascend"] = [ids[2] < ids[0] < ids[1] < ids[3]]
    if collision is None:
        return values | ({"none_none": [meta.planned_agents is None]} if ids is not None else {})
    values["frames_by_meta"] = [frames == meta.recorded_frames]
    values["short"] = [frames - 1 < SECONDS[-1] * _SECOND]
    values["relation_known"] = [collision.spawn_relation in RELATIONS]
    values["relation_opposite"] = [collision.spawn_relation == "opposite"]
    values["contact_known"] = [collision.contact_side in CONTACTS]
    values["unknown_partner"] = [0 in collision.ids]
    if ids is not None:
        names = dict(zip(ids, VEHICLE_AGENTS, strict=True))
        pair = {names.get(each) for each in collision.ids}
        values["agents_named"] = [collision.agents is None or set(collision.agents) == pair]
        values["pair_designed"] = [pair == {VEHICLE_AGENTS[0], VEHICLE_AGENTS[2]}]
        values["pair_behind"] = [pair == {VEHICLE_AGENTS[1], VEHICLE_AGENTS[3]}]
        values["pair_follower"] = [pair == {VEHICLE_AGENTS[1], VEHICLE_AGENTS[2]}]
        values["pair_background"] = [None in pair and 0 not in collision.ids]
    return values


def _of_contact(seen: _Seen, pair: tuple[int, int]) -> dict[str, list[object]]:
    """How a pair met: before the end, at it or after it."""
    rows = seen.ids.searchsorted(pair)
    first, other = seen.boxes[rows]
    _, gap, reach = side_gaps(first, other)
    apart = (np.abs(gap) - reach).max(axis=1)
    known = np.flatnonzero(np.isfinite(apart))
    if pair[0] == pair[1] or not len(known):
        return {}
    touching, last = np.flatnonzero(apart <= 0), known[-1]
    contact = touching[0] if len(touching) else last
    before = known[max(0, known.searchsorted(contact) - 1)]
    turn = first[before, 4] - other[before, 4]
    whole = int(np.ceil((seen.frames - 1) / _SECOND)) - 1
    end = gaps_of_pairs(first[last], other[last])
    closed = apart[known[-2]] - apart[last] if len(known) > 1 else 0.0
    return {
        "overlap_frames": [len(touching)],
        "overlap_depth": [-apart[touching].min()] if len(touching) else [],
        "touch_at_end": [apart[last] <= 0],
        "gap_at_end": [end],
        "gap_closes": [end <= max(closed, 0.0) + 0.3],
        "touch_in_second": [len(touching) > 0 and contact > whole * _SECOND],
        "heading": [np.degrees(abs(np.arctan2(np.sin(turn), np.cos(turn))))],
        "relative_speed": [np.hypot(*(seen.velocity[rows[0], before] - seen.velocity[rows[1], before]))],
    }


def _of_agents(seen: _Seen) -> dict[str, object]:
    """How the vehicles that record drive, and how high the pole is."""
    speed = np.hypot(*seen.column("sample", "velocity")[seen.drives].T)
    poses = seen.poses
    start = seen.column("sample", "timestamp")[seen.drives] == 0
    known = speed[np.isfinite(speed)]
    values: dict[str, object] = {
        "pitch": np.degrees(np.arcsin(np.abs(poses[seen.drives, 2, 0]).clip(max=1))).max(initial=0, keepdims=True),
        "start_speed": speed[start],
    }
    if len(known):
        values |= {"speed": [known.max()], "slow": [(known < MOVING).mean()], "fast": [(known > 15).mean()]}
    if not seen.drives.all() and seen.drives.any():
        pole, cars = poses[~seen.drives, :3, 3][0], poses[seen.drives, :3, 3]
        values["pole_height"] = [pole[2] - cars[np.hypot(*(cars - pole)[:, :2].T).argmin(), 2]]
    return values


def _of_files(seen: _Seen) -> dict[str, object]:
    """How much a sensor's place on its agent differs between frames."""
    columns, places = seen.dataset.columns("sample_data"), seen.dataset.columns("calibrated_sensor")
    ends = np.array([seen.samples.start, seen.samples.stop], dtype=np.int32)
    rows = slice(*columns["sample_row"].searchsorted(ends).tolist())
    of = columns["calibrated_sensor_row"][rows]
    moved = np.abs(columns["matrix"][rows][:, 3::4] - places["matrix"][of][:, 3:12:4])
    return {"jitter": [moved.max(initial=0.0) * 1000], "sensors_stay": places["number"][np.unique(of)] == 1}


def _of_labels(seen: _Seen) -> dict[str, object]:
    """Ids, and what the labels' velocities are in, by the displacements of boxes."""
    table, rows = seen.annotations, seen.rows
    ids, sample = table["actor_id"][rows], table["sample_row"][rows] - seen.samples.start
    own = np.bincount(sample[ids == OWN_ACTOR_ID], minlength=len(seen.agent))
    vehicles = (ids > 0) & (table["category"][rows] != _PEDESTRIAN)
    values: dict[str, object] = {
        "ids_known": np.isin(ids, (OWN_ACTOR_ID, UNTRACKED_ID)) | (ids > 0),
        "own_row": (own == seen.drives)[seen.labelled],
        "vehicles": np.bincount(sample[vehicles], minlength=len(seen.agent))[seen.labelled & (seen.agent == 0)],
    }
    if seen.record["velocity_frame"] is not None:
        values["velocities_released"] = [seen.record["velocity_frame"] == RELEASED_VELOCITY_FRAME]
    others = np.flatnonzero(np.isin(ids, seen.ids))
    actor, frame = seen.ids.searchsorted(ids[others]), sample[others] % seen.frames
    position = np.pad(seen.boxes[..., :2], ((0, 0), (1, 1), (0, 0)), constant_values=np.nan)
    moved = (position[actor, frame + 2] - position[actor, frame]) * (_SECOND / 2)
    said, yaw = table["velocity_label"][rows][others], table["yaw"][rows][others]
    poses = seen.poses[sample[others]]
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    readings = {"world": said, "ego": turned(said, heading), "decoded": world_from_label_velocity(said, yaw)}
    telling = (np.hypot(*moved.T) > _LEAST_MOTION) & np.isfinite(said).all(axis=1)
    if telling.any():
        for name, velocity in readings.items():
            values[f"velocity_{name}"] = [np.median(np.hypot(*(velocity - moved)[telling].T))]
    return values


def _id_counts(ids: IntArray) -> Counter[str]:
    """How many label rows have which kind of id."""
    parked = ids >= STATIC_ACTOR_ID
    kinds = {str(special): ids == special for special in (OWN_ACTOR_ID, UNTRACKED_ID, 0)}
    kinds |= {f"1 to {STATIC_ACTOR_ID - 1}": (ids > 0) & ~parked, f"from {STATIC_ACTOR_ID} on": parked}
    known = {kind: int(rows.sum()) for kind, rows in kinds.items()}
    return Counter({**known, "others": len(ids) - sum(known.values())})


def _pairs(rows: IntArray) -> tuple[IntArray, IntArray]:
    first, second = np.triu_indices(len(rows), 1)
    return rows[first], rows[second]


def _moves(velocity: FloatArray) -> BoolArray:
    """Whether an actor moves: (…, 2) m/s → (…); one of unknown velocity does not."""
    return np.asarray(np.hypot(velocity[..., 0], velocity[..., 1]) > MOVING)


def _of_ego_labels(seen: _Seen) -> dict[str, object]:
    """Overlaps of the vehicles in ego's labels, and how near they come to each other in the next two seconds."""
    ego = seen.labelled & (seen.agent == 0)
    if not ego.any() or not seen.by_ego.any():
        return {}
    rows = np.flatnonzero(seen.vehicle & seen.by_ego.any(axis=1))
    boxes, there = np.where(seen.by_ego[..., None], seen.boxes, np.nan)[rows], seen.by_ego[rows]
    moves = _moves(seen.velocity[rows])
    first, second = _pairs(np.arange(len(rows)))
    reach = np.hypot(*np.moveaxis(boxes[..., 2:4], -1, 0)) / 2
    with np.errstate(invalid="ignore"):
        near = np.hypot(*np.moveaxis(boxes[first] - boxes[second], -1, 0)[:2]) < reach[first] + reach[second]
    pair, frame = np.nonzero(near)
    _, gap, most = side_gaps(boxes[first[pair], frame], boxes[second[pair], frame])
    over = (np.abs(gap) < most).all(axis=-1)
    pair, frame = pair[over], frame[over]
    movers = moves[first[pair], frame].astype(int) + moves[second[pair], frame]
    least = [
        gaps_of_pairs(boxes[one[:, None], ahead], boxes[two[:, None], ahead])
        for now in range(0, seen.frames - _AHEAD[0], _SECOND)
        for ahead in [np.array([now + each for each in _AHEAD if now + each < seen.frames])]
        for one, two in [_pairs(np.flatnonzero(there[:, now]))]
        for one, two in [(one[moves[one, now] | moves[two, now]], two[moves[one, now] | moves[two, now]])]
    ]
    nearest = np.array([np.nanmin(each) for each in least if np.isfinite(each).any()])
    return {
        "overlap_samples": np.isin(np.arange(seen.frames), frame),
        **{f"overlap_{name}": movers == count for count, name in enumerate(("stand", "mixed", "move"))},
        "next_touch": nearest < 0.01,
        "next_near": nearest < 2.5,
        "next_gap": nearest,
    }


def _foreseen(seen: _Seen, meta: Meta | None) -> dict[str, object]:
    """The least gap in each second ahead at constant velocity, of all pairs of which one moves and of all pairs.

    A decision is each whole second from the first frame on that is before the impact; a second ahead counts if it is
    recorded, or the impact lies in it. Rows are the two gaps, and whether the impact lies in it.
    """
    values: dict[str, list[object]] = {f"foreseen_{second}": [] for second in SECONDS}
    end, collided = seen.frames - 1, meta is not None and meta.collision is not None
    times = np.arange(1, _SECOND * SECONDS[-1] + 1) / _SECOND
    for now in range(_SECOND, end, _SECOND) if meta is not None else ():
        rows = np.flatnonzero(np.isfinite(seen.recent[:, now]).all(axis=1))
        first, second = _pairs(rows)
        moves = _moves(seen.recent[:, now])
        mixed = moves[first] | moves[second]
        stand = _least_gaps(seen.boxes[:, now, None], first[~mixed], second[~mixed])
        ahead = np.repeat(seen.boxes[:, now, None], len(times), axis=1)
        ahead[..., :2] += seen.recent[:, now, None] * times[:, None]
        for number in SECONDS:
            here = collided and now + _SECOND * (number - 1) < end <= now + _SECOND * number
            if here or now + _SECOND * number <= end:
                part = ahead[:, _SECOND * (number - 1) : _SECOND * number]
                least = _least_gaps(part, first[mixed], second[mixed])
                values[f"foreseen_{number}"].append((least, min(least, stand), here))
    return {key: np.reshape(each, (-1, 3)) for key, each in values.items()}


def _least_gaps(boxes: FloatArray, first: IntArray, second: IntArray) -> float:
    """The least gap of pairs of actors whose outlines are (A, T, 5); inf without a pair."""
    if not len(first):
        return float("inf")
    apart = np.hypot(*np.moveaxis(boxes[first] - boxes[second], -1, 0)[:2])
    longest, shortest = np.hypot(boxes[..., 2], boxes[..., 3]) / 2, boxes[..., 2:4].min(axis=-1) / 2
    most = np.maximum(apart - shortest[first] - shortest[second], 0).min()
    pair, time = np.nonzero(apart - longest[first] - longest[second] <= most)
    return float(gaps_of_pairs(boxes[first[pair], time], boxes[second[pair], time]).min())


def _extrapolated(seen: _Seen) -> dict[str, object]:
    """How far actors are from where constant velocity puts them: every half second, at 1 to 5 s, as long as seen."""
    errors = []
    for now in range(_BACK, seen.frames - _SECOND, _BACK):
        ahead = [now + _SECOND * second for second in SECONDS if now + _SECOND * second < seen.frames]
        there = seen.boxes[:, ahead, :2] - seen.boxes[:, now, None, :2]
        off = there - seen.recent[:, now, None] * ((np.array(ahead) - now) / _SECOND)[:, None]
        errors.append(
            np.pad(np.hypot(off[..., 0], off[..., 1]), ((0, 0), (0, len(SECONDS) - len(ahead))), constant_values=np.nan)
        )
    error = np.concatenate([np.zeros((0, len(SECONDS))), *errors])
    count = np.isfinite(error).cumprod(axis=1).sum(axis=1)
    rows = np.flatnonzero(count)
    total = np.nancumsum(error[rows], axis=1)[np.arange(len(rows)), count[rows] - 1]
    return {"ade": total / count[rows], "fde": error[rows, count[rows] - 1]}
