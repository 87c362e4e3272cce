"""torch tensors wherever the devkit takes arrays.

They are read where numpy can read them, and otherwise refused with the remedy.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, BevGrid, Boxes
from deepaccident_devkit.motion import (
    MotionHeads,
    MotionLabelConfig,
    MotionLabels,
    agents_to_ego,
    motion_labels_from_boxes,
    past_to_present,
)

CONFIG = MotionLabelConfig(
    grid=BevGrid(x=(-4, 4, 1), y=(-3, 3, 1)), receptive_field=1, future_frames=1
)
SHAPES = {
    "segmentation": (2, 2, 6, 8),
    "centerness": (2, 1, 6, 8),
    "offset": (2, 2, 6, 8),
    "flow": (2, 2, 6, 8),
}


def read_named_heads(tensor: torch.Tensor) -> Any:
    tensors = {name: tensor.expand(shape) for name, shape in SHAPES.items()}
    return MotionHeads(**tensors).segmentation


def read_ordered_heads(tensor: torch.Tensor) -> Any:
    tensors = [tensor.expand(shape) for shape in SHAPES.values()]
    return MotionHeads.from_arrays(*tensors).flow


def read_batch_labels(tensor: torch.Tensor) -> Any:
    labels = motion_labels_from_boxes([None, None], np.zeros((2, 6)), CONFIG)
    batch: dict[str, Any] = labels.as_batch("beverse")
    batch["instance_offset"] = tensor.expand(batch["instance_offset"].shape)
    return MotionLabels.from_batch(batch, CONFIG, "beverse").offset


READERS: list[Callable[[torch.Tensor], Any]] = [
    read_named_heads,
    read_ordered_heads,
    read_batch_labels,
    lambda tensor: agents_to_ego(tensor.expand(2, 6, 8), np.zeros((2, 6)), grid=CONFIG.grid),
    lambda tensor: agents_to_ego(np.zeros((2, 6, 8)), tensor.expand(2, 6), grid=CONFIG.grid),
    lambda tensor: past_to_present(tensor.expand(2, 3, 6, 8), np.zeros((1, 6)), grid=CONFIG.grid),
    lambda tensor: past_to_present(np.zeros((2, 6, 8)), tensor.expand(2, 6), grid=CONFIG.grid),
    lambda tensor: SE3.identity().apply(tensor.expand(4, 3)),
    lambda tensor: Boxes.from_arrays(tensor.expand(1, 3), np.ones((1, 3)), np.zeros(1)),
    lambda tensor: CONFIG.grid.index_of(tensor.expand(4, 2)),
]


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.int32])
def test_tensors_on_the_processor_are_read(
    read: Callable[[torch.Tensor], Any], dtype: torch.dtype
) -> None:
    read(torch.zeros((), dtype=dtype))


@pytest.mark.parametrize("read", READERS)
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
def test_other_tensors_are_refused_with_the_remedy(
    read: Callable[[torch.Tensor], Any], tensor: torch.Tensor
) -> None:
    assert_raises(
        (
            lambda: read(tensor),
            GeometryError,
            ("found Tensor (", "pass a torch tensor as tensor.detach().cpu()"),
        )
    )


def test_numbers_beyond_float32_are_refused() -> None:
    tensor = torch.full((), 1e300, dtype=torch.float64)
    message = "expected numbers within float32's range, found 1e"
    assert_raises(*((partial(read, tensor), GeometryError, message) for read in READERS[:3]))
