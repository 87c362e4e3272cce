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

# Share of the light of the sky that glass mirrors.
_MIRRORED_SHARE = 0.5
_HEADLIGHT_COLOR: Color = (255, 250, 226)
_TAILLIGHT_COLOR: Color = (255, 40, 30)
_LANTERN_LIGHT_COLOR: Color = (255, 232, 190)
# Smallest value of `Light.lamps` at which vehicles have their lamps on. In hard rain they have them
# on by day too.
_MIN_LAMPS = 0.2
# Height above a body of the point that decides whether the body is in the sun.
_SUN_POINT_HEIGHT_M = 0.05
# If the colours of a wall and its windows differ by less than the first number, the colours of the
# windows are multiplied by the second.
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
        facade: Whether each face carries windows, shape (F,), bool.
    """

    wall: FloatArray
    shaded: FloatArray
    window: FloatArray
    shining: FloatArray
    facade: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Colors:
    """Colours of all faces of a moment, and of `GROUND` and `NO_HIT`, as tables for quick look-ups.

    They are as in `Palette`. The values of type uint32 are made of red, green, blue and a kind
    (`FACADE`, `SHINES` or 0), one byte each.

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


def make_static_palette(setting: Setting, light: Light) -> Palette:
    """Return the colours of the static world.

    It has things, lanterns that shine at night, and parked vehicles without lights. Walls of houses
    have their colours in the sun here, even if they are in a shadow.
    """
    corners = setting.static.corners
    tops = corners.mean(axis=1)
    tops[:, 2] = corners[:, :, 2].max(axis=1) + _SUN_POINT_HEIGHT_M
    light_by_lamp = {}
    if light.lamps > _MIN_LAMPS:
        light_by_lamp[LANTERN_COLOR] = _LANTERN_LIGHT_COLOR
    is_sunny = setting.static.solids.facade | _are_in_sun(setting, tops, light)
    return _make_palette(setting.static, light, is_sunny, light_by_lamp)


def make_moving_palette(scene: Scene, light: Light) -> Palette:
    """Return the colours of moving road users.

    A road user in the shadow of a thing is completely in the shadow.
    """
    heights = scene.actors.size[:, 2:] + _SUN_POINT_HEIGHT_M
    tops = scene.frames[:, :3, 3] + (0, 0, 1.0) * heights
    is_sunny = _are_in_sun(scene.setting, tops, light)[scene.movers.owner]
    light_by_lamp: dict[Color, Color] = {}
    if light.lamps > _MIN_LAMPS or light.rain > 0.5:
        light_by_lamp = {LAMP: _HEADLIGHT_COLOR, TAIL: _TAILLIGHT_COLOR}
    return _make_palette(scene.movers, light, is_sunny, light_by_lamp)


def pack_colors(static: Palette, moving: Palette, lamps: Mapping[int, Color]) -> Colors:
    """Pack all colours of a moment, with one table for each sort.

    Args:
        static: Colours of the static world.
        moving: Colours of moving road users.
        lamps: Colour of the light of static solids, by row.
    """
    wall = _join_colors(static.wall, moving.wall)
    shaded = _join_colors(static.shaded, moving.shaded)
    window = _join_colors(static.window, moving.window)
    shining = _join_colors(static.shining, moving.shining)
    for row, color in lamps.items():
        first_face = row * FACES_A_SOLID
        shining[first_face : first_face + FACES_A_SOLID] = color
    kind = np.concatenate([static.facade, moving.facade, [False, False]]).astype(np.uint8)
    is_shining: BoolArray = np.asarray(shining.any(axis=1))
    kind[is_shining] = SHINES
    own_light_or_wall = np.where(is_shining[:, None], shining, wall)
    return Colors(
        wall=_pack_table(own_light_or_wall, kind),
        shaded=_pack_table(shaded),
        window=_pack_table(window, SHINES),
        shining=shining,
    )


def _join_colors(static: FloatArray, moving: FloatArray) -> NDArray[np.uint8]:
    """Join colours (F, 3), with black for `GROUND` and `NO_HIT`."""
    black = np.zeros((2, 3))
    colors = np.concatenate([static, moving, black])
    return colors.clip(0, 255).astype(np.uint8)


def _pack_table(colors: ByteArray, kind: ByteArray | int = 0) -> NDArray[np.uint32]:
    """Pack colours (F, 3) and their kinds into a table (F,), uint32, as in `Colors`."""
    table = np.empty((len(colors), 4), dtype=np.uint8)
    table[:, :3] = colors
    table[:, 3] = kind
    return table.view(np.uint32)[:, 0]


def is_facade(surfaces: Surfaces) -> BoolArray:
    """Return which faces (F,) carry windows."""
    normals, _ = surfaces.planes
    is_upright = np.abs(normals[:, 2]) < 0.5
    has_facade = np.repeat(surfaces.solids.facade, FACES_A_SOLID)
    return np.asarray(has_facade & is_upright)


def _are_in_sun(setting: Setting, points: FloatArray, light: Light) -> BoolArray:
    """Return which points (N, 3) are in the sun, and not in the shadow of the static world."""
    ray = light.to_sun[None]
    is_sunny = []
    for point in points:
        _, face = setting.caster.cast(point, ray)
        is_sunny.append(face[0] == NO_HIT)
    return np.array(is_sunny, dtype=bool)


def _make_palette(
    surfaces: Surfaces, light: Light, is_sunny: BoolArray, light_by_lamp: Mapping[Color, Color]
) -> Palette:
    """Return the colours of surfaces.

    Args:
        surfaces: The surfaces.
        light: The light.
        is_sunny: Whether each solid is in the sun, shape (P,), bool.
        light_by_lamp: Colour of the light of lamps, by the lamp's own colour.
    """
    normals, _ = surfaces.planes
    colors = surfaces.colors
    upward = normals[:, 2:]
    sun_cosine = np.maximum(normals @ light.to_sun, 0.0)
    sun_share = sun_cosine * np.repeat(is_sunny, FACES_A_SOLID)
    shaded = colors * (light.sky * (0.8 + 0.2 * upward))
    wall = shaded + colors * light.sun * sun_share[:, None]
    zenith_share = np.maximum(upward, 0.0)
    sky_color = light.horizon * (1 - zenith_share) + light.zenith * zenith_share
    mirrored = _MIRRORED_SHARE * sky_color
    is_glass = (colors == GLASS).all(axis=1)
    pane = np.array(GLASS) * light.sky * 0.6
    wall[is_glass] = (pane + mirrored)[is_glass]
    window = pane + 0.8 * mirrored
    contrast = np.abs(window - wall).max(axis=1)
    window[contrast < _MIN_WINDOW_CONTRAST] *= _WINDOW_DARKENING
    shining = np.zeros_like(colors)
    for lamp, color in light_by_lamp.items():
        shining[(colors == lamp).all(axis=1)] = color
    return Palette(
        wall=wall, shaded=shaded, window=window, shining=shining, facade=is_facade(surfaces)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Facades:
    """The façades among F faces.

    Each is parallel to an axis, so that x + y grows along it.

    Attributes:
        start: x + y at the start of each façade, shape (F,), float32, metres; 0 for other faces.
        length: Lengths, shape (F,), float32, metres.
        foot: Height of the lower edge above the ground frame's origin, shape (F,), float32, metres.
    """

    start: Float32Array
    length: Float32Array
    foot: Float32Array


class FacadePixels(NamedTuple):
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


def find_facades(surfaces: Surfaces) -> Facades:
    """Return the façades among the faces of the static world."""
    along = surfaces.quads[..., :2].sum(axis=2)
    height = surfaces.quads[..., 2]
    start = along.min(axis=1)
    length = along.max(axis=1) - start
    foot = height.min(axis=1)
    columns = np.where(is_facade(surfaces), np.stack([start, length, foot]), 0)
    return Facades(*columns.astype(np.float32))


def locate_on_facades(
    mask: BoolArray,
    face: IntArray,
    xyz: tuple[Float32Array, Float32Array, Float32Array],
    facades: Facades,
) -> FacadePixels:
    """Return the façade of each pixel that shows one, and the position on it.

    Args:
        mask: Whether each pixel shows a façade, shape (R, C), bool.
        face: Faces of the pixels, shape (R, C).
        xyz: Coordinates of the points in the pixels, (R, C) each, metres.
        facades: The façades.
    """
    x, y, z = xyz
    pixel = np.flatnonzero(mask)
    pixel_face = face.take(pixel)
    along = x.take(pixel) + y.take(pixel)
    across = along - facades.start.take(pixel_face)
    up = z.take(pixel) - facades.foot.take(pixel_face)
    return FacadePixels(pixel, pixel_face, across, up)


def paint_windows(
    painted: NDArray[np.uint32],
    pixels: FacadePixels,
    facades: Facades,
    colors: Colors,
    *,
    lit: bool,
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
    num_bays = np.maximum(np.rint(facades.length * np.float32(1 / _BAY_WIDTH_M)), 1)
    bay_density = num_bays / np.maximum(facades.length, 1)
    bay_position = pixels.across * bay_density.take(pixels.face)
    storey_position = (pixels.up - np.float32(_FLOOR_HEIGHT_M)) * np.float32(1 / STOREY)
    bay = np.floor(bay_position)
    storey = np.floor(storey_position)
    bay_position -= bay
    storey_position -= storey
    is_pane = (bay_position > _BAY_SPAN[0]) & (bay_position < _BAY_SPAN[1]) & (storey >= 0)
    is_pane &= (storey_position > _STOREY_SPAN[0]) & (storey_position < _STOREY_SPAN[1])
    panes = np.flatnonzero(is_pane)
    face = pixels.face.take(panes)
    flat_painted = painted.reshape(-1)
    flat_painted[pixels.pixel.take(panes)] = colors.window.take(face)
    if lit:
        bay_number = bay[panes].astype(np.int64)
        storey_number = storey[panes].astype(np.int64)
        window_number = bay_number * 7 + storey_number * 13 + face
        lit_panes = panes[window_number % 5 < _NUM_LIT_OF_FIVE]
        lit_color = np.array([_LIT_WINDOW_COLOR], dtype=np.uint8)
        flat_painted[pixels.pixel[lit_panes]] = _pack_table(lit_color, SHINES)
