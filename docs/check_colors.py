"""Measure the colour table for normal and colour-blind eyes: `python docs/check_colors.py`.

Distances are CIELAB ΔE (1976, D65); colour blindness is simulated with the matrices of Machado and
others (2009), severity 1; contrast is WCAG's ratio of luminances.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from deepaccident_devkit.render import styles

EYES = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
"""Linear RGB as each kind of eye sees it, as a matrix that is applied to linear RGB."""
XYZ_FROM_RGB = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
GROUPS = {
    "agents and the pair": (*styles.AGENT_COLORS.values(), styles.COLLIDER_COLOR),
    "verdicts": tuple(styles.OUTCOME_COLORS.values()),
    "classes of vehicles": tuple(styles.CATEGORY_COLORS[name] for name in ("car", "truck", "van")),
    "all classes": tuple(styles.CATEGORY_COLORS.values()),
    "classes by choice, and the pair": (*styles.CLASS_COLORS.values(), styles.COLLIDER_COLOR),
    "series": styles.SERIES_COLORS,
    "splits": tuple(styles.SPLIT_COLORS.values()),
    "a town's ground": tuple(styles.MAP_COLORS.values()),
}
"""Colours that stand together in a picture and must be distinguished."""
GROUNDS = {"white": "#ffffff", "road": styles.BEV_COLORS["road"], "mid-grey image": "#808080"}


def linear(names: Iterable[str]) -> NDArray[np.float64]:
    """Return (N, 3) linear RGB of sRGB colours."""
    encoded = np.array(list(map(to_rgb, names)))
    dark = encoded / 12.92
    bright = ((encoded + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, dark, bright)


def lab(names: Iterable[str], eye: str = "normal") -> NDArray[np.float64]:
    """Return (N, 3) lightness, green to red, and blue to yellow of CIELAB, as an eye of `EYES` sees
    the colours.
    """
    rgb = np.clip(linear(names) @ EYES[eye].T, 0, 1)
    white = XYZ_FROM_RGB.sum(axis=1)
    ratio = rgb @ XYZ_FROM_RGB.T / white
    dark = ratio / (3 * (6 / 29) ** 2) + 4 / 29
    x, y, z = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), dark).T
    return np.column_stack([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def chroma(names: Iterable[str]) -> NDArray[np.float64]:
    """Return (N,) the saturation of colours; grey has 0."""
    _, green_to_red, blue_to_yellow = lab(names).T
    return np.hypot(green_to_red, blue_to_yellow)


def distances(
    first: Iterable[str], second: Iterable[str], eye: str = "normal"
) -> NDArray[np.float64]:
    """Return (N, M) ΔE between the colours of two groups."""
    difference = lab(first, eye)[:, None] - lab(second, eye)
    return np.linalg.norm(difference, axis=-1)


def least_distance(group: Sequence[str], eye: str = "normal") -> float:
    """Return the smallest ΔE between two colours of a group."""
    pairs = np.triu_indices(len(group), 1)
    return float(distances(group, group, eye)[pairs].min())


def contrast(names: Iterable[str], ground: str) -> NDArray[np.float64]:
    """Return (N,) WCAG's ratio of luminances of colours and a ground, from 1 to 21."""
    luminance_weights = XYZ_FROM_RGB[1]
    colors = linear(names) @ luminance_weights + 0.05
    background = linear([ground]) @ luminance_weights + 0.05
    return np.maximum(colors, background) / np.minimum(colors, background)


def main() -> None:
    print(f"{'smallest ΔE':22}", *(f"{eye:>13}" for eye in EYES))
    for name, group in GROUPS.items():
        print(f"{name:22}", *(f"{least_distance(group, eye):13.1f}" for eye in EYES))
    print(f"\n{'smallest contrast':22}", *(f"{ground:>15}" for ground in GROUNDS))
    for name, group in GROUPS.items():
        ratios = [contrast(group, ground).min() for ground in GROUNDS.values()]
        print(f"{name:22}", *(f"{ratio:15.2f}" for ratio in ratios))


if __name__ == "__main__":
    main()
