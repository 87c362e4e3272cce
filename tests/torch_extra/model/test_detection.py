"""The detection head's own laws: targets, losses, decoding and suppression."""

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
from refusals import assert_refused
from torch import Tensor
from torch_extra.compared import same
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
HEADS = pytest.mark.parametrize("config", [SMALL, JOINT], ids=["separate", "joint"])
BUILT = settings(max_examples=20)


def features_of(config: DetectionConfig, samples: int = 2) -> Tensor:
    rows, columns = (count // config.upsample for count in config.shape)
    return torch.randn(
        samples, config.in_channels, rows, columns, generator=torch.Generator().manual_seed(0)
    )


def random_boxes(seed: int, count: int) -> tuple[Tensor, Tensor]:
    """Boxes in cells of their own, and categories."""
    random = np.random.default_rng(seed)
    cell = random.choice(16 * 12, count, replace=False)
    place = np.stack([cell % 16 - 8, cell // 16 - 6], axis=1) + random.uniform(
        0.01, 0.99, (count, 2)
    )
    size = random.uniform(0.5, 6.0, (count, 3))
    others = np.column_stack(
        [random.uniform(-3.0, 3.0, (count, 1)), size, random.uniform(-3.1, 3.1, (count, 1))]
    )
    rows = np.column_stack([place, others, random.uniform(-20.0, 20.0, (count, 2))])
    return torch.from_numpy(rows).float(), torch.from_numpy(random.integers(0, 6, count))


@HEADS
def test_gradients_reach_every_parameter(config: DetectionConfig) -> None:
    head = CenterHead(config)
    boxes, categories = zip(*(random_boxes(seed, 20) for seed in (1, 2)), strict=True)
    losses = detection_losses(
        head(features_of(config)), detection_targets(boxes, categories, config)
    )
    torch.stack(list(losses.values())).sum().backward()
    assert all(
        weight.grad is not None and bool(weight.grad.abs().sum() > 0)
        for weight in head.parameters()
    )


@pytest.mark.parametrize(
    "head", [SMALL, replace(SMALL, class_slots=ONE_TASK)], ids=["tasks", "one task"]
)
@given(seed=SEEDS, count=st.integers(0, 30))
@BUILT
def test_perfect_maps_give_the_boxes_back(head: DetectionConfig, seed: int, count: int) -> None:
    boxes, categories = random_boxes(seed, count)
    no_suppression = DecodingConfig(nms=(NmsConfig(threshold=1.0),))
    (found,) = decode_detections(
        perfect_maps(detection_targets([boxes], [categories], head)), head, no_suppression
    )
    ours, truth = found.boxes[:, 0].argsort(), boxes[:, 0].argsort()
    torch.testing.assert_close(found.boxes[ours], boxes[truth], rtol=0, atol=1e-4)
    assert torch.equal(found.categories[ours], categories[truth])


@given(seed=SEEDS)
@BUILT
def test_targets_do_not_depend_on_the_other_samples(seed: int) -> None:
    samples = random_boxes(seed, 20), random_boxes(seed, 0), random_boxes(seed + 1, 9)
    together = detection_targets(*zip(*samples, strict=True), SMALL)
    for number, (boxes, categories) in enumerate(samples):
        alone = detection_targets([boxes], [categories], SMALL)
        assert same([[each[number : number + 1] for each in task] for task in together], alone)


def test_boxes_outside_or_of_no_category_are_left_out() -> None:
    boxes = torch.tensor([[0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0, 0.0, 0.0]]).repeat(6, 1)
    boxes[1, 0], boxes[2, 1], boxes[3, 4] = (
        -8.9,
        6.01,
        0.0,
    )  # in the folded first column; beyond the last row; no width
    categories = torch.tensor([0, 0, 0, 0, -1, 5])
    cars, *_ = detection_targets([boxes], [categories], replace(SMALL, class_slots=((0,), (1, 2))))
    assert cars.cell_index[cars.mask].tolist() == [6 * 16 + 8, 6 * 16]
    assert cars.box[0, 1, 0] == pytest.approx(-0.9, abs=1e-5)


def test_unknown_velocities_are_trained_to_zero_or_not_at_all() -> None:
    boxes, categories = random_boxes(7, 10)
    boxes[:4, 7:] = torch.nan
    known = [torch.arange(10) > 4]  # and one more, which is finite
    for rule, loss in {"zero": 20, "ignore": 10}.items():  # ten boxes, off by 1 in vx and vy
        config = TargetConfig(unknown_velocity=rule)
        targets = detection_targets([boxes], [categories], SMALL, config, velocity_known=known)
        wrong = [task._replace(vel=task.vel + 1) for task in perfect_maps(targets)]
        found = detection_losses(wrong, targets, DetectionLossConfig(weight=1.0, box_weight=1.0))
        counts = [float(target.mask.sum()) + 1e-4 for target in targets]
        losses = [
            float(found[f"task{task}.loss_bbox"]) * count for task, count in enumerate(counts)
        ]
        assert sum(losses) == pytest.approx(loss, abs=1e-3)


def test_candidates_outside_the_range_or_not_finite_are_not_valid() -> None:
    """The first is too high, the second of infinite length, and the third too far."""
    maps = blank_maps()
    maps.height[0, 0, 0, 0], maps.dim[0, 0, 0, 1], maps.reg[0, 0, 0, 2] = 11.0, 100.0, 80.0
    maps.heatmap[0, 0, 0, :4] = torch.tensor([4.0, 3.0, 2.0, 1.0])
    found = decode_candidates(maps, SMALL)
    assert found.valid[0, :6].tolist() == [False, False, False, True, False, False]
    torch.testing.assert_close(found.boxes[0, 3, :3], torch.tensor([-5.0, -6.0, 0.0]))


def blank_maps(samples: int = 1, slots: int = 1) -> TaskMaps:
    """Maps that say nothing, nowhere."""
    code = torch.zeros(samples, 10, 12, 16).split([2, 1, 3, 2, 2], dim=1)
    return TaskMaps(*code, torch.full((samples, slots, 12, 16), -9.0))


def rectangles(seed: int, count: int) -> np.ndarray:
    """Rows of x, y, length, width and yaw."""
    return np.random.default_rng(seed).uniform((-6, -6, 0.2, 0.2, -4), (6, 6, 6, 6, 4), (count, 5))


def as_boxes(rectangle: np.ndarray) -> np.ndarray:
    place, size, yaw = rectangle[:, :2], rectangle[:, 2:4], rectangle[:, 4]
    zero = np.zeros_like(yaw)
    return np.column_stack([place, zero, size, zero + 1, yaw, zero, zero])


def polygon(rectangle: np.ndarray) -> shapely.Polygon:
    x, y, length, width, yaw = rectangle
    upright = shapely.box(x - length / 2, y - width / 2, x + length / 2, y + width / 2)
    return shapely.affinity.rotate(upright, yaw, use_radians=True)


@given(seed=SEEDS)
@BUILT
def test_rotated_iou_is_shapely_s(seed: int) -> None:
    first, second = rectangles(seed, 6), rectangles(seed + 1, 5)
    pairs = [[(polygon(a), polygon(b)) for b in second] for a in first]
    expected = [[a.intersection(b).area / a.union(b).area for a, b in row] for row in pairs]
    np.testing.assert_allclose(rotated_iou(first, second), expected, atol=1e-9)


@given(seed=SEEDS, threshold=st.sampled_from([0.01, 0.2, 0.5]))
@BUILT
def test_kept_boxes_do_not_overlap_and_cover_those_that_went(seed: int, threshold: float) -> None:
    flat = rectangles(seed, 25)
    scores = np.random.default_rng(seed).random(25)
    kept = suppress(as_boxes(flat), scores, np.zeros(25, dtype=int), NmsConfig(threshold=threshold))
    over = rotated_iou(flat, flat) > threshold
    assert (np.diff(scores[kept]) <= 0).all()
    assert over[np.ix_(kept, kept)].sum() == len(kept)
    for gone in set(range(25)) - set(kept.tolist()):
        assert any(over[gone, better] and scores[better] >= scores[gone] for better in kept)


@pytest.mark.parametrize("method", ["rotated", "circle"])
@given(seed=SEEDS)
@BUILT
def test_suppression_depends_neither_on_the_order_nor_on_the_axes(method: Any, seed: int) -> None:
    random = np.random.default_rng(seed)
    boxes, scores, slots = (
        as_boxes(rectangles(seed, 20)),
        random.random(20),
        random.integers(0, 2, 20),
    )
    rules = NmsConfig(method=method, scale=(0.6, 1.3))
    kept = suppress(boxes, scores, slots, rules)
    order = random.permutation(20)
    for some in (scores, scores.round(1)):  # equal ones too
        mixed = order[suppress(boxes[order], some[order], slots[order], rules)]
        np.testing.assert_array_equal(mixed, suppress(boxes, some, slots, rules))
    angle, moved = random.uniform(-3, 3), boxes.copy()
    moved[:, :2] = SE3.from_yaw(angle, (3.0, -40.0, 0.0)).apply(boxes[:, :3])[:, :2]
    moved[:, 6] += angle
    mirrored = boxes * [1, -1, 1, 1, 1, 1, -1, 1, -1]  # the left-handed frame
    for elsewhere in (moved, mirrored):
        np.testing.assert_array_equal(suppress(elsewhere, scores, slots, rules), kept)


def test_detected_boxes_stand_in_the_world() -> None:
    boxes = torch.tensor([[10.0, 2.0, 1.0, 4.0, 2.0, 1.5, 0.25, 5.0, 1.0]])
    found = Detections(
        boxes=boxes.requires_grad_(), scores=torch.tensor([0.5]), categories=torch.tensor([3])
    )
    pose = SE3.from_yaw(math.pi / 2, (100.0, 200.0, 3.0))
    expected = [[98.0, 210.0, 4.0, 4.0, 2.0, 1.5, 0.25 + math.pi / 2, -1.0, 5.0, 0.0]]
    for given_pose in (pose, pose.matrix, torch.from_numpy(pose.matrix.copy())):
        world = detected_boxes(found, given_pose)
        rows = np.column_stack(
            [world.boxes.center, world.boxes.size, world.boxes.yaw, world.boxes.velocity]
        )
        np.testing.assert_allclose(rows, expected, atol=1e-6)
        assert (world.boxes.frame, world.boxes.category_names, world.scores.tolist()) == (
            "world",
            ["cyclist"],
            [0.5],
        )
    assert_refused((lambda: detected_boxes(found, np.ones((4, 4))), GeometryError, r"SE3\.matrix"))


def suppressed_by(*nms: NmsConfig) -> object:
    return decode_detections(CenterHead(SMALL)(features_of(SMALL)), SMALL, DecodingConfig(nms=nms))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (
            lambda: DetectionConfig(class_slots=((0,), ())),
            "class_slots: expected tasks of one slot or more",
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
            "center_range: expected least x, y, z, then",
        ),
        (lambda: DecodingConfig(nms=()), "nms: expected one NmsConfig, or one a task, found none"),
        (lambda: NmsConfig(method="oval"), "method: expected one of rotated, circle, found 'oval'"),
        (lambda: NmsConfig(threshold=-0.1), "threshold: expected a number from 0, found -0.1"),
        (lambda: NmsConfig(scale=(1.0, 0.0)), "scale: expected one number above 0, or one a slot"),
        (lambda: NmsConfig(keep=0), "keep: expected a number from 1, found 0"),
        (
            lambda: suppressed_by(NmsConfig(), NmsConfig()),
            "nms: expected one NmsConfig, or 4, one a task; found 2",
        ),
        (
            lambda: suppressed_by(NmsConfig(scale=(1.0, 1.0, 1.0))),
            "nms: task 0 has 1 slots, found 3 scales",
        ),
        (
            lambda: CenterHead(JOINT)(torch.zeros(1, 4, 12, 16)),
            "24 × 32 cells after upsampling by 2, expected 12 × 16",
        ),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], object], sentence: str) -> None:
    assert_refused((make, DeepAccidentError, sentence))


# --- boxes that are ignored


@HEADS
def test_what_is_found_on_ignored_boxes_is_not_wrong(config: DetectionConfig) -> None:
    """Their cells cost nothing; all others, and all boxes of our classes, are as without them."""
    boxes, categories = random_boxes(3, 6)
    bus = torch.tensor([[1.0, -2.0, 0.0, 5.0, 3.0, 2.0, 0.6, 0.0, 0.0]])
    plain = detection_targets([boxes], [categories], config)
    ignoring = detection_targets(
        [torch.cat([boxes, bus])], [torch.cat([categories, torch.tensor([-1])])], config
    )
    maps = CenterHead(config)(features_of(config, 1))
    covered = torch.zeros(config.shape, dtype=torch.bool)
    for task, other in zip(plain, ignoring, strict=True):
        assert same(task.box, other.box)
        assert same(task.mask, other.mask)
        assert same(task.heatmap == 1, other.heatmap == 1)
        covered |= (task.heatmap != other.heatmap)[0].any(dim=0)
    assert 10 <= int(covered.sum()) <= 20  # 15 square metres, in cells of a metre
    rows, columns = covered.nonzero().T
    place = torch.stack([columns - 7.5, rows - 5.5], dim=1) - bus[0, :2]
    turn = torch.tensor([[math.cos(0.6), math.sin(0.6)], [-math.sin(0.6), math.cos(0.6)]])
    assert ((place @ turn.T).abs() <= torch.tensor([2.5, 1.5])).all()
    shouting = [
        one._replace(heatmap=torch.where(covered, one.heatmap + 9, one.heatmap)) for one in maps
    ]
    quiet, loud, counted = (
        detection_losses(given, wanted)["task0.loss_heatmap"].item()
        for given, wanted in ((maps, ignoring), (shouting, ignoring), (shouting, plain))
    )
    assert loud == pytest.approx(quiet, rel=1e-5)
    assert counted > 1.5 * loud
