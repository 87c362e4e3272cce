"""Whether nested batches and items are equal."""

from typing import Any

import torch


def same(one: Any, other: Any) -> bool:
    """Whether two batches, or what stands in them, are the same bits of the same kind."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return bool(one == other)
