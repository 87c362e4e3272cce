"""torch tensors wherever the devkit takes arrays: read where numpy can, else refused with the remedy."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, BevGrid, Boxes
from deepaccident_devkit.motion import (
    MotionHeads,
    MotionLabelConfig,
)

CONFIG = MotionLabelConfig(grid=BevGrid(x=(-4, 4, 1), y=(-3, 3, 1)), receptive_field=1, future_frames=1)
SHAPES = {"segmentation": (2, 2, 6, 8), "centerness": (2, 1, 6, 8), "offset": (2, 2, 6, 8), "flow": (2, 2, 6, 8)}


def heads(tensor: torch.Tensor) -> Any:
    return MotionHeads(**{name: tensor.expand(shape) for name, shape in SHAPES.items()}).segmentation


def heads_in_order(tensor: torch.Tensor) -> Any:
    return MotionHeads.from_arrays(*(tensor.expand(shape) for shape in SHAPES.values())).flow


ENTRIES: list[Callable[[torch.Tensor], Any]] = [
    heads,
    heads_in_order,
    lambda tensor: SE3.identity().apply(tensor.expand(4, 3)),
    lambda tensor: Boxes.from_arrays(tensor.expand(1, 3), np.ones((1, 3)), np.zeros(1)),
    lambda tensor: CONFIG.grid.index_of(tensor.expand(4, 2)),
]


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.int32])
def test_tensors_on_the_processor_are_read(entry: Callable[[torch.Tensor], Any], dtype: torch.dtype) -> None:
    entry(torch.zeros((), dtype=dtype))


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize(
    "tensor",
    [
        torch.zeros((), requires_grad=True),
        torch.zeros((), device="meta"),
        torch.zeros((), dtype=torch.bfloat16),
        torch.zeros((), dtype=torch.complex64),
    ],
    ids=["grad", "device", "bfloat16", "complex"],
)
def test_others_are_refused_with_the_remedy(entry: Callable[[torch.Tensor], Any], tensor: torch.Tensor) -> None:
    with pytest.raises(GeometryError, match=r"found Tensor \(.*\); pass a torch tensor as tensor\.detach\(\)\.cpu\(\)"):
        entry(tensor)


@pytest.mark.parametrize("entry", [heads, heads_in_order])
def test_numbers_beyond_float32_are_refused(entry: Callable[[torch.Tensor], Any]) -> None:
    with pytest.raises(GeometryError, match="expected numbers within float32's range, found 1e"):
        entry(torch.full((), 1e300, dtype=torch.float64))


def test_the_remedy_is_one() -> None:
    tensor = torch.rand(SHAPES["segmentation"]).bfloat16().requires_grad_()
    taken = tensor.detach().cpu().float()
    zeros = [torch.zeros(shape) for shape in SHAPES.values()][1:]
    assert_array_equal(MotionHeads.from_arrays(taken, *zeros).segmentation, taken.numpy())
