"""Values of each fact in one scenario's labels, meta and calib; `release_facts` defines them.

In each scenario, a fact has an array with one value per case; for shares, the values are booleans.
`release_facts` combines the scenarios.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

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

# Speed below which an actor counts as standing.
_MOVING_SPEED_MPS = 0.5
# Speed above which an actor counts as fast.
_FAST_SPEED_MPS = 15
# Horizons for foreseeing a collision, and for predicting positions.
_HORIZONS_S = (1, 2, 3, 4, 5)
_FRAMES_PER_SECOND = 10
# Number of frames in half a second, over which velocities are measured.
_VELOCITY_FRAMES = 5
_PEDESTRIAN = CATEGORIES.index("pedestrian")
# Field of meta → its known words.
_META_WORDS = {
    "weather": WEATHERS,
    "road_type": ROAD_TYPES,
    "spawn_side": SPAWN_SIDES,
    "ego_direction": DIRECTIONS,
    "other_direction": DIRECTIONS,
}
# A fact's key → the values of its cases.
_FactValues = dict[str, ArrayLike]
# Fact → the pair for which its scenario is designed.
_PAIRS: Mapping[str, set[str | None]] = {
    "pair_designed": {*VEHICLE_AGENTS[::2]},
    "pair_behind": {*VEHICLE_AGENTS[1::2]},
    "pair_follower": {*VEHICLE_AGENTS[1:3]},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFacts:
    """The values of each fact in one scenario.

    Attributes:
        values: Key of a fact → values (N,), or (N, 2): value, and whether the collision came. Facts
            without a value in the scenario are left out.
        counts: What is counted, such as `weather` → word → number.
    """

    values: Mapping[str, FloatArray]
    counts: Mapping[str, Mapping[str, int]]


def counted_scenario_facts(dataset: Dataset, record: ScenarioRecord) -> ScenarioFacts:
    """Compute the facts of one scenario; raise MetaError if its meta file is now unreadable."""
    folder = ScenarioFolder(
        dataset.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS
    )
    data = _ScenarioData(dataset, record)
    velocity_frame = record["velocity_frame"]
    collision = record["collision"]
    labelled_agents = np.unique(data.column("sample", "agent")[data.labelled])
    num_labelled = len(labelled_agents)
    values: _FactValues = {
        "twins": [twin_of(dataset, record) is not None],
        "lights": [record["signalized"]],
        "agents": [num_labelled == len(AGENTS)],
        **_agent_facts(data),
        **_label_facts(data),
        **_extrapolation_errors(data),
    }
    if velocity_frame:
        values["velocities_released"] = [velocity_frame == RELEASED_VELOCITY_FRAME]
    if record["weather"]:
        values |= _meta_facts(data, record, read_meta(folder.meta_path))
    words: dict[str, object] = {"agents with labels": str(num_labelled)}
    words["velocity frame"] = velocity_frame
    words |= {name: dict(record)[name] for name in _META_WORDS}
    if collision:
        words |= {"token 7": collision["spawn_relation"], "token 8": collision["contact_side"]}
    counts: dict[str, Mapping[str, int]] = {}
    for name, word in words.items():
        text = shortened(str(word or "unknown"))
        counts[name] = {text: 1}
    ids = data.column("annotation", "actor_id")
    id_kinds = np.where(ids > 0, "from 1 on", ids.astype(str))
    counts["label ids"] = Counter(id_kinds.tolist())
    return ScenarioFacts(values=_finite_arrays(values), counts=counts)


def _finite_arrays(values: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
    """Keep the finite rows of each fact's values; facts without any are left out."""
    arrays = {}
    for key, cases in values.items():
        if np.size(cases):
            array = as_floats(cases)
            is_finite = np.isfinite(array.reshape(len(array), -1)).all(axis=1)
            if is_finite.any():
                arrays[key] = array[is_finite]
    return arrays


class _ScenarioData:
    """One scenario as arrays over its A actors, F frames (world frame) and S samples.

    Attributes:
        dataset: The release.
        frames: Number of frames, F.
        ids: Actor ids, shape (A,), ascending.
        boxes: Outlines, shape (A, F, 5), metres and radians; NaN where no agent labelled it.
        velocity: Velocities from the labels in m/s, shape (A, F, 2).
        recent: Mean velocities over the last half second in m/s, shape (A, F, 2); the label's
            velocity if no agent saw the actor before.
        by_ego: Whether the ego's label contains the actor, or the actor is the ego, shape (A, F).
        vehicle: Whether the actor is not a pedestrian, shape (A,).
        drives: Whether the sample belongs to a vehicle, shape (S,).
        labelled: Whether the sample has a label, shape (S,).
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
        frames_before = ((0, 0), (_VELOCITY_FRAMES, 0), (0, 0))
        padded_centers = np.pad(centers, frames_before, constant_values=np.nan)
        earlier_centers = padded_centers[:, :-_VELOCITY_FRAMES]
        displacements = centers - earlier_centers
        measured = displacements * (_FRAMES_PER_SECOND / _VELOCITY_FRAMES)
        self.recent = np.where(np.isnan(measured), self.velocity, measured)
        self.vehicle: BoolArray = boxes.category[first_row] != _PEDESTRIAN
        scenario_rows = dataset.columns("sample")["scenario_row"]
        bounds = np.array([row, row + 1], dtype=scenario_rows.dtype)
        self.samples = slice(*scenario_rows.searchsorted(bounds).tolist())
        self.drives: BoolArray = self.column("sample", "agent") != AGENTS.index(INFRASTRUCTURE)
        self.labelled: BoolArray = self.column("sample", "labelled")

    def column(self, table: str, name: str) -> AnyArray:
        """Return the scenario's part of a column of samples, poses, label rows or sensor files."""
        columns = self.dataset.columns(table)
        rows = self.samples
        sample_rows = columns.get("sample_row")
        if sample_rows is not None:
            # With bounds of another dtype, numpy would copy all rows.
            bounds = np.array([rows.start, rows.stop], dtype=sample_rows.dtype)
            rows = slice(*sample_rows.searchsorted(bounds).tolist())
        return np.asarray(columns[name][rows])


def _meta_facts(data: _ScenarioData, record: ScenarioRecord, meta: Meta) -> _FactValues:
    """Compute facts about meta and the folder's name, and the gaps that foresee the collision."""
    is_accident = record["designed_accident"]
    frames = record["num_frames"]
    collision = meta.collision
    ids = meta.agent_ids
    collides = collision is not None
    is_known = []
    for name, known_words in _META_WORDS.items():
        word = getattr(meta, name)
        is_known.append(not word or word in known_words)
    values: _FactValues = {
        "folder_right": [is_accident == collides],
        "length": [(frames, collides)],
        "known_words": is_known,
        **_foreseen_gaps(data, collided=collides),
    }
    if is_accident:
        values |= {"accident_without": [not collides], "accident_frames": [frames]}
    else:
        values |= {"normal_with": [collides], "normal_frames": [frames]}
    if ids:
        values["ids_ascend"] = [ids[2] < ids[0] < ids[1] < ids[3]]
    if ids and collision is None:
        values["none_none"] = [meta.planned_agents is None]
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
        if collision.agents:
            values["agents_named"] = [set(collision.agents) == pair]
        values["pair_background"] = [None in pair and 0 not in collision.ids]
        for name, designed_pair in _PAIRS.items():
            values[name] = [pair == designed_pair]
    return values


def _contact_facts(data: _ScenarioData, pair: tuple[int, int]) -> _FactValues:
    """Compute when a pair touched: before the last frame, in it, or after it.

    Return no facts about a pair that labels do not show together.
    """
    rows = np.flatnonzero(np.isin(data.ids, pair))
    is_known = np.isfinite(data.boxes[rows, :, 0]).all(axis=0)
    frames = np.flatnonzero(is_known)
    if len(rows) < 2 or len(frames) < 2:
        return {}
    actor, other = data.boxes[rows][:, frames]
    gaps = signed_gaps(actor, other)
    touching = np.flatnonzero(gaps <= 0)
    full_seconds = np.ceil((data.frames - 1) / _FRAMES_PER_SECOND)
    last_second = _FRAMES_PER_SECOND * (full_seconds - 1)
    contact = len(frames) - 1
    overlap_depth = []
    if len(touching):
        contact = int(touching[0])
        overlap_depth = [-gaps.min()]
    before = max(contact - 1, 0)
    turn = actor[before, 4] - other[before, 4]
    wrapped_turn = np.arctan2(np.sin(turn), np.cos(turn))
    velocity = data.velocity[rows, frames[before]]
    last_closing = max(gaps[-2] - gaps[-1], 0)
    return {
        "overlap_frames": [len(touching)],
        "overlap_depth": overlap_depth,
        "touch_at_end": [gaps[-1] <= 0],
        "gap_closes": [gaps_of_pairs(actor[-1], other[-1]) <= last_closing + 0.3],
        "touch_in_second": [(frames[touching[:1]] > last_second).any()],
        "heading": [np.degrees(abs(wrapped_turn))],
        "relative_speed": [np.hypot(*(velocity[0] - velocity[1]))],
    }


def _agent_facts(data: _ScenarioData) -> _FactValues:
    """Compute facts about recording vehicles, the height of the pole, and sensor steadiness."""
    poses = data.column("ego_pose", "matrix").reshape(-1, 4, 4)
    car_poses = poses[data.drives]
    pole_poses = poses[~data.drives][: len(car_poses)]
    tilt_sines = np.abs(car_poses[:, 2, 0]).clip(max=1)
    velocity = data.column("sample", "velocity")[data.drives]
    speed = np.hypot(*velocity.T)
    known_speed = speed[np.isfinite(speed)]
    slow_share = []
    fast_share = []
    if len(known_speed):
        slow_share = [(known_speed < _MOVING_SPEED_MPS).mean()]
        fast_share = [(known_speed > _FAST_SPEED_MPS).mean()]
    ground_heights = []
    for pole_pose in pole_poses[:1]:
        offsets = (car_poses - pole_pose)[:, :2, 3]
        nearest_car = np.hypot(*offsets.T).argmin()
        ground_heights.append(car_poses[nearest_car, 2, 3])
    setups = data.dataset.columns("calibrated_sensor")
    setup_rows = data.column("sample_data", "calibrated_sensor_row")
    mounted = setups["matrix"][setup_rows][:, 3:12:4]
    shifts = data.column("sample_data", "matrix")[:, 3::4] - mounted
    is_start = data.column("sample", "timestamp")[data.drives] == 0
    return {
        "pitch": np.degrees(np.arcsin(tilt_sines)),
        "start_speed": speed[is_start],
        "speed": speed,
        "slow": slow_share,
        "fast": fast_share,
        "pole_height": pole_poses[:1, 2, 3] - ground_heights,
        "sensors_stay": setups["number"][np.unique(setup_rows)] == 1,
        "jitter": [np.abs(shifts).max(initial=0) * 1000],
    }


def _label_facts(data: _ScenarioData) -> _FactValues:
    """Compute facts about ids, the agents' own rows, and the vehicles in the ego's labels.

    For vehicles, these are their number, their overlaps, and their smallest gaps in the next two
    seconds. Untracked vehicles are left out; overlaps and gaps include the ego.
    """
    ids = data.column("annotation", "actor_id")
    sample = data.column("annotation", "sample_row") - data.samples.start
    is_vehicle = (ids > 0) & (data.column("annotation", "category") != _PEDESTRIAN)
    own_rows = np.bincount(sample[ids == OWN_ACTOR_ID], minlength=len(data.drives))
    vehicles = np.bincount(sample[is_vehicle], minlength=len(data.drives))
    is_ego_label = data.labelled & (data.column("sample", "agent") == 0)
    boxes = np.where(data.by_ego[..., None], data.boxes, np.nan)[data.vehicle]
    pairs = np.stack(np.triu_indices(len(boxes), 1))
    gaps = gaps_of_pairs(*boxes[pairs])
    speeds = np.hypot(*data.velocity[data.vehicle].T)
    moves = (speeds > _MOVING_SPEED_MPS).T[pairs]
    is_counted = np.isfinite(gaps) & moves.any(axis=0)
    overlaps = gaps == 0
    num_movers = moves.sum(axis=0)[overlaps]
    least_gaps = []
    for frame in range(0, data.frames - 1, _FRAMES_PER_SECOND):
        ahead = slice(frame + 1, frame + 2 * _FRAMES_PER_SECOND + 1)
        candidates = gaps[is_counted[:, frame], ahead]
        least_gaps.append(np.fmin.reduce(candidates, axis=None, initial=np.inf))
    finite_gaps = np.array(least_gaps)[np.isfinite(least_gaps)]
    return {
        "ids_known": np.isin(ids, (OWN_ACTOR_ID, UNTRACKED_ID)) | (ids > 0),
        "own_row": (own_rows == data.drives)[data.labelled],
        "vehicles": vehicles[is_ego_label],
        "overlap_samples": overlaps.any(axis=0)[data.by_ego.any(axis=0)],
        "overlap_stand": num_movers == 0,
        "overlap_mixed": num_movers == 1,
        "overlap_move": num_movers == 2,
        "next_touch": finite_gaps < 0.01,
        "next_near": finite_gaps < 2.5,
        "next_gap": finite_gaps,
    }


def _foreseen_gaps(data: _ScenarioData, *, collided: bool) -> _FactValues:
    """Compute the smallest gap in each second ahead at constant velocity, and if the impact came.

    `foreseen_…` considers pairs with a moving actor, `foreseen_all_…` all pairs. Gaps are predicted
    at each full second from the first frame to the impact. A second ahead counts if it was recorded
    or contains the impact.
    """
    gaps_by_fact: dict[str, list[tuple[float, bool]]] = {}
    end = data.frames - 1
    times = np.arange(1, _FRAMES_PER_SECOND * _HORIZONS_S[-1] + 1) / _FRAMES_PER_SECOND
    for now in range(_FRAMES_PER_SECOND, end, _FRAMES_PER_SECOND):
        boxes = data.boxes[:, now, None]
        velocity = data.recent[:, now, None]
        pairs = np.stack(np.triu_indices(len(boxes), 1))
        speeds = np.linalg.norm(velocity[pairs, 0], axis=-1)
        has_mover = (speeds > _MOVING_SPEED_MPS).any(axis=0)
        displacements = velocity * times[:, None]
        boxes_ahead = boxes + np.pad(displacements, ((0, 0), (0, 0), (0, 3)))
        standing_gap = _least_gaps(boxes, *pairs[:, ~has_mover]).min()
        moving_gaps = _least_gaps(boxes_ahead, *pairs[:, has_mover])
        gaps_by_second = moving_gaps.reshape(-1, _FRAMES_PER_SECOND).min(axis=1).tolist()
        for second, gap in zip(_HORIZONS_S, gaps_by_second, strict=True):
            stop = now + _FRAMES_PER_SECOND * second
            start = stop - _FRAMES_PER_SECOND
            is_hit = collided and start < end <= stop
            if is_hit or stop <= end:
                least_gap = min(gap, standing_gap)
                gaps_by_fact.setdefault(f"foreseen_{second}", []).append((gap, is_hit))
                gaps_by_fact.setdefault(f"foreseen_all_{second}", []).append((least_gap, is_hit))
    return dict(gaps_by_fact)


def _least_gaps(boxes: FloatArray, actors: IntArray, others: IntArray) -> FloatArray:
    """Return the smallest gap of pairs at each time in metres, shape (T,); inf without a pair.

    Args:
        boxes: Outlines, shape (A, T, 5); NaN where an actor is missing.
        actors: Indices of the first actors, shape (P,).
        others: Indices of the second actors, shape (P,).
    """
    offsets = boxes[actors] - boxes[others]
    distances = np.hypot(offsets[..., 0], offsets[..., 1])
    size = boxes[..., 2:4]
    outer_radii = np.hypot(size[..., 0], size[..., 1]) / 2
    inner_radii = size.min(axis=-1) / 2
    upper_bounds = distances - inner_radii[actors] - inner_radii[others]
    upper_bounds = np.maximum(upper_bounds, 0)
    least_bounds = np.fmin.reduce(upper_bounds, axis=0, initial=np.inf)
    lower_bounds = distances - outer_radii[actors] - outer_radii[others]
    pairs, times = np.nonzero(lower_bounds <= least_bounds)
    gaps = gaps_of_pairs(boxes[actors[pairs], times], boxes[others[pairs], times])
    least_gaps = np.full(boxes.shape[1], np.inf)
    np.minimum.at(least_gaps, times, gaps)
    return least_gaps


def _extrapolation_errors(data: _ScenarioData) -> _FactValues:
    """Return the mean and final position errors of constant-velocity predictions, in metres.

    Every half second, each actor is predicted at horizons of 1 to 5 s. Horizons at which the actor
    is not annotated are left out.
    """
    now = np.arange(_VELOCITY_FRAMES, data.frames, _VELOCITY_FRAMES)
    horizons = np.array(_HORIZONS_S)
    frames_after = ((0, 0), (0, _FRAMES_PER_SECOND * _HORIZONS_S[-1]), (0, 0))
    centers = np.pad(data.boxes[..., :2], frames_after, constant_values=np.nan)
    displacements = data.recent[:, now, None] * horizons[:, None]
    expected = centers[:, now, None] + displacements
    actual = centers[:, now[:, None] + _FRAMES_PER_SECOND * horizons]
    errors = np.linalg.norm(actual - expected, axis=-1).reshape(-1, len(_HORIZONS_S))
    errors = errors[np.isfinite(errors).any(axis=1)]
    last_horizon = len(_HORIZONS_S) - 1 - np.isfinite(errors)[:, ::-1].argmax(axis=1)
    return {
        "ade": np.nanmean(errors, axis=1),
        "fde": errors[np.arange(len(errors)), last_horizon],
    }
