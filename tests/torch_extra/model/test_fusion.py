"""Fusion modules: what holds for all of them, their options, windows, and wrong configs."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.expected_errors import assert_raises
from torch_extra.model.gradients import names_without_gradient

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

CHANNELS = 8
MEAN = PoolFusionConfig()
MAX = PoolFusionConfig(by="max")
RELEASED = ReleasedFusionConfig(channels=CHANNELS, ego_channels=(1, 4))
DISCONET = DiscoNetConfig(channels=CHANNELS, hidden=(16, 4))
COBEVT = CobevtConfig(channels=CHANNELS, depth=2, window=4)
V2XVIT = V2XViTConfig(channels=CHANNELS, depth=2, heads=2, windows=(2, 4), window_heads=(2, 1))
ALL_MODULES = pytest.mark.parametrize(
    "config",
    [MEAN, MAX, RELEASED, DISCONET, COBEVT, V2XVIT],
    ids=lambda config: type(config).__name__,
)
LEARNED_MODULES = pytest.mark.parametrize(
    "config", [DISCONET, COBEVT, V2XVIT], ids=lambda config: type(config).__name__
)
Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""Features, mask, whether a slot is at the roadside, and its delay in steps."""


def make_module(config: FusionConfig) -> Fusion:
    torch.manual_seed(0)
    return fusion(config).eval()


def make_batch(agents: int = 4, height: int = 7, width: int = 9) -> Batch:
    """Make maps that no window divides; slot 2 is at the roadside, and slot 1 a step late."""
    generator = torch.Generator().manual_seed(5)
    slots = torch.arange(agents).expand(2, agents)
    features = torch.randn(2, agents, CHANNELS, height, width, generator=generator)
    mask = torch.rand(2, agents, height, width, generator=generator) > 0.3
    mask[:, 0] = True
    return features, mask, slots == 2, (slots == 1).long()


@ALL_MODULES
def test_masked_partners_do_not_affect_the_ego(config: FusionConfig) -> None:
    features, mask, is_infrastructure, delay = make_batch()
    mask[:, 1:] = False
    module = make_module(config)

    fused = module(features, mask, is_infrastructure, delay)

    torch.testing.assert_close(
        fused,
        module(features[:, :1], mask[:, :1], is_infrastructure[:, :1], delay[:, :1]),
        atol=2e-6,
        rtol=0,
    )


@ALL_MODULES
def test_partners_count_in_any_order(config: FusionConfig) -> None:
    batch = make_batch()
    module = make_module(config)
    torch.testing.assert_close(
        module(*[values[:, [0, 3, 1, 2]] for values in batch]),
        module(*batch),
        atol=1e-5,
        rtol=0,
    )


@ALL_MODULES
@pytest.mark.parametrize("training", [False, True])
def test_masked_features_have_no_effect(config: FusionConfig, training: bool) -> None:
    features, mask, *slot_facts = make_batch()
    visible_features = torch.where(mask[:, :, None], features, torch.nan)

    fused = make_module(config).train(training)(features, mask, *slot_facts)
    visible_fused = make_module(config).train(training)(visible_features, mask, *slot_facts)

    assert torch.equal(fused, visible_fused)


@ALL_MODULES
def test_every_partner_counts_where_it_is_seen_and_each_sample_for_itself(
    config: FusionConfig,
) -> None:
    features, mask, *slot_facts = make_batch()
    module, full_mask = make_module(config), torch.ones_like(mask)
    fused = module(features, full_mask, *slot_facts)

    for slot in range(4):
        changed = features.clone()
        changed[0, slot] *= 3
        changed_fused = module(changed, full_mask, *slot_facts)
        assert not torch.allclose(changed_fused[0], fused[0], atol=1e-4)
        torch.testing.assert_close(changed_fused[1], fused[1])


@LEARNED_MODULES
def test_gradients_reach_every_weight(config: FusionConfig) -> None:
    features, mask, *slot_facts = make_batch()  # without a delay, V2X-ViT's sines have no gradient
    module = make_module(config).train()

    (module(features.requires_grad_(), mask, *slot_facts) ** 2).sum().backward()

    assert names_without_gradient(module) == []
    has_gradient = features.grad.ne(0).any(2)
    assert not (has_gradient & ~mask).any()
    assert has_gradient[:, 1:].any()


@ALL_MODULES
def test_autocast_changes_only_digits(config: FusionConfig) -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = make_module(config)(*make_batch())
    torch.testing.assert_close(
        rounded.float(),
        make_module(config)(*make_batch()),
        atol=0.1,
        rtol=0.1,
    )


def test_mean_and_maximum_are_over_the_visible_agents() -> None:
    features, mask, *slot_facts = make_batch()
    features[:, 1:] = features[:, 1:].abs() + 5
    visible = features[0, mask[0, :, 3, 4], :, 3, 4]
    assert 1 < len(visible) < 4

    for config, expected in ((MEAN, visible.mean(0)), (MAX, visible.amax(0))):
        fused = make_module(config)(features, mask, *slot_facts)
        torch.testing.assert_close(fused[0, :, 3, 4], expected)


@pytest.mark.parametrize(
    "config", [replace(V2XVIT, masked_cells="windowed"), replace(COBEVT, masked_cells="averaged")]
)
def test_transformers_can_see_what_the_mask_hides(config: FusionConfig) -> None:
    features, mask, *slot_facts = make_batch()
    changed = torch.where(mask[:, :, None], features, 3 * features)

    fused = make_module(config)(features, mask, *slot_facts)
    changed_fused = make_module(config)(changed, mask, *slot_facts)

    assert not torch.allclose(changed_fused, fused, atol=1e-4)


@settings(max_examples=30)
@given(st.integers(1, 4), st.integers(1, 9), st.integers(1, 9), st.booleans())
def test_windows_are_joined_as_they_were_split(
    size: int, height: int, width: int, strided: bool
) -> None:
    windows = Windows(size=size, strided=strided)
    maps = torch.rand(2, 3, height, width, 2) + 1

    tokens = windows.split(maps)
    is_filled = windows.split_mask(torch.ones(2, 3, height, width, dtype=torch.bool))

    assert torch.equal(windows.join(tokens, maps.shape[:4]), maps)
    assert torch.equal(is_filled, tokens[..., 0] > 0)
    assert is_filled.any(1).all()
    assert int(is_filled.sum()) == 2 * 3 * height * width


@pytest.mark.parametrize(("strided", "cells"), [(False, [2, 3, 8, 9]), (True, [1, 4, 13, 16])])
def test_windows_hold_neighbours_or_cells_spread_over_the_map(
    strided: bool, cells: list[int]
) -> None:
    windows = Windows(size=2, strided=strided).split(torch.arange(24).view(1, 1, 4, 6, 1))
    assert windows[1, :, 0].tolist() == cells


def test_wrong_configs_are_named() -> None:
    cobevt_of_slots = make_module(replace(COBEVT, agent_relation="slots", agents=4))
    assert_raises(
        (
            lambda: ReleasedFusionConfig(channels=CHANNELS),
            ConfigError,
            r"expected numbers from 0 to 7, found \[31, 41",
        ),
        (
            lambda: cobevt_of_slots(*make_batch(agents=5)),
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
            lambda: Agent3DConfig(channels=CHANNELS, agents=1),
            ConfigError,
            "agents: expected at least 2, found 1",
        ),
        (lambda: fusion("mean"), ConfigError, "the config of a fusion module, found 'mean'"),
    )
