"""Assumed masses of road users, as the release has none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.arrays import FloatArray, checked
from deepaccident_devkit.taxonomy import CATEGORIES

CLASS_MASSES: Final[Mapping[str, float]] = MappingProxyType(
    {"car": 1500.0, "truck": 9000.0, "van": 2400.0, "cyclist": 95.0, "motorcycle": 280.0, "pedestrian": 75.0}
)
"""Kilograms of a road user of its class's median size, with load or rider: an assumption of this devkit."""
MASS_UNCERTAINTY: Final = 0.3
"""Share by which these masses may be wrong; figures that depend on them are also given for that much more and less."""
_MEDIAN_SIZES: Final[Mapping[str, tuple[float, float, float]]] = {
    "car": (4.60, 1.93, 1.52),
    "truck": (8.47, 2.89, 3.83),
    "van": (4.48, 1.99, 2.04),
    "cyclist": (1.64, 0.37, 1.77),
    "motorcycle": (2.21, 0.86, 1.53),
    "pedestrian": (0.38, 0.38, 1.86),
}
"""Length, width, height in metres: medians of 250,378 real boxes (docs/format.md)."""
_LEAST, _MOST = 0.5, 2.0
"""How much lighter or heavier than its class a road user can be by its size."""


def masses_of(categories: ArrayLike, sizes: ArrayLike, class_masses: Mapping[str, float] = CLASS_MASSES) -> FloatArray:
    """The assumed masses (N,) of road users in kilograms: their class's, times their volume over the class's median.

    The factor is kept between 0.5 and 2.

    Args:
        categories: (N,) positions in `taxonomy.CATEGORIES`.
        sizes: (N, 3) length, width, height, metres.
        class_masses: class → kilograms at its median size.

    Raises:
        GeometryError: the sizes have another shape.
        ConfigError: a class has no mass, or none above 0.
    """
    codes = np.asarray(categories, dtype=np.int64)
    volumes = checked("sizes", sizes, (len(codes), 3)).prod(axis=1)
    masses = np.array(_masses_in_order(class_masses))
    medians = np.array([np.prod(_MEDIAN_SIZES[name]) for name in CATEGORIES])
    return np.asarray(masses[codes] * np.clip(volumes / medians[codes], _LEAST, _MOST))


def _masses_in_order(class_masses: Mapping[str, float]) -> Sequence[float]:
    missing = [name for name in CATEGORIES if not class_masses.get(name, 0) > 0]
    if missing:
        raise ConfigError(f"class_masses: expected kilograms above 0 for each class; {', '.join(missing)} has none")
    return [float(class_masses[name]) for name in CATEGORIES]
