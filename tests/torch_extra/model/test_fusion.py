"""Fusion modules: the laws that all of them keep, their options, windows, and wrong configs."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import assert_refused

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.fusion import (
    Agent3DConfig,
    CobevtConfig,
    DiscoNetConfig,
    Fusion,
    FusionConfig,
    PoolFusionConfig,
    ReleasedFusionConfig,
    V2XViTConfig,
    fusion,
)
from deepaccident_devkit.plugins.model.fusion.attention import Windows

C = 8
MEAN = PoolFusionConfig()
MAX = PoolFusionConfig(by="max")
RELEASED = ReleasedFusionConfig(channels=C, ego_channels=(1, 4))
DISCONET = DiscoNetConfig(channels=C, hidden=(16, 4))
COBEVT = CobevtConfig(channels=C, depth=2, window=4)
V2XVIT = V2XViTConfig(channels=C, depth=2, heads=2, windows=(2, 4), window_heads=(2, 1))
ALL = pytest.mark.parametrize(
    "config", [MEAN, MAX, RELEASED, DISCONET, COBEVT, V2XVIT], ids=lambda c: type(c).__name__
)
LEARNED = pytest.mark.parametrize(
    "config", [DISCONET, COBEVT, V2XVIT], ids=lambda c: type(c).__name__
)
Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def module(config: FusionConfig) -> Fusion:
    torch.manual_seed(0)
    return fusion(config).eval()


def batch(agents: int = 4, height: int = 7, width: int = 9) -> Batch:
    """Sizes that no window divides; slot 2 is at the roadside, one partner is a step late."""
    generator, slots = torch.Generator().manual_seed(5), torch.arange(agents).expand(2, agents)
    x = torch.randn(2, agents, C, height, width, generator=generator)
    mask = torch.rand(2, agents, height, width, generator=generator) > 0.3
    mask[:, 0] = True
    return x, mask, slots == 2, (slots == 1).long()


@ALL
def test_masked_partners_leave_the_ego_alone(config: FusionConfig) -> None:
    x, mask, infra, delay = batch()
    mask[:, 1:] = False
    alone = module(config)(*[each[:, :1] for each in (x, mask, infra, delay)])
    torch.testing.assert_close(module(config)(x, mask, infra, delay), alone, atol=2e-6, rtol=0)


@ALL
def test_partners_count_in_any_order(config: FusionConfig) -> None:
    swapped = module(config)(*[each[:, [0, 3, 1, 2]] for each in batch()])
    torch.testing.assert_close(swapped, module(config)(*batch()), atol=1e-5, rtol=0)


@ALL
@pytest.mark.parametrize("training", [False, True])
def test_what_the_mask_hides_has_no_effect(config: FusionConfig, training: bool) -> None:
    x, mask, infra, delay = batch()
    garbage = torch.where(mask[:, :, None], x, torch.nan)
    assert torch.equal(
        *[module(config).train(training)(each, mask, infra, delay) for each in (x, garbage)]
    )


@ALL
def test_every_partner_counts_where_it_is_seen_and_each_sample_for_itself(
    config: FusionConfig,
) -> None:
    x, mask, infra, delay = batch()
    model, whole = module(config), torch.ones_like(mask)
    fused = model(x, whole, infra, delay)
    for slot in range(4):
        changed = x.clone()
        changed[0, slot] *= 3
        other = model(changed, whole, infra, delay)
        assert not torch.allclose(other[0], fused[0], atol=1e-4)
        torch.testing.assert_close(other[1], fused[1])


@LEARNED
def test_gradients_reach_every_weight(config: FusionConfig) -> None:
    """With a delay; without one, V2X-ViT's weights of the sines have none."""
    x, mask, infra, delay = batch()
    model = module(config).train()
    (model(x.requires_grad_(), mask, infra, delay) ** 2).sum().backward()
    assert all(weight.grad is not None and weight.grad.ne(0).any() for weight in model.parameters())
    assert torch.equal(x.grad.ne(0).any(2) & ~mask, torch.zeros_like(mask))
    assert x.grad[:, 1:].ne(0).any()


@ALL
def test_autocast_changes_digits_only(config: FusionConfig) -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = module(config)(*batch())
    torch.testing.assert_close(rounded.float(), module(config)(*batch()), atol=0.1, rtol=0.1)


def test_mean_and_maximum_are_over_those_that_are_seen() -> None:
    x, mask, infra, delay = batch()
    x[:, 1:] = x[:, 1:].abs() + 5
    shown = torch.stack([x[0, slot, :, 3, 4] for slot in range(4) if mask[0, slot, 3, 4]])
    assert 1 < len(shown) < 4
    for config, expected in ((MEAN, shown.mean(0)), (MAX, shown.amax(0))):
        torch.testing.assert_close(module(config)(x, mask, infra, delay)[0, :, 3, 4], expected)


@pytest.mark.parametrize(
    "config", [replace(V2XVIT, masked_cells="windowed"), replace(COBEVT, masked_cells="averaged")]
)
def test_transformers_can_see_what_the_mask_hides(config: FusionConfig) -> None:
    x, mask, infra, delay = batch()
    louder = torch.where(mask[:, :, None], x, 3 * x)
    assert not torch.allclose(
        *[module(config)(each, mask, infra, delay) for each in (louder, x)], atol=1e-4
    )


@settings(max_examples=30)
@given(st.integers(1, 4), st.integers(1, 9), st.integers(1, 9), st.booleans())
def test_windows_are_joined_as_they_were_split(
    size: int, height: int, width: int, strided: bool
) -> None:
    windows = Windows(size=size, strided=strided)
    maps = torch.rand(2, 3, height, width, 2) + 1
    tokens, known = (
        windows.split(maps),
        windows.split_mask(torch.ones(2, 3, height, width, dtype=torch.bool)),
    )
    assert torch.equal(windows.join(tokens, maps.shape[:4]), maps)
    assert torch.equal(known, tokens[..., 0] > 0)
    assert known.any(1).all()
    assert int(known.sum()) == 2 * 3 * height * width


@pytest.mark.parametrize(("strided", "held"), [(False, [2, 3, 8, 9]), (True, [1, 4, 13, 16])])
def test_windows_hold_neighbours_or_cells_spread_over_the_map(
    strided: bool, held: list[int]
) -> None:
    numbers = torch.arange(24).view(1, 1, 4, 6, 1)
    assert Windows(size=2, strided=strided).split(numbers)[1, :, 0].tolist() == held


def test_wrong_configs_say_so() -> None:
    cobevt_of_slots = module(replace(COBEVT, agent_relation="slots", agents=4))
    assert_refused(
        (
            lambda: ReleasedFusionConfig(channels=C),
            ConfigError,
            r"expected numbers from 0 to 7, found \[31, 41",
        ),
        (
            lambda: cobevt_of_slots(*batch(agents=5)),
            ConfigError,
            r"4 slots, found 5; raise CobevtConfig\.agents",
        ),
        (lambda: replace(COBEVT, heads=3), ConfigError, "heads: 3 do not divide 8 channels"),
        (
            lambda: replace(V2XVIT, window_heads=(2, 3)),
            ConfigError,
            "window_heads: 3 do not divide 8 channels",
        ),
        (
            lambda: replace(V2XVIT, window_heads=(2,)),
            ConfigError,
            r"one number for each of 2 windows, found \(2,\)",
        ),
        (
            lambda: PoolFusionConfig(by="sum"),
            ConfigError,
            "by: expected one of mean, max, found 'sum'",
        ),
        (
            lambda: Agent3DConfig(channels=C, agents=1),
            ConfigError,
            "agents: expected at least 2, found 1",
        ),
        (lambda: fusion("mean"), ConfigError, "the config of a fusion module, found 'mean'"),
    )
