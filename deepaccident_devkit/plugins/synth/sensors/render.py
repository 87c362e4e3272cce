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
    draw_lamplight,
    draw_rain,
    find_lit_lamps,
    make_light,
    make_sky,
    sample_light,
)
from deepaccident_devkit.plugins.synth.sensors.paint import (
    FACADE,
    SHINES,
    Colors,
    Facades,
    find_facades,
    locate_on_facades,
    make_moving_palette,
    make_static_palette,
    pack_colors,
    paint_windows,
)
from deepaccident_devkit.plugins.synth.sensors.scene import Scene, Setting
from deepaccident_devkit.plugins.synth.sensors.shadows import (
    Ground,
    PassingGround,
    WallShadows,
    cast_wall_shadows,
    darken_facades,
    paint_static_ground,
)
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    ByteArray,
    Float32Array,
    FloatArray,
    IntArray,
)

# Offsets of the rays of a pixel on an outline from the middle of the pixel, pixels.
_SUBPIXEL_OFFSETS = ((-0.25, -0.25), (0.25, 0.25))
_FINE_COLUMNS = 256
# Lengths of ground in one pixel from which on its colour comes from the first, or the second,
# coarser picture.
_COARSER_SPANS_M = (1.0, 4.0)
_MAX_DEPTH_M = np.float32(1000.0)
_LAMP_TINT = (1.0, 0.95, 0.84)
# Light on upright surfaces as a share of the light on the ground.
_UPRIGHT_LIGHT_SHARE = 0.4
# Height above the ground up to which headlamps light things.
_LAMPLIGHT_HEIGHT_M = np.float32(2.5)
_GLOW_STRENGTH = 0.9
# Pixels across and down for each ray of a reflection on wet ground, which is blurred in any case.
_REFLECTION_STEP = 4
# Shares of the light that wet ground mirrors: seen from straight above, and how much more at a very
# small angle.
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
    shape = (len(coarse_row), len(coarse_column))
    right, down = slopes(camera, coarse_column, coarse_row)
    mover_depth = nearest_movers(scene, camera, ground_from_camera)
    rays = ray_directions(ground_from_camera, right[None, :], down[:, None])
    origin = ground_from_camera.translation
    setting = scene.setting
    pose = ground_from_camera.matrix.tobytes()
    static_hits = setting.remember_cast(pose, lambda: setting.cast_columns(origin, rays))
    coarse_mover_depth = mover_depth[: height + 2 : 2, : width + 2 : 2]
    mover_rays = np.flatnonzero(coarse_mover_depth.ravel() < static_hits[0])
    depth, face = scene.with_movers(origin, rays.reshape(-1, 3), static_hits, mover_rays)
    all_faces, is_uncertain = _spread_faces(face.reshape(shape), height, width)
    all_depths = _interpolate_depths(depth.reshape(shape).astype(np.float32), height, width)
    outline = np.flatnonzero(is_uncertain)
    fine = _cast_outline(scene, camera, ground_from_camera, outline, mover_depth)
    all_faces.reshape(-1)[outline] = fine.face.reshape(-1)[: len(outline)]
    all_depths.reshape(-1)[outline] = fine.depth.reshape(-1)[: len(outline)]
    all_right, all_down = slopes(camera, np.arange(width), np.arange(height))
    spacing = _measure_spacing(all_right[:2])
    all_rays = Rays(all_right[None, :], all_down[:, None], all_faces, all_depths, spacing)
    return Buffers(all_rays, outline, fine)


def slopes(camera: Camera, column: AnyArray, row: AnyArray) -> tuple[Float32Array, Float32Array]:
    """Return the slopes of the rays through the middles of pixels.

    Args:
        camera: The camera.
        column: Columns of the pixels.
        row: Rows of the pixels.

    Returns:
        Slopes to the right, of the shape of `column`, and downwards, of the shape of `row`: metres
        for each metre ahead.
    """
    intrinsic = camera.optics.intrinsic
    focal_length = intrinsic[0, 0]
    right = (column + 0.5 - intrinsic[0, 2]) / focal_length
    down = (row + 0.5 - intrinsic[1, 2]) / focal_length
    return right.astype(np.float32), down.astype(np.float32)


def ray_directions(
    ground_from_camera: SE3, right: Float32Array, down: Float32Array
) -> Float32Array:
    """Return the directions (…, 3), float32, of rays in the ground frame.

    Each reaches one metre ahead, so that distances along it are depths.

    Args:
        ground_from_camera: Pose of the camera.
        right: Slopes to the right, metres a metre ahead.
        down: Slopes downwards, metres a metre ahead.
    """
    axes = ground_from_camera.rotation.astype(np.float32)
    shape = np.broadcast_shapes(right.shape, down.shape)
    rays = np.empty((*shape, 3), dtype=np.float32)
    for axis, (right_part, down_part, ahead_part) in enumerate(axes):
        np.add(right * right_part + ahead_part, down * down_part, out=rays[..., axis])
    return rays


def _spread_faces(coarse: IntArray, height: int, width: int) -> tuple[IntArray, NDArray[np.bool_]]:
    """Spread the faces of every second pixel over all pixels.

    Returns:
        Faces (H, W), and truth values (H, W): pixels with uncertain faces, because the corners of a
        square of 2 × 2 differ.
    """
    upper_left = coarse[:-1, :-1]
    is_uniform = upper_left == coarse[1:, :-1]
    is_uniform &= upper_left == coarse[:-1, 1:]
    is_uniform &= upper_left == coarse[1:, 1:]
    faces = _double_size(upper_left)[:height, :width]
    is_uncertain = _double_size(~is_uniform)[:height, :width]
    return np.ascontiguousarray(faces), is_uncertain


def _double_size(coarse: AnyArray) -> AnyArray:
    """Return an array (R, C) with each value repeated over a square of 2 × 2."""
    rows, columns = coarse.shape
    fine = np.empty((2 * rows, 2 * columns), dtype=coarse.dtype)
    fine[::2, ::2] = coarse
    fine[::2, 1::2] = coarse
    fine[1::2] = fine[::2]
    return fine


def _interpolate_depths(depth: Float32Array, height: int, width: int) -> Float32Array:
    """Interpolate the depths of all pixels (H, W) from every second pixel.

    The inverse of a plane's depth is linear.
    """
    inverse = 1 / depth
    rows, columns = depth.shape
    tall = np.empty((2 * (rows - 1), columns), dtype=np.float32)
    tall[::2] = inverse[:-1]
    tall[1::2] = (inverse[:-1] + inverse[1:]) / 2
    full = np.empty((len(tall), 2 * (columns - 1)), dtype=np.float32)
    left = tall[:, :-1]
    full[:, ::2] = left
    full[:, 1::2] = (left + tall[:, 1:]) / 2
    with np.errstate(divide="ignore"):
        return np.ascontiguousarray(1 / full[:height, :width])


def _cast_outline(
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
        ground_from_camera: Pose of the camera.
        outline: Rows of the pixels on outlines, shape (E,).
        mover_depth: Depths from `nearest_movers`.

    Returns:
        The rays, as in `Buffers.fine`.
    """
    width = camera.optics.width
    height = camera.optics.height
    padding = (0, -len(outline) % _FINE_COLUMNS)
    padded = np.pad(outline, padding, mode="edge" if len(outline) else "empty")
    row, column = np.divmod(padded, width)
    column_offsets, row_offsets = np.array(_SUBPIXEL_OFFSETS).T[..., None]
    columns = np.arange(width) + column_offsets
    rows = np.arange(height) + row_offsets
    right, down = slopes(camera, columns, rows)
    spacing = _measure_spacing(right[:, column[:1]].ravel())
    right = right.take(column, axis=1).reshape(-1)
    down = down.take(row, axis=1).reshape(-1)
    rays = ray_directions(ground_from_camera, right, down)
    origin = ground_from_camera.translation
    static_hits = scene.setting.caster.cast(origin, rays)
    ray_mover_depth = np.tile(mover_depth[row, column], len(_SUBPIXEL_OFFSETS))
    mover_rays = np.flatnonzero(ray_mover_depth < static_hits[0])
    depth, face = scene.with_movers(origin, rays, static_hits, mover_rays)
    shape = (-1, _FINE_COLUMNS)
    depth = depth.reshape(shape).astype(np.float32)
    return Rays(right.reshape(shape), down.reshape(shape), face.reshape(shape), depth, spacing)


def _measure_spacing(right: Float32Array) -> float:
    """Return the distance between two neighbouring rays, metres a metre ahead."""
    distances = np.abs(np.diff(right))
    return float(distances.max(initial=1e-3))


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Everything that determines the colours at one moment.

    Attributes:
        light: Light and air.
        sky: The sky.
        ground: Pictures of the ground.
        facades: Façades with windows.
        shadows: Shadows on façades.
        colors: Colours of all faces.
        lamplight: Light from `light.draw_lamplight`; None by day.
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
    """Compute the colours (R, C, 3), uint8, of the faces that the rays hit."""
    import cv2

    hits = _locate_hits(rays, ground_from_camera)
    facades = surroundings.facades
    colors = surroundings.colors
    painted = colors.wall.take(rays.face, mode="wrap")
    table = painted.view(np.uint8).reshape(*painted.shape, 4)
    kind = table[..., 3]
    pixels = locate_on_facades(kind == FACADE, rays.face, (hits.x, hits.y, hits.z), facades)
    darken_facades(painted, pixels, surroundings.shadows, colors)
    paint_windows(painted, pixels, facades, colors, lit=surroundings.light.lamps > 0.5)
    picture = np.asarray(cv2.cvtColor(table, cv2.COLOR_RGBA2RGB), dtype=np.uint8)
    camera_height = float(ground_from_camera.translation[2])
    _add_ground(picture, rays, hits, surroundings.ground, camera_height)
    if surroundings.lamplight is not None:
        share = np.where(rays.face == GROUND, 1, _UPRIGHT_LIGHT_SHARE)
        share = np.where(kind == SHINES, 0, share).astype(np.float32)
        gain = share * _compute_lamplight(surroundings.lamplight, hits)
        picture = _add_lamplight(picture, gain, surroundings.light)
    picture = _add_haze(picture, rays, surroundings.light)
    _add_sky(picture, rays.face == NO_HIT, hits, surroundings.sky)
    return picture


def _locate_hits(rays: Rays, ground_from_camera: SE3) -> _RayHits:
    """Return the points where rays meet something."""
    axes = ground_from_camera.rotation.astype(np.float32)
    origin = ground_from_camera.translation.astype(np.float32)
    depth = np.minimum(rays.depth, _MAX_DEPTH_M)
    directions = []
    points = []
    for (right_part, down_part, ahead_part), start in zip(axes, origin, strict=True):
        direction = rays.right * right_part + (rays.down * down_part + ahead_part)
        directions.append(direction)
        points.append(depth * direction + start)
    return _RayHits(*points, *directions)


def _add_ground(
    picture: ByteArray, rays: Rays, hits: _RayHits, ground: Ground, height: float
) -> None:
    """Paint the pixels that show the ground, in place.

    Each has its colour from the picture of the ground with the matching resolution.

    Args:
        picture: Picture, shape (R, C, 3).
        rays: Rays of the pixels.
        hits: Points that they meet.
        ground: Pictures of the ground.
        height: Height of the camera, metres.
    """
    import cv2

    remaining = rays.face == GROUND
    max_depths = [np.sqrt(span * max(height, 0.5) / rays.spacing) for span in _COARSER_SPANS_M]
    for level, max_depth in enumerate((*max_depths, np.inf)):
        mask = remaining & (rays.depth < max_depth)
        remaining ^= mask
        for window in _find_window(mask):
            colors = ground.at(hits.x[window], hits.y[window], level)
            cv2.copyTo(colors, mask[window].view(np.uint8), picture[window])


def _add_sky(picture: ByteArray, mask: BoolArray, hits: _RayHits, sky: Sky) -> None:
    """Paint the pixels that show the sky, in place."""
    import cv2

    for window in _find_window(mask):
        colors = sky.toward(hits.east[window], hits.north[window], hits.up[window])
        cv2.copyTo(colors, mask[window].view(np.uint8), picture[window])


def _find_window(mask: BoolArray) -> list[tuple[slice, slice]]:
    """Return the rows and columns around all true values of a mask (R, C).

    The list has one window, or is empty if there is no true value.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return []
    row_span = slice(rows[0], rows[-1] + 1)
    column_span = slice(columns[0], columns[-1] + 1)
    return [(row_span, column_span)]


def _compute_lamplight(lamplight: Float32Array, hits: _RayHits) -> Float32Array:
    """Return the light of lamps (R, C) at the points that rays meet.

    Args:
        lamplight: Light on the ground, from `light.draw_lamplight`.
        hits: The points.
    """
    height_factor = np.clip(_LAMPLIGHT_HEIGHT_M - hits.z, 0, 1)
    gain: Float32Array = sample_light(lamplight, hits.x, hits.y) * height_factor
    return gain


def _add_lamplight(picture: ByteArray, gain: Float32Array, light: Light) -> ByteArray:
    """Add the light of lamps to a picture, and return it.

    Args:
        picture: Picture, shape (R, C, 3).
        gain: Light of lamps on each pixel, shape (R, C).
        light: Light and air.
    """
    import cv2

    ratio = light.lamps * np.array(_LAMP_TINT) / (light.tint * light.ambient)
    factors = [1 + np.float32(value) * gain for value in ratio.tolist()]
    return np.asarray(cv2.multiply(picture, cv2.merge(factors), dtype=cv2.CV_8U))


def _add_haze(picture: ByteArray, rays: Rays, light: Light) -> ByteArray:
    """Add haze to a picture, and return it."""
    import cv2

    visibility = np.minimum(rays.depth, _MAX_DEPTH_M)
    visibility *= np.sqrt(1 + rays.right**2 + rays.down**2)
    visibility *= np.float32(-light.haze)
    visibility = np.asarray(cv2.exp(visibility, visibility))
    # Row by row: pixel by pixel takes longer than everything else.
    haze = np.empty_like(picture)
    haze_row = np.tile(light.horizon.astype(np.uint8), picture.shape[1])
    haze.reshape(len(haze), -1)[:] = haze_row
    return np.asarray(cv2.blendLinear(picture, haze, visibility, 1 - visibility))


class Studio:
    """What all pictures of a scenario share: light, sky and the static world.

    Attributes:
        light: Light and air.
    """

    def __init__(
        self, setting: Setting, weather: str, time_of_day: str, rng: np.random.Generator
    ) -> None:
        self.light = make_light(weather, time_of_day)
        self._sky = make_sky(self.light, rng)
        self._ground = PassingGround(paint_static_ground(setting, self.light, rng))
        self._palette = make_static_palette(setting, self.light)
        self._facades = find_facades(setting.static)
        self._shadows = cast_wall_shadows(setting, self._facades, self.light)

    def surroundings(self, scene: Scene, signals: Mapping[Arm, int]) -> Surroundings:
        """Return the surroundings at a moment for all agents' cameras; valid until the next call.

        Args:
            scene: The scene.
            signals: States of the traffic lights, as in `find_lit_lamps`.
        """
        rows = scene.setting.props
        static_lamps = {}
        for row, color in find_lit_lamps(scene.setting.world, signals).items():
            static_lamps[int(rows[row])] = color
        ground = self._ground.at(scene, self.light)
        colors = pack_colors(self._palette, make_moving_palette(scene, self.light), static_lamps)
        return Surroundings(
            light=self.light,
            sky=self._sky,
            ground=ground,
            facades=self._facades,
            shadows=self._shadows,
            colors=colors,
            lamplight=draw_lamplight(scene) if self.light.lamps else None,
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
        _add_reflections(picture, buffers, scene, surroundings, camera, ground_from_camera)
    if light.lamps:
        picture = _add_glow(picture, buffers, surroundings)
    if light.rain:
        size = (camera.optics.width, camera.optics.height)
        picture = np.asarray(cv2.add(picture, draw_rain(size, light.rain, rng)))
    return picture


def _add_reflections(
    picture: ByteArray,
    buffers: Buffers,
    scene: Scene,
    surroundings: Surroundings,
    camera: Camera,
    ground_from_camera: SE3,
) -> None:
    """Add the reflections of wet ground to a picture, in place.

    Rays are cast for every fourth column and row.
    """
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
    all_rays = buffers.all
    if terrain.is_flat:
        is_falling = rays[..., 2] < 0
        first_row = int(np.argmax(is_falling.any(axis=1)))
        # The rays of the camera's mirror image below the ground.
        mirror = np.array([1, 1, -1], dtype=np.float32)
        falling_rays = rays[first_row:]
        origin = eye * mirror
        mirrored = falling_rays * mirror
        descent = -falling_rays[..., 2]
    else:
        pixel_rows = rows.astype(np.intp).clip(max=height - 1)
        pixel_columns = columns.astype(np.intp).clip(max=width - 1)
        pixels = np.ix_(pixel_rows, pixel_columns)
        shows_ground = all_rays.face[pixels] == GROUND
        first_row = int(np.argmax(shows_ground.any(axis=1)))
        depth = np.minimum(all_rays.depth[pixels], _MAX_DEPTH_M)[first_row:]
        origin, mirrored, descent = _mirror_at_slopes(eye, rays[first_row:], depth, terrain)
    _, face = scene.cast(origin, mirrored.reshape(-1, 3))
    face = face.reshape(mirrored.shape[:2])
    sky_colors = surroundings.sky.toward(*np.moveaxis(mirrored, -1, 0))
    colors = np.maximum(sky_colors, 0)
    hits_solid = face >= 0
    wall_colors = surroundings.colors.wall.view(np.uint8).reshape(-1, 4)[:, :3]
    colors[hits_solid] = wall_colors[face[hits_solid]]
    steepness = (descent / np.linalg.norm(mirrored, axis=-1)).clip(0, 1)
    mirrored_share = _MIRRORED_SHARES[0] + _MIRRORED_SHARES[1] * (1 - steepness) ** 5
    share = surroundings.light.wet * mirrored_share
    size = (width, (len(rows) - first_row) * _REFLECTION_STEP)
    blurred_colors = cv2.GaussianBlur(colors, (1, 3), 0)
    reflection = np.asarray(cv2.resize(blurred_colors, size))
    weight = np.asarray(cv2.resize(share.astype(np.float32), size))
    top = first_row * _REFLECTION_STEP
    num_rows = height - top
    shows_ground = all_rays.face[top:] == GROUND
    weight = np.where(shows_ground, weight[:num_rows], np.float32(0))
    picture[top:] = cv2.blendLinear(picture[top:], reflection[:num_rows], 1 - weight, weight)


def _mirror_at_slopes(
    eye: FloatArray, rays: Float32Array, depth: Float32Array, terrain: Terrain
) -> tuple[FloatArray, Float32Array, AnyArray]:
    """Mirror rays at sloping ground, each where it ends.

    Args:
        eye: Origin of the rays, shape (3,), metres.
        rays: Directions, shape (R, C, 3).
        depth: Distances to where they end, shape (R, C), in lengths of the ray.
        terrain: Shape of the ground.

    Returns:
        Origins of the mirrored rays (R · C, 3), their directions (R, C, 3), and their descent to
        the ground (R, C).
    """
    points = eye + rays * depth[..., None]
    normal = terrain.normal(points[..., :2])
    descent = -(rays * normal).sum(axis=-1)
    origins = points + _GROUND_CLEARANCE_M * normal
    mirrored = rays + 2 * descent[..., None] * normal
    return origins.reshape(-1, 3), mirrored.astype(np.float32), descent


def _add_glow(picture: ByteArray, buffers: Buffers, surroundings: Surroundings) -> ByteArray:
    """Add a glow around lamps to a picture, and return it."""
    import cv2

    coarse_face = buffers.all.face[::2, ::2]
    half_picture = surroundings.colors.shining.take(coarse_face, axis=0, mode="wrap")
    if not half_picture.any():
        return picture
    height, width, _ = picture.shape
    diameter = max(3, width // 80) | 1
    half_height, half_width, _ = half_picture.shape
    quarter_size = ((half_width + 1) // 2, (half_height + 1) // 2)
    quarter_picture = cv2.resize(half_picture, quarter_size, interpolation=cv2.INTER_AREA)
    glow = cv2.GaussianBlur(quarter_picture, (0, 0), diameter / 4)
    full_glow = cv2.resize(glow, (width, height))
    strength = _GLOW_STRENGTH * surroundings.light.lamps
    return np.asarray(cv2.addWeighted(picture, 1.0, full_glow, strength, 0))
