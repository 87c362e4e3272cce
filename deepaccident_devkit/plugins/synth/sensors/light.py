"""Light and air: the effects of time of day and weather on images, the sky, rain, and lamps."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.plugins.synth.roads import MAP_EXTENT, Arm
from deepaccident_devkit.plugins.synth.roads.paths import ahead_and_left
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

_SUN_AZIMUTH = np.deg2rad(-36.0)
_CLOUD_GREY = np.array([168.0, 174.0, 182.0])
_SUN_GAIN = 1.7
_WET_DARKENING = 0.32
_SKY_COLUMNS, _SKY_ROWS = 1024, 192
# Slope (height over distance) at the upper edge of the sky's picture. Higher directions have the
# colours of this edge.
_MAX_SKY_SLOPE = 1.2
# Number of clouds over a distance equal to the height of the cloud layer.
_CLOUD_DENSITY = 2.5
# Number of streaks of hard rain in a picture of any size.
_NUM_STREAKS = 520
# Steps in each pixel of the coordinates that OpenCV takes, a power of 2.
_SUBPIXEL_STEPS = 16
_LIGHT_CELLS = 600
_CELL_SIZE_M = 2 * MAP_EXTENT / _LIGHT_CELLS
# Length of a beam ahead of a vehicle, and half its width for each metre ahead.
_BEAM_LENGTH_M = 32.0
_BEAM_SPREAD = 0.3
_BEAM_BRIGHTNESS = 0.55
_LANTERN_BRIGHTNESS = 0.22
_LANTERN_REACH_M = 16.0
_CATEGORIES_WITH_LAMPS = tuple(
    CATEGORIES.index(name) for name in ("car", "van", "truck", "motorcycle")
)


@dataclass(frozen=True, slots=True)
class _ClearSky:
    """Light of a clear sky.

    Attributes:
        tint: Colour of the light, 1 is white.
        zenith: Colour of the sky overhead.
        horizon: Colour of the sky at the horizon.
        elevation: Elevation of the sun, degrees.
        sun: Share of the sun in the light.
    """

    tint: tuple[float, float, float]
    zenith: tuple[int, int, int]
    horizon: tuple[int, int, int]
    elevation: float
    sun: float


@dataclass(frozen=True, slots=True)
class _WeatherAir:
    """The air of a weather.

    Attributes:
        sun: Share of the sunlight that it lets through.
        cover: Share of the sky's blue that grey replaces.
        haze: Haze for each kilometre, as for `Light.haze`.
        wet: Wetness of the ground.
        rain: Strength of the rain.
    """

    sun: float
    cover: float
    haze: float
    wet: float = 0.0
    rain: float = 0.0


_SKY_BY_TIME = {
    "Noon": _ClearSky((1.0, 1.0, 1.0), (86, 140, 214), (196, 214, 232), 52.0, 0.5),
    "Sunset": _ClearSky((1.0, 0.84, 0.68), (92, 104, 160), (244, 178, 116), 16.0, 0.48),
    "Night": _ClearSky((0.2, 0.23, 0.33), (8, 11, 24), (26, 30, 48), 40.0, 0.1),
}
_AIR_BY_WEATHER = {
    "Clear": _WeatherAir(1.0, 0.0, 1.2),
    "Cloudy": _WeatherAir(0.4, 0.7, 2.5),
    "Wet": _WeatherAir(0.9, 0.1, 2.0, wet=0.8),
    "WetCloudy": _WeatherAir(0.35, 0.75, 3.0, wet=0.8),
    "SoftRain": _WeatherAir(0.3, 0.8, 7.0, wet=0.85, rain=0.25),
    "MidRain": _WeatherAir(0.2, 0.87, 11.0, wet=0.95, rain=0.55),
    "HardRain": _WeatherAir(0.1, 0.95, 18.0, wet=1.0, rain=1.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """Light and air of a scenario; colours are RGB, 0 to 255.

    Attributes:
        to_sun: Unit vector to the sun, or to the moon, shape (3,).
        tint: Colour of the light, shape (3,), 1 is white.
        ambient: Share of the light that comes from everywhere; the sun gives the rest.
        zenith: Colour of the sky overhead, shape (3,).
        horizon: Colour of the sky at the horizon, and of the haze, shape (3,).
        cover: Share of the sky under clouds.
        haze: Share of the light that haze takes for each metre.
        wet: Wetness of the ground, 0 to 1.
        rain: Strength of the rain, 0 to 1.
        lamps: Visibility of the light of lamps, 0 (by day) to 1 (at night).
    """

    # sun and ambient light
    to_sun: FloatArray
    tint: FloatArray
    ambient: float
    # sky
    zenith: FloatArray
    horizon: FloatArray
    cover: float
    # weather
    haze: float
    wet: float
    rain: float
    # lamps
    lamps: float

    @property
    def sun(self) -> FloatArray:
        """Light of the sun on a surface that points to it, shape (3,).

        It is a share of the surface's colour.
        """
        return np.asarray(self.tint * self._sun_share)

    @property
    def sky(self) -> FloatArray:
        """Light of the sky on a level surface, shape (3,), as a share of the surface's colour."""
        return np.asarray(self.tint * self.ambient)

    @property
    def wet_ground(self) -> float:
        """Brightness of the ground, as a share of dry ground's."""
        return 1 - _WET_DARKENING * self.wet

    @property
    def in_shadow(self) -> float:
        """Brightness of level ground in a shadow, as a share of its brightness in the sun."""
        sunlight = self._sun_share * self.to_sun[2]
        return float(self.ambient / (self.ambient + sunlight))

    @property
    def _sun_share(self) -> float:
        """Share of the sun in the light, with its gain."""
        direct_share = 1 - self.ambient
        return direct_share * _SUN_GAIN


def make_light(weather: str, time_of_day: str) -> Light:
    """Return the light in a weather at a time of day.

    Args:
        weather: One of `taxonomy.WEATHERS`.
        time_of_day: One of `taxonomy.TIMES_OF_DAY`.
    """
    sky = _SKY_BY_TIME[time_of_day]
    air = _AIR_BY_WEATHER[weather]
    elevation = np.deg2rad(sky.elevation)
    level = np.cos(elevation)
    to_sun = np.array(
        [level * np.cos(_SUN_AZIMUTH), level * np.sin(_SUN_AZIMUTH), np.sin(elevation)]
    )
    grey = _CLOUD_GREY * float(np.mean(sky.horizon)) / 210
    return Light(
        to_sun=readonly(to_sun),
        tint=readonly(np.array(sky.tint) * (0.82 + 0.18 * air.sun)),
        ambient=1 - sky.sun * air.sun,
        zenith=_mix_colors(sky.zenith, grey * 0.8, air.cover),
        horizon=_mix_colors(sky.horizon, grey, air.cover),
        cover=air.cover,
        haze=air.haze / 1000,
        wet=air.wet,
        rain=air.rain,
        lamps={"Noon": 0.0, "Sunset": 0.35, "Night": 1.0}[time_of_day],
    )


def _mix_colors(
    color: tuple[int, int, int], other_color: FloatArray, other_share: float
) -> FloatArray:
    """Return a colour mixed with a share of another one."""
    mixed = np.array(color) * (1 - other_share) + other_color * other_share
    return readonly(mixed)


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """A picture of the sky.

    Attributes:
        picture: RGB picture, shape (192, 1025, 3), uint8: columns by azimuth from x
            counter-clockwise, rows by slope. The last column is the first one again, so that
            colours between the two can be mixed.
    """

    picture: ByteArray

    def toward(self, x: Float32Array, y: Float32Array, z: Float32Array) -> ByteArray:
        """Return the colours (R, C, 3) of the sky in directions x, y, z, (R, C) each.

        Below the horizon they are the colours of the horizon.
        """
        import cv2

        distance, azimuth = cv2.cartToPolar(x, y)
        column = np.asarray(azimuth) * np.float32(_SKY_COLUMNS / (2 * np.pi))
        slope = z / np.maximum(np.asarray(distance), np.float32(1e-6))
        slope = np.clip(slope, 0, np.float32(_MAX_SKY_SLOPE))
        row = slope * np.float32((_SKY_ROWS - 1) / _MAX_SKY_SLOPE)
        colors = cv2.remap(
            self.picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(colors)


def make_sky(light: Light, rng: np.random.Generator) -> Sky:
    """Make the sky in a light; `rng` draws the clouds."""
    azimuth = (np.arange(_SKY_COLUMNS) + 0.5) / _SKY_COLUMNS * 2 * np.pi
    slope = np.arange(_SKY_ROWS) / (_SKY_ROWS - 1) * _MAX_SKY_SLOPE
    zenith_share = np.minimum(slope / 0.6, 1.0) ** 0.7
    zenith_share = zenith_share[:, None, None]
    gradient = light.horizon * (1 - zenith_share) + light.zenith * zenith_share
    color = np.broadcast_to(gradient, (_SKY_ROWS, _SKY_COLUMNS, 3)).copy()
    columns = np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), slope[:, None])
    directions = np.stack(columns, axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    sun_cosine = np.maximum(directions @ light.to_sun, 0.0)[..., None]
    sun_strength = 1 - light.ambient
    glow = 90 * sun_cosine**12 + 400 * sun_cosine**900
    color += sun_strength * light.tint * glow
    clouds = _draw_clouds(azimuth, slope, light.cover, rng)[..., None]
    horizon_fade = np.minimum(slope / 0.12, 1.0)
    cover = clouds * horizon_fade[:, None, None]
    cloud_color = light.horizon * (0.92 + 0.12 * sun_cosine**4)
    mixed = color * (1 - cover) + cloud_color * cover
    picture = mixed.clip(0, 255).astype(np.uint8)
    return Sky(np.concatenate([picture, picture[:, :1]], axis=1))


def _draw_clouds(
    azimuth: FloatArray, slope: FloatArray, cover: float, rng: np.random.Generator
) -> FloatArray:
    """Draw a layer of clouds.

    Args:
        azimuth: Azimuth of each column of the sky's picture, radians.
        slope: Slope of each row.
        cover: Share of the sky under clouds.
        rng: Generator of random numbers.

    Returns:
        Fraction of each pixel that clouds cover, shape (rows, columns), 0 to 0.85.
    """
    import cv2

    noise = _draw_noise(256, rng)
    distance = _CLOUD_DENSITY / np.maximum(slope, 0.04)[:, None]
    column = (distance * np.cos(azimuth) * 8 % 256).astype(np.float32)
    row = (distance * np.sin(azimuth) * 8 % 256).astype(np.float32)
    values = cv2.remap(noise, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    layer = np.asarray(values, dtype=np.float64)
    cloud_share = min(cover + 0.15, 0.98)
    threshold = np.quantile(noise, 1 - cloud_share)
    thickness = (layer - threshold) / (0.6 * float(noise.std()))
    return np.asarray(0.85 * np.clip(thickness, 0, 1))


def _draw_noise(side: int, rng: np.random.Generator) -> Float32Array:
    """Draw rough and fine noise (side, side) that continues across opposite edges."""
    frequencies = np.fft.fftfreq(side)
    frequency = np.hypot(frequencies[None, :], frequencies[:, None])
    white_noise = np.fft.fft2(rng.standard_normal((side, side)))
    spectrum = white_noise / np.maximum(frequency, 1 / side) ** 1.6
    spectrum[0, 0] = 0
    return np.asarray(np.fft.ifft2(spectrum).real, dtype=np.float32)


def draw_rain(size: tuple[int, int], rain: float, rng: np.random.Generator) -> ByteArray:
    """Draw the light of rain to add to a picture: streaks, near ones longer and brighter.

    Args:
        size: Width and height of the picture, pixels.
        rain: Strength of the rain, 0 to 1.
        rng: Generator of random numbers.

    Returns:
        Light, shape (H, W, 3), uint8.
    """
    import cv2

    width, height = size
    streaks = np.zeros((height, width), dtype=np.uint8)
    count = int(_NUM_STREAKS * rain)
    nearness = rng.random(count) ** 3
    length = height * (0.02 + 0.11 * nearness)
    start = rng.random((count, 2)) * (width * 1.1, height) - (0, length.mean())
    end = start + np.column_stack([-0.12 * length, length])
    start_points = (start * _SUBPIXEL_STEPS).astype(np.int64).tolist()
    end_points = (end * _SUBPIXEL_STEPS).astype(np.int64).tolist()
    brightness = (18 + 40 * nearness).astype(np.int64).tolist()
    for start_point, end_point, value in zip(start_points, end_points, brightness, strict=True):
        cv2.line(streaks, start_point, end_point, value, 1, cv2.LINE_AA, 4)
    blurred = cv2.GaussianBlur(streaks, (3, 3), 0)
    return np.asarray(cv2.merge([blurred] * 3))


def draw_lamplight(scene: Scene) -> Float32Array:
    """Draw the light of lamps on the ground.

    All moving vehicles have a wide beam ahead and a little light behind them; lanterns have light
    around them.

    Returns:
        Light, shape (600, 600), cells of 0.5 m, row = y, column = x; 1 is as bright as noon.
    """
    import cv2

    light_map = np.zeros((_LIGHT_CELLS, _LIGHT_CELLS), dtype=np.float32)
    moving = scene.setting.moving
    has_lamps = np.isin(scene.actors.category[moving], _CATEGORIES_WITH_LAMPS)
    for row in moving[has_lamps].tolist():
        x, y, yaw = scene.snapshot.poses[row].tolist()
        half_length = float(scene.actors.size[row, 0]) / 2
        _add_beam(light_map, x, y, yaw, half_length)
    props = scene.setting.world.props
    is_lantern = (props.colors[:, 0] == LANTERN_COLOR).all(axis=1)
    lantern_positions = props.corners[is_lantern, :, :2].mean(axis=1)
    for x, y in lantern_positions.tolist():
        window, east, north = _find_cells_around(x, y, _LANTERN_REACH_M)
        distance = np.hypot(east, north)
        decay = np.clip(1 - distance / _LANTERN_REACH_M, 0, 1)
        light_map[window] += (_LANTERN_BRIGHTNESS * decay).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(light_map, (5, 5), 0))


def sample_light(light_map: Float32Array, x: Float32Array, y: Float32Array) -> Float32Array:
    """Return the light (R, C) at points; 0 beyond the map.

    Args:
        light_map: Light on the ground, from `draw_lamplight`.
        x: Coordinates x of the points, shape (R, C), metres.
        y: Coordinates y of the points, shape (R, C), metres.
    """
    import cv2

    scale = np.float32(1 / _CELL_SIZE_M)
    shift = np.float32(MAP_EXTENT / _CELL_SIZE_M - 0.5)
    column = x * scale + shift
    row = y * scale + shift
    light = cv2.remap(light_map, column, row, cv2.INTER_LINEAR)
    return np.asarray(light)


def _add_beam(light_map: Float32Array, x: float, y: float, yaw: float, half_length: float) -> None:
    """Add the light of a vehicle to a map, in place.

    Args:
        light_map: Light on the ground.
        x: Position x of the vehicle's middle, metres.
        y: Position y of the vehicle's middle, metres.
        yaw: Heading of the vehicle, radians.
        half_length: Half its length, metres.
    """
    window, east, north = _find_cells_around(x, y, _BEAM_LENGTH_M + half_length)
    if not east.size:
        return
    from_middle, lateral = ahead_and_left(east, north, yaw)
    ahead = from_middle - half_length
    to_side = np.abs(lateral)
    half_width = 0.9 + _BEAM_SPREAD * np.maximum(ahead, 0)
    onset = np.clip(ahead / 2, 0, 1)
    decay = np.clip(1 - ahead / _BEAM_LENGTH_M, 0, 1) ** 1.5
    beam = onset * decay * np.clip(1.6 - to_side / half_width, 0, 1)
    from_rear = np.hypot(ahead + 2 * half_length + 1, to_side)
    rear_light = 0.12 * np.clip(1 - from_rear / 4, 0, 1)
    light_map[window] += (_BEAM_BRIGHTNESS * beam + rear_light).astype(np.float32)


def _find_cells_around(
    x: float, y: float, radius_m: float
) -> tuple[tuple[slice, slice], AnyArray, AnyArray]:
    """Return the cells of the light map up to `radius_m` from a point.

    Returns:
        Rows and columns, and the distances of the cells to the east (1, C) and north (R, 1).
    """
    rows = _find_cell_span(y, radius_m)
    columns = _find_cell_span(x, radius_m)
    north = _compute_cell_offsets(rows, y)
    east = _compute_cell_offsets(columns, x)
    return (rows, columns), east[None, :], north[:, None]


def _find_cell_span(coordinate_m: float, radius_m: float) -> slice:
    """Return the rows or columns of the light map up to `radius_m` from a coordinate."""
    start = int((coordinate_m - radius_m + MAP_EXTENT) / _CELL_SIZE_M)
    stop = int((coordinate_m + radius_m + MAP_EXTENT) / _CELL_SIZE_M) + 1
    first_cell = max(start, 0)
    end_cell = min(max(stop, 0), _LIGHT_CELLS)
    return slice(first_cell, end_cell)


def _compute_cell_offsets(span: slice, coordinate_m: float) -> AnyArray:
    """Return the distances of rows or columns of the light map from a coordinate, metres."""
    cells = np.arange(span.start, max(span.stop, span.start))
    positions = (cells + 0.5) * _CELL_SIZE_M - MAP_EXTENT
    return positions - coordinate_m


def find_lit_lamps(world: World, signals: Mapping[Arm, int]) -> dict[int, Color]:
    """Return the colours of the lamps that shine, by their rows among `World.props`.

    Args:
        world: The static world.
        signals: State of the light of each arm, as in `traffic.rights`: 0 red, 1 amber and 2 green;
            the lights of other arms are dark.
    """
    colors = {}
    for head in world.signals:
        if head.arm in signals:
            state = signals[head.arm]
            lamp_row = head.rows[state]
            colors[lamp_row] = LAMP_COLORS[state]
    return colors
