"""The image encoder and the lift equal the released modules.

Golden sets swin_neck, swin_convert and lss: the released SwinTransformer, FPN_LSS, converter of Swin's weights and
TransformerLSS ran on CPU with random weights (tests/data/golden/model/README.md). Equal within 1e-4 of the largest
value; converted weights are exact.
"""

from dataclasses import replace

import pytest
import torch
from golden_model import check_close

from deepaccident_devkit.model.images import Swin, SwinConfig, from_official, image_encoder
from deepaccident_devkit.model.lift import CameraGeometry, LiftConfig, LiftSplat


@pytest.fixture
def swin_neck(golden_model):
    """The golden set, the backbone and the neck with its weights."""
    golden = golden_model("swin_neck")
    return golden, *encoder_of(golden, golden.config["swin"], golden.config["neck"])


def encoder_of(golden, swin, neck):
    config = SwinConfig(
        embed_dims=swin["embed_dims"],
        depths=tuple(swin["depths"]),
        num_heads=tuple(swin["num_heads"]),
        window_size=swin["window_size"],
        out_stages=tuple(swin["out_indices"]),
        neck_channels=neck["out_channels"],
    )
    modules = image_encoder(config)
    for module, prefix in zip(modules, ("img_backbone.", "img_neck."), strict=True):
        module.load_state_dict(golden.state(prefix))
        module.eval()
    return modules


def test_swin_and_its_neck_equal_the_released_ones(swin_neck):
    golden, backbone, neck = swin_neck
    images, out = golden.inputs()["images"], golden.outputs()
    with torch.no_grad():
        stage3, stage4 = backbone(images)
        features = neck((stage3, stage4))
    check_close(stage3, out["stage3"])
    check_close(stage4, out["stage4"])
    check_close(features, out["neck"])


def test_the_index_of_relative_positions_is_the_released_one(swin_neck):
    golden, backbone, _ = swin_neck
    fresh = Swin(backbone.config).state_dict()
    indices = {name: each for name, each in golden.state("img_backbone.").items() if name.endswith("_index")}
    assert len(indices) == 8
    for name, each in indices.items():
        assert torch.equal(fresh[name], each)


def test_official_swin_weights_convert_as_in_the_release(golden_model):
    golden = golden_model("swin_convert")
    converted, expected = from_official(golden.inputs()), golden.outputs()
    assert list(converted) == list(expected)
    for name, tensor in expected.items():
        assert torch.equal(converted[name], tensor), name


@pytest.mark.parametrize("config", ["tiny", "tiny_v2x"])
def test_names_and_shapes_are_those_of_the_released_model(request, config):
    """Golden released_keys_*.txt: the full released configs, built."""
    text = (request.config.getoption("golden") / "model" / f"released_keys_DeepAccident_{config}.txt").read_text()
    prefixes = ("img_backbone.", "img_neck.", "transformer.")
    released = [line for line in text.splitlines() if line.startswith(prefixes)]
    bev = (-51.2, 51.2, 0.8)
    with torch.device("meta"):
        backbone, neck = image_encoder(SwinConfig())
        lift = LiftSplat(
            LiftConfig(
                in_channels=neck.out_channels,
                channels=64,
                depth=(1, 60, 1),
                x=bev,
                y=bev,
                z=(-30, 30, 60),
                image_size=(256, 704),
                stride=16,
            )
        )
    ours = [
        f"{prefix}{name} {tuple(tensor.shape)} {str(tensor.dtype).removeprefix('torch.')}"
        for prefix, module in zip(prefixes, (backbone, neck, lift), strict=True)
        for name, tensor in module.state_dict().items()
    ]
    assert sorted(ours) == sorted(released)


@pytest.fixture
def lss(golden_model):
    """The golden set, a lift with its weights and its cameras."""
    golden = golden_model("lss")
    return golden, lift_of(golden, golden.config), cameras_of(golden.inputs())


def lift_of(golden, released):
    grid = released["grid_conf"]
    config = LiftConfig(
        in_channels=released["numC_input"],
        channels=released["numC_Trans"],
        depth=tuple(grid["dbound"]),
        x=tuple(grid["xbound"]),
        y=tuple(grid["ybound"]),
        z=tuple(grid["zbound"]),
        image_size=tuple(released["input_dim"]),
        stride=16,
        frustum="corners",
        voxel_rounding="trunc",
    )
    lift = LiftSplat(config).eval()
    state = golden.state("transformer.")
    assert torch.equal(lift.frustum, state["frustum"])
    lift.load_state_dict(state)
    return lift


def cameras_of(given, prefix=""):
    return CameraGeometry(
        rotation=given[f"{prefix}rots"],
        translation=given[f"{prefix}trans"],
        intrinsics=given[f"{prefix}intrins"],
        image_rotation=given[f"{prefix}post_rots"],
        image_translation=given[f"{prefix}post_trans"],
    )


def test_the_lift_equals_the_released_one(lss):
    golden, lift, cameras = lss
    out = golden.outputs()
    check_close(lift.points(cameras).flatten(0, 1), out["geometry"])
    with torch.no_grad():
        bev = lift(golden.inputs()["x"], cameras)
    check_close(bev, out["bev"])
    check_close(bev, out["bev_cumsum"])


def test_truncation_folds_the_points_that_the_released_one_folds(lss):
    golden, lift, cameras = lss
    folded = golden.outputs()["folded_points"]
    floor = LiftSplat(replace(lift.config, voxel_rounding="floor"))
    floor.load_state_dict(lift.state_dict())
    theirs, ours = lift.cells(cameras).flatten(0, 1), floor.cells(cameras).flatten(0, 1)
    assert torch.equal(theirs != ours, folded)
    assert (ours[folded] == -1).all()
    assert (int(folded.sum()), int((ours >= 0).sum())) == (52, 2953)


def test_images_of_all_agents_become_the_released_maps(golden_model):
    """Golden end_to_end: the whole released model; within the 1e-3 that float16 leaves of its maps."""
    golden = golden_model("end_to_end")
    config, given, out = golden.config, golden.inputs(), golden.outputs()
    backbone, neck = encoder_of(golden, config["img_backbone"], config["img_neck"])
    lift = lift_of(golden, config["transformer"])
    agents = [f"agent{a}." for a in range(config["num_agents"])]
    images = torch.cat([given[f"{agent}images"] for agent in agents]).float()
    with torch.no_grad():
        features = neck(backbone(images.flatten(0, 2)))
        maps = [
            lift(part, cameras_of(given, agent))
            for part, agent in zip(features.unflatten(0, images.shape[:3]).split(1), agents, strict=True)
        ]
    check_close(features, out["neck"])
    check_close(torch.cat(maps), out["lss"], 1e-3)
