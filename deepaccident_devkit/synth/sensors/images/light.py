"""Light and air: what time of day and weather do to an image."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import FloatArray, readonly


@dataclass(frozen=True, slots=True)
class _Sky:
    """Light of a clear sky.

    Attributes:
        tint: colour of the light, 1 is white.
        zenith: colour of the sky overhead.
        horizon: colour of the sky at the horizon.
        elevation: of the sun, degrees.
        sun: its share of the light.
    """

    tint: tuple[float, float, float]
    zenith: tuple[int, int, int]
    horizon: tuple[int, int, int]
    elevation: float
    sun: float


@dataclass(frozen=True, slots=True)
class _Air:
    """Sun that comes through, how far grey replaces the sky's blue, haze a kilometre, wetness of the ground, rain."""

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
        tint: (3,) of the light, 1 is white.
        ambient: share of the light that comes from everywhere; the sun gives the rest.
        zenith: (3,) the sky overhead.
        horizon: (3,) the sky at the horizon, and the haze.
        cover: share of the sky under clouds.
        haze: share of the light that haze takes, a metre.
        wet: how wet the ground is, 0 to 1.
        rain: how hard it rains, 0 to 1.
        lamps: how far lamps outshine the light, 0 (by day) to 1 (at night).
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
        """What the sun adds to a surface that faces it, (3,), as a share of the surface's colour."""
        return np.asarray(self.tint * ((1 - self.ambient) * _SUN_GAIN))

    @property
    def sky(self) -> FloatArray:
        """What the whole sky adds to a level surface, (3,), likewise."""
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
    to_sun = np.array([level * np.cos(_SUN_AZIMUTH), level * np.sin(_SUN_AZIMUTH), np.sin(elevation)])
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
