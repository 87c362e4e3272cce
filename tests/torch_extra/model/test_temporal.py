"""Temporal models: the frames that count, their order, and their motion."""

import pytest
import torch
from support.expected_errors import assert_raises
from torch_extra.model.gradients import names_without_gradient

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


def make_batch(
    frames: int = 3, samples: int = 2
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    features = torch.randn(samples, frames, 6, 8, 12, generator=generator)
    egomotion = torch.zeros(samples, frames, 6)
    egomotion[..., [0, 1, 5]] = torch.rand(samples, frames, 3, generator=generator)
    return features, egomotion, torch.ones(samples, frames, dtype=torch.bool)


def make_model(kind: str, frames: int = 3, **options: object) -> Temporal3D | TemporalConcat:
    torch.manual_seed(0)
    config = TemporalConfig(channels=6, grid=GRID, kind=kind, frames=frames, **options)
    return temporal_model(config).eval()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_gradients_reach_every_weight_and_frame(kind: str, frames: int) -> None:
    model = make_model(kind, frames).train()
    features, egomotion, valid = make_batch(frames)

    (model(features.requires_grad_(), egomotion, valid) ** 2).sum().backward()

    assert features.grad.ne(0).flatten(2).any(2).all()
    assert names_without_gradient(model) == []


@pytest.mark.parametrize("kind", KINDS)
def test_every_frame_its_motion_and_the_warp_count(kind: str) -> None:
    model = make_model(kind)
    features, egomotion, valid = make_batch()
    expected = model(features, egomotion, valid)

    first, second, present = (
        egomotion + 0.4 * (torch.arange(3) == frame)[:, None] for frame in range(3)
    )
    assert torch.equal(model(features, present, valid), expected)
    for other_model, motion in (
        (model, first),
        (model, second),
        (make_model(kind, warp="stretched"), egomotion),
        (make_model(kind, chain="released"), egomotion),
    ):
        assert not torch.allclose(other_model(features, motion, valid), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_an_invalid_oldest_frame_does_not_count(kind: str) -> None:
    model = make_model(kind)
    features, egomotion, valid = make_batch()
    all_frames = model(features, egomotion, valid)

    valid[1, 0] = False
    valid_frames = model(features, egomotion, valid)
    features[1, 0] = 1e3

    assert torch.equal(model(features, egomotion, valid), valid_frames)
    assert not torch.allclose(valid_frames[1], all_frames[1])


def test_wrong_configs_are_named() -> None:
    assert_raises(
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
