"""Camera images: the nearest surface in every pixel, in simple light."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import AnyArray, BoolArray, ByteArray, FloatArray, IntArray
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.synth.agents import Camera
from deepaccident_devkit.synth.look import Look
from deepaccident_devkit.synth.roads import MAP_EXTENT
from deepaccident_devkit.synth.scene import Scene
from deepaccident_devkit.synth.solids import FACES_A_SOLID, GLASS, Solids, concatenate
from deepaccident_devkit.synth.world import World

_STOREY, _BAY = 3.2, 2.6
"""Metres between rows and columns of windows."""
_LIT_GLASS = (236, 206, 132)
_GROUND_DETAIL = (1.0, 4.0)
"""Metres of ground a pixel row spans, from which on the coarser pictures of the ground are looked up."""


@dataclass(frozen=True, slots=True, eq=False)
class Paint:
    """Colours in the light of a scene, before haze.

    Attributes:
        wall: (F, 3) float64, RGB 0 to 255.
        window: (F, 3) float64, of the windows of a façade.
        facade: (F,) bool, faces that have windows.
        middle: (F, 3) float64, the middle of each face, metres, ground frame.
        ground: pictures of the ground, fine to coarse, from `Look.ground_pictures`.
    """

    wall: FloatArray
    window: FloatArray
    facade: BoolArray
    middle: FloatArray
    ground: tuple[ByteArray, ...]


def paint(scene: Scene, world: World, look: Look) -> Paint:
    """The colours of a scene's faces, for all cameras."""
    solids: Solids = concatenate([scene.actors.solids, world.props])
    upright = np.abs(scene.normals[:, 2]) < 0.5
    windows = np.broadcast_to(np.array(GLASS, dtype=np.float64), scene.normals.shape)
    return Paint(
        wall=look.shaded(solids.colors.reshape(-1, 3).astype(np.float64), scene.normals),
        window=look.shaded(windows, scene.normals),
        facade=np.repeat(solids.facade, FACES_A_SOLID) & upright,
        middle=scene.quads.mean(axis=1),
        ground=look.ground_pictures(scene.corners[: len(scene.actors.solids)][scene.actors.solids.main]),
    )


def render(scene: Scene, colors: Paint, look: Look, camera: Camera, ground_from_camera: SE3) -> ByteArray:
    """The picture (H, W, 3) uint8, RGB; the camera looks level, along the ground."""
    origin = ground_from_camera.translation
    right, down = _pixel_slopes(camera)
    directions = _ray_directions(ground_from_camera, right, down)
    depth, face = scene.caster.cast(origin, directions.reshape(-1, 3))
    picture, ground_depth = _background(colors, look, ground_from_camera, right, down)
    hit = np.flatnonzero((face >= 0) & (depth < np.repeat(ground_depth, len(right))))
    distance = np.linalg.norm(colors.middle - origin, axis=1)
    flat = picture.reshape(-1, 3)
    flat[hit] = look.hazed(colors.wall, distance).astype(np.uint8)[face[hit]]
    on_facade = hit[colors.facade[face[hit]]]
    points = origin.astype(np.float32) + directions.reshape(-1, 3)[on_facade] * depth[on_facade, None]
    glass, lit = _windows(points, face[on_facade])
    flat[on_facade[glass]] = look.hazed(colors.window, distance).astype(np.uint8)[face[on_facade[glass]]]
    if look.lit_windows:
        flat[on_facade[lit]] = _LIT_GLASS
    return picture


def _pixel_slopes(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """How far the rays through the pixels' middles go right (W,) and down (H,), a metre ahead."""
    optics = camera.optics
    (focal, _, cx), (_, _, cy) = optics.intrinsic[0], optics.intrinsic[1]
    return (np.arange(optics.width) + 0.5 - cx) / focal, (np.arange(optics.height) + 0.5 - cy) / focal


def _ray_directions(ground_from_camera: SE3, right: FloatArray, down: FloatArray) -> NDArray[np.float32]:
    """One ray a pixel, (H, W, 3), a metre ahead; distances along it are depths."""
    axes = ground_from_camera.rotation.astype(np.float32)
    across = right.astype(np.float32)[:, None] * axes[:, 0] + axes[:, 2]
    return np.asarray(across[None] + (down.astype(np.float32)[:, None] * axes[:, 1])[:, None])


def _background(
    colors: Paint, look: Look, ground_from_camera: SE3, right: FloatArray, down: FloatArray
) -> tuple[ByteArray, NDArray[np.float32]]:
    """Sky and ground without anything on it, (H, W, 3), and the depth of the ground in each row, (H,)."""
    picture = np.empty((len(down), len(right), 3), dtype=np.uint8)
    height = float(ground_from_camera.translation[2])
    horizon = int(np.searchsorted(down, 0.0, side="right"))
    picture[:horizon] = _sky(look, down[:horizon])[:, None]
    depth = np.full(len(down), np.inf)
    depth[horizon:] = height / down[horizon:]
    spans = depth[horizon:] ** 2 / height * (down[1] - down[0])
    levels = np.digitize(spans, _GROUND_DETAIL)
    for level in np.unique(levels).tolist():
        rows = horizon + np.flatnonzero(levels == level)
        picture[rows] = look.hazed(
            _ground_rows(colors.ground[level], ground_from_camera, right, depth[rows]), depth[rows, None]
        ).astype(np.uint8)
    return picture, depth.astype(np.float32)


def _sky(look: Look, down: FloatArray) -> ByteArray:
    up = np.minimum(-down / 0.5, 1.0)[:, None] ** 0.7
    return (look.horizon * (1 - up) + look.zenith * up).astype(np.uint8)


def _ground_rows(ground: ByteArray, ground_from_camera: SE3, right: FloatArray, depth: FloatArray) -> ByteArray:
    """Rows of ground at depths (R,), (R, W, 3) uint8, from a picture of all the map."""
    import cv2

    axes, cell = ground_from_camera.rotation, 2 * MAP_EXTENT / len(ground)
    column, row = (
        ((offset + depth[:, None] * (axes[k, 2] + right * axes[k, 0]) + MAP_EXTENT) / cell - 0.5).astype(np.float32)
        for k, offset in enumerate(ground_from_camera.translation[:2].tolist())
    )
    outside = ground[0, 0].astype(float).tolist()
    return np.asarray(
        cv2.remap(ground, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
    )


def _windows(points: AnyArray, face: IntArray) -> tuple[IntArray, IntArray]:
    """Which of the points (N, 3) on façades, faces (N,), lie on a window; and which of those on one with light."""
    across, up = (points[:, 0] + points[:, 1]) / _BAY, (points[:, 2] - 0.4) / _STOREY
    bay, storey = np.floor(across), np.floor(up)
    in_bay, in_storey = across - bay, up - storey
    glass = np.flatnonzero((in_bay > 0.25) & (in_bay < 0.8) & (in_storey > 0.32) & (in_storey < 0.8))
    number = bay[glass].astype(np.int64) * 7 + storey[glass].astype(np.int64) * 13 + face[glass]
    return glass, glass[number % 5 < 2]
