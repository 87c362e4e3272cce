"""Lamps: the light of headlamps on the ground and on low things, and which lamps of the traffic lights shine."""

from collections.abc import Mapping

import numpy as np

from deepaccident_devkit.arrays import AnyArray, Float32Array
from deepaccident_devkit.synth.roads import MAP_EXTENT, Arm
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.synth.solids import Color
from deepaccident_devkit.synth.stage import LAMP_COLORS, LANTERN_COLOR, World
from deepaccident_devkit.taxonomy import CATEGORIES

_CELLS = 600
_CELL = 2 * MAP_EXTENT / _CELLS
_BEAM, _SPREAD = 32.0, 0.3
"""How far a beam reaches ahead of a vehicle, metres, and half its width for each metre ahead."""
_BEAM_LIGHT, _LANTERN_LIGHT, _LANTERN_REACH = 0.55, 0.22, 16.0
_WITH_LAMPS = tuple(CATEGORIES.index(name) for name in ("car", "van", "truck", "motorcycle"))


def lamplight(scene: Scene) -> Float32Array:
    """Light on the ground, (600, 600), cells of 0.5 m, row = y, column = x; 1 is as bright as noon.

    All moving vehicles have a wide beam ahead and a little light behind them; lanterns have light around them.
    """
    import cv2

    lit = np.zeros((_CELLS, _CELLS), dtype=np.float32)
    for row in scene.setting.moving[np.isin(scene.actors.category[scene.setting.moving], _WITH_LAMPS)].tolist():
        x, y, yaw = scene.snapshot.poses[row].tolist()
        _add_beam(lit, x, y, yaw, float(scene.actors.size[row, 0]) / 2)
    props = scene.setting.world.props
    for x, y in props.corners[(props.colors[:, 0] == LANTERN_COLOR).all(axis=1), :, :2].mean(axis=1).tolist():
        _add_pool(lit, x, y)
    return np.asarray(cv2.GaussianBlur(lit, (5, 5), 0))


def light_at(lit: Float32Array, x: Float32Array, y: Float32Array) -> Float32Array:
    """The light (R, C) at points `x` and `y`, (R, C) metres; 0 beyond the map."""
    import cv2

    scale, shift = np.float32(1 / _CELL), np.float32(MAP_EXTENT / _CELL - 0.5)
    return np.asarray(cv2.remap(lit, x * scale + shift, y * scale + shift, cv2.INTER_LINEAR))


def _add_beam(lit: Float32Array, x: float, y: float, yaw: float, half: float) -> None:
    rows, columns, east, north = _around(x, y, _BEAM + half)
    if not east.size:
        return
    ahead = np.cos(yaw) * east + np.sin(yaw) * north - half
    aside = np.abs(np.cos(yaw) * north - np.sin(yaw) * east)
    width = 0.9 + _SPREAD * np.maximum(ahead, 0)
    beam = np.clip(ahead / 2, 0, 1) * np.clip(1 - ahead / _BEAM, 0, 1) ** 1.5 * np.clip(1.6 - aside / width, 0, 1)
    behind = 0.12 * np.clip(1 - np.hypot(ahead + 2 * half + 1, aside) / 4, 0, 1)
    lit[rows, columns] += (_BEAM_LIGHT * beam + behind).astype(np.float32)


def _add_pool(lit: Float32Array, x: float, y: float) -> None:
    rows, columns, east, north = _around(x, y, _LANTERN_REACH)
    lit[rows, columns] += (_LANTERN_LIGHT * np.clip(1 - np.hypot(east, north) / _LANTERN_REACH, 0, 1)).astype(
        np.float32
    )


def _around(x: float, y: float, reach: float) -> tuple[slice, slice, AnyArray, AnyArray]:
    """Cells up to `reach` metres from a point: rows, columns, and how far east (1, C) and north (R, 1) they lie."""
    spans = []
    for middle in (y, x):
        first, last = ((middle + side * reach + MAP_EXTENT) / _CELL for side in (-1, 1))
        spans.append(slice(max(int(first), 0), min(max(int(last) + 1, 0), _CELLS)))
    rows, columns = spans
    north, east = (
        (np.arange(span.start, max(span.stop, span.start)) + 0.5) * _CELL - MAP_EXTENT - middle
        for span, middle in ((rows, y), (columns, x))
    )
    return rows, columns, east[None, :], north[:, None]


def lit_lamps(world: World, signals: Mapping[Arm, int]) -> dict[int, Color]:
    """Rows of the lamps among `World.props` that shine, and their colours.

    Args:
        world: where the lights stand.
        signals: arm → 0 red, 1 amber, 2 green, as in `traffic.signals`; the lights of other arms are dark.
    """
    states = {head: signals[head.arm] for head in world.signals if head.arm in signals}
    return {head.rows[state]: LAMP_COLORS[state] for head, state in states.items()}
