"""The BEV encoder and the motion head against the released classes.

The golden set (tests/data/golden/model, its README) was made with DeepAccident @ 728e366 on a CPU: torch 2.13, random
weights. Everything is equal within 1e-4 of the largest value, the crop within 1e-5, gradients within 1 % and 0.1 % of
the largest; warped labels are equal in every cell.
"""

import numpy as np
import pytest
import torch
from golden_model import GoldenModel, check_close

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.geometry.handedness import flip_pose
from deepaccident_devkit.model.bev import BevEncode, BevEncodeConfig, crop
from deepaccident_devkit.model.motion import (
    LatentDistribution,
    MotionHead,
    MotionHeadConfig,
    MotionLossConfig,
    MotionTargets,
    frame_mask,
    motion_losses,
)
from deepaccident_devkit.model.motion.distributions import SpatialDistribution
from deepaccident_devkit.model.motion.flow_gru import FlowGru, warp_with_flow
from deepaccident_devkit.model.motion.losses import center_loss, latent_loss, segmentation_loss, vector_loss
from deepaccident_devkit.motion import Augmentation, MotionLabelConfig, MotionLabels

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
        BevGrid(golden.config[name]["xbound"], golden.config[name]["ybound"]) for name in ("grid", "motion")
    )
    check_close(crop(golden.inputs()["x"], source, target), golden.outputs()["y"], 1e-5)


def test_the_encoder_is_the_released_one(golden_model) -> None:
    golden = golden_model("bev_encoder")
    encoder = BevEncode(BevEncodeConfig(in_channels=4, out_channels=8, widths=(8, 16, 32)))
    encoder.load_state_dict(golden.state("taskfeat_encoders.motion."))
    check_close(encoder.eval()(golden.inputs()["x"]), golden.outputs()["y"])


def test_future_states_are_the_released_ones(golden_model) -> None:
    golden = golden_model("future_prediction")
    given, expected = golden.inputs(), golden.outputs()
    future = FlowGru(8, 4, 4, hidden_warp="none", detach=True)
    future.load_state_dict(golden.state("future_prediction."))
    check_close(future.eval()(given["z"], given["state"]), expected["eval"])
    check_close(future.train()(given["z"], given["state"]), expected["train"])
    check_close(warp_with_flow(given["state"], given["flow"]), expected["warp_with_flow"])


def test_the_distribution_is_the_released_one(golden_model) -> None:
    golden = golden_model("future_prediction")
    distribution = SpatialDistribution(8, 4, 4, (-5.0, 5.0))
    distribution.load_state_dict(golden.state("present_distribution."))
    found = distribution.eval()(golden.inputs()["dist_x"][:, 0])
    check_close(found.mu, golden.outputs()["mu"])
    check_close(found.log_sigma, golden.outputs()["log_sigma"])


def test_training_outputs_are_the_released_ones(golden_model) -> None:
    golden = golden_model("motion_head")
    outputs = head_of(golden).train()(golden.inputs()["x"], warped_targets(golden), noise=golden.inputs()["noise"])
    expected = golden.outputs()
    for name, maps in outputs.maps._asdict().items():
        check_close(maps, expected[f"train.{name}"])
    for name in ("present", "future"):
        for part, values in getattr(outputs, name)._asdict().items():
            check_close(values, expected[f"train.{name}_{part}"])


def test_losses_and_gradients_of_the_head_are_the_released_ones(golden_model) -> None:
    golden = golden_model("motion_head")
    head, features, targets = head_of(golden), golden.inputs()["x"].requires_grad_(), warped_targets(golden)
    losses = motion_losses(head.train()(features, targets, noise=golden.inputs()["noise"]), targets, MotionLossConfig())
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
        maps = head_of(golden).eval()(golden.inputs()["x"], noise=golden.inputs()["eval_noise"]).maps
    for name, values in golden.outputs().items():
        if name.startswith("eval."):
            _, draw, part = name.split(".")
            check_close(getattr(maps, part)[int(draw)], values, 1e-4 if values.dtype == torch.float32 else 2e-3)


def test_the_devkit_warps_labels_as_the_released_head(golden_model) -> None:
    """In the frames that are in the recording: the set's missing ones are all 0, where the loader's vectors are 255."""
    golden = golden_model("motion_head")
    expected = warped_targets(golden)
    for sample in range(len(expected.segmentation)):
        labels = released_labels(golden, sample).to_present("nearest")
        here = labels.label_valid
        for name in ("segmentation", "centerness", "offset", "flow"):
            found, warped = getattr(labels, name)[here], getattr(expected, name)[sample].numpy()[here]
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
    head = {"ignored": "segmentation", "segmentation": "segmentation", "centerness": "instance_center"}
    predicted = given[f"pred.{head.get(target, f'instance_{target}')}"].requires_grad_()
    found = loss(predicted, label, given["frame_mask"], MotionLossConfig(**config))
    check_close(found, expected[name])
    found.backward()
    check_gradient(predicted, expected[f"grad.{name}"])


@pytest.mark.parametrize(
    ("name", "mask"), [("kl", [True, True]), ("kl_first_only", [True, False]), ("kl_none", [False, False])]
)
def test_the_divergence_is_the_released_one(golden_model, name, mask) -> None:
    golden = golden_model("motion_losses")
    given = golden.inputs()
    present, future = (
        LatentDistribution(given[f"{when}_mu"], given[f"{when}_log_sigma"]) for when in ("present", "future")
    )
    check_close(latent_loss(present, future, torch.tensor(mask)), golden.outputs()[name])


def test_nothing_to_learn_from_gives_no_loss(golden_model) -> None:
    golden = golden_model("motion_losses")
    given, expected = golden.inputs(), golden.outputs()
    nothing = torch.zeros_like(given["frame_mask"])
    config = MotionLossConfig()
    check_close(
        segmentation_loss(given["pred.segmentation"], given["label.motion_segmentation"], nothing, config),
        expected["seg_no_frame"],
    )
    check_close(
        vector_loss(given["pred.instance_offset"], given["label.instance_offset"], nothing, config),
        expected["offset_no_frame"],
    )


def test_from_fused_features_on_it_predicts_as_the_released_model(golden_model) -> None:
    """Crop, encoder and head in a row, on the features of three agents."""
    golden = golden_model("end_to_end")
    heads, given = golden.config["pts_bbox_head"], golden.inputs()
    source, target = (
        BevGrid(grid["xbound"], grid["ybound"]) for grid in (heads["grid_conf"], heads["motion_grid_conf"])
    )
    encoder = BevEncode(BevEncodeConfig(in_channels=64, out_channels=16, widths=(8, 16, 32)))
    encoder.load_state_dict(floats(golden.state("pts_bbox_head.taskfeat_encoders.motion.")))
    head = MotionHead(MotionHeadConfig(in_channels=16, latent=4, samples=1, **RELEASED))
    head.load_state_dict(floats(golden.state("pts_bbox_head.task_decoders.motion.")))
    with torch.no_grad():
        features = encoder.eval()(crop(golden.outputs()["fused"].float(), source, target))
        maps = head.eval()(features, noise=given["motion_noise_eval_first"][None]).maps
    for draw, stored in ((0, 0), (1, 5)):
        for name, found in maps._asdict().items():
            check_close(found[draw], golden.outputs()[f"motion.{stored}.{name}"], 1e-3)


@pytest.mark.parametrize("config", ["DeepAccident_tiny", "DeepAccident_tiny_v2x"])
def test_weights_have_the_released_names_and_shapes(request, config) -> None:
    listed = (request.config.getoption("golden") / "model" / f"released_keys_{config}.txt").read_text(encoding="utf-8")
    parts = {"taskfeat_encoders": BevEncode(BevEncodeConfig()), "task_decoders": MotionHead(MotionHeadConfig())}
    found = {
        f"pts_bbox_head.{part}.motion.{name} {tuple(values.shape)}"
        for part, module in parts.items()
        for name, values in module.state_dict().items()
    }
    assert found == {line.rpartition(" ")[0] for line in listed.splitlines() if ".motion." in line}


def floats(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights stored in half precision, as they are used."""
    return {name: values.float() if values.is_floating_point() else values for name, values in state.items()}


def head_of(golden: GoldenModel) -> MotionHead:
    sizes = {"in_channels": golden.config["in_channels"], "latent": golden.config["prob_latent_dim"]}
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
    given = {name: values[sample].numpy() for name, values in golden.inputs().items() if name in BATCH}
    bounds = golden.config["grid_conf"]
    config = MotionLabelConfig(
        grid=BevGrid(bounds["xbound"], bounds["ybound"]),
        orientation="released",
        augmentation=augmentation_of(golden.inputs()["aug_transform"][sample].numpy()),
    )
    return MotionLabels.from_batch(given | {"future_egomotions": given["future_egomotion"]}, config, "deepaccident")


def augmentation_of(matrix: np.ndarray) -> Augmentation:
    """What makes the left-handed matrix that the released code drew."""
    given = flip_pose(matrix)
    scale, flip = given[2, 2], bool(np.linalg.det(given[:2, :2]) < 0)
    turn = np.diag([1, -1 if flip else 1]) @ given[:2, :2] / scale
    return Augmentation(rotation=np.arctan2(turn[1, 0], turn[0, 0]), scale=scale, flip=flip)


def check_gradient(of: torch.Tensor, golden: torch.Tensor) -> None:
    torch.testing.assert_close(of.grad, golden, rtol=1e-2, atol=1e-3 * float(golden.abs().max()))
