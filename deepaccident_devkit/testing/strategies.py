"""Hypothesis strategies for poses, points, boxes, contents of files, and small releases.

Contents (`labels`, `metas`, `calibs`, `clouds`) can be all that the files can hold, also unusual
values; `label_texts` look like real files. Raises MissingExtraError on import if hypothesis is not
installed.
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
        "the strategies need hypothesis: in a checkout, pip install '.[testing]'"
    ) from error

_T = TypeVar("_T")

ANGLES = st.floats(-np.pi, np.pi, allow_nan=False)
"""Radians in [−π, π]."""


def numbers(reach: float) -> st.SearchStrategy[float]:
    """Draw finite floats from −`reach` to `reach`."""
    return st.floats(-reach, reach, allow_nan=False)


def arrays(shape: tuple[int, ...], reach: float) -> st.SearchStrategy[FloatArray]:
    """Draw float64 arrays of numbers from −`reach` to `reach`."""
    return hnp.arrays(np.float64, shape, elements=numbers(reach))


def rotation_matrix(yaw: float, pitch: float, roll: float) -> FloatArray:
    """Return Rz(yaw) · Ry(pitch) · Rx(roll), shape (3, 3), right-handed.

    It is computed here, so that tests do not use the devkit's own code.
    """
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(about_z @ about_y @ about_x)


@st.composite
def matrices(draw: st.DrawFn, reach: float = 1e3) -> FloatArray:
    """Draw rigid 4×4 matrices with any yaw, pitch and roll and a translation up to `reach`."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(draw(ANGLES), draw(ANGLES), draw(ANGLES))
    matrix[:3, 3] = draw(arrays((3,), reach))
    return matrix


def poses(reach: float = 1e3) -> st.SearchStrategy[SE3]:
    """Draw SE3 objects of `matrices`."""
    return matrices(reach).map(SE3)


def points(max_count: int = 8, reach: float = 100.0) -> st.SearchStrategy[FloatArray]:
    """Draw arrays (N, 3), N from 0 to `max_count`."""
    return st.integers(0, max_count).flatmap(lambda count: arrays((count, 3), reach))


@st.composite
def boxes(draw: st.DrawFn, max_count: int = 5, frame: str = "lidar") -> Boxes:
    """Draw boxes with any rotation; some velocities are unknown."""
    count = draw(st.integers(0, max_count))
    rotation = [SE3(draw(matrices())).quaternion.elements for _ in range(count)]
    velocity = draw(arrays((count, 3), 30.0))
    velocity[draw(hnp.arrays(np.bool_, (count,)))] = np.nan
    return Boxes(
        frame=frame,
        center=draw(arrays((count, 3), 100.0)),
        size=np.abs(draw(arrays((count, 3), 10.0))) + 0.1,
        rotation=np.array(rotation).reshape(count, 4),
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
    """Draw boxes on the ground, so close that many overlap; some are parallel to the axes."""
    count = draw(st.integers(0, max_count))
    yaws = ANGLES | st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi])
    return Boxes.from_arrays(
        draw(arrays((count, 3), reach)),
        draw(hnp.arrays(np.float64, (count, 3), elements=st.floats(0.1, 10))),
        draw(hnp.arrays(np.float64, (count,), elements=yaws)),
        frame=frame,
    )


def cameras() -> st.SearchStrategy[PinholeCamera]:
    """Draw pinhole cameras of all focal lengths and centres that a picture can have."""
    focal = st.floats(50, 5000)
    centre = st.floats(0, 2000)
    matrix = st.builds(
        lambda fx, fy, cx, cy: np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        focal,
        focal,
        centre,
        centre,
    )
    return st.builds(PinholeCamera, matrix, st.integers(1, 2000), st.integers(1, 2000))


@st.composite
def labels(draw: st.DrawFn, max_count: int = 5) -> Labels:
    """Draw the content of a label file: numbers up to 1e9, unknown velocities, any handedness."""
    count = draw(st.integers(0, max_count))
    anything = numbers(1e9)
    velocity = draw(hnp.arrays(np.float64, (count, 2), elements=anything | st.just(np.nan)))
    integers = st.integers(-(2**63), 2**63 - 1)
    return Labels(
        raw=draw(st.booleans()),
        num_boxes=np.array([count]),
        agent_velocity=draw(hnp.arrays(np.float64, (1, 2), elements=anything)),
        category=draw(hnp.arrays(np.int8, (count,), elements=st.integers(0, len(CATEGORIES) - 1))),
        center=draw(hnp.arrays(np.float64, (count, 3), elements=anything)),
        size=draw(hnp.arrays(np.float64, (count, 3), elements=anything)),
        yaw=draw(hnp.arrays(np.float64, (count,), elements=anything)),
        velocity=velocity,
        actor_id=draw(hnp.arrays(np.int64, (count,), elements=integers)),
        num_lidar_pts=draw(hnp.arrays(np.int64, (count,), elements=integers)),
        camera_visible=draw(hnp.arrays(np.bool_, (count,))),
    )


@st.composite
def label_lines(draw: st.DrawFn) -> str:
    """Draw a box line with realistic numbers, of a tracked, an untracked or a parked actor."""
    number = numbers(100.0)
    size = st.floats(0.3, 10.0)
    floats = [draw(number) for _ in range(3)] + [draw(size) for _ in range(3)] + [draw(ANGLES)]
    actor_id = draw(
        st.just(UNTRACKED_ID)
        | st.integers(1, 10_000)
        | st.integers(STATIC_ACTOR_ID, STATIC_ACTOR_ID + 500)
    )
    speeds = [draw(number), draw(number)] if 0 < actor_id < STATIC_ACTOR_ID else [0.0, 0.0]
    words = [draw(st.sampled_from(CATEGORIES)), *map(repr, floats + speeds)]
    return " ".join(
        [*words, str(actor_id), str(draw(st.integers(0, 2000))), str(draw(st.booleans()))]
    )


@st.composite
def label_texts(draw: st.DrawFn, max_count: int = 5) -> str:
    """Draw a complete label file of a vehicle: header, own line, other lines, and lines to skip.

    Lines to skip are blank or have one word. Line ends are of Unix or Windows.
    """
    speed = " ".join(repr(draw(numbers(30.0))) for _ in range(2))
    points = draw(st.integers(0, 2000))
    own = f"car 0.0 0.0 -1.2 4.6 1.9 1.5 0.0 {speed} {OWN_ACTOR_ID} {points} False"
    lines = [speed, own, *draw(st.lists(label_lines(), max_size=max_count))]
    for skipped in draw(st.lists(st.sampled_from(["", "car"]), max_size=2)):
        lines.insert(draw(st.integers(1, len(lines))), skipped)
    end = draw(st.sampled_from(["\n", "\r\n"]))
    return "".join(line + end for line in lines)


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
    return Calib(
        ego_from_lidar=draw(poses(5.0)),
        world_from_ego=draw(poses()),
        camera_from_lidar={camera: draw(poses(5.0)) for camera in CAMERAS},
        intrinsic={
            camera: np.array(
                [[draw(focal), 0, draw(focal)], [0, draw(focal), draw(focal)], [0, 0, 1]]
            )
            for camera in CAMERAS
        },
    )


@st.composite
def clouds(draw: st.DrawFn) -> LidarPointCloud:
    """Draw point clouds of single-precision numbers, as in the files."""
    shape = (draw(st.integers(0, 20)), 4)
    elements = st.floats(-100, 100, width=32)
    values = draw(hnp.arrays(np.float32, shape, elements=elements))
    return LidarPointCloud(values[:, :3].astype(np.float64), values[:, 3])


def damaged(content: bytes) -> st.SearchStrategy[bytes]:
    """Draw damaged copies of `content`.

    Bytes are changed, inserted or removed, pieces are repeated, or the end is cut off.
    """
    offsets = st.integers(0, len(content) - 1)
    lengths = st.integers(0, 12)

    def damage(kind: str, offset: int, length: int, new: bytes, source: int) -> bytes:
        if kind == "change":
            return content[:offset] + new + content[offset + len(new) :]
        if kind == "insert":
            return content[:offset] + new + content[offset:]
        if kind == "remove":
            return content[:offset] + content[offset + length + 1 :]
        if kind == "repeat":
            return content[:offset] + content[source : source + length + 1] + content[offset:]
        return content[:offset]

    kinds = st.sampled_from(["change", "change", "insert", "remove", "repeat", "cut"])
    return st.builds(damage, kinds, offsets, lengths, st.binary(min_size=1, max_size=4), offsets)


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
    """Draw one or more of the names, in their order."""
    sets = st.sets(st.sampled_from(names), min_size=1)
    return sets.map(lambda subset: tuple(name for name in names if name in subset))
