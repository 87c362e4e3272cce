"""The cameras' pictures: the nearest surface at every pixel, in the light of the scenario."""

from collections.abc import Mapping

import numpy as np

from deepaccident_devkit.arrays import AnyArray, ByteArray, Float32Array, FloatArray
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.synth.roads import Arm, Terrain
from deepaccident_devkit.synth.sensors.agents import Camera
from deepaccident_devkit.synth.sensors.caster import GROUND
from deepaccident_devkit.synth.sensors.images.buffers import Buffers, look, ray_directions, slopes
from deepaccident_devkit.synth.sensors.images.facades import facades_of
from deepaccident_devkit.synth.sensors.images.ground import ground_of, still_ground
from deepaccident_devkit.synth.sensors.images.lamplight import lamplight, lit_lamps
from deepaccident_devkit.synth.sensors.images.light import light_of, make_sky, rain_streaks
from deepaccident_devkit.synth.sensors.images.paint import moving_palette, packed, still_palette
from deepaccident_devkit.synth.sensors.images.shading import Surroundings, shade
from deepaccident_devkit.synth.sensors.images.shadows import wall_shadows
from deepaccident_devkit.synth.sensors.scene import Scene
from deepaccident_devkit.synth.sensors.setting import Setting

_GLOW = 0.9
_REFLECTION_STEP = 4
"""Pixels across and down for each ray of a reflection on wet ground, which is blurred in any case."""
_MIRRORING = (0.05, 0.6)
"""Share of the light that wet ground mirrors, seen from straight above and seen at a very small angle."""

_CLEAR_OF_GROUND = 0.05
"""Metres above a slope where mirrored rays begin, so that they do not meet the slope's own triangles."""
_FAR = 1000.0


class Studio:
    """What the pictures of a scenario have in common: light, sky, and all that stands still.

    Attributes:
        light: light and air.
    """

    def __init__(self, setting: Setting, weather: str, time_of_day: str, rng: np.random.Generator) -> None:
        self.light = light_of(weather, time_of_day)
        self._sky = make_sky(self.light, rng)
        self._ground = still_ground(setting, self.light, rng)
        self._palette = still_palette(setting, self.light)
        self._facades = facades_of(setting.still)
        self._shadows = wall_shadows(setting, self._facades, self.light)

    def surroundings(self, scene: Scene, signals: Mapping[Arm, int]) -> Surroundings:
        """The colours of a moment, for the cameras of all agents; `signals` as in `lamplight.lit_lamps`."""
        lamps = lit_lamps(scene.setting.world, signals)
        rows = scene.setting.props
        return Surroundings(
            light=self.light,
            sky=self._sky,
            ground=ground_of(self._ground, scene, self.light),
            facades=self._facades,
            shadows=self._shadows,
            colors=packed(
                self._palette,
                moving_palette(scene, self.light),
                {int(rows[row]): color for row, color in lamps.items()},
            ),
            lamplight=lamplight(scene) if self.light.lamps else None,
        )


def render(
    scene: Scene, around: Surroundings, camera: Camera, ground_from_camera: SE3, rng: np.random.Generator
) -> ByteArray:
    """The picture (H, W, 3) uint8, RGB; `rng` draws the rain."""
    import cv2

    buffers = look(scene, camera, ground_from_camera)
    picture = shade(buffers.all, around, ground_from_camera)
    if len(buffers.outline):
        fine = shade(buffers.fine, around, ground_from_camera).reshape(-1, 2, 3)[: len(buffers.outline)]
        picture.reshape(-1, 3)[buffers.outline] = (fine.astype(np.uint16).sum(axis=1) // 2).astype(np.uint8)
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
        pixels = np.ix_(rows.astype(np.intp).clip(max=height - 1), columns.astype(np.intp).clip(max=width - 1))
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


def _below_level_ground(eye: FloatArray, rays: Float32Array) -> tuple[FloatArray, Float32Array, AnyArray]:
    """The mirrored rays of level ground: those of the camera's mirror image below it.

    Returns:
        where mirrored rays begin (3,), their directions (R, C, 3), and how much the rays fall to the ground (R, C).
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
    return begin.reshape(-1, 3), (rays + 2 * falling[..., None] * normal).astype(np.float32), falling


def _with_glow(picture: ByteArray, buffers: Buffers, around: Surroundings) -> ByteArray:
    """The picture with light around lamps."""
    import cv2

    half = around.colors.shining.take(buffers.all.face[::2, ::2], axis=0, mode="wrap")
    if not half.any():
        return picture
    wide = max(3, picture.shape[1] // 80) | 1
    small = cv2.resize(half, (-(-half.shape[1] // 2), -(-half.shape[0] // 2)), interpolation=cv2.INTER_AREA)
    glow = cv2.GaussianBlur(small, (0, 0), wide / 4)
    bright = cv2.resize(glow, (picture.shape[1], picture.shape[0]))
    return np.asarray(cv2.addWeighted(picture, 1.0, bright, _GLOW * around.light.lamps, 0))
