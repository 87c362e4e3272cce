"""The crop to a task's grid, and the two encoders."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support.expected_errors import assert_raises
from torch_extra.model.gradients import names_without_gradient

from deepaccident_devkit.errors import ConfigError, GeometryError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.bev_grid import ORIENTATIONS
from deepaccident_devkit.plugins.model.bev import (
    BevEncode,
    BevEncodeConfig,
    BevUNet,
    BevUNetConfig,
    crop,
)

SOURCE = BevGrid((-8.0, 10.0, 1.0), (-9.0, 6.0, 0.5))
ENCODERS = [
    (BevEncode(BevEncodeConfig(in_channels=6, out_channels=4, widths=(4, 6, 8))), (4, 16, 24)),
    (BevUNet(BevUNetConfig(in_channels=6, out_channels=4, widths=(4, 6))), (4, 8, 12)),
]


@given(
    orientation=st.sampled_from(ORIENTATIONS),
    low=st.tuples(st.floats(-7.0, 0.0), st.floats(-8.0, 0.0)),
    counts=st.tuples(st.integers(1, 12), st.integers(1, 9)),
    size=st.floats(0.1, 0.6),
)
def test_a_plane_stays_a_plane_in_every_grid(orientation, low, counts, size) -> None:
    x, y = ((start, start + count * size, size) for start, count in zip(low, counts, strict=True))
    source, target = (grid.with_orientation(orientation) for grid in (SOURCE, BevGrid(x, y)))

    cropped = crop(draw_plane(source), source, target)

    torch.testing.assert_close(cropped, draw_plane(target), rtol=0, atol=1e-3)


def test_beyond_the_source_features_fade_to_zero_within_half_a_cell() -> None:
    target = BevGrid((-20.0, 20.0, 0.2), (-20.0, 20.0, 0.2))
    x, y = np.moveaxis(target.centers(), -1, 0)
    beyond_x, beyond_y = (
        abs(centers - (low + high) / 2) - (high - low) / 2
        for centers, (low, high, _) in ((x, SOURCE.x), (y, SOURCE.y))
    )
    beyond = np.maximum(beyond_x, beyond_y)

    cropped = crop(torch.ones(1, 1, *SOURCE.shape), SOURCE, target)[0, 0].numpy()

    np.testing.assert_allclose(cropped[beyond > 0.5], 0, atol=1e-5)
    np.testing.assert_allclose(cropped[beyond < -0.5], 1, atol=1e-5)
    assert (cropped[abs(beyond) < 0.1] > 0.1).all()


def test_features_that_do_not_fit_the_grids_are_refused() -> None:
    assert_raises(
        (
            lambda: crop(torch.zeros(1, 1, 18, 30), SOURCE, BevGrid()),
            GeometryError,
            r"features: expected \(N, C, 30, 18\), found \(1, 1, 18, 30\)",
        ),
        (
            lambda: crop(torch.zeros(1, 1, 30, 18), SOURCE, BevGrid(orientation="released")),
            GeometryError,
            r"source's orientation, 'devkit', found 'released'",
        ),
    )


@pytest.mark.parametrize(("encoder", "shape"), ENCODERS)
def test_encoders_have_their_sizes_and_use_every_weight(encoder, shape) -> None:
    encoder.train().zero_grad()

    features = encoder(torch.rand(2, 6, 16, 24))
    features.square().sum().backward()

    assert tuple(features.shape) == (2, *shape)
    assert names_without_gradient(encoder) == []


@pytest.mark.parametrize(
    ("config", "values", "message"),
    [
        (
            BevEncodeConfig,
            {"widths": (8, 16)},
            r"channels of 3 stages, such as \(32, 64, 128\), found \(8, 16\)",
        ),
        (
            BevUNetConfig,
            {"widths": (8, 0)},
            r"channels of 2 stages, such as \(32, 64\), found \(8, 0\)",
        ),
        (BevEncodeConfig, {"out_channels": 0}, "out_channels: expected a number from 1, found 0"),
        (BevUNetConfig, {"in_channels": -1}, "in_channels: expected a number from 1, found -1"),
    ],
)
def test_impossible_sizes_are_refused(config, values, message) -> None:
    assert_raises((lambda: config(**values), ConfigError, message))


def draw_plane(grid: BevGrid) -> torch.Tensor:
    """Return a linear function of x and y at the cells' centres, shape (1, 1, H, W)."""
    x, y = np.moveaxis(grid.centers(), -1, 0)
    heights = torch.from_numpy(0.7 * x - 1.3 * y + 2.0)
    return heights.float()[None, None]
