"""Golden inputs, weights and outputs of the released model's classes (tests/data/golden/model)."""

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TOLERANCE = 1e-4
"""Of the largest value, or of 1, where the golden set's README says nothing else."""


class GoldenModel:
    """One `NAME.npz`: tensors of its inputs, outputs and state dict by their names without the
    prefix.
    """

    def __init__(self, folder: Path, name: str) -> None:
        path = folder / "model" / f"{name}.npz"
        if not path.is_file():
            pytest.fail(f"{path}: is not there; see pytest --golden DIR")
        self._arrays = _arrays(path)
        self.config: dict[str, Any] = (
            json.loads(str(self._arrays["cfg"])) if "cfg" in self._arrays else {}
        )

    def inputs(self) -> dict[str, Any]:
        return self._tensors("in.")

    def outputs(self) -> dict[str, Any]:
        return self._tensors("out.")

    def state(self, prefix: str = "") -> dict[str, Any]:
        """The state dict's entries whose keys begin with `prefix`, without it."""
        return self._tensors(f"state.{prefix}")

    def _tensors(self, prefix: str) -> dict[str, Any]:
        import torch

        return {
            key.removeprefix(prefix): torch.from_numpy(np.array(value))
            for key, value in self._arrays.items()
            if key.startswith(prefix)
        }


def check_close(ours: Any, golden: Any, tolerance: float = TOLERANCE) -> None:
    """Check shapes, and that no value differs by more than the tolerance times max(1, the largest
    golden value).
    """
    import torch

    assert tuple(ours.shape) == tuple(golden.shape)
    golden = golden.to(torch.float32)
    bound = tolerance * max(1.0, float(golden.abs().max()))
    assert float((ours.detach().to(torch.float32) - golden).abs().max()) <= bound


@functools.cache
def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        return dict(archive)
