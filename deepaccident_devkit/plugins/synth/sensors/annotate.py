"""Labels: the label file of an agent for a scene, and the road users that its cameras see.

The result depends neither on the size of the images nor on whether images are made. For every road
user, rays through the pixels of a `WIDTH` × `HEIGHT` picture are cast; if it fills much of the
picture, through fewer of them.
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

CLOSE = 0.05
"""Corners that are at least this far ahead of the camera are projected, metres."""
# The pairs of corners that are the edges of a box.
_EDGES = np.array(
    [
        (a, b)
        for a, b in combinations(range(8), 2)
        if (CORNER_SIGNS[a] == CORNER_SIGNS[b]).sum() == 2
    ]
)
_RECTANGLE_MARGIN_PIXELS = 1.0
# Size of the pictures that decide visibility: a sixteenth of the pixels of the real images.
WIDTH, HEIGHT = 400, 225
MIN_PIXELS = 2
"""Smallest number of pixels of a visible road user."""
# Largest number of rays to a road user, across and also down, and that number in the first attempt.
_RAYS_ACROSS = 14
_RAYS_ACROSS_FIRST = 4
LABEL_RANGE = 120.0
"""Range of annotations: distance over the ground from the LiDAR to the box's centre, metres."""
TRACKING_RANGE = 115.0
"""Actors farther away than this have no id, metres."""
# Points are counted in the boxes of a moment this long after the point cloud, when other actors
# have already moved on.
COUNT_DELAY_S = 0.003
# Largest distance that they have moved on: more would be too wrong for a fast actor with only its
# back in view.
MAX_COUNT_OFFSET_M = 0.012
_PEDESTRIAN = CATEGORIES.index("pedestrian")


def rectangles(
    corners: FloatArray, slope: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return the rectangles of boxes in a picture, not rounded.

    For a box that is partly behind the camera, only the part ahead counts; if the complete box is
    behind, the two results are equal.

    Args:
        corners: Corners of the boxes in the optical frame, shape (A, 8, 3), metres.
        slope: Slope of a pixel, across and down, shape (2,) or (A, 2).
        size: Width and height of the picture, pixels.

    Returns:
        Smallest and largest column and row, shape (A, 2) each.
    """
    depth = corners[..., 2]
    tangents = corners[..., :2] / np.maximum(corners[..., 2:], CLOSE)
    low, high = _spans(tangents, depth >= CLOSE)
    partly_ahead = (depth.min(axis=1) < CLOSE) & (depth.max(axis=1) > CLOSE)
    rows = np.flatnonzero(partly_ahead)
    if len(rows):
        cut, crosses = _cut_edges(corners[rows])
        points = np.concatenate([corners[rows], cut], axis=1)
        is_ahead = np.concatenate([depth[rows] >= CLOSE, crosses], axis=1)
        tangents = points[..., :2] / np.maximum(points[..., 2:], CLOSE)
        low[rows], high[rows] = _spans(tangents, is_ahead)
    middle = np.array(size) / 2
    return low / slope + middle, high / slope + middle


def _spans(points: FloatArray, counted: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and largest coordinates of counted points.

    Args:
        points: Points, shape (A, K, 2).
        counted: Truth values, shape (A, K).

    Returns:
        Coordinates (A, 2) each; 0 if no point is counted.
    """
    low = np.where(counted[..., None], points, np.inf).min(axis=1)
    high = np.where(counted[..., None], points, -np.inf).max(axis=1)
    empty = ~counted.any(axis=1)
    low[empty] = 0
    high[empty] = 0
    return low, high


def _cut_edges(corners: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Cut the twelve edges of boxes (A, 8, 3) at the distance `CLOSE` ahead of the camera.

    Returns:
        The points (A, 12, 3) on the edges, and truth values (A, 12): which edges are cut.
    """
    starts = corners[:, _EDGES[:, 0]]
    ends = corners[:, _EDGES[:, 1]]
    start_depth = starts[..., 2]
    end_depth = ends[..., 2]
    crosses = (start_depth < CLOSE) != (end_depth < CLOSE)
    depth_change = np.where(crosses, end_depth - start_depth, 1.0)
    share = (CLOSE - start_depth) / depth_change
    cut = starts + share[..., None] * (ends - starts)
    cut[..., 2] = CLOSE
    return cut, crosses


def nearest_movers(scene: Scene, camera: Camera, ground_from_camera: SE3) -> Float32Array:
    """Return the smallest possible depth of a moving road user in each pixel.

    Returns:
        Depths (H + 2, W + 2), metres; infinite if there is none. There are two pixels more at the
        bottom and at the right than the picture has.
    """
    corners = scene.box_corners[scene.setting.moving]
    optics = camera.optics
    slope = np.full(2, 1 / optics.intrinsic[0, 0])
    optical_corners = (corners - ground_from_camera.translation) @ ground_from_camera.rotation
    low, high = rectangles(optical_corners, slope, (optics.width, optics.height))
    nearest = np.full((optics.height + 2, optics.width + 2), np.inf, dtype=np.float32)
    ends = (optics.width + 2, optics.height + 2)
    first_pixels = np.floor(low - _RECTANGLE_MARGIN_PIXELS).clip(0, ends).astype(int).tolist()
    end_pixels = np.ceil(high + _RECTANGLE_MARGIN_PIXELS + 2).clip(0, ends).astype(int).tolist()
    depth = (optical_corners[:, :, 2].min(axis=1) - CLOSE).astype(np.float32)
    for row in np.flatnonzero((high > low).all(axis=1)).tolist():
        left, top = first_pixels[row]
        right, bottom = end_pixels[row]
        window = nearest[top:bottom, left:right]
        np.minimum(window, depth[row], out=window)
    return nearest


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """Rectangles of pixels (W,), each around a road user in the picture of a camera.

    Attributes:
        camera: Row of the camera, shape (W,).
        actor: Row of the road user among the rows in question, shape (W,).
        first: Column and row of the upper left pixel, shape (W, 2).
        size: Pixels across and down, shape (W, 2).
    """

    camera: IntArray
    actor: IntArray
    first: IntArray
    size: IntArray

    def select(self, mask: BoolArray) -> "_Windows":
        """Return the rectangles of a mask (W,)."""
        return _Windows(self.camera[mask], self.actor[mask], self.first[mask], self.size[mask])


class CameraViews:
    """The views of C cameras of K road users at a moment.

    Args:
        scene: The scene.
        cameras: The cameras.
        poses: Poses `ground_from_camera` of the cameras.
        rows: Rows of the road users, shape (K,).
    """

    def __init__(
        self, scene: Scene, cameras: Sequence[Camera], poses: Sequence[SE3], rows: IntArray
    ) -> None:
        matrices = np.stack([pose.matrix for pose in poses])
        self._axes = matrices[:, :3, :3]
        self._origins = matrices[:, :3, 3]
        self._slopes = np.stack([_slope(camera) for camera in cameras])
        self._scene = scene
        self._rows = rows
        offsets = scene.box_corners[rows] - self._origins[:, None, None]
        self._windows = _windows(offsets @ self._axes[:, None], self._slopes)

    def pixels(self, mask: BoolArray | None = None, *, rays_across: int = _RAYS_ACROSS) -> IntArray:
        """Count the pixels of a `WIDTH` × `HEIGHT` picture that show each road user.

        Args:
            mask: Truth values, shape (K,): the road users to count; the others have 0. None for
                all.
            rays_across: Largest number of rays to each road user, across and also down.

        Returns:
            Numbers of pixels, shape (C, K), int64; large numbers are approximate.
        """
        windows = self._windows
        if mask is not None:
            windows = windows.select(mask[windows.actor])
        pixel, window, step = _pixels(windows, rays_across)
        camera = windows.camera[window]
        tangents = (pixel + 0.5 - (WIDTH / 2, HEIGHT / 2)) * self._slopes[camera]
        right, down, ahead = np.moveaxis(self._axes, 2, 0)[:, camera]
        rays = (tangents[:, :1] * right + tangents[:, 1:] * down + ahead).astype(np.float32)
        _, face = self._scene.cast(self._origins[camera], rays)
        actor = windows.actor[window]
        hits = np.flatnonzero(self._scene.face_owner[face] == self._rows[actor])
        num_cameras = len(self._slopes)
        num_actors = len(self._rows)
        cell = camera[hits] * num_actors + actor[hits]
        pixels_a_ray = step[window[hits]] ** 2
        counts = np.bincount(cell, pixels_a_ray, minlength=num_cameras * num_actors)
        return counts.astype(np.int64).reshape(-1, num_actors)


def camera_visible(scene: Scene, agent: Agent, ground_from_lidar: SE3, rows: IntArray) -> BoolArray:
    """Return which actors of `rows` (K,) have `MIN_PIXELS` pixels in any camera of an agent.

    The agent itself never has. A few rays are enough for most; all rays are cast only to the
    others.
    """
    poses = [ground_from_lidar @ camera.lidar_from_camera for camera in agent.cameras]
    views = CameraViews(scene, agent.cameras, poses, rows)
    is_other = np.ones(len(rows), dtype=bool) if agent.row is None else rows != agent.row
    visible = np.zeros(len(rows), dtype=bool)
    for rays_across in (_RAYS_ACROSS_FIRST, _RAYS_ACROSS):
        counts = views.pixels(is_other & ~visible, rays_across=rays_across)
        visible |= (counts >= MIN_PIXELS).any(axis=0)
    return visible


def _slope(camera: Camera) -> FloatArray:
    """Return the slope of one pixel of the `WIDTH` × `HEIGHT` picture, across and down, (2,)."""
    optics = camera.optics
    pixel_size = np.array([optics.width / WIDTH, optics.height / HEIGHT])
    return np.asarray(pixel_size / optics.intrinsic[0, 0])


def _windows(corners: FloatArray, slopes: FloatArray) -> _Windows:
    """Return the pixels that boxes may cover.

    Args:
        corners: Corners of the boxes in C optical frames, shape (C, K, 8, 3), metres.
        slopes: Slopes of a pixel, shape (C, 2).
    """
    count = corners.shape[1]
    all_slopes = np.repeat(slopes, count, axis=0)
    low, high = rectangles(corners.reshape(-1, 8, 3), all_slopes, (WIDTH, HEIGHT))
    first = np.floor(low).clip(0, (WIDTH, HEIGHT)).astype(np.int64)
    size = np.ceil(high).clip(0, (WIDTH, HEIGHT)).astype(np.int64) - first
    rows = np.flatnonzero((size > 0).all(axis=1))
    camera, actor = np.divmod(rows, max(count, 1))
    return _Windows(camera, actor, first[rows], size[rows])


def _pixels(windows: _Windows, rays_across: int) -> tuple[IntArray, IntArray, IntArray]:
    """Choose evenly spaced pixels of windows.

    Returns:
        Columns and rows of the pixels (N, 2); the window (N,) of each; and the distance of pixels
        in each window (W,).
    """
    step = -(-windows.size.max(axis=1, initial=1) // rays_across)
    across, down = (-(-windows.size // step[:, None])).T
    counts = across * down
    window = np.repeat(np.arange(len(counts)), counts)
    starts = np.cumsum(counts) - counts
    number = np.arange(len(window)) - np.repeat(starts, counts)
    cell = np.stack(np.divmod(number, across[window])[::-1], axis=1)
    middle = (step - 1) // 2  # the pixel in the middle of a step's square
    pixel = windows.first[window] + cell * step[window, None] + middle[window, None]
    return pixel, window, step


def annotate(
    scene: Scene, agent: Agent, world_from_ground: SE3, scan: Scan, *, exact: bool
) -> Labels:
    """Return the labels of an agent at a moment: parked vehicles, other vehicles, pedestrians.

    Args:
        scene: The scene.
        agent: The agent.
        world_from_ground: Pose of the ground frame in the world.
        scan: Points of the agent's LiDAR; `num_lidar_pts` counts all stored points in each box.
        exact: Whether points are counted in the annotated boxes, and not in the boxes of
            `COUNT_DELAY_S` later.
    """
    ground_from_lidar = agent.ground_from_lidar(scene)
    center, forward, velocity = _kinematics(scene)
    distance = np.hypot(*(center[:, :2] - ground_from_lidar.translation[:2]).T)
    rows = _label_order(scene, distance <= LABEL_RANGE)
    actor_id = np.where(distance > TRACKING_RANGE, UNTRACKED_ID, scene.actors.actor_id)
    lidar_from_ground = ground_from_lidar.inverse()
    lidar_center = lidar_from_ground.apply(center)
    lidar_velocity = lidar_from_ground.rotate(velocity)
    lidar_yaw = _lidar_yaw(forward, lidar_from_ground)
    world_velocity = world_from_ground.rotate(velocity)[:, :2]
    agent_velocity = np.zeros((1, 2))
    if agent.row is not None:
        actor_id[agent.row] = OWN_ACTOR_ID
        agent_velocity[0] = world_velocity[agent.row]
        lidar_yaw[agent.row] = 0.0
        lidar_velocity[agent.row] = 0.0
    size = scene.actors.size[rows]
    offset = np.zeros((len(rows), 3)) if exact else offsets_at_count(lidar_velocity[rows])
    count_center = lidar_center[rows] + offset
    count_boxes = Boxes.from_arrays(count_center, size, lidar_yaw[rows], frame="lidar")
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
        num_lidar_pts=count_boxes.count_points(scan.xyz),
        camera_visible=camera_visible(scene, agent, ground_from_lidar, rows),
    )


def offsets_at_count(velocity: FloatArray) -> FloatArray:
    """Return the offsets (N, 3), metres, of actors at the moment when points are counted.

    Their velocities are (N, 3), m/s.
    """
    offset = COUNT_DELAY_S * velocity
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    factor = np.minimum(1.0, MAX_COUNT_OFFSET_M / np.maximum(length, 1e-9))
    return np.asarray(offset * factor)


def _label_order(scene: Scene, mask: BoolArray) -> IntArray:
    """Return the rows of the actors of a mask (A,) in the order of label lines.

    The order is the same for all agents and frames, and not by ids.
    """
    actors = scene.actors
    parked = np.isin(np.arange(len(actors)), scene.setting.parked)
    order = np.lexsort([actors.object_id, actors.category == _PEDESTRIAN, ~parked])
    return np.asarray(order[mask[order]])


def _kinematics(scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the kinematics of all boxes, ground frame.

    Returns:
        Centres (A, 3), metres, forward unit vectors (A, 3) and velocities (A, 3) along the ground,
        m/s.
    """
    forward = scene.frames[:, :3, 0]
    up = scene.frames[:, :3, 2]
    center = scene.frames[:, :3, 3] + up * (BOX_CLEARANCE + scene.actors.size[:, 2:] / 2)
    level_velocity = scene.snapshot.velocities
    climb = -(level_velocity * up[:, :2]).sum(axis=1) / up[:, 2]
    return center, forward, np.column_stack([level_velocity, climb])


def _lidar_yaw(forward: FloatArray, lidar_from_ground: SE3) -> FloatArray:
    """Return the yaw (A,) of forward vectors (A, 3) in the LiDAR frame, in (−π, π]."""
    lidar_forward = lidar_from_ground.rotate(forward)
    return np.asarray(np.arctan2(lidar_forward[:, 1], lidar_forward[:, 0]))
