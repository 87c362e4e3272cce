"""What each pixel shows: rays to every second pixel, and to all pixels where neighbours show different surfaces.

The pixels between two that show the same flat face show this face too, and the inverse of its depth changes linearly.
On outlines, two rays are cast for each pixel, and its colour is their mean.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import AnyArray, Float32Array, IntArray
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.synth.sensors.agents import Camera
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.synth.sensors.visibility import nearest_movers

_SUBPIXELS = ((-0.25, -0.25), (0.25, 0.25))
"""Offsets of the rays of a pixel on an outline, pixels."""
_COLUMNS = 256


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Pixels in any arrangement (R, C) and what they show.

    Attributes:
        right: how far to the right their rays are one metre ahead, metres; broadcasts to (R, C).
        down: how far down they are there, in the same way.
        face: (R, C) as in `Scene.cast`.
        depth: (R, C) float32, metres along the camera's axis; infinite for the sky.
    """

    right: Float32Array
    down: Float32Array
    face: IntArray
    depth: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class Buffers:
    """What a camera sees.

    Attributes:
        all: every pixel, (H, W); a pixel on an outline shows what the first of its rays meets.
        outline: (E,) rows, of H · W, of the pixels on outlines.
        fine: the two rays of each of these pixels, next to each other, (R, 256), padded at the end.
    """

    all: Rays
    outline: IntArray
    fine: Rays


def look(scene: Scene, camera: Camera, ground_from_camera: SE3) -> Buffers:
    """Cast the rays of a picture."""
    width, height = camera.optics.width, camera.optics.height
    coarse_column, coarse_row = np.arange(0, width + 2, 2), np.arange(0, height + 2, 2)
    shape = len(coarse_row), len(coarse_column)
    right, down = slopes(camera, coarse_column, coarse_row)
    movers = nearest_movers(scene, camera, ground_from_camera)
    rays = ray_directions(ground_from_camera, right[None, :], down[:, None])
    still = scene.setting.cast_columns(ground_from_camera.translation, rays)
    near = np.flatnonzero(movers[: height + 2 : 2, : width + 2 : 2].ravel() < still[0])
    depth, face = scene.with_movers(ground_from_camera.translation, rays.reshape(-1, 3), still, near)
    coarse_face, coarse_depth = face.reshape(shape), depth.reshape(shape).astype(np.float32)
    full_face, mixed = _spread(coarse_face, height, width)
    full_depth = _interpolated(coarse_depth, height, width)
    outline = np.flatnonzero(mixed)
    fine = _fine(scene, camera, ground_from_camera, outline, movers)
    count = len(_SUBPIXELS) * len(outline)
    full_face.reshape(-1)[outline] = fine.face.reshape(-1)[: count : len(_SUBPIXELS)]
    full_depth.reshape(-1)[outline] = fine.depth.reshape(-1)[: count : len(_SUBPIXELS)]
    all_right, all_down = slopes(camera, np.arange(width), np.arange(height))
    return Buffers(Rays(all_right[None, :], all_down[:, None], full_face, full_depth), outline, fine)


def slopes(camera: Camera, column: AnyArray, row: AnyArray) -> tuple[Float32Array, Float32Array]:
    """How far right and down the rays through pixels' middles are one metre ahead, for columns and for rows."""
    (focal, _, cx), (_, _, cy) = camera.optics.intrinsic[0], camera.optics.intrinsic[1]
    right, down = (column + 0.5 - cx) / focal, (row + 0.5 - cy) / focal
    return right.astype(np.float32), down.astype(np.float32)


def ray_directions(ground_from_camera: SE3, right: Float32Array, down: Float32Array) -> Float32Array:
    """Directions (…, 3) float32 in the ground frame, of one metre ahead, so that distances along them are depths."""
    axes = ground_from_camera.rotation.astype(np.float32)
    rays = np.empty((*np.broadcast_shapes(right.shape, down.shape), 3), dtype=np.float32)
    for axis in range(3):
        np.add(right * axes[axis, 0] + axes[axis, 2], down * axes[axis, 1], out=rays[..., axis])
    return rays


def _spread(coarse: IntArray, height: int, width: int) -> tuple[IntArray, NDArray[np.bool_]]:
    """The faces of all pixels (H, W), and where they are not certain: the corners of a square of 2 × 2 differ."""
    same = coarse[:-1, :-1] == coarse[1:, :-1]
    same &= coarse[:-1, :-1] == coarse[:-1, 1:]
    same &= coarse[:-1, :-1] == coarse[1:, 1:]
    full, mixed = (each.repeat(2, axis=0).repeat(2, axis=1)[:height, :width] for each in (coarse[:-1, :-1], ~same))
    return np.ascontiguousarray(full), np.ascontiguousarray(mixed)


def _interpolated(depth: Float32Array, height: int, width: int) -> Float32Array:
    """Depths of all pixels (H, W) from those of every second pixel: the inverse of a plane's depth is linear."""
    inverse = 1 / depth
    full = np.empty((2 * (len(inverse) - 1), 2 * (inverse.shape[1] - 1)), dtype=np.float32)
    full[::2, ::2] = inverse[:-1, :-1]
    full[1::2, ::2] = (inverse[:-1, :-1] + inverse[1:, :-1]) / 2
    full[:, 1::2] = full[:, ::2] / 2
    full[::2, 1::2] += inverse[:-1, 1:] / 2
    full[1::2, 1::2] += (inverse[:-1, 1:] + inverse[1:, 1:]) / 4
    with np.errstate(divide="ignore"):
        return np.ascontiguousarray(1 / full[:height, :width])


def _fine(scene: Scene, camera: Camera, ground_from_camera: SE3, outline: IntArray, movers: Float32Array) -> Rays:
    """Two rays for each pixel of `outline`; `movers` comes from `nearest_movers`."""
    row, column = np.divmod(outline, camera.optics.width)
    offsets = np.array(_SUBPIXELS)
    right, down = slopes(camera, column[:, None] + offsets[:, 0], row[:, None] + offsets[:, 1])
    filled = -len(outline) * len(_SUBPIXELS) % _COLUMNS
    right, down = (
        np.pad(each.reshape(-1), (0, filled), mode="edge" if len(outline) else "empty") for each in (right, down)
    )
    rays = ray_directions(ground_from_camera, right, down)
    still = scene.setting.caster.cast(ground_from_camera.translation, rays)
    reach = still[0][: len(outline) * len(_SUBPIXELS)]
    near = np.flatnonzero(movers[row, column].repeat(len(_SUBPIXELS)) < reach)
    depth, face = scene.with_movers(ground_from_camera.translation, rays, still, near)
    shape = -1, _COLUMNS
    return Rays(right.reshape(shape), down.reshape(shape), face.reshape(shape), depth.reshape(shape).astype(np.float32))
