"""Hypothesis strategies of our own tests, which add to the ones of the test kit."""

from hypothesis import strategies as st

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.testing.strategies import (
    ANGLES,
    arrays,
    boxes,
    calibs,
    cameras,
    clouds,
    labels,
    matrices,
    metas,
    numbers,
    points,
    poses,
    rotation_matrix,
    upright_boxes,
)
from deepaccident_devkit.testing.strategies import damaged as mutations

__all__ = [
    "ANGLES",
    "arrays",
    "boxes",
    "calibs",
    "cameras",
    "clouds",
    "grids",
    "labels",
    "matrices",
    "metas",
    "mutations",
    "numbers",
    "points",
    "poses",
    "rotation_matrix",
    "upright_boxes",
]


@st.composite
def grids(draw: st.DrawFn) -> BevGrid:
    """Small BEV grids in every orientation, not square and not centred as a rule."""
    axes = []
    for _ in range(2):
        start, size = draw(st.integers(-50, 50)), draw(st.sampled_from([0.1, 0.25, 0.5, 1.0, 3.0]))
        axes.append((start, start + draw(st.integers(1, 12)) * size, size))
    return BevGrid(axes[0], axes[1], draw(st.sampled_from(["devkit", "released", "fiery"])))
