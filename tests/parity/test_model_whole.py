"""The whole model against the released class BEVerse_V2X, run on a CPU, and its names against the released configs.

Made with DeepAccident @ 728e366 (tests/data/golden/model/README.md). Equal within 1e-4 of the largest value, stored
halves within 2e-3, losses within 1e-3, gradients within 1 %.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from golden_model import check_close

from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.model.bev import BevEncodeConfig
from deepaccident_devkit.model.checkpoint import Weights, load_weights
from deepaccident_devkit.model.config import ModelConfig
from deepaccident_devkit.model.detection import DecodingConfig, TargetConfig
from deepaccident_devkit.model.entry import ModelInputs
from deepaccident_devkit.model.images import SwinConfig
from deepaccident_devkit.model.lift import CameraGeometry
from deepaccident_devkit.model.motion import MotionTargets, frame_mask
from deepaccident_devkit.model.network import V2XFormer
from deepaccident_devkit.model.poses import matrices_from_six
from deepaccident_devkit.model.presets import released
from deepaccident_devkit.model.training.step import Targets, TrainingStep
from deepaccident_devkit.model.warps import GridBounds
from deepaccident_devkit.motion import MotionLabels

ALONG, CELLS = (-12.8, 12.8, 0.8), (-12.0, 12.0, 0.5)
AGENTS, PAST = 3, 2


def config() -> ModelConfig:
    """The released preset in the small sizes of the golden model."""
    whole = released()
    swin = SwinConfig(
        embed_dims=8, depths=(2, 2, 2, 2), num_heads=(1, 2, 2, 4), checkpointing=False, neck_channels=16
    )
    return replace(
        whole,
        encoder=swin,
        lift=replace(whole.lift, in_channels=16, depth=(1.0, 13.0, 1.0), x=ALONG, y=ALONG, image_size=(64, 160)),
        temporal=replace(whole.temporal, grid=GridBounds(x=ALONG, y=ALONG)),
        bev=BevEncodeConfig(in_channels=64, out_channels=16, widths=(8, 16, 32)),
        motion=replace(whole.motion, in_channels=16, latent=4),
        detection=replace(whole.detection, in_channels=16, shared_channels=8, x=ALONG, y=ALONG),
        targets=TargetConfig(unknown_velocity="zero", max_boxes=50),
        decoding=DecodingConfig(),
        labels=replace(whole.labels, grid=BevGrid(x=CELLS, y=CELLS, orientation="released")),
    )


def inputs_of(given: dict[str, Any]) -> ModelInputs:
    """The golden inputs, agent by agent, as ours."""

    def joined(name: str) -> torch.Tensor:
        return torch.cat([given[f"agent{agent}.{name}"] for agent in range(AGENTS)])[None]

    return ModelInputs(
        images=joined("images").float(),
        cameras=CameraGeometry(
            rotation=joined("rots"),
            translation=joined("trans"),
            intrinsics=joined("intrins"),
            image_rotation=joined("post_rots"),
            image_translation=joined("post_trans"),
        ),
        egomotion=joined("egomotion")[:, :, : PAST + 1],
        frame_valid=joined("img_is_valid")[:, :, : PAST + 1],
        bev_transform=torch.eye(4)[None],
        ego_rows=torch.tensor([[0, 0]]),
        ego_from_agent=matrices_from_six(given["relative_pose"]),
        partners=torch.ones(1, AGENTS, dtype=torch.bool),
        is_infrastructure=torch.zeros(1, AGENTS, dtype=torch.bool),
        delay=torch.zeros(1, AGENTS, dtype=torch.int64),
    )


def model_of(golden: Any) -> V2XFormer:
    model = V2XFormer(config())
    done = load_weights(model, Weights(tensors=golden.state(), meta={}, path=Path("end_to_end.npz")), whole=True)
    assert not done.kept
    assert not done.unused
    return model


def test_each_part_of_a_prediction_is_the_released_one(golden_model) -> None:
    golden = golden_model("end_to_end")
    given, expected, model = golden.inputs(), golden.outputs(), model_of(golden).eval()
    inputs = inputs_of(given)
    with torch.no_grad():
        neck = model.img_neck(model.img_backbone(inputs.images.flatten(0, 3)))
        lifted = model.transformer(neck.unflatten(0, (AGENTS, PAST + 1, 2)), inputs.cameras.flattened())
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
    for draw in (0, 5):
        for name, values in predicted.motion.maps._asdict().items():
            check_close(values[draw], expected[f"motion.{draw}.{name}"])


def test_losses_and_gradients_of_a_step_are_the_released_ones(golden_model) -> None:
    golden = golden_model("end_to_end")
    given, expected, model = golden.inputs(), golden.outputs(), model_of(golden).train()
    names = ("motion_segmentation", "motion_instance", "instance_centerness", "instance_offset", "instance_flow")
    batch = {name: given[name][0].numpy() for name in names}
    batch |= {"future_egomotions": given["agent0.egomotion"][0].numpy()}
    batch |= {"img_is_valid": given["agent0.img_is_valid"][0].numpy()}
    labels = MotionLabels.from_batch(batch, config().labels, "deepaccident").to_present("nearest")
    maps = [torch.tensor(getattr(labels, name))[None] for name in ("segmentation", "centerness", "offset", "flow")]
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
            torch.testing.assert_close(found, gradient, rtol=1e-2, atol=1e-3 * float(gradient.abs().max()))


@pytest.mark.parametrize("name", ["DeepAccident_tiny", "DeepAccident_tiny_v2x"])
def test_names_and_shapes_are_those_of_the_released_configs(request: pytest.FixtureRequest, name: str) -> None:
    """All but the V2X layers that no forward pass of the release reaches (`fusion.Agent3D`)."""
    path = request.config.getoption("golden") / "model" / f"released_keys_{name}.txt"
    listed = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        key, _, rest = line.partition(" ")
        shape, _, dtype = rest.rpartition(" ")
        if not key.startswith("v2x_fusion."):
            listed[key] = (tuple(int(size) for size in shape.strip("()").split(",") if size.strip()), dtype)
    with torch.device("meta"):
        state = V2XFormer(released()).state_dict()
    found = {key: (tuple(each.shape), str(each.dtype).removeprefix("torch.")) for key, each in state.items()}
    assert found == listed
