"""Poses and warps of feature maps: against numpy, against the geometry itself, and what a wrong
grid says.
"""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from deepaccident_devkit.geometry import BevGrid, conventions
from deepaccident_devkit.plugins.model.warps import (
    agents_mask,
    features_to_ego,
    inside_mask,
    matrices_from_six,
    present_from_past_batch,
    six_from_matrices,
    warp_features,
)

GRID = BevGrid(x=(-8, 12, 1), y=(-6, 6, 0.5))
"""Neither square nor centred, and with other steps along x than along y."""
six = st.tuples(*[st.floats(-3, 3, width=32)] * 3, *[st.floats(-1.5, 1.5, width=32)] * 3).map(
    lambda values: torch.tensor(values, dtype=torch.float64)
)
planar = st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-3, 3)).map(
    lambda pose: matrices_from_six(
        torch.tensor([[pose[0], pose[1], 0, 0, 0, pose[2]]], dtype=torch.float64)
    )
)


def turned(*values: float) -> torch.Tensor:
    return torch.tensor([values])


def centres() -> tuple[torch.Tensor, torch.Tensor]:
    y, x = torch.arange(24) * 0.5 - 5.75, torch.arange(20) - 7.5
    return torch.meshgrid(y, x, indexing="ij")[::-1]


@given(six)
def test_matrices_equal_those_of_the_geometry_and_give_the_vectors_back(
    vector: torch.Tensor,
) -> None:
    matrix = matrices_from_six(vector)
    np.testing.assert_allclose(
        matrix.numpy(), conventions.matrices_of_six(vector.numpy()), atol=1e-12
    )
    np.testing.assert_allclose(six_from_matrices(matrix).numpy(), vector.numpy(), atol=1e-7)


@settings(max_examples=25)
@given(st.lists(six, min_size=3, max_size=3))
def test_exact_chains_lead_from_each_frame_to_the_present(vectors: list[torch.Tensor]) -> None:
    world_from_frame = matrices_from_six(torch.stack(vectors))
    next_from_this = torch.linalg.inv(world_from_frame[1:]) @ world_from_frame[:-1]
    motion = six_from_matrices(next_from_this)[None]
    expected = torch.linalg.inv(world_from_frame[-1]) @ world_from_frame[:-1]
    torch.testing.assert_close(present_from_past_batch(motion)[0], expected, atol=1e-6, rtol=0)


@settings(max_examples=40)
@given(planar)
def test_an_exact_warp_gives_a_linear_field_its_values_in_the_other_frame(
    target_from_source: torch.Tensor,
) -> None:
    """Bilinear sampling has no error on such a field, but next to the border, where zeros mix
    in.
    """
    x, y = (each.double() for each in centres())
    warped = warp_features((3 + 0.5 * x - 0.25 * y)[None, None], target_from_source, GRID)[0, 0]
    source = torch.linalg.inv(target_from_source)[0]
    source_x, source_y = (
        source[row, 0] * x + source[row, 1] * y + source[row, 3] for row in (0, 1)
    )
    beyond_x, beyond_y = (source_x - 2).abs() - 10, source_y.abs() - 6  # below 0 inside the grid
    inner, outside = (beyond_x < -0.6) & (beyond_y < -0.3), (beyond_x > 0.6) | (beyond_y > 0.3)
    torch.testing.assert_close(
        warped[inner], (3 + 0.5 * source_x - 0.25 * source_y)[inner], atol=1e-9, rtol=0
    )
    assert not warped[outside].any()
    beyond = torch.maximum(beyond_x, beyond_y)
    clear = beyond.abs() > 1e-6
    assert torch.equal(inside_mask(target_from_source, GRID)[0][clear], beyond[clear] < 0)


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_a_shift_by_whole_cells_moves_cells(mode: str) -> None:
    features = torch.rand(1, 2, 24, 20)
    warped = warp_features(features, matrices_from_six(turned(3, -1, 0, 0, 0, 0)), GRID, mode=mode)
    expected = torch.nn.functional.pad(features[:, :, 2:, :-3], (3, 0, 0, 2))
    torch.testing.assert_close(warped, expected, atol=1e-5, rtol=0)


def test_the_ego_is_neither_warped_nor_hidden_and_missing_agents_are() -> None:
    features = torch.rand(2, 3, 4, 24, 20, requires_grad=True)
    pose = matrices_from_six(turned(2, 1, 0, 0, 0, 0.4)).expand(2, 3, 4, 4)
    placed = features_to_ego(features, pose, GRID)
    assert torch.equal(placed[:, 0], features[:, 0])
    torch.testing.assert_close(placed[:, 2], warp_features(features[:, 2], pose[:, 2], GRID))
    inside = inside_mask(pose[0], GRID)[0]
    assert 0 < inside.float().mean() < 1
    own, nobody = torch.ones_like(inside), torch.zeros_like(inside)
    mask = agents_mask(torch.tensor([[False, True, False], [True, True, True]]), pose, GRID)
    assert torch.equal(mask.flatten(0, 1), torch.stack([own, inside, nobody, own, inside, inside]))
    placed.sum().backward()
    assert features.grad.ne(0).flatten(2).any(2).all()
