"""The colours of pixels, from what they show."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import BoolArray, ByteArray, Float32Array
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.synth.sensors.caster import GROUND, NOTHING
from deepaccident_devkit.synth.sensors.images.buffers import Rays
from deepaccident_devkit.synth.sensors.images.facades import Facades, on_facades, windows_on
from deepaccident_devkit.synth.sensors.images.ground import Ground
from deepaccident_devkit.synth.sensors.images.lamplight import light_at
from deepaccident_devkit.synth.sensors.images.light import Light, Sky
from deepaccident_devkit.synth.sensors.images.paint import FACADE, SHINES, Colors
from deepaccident_devkit.synth.sensors.images.shadows import WallShadows, shadows_on

_COARSER = (1.0, 4.0)
"""If a pixel spans so many metres of ground or more, its colour comes from the first, or second, coarser picture."""
_FAR = np.float32(1000.0)
_LAMP_TINT = (1.0, 0.95, 0.84)
_ON_THINGS = 0.4
"""The share of the light on the ground that upright surfaces show."""
_LAMPS_REACH = np.float32(2.5)
"""Metres above the ground up to which headlamps light things."""


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """All that gives a moment its colours.

    Attributes:
        light: light and air.
        sky: the sky.
        ground: pictures of the ground.
        facades: where there are windows.
        shadows: the shadows on façades.
        colors: the colours of all faces.
        lamplight: from `lamplight.lamplight`; None by day.
    """

    light: Light
    sky: Sky
    ground: Ground
    facades: Facades
    shadows: WallShadows
    colors: Colors
    lamplight: Float32Array | None


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Where rays (R, C) meet something, and their directions, ground frame, metres."""

    x: Float32Array
    y: Float32Array
    z: Float32Array
    east: Float32Array
    north: Float32Array
    up: Float32Array


def shade(rays: Rays, around: Surroundings, ground_from_camera: SE3) -> ByteArray:
    """The colours (R, C, 3) uint8 of what rays show."""
    import cv2

    points = _points(rays, ground_from_camera)
    packed = around.colors.wall.take(rays.face, mode="wrap")
    table = packed.view(np.uint8).reshape(*packed.shape, 4)
    picture = np.asarray(cv2.cvtColor(table, cv2.COLOR_RGBA2RGB), dtype=np.uint8)
    _add_ground(picture, rays, points, around.ground, float(ground_from_camera.translation[2]))
    kind = table[..., 3]
    places = on_facades(kind == FACADE, rays.face, (points.x, points.y, points.z), around.facades)
    shadows_on(picture, places, around.shadows, around.colors)
    if around.lamplight is not None:
        share = np.where(kind == SHINES, 0, np.where(rays.face == GROUND, 1, _ON_THINGS)).astype(np.float32)
        picture = _lamplit(picture, share, points, around)
    windows_on(picture, places, around.facades, around.colors, lit=around.light.lamps > 0.5)
    picture = _hazed(picture, rays, around.light)
    _add_sky(picture, rays.face == NOTHING, points, around.sky)
    return picture


def _points(rays: Rays, ground_from_camera: SE3) -> Points:
    axes, origin = ground_from_camera.rotation.astype(np.float32), ground_from_camera.translation.astype(np.float32)
    depth = np.minimum(rays.depth, _FAR)
    along = [rays.right * axes[k, 0] + (rays.down * axes[k, 1] + axes[k, 2]) for k in range(3)]
    x, y, z = (depth * along[k] + origin[k] for k in range(3))
    return Points(x, y, z, *along)


def _add_ground(picture: ByteArray, rays: Rays, points: Points, ground: Ground, height: float) -> None:
    """Paint the pixels that show the ground, in place, each from the picture with the matching resolution."""
    import cv2

    shown = rays.face == GROUND
    spread = float(np.abs(np.diff(rays.right[:1, :2])).max(initial=1e-3)) or 1e-3
    ends = [0.0, *(np.sqrt(span * max(height, 0.5) / max(spread, 1e-3)) for span in _COARSER), np.inf]
    for level in range(len(ground.levels)):
        mask = shown & (rays.depth >= ends[level]) & (rays.depth < ends[level + 1])
        for rows, here in _rows_of(mask):
            cv2.copyTo(ground.at(points.x[rows], points.y[rows], level), here, picture[rows])


def _add_sky(picture: ByteArray, shown: BoolArray, points: Points, sky: Sky) -> None:
    """Paint the pixels that show the sky, in place."""
    import cv2

    for rows, here in _rows_of(shown):
        cv2.copyTo(sky.toward(points.east[rows], points.north[rows], points.up[rows]), here, picture[rows])


def _rows_of(mask: BoolArray) -> list[tuple[slice, ByteArray]]:
    """One slice with all rows in which a mask (R, C) is true, and the mask of these rows; empty if it is never true."""
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return []
    span = slice(int(rows[0]), int(rows[-1]) + 1)
    return [(span, mask[span].view(np.uint8))]


def _lamplit(picture: ByteArray, share: Float32Array, points: Points, around: Surroundings) -> ByteArray:
    """The picture with the light of lamps, multiplied by `share` (R, C), where it reaches."""
    import cv2

    if around.lamplight is None:
        return picture
    gain = light_at(around.lamplight, points.x, points.y) * np.clip(_LAMPS_REACH - points.z, 0, 1)
    gain *= share
    ratio = around.light.lamps * np.array(_LAMP_TINT) / (around.light.tint * around.light.ambient)
    factors = [1 + np.float32(each) * gain for each in ratio.tolist()]
    return np.asarray(cv2.multiply(picture, cv2.merge(factors), dtype=cv2.CV_8U))


def _hazed(picture: ByteArray, rays: Rays, light: Light) -> ByteArray:
    """The picture with the haze of the air."""
    import cv2

    seen = np.minimum(rays.depth, _FAR)
    seen *= np.sqrt(1 + rays.right**2 + rays.down**2)
    seen *= np.float32(-light.haze)
    seen = np.asarray(cv2.exp(seen, seen))
    haze = np.empty_like(picture)
    haze[:] = light.horizon.astype(np.uint8)
    return np.asarray(cv2.blendLinear(picture, haze, seen, 1 - seen))
