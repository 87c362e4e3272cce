"""Hypothesis strategies for poses, points, boxes, file contents and small releases.

Contents (`labels`, `metas`, `calibs`, `clouds`) can be anything that the files can store, including
unusual values; `label_texts` look like real files. Importing this module raises MissingExtraError
if hypothesis is not installed.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from deepaccident_devkit.errors import MissingExtraError
from deepaccident_devkit.geometry import SE3, Boxes, LidarPointCloud, PinholeCamera
from deepaccident_devkit.release import Calib, Collision, Labels, Meta
from deepaccident_devkit.support.arrays import FloatArray
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CAMERAS,
    CATEGORIES,
    DIRECTIONS,
    META_AGENTS,
    OWN_ACTOR_ID,
    ROAD_TYPES,
    SPLITS,
    STATIC_ACTOR_ID,
    TIMES_OF_DAY,
    UNTRACKED_ID,
    WEATHERS,
)
from deepaccident_devkit.testing.releases import SmallRelease

try:
    from hypothesis import strategies as st
    from hypothesis.extra import numpy as hnp
except ModuleNotFoundError as error:
    raise MissingExtraError(
        "the strategies need hypothesis; run pip install '.[testing]' in a checkout"
    ) from error

_T = TypeVar("_T")

ANGLES = st.floats(-np.pi, np.pi, allow_nan=False)
"""Radians in [−π, π]."""


def numbers(reach: float) -> st.SearchStrategy[float]:
    """Draw finite floats in [−`reach`, `reach`]."""
    return st.floats(-reach, reach, allow_nan=False)


def arrays(shape: tuple[int, ...], reach: float) -> st.SearchStrategy[FloatArray]:
    """Draw float64 arrays of numbers in [−`reach`, `reach`]."""
    return hnp.arrays(np.float64, shape, elements=numbers(reach))


def rotation_matrix(yaw: float, pitch: float, roll: float) -> FloatArray:
    """Return Rz(yaw) · Ry(pitch) · Rx(roll), shape (3, 3), right-handed.

    It is computed here so that tests do not rely on the devkit's implementation.
    """
    cos_yaw, cos_pitch, cos_roll = np.cos([yaw, pitch, roll])
    sin_yaw, sin_pitch, sin_roll = np.sin([yaw, pitch, roll])
    about_z = np.array([[cos_yaw, -sin_yaw, 0], [sin_yaw, cos_yaw, 0], [0, 0, 1]])
    about_y = np.array([[cos_pitch, 0, sin_pitch], [0, 1, 0], [-sin_pitch, 0, cos_pitch]])
    about_x = np.array([[1, 0, 0], [0, cos_roll, -sin_roll], [0, sin_roll, cos_roll]])
    return np.asarray(about_z @ about_y @ about_x)


@st.composite
def matrices(draw: st.DrawFn, reach: float = 1e3) -> FloatArray:
    """Draw rigid 4×4 matrices with any yaw, pitch and roll, and translations up to `reach`."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(draw(ANGLES), draw(ANGLES), draw(ANGLES))
    matrix[:3, 3] = draw(arrays((3,), reach))
    return matrix


def poses(reach: float = 1e3) -> st.SearchStrategy[SE3]:
    """Draw poses whose matrices are drawn by `matrices`."""
    return matrices(reach).map(SE3)


def points(max_count: int = 8, reach: float = 100.0) -> st.SearchStrategy[FloatArray]:
    """Draw points, shape (N, 3), with N from 0 to `max_count`."""
    counts = st.integers(0, max_count)
    return counts.flatmap(lambda count: arrays((count, 3), reach))


@st.composite
def boxes(draw: st.DrawFn, max_count: int = 5, frame: str = "lidar") -> Boxes:
    """Draw boxes with arbitrary rotations; some velocities are unknown."""
    count = draw(st.integers(0, max_count))
    rotation = np.zeros((count, 4))
    for row in range(count):
        rotation[row] = draw(poses()).quaternion.elements
    velocity = draw(arrays((count, 3), 30.0))
    velocity[draw(hnp.arrays(np.bool_, (count,)))] = np.nan
    return Boxes(
        frame=frame,
        center=draw(arrays((count, 3), 100.0)),
        size=np.abs(draw(arrays((count, 3), 10.0))) + 0.1,
        rotation=rotation,
        velocity=velocity,
        category=draw(hnp.arrays(np.int8, (count,), elements=st.integers(0, len(CATEGORIES) - 1))),
        actor_id=draw(hnp.arrays(np.int64, (count,), elements=st.integers(-100, 30_000))),
        num_lidar_pts=draw(hnp.arrays(np.int64, (count,), elements=st.integers(0, 5000))),
        camera_visible=draw(hnp.arrays(np.bool_, (count,))),
        row=np.arange(count),
    )


@st.composite
def upright_boxes(
    draw: st.DrawFn, max_count: int = 4, reach: float = 10.0, frame: str = "lidar"
) -> Boxes:
    """Draw boxes on the ground, so close that many overlap; some are axis-aligned."""
    count = draw(st.integers(0, max_count))
    sizes = st.floats(0.1, 10)
    yaws = ANGLES | st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi])
    center = draw(arrays((count, 3), reach))
    size = draw(hnp.arrays(np.float64, (count, 3), elements=sizes))
    yaw = draw(hnp.arrays(np.float64, (count,), elements=yaws))
    return Boxes.from_arrays(center, size, yaw, frame=frame)


def cameras() -> st.SearchStrategy[PinholeCamera]:
    """Draw pinhole cameras with all focal lengths and centres that an image can have."""

    def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
        first_row = [fx, 0, cx]
        second_row = [0, fy, cy]
        return np.array([first_row, second_row, [0, 0, 1]])

    focal = st.floats(50, 5000)
    centre = st.floats(0, 2000)
    side = st.integers(1, 2000)
    intrinsic = st.builds(intrinsic_matrix, focal, focal, centre, centre)
    return st.builds(PinholeCamera, intrinsic, side, side)


@st.composite
def labels(draw: st.DrawFn, max_count: int = 5) -> Labels:
    """Draw the content of a label file: numbers up to 1e9, unknown velocities, any handedness."""
    count = draw(st.integers(0, max_count))
    number = numbers(1e9)
    velocity = draw(hnp.arrays(np.float64, (count, 2), elements=number | st.just(np.nan)))
    integers = st.integers(-(2**63), 2**63 - 1)
    return Labels(
        raw=draw(st.booleans()),
        num_boxes=np.array([count]),
        agent_velocity=draw(hnp.arrays(np.float64, (1, 2), elements=number)),
        category=draw(hnp.arrays(np.int8, (count,), elements=st.integers(0, len(CATEGORIES) - 1))),
        center=draw(hnp.arrays(np.float64, (count, 3), elements=number)),
        size=draw(hnp.arrays(np.float64, (count, 3), elements=number)),
        yaw=draw(hnp.arrays(np.float64, (count,), elements=number)),
        velocity=velocity,
        actor_id=draw(hnp.arrays(np.int64, (count,), elements=integers)),
        num_lidar_pts=draw(hnp.arrays(np.int64, (count,), elements=integers)),
        camera_visible=draw(hnp.arrays(np.bool_, (count,))),
    )


@st.composite
def label_lines(draw: st.DrawFn) -> str:
    """Draw a box line with realistic numbers, for a tracked, untracked or parked actor."""
    number = numbers(100.0)
    size = st.floats(0.3, 10.0)
    center = [draw(number), draw(number), draw(number)]
    dimensions = [draw(size), draw(size), draw(size)]
    yaw = draw(ANGLES)
    parked_ids = st.integers(STATIC_ACTOR_ID, STATIC_ACTOR_ID + 500)
    actor_id = draw(st.just(UNTRACKED_ID) | st.integers(1, 10_000) | parked_ids)
    velocity = [0.0, 0.0]
    if 0 < actor_id < STATIC_ACTOR_ID:
        velocity = [draw(number), draw(number)]
    category = draw(st.sampled_from(CATEGORIES))
    point_count = draw(st.integers(0, 2000))
    is_visible = draw(st.booleans())
    values = [*center, *dimensions, yaw, *velocity, actor_id, point_count, is_visible]
    return " ".join([category, *map(repr, values)])


@st.composite
def label_texts(draw: st.DrawFn, max_count: int = 5) -> str:
    """Draw a vehicle's complete label file: header, own line, other lines, and lines to skip.

    Lines to skip are blank or contain one word. Line endings are Unix or Windows.
    """
    speed = numbers(30.0)
    velocity = f"{draw(speed)!r} {draw(speed)!r}"
    point_count = draw(st.integers(0, 2000))
    own_line = f"car 0.0 0.0 -1.2 4.6 1.9 1.5 0.0 {velocity} {OWN_ACTOR_ID} {point_count} False"
    other_lines = draw(st.lists(label_lines(), max_size=max_count))
    lines = [velocity, own_line, *other_lines]
    for skipped_line in draw(st.lists(st.sampled_from(["", "car"]), max_size=2)):
        index = draw(st.integers(1, len(lines)))
        lines.insert(index, skipped_line)
    line_end = draw(st.sampled_from(["\n", "\r\n"]))
    return line_end.join([*lines, ""])


@st.composite
def metas(draw: st.DrawFn) -> Meta:
    """Draw the content of a meta file, with or without a collision, complete or not."""
    actors = st.integers(1, 30_000)
    agents = st.sampled_from(list(META_AGENTS.values()))
    collision = Collision(
        ids=(draw(actors), draw(actors)),
        classes=(draw(st.sampled_from(CATEGORIES)), draw(st.sampled_from(CATEGORIES))),
        impact=draw(numbers(1e9)),
        spawn_relation=draw(st.sampled_from(["same", "opposite", "left"])),
        contact_side=draw(st.sampled_from(["front_side", "rear_side"])),
        agents=draw(st.none() | st.tuples(agents, agents)),
    )
    directions = st.none() | st.sampled_from(DIRECTIONS)
    return Meta(
        weather=draw(st.sampled_from(WEATHERS)),
        time_of_day=draw(st.none() | st.sampled_from(TIMES_OF_DAY)),
        collision=draw(st.sampled_from([None, collision])),
        simulated_frames=draw(st.integers(11, 110)),
        agent_ids=draw(st.none() | st.tuples(actors, actors, actors, actors)),
        road_type=draw(st.none() | st.sampled_from(ROAD_TYPES)),
        spawn_side=draw(st.none() | st.sampled_from(["left", "right", "opposite (straight)"])),
        ego_direction=draw(directions),
        other_direction=draw(directions),
    )


@st.composite
def calibs(draw: st.DrawFn) -> Calib:
    """Draw the content of a calib file: any poses, and cameras with different intrinsics."""
    focal = st.floats(100, 2000)
    ego_from_lidar = draw(poses(5.0))
    world_from_ego = draw(poses())
    camera_from_lidar = {camera: draw(poses(5.0)) for camera in CAMERAS}
    intrinsic = {}
    for camera in CAMERAS:
        first_row = [draw(focal), 0, draw(focal)]
        second_row = [0, draw(focal), draw(focal)]
        intrinsic[camera] = np.array([first_row, second_row, [0, 0, 1]])
    return Calib(
        ego_from_lidar=ego_from_lidar,
        world_from_ego=world_from_ego,
        camera_from_lidar=camera_from_lidar,
        intrinsic=intrinsic,
    )


@st.composite
def clouds(draw: st.DrawFn) -> LidarPointCloud:
    """Draw point clouds of single-precision numbers, as stored in the files."""
    point_count = draw(st.integers(0, 20))
    elements = st.floats(-100, 100, width=32)
    points = draw(hnp.arrays(np.float32, (point_count, 4), elements=elements))
    xyz = points[:, :3].astype(np.float64)
    intensity = points[:, 3]
    return LidarPointCloud(xyz, intensity)


def damaged(content: bytes) -> st.SearchStrategy[bytes]:
    """Draw damaged copies of `content`.

    Bytes are changed, inserted or removed, pieces are repeated, or the end is cut off.
    """
    offsets = st.integers(0, len(content) - 1)
    lengths = st.integers(0, 12)

    def damage(kind: str, offset: int, length: int, new_bytes: bytes, source: int) -> bytes:
        start = content[:offset]
        if kind == "change":
            return start + new_bytes + content[offset + len(new_bytes) :]
        if kind == "insert":
            return start + new_bytes + content[offset:]
        if kind == "remove":
            return start + content[offset + length + 1 :]
        if kind == "repeat":
            piece = content[source : source + length + 1]
            return start + piece + content[offset:]
        return start

    kinds = st.sampled_from(["change", "change", "insert", "remove", "repeat", "cut"])
    new_bytes = st.binary(min_size=1, max_size=4)
    return st.builds(damage, kinds, offsets, lengths, new_bytes, offsets)


def small_releases() -> st.SearchStrategy[SmallRelease]:
    """Draw small releases without sensor files, which take a tenth of a second to write."""
    return st.builds(
        SmallRelease,
        layout=st.sampled_from(["A", "B"]),
        frames=st.integers(1, 3),
        splits=_subsets(SPLITS),
        agents=_subsets(AGENTS),
        channels=st.just(()),
        seed=st.integers(0, 2**32),
    )


def _subsets(names: Sequence[_T]) -> st.SearchStrategy[tuple[_T, ...]]:
    """Draw one or more of the names, keeping their order."""

    def in_order(subset: set[_T]) -> tuple[_T, ...]:
        return tuple(name for name in names if name in subset)

    return st.sets(st.sampled_from(names), min_size=1).map(in_order)
