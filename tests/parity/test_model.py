"""The model against the released classes, and the fusion modules against their originals.

The golden set (tests/data/golden/model, see its README) comes from running the original classes on
a CPU with torch 2.13 and random weights: DeepAccident @ 728e366, CoBEVT, V2X-ViT. Unless a test
states otherwise, everything is equal within 1e-4 of the largest value; indices, masks, converted
weights and warped labels are exact. Rotated suppression of boxes has no golden numbers, since the
released one needs CUDA.
"""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from parity.test_warps import make_augmentation
from support.golden_model import GoldenModel, assert_close

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabelConfig, MotionLabels
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
    """Return the golden set, and the backbone and the neck with its weights."""
    golden = golden_model("swin_neck")
    swin = golden.config["swin"]
    config = SwinConfig(
        embed_dims=swin["embed_dims"],
        depths=tuple(swin["depths"]),
        num_heads=tuple(swin["num_heads"]),
        window_size=swin["window_size"],
        out_stages=tuple(swin["out_indices"]),
        neck_channels=golden.config["neck"]["out_channels"],
    )
    modules = image_encoder(config)
    for module, prefix in zip(modules, ("img_backbone.", "img_neck."), strict=True):
        module.load_state_dict(golden.state(prefix))
        module.eval()
    return golden, *modules


def test_swin_and_its_neck_equal_the_released_ones(swin_neck):
    golden, backbone, neck = swin_neck
    images = golden.inputs()["images"]
    out = golden.outputs()

    with torch.no_grad():
        stage3, stage4 = backbone(images)
        features = neck((stage3, stage4))

    assert_close(stage3, out["stage3"])
    assert_close(stage4, out["stage4"])
    assert_close(features, out["neck"])


def test_the_index_of_relative_positions_is_the_released_one(swin_neck):
    golden, backbone, _ = swin_neck
    state = Swin(backbone.config).state_dict()
    indices = {
        name: tensor
        for name, tensor in golden.state("img_backbone.").items()
        if name.endswith("_index")
    }
    assert len(indices) == sum(backbone.config.depths)
    for name, index in indices.items():
        assert torch.equal(state[name], index)


def test_official_swin_weights_convert_as_in_the_release(golden_model):
    golden = golden_model("swin_convert")
    converted = from_official(golden.inputs())
    expected = golden.outputs()
    assert list(converted) == list(expected)
    for name, tensor in expected.items():
        assert torch.equal(converted[name], tensor), name


@pytest.fixture
def lss(golden_model):
    """Return the golden set, and a lift with its weights and its cameras."""
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
    inputs = golden.inputs()
    cameras = CameraGeometry(
        rotation=inputs["rots"],
        translation=inputs["trans"],
        intrinsics=adapt_intrinsics(inputs["intrins"], inputs["post_rots"], inputs["post_trans"]),
    )
    lift = LiftSplat(config).eval()
    assert torch.equal(lift.frustum, golden.state("transformer.")["frustum"])
    lift.load_state_dict(golden.state("transformer."))
    return golden, lift, cameras


def adapt_intrinsics(
    intrinsics: torch.Tensor, linear: torch.Tensor, shift: torch.Tensor
) -> torch.Tensor:
    """Apply the scaling, cropping and turning of images to the intrinsics of their files.

    The release keeps the two apart.
    """
    affine = linear.clone()
    affine[..., :2, 2] = shift[..., :2]
    return affine @ intrinsics


def test_the_lift_equals_the_released_one(lss):
    golden, lift, cameras = lss
    out = golden.outputs()
    assert_close(lift.points(cameras).flatten(0, 1), out["geometry"])
    with torch.no_grad():
        bev = lift(golden.inputs()["x"], cameras)
    assert_close(bev, out["bev"])
    assert_close(bev, out["bev_cumsum"])


def test_truncation_folds_the_points_that_the_released_one_folds(lss):
    golden, lift, cameras = lss
    folded = golden.outputs()["folded_points"]
    flooring_lift = LiftSplat(replace(lift.config, voxel_rounding="floor"))
    flooring_lift.load_state_dict(lift.state_dict())

    truncated_cells = lift.cells(cameras).flatten(0, 1)
    floored_cells = flooring_lift.cells(cameras).flatten(0, 1)

    assert torch.equal(truncated_cells != floored_cells, folded)
    assert (floored_cells[folded] == -1).all()


Golden = Callable[[str], GoldenModel]


def read_golden(golden_model: Golden, name: str) -> tuple[GoldenModel, dict, dict]:
    """Return a golden part, its inputs and its outputs."""
    golden = golden_model(name)
    return golden, golden.inputs(), golden.outputs()


MAX_TIED_SHARE = 0.005
"""The share of cells that may differ after a nearest warp, where points lie between two cells."""


def make_grid(golden: GoldenModel, name: str = "grid") -> BevGrid:
    grid = golden.config[name]
    return BevGrid(x=tuple(grid["xbound"]), y=tuple(grid["ybound"]))


def assert_same_samples(ours: torch.Tensor, golden: torch.Tensor, mode: str) -> None:
    if mode == "bilinear":
        assert_close(ours, golden)
    else:
        assert ours.shape == golden.shape
        differs = (ours - golden).abs() > 1e-6
        assert float(differs.float().mean()) <= MAX_TIED_SHARE


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("augmented", [False, True])
def test_chains_of_warps_equal_the_released_warper(
    golden_model: Golden, augmented: bool, mode: WarpMode
) -> None:
    """Compare with FeatureWarper's cumulative warp; nearest warps may differ in 0.5 % of cells."""
    golden = golden_model("warps")
    inputs = golden.inputs()
    suffix = "_aug" if augmented else ""
    expected = golden.outputs()[f"temporal{suffix}_{mode}"]
    matrix = inputs["aug"] if augmented else None
    features = inputs["x"].clone()
    past_features = features[:, :2].flatten(0, 1)

    chain = warps.present_from_past_batch(
        inputs["egomotion"][:, :2], chain="released", bev_transform=matrix
    )
    warped = warps.warp_features(
        past_features, chain.flatten(0, 1), make_grid(golden), warp="stretched", mode=mode
    )

    features[:, :2] = warped.unflatten(0, chain.shape[:2])
    assert_same_samples(features, expected, mode)


def test_partners_are_placed_as_by_the_released_warper(golden_model: Golden) -> None:
    """Compare the poses' matrices within 1e-6, and plain and augmented maps.

    Augmented maps have the released transform between two agents and the correct one.
    """
    golden, inputs, expected = read_golden(golden_model, "warps")
    ego_from_agent = warps.matrices_from_six(inputs["relative_pose"])
    assert_close(ego_from_agent, expected["pose_mats"], 1e-6)

    own = inputs["aug_v"]
    transforms = {
        "v2x": ego_from_agent,
        "v2x_aug_released": warps.between_augmented(ego_from_agent, own, own),
        "v2x_aug_right": warps.between_augmented(ego_from_agent, own[:, :1], own),
    }
    for name, transform in transforms.items():
        features = warps.features_to_ego(
            inputs["xv"], transform, make_grid(golden), warp="stretched"
        )
        assert_close(features, expected[name])


@pytest.mark.parametrize(
    ("name", "pose"), [("identity_full", [0.0] * 6), ("move_full", [7.3, -3.1, 0, 0, 0, 0.6])]
)
def test_a_full_map_is_warped_as_by_the_released_warper(
    golden_model: Golden, name: str, pose: list[float]
) -> None:
    """Warp a map of 128 × 128 cells of 0.8 m."""
    golden = golden_model("warps")
    grid = make_grid(golden, "full")
    features = golden.inputs()["xf"][:, 0]
    target_from_source = warps.matrices_from_six(torch.tensor([pose]))

    warped = warps.warp_features(features[:, None], target_from_source, grid, warp="stretched")

    assert_close(warped, golden.outputs()[name])


@pytest.mark.parametrize("case", ["eval", "eval_aug", "train_aug"])
def test_temporal_model_equals_the_released_one(golden_model: Golden, case: str) -> None:
    """Compare with Temporal3DConvModel, also for samples without their oldest frames."""
    golden = golden_model("temporal")
    inputs = golden.inputs()
    num_frames = golden.config["receptive_field"]
    egomotion = inputs["egomotion"][:, :num_frames]
    valid = inputs["img_is_valid"][:, :num_frames]
    config = TemporalConfig(
        channels=golden.config["in_channels"],
        grid=make_grid(golden, "grid_conf"),
        warp="stretched",
        chain="released",
        egomotion_input="raw",
    )
    model = temporal_model(config)
    model.load_state_dict(golden.state("temporal_model."))
    model.train(case.startswith("train"))
    matrix = inputs["aug"] if case.endswith("aug") else None

    assert_close(model(inputs["x"], egomotion, valid, matrix), golden.outputs()[case])


def test_released_fusion_equals_the_released_one(golden_model: Golden) -> None:
    """Compare with V2X_fusion and its warp, gradients within 1e-3."""
    golden, inputs, expected = read_golden(golden_model, "fusion_released")
    x = inputs["x"].requires_grad_()
    ego_from_agent = warps.matrices_from_six(inputs["relative_pose"])
    warped = warps.features_to_ego(x, ego_from_agent, make_grid(golden), warp="stretched")
    assert_close(warped, expected["warped"])

    config = ReleasedFusionConfig(
        channels=x.shape[2],
        ego_channels=tuple(golden.config["ego_channels"]),
        fill_below=golden.config["fill_threshold"],
    )
    assert config == ReleasedFusionConfig(channels=x.shape[2])
    everywhere = torch.ones_like(x[:, :, 0], dtype=torch.bool)
    fused = fusion(config)(warped, everywhere, *vehicles_without_delay(everywhere))
    assert_close(fused, expected["fused"])

    (fused * inputs["loss_weight"]).sum().backward()
    assert_close(x.grad, expected["grad_x"], 1e-3)


def test_the_released_fusion_s_unreached_layers_equal_its_own(golden_model: Golden) -> None:
    """Call the layers after the early return in the order of the unreached lines."""
    golden = golden_model("fusion_agent3d_dead")
    features = golden.inputs()["warped"]
    poses = golden.inputs()["relative_pose"]
    expected = golden.outputs()
    config = Agent3DConfig(
        channels=golden.config["in_channels"], agents=golden.config["num_agents"]
    )
    model = Agent3D(config).eval()
    model.load_state_dict(golden.state("v2x_fusion."))
    assert_close(model.over_agents(features, poses), expected["after_model"])
    assert_close(model(features, poses), expected["compressed"])


def test_disconet_equals_the_original(golden_model: Golden) -> None:
    """Compare with PixelWeightedFusionSoftmax and Linear of CoBEVT's code."""
    golden, inputs, expected = read_golden(golden_model, "ref_disconet")
    features = inputs["x"]
    mask = inputs["mask"]
    config = DiscoNetConfig(
        channels=golden.config["channels"], last_relu=golden.config["final_relu"]
    )
    model = fusion(config).eval()
    output_state = rename_keys(golden.state("mlp."), [(r"^", "out.")])
    model.load_state_dict(disconet_scores(golden) | output_state)
    assert_close(model.weights(features, mask), expected["weights"][:, :, 0])
    assert_close(model(features, mask, *vehicles_without_delay(mask)), expected["y"])


def disconet_scores(golden: GoldenModel) -> dict[str, torch.Tensor]:
    """Return the weights of the score layers under our names."""
    scores = {}
    for key, value in golden.state("pixel_weighted_fusion.").items():
        layer, number, name = re.fullmatch(r"(conv|bn)1_(\d)\.(.*)", key).groups()
        index = 3 * (int(number) - 1) + (layer == "bn")
        scores[f"score.{index}.{name}"] = value.flatten(1) if value.ndim == 4 else value
    return scores


def test_cobevt_equals_the_original(golden_model: Golden) -> None:
    """Compare with SwapFusionEncoder: only the first layer, then the whole."""
    golden, inputs, expected = read_golden(golden_model, "ref_cobevt")
    features = inputs["x"]
    mask = inputs["mask"]
    sizes = golden.config
    config = CobevtConfig(
        channels=sizes["input_dim"],
        depth=sizes["depth"],
        window=sizes["window_size"],
        heads=sizes["input_dim"] // sizes["dim_head"],
        agents=sizes["agent_size"],
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
    model.load_state_dict(rename_keys(state, table))

    first_output = model.layers[0](features.movedim(2, -1), mask).movedim(-1, 2)
    assert_close(first_output, expected["after_block0"])
    assert_close(model(features, mask, *vehicles_without_delay(mask)), expected["y"])


def test_v2xvit_equals_the_original(golden_model: Golden) -> None:
    """Compare each stored step of RTE, V2XFusionBlock and FFN; float16 values within 2e-3."""
    golden, inputs, expected = read_golden(golden_model, "ref_v2xvit")
    sizes = golden.config
    config = V2XViTConfig(
        channels=sizes["cav"]["dim"],
        depth=sizes["depth"],
        heads=sizes["cav"]["heads"],
        windows=tuple(sizes["pwindow"]["window_size"]),
        window_heads=tuple(sizes["pwindow"]["heads"]),
        masked_cells="windowed",
    )
    model = fusion(config).eval()
    state = golden.state()
    delays = state.pop("rte.emb.emb.weight")
    assert_close(sinusoid(torch.arange(len(delays)), delays.shape[1]), delays, 1e-6)
    model.load_state_dict(v2xvit_state(state))

    mask = inputs["mask"]
    infra = inputs["types"] == 1
    encoding = model.delay_encoding(inputs["delay"])[:, :, None, None]
    tokens = inputs["x"].movedim(2, -1) + encoding
    assert_close(tokens, expected["after_rte"])
    attention = model.blocks[0].agents
    assert_close(attention.layer(attention.norm(tokens), mask, infra), expected["hmsa0"])
    for number, block in enumerate(model.blocks):
        tokens = block(tokens, mask, infra)
        layer = expected[f"after_layer{number}"]
        assert_close(tokens, layer, tolerance_of(layer))
    assert_close(model(inputs["x"], mask, infra, inputs["delay"]), expected["y"])


def tolerance_of(stored: torch.Tensor) -> float:
    """Return a wider tolerance for values that are stored in float16."""
    return 2e-3 if stored.dtype == torch.float16 else 1e-4


def v2xvit_state(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the weights under our names, both kinds of agents stacked."""
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
        (r"\.q_linears\.", ".query."),
        (r"\.k_linears\.", ".key."),
        (r"\.v_linears\.", ".value."),
        (r"\.a_linears\.", ".out."),
    ]
    name_of_kind = re.compile(r"(.*\.(?:query|key|value|out))\.([01])\.(weight|bias)")
    ours = {}
    for key, value in rename_keys(state, table).items():
        match = name_of_kind.fullmatch(key)
        if not match or "branches" in key:
            ours[key] = value
            continue
        module, kind, parameter = match.groups()
        name = f"{module}.{parameter}"
        ours[name] = value if kind == "0" else torch.stack([ours[name], value])
    return ours


def rename_keys(
    state: dict[str, torch.Tensor], table: list[tuple[str, str]]
) -> dict[str, torch.Tensor]:
    """Replace each pattern of the table in all keys, in the table's order."""
    for pattern, replacement in table:
        state = {re.sub(pattern, replacement, key): value for key, value in state.items()}
    return state


def vehicles_without_delay(mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return which agents are infrastructure, and their delays: none."""
    shape = mask.shape[:2]
    is_infrastructure = torch.zeros(shape, dtype=torch.bool)
    return is_infrastructure, torch.zeros(shape, dtype=torch.long)


RELEASED_MOTION = {"posterior_ignore": "keep", "hidden_warp": "none", "detach": True}
NUM_PAST_FRAMES = 2
MAPS = (
    "motion_segmentation",
    "motion_instance",
    "instance_centerness",
    "instance_offset",
    "instance_flow",
)


def test_the_crop_is_the_released_one(golden_model) -> None:
    golden = golden_model("crop")
    source = make_grid(golden, "grid")
    target = make_grid(golden, "motion")
    assert_close(crop(golden.inputs()["x"], source, target), golden.outputs()["y"], 1e-5)


def test_the_encoder_is_the_released_one(golden_model) -> None:
    golden = golden_model("bev_encoder")
    channels = golden.config["numC_input"]
    widths = (2 * channels, 4 * channels, 8 * channels)
    config = BevEncodeConfig(
        in_channels=channels, out_channels=golden.config["numC_output"], widths=widths
    )
    encoder = BevEncode(config)
    encoder.load_state_dict(golden.state("taskfeat_encoders.motion."))
    assert_close(encoder.eval()(golden.inputs()["x"]), golden.outputs()["y"])


def test_future_states_are_the_released_ones(golden_model) -> None:
    golden, inputs, expected = read_golden(golden_model, "future_prediction")
    sizes = (golden.config[name] for name in ("in_channels", "latent_dim", "n_future"))
    model = FlowGru(*sizes, hidden_warp="none", detach=True)
    model.load_state_dict(golden.state("future_prediction."))
    assert_close(model.eval()(inputs["z"], inputs["state"]), expected["eval"])
    assert_close(model.train()(inputs["z"], inputs["state"]), expected["train"])
    assert_close(warp_with_flow(inputs["state"], inputs["flow"]), expected["warp_with_flow"])


def test_the_distribution_is_the_released_one(golden_model) -> None:
    golden = golden_model("future_prediction")
    channels = golden.config["in_channels"]
    limits = tuple(golden.config["log_sigma"])
    model = SpatialDistribution(channels, channels // 2, golden.config["latent_dim"], limits)
    model.load_state_dict(golden.state("present_distribution."))

    distribution = model.eval()(golden.inputs()["dist_x"][:, 0])

    assert_close(distribution.mu, golden.outputs()["mu"])
    assert_close(distribution.log_sigma, golden.outputs()["log_sigma"])


def test_training_outputs_are_the_released_ones(golden_model) -> None:
    golden, inputs, expected = read_golden(golden_model, "motion_head")
    head = make_motion_head(golden).train()

    outputs = head(inputs["x"], warped_targets(golden), noise=inputs["noise"])

    for name, maps in outputs.maps._asdict().items():
        assert_close(maps, expected[f"train.{name}"])
    for name in ("present", "future"):
        for part, values in getattr(outputs, name)._asdict().items():
            assert_close(values, expected[f"train.{name}_{part}"])


def test_losses_and_gradients_of_the_head_are_the_released_ones(golden_model) -> None:
    golden = golden_model("motion_head")
    expected = golden.outputs()
    features = golden.inputs()["x"].requires_grad_()
    targets = warped_targets(golden)
    head = make_motion_head(golden).train()

    outputs = head(features, targets, noise=golden.inputs()["noise"])
    losses = motion_losses(outputs, targets, MotionLossConfig())
    sum(losses.values()).backward()

    for name, loss in losses.items():
        assert_close(loss, expected[f"loss.loss_{name}"])
    assert_gradient(features, expected["grad_x"])
    for name, gradient in expected.items():
        if name.startswith("grad."):
            assert_gradient(head.get_parameter(name.removeprefix("grad.")), gradient)


def test_predictions_are_the_released_ones(golden_model) -> None:
    """Compare five draws; draws 1 to 4 are stored in float16."""
    golden = golden_model("motion_head")
    inputs = golden.inputs()
    head = make_motion_head(golden).eval()

    with torch.no_grad():
        maps = head(inputs["x"], noise=inputs["eval_noise"]).maps

    for name, expected in golden.outputs().items():
        if name.startswith("eval."):
            _, draw, part = name.split(".")
            assert_close(getattr(maps, part)[int(draw)], expected, tolerance_of(expected))


def test_the_devkit_warps_labels_as_the_released_head(golden_model) -> None:
    """Compare recorded frames only: missing ones are 0 here, but 255 in the loader's vectors."""
    golden = golden_model("motion_head")
    expected = warped_targets(golden)
    for sample in range(len(expected.segmentation)):
        labels = released_labels(golden, sample).to_present("nearest")
        is_recorded = labels.label_valid
        for name in ("segmentation", "centerness", "offset", "flow"):
            values = getattr(labels, name)
            expected_values = getattr(expected, name)[sample].numpy()
            np.testing.assert_array_equal(
                values[is_recorded], expected_values[is_recorded], err_msg=name
            )


@pytest.mark.parametrize(
    ("name", "prediction", "label", "function", "config"),
    [
        ("seg_topk", "segmentation", "motion_segmentation", segmentation_loss, {}),
        ("seg_topk_with_ignored", "segmentation", "with_ignored", segmentation_loss, {}),
        (
            "seg_all_pixels",
            "segmentation",
            "motion_segmentation",
            segmentation_loss,
            {"top_k": 1.0},
        ),
        ("centre_focal", "instance_center", "instance_centerness", center_loss, {}),
        ("offset_l1", "instance_offset", "instance_offset", vector_loss, {}),
        ("flow_l1", "instance_flow", "instance_flow", vector_loss, {}),
    ],
)
def test_each_loss_is_the_released_one(
    golden_model, name, prediction, label, function, config
) -> None:
    _, inputs, expected = read_golden(golden_model, "motion_losses")
    labels = {"label.with_ignored": inputs["target_with_ignored"][:, :, 0], **inputs}
    predicted = inputs[f"pred.{prediction}"].requires_grad_()
    loss_config = MotionLossConfig(**config)

    loss = function(predicted, labels[f"label.{label}"], inputs["frame_mask"], loss_config)
    loss.backward()

    assert_close(loss, expected[name])
    assert_gradient(predicted, expected[f"grad.{name}"])


@pytest.mark.parametrize(("name", "first"), [("kl", None), ("kl_first_only", 1), ("kl_none", 0)])
def test_the_divergence_is_the_released_one(golden_model, name, first) -> None:
    golden = golden_model("motion_losses")
    inputs = golden.inputs()
    present = LatentDistribution(inputs["present_mu"], inputs["present_log_sigma"])
    future = LatentDistribution(inputs["future_mu"], inputs["future_log_sigma"])
    mask = torch.zeros(len(present.mu), dtype=torch.bool)
    mask[:first] = True
    assert_close(latent_loss(present, future, mask), golden.outputs()[name])


def test_nothing_to_learn_from_gives_no_loss(golden_model) -> None:
    _, inputs, expected = read_golden(golden_model, "motion_losses")
    no_frames = torch.zeros_like(inputs["frame_mask"])
    config = MotionLossConfig()

    loss_of_segmentation = segmentation_loss(
        inputs["pred.segmentation"], inputs["label.motion_segmentation"], no_frames, config
    )
    loss_of_offset = vector_loss(
        inputs["pred.instance_offset"], inputs["label.instance_offset"], no_frames, config
    )

    assert_close(loss_of_segmentation, expected["seg_no_frame"])
    assert_close(loss_of_offset, expected["offset_no_frame"])


def test_from_fused_features_on_it_predicts_as_the_released_model(golden_model) -> None:
    """Apply crop, encoder and head one after the other to the agents' features."""
    golden = golden_model("end_to_end")
    expected = golden.outputs()
    heads = golden.config["pts_bbox_head"]
    source = BevGrid(heads["grid_conf"]["xbound"], heads["grid_conf"]["ybound"])
    target = BevGrid(heads["motion_grid_conf"]["xbound"], heads["motion_grid_conf"]["ybound"])
    noise = golden.inputs()["motion_noise_eval_first"][None]
    config = make_config(golden)
    encoder = BevEncode(config.bev).eval()
    encoder.load_state_dict(to_float32(golden.state("pts_bbox_head.taskfeat_encoders.motion.")))
    head = MotionHead(replace(config.motion, samples=1, **RELEASED_MOTION)).eval()
    head.load_state_dict(to_float32(golden.state("pts_bbox_head.task_decoders.motion.")))

    with torch.no_grad():
        features = encoder(crop(expected["fused"].float(), source, target))
        maps = head(features, noise=noise).maps

    for draw, stored_draw in ((0, 0), (1, 5)):
        for name, values in maps._asdict().items():
            assert_close(values[draw], expected[f"motion.{stored_draw}.{name}"], 1e-3)


def to_float32(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Convert weights that are stored in half precision."""
    return {
        name: values.float() if values.is_floating_point() else values
        for name, values in state.items()
    }


def make_motion_head(golden: GoldenModel) -> MotionHead:
    config = MotionHeadConfig(
        in_channels=golden.config["in_channels"],
        latent=golden.config["prob_latent_dim"],
        **RELEASED_MOTION,
    )
    head = MotionHead(config)
    head.load_state_dict(golden.state("task_decoders.motion."))
    return head


def warped_targets(golden: GoldenModel) -> MotionTargets:
    """Return the labels as the released head warped them."""
    expected = golden.outputs()
    valid = golden.inputs()["img_is_valid"]
    return MotionTargets(
        segmentation=expected["label.segmentation"][:, :, 0],
        centerness=expected["label.centerness"],
        offset=expected["label.offset"],
        flow=expected["label.flow"],
        frame_mask=frame_mask(valid[:, NUM_PAST_FRAMES:], valid[:, :NUM_PAST_FRAMES]),
    )


def released_labels(golden: GoldenModel, sample: int) -> MotionLabels:
    """Return a sample's labels from the released loader, each frame in its own ego frame."""
    arrays = {name: values[sample].numpy() for name, values in golden.inputs().items()}
    config = MotionLabelConfig(
        grid=make_grid(golden, "grid_conf"),
        orientation="released",
        augmentation=make_augmentation(arrays["aug_transform"]),
    )
    batch = {name: arrays[name] for name in (*MAPS, "img_is_valid")}
    batch["future_egomotions"] = arrays["future_egomotion"]
    return MotionLabels.from_batch(batch, config, "deepaccident")


def assert_gradient(tensor: torch.Tensor, expected: torch.Tensor) -> None:
    tolerance = 1e-3 * float(expected.abs().max())
    torch.testing.assert_close(tensor.grad, expected, rtol=1e-2, atol=tolerance)


TASKS = range(len(RELEASED_CLASS_SLOTS))


@pytest.fixture
def golden_detection(golden_model: Callable[[str], GoldenModel]) -> GoldenModel:
    return golden_model("det")


@pytest.fixture
def head(golden_detection: GoldenModel) -> CenterHead:
    head = CenterHead(make_head_config(golden_detection))
    head.load_state_dict(golden_detection.state("task_decoders.3dod."), strict=True)
    return head


def make_head_config(golden_detection: GoldenModel) -> DetectionConfig:
    """Return a configuration with square maps that begin where the golden ones do."""
    coder = golden_detection.config["bbox_coder"]
    num_cells = golden_detection.inputs()["x"].shape[-1]
    low = coder["pc_range"][0]
    cell_size = coder["voxel_size"][0] * coder["out_size_factor"]
    bounds = (low, low + num_cells * cell_size, cell_size)
    return DetectionConfig(
        in_channels=golden_detection.config["in_channels"],
        shared_channels=golden_detection.config["share_conv_channel"],
        class_slots=RELEASED_CLASS_SLOTS,
        x=bounds,
        y=bounds,
    )


def golden_maps(golden_detection: GoldenModel) -> list[TaskMaps]:
    outputs = golden_detection.outputs()
    return [
        TaskMaps(*(outputs[f"pred.{task}.{name}"] for name in TaskMaps._fields)) for task in TASKS
    ]


def make_targets(golden_detection: GoldenModel) -> list[TaskTargets]:
    boxes = golden_detection.inputs()["boxes"].clone()
    boxes[..., 2] += boxes[..., 5] / 2  # in the release z is the height of the lower face
    labels = list(golden_detection.inputs()["labels"])
    config = TargetConfig(
        max_boxes=golden_detection.config["train"]["max_objs"], unknown_velocity="zero"
    )
    return detection_targets(list(boxes), labels, make_head_config(golden_detection), config)


def test_maps_of_the_released_head(golden_detection: GoldenModel, head: CenterHead) -> None:
    maps = head.eval()(golden_detection.inputs()["x"])
    for task_maps, golden_task_maps in zip(maps, golden_maps(golden_detection), strict=True):
        for values, expected in zip(task_maps, golden_task_maps, strict=True):
            assert_close(values, expected)


def test_peak_radii_of_the_released_formula(golden_detection: GoldenModel) -> None:
    sizes = golden_detection.inputs()["radius_sizes_in_cells"]
    assert_close(peak_radius(sizes[:, 0], sizes[:, 1], 0.1), golden_detection.outputs()["radius"])


@pytest.mark.parametrize("task", TASKS)
def test_targets_of_the_released_head(golden_detection: GoldenModel, task: int) -> None:
    outputs = golden_detection.outputs()
    targets = make_targets(golden_detection)[task]
    assert torch.equal(targets.mask, outputs[f"target.{task}.mask"].bool())
    assert torch.equal(targets.cell_index, outputs[f"target.{task}.index"])
    assert_close(targets.heatmap, outputs[f"target.{task}.heatmap"])
    assert_close(targets.box, outputs[f"target.{task}.box"])


def test_losses_and_gradient_of_the_released_head(
    golden_detection: GoldenModel, head: CenterHead
) -> None:
    x = golden_detection.inputs()["x"].requires_grad_()
    expected = golden_detection.outputs()

    maps = head.train()(x)
    losses = detection_losses(maps, make_targets(golden_detection), DetectionLossConfig(weight=1.0))
    torch.stack(list(losses.values())).sum().backward()

    expected_names = {key for key in expected if key.startswith("loss.")}
    assert {f"loss.{name}" for name in losses} == expected_names
    for name, loss in losses.items():
        assert_close(loss, expected[f"loss.{name}"])
    gradient = expected["grad_x"]
    tolerance = 1e-4 * float(gradient.abs().max())
    torch.testing.assert_close(x.grad, gradient, rtol=1e-3, atol=tolerance)


@pytest.mark.parametrize("task", TASKS)
def test_decoded_boxes_of_the_released_coder(golden_detection: GoldenModel, task: int) -> None:
    coder = golden_detection.config["bbox_coder"]
    config = DecodingConfig(
        candidates=coder["max_num"], center_range=tuple(coder["post_center_range"])
    )
    maps = golden_maps(golden_detection)[task]

    candidates = decode_candidates(maps, make_head_config(golden_detection), config)

    expected = golden_detection.outputs()
    for sample in range(len(golden_detection.inputs()["boxes"])):
        prefix = f"decode.{task}.{sample}"
        valid = candidates.valid[sample]
        assert_close(candidates.scores[sample, valid], expected[f"{prefix}.scores"])
        assert_close(candidates.boxes[sample, valid], expected[f"{prefix}.boxes"])
        assert torch.equal(candidates.slots[sample, valid], expected[f"{prefix}.labels"].long())


def test_circle_suppression_of_the_released_code(golden_detection: GoldenModel) -> None:
    outputs = golden_detection.outputs()
    names = [name for name in outputs if name.startswith("circle_nms.")]
    assert names
    for name in names:
        _, task, sample = name.split(".")
        boxes = outputs[f"decode.{task}.{sample}.boxes"].numpy()
        scores = outputs[f"decode.{task}.{sample}.scores"].numpy()
        labels = outputs[f"decode.{task}.{sample}.labels"].numpy().astype(np.int64)

        rows = suppress(boxes, scores, labels, RELEASED_NMS[int(task)])

        np.testing.assert_array_equal(rows, outputs[name].numpy())


def make_config(golden: GoldenModel) -> ModelConfig:
    """Return the released preset in the small sizes of the golden model."""
    whole = released()
    small = golden.config
    swin = small["img_backbone"]
    lift = small["transformer"]
    heads = small["pts_bbox_head"]
    motion = heads["cfg_motion"]
    detection = heads["cfg_3dod"]
    grid = lift["grid_conf"]
    label_grid = motion["grid_conf"]
    bounds = {"x": tuple(grid["xbound"]), "y": tuple(grid["ybound"])}
    label_bounds = {"x": tuple(label_grid["xbound"]), "y": tuple(label_grid["ybound"])}

    encoder_config = SwinConfig(
        embed_dims=swin["embed_dims"],
        depths=tuple(swin["depths"]),
        num_heads=tuple(swin["num_heads"]),
        checkpointing=False,
        neck_channels=small["img_neck"]["out_channels"],
    )
    lift_config = replace(
        whole.cameras.lift,
        in_channels=lift["numC_input"],
        depth=tuple(grid["dbound"]),
        image_size=tuple(lift["input_dim"]),
        **bounds,
    )
    return replace(
        whole,
        cameras=replace(whole.cameras, encoder=encoder_config, lift=lift_config),
        temporal=replace(whole.temporal, grid=BevGrid(**bounds)),
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
            **bounds,
        ),
        targets=TargetConfig(
            unknown_velocity="zero", max_boxes=small["train_cfg"]["pts"]["max_objs"]
        ),
        decoding=DecodingConfig(),
        labels=replace(whole.labels, grid=BevGrid(**label_bounds, orientation="released")),
    )


def make_inputs(inputs: dict[str, Any]) -> ModelInputs:
    """Join the golden inputs of the agents into the inputs of our model."""
    agents = inputs["relative_pose"].shape[1]

    def join_agents(name: str) -> torch.Tensor:
        return torch.cat([inputs[f"agent{agent}.{name}"] for agent in range(agents)])[None]

    return ModelInputs(
        images=join_agents("images").float(),
        cameras=CameraGeometry(
            rotation=join_agents("rots"),
            translation=join_agents("trans"),
            intrinsics=adapt_intrinsics(
                join_agents("intrins"), join_agents("post_rots"), join_agents("post_trans")
            ),
        ),
        egomotion=join_agents("egomotion")[:, :, : NUM_PAST_FRAMES + 1],
        frame_valid=join_agents("img_is_valid")[:, :, : NUM_PAST_FRAMES + 1],
        bev_transform=torch.eye(4)[None],
        ego_rows=torch.tensor([[0, 0]]),
        ego_from_agent=matrices_from_six(inputs["relative_pose"]),
        partners=torch.ones(1, agents, dtype=torch.bool),
        is_infrastructure=torch.zeros(1, agents, dtype=torch.bool),
        delay=torch.zeros(1, agents, dtype=torch.int64),
    )


def make_model(golden: Any) -> V2XFormer:
    model = V2XFormer(make_config(golden))
    weights = Weights(tensors=golden.state(), meta={}, path=Path("end_to_end.npz"))
    report = load_weights(model, weights, whole=True)
    assert not report.unchanged
    assert not report.unused
    return model


def test_each_part_of_a_prediction_is_the_released_one(golden_model) -> None:
    golden = golden_model("end_to_end")
    expected = golden.outputs()
    model = make_model(golden).eval()
    inputs = make_inputs(golden.inputs())
    # only the first of the five draws has its noise stored; the last prediction is the mean's
    first_noise = golden.inputs()["motion_noise_eval_first"]
    noise = torch.zeros(5, *first_noise.shape)
    noise[0] = first_noise

    with torch.no_grad():
        neck = model.img_neck(model.img_backbone(inputs.images.flatten(0, 3)))
        features = neck.unflatten(0, inputs.images.shape[1:4])
        lifted = model.transformer(features, inputs.cameras.flattened())
        maps = model.encoded(inputs)
        fused = model.fused(maps, inputs)
        predicted = model(inputs, noise=noise)

    # like ours, the released order is all frames of an agent, then the next agent's
    assert_close(neck, expected["neck"])
    assert_close(lifted, expected["lss"], 2e-3)
    assert_close(maps[0], expected["temporal"])
    assert_close(fused, expected["fused"])
    for task, task_maps in enumerate(predicted.detection):
        for name, values in task_maps._asdict().items():
            assert_close(values, expected[f"det.{task}.{name}"])
    for name, expected_values in expected.items():
        if name.startswith("motion."):
            _, draw, part = name.split(".")
            values = getattr(predicted.motion.maps, part)[int(draw)]
            assert_close(values, expected_values, 1e-3)


def test_losses_and_gradients_of_a_step_are_the_released_ones(golden_model) -> None:
    golden, inputs, expected = read_golden(golden_model, "end_to_end")
    model = make_model(golden).train()
    batch = {name: inputs[name][0].numpy() for name in MAPS}
    batch["future_egomotions"] = inputs["agent0.egomotion"][0].numpy()
    batch["img_is_valid"] = inputs["agent0.img_is_valid"][0].numpy()
    labels = MotionLabels.from_batch(batch, make_config(golden).labels, "deepaccident")
    boxes = inputs["boxes"].clone()
    boxes[:, 2] += boxes[:, 5] / 2  # from the bottom to the centre
    targets = Targets(
        motion=make_motion_targets(labels.to_present("nearest")),
        boxes=[boxes],
        categories=[inputs["labels"]],
        velocity_known=[torch.ones(len(boxes), dtype=torch.bool)],
    )

    losses = TrainingStep(model)(make_inputs(inputs), targets, noise=inputs["motion_noise_train"])
    total = torch.stack(list(losses.values())).sum()
    total.backward()

    for name, loss in losses.items():
        released_name = f"train.{name}" if name.startswith("task") else f"train.loss_{name}"
        assert_close(loss, expected[released_name], 1e-3)
    assert_close(total, expected["train.total"], 1e-3)
    for name, expected_gradient in expected.items():
        if name.startswith("grad."):
            gradient = model.get_parameter(name.removeprefix("grad.")).grad
            largest_error = float((gradient - expected_gradient).abs().max())
            assert largest_error <= 1e-2 * float(expected_gradient.abs().max())


def make_motion_targets(labels: MotionLabels) -> MotionTargets:
    """Return the targets of a batch of one sample."""
    valid = torch.tensor(labels.valid)[None]
    return MotionTargets(
        segmentation=torch.tensor(labels.segmentation)[None].long(),
        centerness=torch.tensor(labels.centerness)[None],
        offset=torch.tensor(labels.offset)[None],
        flow=torch.tensor(labels.flow)[None],
        frame_mask=frame_mask(valid[:, NUM_PAST_FRAMES:], valid[:, :NUM_PAST_FRAMES]),
    )


@pytest.mark.parametrize(
    ("name", "unused"),
    [("DeepAccident_tiny", None), ("DeepAccident_tiny_v2x", Agent3DConfig(channels=64))],
)
def test_names_and_shapes_equal_the_released_configs(
    request: pytest.FixtureRequest, name: str, unused: Agent3DConfig | None
) -> None:
    """Compare the whole state dict.

    The V2X config also has the layers that no forward pass of the release reaches.
    """
    path = request.config.getoption("golden") / "model" / f"released_keys_{name}.txt"
    with torch.device("meta"):
        whole = released()
        model = V2XFormer(replace(whole, fusion=replace(whole.fusion, agent3d=unused)))

    lines = []
    for key, tensor in model.state_dict().items():
        dtype = str(tensor.dtype).removeprefix("torch.")
        lines.append(f"{key} {tuple(tensor.shape)} {dtype}")
    assert sorted(lines) == sorted(path.read_text(encoding="utf-8").splitlines())
