"""Image encoders: shapes, gradients, windows, and wrong configurations."""

import pytest
import torch
from support.expected_errors import assert_raises
from torch import nn
from torch_extra.model.gradients import names_without_gradient
from torch_extra.model.tensors import make_noise

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.model.images import (
    SmallConvConfig,
    Swin,
    SwinConfig,
    from_official,
    image_encoder,
    normalise_images,
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


WITH_ENCODERS = pytest.mark.parametrize(
    "config", ENCODERS, ids=lambda config: f"{type(config).__name__}-{config.stride}"
)


@WITH_ENCODERS
def test_features_have_the_stated_size_and_all_weights_learn(config):
    backbone, neck = image_encoder(config)
    stride = config.stride

    maps = backbone(make_noise(2, 3, 90, 100))
    features = neck(maps)

    assert features.shape == (2, config.neck_channels, -(-90 // stride), -(-100 // stride))
    assert neck.out_channels == config.neck_channels
    assert tuple(stage.shape[1] for stage in maps) == backbone.out_channels

    (features * make_noise(*features.shape, seed=1)).sum().backward()
    assert names_without_gradient(backbone, neck) == []


@WITH_ENCODERS
def test_an_image_does_not_depend_on_the_others_of_its_batch(config):
    images = make_noise(3, 3, 64, 96)
    backbone, neck = (module.eval() for module in image_encoder(config))
    features, single = neck(backbone(images)), neck(backbone(images[1:2]))
    torch.testing.assert_close(features[1:2], single, atol=1e-5, rtol=1e-4)


def test_images_are_normalised_channel_by_channel():
    pixel = torch.tensor([0, 128, 255], dtype=torch.uint8)
    images = pixel[None, :, None, None].expand(2, 3, 2, 2)

    values = normalise_images(images)

    expected = torch.tensor(
        [
            (0 - 0.485) / 0.229,
            (128 / 255 - 0.456) / 0.224,
            (1 - 0.406) / 0.225,
        ]
    )
    torch.testing.assert_close(values, expected[None, :, None, None].expand(2, 3, 2, 2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: normalise_images(torch.zeros(1, 3, 4, 4)), "expected uint8, found torch.float32"),
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
def test_wrong_values_are_named(make, message):
    assert_raises((make, ConfigError, message))


# --- Swin


def test_checkpointing_changes_neither_values_nor_gradients():
    torch.manual_seed(0)
    plain, checkpointed = (
        Swin(SwinConfig(**SMALL_SWIN, checkpointing=choice)).train() for choice in (False, True)
    )
    checkpointed.load_state_dict(plain.state_dict())

    gradients = []
    for network in (plain, checkpointed):
        sum(maps.square().sum() for maps in network(make_noise(1, 3, 64, 96))).backward()
        gradients.append({name: weight.grad for name, weight in network.named_parameters()})

    torch.testing.assert_close(*gradients)


def test_maps_of_odd_sizes_are_padded_before_they_are_halved():
    merging, features = PatchMerging(2), make_noise(1, 3, 5, 2)
    padded = nn.functional.pad(features, (0, 0, 0, 1, 0, 1))
    torch.testing.assert_close(merging(features), merging(padded))
