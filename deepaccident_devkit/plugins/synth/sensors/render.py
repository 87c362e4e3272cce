"""The cameras' pictures: the face in each pixel, and its colour in the light of the scenario.

The pixels between two that show the same flat face show this face too, and the inverse of its depth
changes linearly. On outlines, two rays are cast for each pixel, and its colour is their mean.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.plugins.synth.roads import Arm, Terrain
from deepaccident_devkit.plugins.synth.sensors.agents import Camera
from deepaccident_devkit.plugins.synth.sensors.annotate import nearest_movers
from deepaccident_devkit.plugins.synth.sensors.caster import GROUND, NO_HIT
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
    static_palette,
    windows_on,
)
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting
from deepaccident_devkit.plugins.synth.sensors.shadows import (
    Ground,
    PassingGround,
    WallShadows,
    shadows_on,
    static_ground,
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
_SUBPIXEL_OFFSETS = ((-0.25, -0.25), (0.25, 0.25))
_FINE_COLUMNS = 256
# If a pixel spans this many metres of ground or more, its colour comes from the first, or second,
# coarser picture.
_COARSER_SPANS_M = (1.0, 4.0)
_MAX_DEPTH_M = np.float32(1000.0)
_LAMP_TINT = (1.0, 0.95, 0.84)
# The share of the light on the ground that upright surfaces show.
_UPRIGHT_LIGHT_SHARE = 0.4
# Height above the ground up to which headlamps light things.
_LAMPLIGHT_HEIGHT_M = np.float32(2.5)
_GLOW_STRENGTH = 0.9
# Pixels across and down for each ray of a reflection on wet ground, which is blurred in any case.
_REFLECTION_STEP = 4
# Share of the light that wet ground mirrors, seen from straight above and at a very small angle.
_MIRRORED_SHARES = (0.05, 0.6)
# Distance from a slope to where mirrored rays begin, so that they do not meet the slope's own
# triangles.
_GROUND_CLEARANCE_M = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Pixels in any arrangement (R, C), with the faces that they show.

    Attributes:
        right: Slopes of the rays to the right, metres a metre ahead; broadcasts to (R, C).
        down: Slopes of the rays downwards, in the same way.
        face: Faces as in `Scene.cast`, shape (R, C).
        depth: Distances along the camera's axis, shape (R, C), float32, metres; infinite for the
            sky.
        spacing: Difference of `right` from ray to ray.
    """

    right: Float32Array
    down: Float32Array
    face: IntArray
    depth: Float32Array
    spacing: float


@dataclass(frozen=True, slots=True, eq=False)
class Buffers:
    """The faces in the picture of a camera.

    Attributes:
        all: Every pixel, (H, W); a pixel on an outline shows the face that the first of its rays
            meets.
        outline: Rows, of H · W, of the pixels on outlines, shape (E,).
        fine: Two rays of each of these pixels, (2 · R, 256): first all first rays, then all second
            ones, both padded.
    """

    all: Rays
    outline: IntArray
    fine: Rays


def trace_picture(scene: Scene, camera: Camera, ground_from_camera: SE3) -> Buffers:
    """Cast the rays of a picture."""
    width = camera.optics.width
    height = camera.optics.height
    coarse_column = np.arange(0, width + 2, 2)
    coarse_row = np.arange(0, height + 2, 2)
    shape = len(coarse_row), len(coarse_column)
    right, down = slopes(camera, coarse_column, coarse_row)
    mover_depth = nearest_movers(scene, camera, ground_from_camera)
    rays = ray_directions(ground_from_camera, right[None, :], down[:, None])
    origin = ground_from_camera.translation
    setting = scene.setting
    pose = ground_from_camera.matrix.tobytes()
    static_hits = setting.remembered(pose, lambda: setting.cast_columns(origin, rays))
    coarse_mover_depth = mover_depth[: height + 2 : 2, : width + 2 : 2]
    near = np.flatnonzero(coarse_mover_depth.ravel() < static_hits[0])
    depth, face = scene.with_movers(origin, rays.reshape(-1, 3), static_hits, near)
    full_face, mixed = _spread(face.reshape(shape), height, width)
    full_depth = _interpolated(depth.reshape(shape).astype(np.float32), height, width)
    outline = np.flatnonzero(mixed)
    fine = _fine_rays(scene, camera, ground_from_camera, outline, mover_depth)
    full_face.reshape(-1)[outline] = fine.face.reshape(-1)[: len(outline)]
    full_depth.reshape(-1)[outline] = fine.depth.reshape(-1)[: len(outline)]
    all_right, all_down = slopes(camera, np.arange(width), np.arange(height))
    spacing = _spacing(all_right[:2])
    all_rays = Rays(all_right[None, :], all_down[:, None], full_face, full_depth, spacing)
    return Buffers(all_rays, outline, fine)


def slopes(camera: Camera, column: AnyArray, row: AnyArray) -> tuple[Float32Array, Float32Array]:
    """Return the slopes to the right and down of the rays through pixels' middles.

    They are metres a metre ahead, for columns and for rows.
    """
    (focal, _, cx), (_, _, cy) = camera.optics.intrinsic[0], camera.optics.intrinsic[1]
    right = (column + 0.5 - cx) / focal
    down = (row + 0.5 - cy) / focal
    return right.astype(np.float32), down.astype(np.float32)


def ray_directions(
    ground_from_camera: SE3, right: Float32Array, down: Float32Array
) -> Float32Array:
    """Return the directions (…, 3), float32, of rays in the ground frame.

    They are of one metre ahead, so that distances along them are depths.
    """
    axes = ground_from_camera.rotation.astype(np.float32)
    rays = np.empty((*np.broadcast_shapes(right.shape, down.shape), 3), dtype=np.float32)
    for axis in range(3):
        np.add(right * axes[axis, 0] + axes[axis, 2], down * axes[axis, 1], out=rays[..., axis])
    return rays


def _spread(coarse: IntArray, height: int, width: int) -> tuple[IntArray, NDArray[np.bool_]]:
    """Spread the faces of every second pixel over all pixels.

    Returns:
        Faces (H, W), and truth values (H, W): pixels with uncertain faces, because the corners of a
        square of 2 × 2 differ.
    """
    upper_left = coarse[:-1, :-1]
    uniform = upper_left == coarse[1:, :-1]
    uniform &= upper_left == coarse[:-1, 1:]
    uniform &= upper_left == coarse[1:, 1:]
    full = _doubled(upper_left)[:height, :width]
    mixed = _doubled(~uniform)[:height, :width]
    return np.ascontiguousarray(full), mixed


def _doubled(coarse: AnyArray) -> AnyArray:
    """Return an array (R, C) with each value repeated over a square of 2 × 2."""
    rows, columns = coarse.shape
    fine = np.empty((2 * rows, 2 * columns), dtype=coarse.dtype)
    fine[::2, ::2] = fine[::2, 1::2] = coarse
    fine[1::2] = fine[::2]
    return fine


def _interpolated(depth: Float32Array, height: int, width: int) -> Float32Array:
    """Interpolate the depths of all pixels (H, W) from every second pixel.

    The inverse of a plane's depth is linear.
    """
    inverse = 1 / depth
    rows = np.empty((2 * (len(inverse) - 1), inverse.shape[1]), dtype=np.float32)
    rows[::2] = inverse[:-1]
    rows[1::2] = (inverse[:-1] + inverse[1:]) / 2
    full = np.empty((len(rows), 2 * (rows.shape[1] - 1)), dtype=np.float32)
    full[:, ::2] = rows[:, :-1]
    full[:, 1::2] = (rows[:, :-1] + rows[:, 1:]) / 2
    with np.errstate(divide="ignore"):
        return np.ascontiguousarray(1 / full[:height, :width])


def _fine_rays(
    scene: Scene,
    camera: Camera,
    ground_from_camera: SE3,
    outline: IntArray,
    mover_depth: Float32Array,
) -> Rays:
    """Cast two rays for each pixel on an outline.

    Args:
        scene: The scene.
        camera: The camera.
        ground_from_camera: Its pose.
        outline: Rows of the pixels on outlines, shape (E,).
        mover_depth: Depths from `nearest_movers`.
    """
    width = camera.optics.width
    height = camera.optics.height
    padding = (0, -len(outline) % _FINE_COLUMNS)
    padded = np.pad(outline, padding, mode="edge" if len(outline) else "empty")
    row, column = np.divmod(padded, width)
    across, downwards = np.array(_SUBPIXEL_OFFSETS).T[..., None]
    right, down = slopes(camera, np.arange(width) + across, np.arange(height) + downwards)
    spacing = _spacing(right[:, column[:1]].ravel())
    right = right.take(column, axis=1).reshape(-1)
    down = down.take(row, axis=1).reshape(-1)
    rays = ray_directions(ground_from_camera, right, down)
    origin = ground_from_camera.translation
    static_hits = scene.setting.caster.cast(origin, rays)
    ray_mover_depth = np.tile(mover_depth[row, column], len(_SUBPIXEL_OFFSETS))
    near = np.flatnonzero(ray_mover_depth < static_hits[0])
    depth, face = scene.with_movers(origin, rays, static_hits, near)
    shape = -1, _FINE_COLUMNS
    depth = depth.reshape(shape).astype(np.float32)
    return Rays(right.reshape(shape), down.reshape(shape), face.reshape(shape), depth, spacing)


def _spacing(right: Float32Array) -> float:
    """Return the distance of two neighbouring rays, metres a metre ahead."""
    distances = np.abs(np.diff(right))
    return float(distances.max(initial=1e-3))


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Everything that decides the colours of a moment.

    Attributes:
        light: Light and air.
        sky: The sky.
        ground: Pictures of the ground.
        facades: Façades with windows.
        shadows: Shadows on façades.
        colors: Colours of all faces.
        lamplight: Light from `light.lamplight`; None by day.
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
    """The points where rays (R, C) meet something, and their directions, ground frame, metres."""

    x: Float32Array
    y: Float32Array
    z: Float32Array
    east: Float32Array
    north: Float32Array
    up: Float32Array


def shade_rays(rays: Rays, surroundings: Surroundings, ground_from_camera: SE3) -> ByteArray:
    """Return the colours (R, C, 3), uint8, of the faces that rays show."""
    import cv2

    points = _points(rays, ground_from_camera)
    facades = surroundings.facades
    colors = surroundings.colors
    painted = colors.wall.take(rays.face, mode="wrap")
    table = painted.view(np.uint8).reshape(*painted.shape, 4)
    shows_facade = table[..., 3] == FACADE
    pixels = on_facades(shows_facade, rays.face, (points.x, points.y, points.z), facades)
    shadows_on(painted, pixels, surroundings.shadows, colors)
    windows_on(painted, pixels, facades, colors, lit=surroundings.light.lamps > 0.5)
    picture = np.asarray(cv2.cvtColor(table, cv2.COLOR_RGBA2RGB), dtype=np.uint8)
    camera_height = float(ground_from_camera.translation[2])
    _add_ground(picture, rays, points, surroundings.ground, camera_height)
    if surroundings.lamplight is not None:
        share = np.where(rays.face == GROUND, 1, _UPRIGHT_LIGHT_SHARE)
        share = np.where(table[..., 3] == SHINES, 0, share).astype(np.float32)
        picture = _lamplit(picture, share, points, surroundings)
    picture = _hazed(picture, rays, surroundings.light)
    _add_sky(picture, rays.face == NO_HIT, points, surroundings.sky)
    return picture


def _points(rays: Rays, ground_from_camera: SE3) -> _RayHits:
    """Return the points that rays meet."""
    axes = ground_from_camera.rotation.astype(np.float32)
    origin = ground_from_camera.translation.astype(np.float32)
    depth = np.minimum(rays.depth, _MAX_DEPTH_M)
    along = [rays.right * axes[k, 0] + (rays.down * axes[k, 1] + axes[k, 2]) for k in range(3)]
    x, y, z = (depth * along[k] + origin[k] for k in range(3))
    return _RayHits(x, y, z, *along)


def _add_ground(
    picture: ByteArray, rays: Rays, points: _RayHits, ground: Ground, height: float
) -> None:
    """Paint the pixels that show the ground, in place.

    Each has its colour from the picture with the matching resolution.
    """
    import cv2

    remaining = rays.face == GROUND
    ends = [np.sqrt(span * max(height, 0.5) / rays.spacing) for span in _COARSER_SPANS_M]
    for level, end in enumerate((*ends, np.inf)):
        mask = remaining & (rays.depth < end)
        remaining ^= mask
        for window in _windows_of(mask):
            colors = ground.at(points.x[window], points.y[window], level)
            cv2.copyTo(colors, mask[window].view(np.uint8), picture[window])


def _add_sky(picture: ByteArray, mask: BoolArray, points: _RayHits, sky: Sky) -> None:
    """Paint the pixels that show the sky, in place."""
    import cv2

    for window in _windows_of(mask):
        colors = sky.toward(points.east[window], points.north[window], points.up[window])
        cv2.copyTo(colors, mask[window].view(np.uint8), picture[window])


def _windows_of(mask: BoolArray) -> list[tuple[slice, slice]]:
    """Return the rows and columns around all true values of a mask (R, C).

    The list has one window, or is empty if there is no true value.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return []
    return [(slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))]


def _lamplit(
    picture: ByteArray, share: Float32Array, points: _RayHits, surroundings: Surroundings
) -> ByteArray:
    """Return a picture with the light of lamps, multiplied by `share` (R, C), where it reaches."""
    import cv2

    if surroundings.lamplight is None:
        return picture
    light = surroundings.light
    height_factor = np.clip(_LAMPLIGHT_HEIGHT_M - points.z, 0, 1)
    gain = light_at(surroundings.lamplight, points.x, points.y) * height_factor
    gain *= share
    ratio = light.lamps * np.array(_LAMP_TINT) / (light.tint * light.ambient)
    factors = [1 + np.float32(value) * gain for value in ratio.tolist()]
    return np.asarray(cv2.multiply(picture, cv2.merge(factors), dtype=cv2.CV_8U))


def _hazed(picture: ByteArray, rays: Rays, light: Light) -> ByteArray:
    """Return a picture with the haze of the air."""
    import cv2

    visibility = np.minimum(rays.depth, _MAX_DEPTH_M)
    visibility *= np.sqrt(1 + rays.right**2 + rays.down**2)
    visibility *= np.float32(-light.haze)
    visibility = np.asarray(cv2.exp(visibility, visibility))
    # Row by row: pixel by pixel takes longer than everything else.
    haze = np.empty_like(picture)
    haze.reshape(len(haze), -1)[:] = np.tile(light.horizon.astype(np.uint8), picture.shape[1])
    return np.asarray(cv2.blendLinear(picture, haze, visibility, 1 - visibility))


class Studio:
    """The parts that the pictures of a scenario have in common: light, sky, and static world.

    Attributes:
        light: Light and air.
    """

    def __init__(
        self, setting: Setting, weather: str, time_of_day: str, rng: np.random.Generator
    ) -> None:
        self.light = light_of(weather, time_of_day)
        self._sky = make_sky(self.light, rng)
        self._ground = PassingGround(static_ground(setting, self.light, rng))
        self._palette = static_palette(setting, self.light)
        self._facades = facades_of(setting.static)
        self._shadows = wall_shadows(setting, self._facades, self.light)

    def surroundings(self, scene: Scene, signals: Mapping[Arm, int]) -> Surroundings:
        """Return the colours of a moment, for the cameras of all agents, until the next call.

        Args:
            scene: The scene.
            signals: States of the traffic lights, as in `lit_lamps`.
        """
        lamps = lit_lamps(scene.setting.world, signals)
        rows = scene.setting.props
        static_lamps = {int(rows[row]): color for row, color in lamps.items()}
        ground = self._ground.at(scene, self.light)
        colors = packed(self._palette, moving_palette(scene, self.light), static_lamps)
        return Surroundings(
            light=self.light,
            sky=self._sky,
            ground=ground,
            facades=self._facades,
            shadows=self._shadows,
            colors=colors,
            lamplight=lamplight(scene) if self.light.lamps else None,
        )


def camera_picture(
    scene: Scene,
    surroundings: Surroundings,
    camera: Camera,
    ground_from_camera: SE3,
    rng: np.random.Generator,
) -> ByteArray:
    """Render the picture (H, W, 3), uint8, RGB, of a camera; `rng` draws the rain."""
    import cv2

    light = surroundings.light
    buffers = trace_picture(scene, camera, ground_from_camera)
    picture = shade_rays(buffers.all, surroundings, ground_from_camera)
    if len(buffers.outline):
        fine_colors = shade_rays(buffers.fine, surroundings, ground_from_camera)
        colors, other_colors = fine_colors.reshape(len(_SUBPIXEL_OFFSETS), -1, 3)
        # The mean without more bits than eight.
        mean = (colors & other_colors) + ((colors ^ other_colors) >> 1)
        picture.reshape(-1, 3)[buffers.outline] = mean[: len(buffers.outline)]
    if light.wet:
        picture = _with_reflections(
            picture, buffers, scene, surroundings, camera, ground_from_camera
        )
    if light.lamps:
        picture = _with_glow(picture, buffers, surroundings)
    if light.rain:
        size = camera.optics.width, camera.optics.height
        picture = np.asarray(cv2.add(picture, rain_streaks(size, light.rain, rng)))
    return picture


def _with_reflections(
    picture: ByteArray,
    buffers: Buffers,
    scene: Scene,
    surroundings: Surroundings,
    camera: Camera,
    ground_from_camera: SE3,
) -> ByteArray:
    """Return a picture with the reflections of wet ground, from rays to every fourth pixel."""
    import cv2

    width = camera.optics.width
    height = camera.optics.height
    middle = (_REFLECTION_STEP - 1) / 2
    columns = np.arange(0, width, _REFLECTION_STEP) + middle
    rows = np.arange(0, height, _REFLECTION_STEP) + middle
    right, down = slopes(camera, columns, rows)
    rays = ray_directions(ground_from_camera, right[None, :], down[:, None])
    eye = ground_from_camera.translation
    terrain = scene.setting.world.terrain
    if terrain.is_flat:
        upper = int(np.argmax((rays[..., 2] < 0).any(axis=1)))
        origin, mirrored, falling = _below_level_ground(eye, rays[upper:])
    else:
        pixel_rows = rows.astype(np.intp).clip(max=height - 1)
        pixel_columns = columns.astype(np.intp).clip(max=width - 1)
        pixels = np.ix_(pixel_rows, pixel_columns)
        upper = int(np.argmax((buffers.all.face[pixels] == GROUND).any(axis=1)))
        depth = np.minimum(buffers.all.depth[pixels], _MAX_DEPTH_M)[upper:]
        origin, mirrored, falling = _off_slopes(eye, rays[upper:], depth, terrain)
    _, face = scene.cast(origin, mirrored.reshape(-1, 3))
    face = face.reshape(mirrored.shape[:2])
    colors = np.maximum(surroundings.sky.toward(*(mirrored[..., k] for k in range(3))), 0)
    hits_solid = face >= 0
    wall_colors = surroundings.colors.wall.view(np.uint8).reshape(-1, 4)[:, :3]
    colors[hits_solid] = wall_colors[face[hits_solid]]
    steepness = (falling / np.linalg.norm(mirrored, axis=-1)).clip(0, 1)
    mirrored_share = _MIRRORED_SHARES[0] + _MIRRORED_SHARES[1] * (1 - steepness) ** 5
    share = surroundings.light.wet * mirrored_share
    size = width, (len(rows) - upper) * _REFLECTION_STEP
    reflection = cv2.resize(cv2.GaussianBlur(colors, (1, 3), 0), size)
    weight = cv2.resize(share.astype(np.float32), size)
    top = upper * _REFLECTION_STEP
    reflection = np.asarray(reflection)[: height - top]
    weight = np.asarray(weight)[: height - top]
    weight = np.where(buffers.all.face[top:] == GROUND, weight, np.float32(0))
    picture[top:] = cv2.blendLinear(picture[top:], reflection, 1 - weight, weight)
    return picture


def _below_level_ground(
    eye: FloatArray, rays: Float32Array
) -> tuple[FloatArray, Float32Array, AnyArray]:
    """Return the mirrored rays of level ground: the rays of the camera's mirror image below it.

    Returns:
        Their origin (3,), their directions (R, C, 3), and their descent to the ground (R, C).
    """
    mirror = np.array([1, 1, -1], dtype=np.float32)
    return eye * mirror, rays * mirror, -rays[..., 2]


def _off_slopes(
    eye: FloatArray, rays: Float32Array, depth: Float32Array, terrain: Terrain
) -> tuple[FloatArray, Float32Array, AnyArray]:
    """Return the mirrored rays of slopes: each ray is mirrored where it ends, at `depth` (R, C).

    Returns:
        Their origins (R · C, 3), their directions (R, C, 3), and their descent to the ground
        (R, C).
    """
    points = eye + rays * depth[..., None]
    normal = terrain.normal(points[..., :2])
    falling = -(rays * normal).sum(axis=-1)
    origins = points + _GROUND_CLEARANCE_M * normal
    mirrored = rays + 2 * falling[..., None] * normal
    return origins.reshape(-1, 3), mirrored.astype(np.float32), falling


def _with_glow(picture: ByteArray, buffers: Buffers, surroundings: Surroundings) -> ByteArray:
    """Return a picture with light around lamps."""
    import cv2

    coarse_face = buffers.all.face[::2, ::2]
    half = surroundings.colors.shining.take(coarse_face, axis=0, mode="wrap")
    if not half.any():
        return picture
    diameter = max(3, picture.shape[1] // 80) | 1
    quarter_size = (-(-half.shape[1] // 2), -(-half.shape[0] // 2))
    small = cv2.resize(half, quarter_size, interpolation=cv2.INTER_AREA)
    glow = cv2.GaussianBlur(small, (0, 0), diameter / 4)
    full_glow = cv2.resize(glow, (picture.shape[1], picture.shape[0]))
    strength = _GLOW_STRENGTH * surroundings.light.lamps
    return np.asarray(cv2.addWeighted(picture, 1.0, full_glow, strength, 0))
