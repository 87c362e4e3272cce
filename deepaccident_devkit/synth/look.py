"""How a scenario looks: sun, sky, weather, and the ground as pictures of falling resolution."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepaccident_devkit.arrays import AnyArray, ByteArray, FloatArray
from deepaccident_devkit.synth import roads
from deepaccident_devkit.synth.roads import GroundMap
from deepaccident_devkit.synth.shadows import with_shadows
from deepaccident_devkit.synth.world import World

_COLORS = {
    roads.TERRAIN: (126, 134, 100),
    roads.ROAD: (92, 93, 96),
    roads.WHITE: (226, 226, 222),
    roads.YELLOW: (222, 184, 72),
    roads.SIDEWALK: (168, 164, 156),
    roads.GRASS: (112, 132, 84),
}
_SUN = np.array([0.52, -0.38, 0.76]) / np.linalg.norm([0.52, -0.38, 0.76])
_GRAIN = 7.0
"""Of the ground: standard deviation of its brightness from cell to cell."""
_SUN_GAIN = 1.35
LEVELS = 3
SHRINK = 4
"""Of the ground's pictures: how many there are, and how much coarser each is than the one before."""


@dataclass(frozen=True, slots=True)
class _Light:
    """Colours of the light (1 is white), of the sky overhead and at the horizon, and the sun's share of the light."""

    tint: tuple[float, float, float]
    zenith: tuple[int, int, int]
    horizon: tuple[int, int, int]
    sun: float


@dataclass(frozen=True, slots=True)
class _Air:
    """Sun that comes through, how far grey replaces the sky's blue, haze a kilometre, darkness of a wet road."""

    sun: float
    cover: float
    haze: float
    road: float


_TIMES = {
    "Noon": _Light((1.0, 1.0, 1.0), (86, 140, 214), (196, 214, 232), 0.62),
    "Sunset": _Light((1.0, 0.84, 0.68), (92, 104, 160), (244, 178, 116), 0.6),
    "Night": _Light((0.38, 0.42, 0.56), (14, 18, 36), (44, 50, 74), 0.3),
}
_WEATHERS = {
    "Clear": _Air(1.0, 0.0, 1.2, 1.0),
    "Cloudy": _Air(0.45, 0.7, 2.0, 1.0),
    "Wet": _Air(0.9, 0.1, 1.8, 0.8),
    "WetCloudy": _Air(0.4, 0.75, 2.5, 0.78),
    "SoftRain": _Air(0.4, 0.8, 5.0, 0.8),
    "MidRain": _Air(0.3, 0.85, 7.0, 0.74),
    "HardRain": _Air(0.2, 0.92, 10.0, 0.68),
}


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Colours are RGB, 0 to 255.

    Attributes:
        ground: the map in colour with the shadows of what stands still, (3000, 3000, 3) uint8.
        tint: (3,) of the light.
        ambient: share of the light that comes from everywhere; the sun gives the rest.
        zenith: (3,) the sky overhead.
        horizon: (3,) the sky at the horizon, and the haze.
        haze: share of the light that haze takes, a metre.
        lit_windows: whether some windows shine.
    """

    ground: ByteArray
    tint: FloatArray
    ambient: float
    zenith: FloatArray
    horizon: FloatArray
    haze: float
    lit_windows: bool

    def shaded(self, colors: FloatArray, normals: FloatArray) -> FloatArray:
        """Colours (F, 3) of faces with outward normals (F, 3) in this light, (F, 3)."""
        sunlight = (1 - self.ambient) * _SUN_GAIN * np.maximum(normals @ _SUN, 0.0)
        skylight = self.ambient * (0.88 + 0.12 * normals[:, 2])
        lit: FloatArray = np.minimum(colors * self.tint * (skylight + sunlight)[:, None], 255.0)
        return lit

    def ground_pictures(self, corners: FloatArray) -> tuple[ByteArray, ...]:
        """The ground with the shadows of some solids (P, 8, 3), each picture with cells `SHRINK` times as large."""
        import cv2

        levels = [with_shadows(self.ground, corners, _SUN, self.shadow)]
        for _ in range(LEVELS - 1):
            side = len(levels[-1]) // SHRINK
            smaller = cv2.resize(levels[-1], (side, side), interpolation=cv2.INTER_AREA)
            levels.append(np.asarray(smaller, dtype=np.uint8))
        return tuple(levels)

    @property
    def shadow(self) -> float:
        """Brightness of the ground in a shadow, as a share of what it is in the light."""
        return float(self.ambient / (self.ambient + (1 - self.ambient) * _SUN_GAIN * _SUN[2]))

    def hazed(self, colors: AnyArray, distance: FloatArray) -> FloatArray:
        """Colours (…, 3) seen from `distance` (…, 1) or (…,) metres."""
        seen = np.exp(-self.haze * distance)[..., None]
        mixed: FloatArray = colors * seen + self.horizon * (1 - seen)
        return mixed


def make_look(world: World, weather: str, time_of_day: str, rng: np.random.Generator) -> Look:
    """The look of a place in some weather at some time of day; `rng` grains the ground."""
    light, air = _TIMES[time_of_day], _WEATHERS[weather]
    sun = light.sun * air.sun
    tint = np.array(light.tint) * (0.86 + 0.14 * air.sun)
    night_or_day = float(np.mean(light.horizon)) / 210
    grey = np.array([168.0, 174.0, 182.0]) * night_or_day
    plain = Look(
        ground=_ground_picture(world.ground, tint * (1 - 0.1 * sun), air.road, rng),
        tint=tint,
        ambient=1 - sun,
        zenith=_mixed(light.zenith, grey * 0.8, air.cover),
        horizon=_mixed(light.horizon, grey, air.cover),
        haze=air.haze / 1000,
        lit_windows=time_of_day == "Night",
    )
    # façades are left out: their shadows would fall over road users that are shaded as if in the sun
    things = world.props.corners[~world.props.facade]
    return replace(plain, ground=with_shadows(plain.ground, things, _SUN, plain.shadow))


def _mixed(color: tuple[int, int, int], other: FloatArray, share: float) -> FloatArray:
    return np.array(color) * (1 - share) + other * share


def _ground_picture(ground: GroundMap, tint: FloatArray, road: float, rng: np.random.Generator) -> ByteArray:
    """The map in colour, (3000, 3000, 3): grain from a tile, repeated."""
    palette = np.zeros((256, 3))
    for code, color in _COLORS.items():
        palette[code] = np.array(color) * tint * (road if code == roads.ROAD else 1.0)
    tile = 500
    grain: NDArray[np.int16] = rng.normal(0, _GRAIN, (tile, tile)).round().astype(np.int16)
    shades = (palette[:, None, :] + np.arange(-32, 33)[None, :, None]).clip(0, 255).astype(np.uint8)
    repeated = np.tile(grain.clip(-32, 32) + 32, (roads.MAP_CELLS // tile, roads.MAP_CELLS // tile))
    return np.asarray(shades[ground.codes, repeated])
