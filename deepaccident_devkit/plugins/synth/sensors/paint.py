"""Colours of surfaces in the light of a scenario, and the windows on façades."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.plugins.synth.sensors.caster import NOTHING
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
_MIRRORED = 0.5
_HEADLIGHT: Color = (255, 250, 226)
_TAILLIGHT: Color = (255, 40, 30)
_LANTERN_LIGHT: Color = (255, 232, 190)
# From this value of `Light.lamps` on, vehicles have their lamps on; in hard rain they have them on by day too.
_LAMPS_ON = 0.2
_ABOVE = 0.05
# If the colours of a wall and its windows differ by less than the first number, windows are darkened by the second.
_ALIKE, _DARKER = 32.0, 0.65
# Kinds of faces: those with windows, and those that shine themselves.
FACADE, SHINES = 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """Colours of faces (F, 3) float64, RGB 0 to 255, in the light and before haze.

    Attributes:
        wall: colours of the faces.
        shaded: colours of the faces where they are in a shadow.
        window: colours of the windows on them.
        shining: colours of their own light; 0 if they do not shine.
        facade: (F,) whether they carry windows.
    """

    wall: FloatArray
    shaded: FloatArray
    window: FloatArray
    shining: FloatArray
    facade: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Colors:
    """The same as `Palette` for all faces of a moment, and for `GROUND` and `NOTHING`, as tables for a quick look-up.

    Those of (F + 2,) uint32 are painted: red, green, blue and kind (`FACADE`, `SHINES` or 0), one byte each.

    Attributes:
        wall: (F + 2,) uint32.
        shaded: (F + 2,) uint32; the kind is 0.
        window: (F + 2,) uint32; the kind is `SHINES`, because the light of lamps does not show on glass.
        shining: (F + 2, 3) uint8.
    """

    wall: NDArray[np.uint32]
    shaded: NDArray[np.uint32]
    window: NDArray[np.uint32]
    shining: NDArray[np.uint8]


def still_palette(setting: Setting, light: Light) -> Palette:
    """The colours of what stands still: things, lanterns that shine at night, and parked vehicles without lights.

    Walls of houses have their colours in the sun here, even if they are in a shadow.
    """
    tops = setting.still.corners.mean(axis=1)
    tops[:, 2] = setting.still.corners[:, :, 2].max(axis=1) + _ABOVE
    shining = {LANTERN_COLOR: _LANTERN_LIGHT} if light.lamps > _LAMPS_ON else {}
    in_sun = setting.still.solids.facade | _in_sun(setting, tops, light)
    return _palette(setting.still, light, in_sun, shining)


def moving_palette(scene: Scene, light: Light) -> Palette:
    """The colours of moving road users; one in the shadow of a thing is wholly in the shadow."""
    heads = scene.frames[:, :3, 3] + (0, 0, 1.0) * (scene.actors.size[:, 2:] + _ABOVE)
    in_sun = _in_sun(scene.setting, heads, light)[scene.movers.owner]
    lamps_on = light.lamps > _LAMPS_ON or light.rain > 0.5
    return _palette(
        scene.movers, light, in_sun, {LAMP: _HEADLIGHT, TAIL: _TAILLIGHT} if lamps_on else {}
    )


def packed(still: Palette, moving: Palette, lamps: Mapping[int, Color]) -> Colors:
    """All colours of a moment, each kind in one table; `lamps`: row of a solid that stands still → its light."""
    wall, shaded, window, shining = (
        np.concatenate([getattr(still, name), getattr(moving, name), np.zeros((2, 3))])
        .clip(0, 255)
        .astype(np.uint8)
        for name in ("wall", "shaded", "window", "shining")
    )
    for row, color in lamps.items():
        shining[row * FACES_A_SOLID : (row + 1) * FACES_A_SOLID] = color
    kind = np.concatenate([still.facade, moving.facade, [False, False]]).astype(np.uint8)
    shines: BoolArray = np.asarray(shining.any(axis=1))
    kind[shines] = SHINES
    return Colors(
        _paints(np.where(shines[:, None], shining, wall), kind),
        _paints(shaded),
        _paints(window, SHINES),
        shining,
    )


def _paints(colors: ByteArray, kind: ByteArray | int = 0) -> NDArray[np.uint32]:
    """Colours (F, 3) and their kinds as (F,) uint32."""
    table = np.empty((len(colors), 4), dtype=np.uint8)
    table[:, :3], table[:, 3] = colors, kind
    return table.view(np.uint32)[:, 0]


def is_facade(surfaces: Surfaces) -> BoolArray:
    """Which faces (F,) carry windows."""
    upright = np.abs(surfaces.planes[0][:, 2]) < 0.5
    return np.asarray(np.repeat(surfaces.solids.facade, FACES_A_SOLID) & upright)


def _in_sun(setting: Setting, points: FloatArray, light: Light) -> BoolArray:
    """Which points (N, 3) are in the sun, (N,): not in the shadow of anything that stands still."""
    ray = light.to_sun[None]
    return np.array(
        [setting.caster.cast(point, ray)[1][0] == NOTHING for point in points], dtype=bool
    )


def _palette(
    surfaces: Surfaces, light: Light, in_sun: BoolArray, shining: Mapping[Color, Color]
) -> Palette:
    normals, _ = surfaces.planes
    colors = surfaces.colors
    upward = normals[:, 2:]
    sun = np.maximum(normals @ light.to_sun, 0.0) * np.repeat(in_sun, FACES_A_SOLID)
    shaded = colors * (light.sky * (0.8 + 0.2 * upward))
    lit = shaded + colors * light.sun * sun[:, None]
    overhead = np.maximum(upward, 0.0)
    mirrored = _MIRRORED * (light.horizon * (1 - overhead) + light.zenith * overhead)
    glass = (colors == GLASS).all(axis=1)
    pane = np.array(GLASS) * light.sky * 0.6
    lit[glass] = (pane + mirrored)[glass]
    window = pane + 0.8 * mirrored
    alike = np.abs(window - lit).max(axis=1) < _ALIKE
    window[alike] *= _DARKER
    return Palette(
        wall=lit,
        shaded=shaded,
        window=window,
        shining=_shining(colors, shining),
        facade=is_facade(surfaces),
    )


def _shining(colors: FloatArray, lights: Mapping[Color, Color]) -> FloatArray:
    """The light of the lamps among faces with colours (F, 3); `lights`: a lamp's colour → its light."""
    shining = np.zeros_like(colors)
    for lamp, color in lights.items():
        shining[(colors == lamp).all(axis=1)] = color
    return shining


# Approximate distance between columns of windows, metres: each façade has a whole number of columns.
_BAY = 2.6
# Where a window begins and ends, as shares of its column and of its storey.
_BAY_SPAN, _STOREY_SPAN = (0.25, 0.75), (0.32, 0.8)
# Metres from a façade's lower edge, which is in the ground, to its lowest storey.
_FLOOR = 0.6
_LIT = (236, 206, 132)
_LIT_OF_FIVE = 2


@dataclass(frozen=True, slots=True, eq=False)
class Facades:
    """Where the façades among F faces are; they are parallel to an axis, so x + y grows along them.

    Attributes:
        start: (F,) float32, x + y where each begins, metres; 0 for other faces.
        length: (F,) float32, metres.
        foot: (F,) float32, height of the lower edge above the ground frame's origin, metres.
    """

    start: Float32Array
    length: Float32Array
    foot: Float32Array


class OnFacades(NamedTuple):
    """The pixels of a picture that show façades.

    Attributes:
        pixel: (N,) rows of the pixels, of R · C.
        face: (N,) the faces that they show.
        across: (N,) metres along the façade from its beginning.
        up: (N,) metres above its lower edge.
    """

    pixel: IntArray
    face: IntArray
    across: Float32Array
    up: Float32Array


def facades_of(surfaces: Surfaces) -> Facades:
    """The façades among the faces of what stands still."""
    along, height = surfaces.quads[..., :2].sum(axis=2), surfaces.quads[..., 2]
    low = along.min(axis=1)
    columns: list[FloatArray] = [low, along.max(axis=1) - low, height.min(axis=1)]
    mask: BoolArray = is_facade(surfaces)
    return Facades(*(np.where(mask, column, 0).astype(np.float32) for column in columns))


def on_facades(
    shown: BoolArray,
    face: IntArray,
    xyz: tuple[Float32Array, Float32Array, Float32Array],
    facades: Facades,
) -> OnFacades:
    """The façade of each pixel (R, C) that shows one, and its place on it; `xyz` are metres of the points shown."""
    x, y, z = xyz
    pixel = np.flatnonzero(shown)
    met = face.take(pixel)
    across = x.take(pixel) + y.take(pixel) - facades.start.take(met)
    return OnFacades(pixel, met, across, z.take(pixel) - facades.foot.take(met))


def windows_on(
    painted: NDArray[np.uint32], places: OnFacades, facades: Facades, colors: Colors, *, lit: bool
) -> None:
    """Paint windows on façades into a picture (R, C), as `Colors` has them, in place; if `lit`, two of five shine."""
    if not len(places.pixel):
        return
    length = facades.length
    density = np.maximum(np.rint(length * np.float32(1 / _BAY)), 1) / np.maximum(length, 1)
    bays = places.across * density.take(places.face)
    storeys = (places.up - np.float32(_FLOOR)) * np.float32(1 / STOREY)
    bay, storey = np.floor(bays), np.floor(storeys)
    bays -= bay
    storeys -= storey
    pane = (bays > _BAY_SPAN[0]) & (bays < _BAY_SPAN[1]) & (storey >= 0)
    pane &= (storeys > _STOREY_SPAN[0]) & (storeys < _STOREY_SPAN[1])
    glass = np.flatnonzero(pane)
    face, flat = places.face.take(glass), painted.reshape(-1)
    flat[places.pixel.take(glass)] = colors.window.take(face)
    if lit:
        number = bay[glass].astype(np.int64) * 7 + storey[glass].astype(np.int64) * 13 + face
        flat[places.pixel[glass[number % 5 < _LIT_OF_FIVE]]] = _paints(
            np.array([_LIT], dtype=np.uint8), SHINES
        )
