"""Façades: where they begin and end, and rows and columns of windows on them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from deepaccident_devkit.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from deepaccident_devkit.synth.sensors.images.paint import Colors, is_facade
from deepaccident_devkit.synth.sensors.setting import Surfaces
from deepaccident_devkit.synth.stage import STOREY

_BAY = 2.6
"""Approximate distance between columns of windows, metres: each façade has a whole number of columns."""
_BAY_SPAN, _STOREY_SPAN = (0.25, 0.75), (0.32, 0.8)
"""Where a window begins and ends, as shares of its column and of its storey."""
_FLOOR = 0.6
"""Metres from a façade's lower edge, which is in the ground, to its lowest storey."""
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
    shown: BoolArray, face: IntArray, xyz: tuple[Float32Array, Float32Array, Float32Array], facades: Facades
) -> OnFacades:
    """The façade of each pixel, and its place on the façade.

    Args:
        shown: (R, C) whether pixels show a façade.
        face: (R, C) the faces that they show.
        xyz: x, y and z of the points that they show, (R, C) metres each.
        facades: where façades begin.
    """
    x, y, z = xyz
    pixel = np.flatnonzero(shown)
    met = face.reshape(-1)[pixel]
    across = x.reshape(-1)[pixel] + y.reshape(-1)[pixel] - facades.start[met]
    return OnFacades(pixel, met, across, z.reshape(-1)[pixel] - facades.foot[met])


def windows_on(picture: ByteArray, places: OnFacades, facades: Facades, colors: Colors, *, lit: bool) -> None:
    """Paint windows on façades, in place.

    Args:
        picture: (R, C, 3).
        places: the pixels that show façades.
        facades: where façades begin.
        colors: the colours of the faces.
        lit: whether two of five windows shine.
    """
    if not len(places.pixel):
        return
    length = facades.length
    density = np.maximum(np.rint(length * np.float32(1 / _BAY)), 1) / np.maximum(length, 1)
    bays = places.across * density[places.face]
    storeys = (places.up - np.float32(_FLOOR)) * np.float32(1 / STOREY)
    bay, storey = np.floor(bays), np.floor(storeys)
    in_bay, in_storey = bays - bay, storeys - storey
    pane = (in_bay > _BAY_SPAN[0]) & (in_bay < _BAY_SPAN[1])
    pane &= (in_storey > _STOREY_SPAN[0]) & (in_storey < _STOREY_SPAN[1]) & (storey >= 0)
    glass = np.flatnonzero(pane)
    flat, face = picture.reshape(-1, 3), places.face[glass]
    flat[places.pixel[glass]] = colors.window[face]
    if lit:
        number = bay[glass].astype(np.int64) * 7 + storey[glass].astype(np.int64) * 13 + face
        flat[places.pixel[glass[number % 5 < _LIT_OF_FIVE]]] = _LIT
