"""Poses and warps of feature maps, compared with the devkit's geometry."""

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
"""A grid that is neither square nor centred, with different steps along x and y."""
SIX_VECTORS = st.tuples(
    *[st.floats(-3, 3, width=32)] * 3, *[st.floats(-1.5, 1.5, width=32)] * 3
).map(lambda values: torch.tensor(values, dtype=torch.float64))
PLANAR_POSES = st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-3, 3)).map(
    lambda pose: matrices_from_six(
        torch.tensor([[pose[0], pose[1], 0, 0, 0, pose[2]]], dtype=torch.float64)
    )
)


@given(SIX_VECTORS)
def test_matrices_equal_those_of_the_geometry_and_give_the_vectors_back(
    vector: torch.Tensor,
) -> None:
    matrix = matrices_from_six(vector)
    np.testing.assert_allclose(
        matrix.numpy(),
        conventions.matrices_of_six(vector.numpy()),
        atol=1e-12,
    )
    np.testing.assert_allclose(six_from_matrices(matrix).numpy(), vector.numpy(), atol=1e-7)


@settings(max_examples=25)
@given(st.lists(SIX_VECTORS, min_size=3, max_size=3))
def test_exact_chains_lead_from_each_frame_to_the_present(vectors: list[torch.Tensor]) -> None:
    world_from_frame = matrices_from_six(torch.stack(vectors))
    next_from_this = torch.linalg.inv(world_from_frame[1:]) @ world_from_frame[:-1]
    motion = six_from_matrices(next_from_this)[None]

    present_from_past = present_from_past_batch(motion)[0]

    torch.testing.assert_close(
        present_from_past,
        torch.linalg.inv(world_from_frame[-1]) @ world_from_frame[:-1],
        atol=1e-6,
        rtol=0,
    )


@settings(max_examples=40)
@given(PLANAR_POSES)
def test_an_exact_warp_gives_a_linear_field_its_values_in_the_other_frame(
    target_from_source: torch.Tensor,
) -> None:
    """Bilinear sampling is exact on such a field, except at the border, where it mixes in zeros."""
    x, y = torch.from_numpy(GRID.centers()).double().unbind(-1)
    field = 3 + 0.5 * x - 0.25 * y

    warped = warp_features(field[None, None], target_from_source, GRID)[0, 0]

    matrix = torch.linalg.inv(target_from_source)[0]
    source_x, source_y = (
        matrix[row, 0] * x + matrix[row, 1] * y + matrix[row, 3] for row in (0, 1)
    )
    source_field = 3 + 0.5 * source_x - 0.25 * source_y
    # negative inside the grid
    beyond_x = (source_x - 2).abs() - 10
    beyond_y = source_y.abs() - 6
    is_inside = (beyond_x < -0.6) & (beyond_y < -0.3)
    is_outside = (beyond_x > 0.6) | (beyond_y > 0.3)
    torch.testing.assert_close(warped[is_inside], source_field[is_inside], atol=1e-9, rtol=0)
    assert not warped[is_outside].any()

    beyond = torch.maximum(beyond_x, beyond_y)
    is_clear = beyond.abs() > 1e-6
    mask = inside_mask(target_from_source, GRID)[0]
    assert torch.equal(mask[is_clear], beyond[is_clear] < 0)


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_a_shift_by_whole_cells_moves_cells(mode: str) -> None:
    features = torch.rand(1, 2, 24, 20)
    warped = warp_features(
        features,
        matrices_from_six(torch.tensor([[3.0, -1, 0, 0, 0, 0]])),
        GRID,
        mode=mode,
    )
    torch.testing.assert_close(
        warped,
        torch.nn.functional.pad(features[:, :, 2:, :-3], (3, 0, 0, 2)),
        atol=1e-5,
        rtol=0,
    )


def test_the_ego_is_neither_warped_nor_hidden_and_missing_agents_are() -> None:
    features = torch.rand(2, 3, 4, 24, 20, requires_grad=True)
    pose = matrices_from_six(torch.tensor([[2.0, 1, 0, 0, 0, 0.4]])).expand(2, 3, 4, 4)

    warped = features_to_ego(features, pose, GRID)
    assert torch.equal(warped[:, 0], features[:, 0])
    torch.testing.assert_close(warped[:, 2], warp_features(features[:, 2], pose[:, 2], GRID))

    inside = inside_mask(pose[0], GRID)[0]
    assert 0 < inside.float().mean() < 1
    everywhere, nowhere = torch.ones_like(inside), torch.zeros_like(inside)
    mask = agents_mask(torch.tensor([[False, True, False], [True, True, True]]), pose, GRID)
    expected = [everywhere, inside, nowhere, everywhere, inside, inside]
    assert torch.equal(mask.flatten(0, 1), torch.stack(expected))

    warped.sum().backward()
    assert features.grad.ne(0).flatten(2).any(2).all()
