"""The motion head: its latent, its future states, its maps and its losses."""

import dataclasses

import pytest
import torch
from refusals import assert_refused
from torch import Tensor
from torch_extra.compared import same

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

# eight channels: a bottleneck of one channel of 3 × 3 cells can pass back a gradient of exactly 0
SEPARATE = MotionHeadConfig(in_channels=8, latent=2, future_frames=2, samples=3)
SHUFFLED = dataclasses.replace(SEPARATE, decoders="shuffled", hidden=6, upsample=2)
LOSSES = MotionLossConfig()
ROWS, COLUMNS = 10, 12
CHANNELS = {"segmentation": 2, "instance_center": 1, "instance_offset": 2, "instance_flow": 2}


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.mark.parametrize("config", [SEPARATE, SHUFFLED])
def test_shapes_with_and_without_targets(config) -> None:
    head, features, targets = head_and_data(config)
    size = (config.upsample * ROWS, config.upsample * COLUMNS)
    outputs, predicted = head(features, targets), head.eval()(features)
    for maps, samples in ((outputs.maps, (2, 3)), (predicted.maps, (4, 2, 3))):
        shapes = {name: tuple(values.shape) for name, values in maps._asdict().items()}
        assert shapes == {name: (*samples, count, *size) for name, count in CHANNELS.items()}
    assert tuple(outputs.present.mu.shape) == tuple(outputs.future.log_sigma.shape) == (2, 2, 3, 3)
    assert predicted.future is None


@pytest.mark.parametrize("config", [SEPARATE, SHUFFLED])
@pytest.mark.parametrize("hidden_warp", ["none", "warped"])
@pytest.mark.parametrize("detach", [True, False])
def test_every_weight_learns(config, hidden_warp, detach) -> None:
    head, features, targets = head_and_data(
        dataclasses.replace(config, hidden_warp=hidden_warp, detach=detach)
    )
    sum(motion_losses(head(features, targets), targets, LOSSES).values()).backward()
    unused = [
        name
        for name, values in head.named_parameters()
        if values.grad is None or not values.grad.any()
    ]
    assert not unused


def test_the_mean_is_the_last_prediction_and_needs_no_draws() -> None:
    head, features, _ = head_and_data(SHUFFLED)
    drawn = head.eval()(features).maps
    head.config = dataclasses.replace(SHUFFLED, samples=0)
    assert same([each[-1:] for each in drawn], list(head(features).maps))
    assert not torch.equal(drawn.instance_center[0], drawn.instance_center[-1])


def test_noise_decides_the_draws_of_the_future() -> None:
    head, features, _ = head_and_data(SEPARATE)
    noise = torch.tensor([0.0, 1, 0])[:, None, None, None, None].expand(3, 2, 2, 3, 3)
    *draws, mean = head.eval()(features, noise=noise).maps.instance_center
    assert [torch.equal(draw, mean) for draw in draws] == [True, False, True]
    assert torch.equal(draws[1][:, 0], mean[:, 0])  # the present


def test_the_posterior_sees_the_future_and_not_the_present() -> None:
    head, features, targets = head_and_data(SEPARATE)
    before = head.eval()(features, targets)
    for frame, is_seen in ((0, False), (1, True), (2, True)):
        changed = targets._replace(centerness=targets.centerness.clone())
        changed.centerness[:, frame] += 1
        after = head(features, changed)
        assert torch.equal(before.future.mu, after.future.mu) is not is_seen
        assert torch.equal(before.present.mu, after.present.mu)


@pytest.mark.parametrize(("posterior_ignore", "is_seen"), [("keep", True), ("zero", False)])
def test_the_posterior_sees_the_mark_of_ignored_cells_only_where_it_is_kept(
    posterior_ignore, is_seen
) -> None:
    head, features, targets = head_and_data(
        dataclasses.replace(SEPARATE, posterior_ignore=posterior_ignore)
    )
    cleared = targets._replace(offset=targets.offset.where(targets.offset != 255, 0))
    marked, zero = (head.eval()(features, given).future.mu for given in (targets, cleared))
    assert torch.equal(marked, zero) is not is_seen


def test_frames_that_do_not_count_change_no_loss() -> None:
    head, features, targets = head_and_data(SEPARATE)
    targets.frame_mask[0, 2] = targets.frame_mask[1] = False
    outputs = head(features, targets)
    ignored = ~targets.frame_mask[:, :, None, None, None]
    changed = PredictedMotionMaps(*(torch.where(ignored, 7, maps) for maps in outputs.maps))
    present = LatentDistribution(*(torch.cat([each[:1], each[1:] + 3]) for each in outputs.present))
    before = motion_losses(outputs, targets, LOSSES)
    assert all(loss.item() > 0 for loss in before.values())
    assert same(
        motion_losses(MotionOutputs(changed, present, outputs.future), targets, LOSSES), before
    )


def test_a_batch_without_a_frame_that_counts_gives_zero_gradients() -> None:
    head, features, targets = head_and_data(SHUFFLED)
    nothing = targets._replace(frame_mask=torch.zeros_like(targets.frame_mask))
    losses = motion_losses(head(features.requires_grad_(), nothing), nothing, LOSSES)
    names = ["motion_seg", "motion_centerness", "motion_offset", "motion_flow", "motion_prob"]
    assert {name: loss.item() for name, loss in losses.items()} == dict.fromkeys(names, 0)
    sum(losses.values()).backward()
    assert torch.equal(features.grad, torch.zeros_like(features))


def test_a_certain_and_wrong_centre_costs_a_finite_loss() -> None:
    logits = torch.tensor([-1000.0, 1000.0]).view(1, 1, 1, 1, 2).requires_grad_()
    target = torch.tensor([1.0, 0.0]).view(1, 1, 1, 1, 2)
    loss = center_loss(logits, target, torch.ones(1, 1, dtype=torch.bool), LOSSES)
    loss.backward()
    assert (loss.isfinite(), logits.grad.isfinite().all()) == (True, True)


def test_a_sample_without_its_past_has_no_frame_that_counts() -> None:
    label_valid, past_valid = (
        torch.tensor([[1, 1, 0], [1, 1, 1]]).bool(),
        torch.tensor([[1, 1], [0, 1]]).bool(),
    )
    assert frame_mask(label_valid, past_valid).tolist() == [
        [True, True, False],
        [False, False, False],
    ]


def test_what_does_not_fit_is_refused() -> None:
    head, features, targets = head_and_data(SHUFFLED)
    assert_refused(
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
            "noise: expected that of 3 draws, found 5",
        ),
        (
            lambda: motion_losses(head(features), targets, LOSSES),
            NotAvailableError,
            r"outputs: .* found no posterior; give the targets",
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
            r"those of background and foreground, found \(1.0,\)",
        ),
    ],
)
def test_impossible_values_are_refused(config, values, message) -> None:
    assert_refused((lambda: config(**values), ConfigError, message))


def head_and_data(config: MotionHeadConfig) -> tuple[MotionHead, Tensor, MotionTargets]:
    """A head in training, features of two samples, and labels of a few moving blobs."""
    frames, size = config.future_frames + 1, (config.upsample * ROWS, config.upsample * COLUMNS)
    segmentation = torch.zeros(2, frames, *size, dtype=torch.int64)
    segmentation[..., 2:8, 2:10] = 1
    centerness = 0.5 * segmentation[:, :, None].float()
    centerness[..., 4, 6] = 1
    vectors = [
        torch.randn(2, frames, 2, *size).where(segmentation[:, :, None] == 1, 255.0)
        for _ in range(2)
    ]
    targets = MotionTargets(
        segmentation, centerness, *vectors, torch.ones(2, frames, dtype=torch.bool)
    )
    return MotionHead(config).train(), torch.randn(2, config.in_channels, ROWS, COLUMNS), targets
