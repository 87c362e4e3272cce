"""Comparison of nested batches and items."""

from typing import Any

import torch


def are_identical(first: Any, second: Any) -> bool:
    """Compare two batches, or values in them, bit for bit and with their kinds."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(
            are_identical(first[key], second[key]) for key in first
        )
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(are_identical, first, second))
    if isinstance(first, torch.Tensor):
        return first.dtype == second.dtype and torch.equal(first, second)
    return bool(first == second)
