"""The motion head: its latent, its future states, its maps and its losses."""

import dataclasses

import pytest
import torch
from support.expected_errors import assert_raises
from torch import Tensor
from torch_extra.compared import are_identical
from torch_extra.model.gradients import names_without_gradient

from deepaccident_devkit.errors import ConfigError, GeometryError, NotAvailableError
from deepaccident_devkit.plugins.model.motion import (
    LatentDistribution,
    MotionHead,
    MotionHeadConfig,
    MotionLossConfig,
    MotionOutputs,
    MotionTargets,
    PredictedMotionMaps,
    frame_mask,
    motion_losses,
)
from deepaccident_devkit.plugins.model.motion.head import center_loss

# with fewer than eight channels, a bottleneck of one channel can have a gradient of exactly 0
SEPARATE = MotionHeadConfig(in_channels=8, latent=2, future_frames=2, samples=3)
SHUFFLED = dataclasses.replace(SEPARATE, decoders="shuffled", hidden=6, upsample=2)
LOSSES = MotionLossConfig()
ROWS, COLUMNS = 10, 12
CHANNELS = {"segmentation": 2, "instance_center": 1, "instance_offset": 2, "instance_flow": 2}


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.mark.parametrize("config", [SEPARATE, SHUFFLED])
def test_shapes_with_and_without_targets(config) -> None:
    head, features, targets = make_head_and_data(config)
    size = (config.upsample * ROWS, config.upsample * COLUMNS)

    outputs, predicted = head(features, targets), head.eval()(features)

    for maps, batch_shape in (
        (outputs.maps, (2, 3)),
        (predicted.maps, (4, 2, 3)),
    ):
        for name, count in CHANNELS.items():
            assert getattr(maps, name).shape == (*batch_shape, count, *size)
        assert len(maps) == len(CHANNELS)
    assert tuple(outputs.present.mu.shape) == tuple(outputs.future.log_sigma.shape) == (2, 2, 3, 3)
    assert predicted.future is None


@pytest.mark.parametrize("config", [SEPARATE, SHUFFLED])
@pytest.mark.parametrize("hidden_warp", ["none", "warped"])
@pytest.mark.parametrize("detach", [True, False])
def test_every_weight_learns(config, hidden_warp, detach) -> None:
    config = dataclasses.replace(config, hidden_warp=hidden_warp, detach=detach)
    head, features, targets = make_head_and_data(config)
    losses = motion_losses(head(features, targets), targets, LOSSES)
    sum(losses.values()).backward()
    assert names_without_gradient(head) == []


def test_the_mean_is_the_last_prediction_and_needs_no_draws() -> None:
    head, features, _ = make_head_and_data(SHUFFLED)
    sampled_maps = head.eval()(features).maps

    head.config = dataclasses.replace(SHUFFLED, samples=0)
    mean_maps = head(features).maps

    assert are_identical([samples[-1:] for samples in sampled_maps], list(mean_maps))
    centers = sampled_maps.instance_center
    assert not torch.equal(centers[0], centers[-1])


def test_noise_decides_the_draws_of_the_future() -> None:
    head, features, _ = make_head_and_data(SEPARATE)
    noise = torch.tensor([0.0, 1, 0]).view(3, 1, 1, 1, 1).expand(3, 2, 2, 3, 3)

    *draws, mean = head.eval()(features, noise=noise).maps.instance_center
    assert [torch.equal(draw, mean) for draw in draws] == [True, False, True]
    assert torch.equal(draws[1][:, 0], mean[:, 0])  # the present


def test_the_posterior_sees_the_future_and_not_the_present() -> None:
    head, features, targets = make_head_and_data(SEPARATE)
    before = head.eval()(features, targets)
    for frame, is_seen in ((0, False), (1, True), (2, True)):
        centerness = targets.centerness.clone()
        centerness[:, frame] += 1
        after = head(features, targets._replace(centerness=centerness))
        assert torch.equal(before.future.mu, after.future.mu) is not is_seen
        assert torch.equal(before.present.mu, after.present.mu)


@pytest.mark.parametrize(("posterior_ignore", "is_seen"), [("keep", True), ("zero", False)])
def test_the_posterior_sees_the_mark_of_ignored_cells_only_where_it_is_kept(
    posterior_ignore, is_seen
) -> None:
    head, features, targets = make_head_and_data(
        dataclasses.replace(SEPARATE, posterior_ignore=posterior_ignore)
    )
    unmarked_targets = targets._replace(offset=targets.offset.where(targets.offset != 255, 0))

    outputs = head.eval()(features, targets)
    unmarked_outputs = head(features, unmarked_targets)

    assert torch.equal(outputs.future.mu, unmarked_outputs.future.mu) is not is_seen


def test_frames_that_do_not_count_change_no_loss() -> None:
    head, features, targets = make_head_and_data(SEPARATE)
    targets.frame_mask[0, 2] = False
    targets.frame_mask[1] = False
    outputs = head(features, targets)
    losses = motion_losses(outputs, targets, LOSSES)
    assert all(loss.item() > 0 for loss in losses.values())

    is_ignored = ~targets.frame_mask[:, :, None, None, None]
    maps = PredictedMotionMaps(*(torch.where(is_ignored, 7, values) for values in outputs.maps))
    mu, log_sigma = (torch.cat([values[:1], values[1:] + 3]) for values in outputs.present)
    changed_outputs = MotionOutputs(maps, LatentDistribution(mu, log_sigma), outputs.future)
    assert are_identical(motion_losses(changed_outputs, targets, LOSSES), losses)


def test_a_batch_without_a_frame_that_counts_gives_zero_gradients() -> None:
    head, features, targets = make_head_and_data(SHUFFLED)
    targets = targets._replace(frame_mask=torch.zeros_like(targets.frame_mask))

    losses = motion_losses(head(features.requires_grad_(), targets), targets, LOSSES)

    names = [
        "motion_seg",
        "motion_centerness",
        "motion_offset",
        "motion_flow",
        "motion_prob",
    ]
    assert {name: loss.item() for name, loss in losses.items()} == dict.fromkeys(names, 0)
    sum(losses.values()).backward()
    assert torch.equal(features.grad, torch.zeros_like(features))


def test_a_certain_and_wrong_centre_costs_a_finite_loss() -> None:
    logits = torch.tensor([-1000.0, 1000.0]).view(1, 1, 1, 1, 2).requires_grad_()
    target = torch.tensor([1.0, 0.0]).view(1, 1, 1, 1, 2)
    valid_frames = torch.ones(1, 1, dtype=torch.bool)

    loss = center_loss(logits, target, valid_frames, LOSSES)
    loss.backward()

    assert loss.isfinite()
    assert logits.grad.isfinite().all()


def test_a_sample_without_its_past_has_no_frame_that_counts() -> None:
    label_valid = torch.tensor([[True, True, False], [True, True, True]])
    past_valid = torch.tensor([[True, True], [False, True]])
    assert frame_mask(label_valid, past_valid).tolist() == [
        [True, True, False],
        [False, False, False],
    ]


def test_data_of_other_shapes_are_refused() -> None:
    head, features, targets = make_head_and_data(SHUFFLED)
    assert_raises(
        (
            lambda: head(features[..., :5, :5], targets),
            GeometryError,
            r"segmentation of shape \(2, 3, 10, 10\), found \(2, 3, 20, 24\)",
        ),
        (
            lambda: head(features, targets, noise=torch.zeros(2, 2, 1, 1)),
            GeometryError,
            r"noise: expected shape \(2, 2, 3, 3\), found \(2, 2, 1, 1\)",
        ),
        (
            lambda: head(features, noise=torch.zeros(5, 2, 2, 3, 3)),
            GeometryError,
            "noise: expected noise for 3 draws, found 5",
        ),
        (
            lambda: motion_losses(head(features), targets, LOSSES),
            NotAvailableError,
            r"outputs: .* found no posterior; pass the targets",
        ),
    )


@pytest.mark.parametrize(
    ("config", "values", "message"),
    [
        (
            MotionHeadConfig,
            {"hidden_warp": "moved"},
            "hidden_warp: expected one of none, warped, found 'moved'",
        ),
        (
            MotionHeadConfig,
            {"posterior_ignore": "drop"},
            "posterior_ignore: expected one of keep, zero, found 'drop'",
        ),
        (
            MotionHeadConfig,
            {"decoders": "none"},
            "decoders: expected one of separate, shuffled, found 'none'",
        ),
        (MotionHeadConfig, {"latent": 0}, "latent: expected a number from 1, found 0"),
        (
            MotionHeadConfig,
            {"log_sigma": (5, -5)},
            r"smaller limit first, such as \(-5, 5\), found \(5, -5\)",
        ),
        (
            MotionHeadConfig,
            {"upsample": 2},
            "separate decoders keep the states' resolution, found 2; choose 1, or",
        ),
        (MotionLossConfig, {"top_k": 0}, "top_k: expected a share above 0 and at most 1, found 0"),
        (
            MotionLossConfig,
            {"class_weights": (1.0,)},
            r"the weights of background and foreground, found \(1.0,\)",
        ),
    ],
)
def test_impossible_values_are_refused(config, values, message) -> None:
    assert_raises((lambda: config(**values), ConfigError, message))


def make_head_and_data(config: MotionHeadConfig) -> tuple[MotionHead, Tensor, MotionTargets]:
    """Make a head in training, features of two samples, and labels of one instance."""
    frames = config.future_frames + 1
    size = (config.upsample * ROWS, config.upsample * COLUMNS)
    segmentation = torch.zeros(2, frames, *size, dtype=torch.int64)
    segmentation[..., 2:8, 2:10] = 1
    centerness = 0.5 * segmentation[:, :, None].float()
    centerness[..., 4, 6] = 1
    offset, flow = (
        torch.randn(2, frames, 2, *size).where(segmentation[:, :, None] == 1, 255.0)
        for _ in range(2)
    )
    targets = MotionTargets(
        segmentation,
        centerness,
        offset,
        flow,
        torch.ones(2, frames, dtype=torch.bool),
    )
    head = MotionHead(config).train()
    features = torch.randn(2, config.in_channels, ROWS, COLUMNS)
    return head, features, targets
