"""The columns of clips: what an agent does in each frame, and how close an accident is."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from deepaccident_devkit.geometry.box_arrays import along, normals, side_yaws
from deepaccident_devkit.geometry.conventions import stored_transforms
from deepaccident_devkit.interactions.compute import actor_motion
from deepaccident_devkit.interactions.scenario import interactions
from deepaccident_devkit.interactions.table import InteractionConfig
from deepaccident_devkit.support.arrays import AnyArray, FloatArray, readonly
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.tables.record_tables import RecordTables
from deepaccident_devkit.taxonomy import AGENTS
from deepaccident_devkit.v2x.agent_motion import agent_motion
from deepaccident_devkit.v2x.tracks import scenario_tracks
from deepaccident_devkit.v2x.windows import window

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset, RowArgument
    from deepaccident_devkit.tables.records import SampleRecord, ScenarioRecord

PATH_HALF_WIDTH: Final = 2.5
"""Distance to the left and right, metres, within which an actor ahead is in an agent's path."""
# Fields of `AgentMotion` that are the state.
_STATE = ("speed", "acceleration", "lateral_acceleration", "yaw_rate")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipColumn:
    """A column of clips.

    Attributes:
        dtype: Type of the numbers, or `string`.
        doc: Meaning of the column, with its unit.
        names: Names of the numbers in a row; empty for a single value.
    """

    dtype: str
    doc: str
    names: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a row; (1,) for a single value."""
        return (max(len(self.names), 1),)


CLIP_COLUMNS: Final[Mapping[str, ClipColumn]] = {
    "observation.state": ClipColumn(
        dtype="float32",
        doc="speed in m/s, acceleration along the heading and to the left in m/s², and yaw rate in "
        "rad/s, from the agent's poses",
        names=_STATE,
    ),
    "action": ClipColumn(
        dtype="float32",
        doc="movement until the next frame in ego axes: metres forward and to the left, and turn "
        "in radians; 0 in the last frame",
        names=("forward", "left", "turn"),
    ),
    "time_to_impact": ClipColumn(
        dtype="float32", doc="seconds until the recorded impact; NaN without one"
    ),
    "collides": ClipColumn(dtype="bool", doc="whether the agent is one of the colliding pair"),
    "ttc": ClipColumn(
        dtype="float32",
        doc="shortest time to collision in seconds of the agent with anybody, as in "
        "`da.interactions`; NaN if there is none",
    ),
    "ttc_ahead": ClipColumn(
        dtype="float32",
        doc=f"seconds until the agent reaches whoever is ahead within {PATH_HALF_WIDTH} m to the "
        "left or right, at constant speeds; NaN if it reaches nobody",
    ),
    "partners_seen": ClipColumn(
        dtype="float32",
        doc="number of other agents that see a colliding actor other than this agent; NaN without "
        "a collision or labels",
    ),
    "collider_seen_by": ClipColumn(
        dtype="uint8",
        doc="these agents as bits, with bit 1 for ego_vehicle, 2 for ego_vehicle_behind, 4 for "
        "other_vehicle, 8 for other_vehicle_behind and 16 for infrastructure; includes this agent",
    ),
    "weather": ClipColumn(dtype="string", doc="weather of the scenario, or `unknown`"),
    "token": ClipColumn(dtype="string", doc="token of the sample"),
}
"""The columns of `ClipRows` by name; each row is a frame."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClipRows:
    """The F frames of an agent's recording.

    Attributes:
        columns: Read-only arrays by the names of `CLIP_COLUMNS`. Shape (F,), or (F, K) for a
            column with K names.
        episode: Facts of the whole recording: `scenario`, `agent`, `split` (None if unknown),
            `group` and `weather`. All agents of a scenario and of its twin are in one group.
    """

    columns: Mapping[str, AnyArray]
    episode: Mapping[str, str | None]

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.columns["token"])


def clip_rows(dataset: Dataset, agent: RowArgument) -> ClipRows:
    """Return the columns of an agent's clip.

    Without labels, times to collision and `partners_seen` are NaN.

    Args:
        dataset: The release.
        agent: Token or record of the agent.

    Raises:
        TokenError: The agent is unknown.
    """
    record = dataset.get("agent", agent)
    scenario = dataset.scenario.get(record["scenario_token"])
    num_frames = scenario["num_frames"]
    own_id = record["actor_id"]
    pair = scenario["collision"]["ids"] if scenario["collision"] else []
    tables = RecordTables(dataset)
    samples = tables.rows([scenario["token"]], [record["name"]])["sample"]
    sample_columns = dataset.columns("sample")
    motion = agent_motion(dataset, record)
    first_sample = dataset.sample.get(record["first_sample_token"])
    is_known = first_sample["labelled"] and bool(pair)
    seen_by = np.zeros(num_frames, dtype=np.uint8)
    if is_known:
        seen_by = _find_seeing_agents(dataset, first_sample, {*pair} - {own_id})
    partners = seen_by & ~np.uint8(1 << AGENTS.index(record["name"]))
    num_partners = np.unpackbits(partners[:, None], axis=1).sum(axis=1)
    weather = scenario["weather"] or "unknown"
    values: NamedValues = {
        "observation.state": np.column_stack([getattr(motion, name) for name in _STATE]),
        "action": _compute_steps(dataset.columns("ego_pose")["matrix"][samples]),
        "time_to_impact": sample_columns["time_to_impact"][samples],
        "collides": [own_id in pair] * num_frames,
        "ttc": _find_shortest_times(dataset, scenario, own_id),
        "ttc_ahead": _find_times_ahead(dataset, scenario, own_id),
        "partners_seen": np.where(is_known, num_partners, np.nan),
        "collider_seen_by": seen_by,
        "weather": [weather] * num_frames,
        "token": tables.tokens("sample", samples).to_pylist(),
    }
    columns = {}
    for name, column in CLIP_COLUMNS.items():
        dtype = np.str_ if column.dtype == "string" else column.dtype
        columns[name] = readonly(np.asarray(values[name], dtype))
    return ClipRows(
        columns=columns,
        episode={
            "scenario": scenario["token"],
            "agent": record["name"],
            "split": scenario["split"],
            "group": scenario["name"],
            "weather": weather,
        },
    )


def clip_cameras(
    dataset: Dataset, agent: RowArgument, channels: Sequence[str], size: tuple[int, int]
) -> dict[str, FloatArray]:
    """Return the cameras of an agent's clips, in its first frame.

    Args:
        dataset: The release.
        agent: Token or record of the agent.
        channels: The cameras.
        size: Width and height of the pictures, in pixels.

    Returns:
        `intrinsic.<channel>` → K (3, 3) in pixels of the pictures, and `ego_from_camera.<channel>`
            → transform (4, 4) from optical axes.

    Raises:
        TokenError: The agent is unknown.
        ChoiceError: A channel is not a camera.
    """
    sample = dataset.get("agent", agent)["first_sample_token"]
    matrices = {}
    for channel in channels:
        camera = dataset.camera(sample, channel).resized(*size)
        matrices[f"intrinsic.{channel}"] = camera.intrinsic
        ego_from_camera = dataset.ego_from(sample, channel)
        matrices[f"ego_from_camera.{channel}"] = ego_from_camera.matrix
    return matrices


def _compute_steps(poses: FloatArray) -> FloatArray:
    """Return forward, left and turn from each stored `world_from_ego` to the next, shape (F, 3)."""
    world_from_ego = stored_transforms(poses)
    ego_from_next = np.linalg.inv(world_from_ego[:-1]) @ world_from_ego[1:]
    turns = np.arctan2(ego_from_next[:, 1, 0], ego_from_next[:, 0, 0])
    steps = np.column_stack([ego_from_next[:, :2, 3], turns])
    return np.vstack([steps, np.zeros(3)])


def _find_shortest_times(
    dataset: Dataset, scenario: ScenarioRecord, own_id: int | None
) -> FloatArray:
    """Return an actor's shortest time to collision in each frame, shape (F,); NaN if none."""
    pairs = interactions(dataset, scenario)
    is_own = (pairs.actor_ids == own_id).any(axis=1) & np.isfinite(pairs.ttc)
    times = np.full(scenario["num_frames"], np.nan)
    np.fmin.at(times, pairs.frame[is_own] - 1, pairs.ttc[is_own])
    return times


def _find_times_ahead(dataset: Dataset, scenario: ScenarioRecord, own_id: int | None) -> FloatArray:
    """Return an actor's shortest time until it reaches another one ahead, shape (F,).

    Others count if their centre is ahead and at most `PATH_HALF_WIDTH` to the left or right. The
    gap is the distance ahead less half of both lengths; it closes at constant speeds along the
    heading. Times are NaN if no gap closes.
    """
    tracks = scenario_tracks(dataset, scenario)
    motion = actor_motion(tracks, scenario["num_frames"], InteractionConfig())
    is_own = motion.ids == own_id
    if not is_own.any():
        return np.full(scenario["num_frames"], np.nan)
    own_boxes = motion.boxes[is_own]
    ego_axes = normals(side_yaws(own_boxes))
    offsets = along(ego_axes, motion.boxes[..., :2] - own_boxes[..., :2])
    ahead, beside = np.moveaxis(offsets, -1, 0)
    gap = ahead - (motion.boxes[..., 2] + own_boxes[..., 2]) / 2
    closing_speed = along(ego_axes, motion.velocity[is_own] - motion.velocity)[..., 0]
    is_reached = (ahead > 0) & (abs(beside) <= PATH_HALF_WIDTH) & (closing_speed > 0)
    times = np.full(gap.shape, np.nan)
    np.divide(gap.clip(min=0), closing_speed, out=times, where=is_reached)
    return np.asarray(np.fmin.reduce(times, axis=0))


def _find_seeing_agents(
    dataset: Dataset, sample: SampleRecord, actor_ids: Collection[int]
) -> AnyArray:
    """Return which agents see at least one of some actors in each frame, as bits, shape (F,).

    Agents see by the released rule, without their partners; they do not see themselves.

    Args:
        dataset: The release.
        sample: A labelled sample of the first frame.
        actor_ids: The actors.
    """
    tracks = window(dataset, sample, past=0, future=sample["time_to_end"], actors="any")
    is_sought = np.isin(tracks.actor_id, list(actor_ids))
    return np.asarray(np.bitwise_or.reduce(tracks.seen_by[is_sought], axis=0))
