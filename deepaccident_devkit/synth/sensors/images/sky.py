"""The sky as a picture all around: blue to the horizon, clouds, and the glow of the sun."""

from dataclasses import dataclass

import numpy as np

from deepaccident_devkit.arrays import ByteArray, Float32Array, FloatArray
from deepaccident_devkit.synth.sensors.images.light import Light

_COLUMNS, _ROWS = 1024, 192
_STEEPEST = 1.2
"""Rise over run of the picture's upper edge; what is higher looks as it does."""
_DRIFT = 2.5
"""Clouds in the run of a cloud layer at a height of 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Sky:
    """A picture (192, 1024, 3) uint8, RGB: columns by azimuth from x counter-clockwise, rows by rise over run."""

    picture: ByteArray

    def toward(self, x: Float32Array, y: Float32Array, z: Float32Array) -> ByteArray:
        """Colours (R, C, 3) of the sky in directions (R, C) each, of any length; below the horizon, the horizon's."""
        import cv2

        run, azimuth = cv2.cartToPolar(x, y)
        column = np.asarray(azimuth) * np.float32(_COLUMNS / (2 * np.pi))
        rise = np.clip(z / np.maximum(np.asarray(run), np.float32(1e-6)), 0, np.float32(_STEEPEST))
        row = rise * np.float32((_ROWS - 1) / _STEEPEST)
        wrapped = cv2.copyMakeBorder(self.picture, 0, 0, 0, 1, cv2.BORDER_WRAP)
        return np.asarray(cv2.remap(wrapped, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def make_sky(light: Light, rng: np.random.Generator) -> Sky:
    """The sky in some light; `rng` draws the clouds."""
    azimuth = (np.arange(_COLUMNS) + 0.5) / _COLUMNS * 2 * np.pi
    rise = np.arange(_ROWS) / (_ROWS - 1) * _STEEPEST
    up = (np.minimum(rise / 0.6, 1.0) ** 0.7)[:, None, None]
    color = np.broadcast_to(light.horizon * (1 - up) + light.zenith * up, (_ROWS, _COLUMNS, 3)).copy()
    directions = np.stack(np.broadcast_arrays(np.cos(azimuth), np.sin(azimuth), rise[:, None]), axis=-1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    glow = np.maximum(directions @ light.to_sun, 0.0)[..., None]
    strength = 1 - light.ambient
    color += strength * light.tint * (90 * glow**12 + 400 * glow**900)
    cover = _clouds(azimuth, rise, light.cover, rng)[..., None] * np.minimum(rise / 0.12, 1.0)[:, None, None]
    lit = light.horizon * (0.92 + 0.12 * glow**4)
    return Sky((color * (1 - cover) + lit * cover).clip(0, 255).astype(np.uint8))


def _clouds(azimuth: FloatArray, rise: FloatArray, cover: float, rng: np.random.Generator) -> FloatArray:
    """How much of each pixel (rows, columns) a layer of clouds takes, 0 to 0.85."""
    import cv2

    noise = _seamless_noise(256, rng)
    distance = _DRIFT / np.maximum(rise, 0.04)[:, None]
    column, row = ((distance * turn * 8 % 256).astype(np.float32) for turn in (np.cos(azimuth), np.sin(azimuth)))
    layer = np.asarray(cv2.remap(noise, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), dtype=np.float64)
    level = np.quantile(noise, 1 - min(cover + 0.15, 0.98))
    return np.asarray(0.85 * np.clip((layer - level) / (0.6 * float(noise.std())), 0, 1))


def _seamless_noise(side: int, rng: np.random.Generator) -> Float32Array:
    """Noise (side, side) that goes on over the edges, rough and fine alike."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    spectrum = np.fft.fft2(rng.standard_normal((side, side))) / np.maximum(frequency, 1 / side) ** 1.6
    spectrum[0, 0] = 0
    return np.asarray(np.fft.ifft2(spectrum).real, dtype=np.float32)
