"""Labels: the label file of an agent for a scene, and which road users its cameras see.

The result depends neither on the size of the images nor on whether images are made. For every road user, rays through
the pixels of a `WIDTH` × `HEIGHT` picture are cast; if it fills much of the picture, through fewer of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.geometry.boxes import CORNER_SIGNS
from deepaccident_devkit.plugins.synth.sensors.agents import Agent, Camera
from deepaccident_devkit.plugins.synth.sensors.lidar import Scan
from deepaccident_devkit.plugins.synth.sensors.scene import Scene
from deepaccident_devkit.plugins.synth.shapes import BOX_CLEARANCE
from deepaccident_devkit.release import Labels, label_from_world_velocity
from deepaccident_devkit.support.arrays import BoolArray, Float32Array, FloatArray, IntArray
from deepaccident_devkit.taxonomy import CATEGORIES, OWN_ACTOR_ID, UNTRACKED_ID

# Corners that are at least so many metres ahead of the camera are projected.
CLOSE = 0.05
# The pairs of corners that are the edges of a box.
_EDGES = np.array(
    [
        (a, b)
        for a, b in combinations(range(8), 2)
        if (CORNER_SIGNS[a] == CORNER_SIGNS[b]).sum() == 2
    ]
)
# Pixels that are added around a rectangle.
_SPARE = 1.0


def rectangles(
    corners: FloatArray, slope: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Least and greatest column and row, (A, 2) each, not rounded, of boxes (A, 8, 3), metres, in the optical frame.

    Of a box that is partly behind the camera, only the part ahead counts; if all of it is behind, the two are equal.
    `slope` is that of a pixel, across and down, (2,) or (A, 2); `size` the picture's width and height.
    """
    low, high = _spans(
        corners[..., :2] / np.maximum(corners[..., 2:], CLOSE), corners[..., 2] >= CLOSE
    )
    partly = np.flatnonzero(
        (corners[..., 2].min(axis=1) < CLOSE) & (corners[..., 2].max(axis=1) > CLOSE)
    )
    if len(partly):
        cut, crosses = _cut_edges(corners[partly])
        ahead = np.concatenate([corners[partly], cut], axis=1)
        shown = np.concatenate([corners[partly, :, 2] >= CLOSE, crosses], axis=1)
        low[partly], high[partly] = _spans(
            ahead[..., :2] / np.maximum(ahead[..., 2:], CLOSE), shown
        )
    middle = np.array(size) / 2
    return low / slope + middle, high / slope + middle


def _spans(places: FloatArray, counted: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest of the points (A, K, 2) that are counted (A, K); 0 if no point is."""
    low = np.where(counted[..., None], places, np.inf).min(axis=1)
    high = np.where(counted[..., None], places, -np.inf).max(axis=1)
    none = ~counted.any(axis=1)
    low[none], high[none] = 0, 0
    return low, high


def _cut_edges(corners: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Where the twelve edges of boxes (A, 8, 3) are `CLOSE` ahead of the camera, (A, 12, 3), and which edges are."""
    one, other = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    crosses = (one[..., 2] < CLOSE) != (other[..., 2] < CLOSE)
    way = np.where(crosses, other[..., 2] - one[..., 2], 1.0)
    share = (CLOSE - one[..., 2]) / way
    cut = one + share[..., None] * (other - one)
    cut[..., 2] = CLOSE
    return cut, crosses


def nearest_movers(scene: Scene, camera: Camera, ground_from_camera: SE3) -> Float32Array:
    """How near (metres ahead) a moving road user may be in each pixel, (H + 2, W + 2); infinite if there is none.

    There are two pixels more at the bottom and at the right than the picture has.
    """
    corners = scene.box_corners[scene.setting.moving]
    optics = camera.optics
    slope = np.full(2, 1 / optics.intrinsic[0, 0])
    local = (corners - ground_from_camera.translation) @ ground_from_camera.rotation
    low, high = rectangles(local, slope, (optics.width, optics.height))
    nearest = np.full((optics.height + 2, optics.width + 2), np.inf, dtype=np.float32)
    ends = (optics.width + 2, optics.height + 2)
    first = np.floor(low - _SPARE).clip(0, ends).astype(int).tolist()
    last = np.ceil(high + _SPARE + 2).clip(0, ends).astype(int).tolist()
    ahead = (local[:, :, 2].min(axis=1) - CLOSE).astype(np.float32)
    for row in np.flatnonzero((high > low).all(axis=1)).tolist():
        window = nearest[first[row][1] : last[row][1], first[row][0] : last[row][0]]
        np.minimum(window, ahead[row], out=window)
    return nearest


# Size of the pictures that decide visibility: they have a sixteenth of the pixels of the real images.
WIDTH, HEIGHT = 400, 225
# A road user with this many pixels is visible.
LEAST_PIXELS = 2
# The most rays to a road user, across and also down: in all, and in the first attempt.
_RAYS_ACROSS, _FEW_ACROSS = 14, 4


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """Rectangles of pixels (W,), each around a road user in the picture of a camera.

    Attributes:
        camera: row of the camera.
        actor: row of the road user among the wanted ones.
        first: (W, 2) column and row of the upper left pixel.
        size: (W, 2) pixels across and down.
    """

    camera: IntArray
    actor: IntArray
    first: IntArray
    size: IntArray

    def select(self, rows: BoolArray) -> "_Windows":
        """Some of the rectangles; `rows` (W,) says which."""
        return _Windows(self.camera[rows], self.actor[rows], self.first[rows], self.size[rows])


class CameraViews:
    """What C cameras at poses `ground_from_camera` might see of road users, rows (K,), at a moment."""

    def __init__(
        self, scene: Scene, cameras: Sequence[Camera], poses: Sequence[SE3], rows: IntArray
    ) -> None:
        matrices = np.stack([pose.matrix for pose in poses])
        self._axes, self._origins = matrices[:, :3, :3], matrices[:, :3, 3]
        self._slopes = np.stack([_slope(camera) for camera in cameras])
        self._scene, self._rows = scene, rows
        corners = (scene.box_corners[rows] - self._origins[:, None, None]) @ self._axes[:, None]
        self._windows = _windows(corners, self._slopes)

    def pixels(
        self, wanted: BoolArray | None = None, *, rays_across: int = _RAYS_ACROSS
    ) -> IntArray:
        """How many pixels (C, K) int64 of a `WIDTH` × `HEIGHT` picture road users have; large numbers are approximate.

        Those that are not `wanted` (K,) have 0. At most so many rays are cast to each, across and also down.
        """
        windows = (
            self._windows if wanted is None else self._windows.select(wanted[self._windows.actor])
        )
        pixel, window, step = _pixels(windows, rays_across)
        camera = windows.camera[window]
        aside = (pixel + 0.5 - (WIDTH / 2, HEIGHT / 2)) * self._slopes[camera]
        right, down, ahead = np.moveaxis(self._axes, 2, 0)[:, camera]
        rays = (aside[:, :1] * right + aside[:, 1:] * down + ahead).astype(np.float32)
        _, face = self._scene.cast(self._origins[camera], rays)
        met = np.flatnonzero(self._scene.face_owner[face] == self._rows[windows.actor[window]])
        place = camera[met] * len(self._rows) + windows.actor[window[met]]
        count = len(self._slopes) * len(self._rows)
        return (
            np.bincount(place, step[window[met]] ** 2, minlength=count)
            .astype(np.int64)
            .reshape(-1, len(self._rows))
        )


def camera_visible(scene: Scene, agent: Agent, ground_from_lidar: SE3, rows: IntArray) -> BoolArray:
    """Which actors of `rows` (K,) have `LEAST_PIXELS` pixels in any camera of the agent; never the agent itself.

    A few rays are enough for most; all rays are cast only to the others.
    """
    poses = [ground_from_lidar @ camera.lidar_from_camera for camera in agent.cameras]
    views = CameraViews(scene, agent.cameras, poses, rows)
    others = np.ones(len(rows), dtype=bool) if agent.row is None else rows != agent.row
    seen = np.zeros(len(rows), dtype=bool)
    for rays_across in (_FEW_ACROSS, _RAYS_ACROSS):
        seen |= (views.pixels(others & ~seen, rays_across=rays_across) >= LEAST_PIXELS).any(axis=0)
    return seen


def _slope(camera: Camera) -> FloatArray:
    """The slope of one pixel of the `WIDTH` × `HEIGHT` picture, across and down, (2,)."""
    optics = camera.optics
    return np.asarray(
        np.array([optics.width / WIDTH, optics.height / HEIGHT]) / optics.intrinsic[0, 0]
    )


def _windows(corners: FloatArray, slopes: FloatArray) -> _Windows:
    """The pixels that boxes (C, K, 8, 3) in C optical frames may cover; `slopes` (C, 2) are those of a pixel."""
    count = corners.shape[1]
    low, high = rectangles(
        corners.reshape(-1, 8, 3), np.repeat(slopes, count, axis=0), (WIDTH, HEIGHT)
    )
    first = np.floor(low).clip(0, (WIDTH, HEIGHT)).astype(np.int64)
    size = np.ceil(high).clip(0, (WIDTH, HEIGHT)).astype(np.int64) - first
    rows = np.flatnonzero((size > 0).all(axis=1))
    camera, actor = np.divmod(rows, max(count, 1))
    return _Windows(camera, actor, first[rows], size[rows])


def _pixels(windows: _Windows, rays_across: int) -> tuple[IntArray, IntArray, IntArray]:
    """Pixels (N, 2), column and row; the window (N,) of each; and the distance of pixels in each window (W,)."""
    step = -(-windows.size.max(axis=1, initial=1) // rays_across)
    across, down = (-(-windows.size // step[:, None])).T
    counts = across * down
    window = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(window)) - np.repeat(np.cumsum(counts) - counts, counts)
    place = np.stack(np.divmod(within, across[window])[::-1], axis=1)
    middle = (step - 1) // 2  # the pixel in the middle of a step's square
    return windows.first[window] + place * step[window, None] + middle[window, None], window, step


# Actors up to this distance are annotated: metres over the ground from the LiDAR to the box's centre.
LABEL_RANGE = 120.0
# Actors farther away than this, in metres, have no id.
TRACKING_RANGE = 115.0
# Points are counted in boxes of so many seconds after the point cloud, when other actors have already moved on.
COUNTED_LATER = 0.003
# The most metres that they have moved on: more would be too wrong for a fast one of which only the back is seen.
MOST_AHEAD = 0.012
_PEDESTRIAN = CATEGORIES.index("pedestrian")


def annotate(
    scene: Scene, agent: Agent, world_from_ground: SE3, scan: Scan, *, exact: bool
) -> Labels:
    """The labels of one agent at one moment: parked vehicles, other vehicles, pedestrians.

    `num_lidar_pts` counts all stored points of the scan in each box; if `exact` in the annotated boxes, and not in
    those of `COUNTED_LATER`.
    """
    ground_from_lidar = agent.ground_from_lidar(scene)
    center, yaw, velocity = _kinematics(scene)
    distance = np.hypot(*(center[:, :2] - ground_from_lidar.translation[:2]).T)
    rows = _in_order(scene, distance <= LABEL_RANGE)
    actor_id = np.where(distance > TRACKING_RANGE, UNTRACKED_ID, scene.actors.actor_id)
    lidar_from_ground = ground_from_lidar.inverse()
    lidar_center, lidar_velocity = (
        lidar_from_ground.apply(center),
        lidar_from_ground.rotate(velocity),
    )
    lidar_yaw = _turned(yaw, lidar_from_ground)
    world_velocity = world_from_ground.rotate(velocity)[:, :2]
    agent_velocity = np.zeros((1, 2))
    if agent.row is not None:
        actor_id[agent.row] = OWN_ACTOR_ID
        agent_velocity[0] = world_velocity[agent.row]
        lidar_yaw[agent.row], lidar_velocity[agent.row] = 0.0, 0.0
    size, ahead = (
        scene.actors.size[rows],
        np.zeros((len(rows), 3)) if exact else gone_on(lidar_velocity[rows]),
    )
    counted = Boxes.from_arrays(lidar_center[rows] + ahead, size, lidar_yaw[rows], frame="lidar")
    return Labels(
        raw=False,
        num_boxes=np.array([len(rows)]),
        agent_velocity=agent_velocity,
        category=scene.actors.category[rows],
        center=lidar_center[rows],
        size=size,
        yaw=lidar_yaw[rows],
        velocity=label_from_world_velocity(world_velocity, lidar_yaw)[rows],
        actor_id=actor_id[rows],
        num_lidar_pts=counted.count_points(scan.xyz),
        camera_visible=camera_visible(scene, agent, ground_from_lidar, rows),
    )


def gone_on(velocity: FloatArray) -> FloatArray:
    """How far (N, 3), metres, actors with velocities (N, 3) have moved on when points are counted."""
    way = COUNTED_LATER * velocity
    return np.asarray(
        way
        * np.minimum(1.0, MOST_AHEAD / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9))
    )


def _in_order(scene: Scene, wanted: BoolArray) -> IntArray:
    """Rows of the wanted actors (A,) in the order of label lines: the same for all agents and frames, not by ids."""
    actors = scene.actors
    parked = np.isin(np.arange(len(actors)), scene.setting.parked)
    order = np.lexsort([actors.object_id, actors.category == _PEDESTRIAN, ~parked])
    return np.asarray(order[wanted[order]])


def _kinematics(scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres (A, 3), forward unit vectors (A, 3) and velocities (A, 3) along the ground of all boxes, ground frame."""
    forward, up = scene.frames[:, :3, 0], scene.frames[:, :3, 2]
    center = scene.frames[:, :3, 3] + up * (BOX_CLEARANCE + scene.actors.size[:, 2:] / 2)
    over_ground = scene.snapshot.velocities
    climb = -(over_ground * up[:, :2]).sum(axis=1) / up[:, 2]
    return center, forward, np.column_stack([over_ground, climb])


def _turned(forward: FloatArray, lidar_from_ground: SE3) -> FloatArray:
    """Yaw (A,) of forward vectors (A, 3) in the LiDAR frame, in (−π, π]."""
    ahead = lidar_from_ground.rotate(forward)
    return np.asarray(np.arctan2(ahead[:, 1], ahead[:, 0]))
