"""Which road users an agent's cameras see: by the pixels that are theirs, in pictures of a size of its own.

What is seen depends neither on the size of the images nor on whether any are made: every road user is looked at with
rays of one grid, a pixel of `WIDTH` × `HEIGHT` each, thinned out where it fills much of the picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray, FloatArray, IntArray
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.synth.sensors.agents import Agent, Camera
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.synth.sensors.windows import rectangles

WIDTH, HEIGHT = 400, 225
"""Pixels of the pictures that visibility is decided on: a sixteenth of the real ones'."""
LEAST_PIXELS = 2
"""As many of its pixels make a road user visible."""
_RAYS_ACROSS, _FEW_ACROSS = 14, 4
"""Rays to a road user, across and down, at most, and at the first look."""


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """Rectangles of pixels (W,), each around a road user in the picture of a camera.

    Attributes:
        camera: row of the camera.
        actor: which road user, of those that are looked at.
        first: (W, 2) column and row of the upper left pixel.
        size: (W, 2) pixels across and down.
    """

    camera: IntArray
    actor: IntArray
    first: IntArray
    size: IntArray

    def select(self, rows: BoolArray) -> "_Windows":
        """Some of them, (W,)."""
        return _Windows(self.camera[rows], self.actor[rows], self.first[rows], self.size[rows])


class Views:
    """What cameras might see of some road users at a moment.

    Args:
        scene: the moment.
        cameras: C of them.
        poses: of these, `ground_from_camera`.
        rows: of the road users, (K,).
    """

    def __init__(self, scene: Scene, cameras: Sequence[Camera], poses: Sequence[SE3], rows: IntArray) -> None:
        matrices = np.stack([pose.matrix for pose in poses])
        self._axes, self._origins = matrices[:, :3, :3], matrices[:, :3, 3]
        self._slopes = np.stack([_slope(camera) for camera in cameras])
        self._scene, self._rows = scene, rows
        corners = (scene.box_corners[rows] - self._origins[:, None, None]) @ self._axes[:, None]
        self._windows = _windows(corners, self._slopes)

    def pixels(self, wanted: BoolArray | None = None, *, rays_across: int = _RAYS_ACROSS) -> IntArray:
        """How many pixels of a `WIDTH` × `HEIGHT` picture the road users have; about as many where they are many.

        Args:
            wanted: (K,) which of them; None for all. Of the others it is 0.
            rays_across: how many rays each is looked at with at most, across and down.

        Returns:
            (C, K) int64.
        """
        windows = self._windows if wanted is None else self._windows.select(wanted[self._windows.actor])
        pixel, window, step = _pixels(windows, rays_across)
        camera = windows.camera[window]
        aside = (pixel + 0.5 - (WIDTH / 2, HEIGHT / 2)) * self._slopes[camera]
        right, down, ahead = np.moveaxis(self._axes, 2, 0)[:, camera]
        rays = (aside[:, :1] * right + aside[:, 1:] * down + ahead).astype(np.float32)
        _, face = self._scene.cast(self._origins[camera], rays)
        met = np.flatnonzero(self._scene.face_owner[face] == self._rows[windows.actor[window]])
        place = camera[met] * len(self._rows) + windows.actor[window[met]]
        count = len(self._slopes) * len(self._rows)
        return np.bincount(place, step[window[met]] ** 2, minlength=count).astype(np.int64).reshape(-1, len(self._rows))


def camera_visible(scene: Scene, agent: Agent, ground_from_lidar: SE3, rows: IntArray) -> BoolArray:
    """Which actors of `rows` (K,) some camera of the agent has `LEAST_PIXELS` pixels of; never the agent itself.

    Most are seen with a few rays already; only those who are not are looked at with all.
    """
    poses = [ground_from_lidar @ camera.lidar_from_camera for camera in agent.cameras]
    views = Views(scene, agent.cameras, poses, rows)
    others = np.ones(len(rows), dtype=bool) if agent.row is None else rows != agent.row
    seen = np.zeros(len(rows), dtype=bool)
    for rays_across in (_FEW_ACROSS, _RAYS_ACROSS):
        seen |= (views.pixels(others & ~seen, rays_across=rays_across) >= LEAST_PIXELS).any(axis=0)
    return seen


def _slope(camera: Camera) -> FloatArray:
    """Of one pixel of the `WIDTH` × `HEIGHT` picture, across and down, (2,)."""
    optics = camera.optics
    return np.asarray(np.array([optics.width / WIDTH, optics.height / HEIGHT]) / optics.intrinsic[0, 0])


def _windows(corners: FloatArray, slopes: FloatArray) -> _Windows:
    """The pixels that boxes (C, K, 8, 3) in the optical frames of C cameras may cover; `slopes` (C, 2) of a pixel."""
    count = corners.shape[1]
    low, high = rectangles(corners.reshape(-1, 8, 3), np.repeat(slopes, count, axis=0), (WIDTH, HEIGHT))
    first = np.floor(low).clip(0, (WIDTH, HEIGHT)).astype(np.int64)
    size = np.ceil(high).clip(0, (WIDTH, HEIGHT)).astype(np.int64) - first
    rows = np.flatnonzero((size > 0).all(axis=1))
    camera, actor = np.divmod(rows, max(count, 1))
    return _Windows(camera, actor, first[rows], size[rows])


def _pixels(windows: _Windows, rays_across: int) -> tuple[IntArray, IntArray, IntArray]:
    """Pixels (N, 2), column and row; the window (N,) of each; and how far apart they are in each window (W,)."""
    step = -(-windows.size.max(axis=1, initial=1) // rays_across)
    across, down = (-(-windows.size // step[:, None])).T
    counts = across * down
    window = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(window)) - np.repeat(np.cumsum(counts) - counts, counts)
    place = np.stack(np.divmod(within, across[window])[::-1], axis=1)
    middle = (step - 1) // 2  # the pixel in the middle of a step's square
    return windows.first[window] + place * step[window, None] + middle[window, None], window, step
