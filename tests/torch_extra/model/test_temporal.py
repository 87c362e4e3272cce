"""Temporal models: which frames count, in which order, with which motion; blocks look only
backwards.
"""

import pytest
import torch
from refusals import assert_refused

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.plugins.model.temporal import (
    Temporal3D,
    TemporalConcat,
    TemporalConfig,
    temporal_model,
)

GRID = BevGrid(x=(-6, 6, 1), y=(-4, 4, 1))
KINDS = ["blocks", "concat"]


def batch(frames: int = 3, samples: int = 2) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    features = torch.randn(samples, frames, 6, 8, 12, generator=generator)
    egomotion = torch.zeros(samples, frames, 6)
    egomotion[..., [0, 1, 5]] = torch.rand(samples, frames, 3, generator=generator)
    return features, egomotion, torch.ones(samples, frames, dtype=torch.bool)


def model_of(kind: str, frames: int = 3, **options: object) -> Temporal3D | TemporalConcat:
    torch.manual_seed(0)
    return temporal_model(
        TemporalConfig(channels=6, grid=GRID, kind=kind, frames=frames, **options)
    ).eval()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_gradients_reach_every_weight_and_frame(kind: str, frames: int) -> None:
    model = model_of(kind, frames).train()
    features, egomotion, valid = batch(frames)
    (model(features.requires_grad_(), egomotion, valid) ** 2).sum().backward()
    assert features.grad.ne(0).flatten(2).any(2).all()
    assert all(weight.grad is not None and weight.grad.ne(0).any() for weight in model.parameters())


@pytest.mark.parametrize("kind", KINDS)
def test_every_frame_its_motion_and_the_warp_count(kind: str) -> None:
    model = model_of(kind)
    features, egomotion, valid = batch()
    result = model(features, egomotion, valid)
    first, second, unused = (
        egomotion + 0.4 * (torch.arange(3) == frame)[:, None] for frame in range(3)
    )
    assert torch.equal(model(features, unused, valid), result)
    others = (model_of(kind, warp="stretched"), model_of(kind, chain="released"))
    for other, motion in ((model, first), (model, second), *((each, egomotion) for each in others)):
        assert not torch.allclose(other(features, motion, valid), result)


@pytest.mark.parametrize("kind", KINDS)
def test_an_oldest_frame_that_is_not_valid_does_not_count(kind: str) -> None:
    model = model_of(kind)
    features, egomotion, valid = batch()
    whole = model(features, egomotion, valid)
    valid[1, 0] = False
    result = model(features, egomotion, valid)
    features[1, 0] = 1e3
    assert torch.equal(model(features, egomotion, valid), result)
    assert not torch.allclose(result[1], whole[1])


def test_wrong_configs_say_so() -> None:
    assert_refused(
        (
            lambda: TemporalConfig(channels=6, grid=GRID, frames=0),
            ConfigError,
            "at least 1 channel and 1 frame, found 6 and 0",
        ),
        (
            lambda: TemporalConfig(channels=6, grid=GRID, chain="reverse"),
            ConfigError,
            "chain: expected one of released, exact, found 'reverse'",
        ),
    )
