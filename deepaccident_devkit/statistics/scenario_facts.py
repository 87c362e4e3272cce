"""Values that one scenario's labels, meta and calib have of each fact (docs/validation.md, Facts).

The values of a fact are an array a scenario with one value a case, booleans for shares.
`release_facts` combines the scenarios.
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

# m/s; a slower actor counts as standing.
_MOVING_SPEED: Final = 0.5
# Horizons at which a collision is to be foreseen, and positions are predicted.
_HORIZONS_S: Final = (1, 2, 3, 4, 5)
_FRAMES_PER_SECOND: Final = 10
# Frames in half a second, over which a velocity is measured.
_VELOCITY_FRAMES: Final = 5
_PEDESTRIAN: Final = CATEGORIES.index("pedestrian")
# Field of meta → its known words.
_META_WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    "weather": WEATHERS,
    "road_type": ROAD_TYPES,
    "spawn_side": SPAWN_SIDES,
    "ego_direction": DIRECTIONS,
    "other_direction": DIRECTIONS,
}
# Fact → the pair that its scenario is designed for.
_PAIRS: Final[Mapping[str, set[str | None]]] = {
    "pair_designed": {*VEHICLE_AGENTS[::2]},
    "pair_behind": {*VEHICLE_AGENTS[1::2]},
    "pair_follower": {*VEHICLE_AGENTS[1:3]},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFacts:
    """Values that one scenario has of each fact.

    Attributes:
        values: Key of a fact → (N,) values, or (N, 2) values and whether the collision came;
            without facts that have no value in the scenario.
        counts: What is counted, such as `weather` → word → number.
    """

    values: Mapping[str, FloatArray]
    counts: Mapping[str, Mapping[str, int]]


def counted_scenario_facts(dataset: Dataset, record: ScenarioRecord) -> ScenarioFacts:
    """Return the facts of one scenario; raises MetaError if its meta file became unreadable."""
    folder = ScenarioFolder(
        dataset.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS
    )
    data = _ScenarioData(dataset, record)
    velocity_frame = record["velocity_frame"]
    collision = record["collision"]
    labelled_agents = len(np.unique(data.column("sample", "agent")[data.labelled]))
    velocities_released = [velocity_frame == RELEASED_VELOCITY_FRAME] if velocity_frame else []
    values: dict[str, ArrayLike] = {
        "twins": [twin_of(dataset, record) is not None],
        "lights": [record["signalized"]],
        "agents": [labelled_agents == len(AGENTS)],
        "velocities_released": velocities_released,
        **_agent_facts(data),
        **_label_facts(data),
        **_extrapolation_errors(data),
    }
    if record["weather"]:
        values |= _meta_facts(data, record, read_meta(folder.meta_path))
    words: dict[str, object] = {"agents with labels": str(labelled_agents)}
    words["velocity frame"] = velocity_frame
    words |= {name: dict(record)[name] for name in _META_WORDS}
    if collision:
        words |= {"token 7": collision["spawn_relation"], "token 8": collision["contact_side"]}
    counts = {name: {shortened(str(word or "unknown")): 1} for name, word in words.items()}
    ids = data.column("annotation", "actor_id")
    id_kinds = Counter(np.where(ids > 0, "from 1 on", ids.astype(str)).tolist())
    return ScenarioFacts(values=_finite_arrays(values), counts={**counts, "label ids": id_kinds})


def _finite_arrays(values: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
    """Return the finite rows of each fact's values, without facts that have none."""
    arrays = {}
    for key, cases in values.items():
        if np.size(cases):
            array = as_floats(cases)
            array = array[np.isfinite(array.reshape(len(array), -1)).all(axis=1)]
            if len(array):
                arrays[key] = array
    return arrays


class _ScenarioData:
    """Tables of a scenario as arrays over its A actors and F frames, world frame, and S samples.

    Attributes:
        ids: Actor ids, shape (A,), ascending.
        boxes: Outlines, shape (A, F, 5), metres and radians; NaN where nobody annotated the actor.
        velocity: Velocities of the labels, shape (A, F, 2), m/s.
        recent: Mean velocities over the last half second, shape (A, F, 2), m/s; the label's
            velocity where nobody saw the actor before.
        by_ego: Whether ego's label has the actor, or it is ego, shape (A, F).
        vehicle: Whether the actor is no pedestrian, shape (A,).
        drives: Whether a sample is a vehicle's, shape (S,).
        labelled: Whether a sample has a label, shape (S,).
        samples: Rows of the samples.
    """

    def __init__(self, dataset: Dataset, record: ScenarioRecord) -> None:
        self.dataset = dataset
        self.frames = record["num_frames"]
        row = dataset.getind("scenario", record["token"])
        tracks = scenario_tracks(dataset, record["token"])
        self.ids, first_row, actor = np.unique(
            tracks.actor_id, return_index=True, return_inverse=True
        )
        boxes = tracks.boxes
        dense = np.full((len(self.ids), self.frames, 8), np.nan)
        columns = [
            boxes.center[:, :2],
            boxes.size[:, :2],
            boxes.yaw,
            boxes.velocity[:, :2],
            tracks.agents & 1,
        ]
        dense[actor.reshape(-1), tracks.index - 1] = np.column_stack(columns)
        self.boxes = dense[..., :5]
        self.velocity = dense[..., 5:7]
        self.by_ego = dense[..., 7] == 1
        centers = dense[..., :2]
        earlier = np.pad(centers, ((0, 0), (_VELOCITY_FRAMES, 0), (0, 0)), constant_values=np.nan)[
            :, :-_VELOCITY_FRAMES
        ]
        measured = (centers - earlier) * (_FRAMES_PER_SECOND / _VELOCITY_FRAMES)
        self.recent = np.where(np.isnan(measured), self.velocity, measured)
        self.vehicle: BoolArray = boxes.category[first_row] != _PEDESTRIAN
        scenario_rows = dataset.columns("sample")["scenario_row"]
        bounds = np.array([row, row + 1], dtype=scenario_rows.dtype)
        self.samples = slice(*scenario_rows.searchsorted(bounds).tolist())
        self.drives: BoolArray = self.column("sample", "agent") != AGENTS.index(INFRASTRUCTURE)
        self.labelled: BoolArray = self.column("sample", "labelled")

    def column(self, table: str, name: str) -> AnyArray:
        """Return the scenario's rows of a column of samples, poses, label rows or sensor files."""
        columns = self.dataset.columns(table)
        rows = self.samples
        sample_rows = columns.get("sample_row")
        if sample_rows is not None:
            # With bounds of another type, numpy would copy all rows.
            bounds = np.array([rows.start, rows.stop], dtype=sample_rows.dtype)
            rows = slice(*sample_rows.searchsorted(bounds).tolist())
        return np.asarray(columns[name][rows])


def _meta_facts(data: _ScenarioData, record: ScenarioRecord, meta: Meta) -> dict[str, ArrayLike]:
    """Return facts of the meta file and the folder's name, and how the collision is foreseen."""
    accident = record["designed_accident"]
    frames = record["num_frames"]
    collision = meta.collision
    ids = meta.agent_ids
    known_words = [
        (getattr(meta, name) or words[0]) in words for name, words in _META_WORDS.items()
    ]
    values: dict[str, ArrayLike] = {
        "accident_without" if accident else "normal_with": [accident == (collision is None)],
        "folder_right": [accident == (collision is not None)],
        "accident_frames" if accident else "normal_frames": [frames],
        "length": [(frames, collision is not None)],
        "known_words": known_words,
        "ids_ascend": [ids[2] < ids[0] < ids[1] < ids[3]] if ids else [],
        "none_none": [meta.planned_agents is None] if ids and collision is None else [],
        **_foreseen_gaps(data, collided=collision is not None),
    }
    if collision is None:
        return values
    values |= {
        "frames_by_meta": [frames == meta.recorded_frames],
        "short": [frames - 1 < _HORIZONS_S[-1] * _FRAMES_PER_SECOND],
        "relation_known": [collision.spawn_relation in ("same", "opposite")],
        "relation_opposite": [collision.spawn_relation == "opposite"],
        "contact_known": [collision.contact_side in ("front", "front_side", "rear", "rear_side")],
        "unknown_partner": [0 in collision.ids],
        **_contact_facts(data, collision.ids),
    }
    if ids:
        agents_by_id = dict(zip(ids, VEHICLE_AGENTS, strict=False))
        pair = {agents_by_id.get(actor) for actor in collision.ids}
        values["agents_named"] = [set(collision.agents) == pair] if collision.agents else []
        values["pair_background"] = [None in pair and 0 not in collision.ids]
        values |= {name: [pair == designed_pair] for name, designed_pair in _PAIRS.items()}
    return values


def _contact_facts(data: _ScenarioData, pair: tuple[int, int]) -> dict[str, ArrayLike]:
    """Return how a pair met: before the end, at it or after it.

    Nothing is returned for a pair that labels do not show together.
    """
    rows = np.flatnonzero(np.isin(data.ids, pair))
    known = np.flatnonzero(np.isfinite(data.boxes[rows, :, 0]).all(axis=0))
    if len(rows) < 2 or len(known) < 2:
        return {}
    actor, other = data.boxes[rows][:, known]
    gaps = signed_gaps(actor, other)
    touching = np.flatnonzero(gaps <= 0)
    last_second = _FRAMES_PER_SECOND * (np.ceil((data.frames - 1) / _FRAMES_PER_SECOND) - 1)
    contact = int(touching[0]) if len(touching) else len(known) - 1
    before = max(contact - 1, 0)
    turn = actor[before, 4] - other[before, 4]
    velocity = data.velocity[rows, known[before]]
    return {
        "overlap_frames": [len(touching)],
        "overlap_depth": [-gaps.min()] if len(touching) else [],
        "touch_at_end": [gaps[-1] <= 0],
        "gap_closes": [gaps_of_pairs(actor[-1], other[-1]) <= max(gaps[-2] - gaps[-1], 0) + 0.3],
        "touch_in_second": [(known[touching[:1]] > last_second).any()],
        "heading": [np.degrees(abs(np.arctan2(np.sin(turn), np.cos(turn))))],
        "relative_speed": [np.hypot(*(velocity[0] - velocity[1]))],
    }


def _agent_facts(data: _ScenarioData) -> dict[str, ArrayLike]:
    """Return how recording vehicles drive, how high the pole is, and how steady sensors are."""
    poses = data.column("ego_pose", "matrix").reshape(-1, 4, 4)
    car_poses = poses[data.drives]
    pole_poses = poses[~data.drives][: len(car_poses)]
    speed = np.hypot(*data.column("sample", "velocity")[data.drives].T)
    known_speed = speed[np.isfinite(speed)]
    ground_heights = []
    for pole in pole_poses[:1]:
        nearest_car = np.hypot(*(car_poses - pole)[:, :2, 3].T).argmin()
        ground_heights.append(car_poses[nearest_car, 2, 3])
    setups = data.dataset.columns("calibrated_sensor")
    setup_rows = data.column("sample_data", "calibrated_sensor_row")
    mounted = setups["matrix"][setup_rows][:, 3:12:4]
    offsets = data.column("sample_data", "matrix")[:, 3::4] - mounted
    is_start = data.column("sample", "timestamp")[data.drives] == 0
    return {
        "pitch": np.degrees(np.arcsin(np.abs(car_poses[:, 2, 0]).clip(max=1))),
        "start_speed": speed[is_start],
        "speed": speed,
        "slow": [(known_speed < _MOVING_SPEED).mean()] if len(known_speed) else [],
        "fast": [(known_speed > 15).mean()] if len(known_speed) else [],
        "pole_height": pole_poses[:1, 2, 3] - ground_heights,
        "sensors_stay": setups["number"][np.unique(setup_rows)] == 1,
        "jitter": [np.abs(offsets).max(initial=0) * 1000],
    }


def _label_facts(data: _ScenarioData) -> dict[str, ArrayLike]:
    """Return facts of ids, of own rows, and of the vehicles in ego's labels.

    For vehicles these are their number, their overlaps, and their least gaps in the next two
    seconds. Untracked ones are left out; ego itself counts in overlaps and gaps.
    """
    ids = data.column("annotation", "actor_id")
    sample = data.column("annotation", "sample_row") - data.samples.start
    is_vehicle = (ids > 0) & (data.column("annotation", "category") != _PEDESTRIAN)
    own_rows = np.bincount(sample[ids == OWN_ACTOR_ID], minlength=len(data.drives))
    vehicles = np.bincount(sample[is_vehicle], minlength=len(data.drives))
    boxes = np.where(data.by_ego[..., None], data.boxes, np.nan)[data.vehicle]
    pairs = np.stack(np.triu_indices(len(boxes), 1))
    gaps = gaps_of_pairs(*boxes[pairs])
    moves = (np.hypot(*data.velocity[data.vehicle].T) > _MOVING_SPEED).T[pairs]
    counted = np.isfinite(gaps) & moves.any(axis=0)
    movers = moves.sum(axis=0)[gaps == 0]
    least_gaps = []
    for frame in range(0, data.frames - 1, _FRAMES_PER_SECOND):
        ahead = slice(frame + 1, frame + 2 * _FRAMES_PER_SECOND + 1)
        candidates = gaps[counted[:, frame], ahead]
        least_gaps.append(np.fmin.reduce(candidates, axis=None, initial=np.inf))
    finite_gaps = np.array(least_gaps)[np.isfinite(least_gaps)]
    return {
        "ids_known": np.isin(ids, (OWN_ACTOR_ID, UNTRACKED_ID)) | (ids > 0),
        "own_row": (own_rows == data.drives)[data.labelled],
        "vehicles": vehicles[data.labelled & (data.column("sample", "agent") == 0)],
        "overlap_samples": (gaps == 0).any(axis=0)[data.by_ego.any(axis=0)],
        "overlap_stand": movers == 0,
        "overlap_mixed": movers == 1,
        "overlap_move": movers == 2,
        "next_touch": finite_gaps < 0.01,
        "next_near": finite_gaps < 2.5,
        "next_gap": finite_gaps,
    }


def _foreseen_gaps(data: _ScenarioData, *, collided: bool) -> dict[str, ArrayLike]:
    """Return the least gap in each second ahead at constant velocity, and whether the impact came.

    `foreseen_…` counts pairs with a moving actor, `foreseen_all_…` all pairs. A decision falls on
    each full second, from the first frame to the impact; a second ahead counts if it is recorded,
    or the impact lies in it.
    """
    gaps_by_fact: dict[str, list[tuple[float, bool]]] = {}
    end = data.frames - 1
    times = np.arange(1, _FRAMES_PER_SECOND * _HORIZONS_S[-1] + 1) / _FRAMES_PER_SECOND
    for now in range(_FRAMES_PER_SECOND, end, _FRAMES_PER_SECOND):
        boxes = data.boxes[:, now, None]
        velocity = data.recent[:, now, None]
        pairs = np.stack(np.triu_indices(len(boxes), 1))
        speeds = np.linalg.norm(velocity[pairs, 0], axis=-1)
        has_mover = (speeds > _MOVING_SPEED).any(axis=0)
        ahead = boxes + np.pad(velocity * times[:, None], ((0, 0), (0, 0), (0, 3)))
        standing_gap = _least_gaps(boxes, *pairs[:, ~has_mover]).min()
        moving_gaps = _least_gaps(ahead, *pairs[:, has_mover]).reshape(-1, _FRAMES_PER_SECOND)
        for second, gap in zip(_HORIZONS_S, moving_gaps.min(axis=1).tolist(), strict=True):
            start = now + _FRAMES_PER_SECOND * (second - 1)
            stop = now + _FRAMES_PER_SECOND * second
            hit = collided and start < end <= stop
            if hit or stop <= end:
                least_gap = min(gap, standing_gap)
                gaps_by_fact.setdefault(f"foreseen_{second}", []).append((gap, hit))
                gaps_by_fact.setdefault(f"foreseen_all_{second}", []).append((least_gap, hit))
    return dict(gaps_by_fact)


def _least_gaps(boxes: FloatArray, actors: IntArray, others: IntArray) -> FloatArray:
    """Return the least gap of pairs of actors at each time, shape (T,), inf without a pair.

    Outlines are (A, T, 5); NaN is left out.
    """
    distances = np.hypot(*np.moveaxis(boxes[actors] - boxes[others], -1, 0)[:2])
    size = boxes[..., 2:4]
    outer_radii = np.hypot(size[..., 0], size[..., 1]) / 2
    inner_radii = size.min(axis=-1) / 2
    upper_bounds = np.maximum(distances - inner_radii[actors] - inner_radii[others], 0)
    least_bounds = np.fmin.reduce(upper_bounds, axis=0, initial=np.inf)
    lower_bounds = distances - outer_radii[actors] - outer_radii[others]
    pair, time = np.nonzero(lower_bounds <= least_bounds)
    least_gaps = np.full(boxes.shape[1], np.inf)
    gaps = gaps_of_pairs(boxes[actors[pair], time], boxes[others[pair], time])
    np.minimum.at(least_gaps, time, gaps)
    return least_gaps


def _extrapolation_errors(data: _ScenarioData) -> dict[str, ArrayLike]:
    """Return errors of constant velocity, metres, every half second, at horizons of 1 to 5 s.

    An actor counts as long as it is annotated.
    """
    now = np.arange(_VELOCITY_FRAMES, data.frames, _VELOCITY_FRAMES)
    horizons = np.array(_HORIZONS_S)
    centers = np.pad(
        data.boxes[..., :2],
        ((0, 0), (0, _FRAMES_PER_SECOND * _HORIZONS_S[-1]), (0, 0)),
        constant_values=np.nan,
    )
    expected = centers[:, now, None] + data.recent[:, now, None] * horizons[:, None]
    actual = centers[:, now[:, None] + _FRAMES_PER_SECOND * horizons]
    errors = np.linalg.norm(actual - expected, axis=-1).reshape(-1, len(_HORIZONS_S))
    errors = errors[np.isfinite(errors).any(axis=1)]
    last_horizon = len(_HORIZONS_S) - 1 - np.isfinite(errors)[:, ::-1].argmax(axis=1)
    return {
        "ade": np.nanmean(errors, axis=1),
        "fde": errors[np.arange(len(errors)), last_horizon],
    }
