"""The cameras' pictures: what each pixel shows, and its colour in the light of the scenario.

The pixels between two that show the same flat face show this face too, and the inverse of its depth changes linearly.
On outlines, two rays are cast for each pixel, and its colour is their mean.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.plugins.synth.roads import Arm, Terrain
from deepaccident_devkit.plugins.synth.sensors.agents import Camera
from deepaccident_devkit.plugins.synth.sensors.annotate import nearest_movers
from deepaccident_devkit.plugins.synth.sensors.caster import GROUND, NOTHING
from deepaccident_devkit.plugins.synth.sensors.light import (
    Light,
    Sky,
    lamplight,
    light_at,
    light_of,
    lit_lamps,
    make_sky,
    rain_streaks,
)
from deepaccident_devkit.plugins.synth.sensors.paint import (
    FACADE,
    SHINES,
    Colors,
    Facades,
    facades_of,
    moving_palette,
    on_facades,
    packed,
    still_palette,
    windows_on,
)
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting
from deepaccident_devkit.plugins.synth.sensors.shadows import (
    Ground,
    PassingGround,
    WallShadows,
    shadows_on,
    still_ground,
    wall_shadows,
)
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
)

# Offsets of the rays of a pixel on an outline, pixels.
_SUBPIXELS = ((-0.25, -0.25), (0.25, 0.25))
_COLUMNS = 256


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Pixels in any arrangement (R, C) and what they show.

    Attributes:
        right: how far to the right their rays are one metre ahead, metres; broadcasts to (R, C).
        down: how far down they are there, in the same way.
        face: (R, C) as in `Scene.cast`.
        depth: (R, C) float32, metres along the camera's axis; infinite for the sky.
        spacing: by how much `right` differs from ray to ray.
    """

    right: Float32Array
    down: Float32Array
    face: IntArray
    depth: Float32Array
    spacing: float


@dataclass(frozen=True, slots=True, eq=False)
class Buffers:
    """What a camera sees.

    Attributes:
        all: every pixel, (H, W); a pixel on an outline shows what the first of its rays meets.
        outline: (E,) rows, of H · W, of the pixels on outlines.
        fine: the two rays of each of these pixels, (2 · R, 256): all first ones, then all second ones, both padded.
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
    origin, setting = ground_from_camera.translation, scene.setting
    still = setting.kept(
        ground_from_camera.matrix.tobytes(), lambda: setting.cast_columns(origin, rays)
    )
    near = np.flatnonzero(movers[: height + 2 : 2, : width + 2 : 2].ravel() < still[0])
    depth, face = scene.with_movers(origin, rays.reshape(-1, 3), still, near)
    coarse_face, coarse_depth = face.reshape(shape), depth.reshape(shape).astype(np.float32)
    full_face, mixed = _spread(coarse_face, height, width)
    full_depth = _interpolated(coarse_depth, height, width)
    outline = np.flatnonzero(mixed)
    fine = _fine(scene, camera, ground_from_camera, outline, movers)
    full_face.reshape(-1)[outline] = fine.face.reshape(-1)[: len(outline)]
    full_depth.reshape(-1)[outline] = fine.depth.reshape(-1)[: len(outline)]
    all_right, all_down = slopes(camera, np.arange(width), np.arange(height))
    spacing = _spacing(all_right[:2])
    return Buffers(
        Rays(all_right[None, :], all_down[:, None], full_face, full_depth, spacing), outline, fine
    )


def slopes(camera: Camera, column: AnyArray, row: AnyArray) -> tuple[Float32Array, Float32Array]:
    """How far right and down the rays through pixels' middles are one metre ahead, for columns and for rows."""
    (focal, _, cx), (_, _, cy) = camera.optics.intrinsic[0], camera.optics.intrinsic[1]
    right, down = (column + 0.5 - cx) / focal, (row + 0.5 - cy) / focal
    return right.astype(np.float32), down.astype(np.float32)


def ray_directions(
    ground_from_camera: SE3, right: Float32Array, down: Float32Array
) -> Float32Array:
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
    full, mixed = (
        np.empty((2 * same.shape[0], 2 * same.shape[1]), dtype=each.dtype)
        for each in (coarse, same)
    )
    for fine, each in ((full, coarse[:-1, :-1]), (mixed, ~same)):
        fine[::2, ::2] = fine[::2, 1::2] = each
        fine[1::2] = fine[::2]
    return np.ascontiguousarray(full[:height, :width]), mixed[:height, :width]


def _interpolated(depth: Float32Array, height: int, width: int) -> Float32Array:
    """Depths of all pixels (H, W) from those of every second pixel: the inverse of a plane's depth is linear."""
    inverse = 1 / depth
    rows = np.empty((2 * (len(inverse) - 1), inverse.shape[1]), dtype=np.float32)
    rows[::2], rows[1::2] = inverse[:-1], (inverse[:-1] + inverse[1:]) / 2
    full = np.empty((len(rows), 2 * (rows.shape[1] - 1)), dtype=np.float32)
    full[:, ::2], full[:, 1::2] = rows[:, :-1], (rows[:, :-1] + rows[:, 1:]) / 2
    with np.errstate(divide="ignore"):
        return np.ascontiguousarray(1 / full[:height, :width])


def _fine(
    scene: Scene, camera: Camera, ground_from_camera: SE3, outline: IntArray, movers: Float32Array
) -> Rays:
    """Two rays for each pixel of `outline`; `movers` comes from `nearest_movers`."""
    width, height = camera.optics.width, camera.optics.height
    filled = np.pad(
        outline, (0, -len(outline) % _COLUMNS), mode="edge" if len(outline) else "empty"
    )
    row, column = np.divmod(filled, width)
    across, downwards = np.array(_SUBPIXELS).T[..., None]
    right, down = slopes(camera, np.arange(width) + across, np.arange(height) + downwards)
    spacing = _spacing(right[:, column[:1]].ravel())
    right, down = right.take(column, axis=1).reshape(-1), down.take(row, axis=1).reshape(-1)
    rays = ray_directions(ground_from_camera, right, down)
    still = scene.setting.caster.cast(ground_from_camera.translation, rays)
    near = np.flatnonzero(np.tile(movers[row, column], len(_SUBPIXELS)) < still[0])
    depth, face = scene.with_movers(ground_from_camera.translation, rays, still, near)
    shape = -1, _COLUMNS
    depth = depth.reshape(shape).astype(np.float32)
    return Rays(right.reshape(shape), down.reshape(shape), face.reshape(shape), depth, spacing)


def _spacing(right: Float32Array) -> float:
    """How far apart two neighbouring rays are, metres a metre ahead."""
    return float(np.abs(np.diff(right)).max(initial=1e-3))


# If a pixel spans so many metres of ground or more, its colour comes from the first, or second, coarser picture.
_COARSER = (1.0, 4.0)
_FAR = np.float32(1000.0)
_LAMP_TINT = (1.0, 0.95, 0.84)
# The share of the light on the ground that upright surfaces show.
_ON_THINGS = 0.4
# Metres above the ground up to which headlamps light things.
_LAMPS_REACH = np.float32(2.5)


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
        lamplight: from `light.lamplight`; None by day.
    """

    light: Light
    sky: Sky
    ground: Ground
    facades: Facades
    shadows: WallShadows
    colors: Colors
    lamplight: Float32Array | None


@dataclass(frozen=True, slots=True, eq=False)
class _RayHits:
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
    painted = around.colors.wall.take(rays.face, mode="wrap")
    table = painted.view(np.uint8).reshape(*painted.shape, 4)
    places = on_facades(
        table[..., 3] == FACADE, rays.face, (points.x, points.y, points.z), around.facades
    )
    shadows_on(painted, places, around.shadows, around.colors)
    windows_on(painted, places, around.facades, around.colors, lit=around.light.lamps > 0.5)
    picture = np.asarray(cv2.cvtColor(table, cv2.COLOR_RGBA2RGB), dtype=np.uint8)
    _add_ground(picture, rays, points, around.ground, float(ground_from_camera.translation[2]))
    if around.lamplight is not None:
        share = np.where(
            table[..., 3] == SHINES, 0, np.where(rays.face == GROUND, 1, _ON_THINGS)
        ).astype(np.float32)
        picture = _lamplit(picture, share, points, around)
    picture = _hazed(picture, rays, around.light)
    _add_sky(picture, rays.face == NOTHING, points, around.sky)
    return picture


def _points(rays: Rays, ground_from_camera: SE3) -> _RayHits:
    axes, origin = (
        ground_from_camera.rotation.astype(np.float32),
        ground_from_camera.translation.astype(np.float32),
    )
    depth = np.minimum(rays.depth, _FAR)
    along = [rays.right * axes[k, 0] + (rays.down * axes[k, 1] + axes[k, 2]) for k in range(3)]
    x, y, z = (depth * along[k] + origin[k] for k in range(3))
    return _RayHits(x, y, z, *along)


def _add_ground(
    picture: ByteArray, rays: Rays, points: _RayHits, ground: Ground, height: float
) -> None:
    """Paint the pixels that show the ground, in place, each from the picture with the matching resolution."""
    import cv2

    shown, ends = (
        rays.face == GROUND,
        (np.sqrt(span * max(height, 0.5) / rays.spacing) for span in _COARSER),
    )
    for level, end in enumerate((*ends, np.inf)):
        here = shown & (rays.depth < end)
        shown ^= here
        for part in _part_of(here):
            cv2.copyTo(
                ground.at(points.x[part], points.y[part], level),
                here[part].view(np.uint8),
                picture[part],
            )


def _add_sky(picture: ByteArray, shown: BoolArray, points: _RayHits, sky: Sky) -> None:
    """Paint the pixels that show the sky, in place."""
    import cv2

    for part in _part_of(shown):
        colors = sky.toward(points.east[part], points.north[part], points.up[part])
        cv2.copyTo(colors, shown[part].view(np.uint8), picture[part])


def _part_of(mask: BoolArray) -> list[tuple[slice, slice]]:
    """The rows and columns around all that is true in a mask (R, C); empty if nothing is."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return [np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]] if len(rows) else []


def _lamplit(
    picture: ByteArray, share: Float32Array, points: _RayHits, around: Surroundings
) -> ByteArray:
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
    # row by row: pixel by pixel takes longer than the rest
    haze = np.empty_like(picture)
    haze.reshape(len(haze), -1)[:] = np.tile(light.horizon.astype(np.uint8), picture.shape[1])
    return np.asarray(cv2.blendLinear(picture, haze, seen, 1 - seen))


_GLOW = 0.9
# Pixels across and down for each ray of a reflection on wet ground, which is blurred in any case.
_REFLECTION_STEP = 4
# Share of the light that wet ground mirrors, seen from straight above and seen at a very small angle.
_MIRRORING = (0.05, 0.6)

# Metres above a slope where mirrored rays begin, so that they do not meet the slope's own triangles.
_CLEAR_OF_GROUND = 0.05


class Studio:
    """What the pictures of a scenario have in common: light, sky, and all that stands still.

    Attributes:
        light: light and air.
    """

    def __init__(
        self, setting: Setting, weather: str, time_of_day: str, rng: np.random.Generator
    ) -> None:
        self.light = light_of(weather, time_of_day)
        self._sky = make_sky(self.light, rng)
        self._ground = PassingGround(still_ground(setting, self.light, rng))
        self._palette = still_palette(setting, self.light)
        self._facades = facades_of(setting.still)
        self._shadows = wall_shadows(setting, self._facades, self.light)

    def surroundings(self, scene: Scene, signals: Mapping[Arm, int]) -> Surroundings:
        """The colours of a moment, for the cameras of all agents, until the next call; `signals` as in `lit_lamps`."""
        lamps = lit_lamps(scene.setting.world, signals)
        rows = scene.setting.props
        return Surroundings(
            light=self.light,
            sky=self._sky,
            ground=self._ground.at(scene, self.light),
            facades=self._facades,
            shadows=self._shadows,
            colors=packed(
                self._palette,
                moving_palette(scene, self.light),
                {int(rows[row]): color for row, color in lamps.items()},
            ),
            lamplight=lamplight(scene) if self.light.lamps else None,
        )


def camera_picture(
    scene: Scene,
    around: Surroundings,
    camera: Camera,
    ground_from_camera: SE3,
    rng: np.random.Generator,
) -> ByteArray:
    """The picture (H, W, 3) uint8, RGB; `rng` draws the rain."""
    import cv2

    buffers = look(scene, camera, ground_from_camera)
    picture = shade(buffers.all, around, ground_from_camera)
    if len(buffers.outline):
        one, other = shade(buffers.fine, around, ground_from_camera).reshape(len(_SUBPIXELS), -1, 3)
        mean = (one & other) + ((one ^ other) >> 1)  # without more bits than eight
        picture.reshape(-1, 3)[buffers.outline] = mean[: len(buffers.outline)]
    if around.light.wet:
        picture = _with_reflections(picture, buffers, scene, around, camera, ground_from_camera)
    if around.light.lamps:
        picture = _with_glow(picture, buffers, around)
    if around.light.rain:
        size = camera.optics.width, camera.optics.height
        picture = np.asarray(cv2.add(picture, rain_streaks(size, around.light.rain, rng)))
    return picture


def _with_reflections(
    picture: ByteArray,
    buffers: Buffers,
    scene: Scene,
    around: Surroundings,
    camera: Camera,
    ground_from_camera: SE3,
) -> ByteArray:
    """The picture with the reflections of wet ground, from rays to every fourth pixel."""
    import cv2

    width, height = camera.optics.width, camera.optics.height
    middle = (_REFLECTION_STEP - 1) / 2
    columns, rows = (np.arange(0, size, _REFLECTION_STEP) + middle for size in (width, height))
    right, down = slopes(camera, columns, rows)
    rays = ray_directions(ground_from_camera, right[None, :], down[:, None])
    eye, terrain = ground_from_camera.translation, scene.setting.world.terrain
    if terrain.is_flat:
        upper = int(np.argmax((rays[..., 2] < 0).any(axis=1)))
        origin, mirrored, falling = _below_level_ground(eye, rays[upper:])
    else:
        pixels = np.ix_(
            rows.astype(np.intp).clip(max=height - 1), columns.astype(np.intp).clip(max=width - 1)
        )
        upper = int(np.argmax((buffers.all.face[pixels] == GROUND).any(axis=1)))
        depth = np.minimum(buffers.all.depth[pixels], _FAR)[upper:]
        origin, mirrored, falling = _off_slopes(eye, rays[upper:], depth, terrain)
    _, face = scene.cast(origin, mirrored.reshape(-1, 3))
    colors = np.maximum(around.sky.toward(*(mirrored[..., k] for k in range(3))), 0)
    solid = face.reshape(mirrored.shape[:2]) >= 0
    walls = around.colors.wall.view(np.uint8).reshape(-1, 4)[:, :3]
    colors[solid] = walls[face.reshape(solid.shape)[solid]]
    steep = (falling / np.linalg.norm(mirrored, axis=-1)).clip(0, 1)
    share = around.light.wet * (_MIRRORING[0] + _MIRRORING[1] * (1 - steep) ** 5)
    size = width, (len(rows) - upper) * _REFLECTION_STEP
    seen = cv2.resize(cv2.GaussianBlur(colors, (1, 3), 0), size)
    weight = cv2.resize(share.astype(np.float32), size)
    top = upper * _REFLECTION_STEP
    seen, weight = np.asarray(seen)[: height - top], np.asarray(weight)[: height - top]
    weight = np.where(buffers.all.face[top:] == GROUND, weight, np.float32(0))
    picture[top:] = cv2.blendLinear(picture[top:], seen, 1 - weight, weight)
    return picture


def _below_level_ground(
    eye: FloatArray, rays: Float32Array
) -> tuple[FloatArray, Float32Array, AnyArray]:
    """The mirrored rays of level ground: those of the camera's mirror image below it.

    Returns where they begin (3,), their directions (R, C, 3), and how much they fall to the ground (R, C).
    """
    mirror = np.array([1, 1, -1], dtype=np.float32)
    return eye * mirror, rays * mirror, -rays[..., 2]


def _off_slopes(
    eye: FloatArray, rays: Float32Array, depth: Float32Array, terrain: Terrain
) -> tuple[FloatArray, Float32Array, AnyArray]:
    """The same for slopes: each ray is mirrored where it ends, at `depth` (R, C); so they begin at (R · C, 3)."""
    met = eye + rays * depth[..., None]
    normal = terrain.normal(met[..., :2])
    falling = -(rays * normal).sum(axis=-1)
    begin = met + _CLEAR_OF_GROUND * normal
    return (
        begin.reshape(-1, 3),
        (rays + 2 * falling[..., None] * normal).astype(np.float32),
        falling,
    )


def _with_glow(picture: ByteArray, buffers: Buffers, around: Surroundings) -> ByteArray:
    """The picture with light around lamps."""
    import cv2

    half = around.colors.shining.take(buffers.all.face[::2, ::2], axis=0, mode="wrap")
    if not half.any():
        return picture
    wide = max(3, picture.shape[1] // 80) | 1
    small = cv2.resize(
        half, (-(-half.shape[1] // 2), -(-half.shape[0] // 2)), interpolation=cv2.INTER_AREA
    )
    glow = cv2.GaussianBlur(small, (0, 0), wide / 4)
    bright = cv2.resize(glow, (picture.shape[1], picture.shape[0]))
    return np.asarray(cv2.addWeighted(picture, 1.0, bright, _GLOW * around.light.lamps, 0))
