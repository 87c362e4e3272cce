"""The records of every table: each field's type, storage and meaning, written once.

`schema/` is generated from here. Frames are right-handed: x forward, y left, z up; metres, radians,
seconds.
"""

from collections.abc import Mapping
from functools import cache
from types import UnionType
from typing import Annotated, Any, TypedDict, Union, get_args, get_origin, get_type_hints

from deepaccident_devkit.errors import TableError
from deepaccident_devkit.support.nuscenes_names import table_remedy
from deepaccident_devkit.support.text import meant_text, spelled
from deepaccident_devkit.tables.columns import (
    Choice,
    Column,
    ColumnKind,
    Derived,
    Items,
    Key,
    Number,
    Struct,
    Subset,
    TableSpec,
    Vector,
    Word,
)
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CATEGORIES,
    CHANNELS,
    FILE_FORMATS,
    MODALITIES,
    SPLITS,
    TIMES_OF_DAY,
    VELOCITY_FRAMES,
)

SCHEMA_VERSION = 4
"""Counts up whenever the stored columns, their meaning or the form of the index change."""


class CollisionRecord(TypedDict):
    """The collision that ended a scenario, as meta names it."""

    ids: Annotated[list[int], Items(type="integer", doc="Actor ids of the pair.")]
    classes: Annotated[list[str], Items(type="string", doc="Category names of the pair.")]
    impact: Annotated[float, Number(dtype="float64", doc="The simulator's impulse of the contact.")]
    spawn_relation: Annotated[
        str, Word(doc="Meta's word for where the pair was spawned, such as `same`.")
    ]
    contact_side: Annotated[
        str, Word(doc="Meta's word for where the contact was, such as `front_side`.")
    ]
    agents: Annotated[
        list[str | None] | None,
        Items(
            type="string",
            nullable=True,
            doc="Which agents the pair are; null for a road user that records nothing, null where "
            "meta is silent.",
        ),
    ]


class ScenarioRecord(TypedDict):
    """One recording of 36 to 100 frames at an intersection, seen by up to five agents."""

    token: Annotated[
        str, Derived(doc="`<scenario_type>/<name>`; a name alone occurs under several types.")
    ]
    name: Annotated[str, Word(doc="Folder name, `<Town>_type001_subtype000<k>_scenario000<nn>`.")]
    scenario_type: Annotated[str, Word(doc="Such as `type1_subtype1_accident`.")]
    folder: Annotated[
        str, Word(doc="Folder of layout B below the dataroot (`train`, …), empty in layout A.")
    ]
    signalized: Annotated[
        bool, Number(dtype="bool", doc="Whether the intersection has traffic lights (subtype1).")
    ]
    designed_accident: Annotated[
        bool,
        Number(
            dtype="bool",
            doc="Whether the scenario was set up to end in an accident (an `_accident` folder); "
            "what happened is in `collision`.",
        ),
    ]
    town: Annotated[str, Word(doc="CARLA town, first part of the name.")]
    weather: Annotated[str | None, Word(doc="Clear, Cloudy, HardRain, …; null without meta.")]
    time_of_day: Annotated[str | None, Choice(values=TIMES_OF_DAY, doc="Null without meta.")]
    road_type: Annotated[
        str | None, Word(doc="`four-way junction` or `three-way junction`; null where unsaid.")
    ]
    spawn_side: Annotated[
        str | None, Word(doc="Where the other vehicle comes from: left, right, opposite….")
    ]
    ego_direction: Annotated[str | None, Word(doc="straight, left or right.")]
    other_direction: Annotated[str | None, Word(doc="straight, left or right.")]
    collision: Annotated[
        CollisionRecord | None,
        Struct(record=CollisionRecord, doc="Null if meta names no collision, or is missing."),
    ]
    accident_type: Annotated[
        int | None,
        Number(
            dtype="int8",
            doc="The paper's design 1 to 12 that the accident realises; null for any other end.",
        ),
    ]
    velocity_frame: Annotated[
        str | None,
        Choice(
            values=tuple(VELOCITY_FRAMES),
            doc="What the labels' velocities turned out to be in, by the displacements of moving "
            "boxes (see docs/conventions.md); null where too few boxes move or nothing fits. They "
            "are decoded by it; by `released` where it is null.",
        ),
    ]
    num_frames: Annotated[
        int, Number(dtype="int32", doc="Recorded frames, numbered from 1, at 10 Hz.")
    ]
    first_frame_token: Annotated[str, Key(table="frame", doc="The first moment.")]
    last_frame_token: Annotated[
        str, Key(table="frame", doc="The last moment: of an accident, the impact.")
    ]
    split: Annotated[
        str | None,
        Choice(
            values=SPLITS,
            doc="From the split files, else the folder of layout B, else null (unknown).",
        ),
    ]


class AgentRecord(TypedDict):
    """One of the up to five recorders of a scenario."""

    token: Annotated[str, Derived(doc="`<scenario>/<agent>`.")]
    scenario_token: Annotated[str, Key(table="scenario", doc="Its scenario.")]
    name: Annotated[str, Choice(values=AGENTS, doc="The release's folder name.")]
    actor_id: Annotated[
        int | None, Number(dtype="int64", doc="CARLA id by meta; null for infrastructure.")
    ]
    category: Annotated[
        str | None, Choice(values=CATEGORIES, doc="Of its own label row; null without one.")
    ]
    size: Annotated[
        list[float] | None,
        Vector(shape=(3,), doc="Length, width, height of its own label row.", unit="m"),
    ]
    is_infrastructure: Annotated[bool, Number(dtype="bool", doc="Whether it is the roadside pole.")]
    first_sample_token: Annotated[
        str, Key(table="sample", doc="Its first sample; the rest follow.")
    ]


class FrameRecord(TypedDict):
    """One moment of a scenario, shared by its agents."""

    token: Annotated[str, Derived(doc="`<scenario>/<NNN>`.")]
    scenario_token: Annotated[str, Key(table="scenario", doc="Its scenario.")]
    index: Annotated[int, Number(dtype="int32", doc="The frame's number NNN, from 1.")]
    timestamp: Annotated[
        float, Number(dtype="float64", doc="Since the first frame: (NNN − 1) · 0.1.", unit="s")
    ]
    time_to_impact: Annotated[
        float | None,
        Number(
            dtype="float64",
            doc="Until the recorded impact (the paper's TTC); null without one.",
            unit="s",
        ),
    ]
    prev: Annotated[str | None, Key(table="frame", doc="The moment before.")]
    next: Annotated[str | None, Key(table="frame", doc="The moment after.")]


class SampleRecord(TypedDict):
    """One agent at one moment."""

    token: Annotated[str, Derived(doc="`<scenario>/<agent>/<NNN>`.")]
    frame_token: Annotated[str, Key(table="frame", doc="Its moment.")]
    scenario_token: Annotated[str, Key(table="scenario", doc="Its scenario.")]
    agent_token: Annotated[str, Key(table="agent", doc="Its agent.")]
    agent: Annotated[str, Choice(values=AGENTS, doc="The agent's name.")]
    timestamp: Annotated[float, Number(dtype="float64", doc="Since the first frame.", unit="s")]
    velocity: Annotated[
        list[float] | None,
        Vector(
            shape=(2,),
            doc="The agent's, in world: the label's first line as (vx, −vy).",
            unit="m/s",
        ),
    ]
    time_to_end: Annotated[
        float, Number(dtype="float64", doc="Until the scenario's last frame.", unit="s")
    ]
    time_to_impact: Annotated[
        float | None,
        Number(dtype="float64", doc="Until the recorded impact; null without one.", unit="s"),
    ]
    labelled: Annotated[bool, Number(dtype="bool", doc="Whether there is a label file.")]
    num_annotations: Annotated[
        int, Number(dtype="int32", doc="Boxes annotated by this agent at this moment.")
    ]
    first_annotation_token: Annotated[
        str | None,
        Key(table="annotation", doc="Its first box; the others are the rows that follow."),
    ]
    prev: Annotated[str | None, Key(table="sample", doc="The same agent's moment before.")]
    next: Annotated[str | None, Key(table="sample", doc="The same agent's moment after.")]


class SampleDataRecord(TypedDict):
    """One sensor file of a sample; the row is there whether the file was downloaded or not."""

    token: Annotated[str, Derived(doc="`<sample>/<channel>`.")]
    sample_token: Annotated[str, Key(table="sample", doc="Its sample.")]
    sensor_token: Annotated[str, Key(table="sensor", doc="Its sensor.")]
    calibrated_sensor_token: Annotated[
        str,
        Key(
            table="calibrated_sensor", doc="Where the sensor sits on the agent, and its intrinsics."
        ),
    ]
    ego_pose_token: Annotated[str, Key(table="ego_pose", doc="Where the agent was.")]
    channel: Annotated[str, Choice(values=CHANNELS, doc="The release's folder name.")]
    modality: Annotated[str, Choice(values=MODALITIES, doc="Of the sensor.")]
    filename: Annotated[str, Derived(doc="Path below the dataroot, with forward slashes.")]
    fileformat: Annotated[str, Choice(values=FILE_FORMATS, doc="Ending of the file.")]
    width: Annotated[
        int | None,
        Number(dtype="int32", doc="Image width by calib (2·cx); null for lidar.", unit="px"),
    ]
    height: Annotated[
        int | None,
        Number(dtype="int32", doc="Image height by calib (2·cy); null for lidar.", unit="px"),
    ]
    matrix: Annotated[
        list[list[float]],
        Vector(
            shape=(3, 4),
            doc="Upper three rows of `ego_from_sensor` as this sample's calib file gives it; "
            "`calibrated_sensor` holds the same apart from rounding.",
        ),
    ]
    prev: Annotated[str | None, Key(table="sample_data", doc="The same sensor's file before.")]
    next: Annotated[str | None, Key(table="sample_data", doc="The same sensor's file after.")]


class SensorRecord(TypedDict):
    """One kind of sensor that every agent has."""

    token: Annotated[str, Derived(doc="The channel.")]
    channel: Annotated[str, Choice(values=CHANNELS, doc="The release's folder name.")]
    modality: Annotated[str, Choice(values=MODALITIES, doc="camera, lidar or bev.")]


class CalibratedSensorRecord(TypedDict):
    """A sensor on an agent: `ego_from_sensor`; one row, and a further one where it moved on its agent.

    The release computes its matrices in single precision at every frame, so that they jitter: what
    differs by at most 1 mm in the translation and 1e-5 in the rotation is one row, with the numbers
    of its first frame.
    """  # noqa: E501 - the schema has this text

    token: Annotated[
        str, Derived(doc="`<scenario>/<agent>/<channel>`, then `/2`, `/3`, … for further values.")
    ]
    sensor_token: Annotated[str, Key(table="sensor", doc="Its sensor.")]
    agent_token: Annotated[str, Key(table="agent", doc="Its agent.")]
    number: Annotated[int, Number(dtype="int32", doc="Counts the rows of this sensor from 1.")]
    translation: Annotated[
        list[float],
        Vector(
            shape=(3,),
            doc="Of the sensor in the agent's ego frame; 0 for the BEV camera.",
            unit="m",
        ),
    ]
    rotation: Annotated[
        list[float],
        Vector(
            shape=(4,),
            doc="Quaternion w, x, y, z; cameras with optical axes (x right, y down, z forward).",
        ),
    ]
    camera_intrinsic: Annotated[
        list[list[float]] | None, Vector(shape=(3, 3), doc="K of a camera, else null.", unit="px")
    ]
    matrix: Annotated[
        list[list[float]],
        Vector(shape=(4, 4), doc="`ego_from_sensor` as the first of its calib files gives it."),
    ]


class EgoPoseRecord(TypedDict):
    """Where an agent was at a moment: `world_from_ego`; one row a sample."""

    token: Annotated[str, Derived(doc="The sample's token.")]
    translation: Annotated[
        list[float], Vector(shape=(3,), doc="Of the ego frame's origin in world.", unit="m")
    ]
    rotation: Annotated[list[float], Vector(shape=(4,), doc="Quaternion w, x, y, z.")]
    timestamp: Annotated[float, Number(dtype="float64", doc="Since the first frame.", unit="s")]
    matrix: Annotated[
        list[list[float]],
        Vector(
            shape=(4, 4),
            doc="`world_from_ego` as the calib file gives it, right-handed, bit for bit.",
        ),
    ]


class InstanceRecord(TypedDict):
    """One actor of a scenario, over all frames and agents."""

    token: Annotated[str, Derived(doc="`<scenario>/actor/<actor_id>`.")]
    scenario_token: Annotated[str, Key(table="scenario", doc="Its scenario.")]
    actor_id: Annotated[int, Number(dtype="int64", doc="CARLA id; from 20000 on parked.")]
    category: Annotated[str, Choice(values=CATEGORIES, doc="By its first annotation.")]
    num_annotations: Annotated[int, Number(dtype="int32", doc="Over all frames and agents.")]
    first_annotation_token: Annotated[
        str, Key(table="annotation", doc="First by frame, then agent.")
    ]
    last_annotation_token: Annotated[str, Key(table="annotation", doc="Last by frame, then agent.")]


class AnnotationRecord(TypedDict):
    """One box: an actor as one agent annotated it at one moment, in that sample's LiDAR frame."""

    token: Annotated[
        str, Derived(doc="`<sample>/<row>`, row counted from 0 among the boxes of the label.")
    ]
    sample_token: Annotated[str, Key(table="sample", doc="Its sample.")]
    instance_token: Annotated[
        str | None,
        Key(
            table="instance",
            doc="Its actor; the agent's own row (−100) belongs to the agent's actor; null for "
            "untracked rows (−1).",
        ),
    ]
    category: Annotated[str, Choice(values=CATEGORIES, doc="The label's class.")]
    translation: Annotated[
        list[float], Vector(shape=(3,), doc="Box centre, LiDAR frame.", unit="m")
    ]
    size: Annotated[list[float], Vector(shape=(3,), doc="Full length, width, height.", unit="m")]
    rotation: Annotated[list[float], Vector(shape=(4,), doc="Quaternion w, x, y, z, LiDAR frame.")]
    velocity: Annotated[
        list[float],
        Vector(
            shape=(3,),
            doc="Over the ground, in the LiDAR frame's axes: the label's own, decoded. Where that "
            "is no number: differences of this agent's world positions of the actor at 10 Hz, NaN "
            "without a neighbour frame or id.",
            unit="m/s",
        ),
    ]
    yaw: Annotated[
        float, Number(dtype="float64", doc="About z, counter-clockwise, LiDAR frame.", unit="rad")
    ]
    actor_id: Annotated[
        int,
        Number(
            dtype="int64",
            doc="As in the file: −100 the agent itself, −1 untracked, ≥ 20000 parked.",
        ),
    ]
    num_lidar_pts: Annotated[
        int, Number(dtype="int64", doc="Points of this agent's LiDAR in the box.")
    ]
    camera_visible: Annotated[
        bool, Number(dtype="bool", doc="Whether any of this agent's cameras sees it.")
    ]
    velocity_label: Annotated[
        list[float],
        Vector(
            shape=(2,),
            doc="The label's own numbers as (vx, −vy): the world's velocity, turned once more by "
            "the box's yaw; NaN where the label has no number.",
            unit="m/s",
        ),
    ]
    is_collider: Annotated[
        bool, Number(dtype="bool", doc="Whether meta names this actor as one of the pair.")
    ]
    time_to_impact: Annotated[
        float | None,
        Number(dtype="float64", doc="Until the recorded impact; null without one.", unit="s"),
    ]
    prev: Annotated[
        str | None, Key(table="annotation", doc="The same agent's box of this actor before.")
    ]
    next: Annotated[
        str | None, Key(table="annotation", doc="The same agent's box of this actor after.")
    ]


class TrackRecord(TypedDict):
    """One actor at one moment in the world, merged from all agents' labels.

    Pose, size, velocity and category are those of one annotation: the first agent's, in the order
    of the agent table, that saw the actor from outside; its own row (up to 0.3 m off) counts only
    where nobody else saw it.
    """

    token: Annotated[str, Derived(doc="`<frame>/actor/<actor_id>`.")]
    frame_token: Annotated[str, Key(table="frame", doc="Its moment.")]
    instance_token: Annotated[str, Key(table="instance", doc="Its actor.")]
    scenario_token: Annotated[str, Key(table="scenario", doc="Its scenario.")]
    translation: Annotated[list[float], Vector(shape=(3,), doc="Box centre, world.", unit="m")]
    rotation: Annotated[list[float], Vector(shape=(4,), doc="Quaternion w, x, y, z, world.")]
    size: Annotated[list[float], Vector(shape=(3,), doc="Full length, width, height.", unit="m")]
    velocity: Annotated[
        list[float], Vector(shape=(3,), doc="World; NaN where unknown.", unit="m/s")
    ]
    category: Annotated[str, Choice(values=CATEGORIES, doc="The label's class.")]
    is_collider: Annotated[
        bool, Number(dtype="bool", doc="Whether meta names this actor as one of the pair.")
    ]
    agents: Annotated[list[str], Subset(values=AGENTS, doc="The agents that annotated it.")]


class CategoryRecord(TypedDict):
    """One class of road user."""

    token: Annotated[str, Derived(doc="The name.")]
    name: Annotated[str, Choice(values=CATEGORIES, doc="The label's word.")]
    index: Annotated[int, Number(dtype="int8", doc="Class index of the released evaluation.")]


RECORDS: dict[str, type] = {
    "scenario": ScenarioRecord,
    "agent": AgentRecord,
    "frame": FrameRecord,
    "sample": SampleRecord,
    "sample_data": SampleDataRecord,
    "sensor": SensorRecord,
    "calibrated_sensor": CalibratedSensorRecord,
    "ego_pose": EgoPoseRecord,
    "instance": InstanceRecord,
    "annotation": AnnotationRecord,
    "track": TrackRecord,
    "category": CategoryRecord,
}
"""Table name → the type of its records."""


@cache
def table_specs() -> Mapping[str, TableSpec]:
    """Return all tables, in the order in which they build on each other."""
    return {name: spec_of(name, record) for name, record in RECORDS.items()}


def table_spec(name: str) -> TableSpec:
    """Return a table's specification; raises TableError."""
    specs = table_specs()
    known = spelled(name, specs)
    if known not in specs:
        remedy = table_remedy(name) or meant_text(name, specs)
        raise TableError(f"no table {name!r}; there are {', '.join(specs)}{remedy}")
    return specs[known]


def record_columns(record: type) -> tuple[Column, ...]:
    """Return the columns that a TypedDict of annotated fields declares."""
    hints = get_type_hints(record, include_extras=True)
    return tuple(_column(field, hint) for field, hint in hints.items())


def spec_of(name: str, record: type) -> TableSpec:
    """Return the specification of a table with records of a TypedDict of annotated fields."""
    doc = " ".join((record.__doc__ or "").split())
    return TableSpec(name=name, doc=doc, columns=record_columns(record))


def _column(field: str, hint: Any) -> Column:
    plain, kind = get_args(hint)
    nullable = get_origin(plain) in (Union, UnionType) and type(None) in get_args(plain)
    return Column(field, _stored_name(field, kind), kind, nullable)


def _stored_name(field: str, kind: ColumnKind) -> str | None:
    if isinstance(kind, Derived):
        return None
    if isinstance(kind, Key):
        return f"{field.removesuffix('_token')}_row"
    return field
