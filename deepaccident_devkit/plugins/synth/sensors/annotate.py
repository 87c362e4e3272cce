"""The labels of an agent for a scene, and the road users that its cameras see.

The result depends neither on the size of the images nor on whether images are made. Rays are cast
through the pixels of a `WIDTH` × `HEIGHT` picture that may show a road user; if it fills much of
the picture, through only some of them.
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
"""Distance ahead of the camera from which on corners are projected, metres."""
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
# Largest number of rays to a road user, across and also down; and the same in the first attempt.
_RAYS_ACROSS = 14
_RAYS_ACROSS_FIRST = 4
LABEL_RANGE = 120.0
"""Range of annotations: distance over the ground from the LiDAR to the box's centre, metres."""
TRACKING_RANGE = 115.0
"""Distance up to which actors have an id, metres."""
# Time from the point cloud to the moment of the boxes in which its points are counted. By then,
# other actors have moved on.
COUNT_DELAY_S = 0.003
# Largest distance that the actors have moved on. More would be too wrong for a fast actor with only
# its back in view.
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
    is_ahead = depth >= CLOSE
    low, high = _find_extents(_compute_slopes(corners), is_ahead)
    partly_ahead = (depth.min(axis=1) < CLOSE) & (depth.max(axis=1) > CLOSE)
    rows = np.flatnonzero(partly_ahead)
    if len(rows):
        cuts, is_cut = _cut_edges(corners[rows])
        points = np.concatenate([corners[rows], cuts], axis=1)
        is_counted = np.concatenate([is_ahead[rows], is_cut], axis=1)
        low[rows], high[rows] = _find_extents(_compute_slopes(points), is_counted)
    middle = np.array(size) / 2
    return low / slope + middle, high / slope + middle


def _compute_slopes(points: FloatArray) -> FloatArray:
    """Return the slopes to the right and down of the rays to points (…, 3) in the optical frame.

    Points nearer than `CLOSE` count as that far ahead.
    """
    depth = np.maximum(points[..., 2:], CLOSE)
    slopes: FloatArray = points[..., :2] / depth
    return slopes


def _find_extents(points: FloatArray, is_counted: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the smallest and largest coordinates of counted points.

    Args:
        points: Points, shape (A, K, 2).
        is_counted: Whether each point is counted, shape (A, K), bool.

    Returns:
        Coordinates (A, 2) each; 0 if no point is counted.
    """
    low = np.where(is_counted[..., None], points, np.inf).min(axis=1)
    high = np.where(is_counted[..., None], points, -np.inf).max(axis=1)
    is_empty = ~is_counted.any(axis=1)
    low[is_empty] = 0
    high[is_empty] = 0
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
    is_cut = (start_depth < CLOSE) != (end_depth < CLOSE)
    depth_change = np.where(is_cut, end_depth - start_depth, 1.0)
    share = (CLOSE - start_depth) / depth_change
    cuts = starts + share[..., None] * (ends - starts)
    cuts[..., 2] = CLOSE
    return cuts, is_cut


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
    size = (optics.width + 2, optics.height + 2)
    nearest = np.full(size[::-1], np.inf, dtype=np.float32)
    first_pixels = np.floor(low - _RECTANGLE_MARGIN_PIXELS).clip(0, size).astype(int).tolist()
    end_pixels = np.ceil(high + _RECTANGLE_MARGIN_PIXELS + 2).clip(0, size).astype(int).tolist()
    min_depth = optical_corners[:, :, 2].min(axis=1) - CLOSE
    depth = min_depth.astype(np.float32)
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
        actor: Index of the road user in `CameraViews`' rows, shape (W,).
        first: Column and row of the upper left pixel, shape (W, 2).
        size: Pixels across and down, shape (W, 2).
    """

    camera: IntArray
    actor: IntArray
    first: IntArray
    size: IntArray

    def select(self, mask: BoolArray) -> "_Windows":
        """Return the rectangles of a mask (W,)."""
        columns = [getattr(self, name)[mask] for name in _Windows.__slots__]
        return _Windows(*columns)


class CameraViews:
    """The views that C cameras have of K road users at a moment.

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
        self._slopes = np.stack([_compute_pixel_slope(camera) for camera in cameras])
        self._scene = scene
        self._rows = rows
        offsets = scene.box_corners[rows] - self._origins[:, None, None]
        self._windows = _find_windows(offsets @ self._axes[:, None], self._slopes)

    def pixels(self, mask: BoolArray | None = None, *, rays_across: int = _RAYS_ACROSS) -> IntArray:
        """Count the pixels of a `WIDTH` × `HEIGHT` picture that show each road user.

        Args:
            mask: Which road users to count, shape (K,), bool; the others get 0. None for all.
            rays_across: Largest number of rays to each road user, across and also down.

        Returns:
            Numbers of pixels, shape (C, K), int64; large numbers are approximate.
        """
        windows = self._windows
        if mask is not None:
            windows = windows.select(mask[windows.actor])
        pixel, window, step = _choose_pixels(windows, rays_across)
        camera = windows.camera[window]
        from_middle = pixel + 0.5 - (WIDTH / 2, HEIGHT / 2)
        slopes = from_middle * self._slopes[camera]
        right, down, ahead = np.moveaxis(self._axes, 2, 0)[:, camera]
        rays = (slopes[:, :1] * right + slopes[:, 1:] * down + ahead).astype(np.float32)
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

    The result is False for the agent itself. For most actors a few rays decide; all rays are cast
    only for the others.
    """
    poses = [ground_from_lidar @ camera.lidar_from_camera for camera in agent.cameras]
    views = CameraViews(scene, agent.cameras, poses, rows)
    is_other = np.ones(len(rows), dtype=bool)
    if agent.row is not None:
        is_other = rows != agent.row
    is_visible = np.zeros(len(rows), dtype=bool)
    for rays_across in (_RAYS_ACROSS_FIRST, _RAYS_ACROSS):
        counts = views.pixels(is_other & ~is_visible, rays_across=rays_across)
        is_visible |= (counts >= MIN_PIXELS).any(axis=0)
    return is_visible


def _compute_pixel_slope(camera: Camera) -> FloatArray:
    """Return the slope of one pixel of the `WIDTH` × `HEIGHT` picture, across and down, (2,)."""
    optics = camera.optics
    pixel_size = np.array([optics.width / WIDTH, optics.height / HEIGHT])
    return np.asarray(pixel_size / optics.intrinsic[0, 0])


def _find_windows(corners: FloatArray, slopes: FloatArray) -> _Windows:
    """Return the windows of pixels that boxes may cover.

    Args:
        corners: Corners of the boxes in C optical frames, shape (C, K, 8, 3), metres.
        slopes: Slopes of a pixel, shape (C, 2).
    """
    num_actors = corners.shape[1]
    all_slopes = np.repeat(slopes, num_actors, axis=0)
    picture_size = (WIDTH, HEIGHT)
    low, high = rectangles(corners.reshape(-1, 8, 3), all_slopes, picture_size)
    first = np.floor(low).clip(0, picture_size).astype(np.int64)
    end = np.ceil(high).clip(0, picture_size).astype(np.int64)
    size = end - first
    rows = np.flatnonzero((size > 0).all(axis=1))
    camera, actor = np.divmod(rows, max(num_actors, 1))
    return _Windows(camera, actor, first[rows], size[rows])


def _choose_pixels(windows: _Windows, rays_across: int) -> tuple[IntArray, IntArray, IntArray]:
    """Choose evenly spaced pixels of windows.

    Args:
        windows: The windows.
        rays_across: Largest number of pixels of each window, across and also down.

    Returns:
        Columns and rows of the pixels (N, 2); the window (N,) of each; and the distance of pixels
        in each window (W,).
    """
    longest_side = windows.size.max(axis=1, initial=1)
    step = -(-longest_side // rays_across)  # rounded up
    across, down = (-(-windows.size // step[:, None])).T
    counts = across * down
    window = np.repeat(np.arange(len(counts)), counts)
    starts = np.cumsum(counts) - counts
    number = np.arange(len(window)) - np.repeat(starts, counts)
    row, column = np.divmod(number, across[window])
    cell = np.stack([column, row], axis=1)
    middle = (step - 1) // 2  # the pixel in the middle of a step's square
    pixel = windows.first[window] + cell * step[window, None] + middle[window, None]
    return pixel, window, step


def annotate(
    scene: Scene, agent: Agent, world_from_ground: SE3, scan: Scan, *, exact: bool
) -> Labels:
    """Label what an agent perceives at a moment: parked vehicles, other vehicles, pedestrians.

    Args:
        scene: The scene.
        agent: The agent.
        world_from_ground: Pose of the ground frame in the world.
        scan: Points of the agent's LiDAR; `num_lidar_pts` counts all stored points in each box.
        exact: Whether points are counted in the annotated boxes, and not in the boxes of
            `COUNT_DELAY_S` later.
    """
    ground_from_lidar = agent.ground_from_lidar(scene)
    center, forward, velocity = _compute_kinematics(scene)
    offsets = center[:, :2] - ground_from_lidar.translation[:2]
    distance = np.hypot(offsets[:, 0], offsets[:, 1])
    rows = _order_labels(scene, distance <= LABEL_RANGE)
    actor_id = np.where(distance > TRACKING_RANGE, UNTRACKED_ID, scene.actors.actor_id)
    lidar_from_ground = ground_from_lidar.inverse()
    lidar_center = lidar_from_ground.apply(center)
    lidar_velocity = lidar_from_ground.rotate(velocity)
    lidar_forward = lidar_from_ground.rotate(forward)
    lidar_yaw = np.arctan2(lidar_forward[:, 1], lidar_forward[:, 0])
    world_velocity = world_from_ground.rotate(velocity)[:, :2]
    agent_velocity = np.zeros((1, 2))
    if agent.row is not None:
        actor_id[agent.row] = OWN_ACTOR_ID
        agent_velocity[0] = world_velocity[agent.row]
        lidar_yaw[agent.row] = 0.0
        lidar_velocity[agent.row] = 0.0
    size = scene.actors.size[rows]
    count_center = lidar_center[rows]
    if not exact:
        count_center = count_center + offsets_at_count(lidar_velocity[rows])
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
    """Return how far actors have moved on when points are counted, shape (N, 3), metres.

    Args:
        velocity: Velocities of the actors, shape (N, 3), m/s.
    """
    offset = COUNT_DELAY_S * velocity
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    factor = np.minimum(1.0, MAX_COUNT_OFFSET_M / np.maximum(length, 1e-9))
    return np.asarray(offset * factor)


def _order_labels(scene: Scene, is_labelled: BoolArray) -> IntArray:
    """Return the rows of labelled actors, in the order of label lines.

    The order is the same for all agents and frames, and not by ids.

    Args:
        scene: The scene.
        is_labelled: Whether each actor is labelled, shape (A,), bool.
    """
    actors = scene.actors
    is_parked = np.isin(np.arange(len(actors)), scene.setting.parked)
    is_pedestrian = actors.category == _PEDESTRIAN
    order = np.lexsort([actors.object_id, is_pedestrian, ~is_parked])
    return np.asarray(order[is_labelled[order]])


def _compute_kinematics(scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the kinematics of all boxes, ground frame.

    Returns:
        Centres (A, 3), metres, forward unit vectors (A, 3) and velocities (A, 3) along the ground,
        m/s.
    """
    forward = scene.frames[:, :3, 0]
    up = scene.frames[:, :3, 2]
    foot = scene.frames[:, :3, 3]
    center_height = BOX_CLEARANCE + scene.actors.size[:, 2:] / 2
    level_velocity = scene.snapshot.velocities
    climb = -(level_velocity * up[:, :2]).sum(axis=1) / up[:, 2]
    velocity = np.column_stack([level_velocity, climb])
    return foot + up * center_height, forward, velocity
