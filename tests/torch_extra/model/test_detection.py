"""The detection head: targets, losses, decoding and suppression."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.expected_errors import assert_raises
from torch import Tensor
from torch_extra.compared import are_identical
from torch_extra.model.gradients import names_without_gradient
from torch_extra.model.perfect import perfect_maps

from deepaccident_devkit.errors import DeepAccidentError, GeometryError
from deepaccident_devkit.geometry import SE3
from deepaccident_devkit.plugins.model.detection import (
    ONE_TASK,
    CenterHead,
    DecodingConfig,
    DetectionConfig,
    DetectionLossConfig,
    Detections,
    NmsConfig,
    TargetConfig,
    TaskMaps,
    decode_candidates,
    decode_detections,
    detected_boxes,
    detection_losses,
    detection_targets,
    rotated_iou,
    suppress,
)

GRID: dict[str, Any] = {"x": (-8.0, 8.0, 1.0), "y": (-6.0, 6.0, 1.0)}
SMALL = DetectionConfig(in_channels=4, shared_channels=4, **GRID)
JOINT = replace(SMALL, class_slots=ONE_TASK, branches="joint", upsample=2)
SEEDS = st.integers(0, 2**32 - 1)
BOTH_BRANCHES = pytest.mark.parametrize("config", [SMALL, JOINT], ids=["separate", "joint"])
FEW_EXAMPLES = settings(max_examples=20)


def make_features(config: DetectionConfig, samples: int = 2) -> Tensor:
    rows, columns = (count // config.upsample for count in config.shape)
    return torch.randn(
        samples,
        config.in_channels,
        rows,
        columns,
        generator=torch.Generator().manual_seed(0),
    )


def random_boxes(seed: int, count: int) -> tuple[Tensor, Tensor]:
    """Draw boxes in different cells, and their categories."""
    random = np.random.default_rng(seed)
    cells = random.choice(16 * 12, count, replace=False)
    corners = np.stack([cells % 16 - 8, cells // 16 - 6], axis=1)
    columns = [
        corners + random.uniform(0.01, 0.99, (count, 2)),
        random.uniform(-3.0, 3.0, (count, 1)),  # height
        random.uniform(0.5, 6.0, (count, 3)),  # size
        random.uniform(-3.1, 3.1, (count, 1)),  # yaw
        random.uniform(-20.0, 20.0, (count, 2)),  # velocity
    ]
    boxes = torch.from_numpy(np.column_stack(columns)).float()
    return boxes, torch.from_numpy(random.integers(0, 6, count))


@BOTH_BRANCHES
def test_gradients_reach_every_parameter(config: DetectionConfig) -> None:
    head = CenterHead(config)
    boxes, categories = zip(random_boxes(1, 20), random_boxes(2, 20), strict=True)
    targets = detection_targets(boxes, categories, config)

    losses = detection_losses(head(make_features(config)), targets)
    torch.stack(list(losses.values())).sum().backward()

    assert names_without_gradient(head) == []


@pytest.mark.parametrize(
    "config", [SMALL, replace(SMALL, class_slots=ONE_TASK)], ids=["tasks", "one task"]
)
@given(seed=SEEDS, count=st.integers(0, 30))
@FEW_EXAMPLES
def test_perfect_maps_give_the_boxes_back(config: DetectionConfig, seed: int, count: int) -> None:
    boxes, categories = random_boxes(seed, count)
    maps = perfect_maps(detection_targets([boxes], [categories], config))
    no_suppression = DecodingConfig(nms=(NmsConfig(threshold=1.0),))

    (detections,) = decode_detections(maps, config, no_suppression)

    order = detections.boxes[:, 0].argsort()
    expected_order = boxes[:, 0].argsort()
    torch.testing.assert_close(detections.boxes[order], boxes[expected_order], rtol=0, atol=1e-4)
    assert torch.equal(detections.categories[order], categories[expected_order])


@given(seed=SEEDS)
@FEW_EXAMPLES
def test_targets_do_not_depend_on_the_other_samples(seed: int) -> None:
    samples = (
        random_boxes(seed, 20),
        random_boxes(seed, 0),
        random_boxes(seed + 1, 9),
    )
    batch_targets = detection_targets(*zip(*samples, strict=True), SMALL)

    for number, (boxes, categories) in enumerate(samples):
        rows = slice(number, number + 1)
        targets = [[values[rows] for values in task] for task in batch_targets]
        assert are_identical(targets, detection_targets([boxes], [categories], SMALL))


def test_boxes_outside_or_of_no_category_are_left_out() -> None:
    boxes = torch.tensor([[0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0, 0.0, 0.0]]).repeat(6, 1)
    boxes[1, 0] = -8.9  # is truncated into the first column
    boxes[2, 1] = 6.01  # lies beyond the last row
    boxes[3, 4] = 0.0  # has no width
    categories = torch.tensor([0, 0, 0, 0, -1, 5])
    cars, *_ = detection_targets([boxes], [categories], replace(SMALL, class_slots=((0,), (1, 2))))
    assert cars.cell_index[cars.mask].tolist() == [6 * 16 + 8, 6 * 16]
    assert cars.box[0, 1, 0] == pytest.approx(-0.9, abs=1e-5)


def test_unknown_velocities_are_trained_to_zero_or_not_at_all() -> None:
    boxes, categories = random_boxes(7, 10)
    boxes[:4, 7:] = torch.nan
    is_known = [torch.arange(10) > 4]  # the fifth is finite, but unknown
    loss_config = DetectionLossConfig(weight=1.0, box_weight=1.0)

    # ten boxes with an error of 1 m/s in both velocities
    for rule, expected_loss in {"zero": 20, "ignore": 10}.items():
        targets = detection_targets(
            [boxes],
            [categories],
            SMALL,
            TargetConfig(unknown_velocity=rule),
            velocity_known=is_known,
        )
        wrong_maps = [maps._replace(vel=maps.vel + 1) for maps in perfect_maps(targets)]

        losses = detection_losses(wrong_maps, targets, loss_config)

        loss_sum = 0.0
        for task, target in enumerate(targets):
            mean_loss = float(losses[f"task{task}.loss_bbox"])
            loss_sum += mean_loss * (float(target.mask.sum()) + 1e-4)
        assert loss_sum == pytest.approx(expected_loss, abs=1e-3)


def test_candidates_outside_the_range_or_not_finite_are_not_valid() -> None:
    code = torch.zeros(1, 10, 12, 16).split([2, 1, 3, 2, 2], dim=1)
    maps = TaskMaps(*code, torch.full((1, 1, 12, 16), -9.0))
    maps.height[0, 0, 0, 0] = 11.0  # too high
    maps.dim[0, 0, 0, 1] = 100.0  # infinitely long
    maps.reg[0, 0, 0, 2] = 80.0  # too far
    maps.heatmap[0, 0, 0, :4] = torch.tensor([4.0, 3.0, 2.0, 1.0])

    candidates = decode_candidates(maps, SMALL)

    assert candidates.valid[0, :6].tolist() == [False, False, False, True, False, False]
    torch.testing.assert_close(candidates.boxes[0, 3, :3], torch.tensor([-5.0, -6.0, 0.0]))


def random_rectangles(seed: int, count: int) -> np.ndarray:
    """Draw rows of x, y, length, width and yaw."""
    lowest, highest = (-6, -6, 0.2, 0.2, -4), (6, 6, 6, 6, 4)
    return np.random.default_rng(seed).uniform(lowest, highest, (count, 5))


def make_boxes(rectangles: np.ndarray) -> np.ndarray:
    yaw = rectangles[:, 4]
    zero = np.zeros_like(yaw)
    return np.column_stack([rectangles[:, :2], zero, rectangles[:, 2:4], zero + 1, yaw, zero, zero])


def make_polygon(rectangle: np.ndarray) -> shapely.Polygon:
    x, y, length, width, yaw = rectangle
    return shapely.affinity.rotate(
        shapely.box(x - length / 2, y - width / 2, x + length / 2, y + width / 2),
        yaw,
        use_radians=True,
    )


@given(seed=SEEDS)
@FEW_EXAMPLES
def test_rotated_iou_equals_shapelys(seed: int) -> None:
    first, second = random_rectangles(seed, 6), random_rectangles(seed + 1, 5)

    expected = np.zeros((6, 5))
    for row, column in np.ndindex(6, 5):
        polygon = make_polygon(first[row])
        other = make_polygon(second[column])
        expected[row, column] = polygon.intersection(other).area / polygon.union(other).area
    np.testing.assert_allclose(rotated_iou(first, second), expected, atol=1e-9)


@given(seed=SEEDS, threshold=st.sampled_from([0.01, 0.2, 0.5]))
@FEW_EXAMPLES
def test_kept_boxes_do_not_overlap_and_cover_the_suppressed_ones(
    seed: int, threshold: float
) -> None:
    rectangles = random_rectangles(seed, 25)
    scores = np.random.default_rng(seed).random(25)
    slots = np.zeros(25, dtype=int)

    rows = suppress(make_boxes(rectangles), scores, slots, NmsConfig(threshold=threshold))

    overlaps = rotated_iou(rectangles, rectangles) > threshold
    assert (np.diff(scores[rows]) <= 0).all()
    assert overlaps[np.ix_(rows, rows)].sum() == len(rows)
    for suppressed in set(range(25)) - set(rows.tolist()):
        covers = overlaps[suppressed, rows] & (scores[rows] >= scores[suppressed])
        assert covers.any()


@pytest.mark.parametrize("method", ["rotated", "circle"])
@given(seed=SEEDS)
@FEW_EXAMPLES
def test_suppression_depends_neither_on_the_order_nor_on_the_axes(method: Any, seed: int) -> None:
    random = np.random.default_rng(seed)
    boxes = make_boxes(random_rectangles(seed, 20))
    scores, slots = random.random(20), random.integers(0, 2, 20)
    config = NmsConfig(method=method, scale=(0.6, 1.3))

    order = random.permutation(20)
    rounded_scores = scores.round(1)  # some of them are equal
    for values in (scores, rounded_scores):
        shuffled_rows = suppress(boxes[order], values[order], slots[order], config)
        np.testing.assert_array_equal(order[shuffled_rows], suppress(boxes, values, slots, config))

    angle, moved = random.uniform(-3, 3), boxes.copy()
    moved[:, :2] = SE3.from_yaw(angle, (3.0, -40.0, 0.0)).apply(boxes[:, :3])[:, :2]
    moved[:, 6] += angle
    mirrored = boxes * [1, -1, 1, 1, 1, 1, -1, 1, -1]  # the left-handed frame
    rows = suppress(boxes, scores, slots, config)
    for changed in (moved, mirrored):
        np.testing.assert_array_equal(suppress(changed, scores, slots, config), rows)


def test_detected_boxes_stand_in_the_world() -> None:
    boxes = torch.tensor([[10.0, 2.0, 1.0, 4.0, 2.0, 1.5, 0.25, 5.0, 1.0]])
    detections = Detections(
        boxes=boxes.requires_grad_(),
        scores=torch.tensor([0.5]),
        categories=torch.tensor([3]),
    )
    pose = SE3.from_yaw(math.pi / 2, (100.0, 200.0, 3.0))
    expected = [[98.0, 210.0, 4.0, 4.0, 2.0, 1.5, 0.25 + math.pi / 2, -1.0, 5.0, 0.0]]
    for pose_value in (pose, pose.matrix, torch.from_numpy(pose.matrix.copy())):
        detected = detected_boxes(detections, pose_value)

        world = detected.boxes
        np.testing.assert_allclose(
            np.column_stack([world.center, world.size, world.yaw, world.velocity]),
            expected,
            atol=1e-6,
        )
        assert (world.frame, world.category_names) == ("world", ["cyclist"])
        assert detected.scores.tolist() == [0.5]

    no_pose = np.ones((4, 4))
    assert_raises(
        (
            lambda: detected_boxes(detections, no_pose),
            GeometryError,
            r"SE3\.matrix",
        )
    )


def decode_with(*nms: NmsConfig) -> object:
    maps = CenterHead(SMALL)(make_features(SMALL))
    return decode_detections(maps, SMALL, DecodingConfig(nms=nms))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: DetectionConfig(class_slots=((0,), ())),
            "class_slots: expected tasks with one slot or more",
        ),
        (
            lambda: DetectionConfig(class_slots=((0, 0),)),
            "class_slots: expected each category 0 to 5 at most once",
        ),
        (
            lambda: DetectionConfig(class_slots=((6,),)),
            "class_slots: expected each category 0 to 5 at most once",
        ),
        (lambda: DetectionConfig(x=(0.0, 1.0, 0.3)), "x: 0 to 1 m is not a whole number of cells"),
        (lambda: DetectionConfig(upsample=0), "upsample: expected a number from 1, found 0"),
        (
            lambda: DetectionConfig(branches="shared"),
            "branches: expected one of separate, joint, found 'shared'",
        ),
        (
            lambda: TargetConfig(min_overlap=1.0),
            "min_overlap: expected a number between 0 and 1, found 1.0",
        ),
        (lambda: TargetConfig(max_boxes=0), "max_boxes: expected a number from 1, found 0"),
        (
            lambda: TargetConfig(unknown_velocity="nan"),
            "unknown_velocity: expected one of ignore, zero, found 'nan'",
        ),
        (lambda: DetectionLossConfig(weight=-1.0), "weight: expected a number from 0, found -1.0"),
        (lambda: DecodingConfig(candidates=0), "candidates: expected a number from 1, found 0"),
        (
            lambda: DecodingConfig(center_range=(1, 1, 1, 0, 2, 2)),
            "center_range: expected the lowest x, y, z, then",
        ),
        (
            lambda: DecodingConfig(nms=()),
            "nms: expected one NmsConfig, or one per task, found none",
        ),
        (lambda: NmsConfig(method="oval"), "method: expected one of rotated, circle, found 'oval'"),
        (lambda: NmsConfig(threshold=-0.1), "threshold: expected a number from 0, found -0.1"),
        (
            lambda: NmsConfig(scale=(1.0, 0.0)),
            "scale: expected one number above 0, or one per slot",
        ),
        (lambda: NmsConfig(keep=0), "keep: expected a number from 1, found 0"),
        (
            lambda: decode_with(NmsConfig(), NmsConfig()),
            "nms: expected one NmsConfig, or 4 \\(one per task\\), found 2",
        ),
        (
            lambda: decode_with(NmsConfig(scale=(1.0, 1.0, 1.0))),
            "nms: task 0 has 1 slot, but 3 scales",
        ),
        (
            lambda: CenterHead(JOINT)(torch.zeros(1, 4, 12, 16)),
            "24 × 32 cells after upsampling by 2, expected 12 × 16",
        ),
    ],
)
def test_impossible_values_are_refused(make: Callable[[], object], sentence: str) -> None:
    assert_raises((make, DeepAccidentError, sentence))


# --- boxes that are ignored


@BOTH_BRANCHES
def test_detections_on_ignored_boxes_cost_nothing(config: DetectionConfig) -> None:
    """All other cells, and the boxes of our classes, are the same with and without them."""
    boxes, categories = random_boxes(3, 6)
    bus = torch.tensor([[1.0, -2.0, 0.0, 5.0, 3.0, 2.0, 0.6, 0.0, 0.0]])
    plain_targets = detection_targets([boxes], [categories], config)
    ignoring_targets = detection_targets(
        [torch.cat([boxes, bus])],
        [torch.cat([categories, torch.tensor([-1])])],
        config,
    )

    is_ignored = torch.zeros(config.shape, dtype=torch.bool)
    for task, ignoring_task in zip(plain_targets, ignoring_targets, strict=True):
        assert are_identical(task.box, ignoring_task.box)
        assert are_identical(task.mask, ignoring_task.mask)
        assert are_identical(task.heatmap == 1, ignoring_task.heatmap == 1)
        is_ignored |= (task.heatmap != ignoring_task.heatmap)[0].any(dim=0)
    assert 10 <= int(is_ignored.sum()) <= 20  # 15 square metres, in cells of a metre

    rows, columns = is_ignored.nonzero().T
    offsets = torch.stack([columns - 7.5, rows - 5.5], dim=1) - bus[0, :2]
    bus_from_ego = torch.tensor([[math.cos(0.6), math.sin(0.6)], [-math.sin(0.6), math.cos(0.6)]])
    assert ((offsets @ bus_from_ego.T).abs() <= torch.tensor([2.5, 1.5])).all()

    maps = CenterHead(config)(make_features(config, 1))
    confident_maps = []
    for task_maps in maps:
        heatmap = torch.where(is_ignored, task_maps.heatmap + 9, task_maps.heatmap)
        confident_maps.append(task_maps._replace(heatmap=heatmap))

    key = "task0.loss_heatmap"
    loss = detection_losses(maps, ignoring_targets)[key].item()
    confident_loss = detection_losses(confident_maps, ignoring_targets)[key].item()
    counted_loss = detection_losses(confident_maps, plain_targets)[key].item()
    assert confident_loss == pytest.approx(loss, rel=1e-5)
    assert counted_loss > 1.5 * confident_loss
