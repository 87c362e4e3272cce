"""What one scenario's labels, meta and calib say about each fact that others measured (docs/validation.md, Facts).

A fact's values are an array a scenario, a value a case: true or false of shares. `release_facts` puts them together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.collisions.twins import twin_of
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import shortened
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs, signed_gaps
from deepaccident_devkit.release import Meta, read_meta
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
    UNTRACKED_ID,
    VEHICLE_AGENTS,
    WEATHERS,
)
from deepaccident_devkit.v2x.tracks import scenario_tracks

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

# m/s; up to it an actor stands.
_MOVING_SPEED: Final = 0.5
# The seconds ahead in which a collision is to be foreseen, and at which positions are.
_SECONDS_AHEAD: Final = (1, 2, 3, 4, 5)
# Frames in a second and in half of one, over which a velocity is measured.
_SECOND, _HALF = 10, 5
_PEDESTRIAN: Final = CATEGORIES.index("pedestrian")
# Field of meta → its known words.
_WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    "weather": WEATHERS,
    "road_type": ROAD_TYPES,
    "spawn_side": SPAWN_SIDES,
    "ego_direction": DIRECTIONS,
    "other_direction": DIRECTIONS,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFacts:
    """What one scenario has of each fact.

    Attributes:
        values: key of a fact → (N,) values, or (N, 2) values and whether the collision came; a fact of which the
            scenario has nothing is not there.
        counts: what is counted, such as `weather` → word → how often.
    """

    values: Mapping[str, FloatArray]
    counts: Mapping[str, Mapping[str, int]]


def counted_scenario_facts(dataset: Dataset, record: ScenarioRecord) -> ScenarioFacts:
    """The facts of one scenario; raises MetaError where its meta file has become unreadable."""
    folder = ScenarioFolder(
        dataset.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS
    )
    seen, frame, collision = _Seen(dataset, record), record["velocity_frame"], record["collision"]
    labelled = len(np.unique(seen.column("sample", "agent")[seen.labelled]))
    values: dict[str, ArrayLike] = {
        "twins": [twin_of(dataset, record) is not None],
        "lights": [record["signalized"]],
        "agents": [labelled == len(AGENTS)],
        "velocities_released": [frame == RELEASED_VELOCITY_FRAME] if frame else [],
        **_of_agents(seen),
        **_of_labels(seen),
        **_extrapolated(seen),
        **(_of_meta(seen, record, read_meta(folder.meta_path)) if record["weather"] else {}),
    }
    words = {
        "agents with labels": str(labelled),
        "velocity frame": frame,
        **{name: dict(record)[name] for name in _WORDS},
        **(
            {"token 7": collision["spawn_relation"], "token 8": collision["contact_side"]}
            if collision
            else {}
        ),
    }
    ids = seen.column("annotation", "actor_id")
    arrays = {key: as_floats(each) for key, each in values.items() if np.size(each)}
    known = {
        key: each[np.isfinite(each.reshape(len(each), -1)).all(axis=1)]
        for key, each in arrays.items()
    }
    return ScenarioFacts(
        values={key: each for key, each in known.items() if len(each)},
        counts={
            **{name: {shortened(str(word or "unknown")): 1} for name, word in words.items()},
            "label ids": Counter(np.where(ids > 0, "from 1 on", ids.astype(str)).tolist()),
        },
    )


class _Seen:
    """What a scenario's tables hold of its A actors at F frames, in world, and of its S samples.

    Attributes:
        ids: (A,) ascending.
        boxes: (A, F, 5) outlines, metres and radians; NaN where nobody annotated the actor.
        velocity: (A, F, 2) m/s as the labels say.
        recent: (A, F, 2) m/s, the mean of the last half second; as the label says where nobody saw the actor before it.
        by_ego: (A, F) whether ego's label has the actor, or it is ego.
        vehicle: (A,) whether the actor is no pedestrian.
        drives: (S,) whether a sample is a vehicle's.
        labelled: (S,) whether it has a label.
        samples: rows of the samples.
    """

    def __init__(self, dataset: Dataset, record: ScenarioRecord) -> None:
        self.dataset, self.frames, row = (
            dataset,
            record["num_frames"],
            dataset.getind("scenario", record["token"]),
        )
        tracks = scenario_tracks(dataset, record["token"])
        self.ids, first, actor = np.unique(tracks.actor_id, return_index=True, return_inverse=True)
        boxes, dense = tracks.boxes, np.full((len(self.ids), self.frames, 8), np.nan)
        dense[actor.reshape(-1), tracks.index - 1] = np.column_stack(
            [
                boxes.center[:, :2],
                boxes.size[:, :2],
                boxes.yaw,
                boxes.velocity[:, :2],
                tracks.agents & 1,
            ]
        )
        self.boxes, self.velocity, self.by_ego = dense[..., :5], dense[..., 5:7], dense[..., 7] == 1
        before = np.pad(dense[..., :2], ((0, 0), (_HALF, 0), (0, 0)), constant_values=np.nan)[
            :, :-_HALF
        ]
        moved = (dense[..., :2] - before) * (_SECOND / _HALF)
        self.recent = np.where(np.isnan(moved), self.velocity, moved)
        self.vehicle: BoolArray = boxes.category[first] != _PEDESTRIAN
        of_samples = dataset.columns("sample")["scenario_row"]
        self.samples = slice(
            *of_samples.searchsorted(np.array([row, row + 1], dtype=of_samples.dtype)).tolist()
        )
        self.drives: BoolArray = self.column("sample", "agent") != AGENTS.index(INFRASTRUCTURE)
        self.labelled: BoolArray = self.column("sample", "labelled")

    def column(self, table: str, name: str) -> AnyArray:
        """What a column of samples, poses, label rows or sensor files has of this scenario."""
        columns, rows = self.dataset.columns(table), self.samples
        if (keys := columns.get("sample_row")) is not None:
            ends = np.array(
                [rows.start, rows.stop], dtype=keys.dtype
            )  # of another type, all rows would be copied
            rows = slice(*keys.searchsorted(ends).tolist())
        return np.asarray(columns[name][rows])


def _of_meta(seen: _Seen, record: ScenarioRecord, meta: Meta) -> dict[str, ArrayLike]:
    """What follows from the meta file and the folder's name; and what is foreseen of the collision."""
    accident, frames, collision, ids = (
        record["designed_accident"],
        record["num_frames"],
        meta.collision,
        meta.agent_ids,
    )
    values: dict[str, ArrayLike] = {
        "accident_without" if accident else "normal_with": [accident == (collision is None)],
        "folder_right": [accident == (collision is not None)],
        "accident_frames" if accident else "normal_frames": [frames],
        "length": [(frames, collision is not None)],
        "known_words": [
            (getattr(meta, name) or known[0]) in known for name, known in _WORDS.items()
        ],
        "ids_ascend": [ids[2] < ids[0] < ids[1] < ids[3]] if ids else [],
        "none_none": [meta.planned_agents is None] if ids and collision is None else [],
        **_foreseen(seen, collided=collision is not None),
    }
    if collision is None:
        return values
    names = dict(zip(ids or (), VEHICLE_AGENTS, strict=False))
    pair, unknown = {names.get(each) for each in collision.ids}, 0 in collision.ids
    pairs = {
        "designed": VEHICLE_AGENTS[::2],
        "behind": VEHICLE_AGENTS[1::2],
        "follower": VEHICLE_AGENTS[1:3],
    }
    return values | {
        "frames_by_meta": [frames == meta.recorded_frames],
        "short": [frames - 1 < _SECONDS_AHEAD[-1] * _SECOND],
        "relation_known": [collision.spawn_relation in ("same", "opposite")],
        "relation_opposite": [collision.spawn_relation == "opposite"],
        "contact_known": [collision.contact_side in ("front", "front_side", "rear", "rear_side")],
        "unknown_partner": [unknown],
        "agents_named": [set(collision.agents) == pair] if collision.agents and ids else [],
        "pair_background": [None in pair and not unknown] if ids else [],
        **{f"pair_{name}": [pair == {*each}] if ids else [] for name, each in pairs.items()},
        **_of_contact(seen, collision.ids),
    }


def _of_contact(seen: _Seen, pair: tuple[int, int]) -> dict[str, ArrayLike]:
    """How a pair met: before the end, at it or after it; nothing of a pair that labels do not show together."""
    rows = np.flatnonzero(np.isin(seen.ids, pair))
    known = np.flatnonzero(np.isfinite(seen.boxes[rows, :, 0]).all(axis=0))
    if len(rows) < 2 or len(known) < 2:
        return {}
    first, other = seen.boxes[rows][:, known]
    apart = signed_gaps(first, other)
    touching, last_second = (
        np.flatnonzero(apart <= 0),
        _SECOND * (np.ceil((seen.frames - 1) / _SECOND) - 1),
    )
    before = max(int([*touching, len(known) - 1][0]) - 1, 0)
    turn, velocity = first[before, 4] - other[before, 4], seen.velocity[rows, known[before]]
    return {
        "overlap_frames": [len(touching)],
        "overlap_depth": [-apart.min()] if len(touching) else [],
        "touch_at_end": [apart[-1] <= 0],
        "gap_closes": [gaps_of_pairs(first[-1], other[-1]) <= max(apart[-2] - apart[-1], 0) + 0.3],
        "touch_in_second": [(known[touching[:1]] > last_second).any()],
        "heading": [np.degrees(abs(np.arctan2(np.sin(turn), np.cos(turn))))],
        "relative_speed": [np.hypot(*(velocity[0] - velocity[1]))],
    }


def _of_agents(seen: _Seen) -> dict[str, ArrayLike]:
    """How the vehicles that record drive, how high the pole is, and how sensors sit on their agents."""
    poses = seen.column("ego_pose", "matrix").reshape(-1, 4, 4)
    speed, cars = np.hypot(*seen.column("sample", "velocity")[seen.drives].T), poses[seen.drives]
    known, poles = speed[np.isfinite(speed)], poses[~seen.drives][: len(cars)]
    below = [cars[np.hypot(*(cars - pole)[:, :2, 3].T).argmin(), 2, 3] for pole in poles[:1]]
    places, of = (
        seen.dataset.columns("calibrated_sensor"),
        seen.column("sample_data", "calibrated_sensor_row"),
    )
    moved = seen.column("sample_data", "matrix")[:, 3::4] - places["matrix"][of][:, 3:12:4]
    return {
        "pitch": np.degrees(np.arcsin(np.abs(cars[:, 2, 0]).clip(max=1))),
        "start_speed": speed[seen.column("sample", "timestamp")[seen.drives] == 0],
        "speed": speed,
        "slow": [(known < _MOVING_SPEED).mean()] if len(known) else [],
        "fast": [(known > 15).mean()] if len(known) else [],
        "pole_height": poles[:1, 2, 3] - below,
        "sensors_stay": places["number"][np.unique(of)] == 1,
        "jitter": [np.abs(moved).max(initial=0) * 1000],
    }


def _of_labels(seen: _Seen) -> dict[str, ArrayLike]:
    """Ids and own rows; of the vehicles in ego's labels their number, overlaps, and least gaps in the next two seconds.

    Untracked ones are left out; ego itself counts among those that overlap and come near.
    """
    ids, sample = (
        seen.column("annotation", "actor_id"),
        seen.column("annotation", "sample_row") - seen.samples.start,
    )
    vehicle = (ids > 0) & (seen.column("annotation", "category") != _PEDESTRIAN)
    own, vehicles = (
        np.bincount(sample[rows], minlength=len(seen.drives))
        for rows in (ids == OWN_ACTOR_ID, vehicle)
    )
    boxes = np.where(seen.by_ego[..., None], seen.boxes, np.nan)[seen.vehicle]
    pairs = np.stack(np.triu_indices(len(boxes), 1))
    gaps, moves = (
        gaps_of_pairs(*boxes[pairs]),
        (np.hypot(*seen.velocity[seen.vehicle].T) > _MOVING_SPEED).T[pairs],
    )
    here, movers = np.isfinite(gaps) & moves.any(axis=0), moves.sum(axis=0)[gaps == 0]
    least = [
        np.fmin.reduce(
            gaps[here[:, now], now + 1 : now + 2 * _SECOND + 1], axis=None, initial=np.inf
        )
        for now in range(0, seen.frames - 1, _SECOND)
    ]
    nearest = np.array(least)[np.isfinite(least)]
    return {
        "ids_known": np.isin(ids, (OWN_ACTOR_ID, UNTRACKED_ID)) | (ids > 0),
        "own_row": (own == seen.drives)[seen.labelled],
        "vehicles": vehicles[seen.labelled & (seen.column("sample", "agent") == 0)],
        "overlap_samples": (gaps == 0).any(axis=0)[seen.by_ego.any(axis=0)],
        **{
            f"overlap_{name}": movers == count
            for count, name in enumerate(("stand", "mixed", "move"))
        },
        "next_touch": nearest < 0.01,
        "next_near": nearest < 2.5,
        "next_gap": nearest,
    }


def _foreseen(seen: _Seen, *, collided: bool) -> dict[str, ArrayLike]:
    """The least gap in each second ahead at constant velocity, of all pairs of which one moves and of all pairs.

    A decision is each whole second from the first frame on that is before the impact; a second ahead counts if it is
    recorded, or the impact lies in it.
    """
    found: dict[str, list[tuple[float, bool]]] = {}
    end, times = seen.frames - 1, np.arange(1, _SECOND * _SECONDS_AHEAD[-1] + 1) / _SECOND
    for now in range(_SECOND, end, _SECOND):
        here, velocity = seen.boxes[:, now, None], seen.recent[:, now, None]
        pairs = np.stack(np.triu_indices(len(here), 1))
        mixed = (np.linalg.norm(velocity[pairs, 0], axis=-1) > _MOVING_SPEED).any(axis=0)
        ahead = here + np.pad(velocity * times[:, None], ((0, 0), (0, 0), (0, 3)))
        stand = _least_gaps(here, *pairs[:, ~mixed]).min()
        least = _least_gaps(ahead, *pairs[:, mixed]).reshape(-1, _SECOND).min(axis=1)
        for second, gap in zip(_SECONDS_AHEAD, least.tolist(), strict=True):
            hit = collided and now + _SECOND * (second - 1) < end <= now + _SECOND * second
            if hit or now + _SECOND * second <= end:
                found.setdefault(f"foreseen_{second}", []).append((gap, hit))
                found.setdefault(f"foreseen_all_{second}", []).append((min(gap, stand), hit))
    return dict(found)


def _least_gaps(boxes: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """(T,) the least gap of pairs of actors whose outlines are (A, T, 5), NaN left out; inf without a pair."""
    apart = np.hypot(*np.moveaxis(boxes[first] - boxes[second], -1, 0)[:2])
    longest, shortest = np.hypot(boxes[..., 2], boxes[..., 3]) / 2, boxes[..., 2:4].min(axis=-1) / 2
    most = np.fmin.reduce(
        np.maximum(apart - shortest[first] - shortest[second], 0), axis=0, initial=np.inf
    )
    pair, time = np.nonzero(apart - longest[first] - longest[second] <= most)
    least = np.full(boxes.shape[1], np.inf)
    np.minimum.at(least, time, gaps_of_pairs(boxes[first[pair], time], boxes[second[pair], time]))
    return least


def _extrapolated(seen: _Seen) -> dict[str, ArrayLike]:
    """How far actors are from where constant velocity puts them: every half second, at 1 to 5 s, as long as seen."""
    now, seconds = np.arange(_HALF, seen.frames, _HALF), np.array(_SECONDS_AHEAD)
    places = np.pad(
        seen.boxes[..., :2],
        ((0, 0), (0, _SECOND * _SECONDS_AHEAD[-1]), (0, 0)),
        constant_values=np.nan,
    )
    expected = places[:, now, None] + seen.recent[:, now, None] * seconds[:, None]
    error = np.linalg.norm(places[:, now[:, None] + _SECOND * seconds] - expected, axis=-1).reshape(
        -1, len(_SECONDS_AHEAD)
    )
    error = error[np.isfinite(error).any(axis=1)]
    last = len(_SECONDS_AHEAD) - 1 - np.isfinite(error)[:, ::-1].argmax(axis=1)
    return {"ade": np.nanmean(error, axis=1), "fde": error[np.arange(len(error)), last]}
