"""torch tensors wherever the devkit takes arrays: read where numpy can, else refused with the
remedy.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from refusals import assert_refused

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


def heads(tensor: torch.Tensor) -> Any:
    return MotionHeads(
        **{name: tensor.expand(shape) for name, shape in SHAPES.items()}
    ).segmentation


def heads_in_order(tensor: torch.Tensor) -> Any:
    return MotionHeads.from_arrays(*(tensor.expand(shape) for shape in SHAPES.values())).flow


def labels_of_a_batch(tensor: torch.Tensor) -> Any:
    batch: dict[str, Any] = motion_labels_from_boxes(
        [None, None], np.zeros((2, 6)), CONFIG
    ).as_batch("beverse")
    batch["instance_offset"] = tensor.expand(batch["instance_offset"].shape)
    return MotionLabels.from_batch(batch, CONFIG, "beverse").offset


ENTRIES: list[Callable[[torch.Tensor], Any]] = [
    heads,
    heads_in_order,
    labels_of_a_batch,
    lambda tensor: agents_to_ego(tensor.expand(2, 6, 8), np.zeros((2, 6)), grid=CONFIG.grid),
    lambda tensor: agents_to_ego(np.zeros((2, 6, 8)), tensor.expand(2, 6), grid=CONFIG.grid),
    lambda tensor: past_to_present(tensor.expand(2, 3, 6, 8), np.zeros((1, 6)), grid=CONFIG.grid),
    lambda tensor: past_to_present(np.zeros((2, 6, 8)), tensor.expand(2, 6), grid=CONFIG.grid),
    lambda tensor: SE3.identity().apply(tensor.expand(4, 3)),
    lambda tensor: Boxes.from_arrays(tensor.expand(1, 3), np.ones((1, 3)), np.zeros(1)),
    lambda tensor: CONFIG.grid.index_of(tensor.expand(4, 2)),
]


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.int32])
def test_tensors_on_the_processor_are_read(
    entry: Callable[[torch.Tensor], Any], dtype: torch.dtype
) -> None:
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
def test_others_are_refused_with_the_remedy(
    entry: Callable[[torch.Tensor], Any], tensor: torch.Tensor
) -> None:
    assert_refused(
        (
            lambda: entry(tensor),
            GeometryError,
            ("found Tensor (", "pass a torch tensor as tensor.detach().cpu()"),
        )
    )


def test_numbers_beyond_float32_are_refused() -> None:
    huge, named = (
        torch.full((), 1e300, dtype=torch.float64),
        "expected numbers within float32's range, found 1e",
    )
    assert_refused(*((partial(entry, huge), GeometryError, named) for entry in ENTRIES[:3]))
