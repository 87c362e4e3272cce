"""Random tensors."""

import torch


def make_noise(*shape: int, seed: int = 0) -> torch.Tensor:
    """Draw standard normal values of this shape, the same for each call."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))
