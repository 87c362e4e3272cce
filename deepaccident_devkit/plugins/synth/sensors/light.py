"""Light and air: what time of day and weather do to an image, the sky all around, rain, and lamps."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.plugins.synth.roads import MAP_EXTENT, Arm
from deepaccident_devkit.plugins.synth.sensors.scene import Scene
from deepaccident_devkit.plugins.synth.solids import Color
from deepaccident_devkit.plugins.synth.world import LAMP_COLORS, LANTERN_COLOR, World
from deepaccident_devkit.support.arrays import (
    AnyArray,
    ByteArray,
    Float32Array,
    FloatArray,
    readonly,
)
from deepaccident_devkit.taxonomy import CATEGORIES


@dataclass(frozen=True, slots=True)
class _Sky:
    """Light of a clear sky.

    Attributes:
        tint: colour of the light, 1 is white.
        zenith: colour of the sky overhead.
        horizon: colour of the sky at the horizon.
        elevation: elevation of the sun, degrees.
        sun: the sun's share of the light.
    """

    tint: tuple[float, float, float]
    zenith: tuple[int, int, int]
    horizon: tuple[int, int, int]
    elevation: float
    sun: float


@dataclass(frozen=True, slots=True)
class _Air:
    """The share of sunlight, how much grey replaces the sky's blue, haze a kilometre, wetness of the ground, rain."""

    sun: float
    cover: float
    haze: float
    wet: float = 0.0
    rain: float = 0.0


_TIMES = {
    "Noon": _Sky((1.0, 1.0, 1.0), (86, 140, 214), (196, 214, 232), 52.0, 0.5),
    "Sunset": _Sky((1.0, 0.84, 0.68), (92, 104, 160), (244, 178, 116), 16.0, 0.48),
    "Night": _Sky((0.2, 0.23, 0.33), (8, 11, 24), (26, 30, 48), 40.0, 0.1),
}
_WEATHERS = {
    "Clear": _Air(1.0, 0.0, 1.2),
    "Cloudy": _Air(0.4, 0.7, 2.5),
    "Wet": _Air(0.9, 0.1, 2.0, wet=0.8),
    "WetCloudy": _Air(0.35, 0.75, 3.0, wet=0.8),
    "SoftRain": _Air(0.3, 0.8, 7.0, wet=0.85, rain=0.25),
    "MidRain": _Air(0.2, 0.87, 11.0, wet=0.95, rain=0.55),
    "HardRain": _Air(0.1, 0.95, 18.0, wet=1.0, rain=1.0),
}
_SUN_AZIMUTH = np.deg2rad(-36.0)
_GREY = np.array([168.0, 174.0, 182.0])
_SUN_GAIN = 1.7
_DARK_WHEN_WET = 0.32


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """Light and air of a scenario; colours are RGB, 0 to 255.

    Attributes:
        to_sun: (3,) unit vector to the sun, or to the moon.
        tint: (3,) colour of the light, 1 is white.
        ambient: share of the light that comes from everywhere; the sun gives the rest.
        zenith: (3,) the sky overhead.
        horizon: (3,) the sky at the horizon, and the haze.
        cover: share of the sky under clouds.
        haze: share of the light that haze takes for each metre.
        wet: how wet the ground is, 0 to 1.
        rain: how hard it rains, 0 to 1.
        lamps: how visible the light of lamps is, 0 (by day) to 1 (at night).
    """

    to_sun: FloatArray
    tint: FloatArray
    ambient: float
    zenith: FloatArray
    horizon: FloatArray
    cover: float
    haze: float
    wet: float
    rain: float
    lamps: float

    @property
    def sun(self) -> FloatArray:
        """What the sun adds to a surface that points to it, (3,), as a share of the surface's colour."""
        return np.asarray(self.tint * ((1 - self.ambient) * _SUN_GAIN))

    @property
    def sky(self) -> FloatArray:
        """What the whole sky adds to a level surface, (3,), as a share of the surface's colour."""
        return np.asarray(self.tint * self.ambient)

    @property
    def wet_ground(self) -> float:
        """Brightness of the ground, as a share of that of dry ground."""
        return 1 - _DARK_WHEN_WET * self.wet

    @property
    def in_shadow(self) -> float:
        """Brightness of level ground in a shadow, as a share of that in the sun."""
        sunny = (1 - self.ambient) * _SUN_GAIN * self.to_sun[2]
        return float(self.ambient / (self.ambient + sunny))


def light_of(weather: str, time_of_day: str) -> Light:
    """The light in a weather (of `taxonomy.WEATHERS`) at a time of day (of `taxonomy.TIMES_OF_DAY`)."""
    sky, air = _TIMES[time_of_day], _WEATHERS[weather]
    elevation = np.deg2rad(sky.elevation)
    level = np.cos(elevation)
    to_sun = np.array(
        [level * np.cos(_SUN_AZIMUTH), level * np.sin(_SUN_AZIMUTH), np.sin(elevation)]
    )
    grey = _GREY * float(np.mean(sky.horizon)) / 210
    return Light(
        to_sun=readonly(to_sun),
        tint=readonly(np.array(sky.tint) * (0.82 + 0.18 * air.sun)),
        ambient=1 - sky.sun * air.sun,
        zenith=_mixed(sky.zenith, grey * 0.8, air.cover),
        horizon=_mixed(sky.horizon, grey, air.cover),
        cover=air.cover,
        haze=air.haze / 1000,
        wet=air.wet,
        rain=air.rain,
        lamps={"Noon": 0.0, "Sunset": 0.35, "Night": 1.0}[time_of_day],
    )


def _mixed(color: tuple[int, int, int], other: FloatArray, share: float) -> FloatArray:
    return readonly(np.array(color) * (1 - share) + other * share)


_COLUMNS, _ROWS = 1024, 192
# Slope (height over distance) at the picture's upper edge; higher directions have the colours of this edge.
_STEEPEST = 1.2
# How many clouds there are over a distance equal to the height of the cloud layer.
_DRIFT = 2.5


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """A picture (192, 1025, 3) uint8, RGB: columns by azimuth from x counter-clockwise, rows by slope.

    The last column is the first one again, so that colours between the two can be mixed.
    """

    picture: ByteArray

    def toward(self, x: Float32Array, y: Float32Array, z: Float32Array) -> ByteArray:
        """Colours (R, C, 3) of the sky in directions x, y, z, (R, C) each; below the horizon, those of the horizon."""
        import cv2

        run, azimuth = cv2.cartToPolar(x, y)
        column = np.asarray(azimuth) * np.float32(_COLUMNS / (2 * np.pi))
        rise = np.clip(z / np.maximum(np.asarray(run), np.float32(1e-6)), 0, np.float32(_STEEPEST))
        row = rise * np.float32((_ROWS - 1) / _STEEPEST)
        return np.asarray(
            cv2.remap(self.picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )


def make_sky(light: Light, rng: np.random.Generator) -> Sky:
    """The sky in a light; `rng` draws the clouds."""
    azimuth = (np.arange(_COLUMNS) + 0.5) / _COLUMNS * 2 * np.pi
    rise = np.arange(_ROWS) / (_ROWS - 1) * _STEEPEST
    up = (np.minimum(rise / 0.6, 1.0) ** 0.7)[:, None, None]
    color = np.broadcast_to(
        light.horizon * (1 - up) + light.zenith * up, (_ROWS, _COLUMNS, 3)
    ).copy()
    directions = np.stack(
        np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), rise[:, None]), axis=-1
    )
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    glow = np.maximum(directions @ light.to_sun, 0.0)[..., None]
    strength = 1 - light.ambient
    color += strength * light.tint * (90 * glow**12 + 400 * glow**900)
    cover = (
        _clouds(azimuth, rise, light.cover, rng)[..., None]
        * np.minimum(rise / 0.12, 1.0)[:, None, None]
    )
    lit = light.horizon * (0.92 + 0.12 * glow**4)
    picture = (color * (1 - cover) + lit * cover).clip(0, 255).astype(np.uint8)
    return Sky(np.concatenate([picture, picture[:, :1]], axis=1))


def _clouds(
    azimuth: FloatArray, rise: FloatArray, cover: float, rng: np.random.Generator
) -> FloatArray:
    """How much of each pixel (rows, columns) a layer of clouds takes, 0 to 0.85."""
    import cv2

    noise = _seamless_noise(256, rng)
    distance = _DRIFT / np.maximum(rise, 0.04)[:, None]
    column, row = (
        (distance * turn * 8 % 256).astype(np.float32)
        for turn in (np.cos(azimuth), np.sin(azimuth))
    )
    layer = np.asarray(
        cv2.remap(noise, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP),
        dtype=np.float64,
    )
    level = np.quantile(noise, 1 - min(cover + 0.15, 0.98))
    return np.asarray(0.85 * np.clip((layer - level) / (0.6 * float(noise.std())), 0, 1))


def _seamless_noise(side: int, rng: np.random.Generator) -> Float32Array:
    """Rough and fine noise (side, side) that continues from each edge to the opposite edge."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    spectrum = (
        np.fft.fft2(rng.standard_normal((side, side))) / np.maximum(frequency, 1 / side) ** 1.6
    )
    spectrum[0, 0] = 0
    return np.asarray(np.fft.ifft2(spectrum).real, dtype=np.float32)


# Number of streaks of hard rain in a picture of any size.
_STREAKS = 520
# Steps of a pixel for OpenCV's coordinates, a power of 2.
_SUBPIXEL = 16


def rain_streaks(size: tuple[int, int], rain: float, rng: np.random.Generator) -> ByteArray:
    """Light to add to a picture of `size` (width, height), (H, W, 3) uint8: streaks, near ones longer and brighter."""
    import cv2

    width, height = size
    streaks = np.zeros((height, width), dtype=np.uint8)
    count = int(_STREAKS * rain)
    near = rng.random(count) ** 3
    length = height * (0.02 + 0.11 * near)
    start = rng.random((count, 2)) * (width * 1.1, height) - (0, length.mean())
    end = start + np.column_stack([-0.12 * length, length])
    first, last = ((each * _SUBPIXEL).astype(np.int64).tolist() for each in (start, end))
    bright = (18 + 40 * near).astype(np.int64).tolist()
    for one, other, light in zip(first, last, bright, strict=True):
        cv2.line(streaks, one, other, light, 1, cv2.LINE_AA, 4)
    return np.asarray(cv2.merge([cv2.GaussianBlur(streaks, (3, 3), 0)] * 3))


_CELLS = 600
_CELL = 2 * MAP_EXTENT / _CELLS
# How far a beam reaches ahead of a vehicle, metres, and half its width for each metre ahead.
_BEAM, _SPREAD = 32.0, 0.3
_BEAM_LIGHT, _LANTERN_LIGHT, _LANTERN_REACH = 0.55, 0.22, 16.0
_WITH_LAMPS = tuple(CATEGORIES.index(name) for name in ("car", "van", "truck", "motorcycle"))


def lamplight(scene: Scene) -> Float32Array:
    """Light on the ground, (600, 600), cells of 0.5 m, row = y, column = x; 1 is as bright as noon.

    All moving vehicles have a wide beam ahead and a little light behind them; lanterns have light around them.
    """
    import cv2

    lit = np.zeros((_CELLS, _CELLS), dtype=np.float32)
    for row in scene.setting.moving[
        np.isin(scene.actors.category[scene.setting.moving], _WITH_LAMPS)
    ].tolist():
        x, y, yaw = scene.snapshot.poses[row].tolist()
        _add_beam(lit, x, y, yaw, float(scene.actors.size[row, 0]) / 2)
    props = scene.setting.world.props
    for x, y in (
        props.corners[(props.colors[:, 0] == LANTERN_COLOR).all(axis=1), :, :2]
        .mean(axis=1)
        .tolist()
    ):
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
    beam = (
        np.clip(ahead / 2, 0, 1)
        * np.clip(1 - ahead / _BEAM, 0, 1) ** 1.5
        * np.clip(1.6 - aside / width, 0, 1)
    )
    behind = 0.12 * np.clip(1 - np.hypot(ahead + 2 * half + 1, aside) / 4, 0, 1)
    lit[rows, columns] += (_BEAM_LIGHT * beam + behind).astype(np.float32)


def _add_pool(lit: Float32Array, x: float, y: float) -> None:
    rows, columns, east, north = _around(x, y, _LANTERN_REACH)
    lit[rows, columns] += (
        _LANTERN_LIGHT * np.clip(1 - np.hypot(east, north) / _LANTERN_REACH, 0, 1)
    ).astype(np.float32)


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

    `signals` are 0 red, 1 amber and 2 green by arm, as in `traffic.rights`; the lights of other arms are dark.
    """
    states = {head: signals[head.arm] for head in world.signals if head.arm in signals}
    return {head.rows[state]: LAMP_COLORS[state] for head, state in states.items()}
