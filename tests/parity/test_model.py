"""The model against the released classes, and the fusion modules against their originals.

The golden set (tests/data/golden/model, its README) was made by running those classes on a CPU with
torch 2.13 and
random weights: DeepAccident @ 728e366, CoBEVT, V2X-ViT. Everything is equal within 1e-4 of the
    largest value where
nothing else is said; indices, masks, converted weights and warped labels are exact. Rotated
suppression of boxes has no golden numbers, since the released one needs CUDA.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from golden_model import GoldenModel, check_close

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.conventions import flip_pose
from deepaccident_devkit.motion import Augmentation, MotionLabelConfig, MotionLabels
from deepaccident_devkit.motion.warping import WarpMode
from deepaccident_devkit.plugins.model import warps
from deepaccident_devkit.plugins.model.bev import BevEncode, BevEncodeConfig, crop
from deepaccident_devkit.plugins.model.checkpoint import Weights, load_weights
from deepaccident_devkit.plugins.model.detection import (
    RELEASED_CLASS_SLOTS,
    RELEASED_NMS,
    CenterHead,
    DecodingConfig,
    DetectionConfig,
    DetectionLossConfig,
    TargetConfig,
    TaskMaps,
    TaskTargets,
    decode_candidates,
    detection_losses,
    detection_targets,
    suppress,
)
from deepaccident_devkit.plugins.model.detection.targets import peak_radius
from deepaccident_devkit.plugins.model.fusion import (
    Agent3D,
    Agent3DConfig,
    CobevtConfig,
    DiscoNetConfig,
    ReleasedFusionConfig,
    V2XViTConfig,
    fusion,
)
from deepaccident_devkit.plugins.model.fusion.transformers import sinusoid
from deepaccident_devkit.plugins.model.images import Swin, SwinConfig, from_official, image_encoder
from deepaccident_devkit.plugins.model.inputs import ModelInputs
from deepaccident_devkit.plugins.model.lift import CameraGeometry, LiftConfig, LiftSplat
from deepaccident_devkit.plugins.model.motion import (
    LatentDistribution,
    MotionHead,
    MotionHeadConfig,
    MotionLossConfig,
    MotionTargets,
    frame_mask,
    motion_losses,
)
from deepaccident_devkit.plugins.model.motion.decoders import (
    FlowGru,
    SpatialDistribution,
    warp_with_flow,
)
from deepaccident_devkit.plugins.model.motion.head import (
    center_loss,
    latent_loss,
    segmentation_loss,
    vector_loss,
)
from deepaccident_devkit.plugins.model.network import ModelConfig, V2XFormer
from deepaccident_devkit.plugins.model.presets import released
from deepaccident_devkit.plugins.model.temporal import TemporalConfig, temporal_model
from deepaccident_devkit.plugins.model.training_step import Targets, TrainingStep
from deepaccident_devkit.plugins.model.warps import matrices_from_six


@pytest.fixture
def swin_neck(golden_model):
    """The golden set, the backbone and the neck with its weights."""
    golden = golden_model("swin_neck")
    swin, neck = golden.config["swin"], golden.config["neck"]
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
    return golden, *modules


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
    indices = {
        name: each
        for name, each in golden.state("img_backbone.").items()
        if name.endswith("_index")
    }
    assert len(indices) == sum(backbone.config.depths)
    for name, each in indices.items():
        assert torch.equal(fresh[name], each)


def test_official_swin_weights_convert_as_in_the_release(golden_model):
    golden = golden_model("swin_convert")
    converted, expected = from_official(golden.inputs()), golden.outputs()
    assert list(converted) == list(expected)
    for name, tensor in expected.items():
        assert torch.equal(converted[name], tensor), name


@pytest.fixture
def lss(golden_model):
    """The golden set, a lift with its weights and its cameras."""
    golden = golden_model("lss")
    grid = golden.config["grid_conf"]
    config = LiftConfig(
        in_channels=golden.config["numC_input"],
        channels=golden.config["numC_Trans"],
        depth=tuple(grid["dbound"]),
        x=tuple(grid["xbound"]),
        y=tuple(grid["ybound"]),
        z=tuple(grid["zbound"]),
        image_size=tuple(golden.config["input_dim"]),
        stride=golden.config["downsample"],
        frustum="corners",
        voxel_rounding="trunc",
    )
    given = golden.inputs()
    cameras = CameraGeometry(
        rotation=given["rots"],
        translation=given["trans"],
        intrinsics=prepared(given["intrins"], given["post_rots"], given["post_trans"]),
    )
    lift = LiftSplat(config).eval()
    assert torch.equal(lift.frustum, golden.state("transformer.")["frustum"])
    lift.load_state_dict(golden.state("transformer."))
    return golden, lift, cameras


def prepared(intrinsics: torch.Tensor, linear: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """The intrinsics of images that were scaled, cropped and turned, which the release has beside
    those of the file.
    """
    affine = linear.clone()
    affine[..., :2, 2] = shift[..., :2]
    return affine @ intrinsics


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
    floor = LiftSplat(LiftConfig(**{**_fields(lift.config), "voxel_rounding": "floor"}))
    floor.load_state_dict(lift.state_dict())
    theirs, ours = lift.cells(cameras).flatten(0, 1), floor.cells(cameras).flatten(0, 1)
    assert torch.equal(theirs != ours, folded)
    assert (ours[folded] == -1).all()


def _fields(config):
    return {name: getattr(config, name) for name in config.__dataclass_fields__}


Golden = Callable[[str], GoldenModel]
CELLS_AT_TIES = 0.005
"""The share of cells that may differ after a nearest warp, for points on the border between two
cells.
"""


def bounds(golden: GoldenModel, name: str = "grid") -> BevGrid:
    grid = golden.config[name]
    return BevGrid(x=tuple(grid["xbound"]), y=tuple(grid["ybound"]))


def check_sampled(ours: torch.Tensor, golden: torch.Tensor, mode: str) -> None:
    if mode == "bilinear":
        check_close(ours, golden)
    else:
        assert ours.shape == golden.shape
        assert float(((ours - golden).abs() > 1e-6).float().mean()) <= CELLS_AT_TIES


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("augmented", [False, True])
def test_chains_of_warps_equal_the_released_warper(
    golden_model: Golden, augmented: bool, mode: WarpMode
) -> None:
    """FeatureWarper's cumulative warp; nearest: all but 0.5 % of the cells."""
    golden = golden_model("warps")
    given = golden.inputs()
    matrix = given["aug"] if augmented else None
    chain = warps.present_from_past_batch(
        given["egomotion"][:, :2], chain="released", bev_transform=matrix
    )
    ours = given["x"].clone()
    ours[:, :2] = warps.warp_features(
        given["x"][:, :2].flatten(0, 1),
        chain.flatten(0, 1),
        bounds(golden),
        warp="stretched",
        mode=mode,
    ).unflatten(0, chain.shape[:2])
    check_sampled(ours, golden.outputs()[f"temporal{'_aug' if augmented else ''}_{mode}"], mode)


def test_partners_are_placed_as_by_the_released_warper(golden_model: Golden) -> None:
    """The maps; the poses' matrices within 1e-6; also with the released transforms of augmented
    maps, and the right.
    """
    golden = golden_model("warps")
    given, expected, grid = golden.inputs(), golden.outputs(), bounds(golden)
    ego_from_agent = warps.matrices_from_six(given["relative_pose"])
    check_close(ego_from_agent, expected["pose_mats"], 1e-6)
    check_close(
        warps.features_to_ego(given["xv"], ego_from_agent, grid, warp="stretched"), expected["v2x"]
    )
    own = given["aug_v"]
    as_released = warps.between_augmented(ego_from_agent, own, own)
    check_close(
        warps.features_to_ego(given["xv"], as_released, grid, warp="stretched"),
        expected["v2x_aug_released"],
    )
    right = warps.between_augmented(ego_from_agent, own[:, :1], own)
    check_close(
        warps.features_to_ego(given["xv"], right, grid, warp="stretched"), expected["v2x_aug_right"]
    )


@pytest.mark.parametrize(
    ("name", "pose"), [("identity_full", [0.0] * 6), ("move_full", [7.3, -3.1, 0, 0, 0, 0.6])]
)
def test_a_full_map_is_warped_as_by_the_released_warper(
    golden_model: Golden, name: str, pose: list[float]
) -> None:
    """128 × 128 cells of 0.8 m."""
    golden = golden_model("warps")
    target_from_source = warps.matrices_from_six(torch.tensor([pose]))
    features = golden.inputs()["xf"][:, 0]
    ours = warps.warp_features(
        features[:, None], target_from_source, bounds(golden, "full"), warp="stretched"
    )
    check_close(ours, golden.outputs()[name])


@pytest.mark.parametrize("case", ["eval", "eval_aug", "train_aug"])
def test_temporal_model_equals_the_released_one(golden_model: Golden, case: str) -> None:
    """Temporal3DConvModel; also samples without their oldest frames."""
    golden = golden_model("temporal")
    given = golden.inputs()
    frames = golden.config["receptive_field"]
    config = TemporalConfig(
        channels=golden.config["in_channels"],
        grid=bounds(golden, "grid_conf"),
        warp="stretched",
        chain="released",
        egomotion_input="raw",
    )
    model = temporal_model(config)
    model.load_state_dict(golden.state("temporal_model."))
    model.train(case.startswith("train"))
    matrix = given["aug"] if case.endswith("aug") else None
    ours = model(
        given["x"], given["egomotion"][:, :frames], given["img_is_valid"][:, :frames], matrix
    )
    check_close(ours, golden.outputs()[case])


def test_released_fusion_equals_the_released_one(golden_model: Golden) -> None:
    """V2X_fusion with its warp. Gradients within 1e-3."""
    golden = golden_model("fusion_released")
    given, expected = golden.inputs(), golden.outputs()
    x = given["x"].requires_grad_()
    ego_from_agent = warps.matrices_from_six(given["relative_pose"])
    placed = warps.features_to_ego(x, ego_from_agent, bounds(golden), warp="stretched")
    check_close(placed, expected["warped"])
    config = ReleasedFusionConfig(
        channels=x.shape[2],
        ego_channels=tuple(golden.config["ego_channels"]),
        fill_below=golden.config["fill_threshold"],
    )
    assert config == ReleasedFusionConfig(channels=x.shape[2])
    everywhere = torch.ones_like(x[:, :, 0], dtype=torch.bool)
    fused = fusion(config)(placed, everywhere, *vehicles_without_delay(everywhere))
    check_close(fused, expected["fused"])
    (fused * given["loss_weight"]).sum().backward()
    check_close(x.grad, expected["grad_x"], 1e-3)


def test_the_released_fusion_s_unreached_layers_equal_its_own(golden_model: Golden) -> None:
    """The layers behind the early return, called in the order of the lines that are never
    reached.
    """
    golden = golden_model("fusion_agent3d_dead")
    given, expected = golden.inputs(), golden.outputs()
    model = Agent3D(
        Agent3DConfig(channels=golden.config["in_channels"], agents=golden.config["num_agents"])
    ).eval()
    model.load_state_dict(golden.state("v2x_fusion."))
    check_close(model.over_agents(given["warped"], given["relative_pose"]), expected["after_model"])
    check_close(model(given["warped"], given["relative_pose"]), expected["compressed"])


def test_disconet_equals_the_original(golden_model: Golden) -> None:
    """PixelWeightedFusionSoftmax and Linear, of CoBEVT's code."""
    golden = golden_model("ref_disconet")
    given, expected = golden.inputs(), golden.outputs()
    model = fusion(
        DiscoNetConfig(channels=golden.config["channels"], last_relu=golden.config["final_relu"])
    ).eval()
    model.load_state_dict(
        {**disconet_scores(golden), **renamed(golden.state("mlp."), [(r"^", "out.")])}
    )
    check_close(model.weights(given["x"], given["mask"]), expected["weights"][:, :, 0])
    check_close(
        model(given["x"], given["mask"], *vehicles_without_delay(given["mask"])), expected["y"]
    )


def disconet_scores(golden: GoldenModel) -> dict[str, torch.Tensor]:
    scores = {}
    for key, value in golden.state("pixel_weighted_fusion.").items():
        layer, number, name = re.fullmatch(r"(conv|bn)1_(\d)\.(.*)", key).groups()
        place = 3 * (int(number) - 1) + (layer == "bn")
        scores[f"score.{place}.{name}"] = value.flatten(1) if value.ndim == 4 else value
    return scores


def test_cobevt_equals_the_original(golden_model: Golden) -> None:
    """SwapFusionEncoder; the first layer alone and the whole."""
    golden = golden_model("ref_cobevt")
    given, expected, cfg = golden.inputs(), golden.outputs(), golden.config
    config = CobevtConfig(
        channels=cfg["input_dim"],
        depth=cfg["depth"],
        window=cfg["window_size"],
        heads=cfg["input_dim"] // cfg["dim_head"],
        agents=cfg["agent_size"],
        agent_relation="slots",
        masked_cells="averaged",
    )
    model = fusion(config).eval()
    table = [
        ("_ffd.", "_feed_forward."),
        (r"\.fn\.", ".layer."),
        (r"relative_position_bias_table\.weight", "bias_table"),
        ("mlp_head.2", "head.0"),
        ("mlp_head.3", "head.1"),
    ]
    state = {key: value for key, value in golden.state().items() if "position_index" not in key}
    model.load_state_dict(renamed(state, table))
    first = model.layers[0](given["x"].movedim(2, -1), given["mask"]).movedim(-1, 2)
    check_close(first, expected["after_block0"])
    check_close(
        model(given["x"], given["mask"], *vehicles_without_delay(given["mask"])), expected["y"]
    )


def test_v2xvit_equals_the_original(golden_model: Golden) -> None:
    """RTE, V2XFusionBlock and FFN; each step that the golden file has; what is float16 there within
    2e-3.
    """
    golden = golden_model("ref_v2xvit")
    given, expected, cfg = golden.inputs(), golden.outputs(), golden.config
    config = V2XViTConfig(
        channels=cfg["cav"]["dim"],
        depth=cfg["depth"],
        heads=cfg["cav"]["heads"],
        windows=tuple(cfg["pwindow"]["window_size"]),
        window_heads=tuple(cfg["pwindow"]["heads"]),
        masked_cells="windowed",
    )
    model = fusion(config).eval()
    state = golden.state()
    delays = state.pop("rte.emb.emb.weight")
    check_close(sinusoid(torch.arange(len(delays)), delays.shape[1]), delays, 1e-6)
    model.load_state_dict(v2xvit_state(state))
    mask, infra = given["mask"], given["types"] == 1
    tokens = given["x"].movedim(2, -1) + model.delay_encoding(given["delay"])[:, :, None, None]
    check_close(tokens, expected["after_rte"])
    for number, block in enumerate(model.blocks):
        if number == 0:
            check_close(
                block.agents.layer(block.agents.norm(tokens), mask, infra), expected["hmsa0"]
            )
        tokens = block(tokens, mask, infra)
        layer = expected[f"after_layer{number}"]
        check_close(tokens, layer, 2e-3 if layer.dtype == torch.float16 else 1e-4)
    check_close(model(given["x"], mask, infra, given["delay"]), expected["y"])


def v2xvit_state(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    table = [
        (r"^rte\.emb\.lin\.", "delay_encoding.linear."),
        (r"^layers\.(\d)\.0\.layers\.0\.0\.", r"blocks.\1.agents."),
        (r"^layers\.(\d)\.0\.layers\.0\.1\.", r"blocks.\1.windows."),
        (r"^layers\.(\d)\.1\.", r"blocks.\1.feed_forward."),
        (r"\.fn\.", ".layer."),
        (r"\.pwmsa\.", ".branches."),
        (r"\.split_attn\.fc1\.", ".split_attention.weigh.0."),
        (r"\.split_attn\.bn1\.", ".split_attention.weigh.1."),
        (r"\.split_attn\.fc2\.", ".split_attention.weigh.3."),
        *(
            (rf"\.{old}_linears\.", f".{new}.")
            for old, new in zip("qkva", ("query", "key", "value", "out"), strict=True)
        ),
    ]
    ours, by_kind = {}, re.compile(r"(.*\.(?:query|key|value|out))\.([01])\.(weight|bias)")
    for key, value in renamed(state, table).items():
        found = by_kind.fullmatch(key)
        if not found or "branches" in key:
            ours[key] = value
        elif found[2] == "0":
            ours[f"{found[1]}.{found[3]}"] = value
        else:
            name = f"{found[1]}.{found[3]}"
            ours[name] = torch.stack([ours[name], value])
    return ours


def renamed(
    state: dict[str, torch.Tensor], table: list[tuple[str, str]]
) -> dict[str, torch.Tensor]:
    for pattern, replacement in table:
        state = {re.sub(pattern, replacement, key): value for key, value in state.items()}
    return state


def vehicles_without_delay(mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    shape = mask.shape[:2]
    return torch.zeros(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.long)


RELEASED = {"posterior_ignore": "keep", "hidden_warp": "none", "detach": True}
PAST = 2
BATCH = (
    "motion_segmentation",
    "motion_instance",
    "instance_centerness",
    "instance_offset",
    "instance_flow",
    "future_egomotion",
    "img_is_valid",
)


def test_the_crop_is_the_released_one(golden_model) -> None:
    golden = golden_model("crop")
    source, target = (
        BevGrid(golden.config[name]["xbound"], golden.config[name]["ybound"])
        for name in ("grid", "motion")
    )
    check_close(crop(golden.inputs()["x"], source, target), golden.outputs()["y"], 1e-5)


def test_the_encoder_is_the_released_one(golden_model) -> None:
    golden = golden_model("bev_encoder")
    inputs = golden.config["numC_input"]
    widths = (2 * inputs, 4 * inputs, 8 * inputs)
    encoder = BevEncode(
        BevEncodeConfig(
            in_channels=inputs, out_channels=golden.config["numC_output"], widths=widths
        )
    )
    encoder.load_state_dict(golden.state("taskfeat_encoders.motion."))
    check_close(encoder.eval()(golden.inputs()["x"]), golden.outputs()["y"])


def test_future_states_are_the_released_ones(golden_model) -> None:
    golden = golden_model("future_prediction")
    given, expected = golden.inputs(), golden.outputs()
    sizes = (golden.config[name] for name in ("in_channels", "latent_dim", "n_future"))
    future = FlowGru(*sizes, hidden_warp="none", detach=True)
    future.load_state_dict(golden.state("future_prediction."))
    check_close(future.eval()(given["z"], given["state"]), expected["eval"])
    check_close(future.train()(given["z"], given["state"]), expected["train"])
    check_close(warp_with_flow(given["state"], given["flow"]), expected["warp_with_flow"])


def test_the_distribution_is_the_released_one(golden_model) -> None:
    golden = golden_model("future_prediction")
    inputs, latent, limits = (
        golden.config[name] for name in ("in_channels", "latent_dim", "log_sigma")
    )
    distribution = SpatialDistribution(inputs, inputs // 2, latent, tuple(limits))
    distribution.load_state_dict(golden.state("present_distribution."))
    found = distribution.eval()(golden.inputs()["dist_x"][:, 0])
    check_close(found.mu, golden.outputs()["mu"])
    check_close(found.log_sigma, golden.outputs()["log_sigma"])


def test_training_outputs_are_the_released_ones(golden_model) -> None:
    golden = golden_model("motion_head")
    outputs = head_of(golden).train()(
        golden.inputs()["x"], warped_targets(golden), noise=golden.inputs()["noise"]
    )
    expected = golden.outputs()
    for name, maps in outputs.maps._asdict().items():
        check_close(maps, expected[f"train.{name}"])
    for name in ("present", "future"):
        for part, values in getattr(outputs, name)._asdict().items():
            check_close(values, expected[f"train.{name}_{part}"])


def test_losses_and_gradients_of_the_head_are_the_released_ones(golden_model) -> None:
    golden = golden_model("motion_head")
    head, features, targets = (
        head_of(golden),
        golden.inputs()["x"].requires_grad_(),
        warped_targets(golden),
    )
    losses = motion_losses(
        head.train()(features, targets, noise=golden.inputs()["noise"]), targets, MotionLossConfig()
    )
    expected = golden.outputs()
    for name, loss in losses.items():
        check_close(loss, expected[f"loss.loss_{name}"])
    sum(losses.values()).backward()
    check_gradient(features, expected["grad_x"])
    for name, gradient in expected.items():
        if name.startswith("grad."):
            check_gradient(head.get_parameter(name.removeprefix("grad.")), gradient)


def test_predictions_are_the_released_ones(golden_model) -> None:
    """Draws 1 to 4 are stored in float16."""
    golden = golden_model("motion_head")
    with torch.no_grad():
        maps = (
            head_of(golden).eval()(golden.inputs()["x"], noise=golden.inputs()["eval_noise"]).maps
        )
    for name, values in golden.outputs().items():
        if name.startswith("eval."):
            _, draw, part = name.split(".")
            check_close(
                getattr(maps, part)[int(draw)],
                values,
                1e-4 if values.dtype == torch.float32 else 2e-3,
            )


def test_the_devkit_warps_labels_as_the_released_head(golden_model) -> None:
    """In the frames that are in the recording: the set's missing ones are all 0, where the loader's
    vectors are 255.
    """
    golden = golden_model("motion_head")
    expected = warped_targets(golden)
    for sample in range(len(expected.segmentation)):
        labels = released_labels(golden, sample).to_present("nearest")
        here = labels.label_valid
        for name in ("segmentation", "centerness", "offset", "flow"):
            found, warped = (
                getattr(labels, name)[here],
                getattr(expected, name)[sample].numpy()[here],
            )
            np.testing.assert_array_equal(found, warped, err_msg=name)


@pytest.mark.parametrize(
    ("name", "target", "loss", "config"),
    [
        ("seg_topk", "segmentation", segmentation_loss, {}),
        ("seg_topk_with_ignored", "ignored", segmentation_loss, {}),
        ("seg_all_pixels", "segmentation", segmentation_loss, {"top_k": 1.0}),
        ("centre_focal", "centerness", center_loss, {}),
        ("offset_l1", "offset", vector_loss, {}),
        ("flow_l1", "flow", vector_loss, {}),
    ],
)
def test_each_loss_is_the_released_one(golden_model, name, target, loss, config) -> None:
    golden = golden_model("motion_losses")
    given, expected = golden.inputs(), golden.outputs()
    label = {
        "segmentation": given["label.motion_segmentation"],
        "ignored": given["target_with_ignored"][:, :, 0],
        "centerness": given["label.instance_centerness"],
        "offset": given["label.instance_offset"],
        "flow": given["label.instance_flow"],
    }[target]
    head = {
        "ignored": "segmentation",
        "segmentation": "segmentation",
        "centerness": "instance_center",
    }
    predicted = given[f"pred.{head.get(target, f'instance_{target}')}"].requires_grad_()
    found = loss(predicted, label, given["frame_mask"], MotionLossConfig(**config))
    check_close(found, expected[name])
    found.backward()
    check_gradient(predicted, expected[f"grad.{name}"])


@pytest.mark.parametrize(("name", "first"), [("kl", None), ("kl_first_only", 1), ("kl_none", 0)])
def test_the_divergence_is_the_released_one(golden_model, name, first) -> None:
    golden = golden_model("motion_losses")
    given = golden.inputs()
    present, future = (
        LatentDistribution(given[f"{when}_mu"], given[f"{when}_log_sigma"])
        for when in ("present", "future")
    )
    mask = torch.zeros(len(present.mu), dtype=torch.bool)
    mask[:first] = True
    check_close(latent_loss(present, future, mask), golden.outputs()[name])


def test_nothing_to_learn_from_gives_no_loss(golden_model) -> None:
    golden = golden_model("motion_losses")
    given, expected = golden.inputs(), golden.outputs()
    nothing = torch.zeros_like(given["frame_mask"])
    config = MotionLossConfig()
    check_close(
        segmentation_loss(
            given["pred.segmentation"], given["label.motion_segmentation"], nothing, config
        ),
        expected["seg_no_frame"],
    )
    check_close(
        vector_loss(given["pred.instance_offset"], given["label.instance_offset"], nothing, config),
        expected["offset_no_frame"],
    )


def test_from_fused_features_on_it_predicts_as_the_released_model(golden_model) -> None:
    """Crop, encoder and head in a row, on the agents' features."""
    golden = golden_model("end_to_end")
    heads, given = golden.config["pts_bbox_head"], golden.inputs()
    source, target = (
        BevGrid(grid["xbound"], grid["ybound"])
        for grid in (heads["grid_conf"], heads["motion_grid_conf"])
    )
    small = config(golden)
    encoder = BevEncode(small.bev)
    encoder.load_state_dict(floats(golden.state("pts_bbox_head.taskfeat_encoders.motion.")))
    head = MotionHead(replace(small.motion, samples=1, **RELEASED))
    head.load_state_dict(floats(golden.state("pts_bbox_head.task_decoders.motion.")))
    with torch.no_grad():
        features = encoder.eval()(crop(golden.outputs()["fused"].float(), source, target))
        maps = head.eval()(features, noise=given["motion_noise_eval_first"][None]).maps
    for draw, stored in ((0, 0), (1, 5)):
        for name, found in maps._asdict().items():
            check_close(found[draw], golden.outputs()[f"motion.{stored}.{name}"], 1e-3)


def floats(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights stored in half precision, as they are used."""
    return {
        name: values.float() if values.is_floating_point() else values
        for name, values in state.items()
    }


def head_of(golden: GoldenModel) -> MotionHead:
    sizes = {
        "in_channels": golden.config["in_channels"],
        "latent": golden.config["prob_latent_dim"],
    }
    head = MotionHead(MotionHeadConfig(**sizes, **RELEASED))
    head.load_state_dict(golden.state("task_decoders.motion."))
    return head


def warped_targets(golden: GoldenModel) -> MotionTargets:
    """The labels as the released head warped them."""
    given, expected = golden.inputs(), golden.outputs()
    valid = given["img_is_valid"]
    return MotionTargets(
        segmentation=expected["label.segmentation"][:, :, 0],
        centerness=expected["label.centerness"],
        offset=expected["label.offset"],
        flow=expected["label.flow"],
        frame_mask=frame_mask(valid[:, PAST:], valid[:, :PAST]),
    )


def released_labels(golden: GoldenModel, sample: int) -> MotionLabels:
    """One sample's labels, each frame in its own frame, as the released loader gives them."""
    given = {
        name: values[sample].numpy() for name, values in golden.inputs().items() if name in BATCH
    }
    bounds = golden.config["grid_conf"]
    config = MotionLabelConfig(
        grid=BevGrid(bounds["xbound"], bounds["ybound"]),
        orientation="released",
        augmentation=augmentation_of(golden.inputs()["aug_transform"][sample].numpy()),
    )
    return MotionLabels.from_batch(
        given | {"future_egomotions": given["future_egomotion"]}, config, "deepaccident"
    )


def augmentation_of(matrix: np.ndarray) -> Augmentation:
    """What makes the left-handed matrix that the released code drew."""
    given = flip_pose(matrix)
    scale, flip = given[2, 2], bool(np.linalg.det(given[:2, :2]) < 0)
    turn = np.diag([1, -1 if flip else 1]) @ given[:2, :2] / scale
    return Augmentation(rotation=np.arctan2(turn[1, 0], turn[0, 0]), scale=scale, flip=flip)


def check_gradient(of: torch.Tensor, golden: torch.Tensor) -> None:
    torch.testing.assert_close(of.grad, golden, rtol=1e-2, atol=1e-3 * float(golden.abs().max()))


TASKS = range(len(RELEASED_CLASS_SLOTS))


@pytest.fixture
def det(golden_model: Callable[[str], GoldenModel]) -> GoldenModel:
    return golden_model("det")


@pytest.fixture
def head(det: GoldenModel) -> CenterHead:
    head = CenterHead(head_config(det))
    head.load_state_dict(det.state("task_decoders.3dod."), strict=True)
    return head


def head_config(det: GoldenModel) -> DetectionConfig:
    """Of square maps: the golden's config says where they begin and how large a cell is."""
    coder, cells = det.config["bbox_coder"], det.inputs()["x"].shape[-1]
    low, size = coder["pc_range"][0], coder["voxel_size"][0] * coder["out_size_factor"]
    along = (low, low + cells * size, size)
    return DetectionConfig(
        in_channels=det.config["in_channels"],
        shared_channels=det.config["share_conv_channel"],
        class_slots=RELEASED_CLASS_SLOTS,
        x=along,
        y=along,
    )


def golden_maps(det: GoldenModel) -> list[TaskMaps]:
    outputs = det.outputs()
    return [
        TaskMaps(*(outputs[f"pred.{task}.{name}"] for name in TaskMaps._fields)) for task in TASKS
    ]


def our_targets(det: GoldenModel) -> list[TaskTargets]:
    boxes = det.inputs()["boxes"].clone()
    boxes[..., 2] += boxes[..., 5] / 2  # the release's z is that of the lower face
    config = TargetConfig(max_boxes=det.config["train"]["max_objs"], unknown_velocity="zero")
    return detection_targets(list(boxes), list(det.inputs()["labels"]), head_config(det), config)


def test_maps_of_the_released_head(det: GoldenModel, head: CenterHead) -> None:
    maps = head.eval()(det.inputs()["x"])
    for ours, golden in zip(maps, golden_maps(det), strict=True):
        for found, expected in zip(ours, golden, strict=True):
            check_close(found, expected)


def test_peak_radii_of_the_released_formula(det: GoldenModel) -> None:
    sizes = det.inputs()["radius_sizes_in_cells"]
    check_close(peak_radius(sizes[:, 0], sizes[:, 1], 0.1), det.outputs()["radius"])


@pytest.mark.parametrize("task", TASKS)
def test_targets_of_the_released_head(det: GoldenModel, task: int) -> None:
    outputs, ours = det.outputs(), our_targets(det)[task]
    assert torch.equal(ours.mask, outputs[f"target.{task}.mask"].bool())
    assert torch.equal(ours.cell_index, outputs[f"target.{task}.index"])
    check_close(ours.heatmap, outputs[f"target.{task}.heatmap"])
    check_close(ours.box, outputs[f"target.{task}.box"])


def test_losses_and_gradient_of_the_released_head(det: GoldenModel, head: CenterHead) -> None:
    x = det.inputs()["x"].requires_grad_()
    maps = head.train()(x)
    losses = detection_losses(maps, our_targets(det), DetectionLossConfig(weight=1.0))
    golden = {
        key.removeprefix("loss."): value
        for key, value in det.outputs().items()
        if key.startswith("loss.")
    }
    assert losses.keys() == golden.keys()
    for name, value in losses.items():
        check_close(value, golden[name])
    torch.stack(list(losses.values())).sum().backward()
    gradient = det.outputs()["grad_x"]
    torch.testing.assert_close(x.grad, gradient, rtol=1e-3, atol=1e-4 * float(gradient.abs().max()))


@pytest.mark.parametrize("task", TASKS)
def test_decoded_boxes_of_the_released_coder(det: GoldenModel, task: int) -> None:
    coder = det.config["bbox_coder"]
    config = DecodingConfig(
        candidates=coder["max_num"], center_range=tuple(coder["post_center_range"])
    )
    found, outputs = (
        decode_candidates(golden_maps(det)[task], head_config(det), config),
        det.outputs(),
    )
    for sample in range(len(det.inputs()["boxes"])):
        golden = {
            name: outputs[f"decode.{task}.{sample}.{name}"]
            for name in ("boxes", "scores", "labels")
        }
        valid = found.valid[sample]
        check_close(found.scores[sample, valid], golden["scores"])
        check_close(found.boxes[sample, valid], golden["boxes"])
        assert torch.equal(found.slots[sample, valid], golden["labels"].long())


def test_circle_suppression_of_the_released_code(det: GoldenModel) -> None:
    outputs = det.outputs()
    suppressed = {name: kept for name, kept in outputs.items() if name.startswith("circle_nms.")}
    assert suppressed
    for name, kept in suppressed.items():
        _, task, sample = name.split(".")
        found = (
            outputs[f"decode.{task}.{sample}.{each}"].numpy()
            for each in ("boxes", "scores", "labels")
        )
        boxes, scores, labels = found
        ours = suppress(boxes, scores, labels.astype(np.int64), RELEASED_NMS[int(task)])
        np.testing.assert_array_equal(ours, kept.numpy())


def config(golden: GoldenModel) -> ModelConfig:
    """The released preset in the small sizes of the golden model."""
    whole, small = released(), golden.config
    swin, lift, heads = small["img_backbone"], small["transformer"], small["pts_bbox_head"]
    motion, detection = heads["cfg_motion"], heads["cfg_3dod"]
    grid, cells = lift["grid_conf"], motion["grid_conf"]
    along = {name: tuple(grid[f"{name}bound"]) for name in "xy"}
    own = {name: tuple(cells[f"{name}bound"]) for name in "xy"}
    return replace(
        whole,
        cameras=replace(
            whole.cameras,
            encoder=SwinConfig(
                embed_dims=swin["embed_dims"],
                depths=tuple(swin["depths"]),
                num_heads=tuple(swin["num_heads"]),
                checkpointing=False,
                neck_channels=small["img_neck"]["out_channels"],
            ),
            lift=replace(
                whole.cameras.lift,
                in_channels=lift["numC_input"],
                depth=tuple(grid["dbound"]),
                image_size=tuple(lift["input_dim"]),
                **along,
            ),
        ),
        temporal=replace(whole.temporal, grid=BevGrid(**along)),
        bev=BevEncodeConfig(
            in_channels=heads["in_channels"],
            out_channels=heads["out_channels"],
            widths=tuple(heads["num_channels"]),
        ),
        motion=replace(
            whole.motion, in_channels=motion["in_channels"], latent=motion["prob_latent_dim"]
        ),
        detection=replace(
            whole.detection,
            in_channels=detection["in_channels"],
            shared_channels=detection["share_conv_channel"],
            **along,
        ),
        targets=TargetConfig(
            unknown_velocity="zero", max_boxes=small["train_cfg"]["pts"]["max_objs"]
        ),
        decoding=DecodingConfig(),
        labels=replace(whole.labels, grid=BevGrid(**own, orientation="released")),
    )


def inputs_of(given: dict[str, Any]) -> ModelInputs:
    """The golden inputs, agent by agent, as ours."""
    agents = given["relative_pose"].shape[1]

    def joined(name: str) -> torch.Tensor:
        return torch.cat([given[f"agent{agent}.{name}"] for agent in range(agents)])[None]

    return ModelInputs(
        images=joined("images").float(),
        cameras=CameraGeometry(
            rotation=joined("rots"),
            translation=joined("trans"),
            intrinsics=prepared(joined("intrins"), joined("post_rots"), joined("post_trans")),
        ),
        egomotion=joined("egomotion")[:, :, : PAST + 1],
        frame_valid=joined("img_is_valid")[:, :, : PAST + 1],
        bev_transform=torch.eye(4)[None],
        ego_rows=torch.tensor([[0, 0]]),
        ego_from_agent=matrices_from_six(given["relative_pose"]),
        partners=torch.ones(1, agents, dtype=torch.bool),
        is_infrastructure=torch.zeros(1, agents, dtype=torch.bool),
        delay=torch.zeros(1, agents, dtype=torch.int64),
    )


def model_of(golden: Any) -> V2XFormer:
    model = V2XFormer(config(golden))
    done = load_weights(
        model, Weights(tensors=golden.state(), meta={}, path=Path("end_to_end.npz")), whole=True
    )
    assert not done.unchanged
    assert not done.unused
    return model


def test_each_part_of_a_prediction_is_the_released_one(golden_model) -> None:
    golden = golden_model("end_to_end")
    given, expected, model = golden.inputs(), golden.outputs(), model_of(golden).eval()
    inputs = inputs_of(given)
    with torch.no_grad():
        neck = model.img_neck(model.img_backbone(inputs.images.flatten(0, 3)))
        lifted = model.transformer(
            neck.unflatten(0, inputs.images.shape[1:4]), inputs.cameras.flattened()
        )
        maps = model.encoded(inputs)
        fused = model.fused(maps, inputs)
        # of the five draws only the first one's noise is stored; the last prediction is the mean's
        noise = torch.zeros(5, *given["motion_noise_eval_first"].shape)
        noise[0] = given["motion_noise_eval_first"]
        predicted = model(inputs, noise=noise)
    # the release puts all frames of an agent, then the next agent's, in the same order as ours
    check_close(neck, expected["neck"])
    check_close(lifted, expected["lss"], 2e-3)
    check_close(maps[0], expected["temporal"])
    check_close(fused, expected["fused"])
    for task, found in enumerate(predicted.detection):
        for name, values in found._asdict().items():
            check_close(values, expected[f"det.{task}.{name}"])
    for name, values in expected.items():
        if name.startswith("motion."):
            _, draw, part = name.split(".")
            check_close(getattr(predicted.motion.maps, part)[int(draw)], values, 1e-3)


def test_losses_and_gradients_of_a_step_are_the_released_ones(golden_model) -> None:
    golden = golden_model("end_to_end")
    given, expected, model = golden.inputs(), golden.outputs(), model_of(golden).train()
    names = (
        "motion_segmentation",
        "motion_instance",
        "instance_centerness",
        "instance_offset",
        "instance_flow",
    )
    batch = {name: given[name][0].numpy() for name in names}
    batch |= {"future_egomotions": given["agent0.egomotion"][0].numpy()}
    batch |= {"img_is_valid": given["agent0.img_is_valid"][0].numpy()}
    labels = MotionLabels.from_batch(batch, config(golden).labels, "deepaccident").to_present(
        "nearest"
    )
    maps = [
        torch.tensor(getattr(labels, name))[None]
        for name in ("segmentation", "centerness", "offset", "flow")
    ]
    valid = torch.tensor(labels.valid)[None]
    motion = MotionTargets(maps[0].long(), *maps[1:], frame_mask(valid[:, PAST:], valid[:, :PAST]))
    boxes = given["boxes"].clone()
    boxes[:, 2] += boxes[:, 5] / 2  # from the bottom to the centre
    targets = Targets(
        motion=motion,
        boxes=[boxes],
        categories=[given["labels"]],
        velocity_known=[torch.ones(len(boxes), dtype=torch.bool)],
    )
    losses = TrainingStep(model)(inputs_of(given), targets, noise=given["motion_noise_train"])
    for name, loss in losses.items():
        ours = f"train.{name}" if name.startswith("task") else f"train.loss_{name}"
        check_close(loss, expected[ours], 1e-3)
    total = torch.stack(list(losses.values())).sum()
    check_close(total, expected["train.total"], 1e-3)
    total.backward()
    for name, gradient in expected.items():
        if name.startswith("grad."):
            found = model.get_parameter(name.removeprefix("grad.")).grad
            assert float((found - gradient).abs().max()) <= 1e-2 * float(gradient.abs().max())


@pytest.mark.parametrize(
    ("name", "unused"),
    [("DeepAccident_tiny", None), ("DeepAccident_tiny_v2x", Agent3DConfig(channels=64))],
)
def test_names_and_shapes_are_those_of_the_released_configs(
    request: pytest.FixtureRequest, name: str, unused: Agent3DConfig | None
) -> None:
    """Of the whole state dict; the V2X config also has the layers that no forward pass of the
    release reaches.
    """
    path = request.config.getoption("golden") / "model" / f"released_keys_{name}.txt"
    with torch.device("meta"):
        whole = released()
        model = V2XFormer(replace(whole, fusion=replace(whole.fusion, agent3d=unused)))
    state = model.state_dict()
    found = [
        f"{key} {tuple(each.shape)} {str(each.dtype).removeprefix('torch.')}"
        for key, each in state.items()
    ]
    assert sorted(found) == sorted(path.read_text(encoding="utf-8").splitlines())
