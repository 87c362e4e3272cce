"""The detection head against the released CenterHeadv1 (golden det; 6 tasks, 32 × 32 cells, 14 boxes a sample).

The golden numbers were made by running the released class on CPU with random weights. Indices, masks and kept rows are
exact; everything else within 1e-4 of the largest value or of 1, gradients within 1e-3. Rotated suppression has no
golden numbers, since the released one needs CUDA.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from golden_model import GoldenModel, check_close

from deepaccident_devkit.model.detection import (
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
from deepaccident_devkit.model.detection.peaks import peak_radius

HEAD = DetectionConfig(
    in_channels=8, shared_channels=8, class_slots=RELEASED_CLASS_SLOTS, x=(-12.8, 12.8, 0.8), y=(-12.8, 12.8, 0.8)
)
TASKS = range(6)


@pytest.fixture
def det(golden_model: Callable[[str], GoldenModel]) -> GoldenModel:
    return golden_model("det")


@pytest.fixture
def head(det: GoldenModel) -> CenterHead:
    head = CenterHead(HEAD)
    head.load_state_dict(det.state("task_decoders.3dod."), strict=True)
    return head


def golden_maps(det: GoldenModel) -> list[TaskMaps]:
    outputs = det.outputs()
    return [TaskMaps(*(outputs[f"pred.{task}.{name}"] for name in TaskMaps._fields)) for task in TASKS]


def our_targets(det: GoldenModel) -> list[TaskTargets]:
    boxes = det.inputs()["boxes"].clone()
    boxes[..., 2] += boxes[..., 5] / 2  # the release's z is that of the lower face
    config = TargetConfig(max_boxes=det.config["train"]["max_objs"], unknown_velocity="zero")
    return detection_targets(list(boxes), list(det.inputs()["labels"]), HEAD, config)


def test_maps_of_the_released_head(det: GoldenModel, head: CenterHead) -> None:
    maps = head.eval()(det.inputs()["x"])
    for ours, golden in zip(maps, golden_maps(det), strict=True):
        for found, expected in zip(ours, golden, strict=True):
            check_close(found, expected)


def test_keys_and_shapes_of_the_released_checkpoint(request: pytest.FixtureRequest) -> None:
    prefix = "pts_bbox_head.task_decoders.3dod."
    path = request.config.getoption("golden") / "model" / "released_keys_DeepAccident_tiny_v2x.txt"
    lines = [line.removeprefix(prefix) for line in path.read_text("ascii").splitlines() if line.startswith(prefix)]
    released = {line.split(" ", 1)[0]: line.split(" ", 1)[1].rsplit(" ", 1)[0] for line in lines}
    ours = CenterHead(DetectionConfig(class_slots=RELEASED_CLASS_SLOTS)).state_dict()
    assert {key: str(tuple(value.shape)) for key, value in ours.items()} == released


def test_peak_radii_of_the_released_formula(det: GoldenModel) -> None:
    sizes = det.inputs()["radius_sizes_in_cells"]
    check_close(peak_radius(sizes[:, 0], sizes[:, 1], 0.1), det.outputs()["radius"])


@pytest.mark.parametrize("task", TASKS)
def test_targets_of_the_released_head(det: GoldenModel, task: int) -> None:
    outputs, ours = det.outputs(), our_targets(det)[task]
    assert torch.equal(ours.mask, outputs[f"target.{task}.mask"].bool())
    assert torch.equal(ours.place, outputs[f"target.{task}.index"])
    check_close(ours.heatmap, outputs[f"target.{task}.heatmap"])
    check_close(ours.box, outputs[f"target.{task}.box"])


def test_losses_and_gradient_of_the_released_head(det: GoldenModel, head: CenterHead) -> None:
    x = det.inputs()["x"].requires_grad_()
    maps = head.train()(x)
    losses = detection_losses(maps, our_targets(det), DetectionLossConfig(weight=1.0))
    golden = {key.removeprefix("loss."): value for key, value in det.outputs().items() if key.startswith("loss.")}
    assert losses.keys() == golden.keys()
    for name, value in losses.items():
        check_close(value, golden[name])
    torch.stack(list(losses.values())).sum().backward()
    gradient = det.outputs()["grad_x"]
    torch.testing.assert_close(x.grad, gradient, rtol=1e-3, atol=1e-4 * float(gradient.abs().max()))


@pytest.mark.parametrize("task", TASKS)
def test_decoded_boxes_of_the_released_coder(det: GoldenModel, task: int) -> None:
    coder = det.config["bbox_coder"]
    config = DecodingConfig(candidates=coder["max_num"], center_range=tuple(coder["post_center_range"]))
    found, outputs = decode_candidates(golden_maps(det)[task], HEAD, config), det.outputs()
    for sample in range(2):
        golden = {name: outputs[f"decode.{task}.{sample}.{name}"] for name in ("boxes", "scores", "labels")}
        valid = found.valid[sample]
        check_close(found.scores[sample, valid], golden["scores"])
        check_close(found.boxes[sample, valid], golden["boxes"])
        assert torch.equal(found.slots[sample, valid], golden["labels"].long())


def test_circle_suppression_of_the_released_code(det: GoldenModel) -> None:
    boxes, scores, labels = (det.outputs()[f"decode.3.0.{name}"].numpy() for name in ("boxes", "scores", "labels"))
    kept = suppress(boxes, scores, labels.astype(np.int64), RELEASED_NMS[3])
    np.testing.assert_array_equal(kept, det.outputs()["circle_nms.3.0"].numpy())
