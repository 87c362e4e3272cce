"""The model's warps, temporal model and fusion against the released classes and the originals of the fusion modules.

All numbers were made on a CPU with torch 2.13 by those classes themselves (tests/data/golden/model/README.md), with
seeded random weights; within 1e-4 of the largest value where nothing else is said.
"""

from collections.abc import Callable

import pytest
import torch
from golden_model import GoldenModel, check_close

from deepaccident_devkit.model import warps
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
        chain = warps.present_from_past(given["egomotion"][:, :2], chain="released", bev_transform=matrix)
    else:
        moved = slice(1, 3)
        chain = warps.present_from_frames(given["egomotion"], bev_transform=matrix)[:, 1:]
    ours = given["x"].clone()
    ours[:, moved] = warps.warp_features(
        given["x"][:, moved].flatten(0, 1), chain.flatten(0, 1), bounds(golden), warp="stretched", mode=mode
    ).unflatten(0, (2, 2))
    check_sampled(ours, golden.outputs()[f"{kind}{'_aug' if augmented else ''}_{mode}"], mode)


def test_partners_are_placed_as_by_the_released_warper(golden_model: Golden) -> None:
    """The maps; the poses' matrices within 1e-6; also with the released transforms of augmented maps, and the right."""
    golden = golden_model("warps")
    given, expected, grid = golden.inputs(), golden.outputs(), bounds(golden)
    poses = warps.matrices_from_six(given["relative_pose"])
    check_close(poses, expected["pose_mats"], 1e-6)
    check_close(warps.agents_to_ego(given["xv"], poses, grid, warp="stretched"), expected["v2x"])
    own = given["aug_v"]
    as_released = warps.between_augmented(poses, own, own)
    check_close(warps.agents_to_ego(given["xv"], as_released, grid, warp="stretched"), expected["v2x_aug_released"])
    right = warps.between_augmented(poses, own[:, :1], own)
    check_close(warps.agents_to_ego(given["xv"], right, grid, warp="stretched"), expected["v2x_aug_right"])


@pytest.mark.parametrize(("name", "pose"), [("identity_full", [0.0] * 6), ("move_full", [7.3, -3.1, 0, 0, 0, 0.6])])
def test_a_full_map_is_warped_as_by_the_released_warper(golden_model: Golden, name: str, pose: list[float]) -> None:
    """128 × 128 cells of 0.8 m."""
    golden = golden_model("warps")
    target_from_source = warps.matrices_from_six(torch.tensor([pose]))
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
