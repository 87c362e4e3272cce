"""The model's warps, temporal model and fusion against the released classes and the originals of the fusion modules.

All numbers were made on a CPU with torch 2.13 by those classes themselves (tests/data/golden/model/README.md), with
seeded random weights; within 1e-4 of the largest value where nothing else is said.
"""

import re
from collections.abc import Callable

import pytest
import torch
from golden_model import GoldenModel, check_close

from deepaccident_devkit.model import poses, warps
from deepaccident_devkit.model.fusion import (
    Agent3D,
    Agent3DConfig,
    CobevtConfig,
    DiscoNetConfig,
    ReleasedFusionConfig,
    V2XViTConfig,
    fusion,
)
from deepaccident_devkit.model.fusion.v2xvit import sinusoid
from deepaccident_devkit.model.temporal import TemporalConfig, temporal_model
from deepaccident_devkit.model.warps import GridBounds

Golden = Callable[[str], GoldenModel]
CELLS_AT_TIES = 0.005
"""The share of cells that may differ after a nearest warp, for points on the border between two cells."""


def bounds(golden: GoldenModel, name: str = "grid") -> GridBounds:
    grid = golden.config[name]
    return GridBounds(x=tuple(grid["xbound"]), y=tuple(grid["ybound"]))


def check_sampled(ours: torch.Tensor, golden: torch.Tensor, mode: str) -> None:
    if mode == "bilinear":
        check_close(ours, golden)
    else:
        assert ours.shape == golden.shape
        assert float(((ours - golden).abs() > 1e-6).float().mean()) <= CELLS_AT_TIES


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("augmented", [False, True])
@pytest.mark.parametrize("kind", ["temporal", "labels"])
def test_chains_of_warps_equal_the_released_warper(
    golden_model: Golden, kind: str, augmented: bool, mode: warps.WarpMode
) -> None:
    """FeatureWarper's cumulative and reverse warps; nearest: all but 0.5 % of the cells."""
    golden = golden_model("warps")
    given = golden.inputs()
    matrix = given["aug"] if augmented else None
    if kind == "temporal":
        moved = slice(0, 2)
        chain = poses.present_from_past(given["egomotion"][:, :2], chain="released", bev_transform=matrix)
    else:
        moved = slice(1, 3)
        chain = poses.present_from_frames(given["egomotion"], bev_transform=matrix)[:, 1:]
    ours = given["x"].clone()
    ours[:, moved] = warps.warp_features(
        given["x"][:, moved].flatten(0, 1), chain.flatten(0, 1), bounds(golden), warp="stretched", mode=mode
    ).unflatten(0, (2, 2))
    check_sampled(ours, golden.outputs()[f"{kind}{'_aug' if augmented else ''}_{mode}"], mode)


def test_partners_are_placed_as_by_the_released_warper(golden_model: Golden) -> None:
    """The maps; the poses' matrices within 1e-6; also with the released transforms of augmented maps, and the right."""
    golden = golden_model("warps")
    given, expected, grid = golden.inputs(), golden.outputs(), bounds(golden)
    ego_from_agent = poses.matrices_from_six(given["relative_pose"])
    check_close(ego_from_agent, expected["pose_mats"], 1e-6)
    check_close(warps.agents_to_ego(given["xv"], ego_from_agent, grid, warp="stretched"), expected["v2x"])
    own = given["aug_v"]
    as_released = poses.between_augmented(ego_from_agent, own, own)
    check_close(warps.agents_to_ego(given["xv"], as_released, grid, warp="stretched"), expected["v2x_aug_released"])
    right = poses.between_augmented(ego_from_agent, own[:, :1], own)
    check_close(warps.agents_to_ego(given["xv"], right, grid, warp="stretched"), expected["v2x_aug_right"])


@pytest.mark.parametrize(("name", "pose"), [("identity_full", [0.0] * 6), ("move_full", [7.3, -3.1, 0, 0, 0, 0.6])])
def test_a_full_map_is_warped_as_by_the_released_warper(golden_model: Golden, name: str, pose: list[float]) -> None:
    """128 × 128 cells of 0.8 m."""
    golden = golden_model("warps")
    target_from_source = poses.matrices_from_six(torch.tensor([pose]))
    features = golden.inputs()["xf"][:, 0]
    ours = warps.warp_features(features[:, None], target_from_source, bounds(golden, "full"), warp="stretched")
    check_close(ours, golden.outputs()[name])


@pytest.mark.parametrize("case", ["eval", "eval_aug", "train_aug"])
def test_temporal_model_equals_the_released_one(golden_model: Golden, case: str) -> None:
    """Temporal3DConvModel; sample 1 without its oldest frame, sample 2 with the present alone."""
    golden = golden_model("temporal")
    given = golden.inputs()
    config = TemporalConfig(
        channels=8, grid=bounds(golden, "grid_conf"), warp="stretched", chain="released", egomotion_input="raw"
    )
    model = temporal_model(config)
    model.load_state_dict(golden.state("temporal_model."))
    model.train(case.startswith("train"))
    matrix = given["aug"] if case.endswith("aug") else None
    ours = model(given["x"], given["egomotion"][:, :3], given["img_is_valid"][:, :3], matrix)
    check_close(ours, golden.outputs()[case])


def test_released_fusion_equals_the_released_one(golden_model: Golden) -> None:
    """V2X_fusion with its warp; agent 3 has almost nothing to say. Gradients within 1e-3."""
    golden = golden_model("fusion_released")
    given, expected = golden.inputs(), golden.outputs()
    x = given["x"].requires_grad_()
    ego_from_agent = poses.matrices_from_six(given["relative_pose"])
    placed = warps.agents_to_ego(x, ego_from_agent, bounds(golden), warp="stretched")
    check_close(placed, expected["warped"])
    config = ReleasedFusionConfig(
        channels=64, ego_channels=tuple(golden.config["ego_channels"]), fill_below=golden.config["fill_threshold"]
    )
    assert config == ReleasedFusionConfig(channels=64)
    everywhere = torch.ones(1, 5, 16, 16, dtype=torch.bool)
    fused = fusion(config)(placed, everywhere, *vehicles_without_delay(everywhere))
    check_close(fused, expected["fused"])
    (fused * given["loss_weight"]).sum().backward()
    check_close(x.grad, expected["grad_x"], 1e-3)


def test_the_released_fusion_s_unreached_layers_equal_its_own(golden_model: Golden) -> None:
    """The layers behind the early return, called in the order of the lines that are never reached."""
    golden = golden_model("fusion_agent3d_dead")
    given, expected = golden.inputs(), golden.outputs()
    model = Agent3D(Agent3DConfig(channels=8, agents=3)).eval()
    model.load_state_dict(golden.state("v2x_fusion."))
    check_close(model.over_agents(given["warped"], given["relative_pose"]), expected["after_model"])
    check_close(model(given["warped"], given["relative_pose"]), expected["compressed"])


@pytest.mark.parametrize("part", ["temporal_model", "v2x_fusion"])
def test_keys_are_those_of_the_released_state_dict(pytestconfig: pytest.Config, part: str) -> None:
    """The full released V2X config: names and shapes. No gradient is asked of the fusion's unused layers."""
    listing = pytestconfig.getoption("golden") / "model" / "released_keys_DeepAccident_tiny_v2x.txt"
    lines = [line.split(" ", 1) for line in listing.read_text().splitlines() if line.startswith(f"{part}.")]
    expected = {key: shape.rsplit(" ", 1)[0] for key, shape in lines}
    if part == "temporal_model":
        axis = (-51.2, 51.2, 0.8)
        model = temporal_model(TemporalConfig(channels=64, grid=GridBounds(x=axis, y=axis)))
    else:
        model = fusion(ReleasedFusionConfig(channels=64, agent3d=Agent3DConfig(channels=64)))
    assert {f"{part}.{key}": str(tuple(value.shape)) for key, value in model.state_dict().items()} == expected
    assert all(weight.requires_grad == (part == "temporal_model") for weight in model.parameters())


def test_disconet_equals_the_original(golden_model: Golden) -> None:
    """PixelWeightedFusionSoftmax and Linear, of CoBEVT's code."""
    golden = golden_model("ref_disconet")
    given, expected = golden.inputs(), golden.outputs()
    model = fusion(DiscoNetConfig(channels=32, last_relu=True)).eval()
    model.load_state_dict({**disconet_scores(golden), **renamed(golden.state("mlp."), [(r"^", "out.")])})
    check_close(model.weights(given["x"], given["mask"]), expected["weights"][:, :, 0])
    check_close(model(given["x"], given["mask"], *vehicles_without_delay(given["mask"])), expected["y"])


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
    check_close(model(given["x"], given["mask"], *vehicles_without_delay(given["mask"])), expected["y"])


def test_v2xvit_equals_the_original(golden_model: Golden) -> None:
    """RTE, V2XFusionBlock and FFN; each step that the golden file has. The first layer is float16: within 2e-3."""
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
    check_close(sinusoid(torch.arange(100), 32), state.pop("rte.emb.emb.weight"), 1e-6)
    model.load_state_dict(v2xvit_state(state))
    mask, infra = given["mask"], given["types"] == 1
    tokens = given["x"].movedim(2, -1) + model.delay_encoding(given["delay"])[:, :, None, None]
    check_close(tokens, expected["after_rte"])
    for number, (block, tolerance) in enumerate(zip(model.blocks, (2e-3, 1e-4), strict=True)):
        if number == 0:
            check_close(block.agents.layer(block.agents.norm(tokens), mask, infra), expected["hmsa0"])
        tokens = block(tokens, mask, infra)
        check_close(tokens, expected[f"after_layer{number}"], tolerance)
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


def renamed(state: dict[str, torch.Tensor], table: list[tuple[str, str]]) -> dict[str, torch.Tensor]:
    for pattern, replacement in table:
        state = {re.sub(pattern, replacement, key): value for key, value in state.items()}
    return state


def vehicles_without_delay(mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    shape = mask.shape[:2]
    return torch.zeros(shape, dtype=torch.bool), torch.zeros(shape, dtype=torch.long)
