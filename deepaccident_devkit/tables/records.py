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
from deepaccident_devkit.support.text import match_spelling, meant_text
from deepaccident_devkit.tables.columns import (
    Choice,
    Column,
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
"""Increases whenever the stored columns, their meaning or the format of the index change."""


# Fields that several records share.
_Direction = Annotated[str | None, Word(doc="Direction: straight, left or right.")]
_ScenarioToken = Annotated[str, Key(table="scenario", doc="Its scenario.")]
_FrameToken = Annotated[str, Key(table="frame", doc="Its frame.")]
_AgentToken = Annotated[str, Key(table="agent", doc="Its agent.")]
_Timestamp = Annotated[float, Number(dtype="float64", doc="Time since the first frame.", unit="s")]
_TimeToImpact = Annotated[
    float | None,
    Number(
        dtype="float64", doc="Time until the recorded impact; null without an impact.", unit="s"
    ),
]
_SampleToken = Annotated[str, Key(table="sample", doc="Its sample.")]
_SensorToken = Annotated[str, Key(table="sensor", doc="Its sensor.")]
_Channel = Annotated[str, Choice(values=CHANNELS, doc="The release's folder name.")]
_LabelCategory = Annotated[str, Choice(values=CATEGORIES, doc="The label's class.")]
_BoxSize = Annotated[list[float], Vector(shape=(3,), doc="Full length, width, height.", unit="m")]
_IsCollider = Annotated[
    bool, Number(dtype="bool", doc="Whether meta names this actor as one of the pair.")
]


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
            doc="Agents in the pair; null for a road user that records nothing, and null if meta "
            "names no agents.",
        ),
    ]


class ScenarioRecord(TypedDict):
    """One recording of 36 to 100 frames at an intersection, seen by up to five agents."""

    token: Annotated[
        str, Derived(doc="`<scenario_type>/<name>`; a name alone occurs under several types.")
    ]
    name: Annotated[str, Word(doc="Folder name, `<Town>_type001_subtype000<k>_scenario000<nn>`.")]
    scenario_type: Annotated[str, Word(doc="Type, such as `type1_subtype1_accident`.")]
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
    time_of_day: Annotated[
        str | None, Choice(values=TIMES_OF_DAY, doc="Time of day; null without meta.")
    ]
    road_type: Annotated[
        str | None,
        Word(doc="`four-way junction` or `three-way junction`; null if meta does not say."),
    ]
    spawn_side: Annotated[
        str | None, Word(doc="Where the other vehicle comes from: left, right, opposite, ….")
    ]
    ego_direction: _Direction
    other_direction: _Direction
    collision: Annotated[
        CollisionRecord | None,
        Struct(
            record=CollisionRecord, doc="The collision; null if meta names none, or is missing."
        ),
    ]
    accident_type: Annotated[
        int | None,
        Number(
            dtype="int8",
            doc="Design of the paper (1 to 12) that the accident follows; null for any other end.",
        ),
    ]
    velocity_frame: Annotated[
        str | None,
        Choice(
            values=tuple(VELOCITY_FRAMES),
            doc="Frame of the labels' velocities, found from the displacements of moving boxes "
            "(docs/conventions.md); null if too few boxes move or no frame fits. Velocities are "
            "decoded from this frame, or from `released` if it is null.",
        ),
    ]
    num_frames: Annotated[
        int, Number(dtype="int32", doc="Recorded frames, numbered from 1, at 10 Hz.")
    ]
    first_frame_token: Annotated[str, Key(table="frame", doc="The first moment.")]
    last_frame_token: Annotated[
        str, Key(table="frame", doc="The last moment; in an accident, the impact.")
    ]
    split: Annotated[
        str | None,
        Choice(
            values=SPLITS,
            doc="Split by the split files, otherwise by the folder of layout B; null if unknown.",
        ),
    ]


class AgentRecord(TypedDict):
    """One of the up to five recorders of a scenario."""

    token: Annotated[str, Derived(doc="`<scenario>/<agent>`.")]
    scenario_token: _ScenarioToken
    name: Annotated[str, Choice(values=AGENTS, doc="The release's folder name.")]
    actor_id: Annotated[
        int | None, Number(dtype="int64", doc="CARLA id in meta; null for infrastructure.")
    ]
    category: Annotated[
        str | None,
        Choice(values=CATEGORIES, doc="Class in its own label row; null without such a row."),
    ]
    size: Annotated[
        list[float] | None,
        Vector(shape=(3,), doc="Length, width, height in its own label row.", unit="m"),
    ]
    is_infrastructure: Annotated[bool, Number(dtype="bool", doc="Whether it is the roadside pole.")]
    first_sample_token: Annotated[
        str, Key(table="sample", doc="Its first sample; the rest follow.")
    ]


class FrameRecord(TypedDict):
    """One moment of a scenario, shared by its agents."""

    token: Annotated[str, Derived(doc="`<scenario>/<NNN>`.")]
    scenario_token: _ScenarioToken
    index: Annotated[int, Number(dtype="int32", doc="The frame's number NNN, from 1.")]
    timestamp: Annotated[
        float, Number(dtype="float64", doc="Time since the first frame: (NNN − 1) · 0.1.", unit="s")
    ]
    time_to_impact: Annotated[
        float | None,
        Number(
            dtype="float64",
            doc="Time until the recorded impact (the paper's TTC); null without an impact.",
            unit="s",
        ),
    ]
    prev: Annotated[str | None, Key(table="frame", doc="The previous moment.")]
    next: Annotated[str | None, Key(table="frame", doc="The next moment.")]


class SampleRecord(TypedDict):
    """One agent at one moment."""

    token: Annotated[str, Derived(doc="`<scenario>/<agent>/<NNN>`.")]
    frame_token: _FrameToken
    scenario_token: _ScenarioToken
    agent_token: _AgentToken
    agent: Annotated[str, Choice(values=AGENTS, doc="The agent's name.")]
    timestamp: _Timestamp
    velocity: Annotated[
        list[float] | None,
        Vector(
            shape=(2,),
            doc="Velocity of the agent in world: the label's first line as (vx, −vy).",
            unit="m/s",
        ),
    ]
    time_to_end: Annotated[
        float, Number(dtype="float64", doc="Time until the scenario's last frame.", unit="s")
    ]
    time_to_impact: _TimeToImpact
    labelled: Annotated[bool, Number(dtype="bool", doc="Whether there is a label file.")]
    num_annotations: Annotated[
        int, Number(dtype="int32", doc="Boxes annotated by this agent at this moment.")
    ]
    first_annotation_token: Annotated[
        str | None,
        Key(table="annotation", doc="Its first box; the others are the rows that follow."),
    ]
    prev: Annotated[str | None, Key(table="sample", doc="The agent's previous sample.")]
    next: Annotated[str | None, Key(table="sample", doc="The agent's next sample.")]


class SampleDataRecord(TypedDict):
    """One sensor file of a sample; the row is there whether the file was downloaded or not."""

    token: Annotated[str, Derived(doc="`<sample>/<channel>`.")]
    sample_token: _SampleToken
    sensor_token: _SensorToken
    calibrated_sensor_token: Annotated[
        str,
        Key(
            table="calibrated_sensor", doc="Where the sensor sits on the agent, and its intrinsics."
        ),
    ]
    ego_pose_token: Annotated[str, Key(table="ego_pose", doc="Where the agent was.")]
    channel: _Channel
    modality: Annotated[str, Choice(values=MODALITIES, doc="Kind of the sensor.")]
    filename: Annotated[str, Derived(doc="Path below the dataroot, with forward slashes.")]
    fileformat: Annotated[str, Choice(values=FILE_FORMATS, doc="Ending of the file.")]
    width: Annotated[
        int | None,
        Number(dtype="int32", doc="Image width in calib (2·cx); null for lidar.", unit="px"),
    ]
    height: Annotated[
        int | None,
        Number(dtype="int32", doc="Image height in calib (2·cy); null for lidar.", unit="px"),
    ]
    matrix: Annotated[
        list[list[float]],
        Vector(
            shape=(3, 4),
            doc="Upper three rows of `ego_from_sensor` in this sample's calib file; "
            "`calibrated_sensor` has the same matrix apart from rounding.",
        ),
    ]
    prev: Annotated[str | None, Key(table="sample_data", doc="The sensor's previous file.")]
    next: Annotated[str | None, Key(table="sample_data", doc="The sensor's next file.")]


class SensorRecord(TypedDict):
    """One kind of sensor that every agent has."""

    token: Annotated[str, Derived(doc="The channel.")]
    channel: _Channel
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
    sensor_token: _SensorToken
    agent_token: _AgentToken
    number: Annotated[
        int, Number(dtype="int32", doc="Number of the row among the rows of this sensor, from 1.")
    ]
    translation: Annotated[
        list[float],
        Vector(
            shape=(3,),
            doc="Position of the sensor in the agent's ego frame; 0 for the BEV camera.",
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
        list[list[float]] | None,
        Vector(shape=(3, 3), doc="K of a camera; null for other sensors.", unit="px"),
    ]
    matrix: Annotated[
        list[list[float]],
        Vector(shape=(4, 4), doc="`ego_from_sensor` in the first of its calib files."),
    ]


class EgoPoseRecord(TypedDict):
    """Where an agent was at a moment: `world_from_ego`; one row a sample."""

    token: Annotated[str, Derived(doc="The sample's token.")]
    translation: Annotated[
        list[float],
        Vector(shape=(3,), doc="Position of the ego frame's origin in world.", unit="m"),
    ]
    rotation: Annotated[list[float], Vector(shape=(4,), doc="Quaternion w, x, y, z.")]
    timestamp: _Timestamp
    matrix: Annotated[
        list[list[float]],
        Vector(
            shape=(4, 4),
            doc="`world_from_ego` in the calib file, right-handed, bit for bit.",
        ),
    ]


class InstanceRecord(TypedDict):
    """One actor of a scenario, over all frames and agents."""

    token: Annotated[str, Derived(doc="`<scenario>/actor/<actor_id>`.")]
    scenario_token: _ScenarioToken
    actor_id: Annotated[
        int, Number(dtype="int64", doc="CARLA id; ids from 20000 are parked vehicles.")
    ]
    category: Annotated[str, Choice(values=CATEGORIES, doc="Class in its first annotation.")]
    num_annotations: Annotated[int, Number(dtype="int32", doc="Number over all frames and agents.")]
    first_annotation_token: Annotated[
        str, Key(table="annotation", doc="First annotation, ordered by frame, then agent.")
    ]
    last_annotation_token: Annotated[
        str, Key(table="annotation", doc="Last annotation, ordered by frame, then agent.")
    ]


class AnnotationRecord(TypedDict):
    """One box: an actor as one agent annotated it at one moment, in that sample's LiDAR frame."""

    token: Annotated[
        str, Derived(doc="`<sample>/<row>`, row counted from 0 among the boxes of the label.")
    ]
    sample_token: _SampleToken
    instance_token: Annotated[
        str | None,
        Key(
            table="instance",
            doc="Its actor; the agent's own row (−100) belongs to the agent's actor; null for "
            "untracked rows (−1).",
        ),
    ]
    category: _LabelCategory
    translation: Annotated[
        list[float], Vector(shape=(3,), doc="Box centre, LiDAR frame.", unit="m")
    ]
    size: _BoxSize
    rotation: Annotated[list[float], Vector(shape=(4,), doc="Quaternion w, x, y, z, LiDAR frame.")]
    velocity: Annotated[
        list[float],
        Vector(
            shape=(3,),
            doc="Velocity over the ground, along the axes of the LiDAR frame: the label's own "
            "velocity, decoded. Where the label has no number, it is computed from this agent's "
            "positions of the actor in the world at 10 Hz; NaN without a neighbouring frame or "
            "an id.",
            unit="m/s",
        ),
    ]
    yaw: Annotated[
        float,
        Number(
            dtype="float64", doc="Rotation about z, counter-clockwise, LiDAR frame.", unit="rad"
        ),
    ]
    actor_id: Annotated[
        int,
        Number(
            dtype="int64",
            doc="Id in the file: −100 for the agent itself, −1 if untracked, 20000 or more "
            "for parked vehicles.",
        ),
    ]
    num_lidar_pts: Annotated[
        int, Number(dtype="int64", doc="Number of points of this agent's LiDAR in the box.")
    ]
    camera_visible: Annotated[
        bool, Number(dtype="bool", doc="Whether any of this agent's cameras sees the box.")
    ]
    velocity_label: Annotated[
        list[float],
        Vector(
            shape=(2,),
            doc="The label's own numbers as (vx, −vy): the velocity in world, rotated once more by "
            "the box's yaw; NaN where the label has no number.",
            unit="m/s",
        ),
    ]
    is_collider: _IsCollider
    time_to_impact: _TimeToImpact
    prev: Annotated[
        str | None, Key(table="annotation", doc="The previous box of this actor by the same agent.")
    ]
    next: Annotated[
        str | None, Key(table="annotation", doc="The next box of this actor by the same agent.")
    ]


class TrackRecord(TypedDict):
    """One actor at one moment in the world, merged from all agents' labels.

    Pose, size, velocity and category come from one annotation: by the first agent, in the order of
    the agent table, that saw the actor from outside. The actor's own row (up to 0.3 m off) is used
    only if no other agent saw the actor.
    """

    token: Annotated[str, Derived(doc="`<frame>/actor/<actor_id>`.")]
    frame_token: _FrameToken
    instance_token: Annotated[str, Key(table="instance", doc="Its actor.")]
    scenario_token: _ScenarioToken
    translation: Annotated[list[float], Vector(shape=(3,), doc="Box centre, world.", unit="m")]
    rotation: Annotated[list[float], Vector(shape=(4,), doc="Quaternion w, x, y, z, world.")]
    size: _BoxSize
    velocity: Annotated[
        list[float], Vector(shape=(3,), doc="Velocity in world; NaN where unknown.", unit="m/s")
    ]
    category: _LabelCategory
    is_collider: _IsCollider
    agents: Annotated[list[str], Subset(values=AGENTS, doc="The agents that annotated the actor.")]


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
    """Return table name → specification, in the order in which the tables build on each other."""
    return {name: spec_of(name, record) for name, record in RECORDS.items()}


def table_spec(name: str) -> TableSpec:
    """Return the specification of a table; raise TableError if its name is unknown."""
    specs = table_specs()
    table_name = match_spelling(name, specs)
    if table_name not in specs:
        remedy = table_remedy(name) or meant_text(name, specs)
        raise TableError(f"no table {name!r}; there are {', '.join(specs)}{remedy}")
    return specs[table_name]


def record_columns(record: type) -> tuple[Column, ...]:
    """Return the columns that a TypedDict declares with its annotated fields."""
    hints = get_type_hints(record, include_extras=True)
    return tuple(_make_column(field, hint) for field, hint in hints.items())


def spec_of(name: str, record: type) -> TableSpec:
    """Return the specification of a table whose records have the type `record`, a TypedDict."""
    doc = " ".join((record.__doc__ or "").split())
    return TableSpec(name=name, doc=doc, columns=record_columns(record))


def _make_column(field: str, hint: Any) -> Column:
    value_type, kind = get_args(hint)
    is_union = get_origin(value_type) in (Union, UnionType)
    nullable = is_union and type(None) in get_args(value_type)
    stored: str | None = field
    if isinstance(kind, Derived):
        stored = None
    elif isinstance(kind, Key):
        stored = f"{field.removesuffix('_token')}_row"
    return Column(field, stored, kind, nullable)
