"""Colours of surfaces in the light of a scenario, and the windows on façades."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.plugins.synth.sensors.caster import NO_HIT
from deepaccident_devkit.plugins.synth.sensors.light import Light
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting, Surfaces
from deepaccident_devkit.plugins.synth.shapes import LAMP, TAIL
from deepaccident_devkit.plugins.synth.solids import FACES_A_SOLID, GLASS, Color
from deepaccident_devkit.plugins.synth.world import LANTERN_COLOR, STOREY
from deepaccident_devkit.support.arrays import (
    BoolArray,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
)

# Share of the sky's light that glass mirrors.
_MIRRORED_SHARE = 0.5
_HEADLIGHT_COLOR: Color = (255, 250, 226)
_TAILLIGHT_COLOR: Color = (255, 40, 30)
_LANTERN_LIGHT_COLOR: Color = (255, 232, 190)
# Value of `Light.lamps` from which on vehicles have their lamps on; in hard rain they have them on
# by day too.
_MIN_LAMPS = 0.2
# Distance above a body to the point that decides whether the body is in the sun.
_SUN_POINT_HEIGHT_M = 0.05
# If the colours of a wall and its windows differ by less than the first number, windows are
# darkened by the second.
_MIN_WINDOW_CONTRAST = 32.0
_WINDOW_DARKENING = 0.65
# Kinds of faces: faces with windows, and faces that shine themselves.
FACADE, SHINES = 1, 2
# Approximate distance between columns of windows: each façade has a whole number of columns.
_BAY_WIDTH_M = 2.6
# Start and end of a window, as shares of its column and of its storey.
_BAY_SPAN, _STOREY_SPAN = (0.25, 0.75), (0.32, 0.8)
# Distance from a façade's lower edge, which is in the ground, to its lowest storey.
_FLOOR_HEIGHT_M = 0.6
_LIT_WINDOW_COLOR = (236, 206, 132)
_NUM_LIT_OF_FIVE = 2


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """Colours of faces, RGB 0 to 255, shape (F, 3), float64, in the light and before haze.

    Attributes:
        wall: Colours of the faces.
        shaded: Colours of the faces where they are in a shadow.
        window: Colours of the windows on them.
        shining: Colours of their own light; 0 if they do not shine.
        facade: Truth values, shape (F,): whether they carry windows.
    """

    wall: FloatArray
    shaded: FloatArray
    window: FloatArray
    shining: FloatArray
    facade: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Colors:
    """Colours of all faces of a moment, and of `GROUND` and `NO_HIT`, as tables for quick look-ups.

    They are as in `Palette`. Tables of shape (F + 2,), uint32, are painted: red, green, blue and
    kind (`FACADE`, `SHINES` or 0), one byte each.

    Attributes:
        wall: Colours of the faces, shape (F + 2,), uint32.
        shaded: Colours in a shadow, shape (F + 2,), uint32; the kind is 0.
        window: Colours of windows, shape (F + 2,), uint32; the kind is `SHINES`, because the light
            of lamps does not show on glass.
        shining: Colours of their own light, shape (F + 2, 3), uint8.
    """

    wall: NDArray[np.uint32]
    shaded: NDArray[np.uint32]
    window: NDArray[np.uint32]
    shining: NDArray[np.uint8]


def static_palette(setting: Setting, light: Light) -> Palette:
    """Return the colours of the static world.

    It has things, lanterns that shine at night, and parked vehicles without lights. Walls of houses
    have their colours in the sun here, even if they are in a shadow.
    """
    corners = setting.static.corners
    tops = corners.mean(axis=1)
    tops[:, 2] = corners[:, :, 2].max(axis=1) + _SUN_POINT_HEIGHT_M
    shining = {LANTERN_COLOR: _LANTERN_LIGHT_COLOR} if light.lamps > _MIN_LAMPS else {}
    in_sun = setting.static.solids.facade | _in_sun(setting, tops, light)
    return _palette(setting.static, light, in_sun, shining)


def moving_palette(scene: Scene, light: Light) -> Palette:
    """Return the colours of moving road users.

    A road user in the shadow of a thing is completely in the shadow.
    """
    heights = scene.actors.size[:, 2:] + _SUN_POINT_HEIGHT_M
    tops = scene.frames[:, :3, 3] + (0, 0, 1.0) * heights
    in_sun = _in_sun(scene.setting, tops, light)[scene.movers.owner]
    shining: dict[Color, Color] = {}
    if light.lamps > _MIN_LAMPS or light.rain > 0.5:
        shining = {LAMP: _HEADLIGHT_COLOR, TAIL: _TAILLIGHT_COLOR}
    return _palette(scene.movers, light, in_sun, shining)


def packed(static: Palette, moving: Palette, lamps: Mapping[int, Color]) -> Colors:
    """Pack all colours of a moment, each sort in one table.

    Args:
        static: Colours of the static world.
        moving: Colours of moving road users.
        lamps: Colour of the light of static solids, by row.
    """
    wall = _joined(static.wall, moving.wall)
    shaded = _joined(static.shaded, moving.shaded)
    window = _joined(static.window, moving.window)
    shining = _joined(static.shining, moving.shining)
    for row, color in lamps.items():
        shining[row * FACES_A_SOLID : (row + 1) * FACES_A_SOLID] = color
    kind = np.concatenate([static.facade, moving.facade, [False, False]]).astype(np.uint8)
    shines: BoolArray = np.asarray(shining.any(axis=1))
    kind[shines] = SHINES
    own_light_or_wall = np.where(shines[:, None], shining, wall)
    return Colors(
        _paints(own_light_or_wall, kind), _paints(shaded), _paints(window, SHINES), shining
    )


def _joined(static: FloatArray, moving: FloatArray) -> NDArray[np.uint8]:
    """Join colours (F, 3), with black for `GROUND` and `NO_HIT`."""
    colors = np.concatenate([static, moving, np.zeros((2, 3))])
    return colors.clip(0, 255).astype(np.uint8)


def _paints(colors: ByteArray, kind: ByteArray | int = 0) -> NDArray[np.uint32]:
    """Pack colours (F, 3) and their kinds into (F,) uint32."""
    table = np.empty((len(colors), 4), dtype=np.uint8)
    table[:, :3] = colors
    table[:, 3] = kind
    return table.view(np.uint32)[:, 0]


def is_facade(surfaces: Surfaces) -> BoolArray:
    """Return which faces (F,) carry windows."""
    normals, _ = surfaces.planes
    upright = np.abs(normals[:, 2]) < 0.5
    return np.asarray(np.repeat(surfaces.solids.facade, FACES_A_SOLID) & upright)


def _in_sun(setting: Setting, points: FloatArray, light: Light) -> BoolArray:
    """Return which points (N, 3) are in the sun: not in the shadow of the static world."""
    ray = light.to_sun[None]
    in_sun = []
    for point in points:
        _, face = setting.caster.cast(point, ray)
        in_sun.append(face[0] == NO_HIT)
    return np.array(in_sun, dtype=bool)


def _palette(
    surfaces: Surfaces, light: Light, in_sun: BoolArray, shining: Mapping[Color, Color]
) -> Palette:
    """Return the colours of surfaces.

    Args:
        surfaces: The surfaces.
        light: The light.
        in_sun: Truth values, shape (P,): whether each solid is in the sun.
        shining: Colour of the light of lamps, by the lamp's own colour.
    """
    normals, _ = surfaces.planes
    colors = surfaces.colors
    upward = normals[:, 2:]
    sun_share = np.maximum(normals @ light.to_sun, 0.0) * np.repeat(in_sun, FACES_A_SOLID)
    shaded = colors * (light.sky * (0.8 + 0.2 * upward))
    lit = shaded + colors * light.sun * sun_share[:, None]
    overhead = np.maximum(upward, 0.0)
    mirrored = _MIRRORED_SHARE * (light.horizon * (1 - overhead) + light.zenith * overhead)
    is_glass = (colors == GLASS).all(axis=1)
    pane = np.array(GLASS) * light.sky * 0.6
    lit[is_glass] = (pane + mirrored)[is_glass]
    window = pane + 0.8 * mirrored
    contrast = np.abs(window - lit).max(axis=1)
    window[contrast < _MIN_WINDOW_CONTRAST] *= _WINDOW_DARKENING
    return Palette(
        wall=lit,
        shaded=shaded,
        window=window,
        shining=_shining(colors, shining),
        facade=is_facade(surfaces),
    )


def _shining(colors: FloatArray, lights: Mapping[Color, Color]) -> FloatArray:
    """Return the light of the lamps among faces.

    Args:
        colors: Colours of the faces, shape (F, 3).
        lights: Colour of the light of lamps, by the lamp's own colour.
    """
    shining = np.zeros_like(colors)
    for lamp, color in lights.items():
        shining[(colors == lamp).all(axis=1)] = color
    return shining


@dataclass(frozen=True, slots=True, eq=False)
class Facades:
    """The façades among F faces; they are parallel to an axis, so x + y grows along them.

    Attributes:
        start: x + y at the start of each, shape (F,), float32, metres; 0 for other faces.
        length: Lengths, shape (F,), float32, metres.
        foot: Height of the lower edge above the ground frame's origin, shape (F,), float32, metres.
    """

    start: Float32Array
    length: Float32Array
    foot: Float32Array


class OnFacades(NamedTuple):
    """The N pixels of a picture that show façades.

    Attributes:
        pixel: Rows of the pixels, of R · C, shape (N,).
        face: Faces that they show, shape (N,).
        across: Distances along the façade from its start, shape (N,), metres.
        up: Heights above its lower edge, shape (N,), metres.
    """

    pixel: IntArray
    face: IntArray
    across: Float32Array
    up: Float32Array


def facades_of(surfaces: Surfaces) -> Facades:
    """Return the façades among the faces of the static world."""
    along = surfaces.quads[..., :2].sum(axis=2)
    height = surfaces.quads[..., 2]
    start = along.min(axis=1)
    foot = height.min(axis=1)
    length = along.max(axis=1) - start
    mask: BoolArray = is_facade(surfaces)
    columns: list[FloatArray] = [start, length, foot]
    return Facades(*(np.where(mask, column, 0).astype(np.float32) for column in columns))


def on_facades(
    mask: BoolArray,
    face: IntArray,
    xyz: tuple[Float32Array, Float32Array, Float32Array],
    facades: Facades,
) -> OnFacades:
    """Return the façade of each pixel that shows one, and the position on it.

    Args:
        mask: Truth values, shape (R, C): whether a pixel shows a façade.
        face: Faces of the pixels, shape (R, C).
        xyz: Coordinates of the points in the pixels, (R, C) each, metres.
        facades: The façades.
    """
    x, y, z = xyz
    pixel = np.flatnonzero(mask)
    pixel_face = face.take(pixel)
    across = x.take(pixel) + y.take(pixel) - facades.start.take(pixel_face)
    up = z.take(pixel) - facades.foot.take(pixel_face)
    return OnFacades(pixel, pixel_face, across, up)


def windows_on(
    painted: NDArray[np.uint32], pixels: OnFacades, facades: Facades, colors: Colors, *, lit: bool
) -> None:
    """Paint windows on façades into a picture, in place.

    Args:
        painted: Picture as in `Colors`, shape (R, C).
        pixels: Pixels of the picture that show façades.
        facades: The façades.
        colors: Colours of the moment.
        lit: Whether two of five windows shine.
    """
    if not len(pixels.pixel):
        return
    length = facades.length
    num_bays = np.maximum(np.rint(length * np.float32(1 / _BAY_WIDTH_M)), 1)
    density = num_bays / np.maximum(length, 1)
    bays = pixels.across * density.take(pixels.face)
    storeys = (pixels.up - np.float32(_FLOOR_HEIGHT_M)) * np.float32(1 / STOREY)
    bay = np.floor(bays)
    storey = np.floor(storeys)
    bays -= bay
    storeys -= storey
    is_pane = (bays > _BAY_SPAN[0]) & (bays < _BAY_SPAN[1]) & (storey >= 0)
    is_pane &= (storeys > _STOREY_SPAN[0]) & (storeys < _STOREY_SPAN[1])
    panes = np.flatnonzero(is_pane)
    face = pixels.face.take(panes)
    flat = painted.reshape(-1)
    flat[pixels.pixel.take(panes)] = colors.window.take(face)
    if lit:
        number = bay[panes].astype(np.int64) * 7 + storey[panes].astype(np.int64) * 13 + face
        lit_panes = panes[number % 5 < _NUM_LIT_OF_FIVE]
        lit_color = np.array([_LIT_WINDOW_COLOR], dtype=np.uint8)
        flat[pixels.pixel[lit_panes]] = _paints(lit_color, SHINES)
