"""Golden inputs, weights and outputs of the released model's classes (tests/data/golden/model)."""

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TOLERANCE = 1e-4
"""Share of the largest golden value, or of 1, unless the golden set's README says otherwise."""


class GoldenModel:
    """One `NAME.npz`: the tensors of inputs, outputs and state dict, by name without the prefix."""

    def __init__(self, folder: Path, name: str) -> None:
        path = folder / "model" / f"{name}.npz"
        if not path.is_file():
            pytest.fail(f"{path}: is not there; see pytest --golden DIR")
        self._arrays = _read_arrays(path)
        self.config: dict[str, Any] = {}
        if "cfg" in self._arrays:
            self.config = json.loads(str(self._arrays["cfg"]))

    def inputs(self) -> dict[str, Any]:
        return self._tensors("in.")

    def outputs(self) -> dict[str, Any]:
        return self._tensors("out.")

    def state(self, prefix: str = "") -> dict[str, Any]:
        """Return the state dict's entries under `prefix`, without the prefix in their names."""
        return self._tensors(f"state.{prefix}")

    def _tensors(self, prefix: str) -> dict[str, Any]:
        import torch

        return {
            key.removeprefix(prefix): torch.from_numpy(np.array(array))
            for key, array in self._arrays.items()
            if key.startswith(prefix)
        }


def assert_close(ours: Any, golden: Any, tolerance: float = TOLERANCE) -> None:
    """Check the shapes, and the values against a tolerance relative to the largest golden value.

    Where all golden values are below 1, the tolerance is absolute.
    """
    import torch

    assert tuple(ours.shape) == tuple(golden.shape)
    golden = golden.to(torch.float32)
    bound = tolerance * max(1.0, float(golden.abs().max()))
    difference = ours.detach().to(torch.float32) - golden
    assert float(difference.abs().max()) <= bound


@functools.cache
def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)
