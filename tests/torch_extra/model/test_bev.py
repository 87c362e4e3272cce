"""The crop to a task's grid, and the two encoders."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from refusals import assert_refused

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
    found = crop(plane(source), source, target)
    torch.testing.assert_close(found, plane(target), rtol=0, atol=1e-3)


def test_beyond_the_source_features_fade_to_zero_within_half_a_cell() -> None:
    target = BevGrid((-20.0, 20.0, 0.2), (-20.0, 20.0, 0.2))
    x, y = np.moveaxis(target.centers(), -1, 0)
    beyond = np.maximum(
        *(
            abs(p - (low + high) / 2) - (high - low) / 2
            for p, (low, high, _) in ((x, SOURCE.x), (y, SOURCE.y))
        )
    )
    found = crop(torch.ones(1, 1, *SOURCE.shape), SOURCE, target)[0, 0].numpy()
    np.testing.assert_allclose(found[beyond > 0.5], 0, atol=1e-5)
    np.testing.assert_allclose(found[beyond < -0.5], 1, atol=1e-5)
    assert (found[abs(beyond) < 0.1] > 0.1).all()


def test_what_does_not_fit_is_refused() -> None:
    assert_refused(
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
    result = encoder(torch.rand(2, 6, 16, 24))
    assert tuple(result.shape) == (2, *shape)
    result.square().sum().backward()
    assert [
        name
        for name, each in encoder.named_parameters()
        if each.grad is None or not each.grad.any()
    ] == []


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
    assert_refused((lambda: config(**values), ConfigError, message))


def plane(grid: BevGrid) -> torch.Tensor:
    """(1, 1, H, W) a linear function of x and y at the cells' centres."""
    x, y = np.moveaxis(grid.centers(), -1, 0)
    return torch.from_numpy(0.7 * x - 1.3 * y + 2.0).float()[None, None]
