"""Image encoders: shapes, names, windows, and that official Swin weights mean the same after their
conversion.
"""

import pytest
import torch
from refusals import assert_refused
from torch import nn

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.images import (
    SmallConvConfig,
    Swin,
    SwinConfig,
    from_official,
    image_encoder,
    normalised,
)
from deepaccident_devkit.plugins.model.images.swin import PatchMerging

SMALL_SWIN = {
    "embed_dims": 8,
    "depths": (2, 2, 2, 2),
    "num_heads": (1, 2, 2, 4),
    "neck_channels": 16,
}
ENCODERS = [
    SwinConfig(**SMALL_SWIN),
    SwinConfig(
        embed_dims=8,
        depths=(1, 2),
        num_heads=(1, 2),
        window_size=4,
        out_stages=(0, 1),
        neck_channels=16,
    ),
    SmallConvConfig(),
]


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    "config", ENCODERS, ids=lambda config: f"{type(config).__name__}-{config.stride}"
)
def test_features_have_the_stated_size_and_all_weights_learn(config):
    backbone, neck = image_encoder(config)
    maps = backbone(noise(2, 3, 90, 100))
    features = neck(maps)
    assert features.shape == (
        2,
        config.neck_channels,
        -(-90 // config.stride),
        -(-100 // config.stride),
    )
    assert (tuple(each.shape[1] for each in maps), neck.out_channels) == (
        backbone.out_channels,
        config.neck_channels,
    )
    (features * noise(*features.shape, seed=1)).sum().backward()
    weights = dict((*backbone.named_parameters(), *neck.named_parameters()))
    assert [
        name for name, each in weights.items() if each.grad is None or not each.grad.abs().sum() > 0
    ] == []


@pytest.mark.parametrize(
    "config", ENCODERS, ids=lambda config: f"{type(config).__name__}-{config.stride}"
)
def test_an_image_does_not_depend_on_the_others_of_its_batch(config):
    images, (backbone, neck) = (
        noise(3, 3, 64, 96),
        (module.eval() for module in image_encoder(config)),
    )
    torch.testing.assert_close(
        neck(backbone(images))[1:2], neck(backbone(images[1:2])), atol=1e-5, rtol=1e-4
    )


def test_images_are_normalised_channel_by_channel():
    images = torch.tensor([0, 128, 255], dtype=torch.uint8)[None, :, None, None].expand(2, 3, 2, 2)
    expected = torch.tensor([(0 - 0.485) / 0.229, (128 / 255 - 0.456) / 0.224, (1 - 0.406) / 0.225])
    torch.testing.assert_close(normalised(images), expected[None, :, None, None].expand(2, 3, 2, 2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: normalised(torch.zeros(1, 3, 4, 4)), "expected uint8, found torch.float32"),
        (lambda: image_encoder("swin"), "expected a SwinConfig or a SmallConvConfig, found 'swin'"),
        (lambda: SmallConvConfig(widths=(8, 8)), "widths: expected three"),
        (lambda: SwinConfig(num_heads=(3, 6)), "num_heads: expected 4"),
        (lambda: SwinConfig(num_heads=(3, 6, 12, 25)), "768 channels cannot be shared by 25 heads"),
        (
            lambda: SwinConfig(out_stages=(1, 3)),
            r"out_stages: expected one of \[\(0, 1\), .* found \(1, 3\)",
        ),
        (
            lambda: from_official({"model": torch.zeros(1)}),
            "found 'model'; .* give its entry 'model'",
        ),
    ],
)
def test_what_does_not_fit_is_named(make, message):
    assert_refused((make, ConfigError, message))


# --- Swin


def test_checkpointing_changes_neither_values_nor_gradients():
    torch.manual_seed(0)
    plain, again = (
        Swin(SwinConfig(**SMALL_SWIN, checkpointing=each)).train() for each in (False, True)
    )
    again.load_state_dict(plain.state_dict())
    for network in (plain, again):
        sum(each.square().sum() for each in network(noise(1, 3, 64, 96))).backward()
    gradients = [
        {name: each.grad for name, each in network.named_parameters()} for network in (plain, again)
    ]
    torch.testing.assert_close(*gradients)


def test_maps_of_odd_sizes_are_filled_to_be_halved():
    merging, features = PatchMerging(2), noise(1, 3, 5, 2)
    torch.testing.assert_close(
        merging(features), merging(nn.functional.pad(features, (0, 0, 0, 1, 0, 1)))
    )
