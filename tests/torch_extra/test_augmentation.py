"""An augmentation moves everything in an ego frame together: A = flip · scale · rotation."""

import itertools
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises
from torch_extra.compared import are_identical
from torch_extra.items import load_item

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import BevGrid, Boxes, conventions
from deepaccident_devkit.motion import Augmentation, MotionLabelConfig, bev_segmentation
from deepaccident_devkit.motion.sample_labels import motion_labels
from deepaccident_devkit.training.torch import (
    ImageConfig,
    RandomAugmentation,
    V2XConfig,
    V2XDataset,
)
from deepaccident_devkit.training.torch.config import (
    augmented_boxes,
    augmented_pose,
    augmented_six_vectors,
)

WITH_AUGMENTATIONS = pytest.mark.parametrize(
    "augmentation",
    [
        Augmentation(rotation=0.4),
        Augmentation(flip=True),
        Augmentation(rotation=-1.1, scale=1.2, flip=True),
    ],
    ids=["turned", "mirrored", "all"],
)
AUGMENTATIONS = st.builds(
    Augmentation, rotation=st.floats(-3.2, 3.2), scale=st.floats(0.5, 2), flip=st.booleans()
)
LABELS = MotionLabelConfig(receptive_field=2, future_frames=2, step=1, protocol="clean")


def make_boxes(rows: torch.Tensor, margin_m: float = 0.0) -> Boxes:
    """Make boxes from an item's rows, each larger by the margin."""
    array = rows.double().numpy()
    return Boxes.from_arrays(
        array[:, :3],
        np.maximum(array[:, 3:6] + margin_m, 0),
        array[:, 6],
        frame="ego",
    )


def transform_points(points: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    """Move points (N, 3 or more) into the frame that a matrix (4, 4) leads to."""
    return points[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]


@given(AUGMENTATIONS, st.floats(-3, 3), st.floats(0.5, 20))
def test_a_box_heads_where_it_drives(augmentation: Augmentation, yaw: float, speed: float) -> None:
    boxes = Boxes.from_arrays(
        [[5.0, 2, 1]],
        [[4.0, 2, 1.5]],
        [yaw],
        frame="ego",
        velocity=[[speed * np.cos(yaw), speed * np.sin(yaw), 0]],
    )

    [row] = augmented_boxes(boxes, augmentation)

    heading = np.array([np.cos(row[6]), np.sin(row[6])])
    augmented_speed = np.hypot(*row[7:])
    assert_allclose(row[7:], augmented_speed * heading, atol=1e-9)
    assert_allclose(augmented_speed, speed * augmentation.scale)
    assert_allclose(row[3:6], np.array([4, 2, 1.5]) * augmentation.scale)


@given(AUGMENTATIONS, st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_augmented_six_vectors_equal_augmented_poses(
    augmentation: Augmentation, six_vector: list[float]
) -> None:
    plain_pose = conventions.matrices_of_six(six_vector)
    pose = augmented_pose(plain_pose, augmentation)
    augmented_vector = augmented_six_vectors(six_vector, augmentation)

    assert_allclose(conventions.matrices_of_six(augmented_vector), pose, atol=1e-9)
    assert_allclose(
        pose @ augmentation.matrix,
        augmentation.matrix @ plain_pose,
        atol=1e-9,
    )


@WITH_AUGMENTATIONS
def test_points_stay_in_their_boxes(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    plain = load_item(da, sample, visible=None)
    augmented = load_item(da, sample, visible=None, augmentation=augmentation)

    is_inside = []
    for item, scale in ((plain, 1), (augmented, augmentation.scale)):
        boxes = make_boxes(item["boxes"], 0.02 * scale)  # points lie on the faces
        is_inside.append(boxes.contains(item["points"][0][0][:, :3].double()))

    before, after = is_inside
    assert before.sum() > 200
    assert (before != after).sum() <= 0.001 * before.sum()
    assert_array_equal(plain["points"][0][0][:, 3], augmented["points"][0][0][:, 3])


@WITH_AUGMENTATIONS
def test_augmented_points_hit_the_same_pixels(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    images = ImageConfig(resize=(18, 40), crop=(2, 3, 14, 30))
    plain, augmented = (
        load_item(da, sample, agents="+other", images=images, augmentation=choice)
        for choice in (None, augmentation)
    )
    for key in ("images", "intrinsics"):
        assert are_identical(plain[key], augmented[key])

    for agent, camera in itertools.product(range(2), range(6)):
        before, after = (
            torch.nn.functional.pad(item["points"][agent][0].double()[:, :3], (0, 1), value=1)
            @ item["image_from_ego"][agent, 0, camera].double().T
            for item in (plain, augmented)
        )
        assert_allclose(before[:, 2], after[:, 2], atol=1e-3)

        is_ahead = before[:, 2] > 1
        pixels, augmented_pixels = (
            rays[is_ahead, :2] / rays[is_ahead, 2:3] for rays in (before, after)
        )
        is_near = (pixels.abs() < 100).all(dim=1)
        assert_allclose(pixels[is_near], augmented_pixels[is_near], atol=0.01)


@WITH_AUGMENTATIONS
def test_poses_lead_between_augmented_frames(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    items = [
        load_item(da, sample, agents="all", past=2, step=2, augmentation=choice)
        for choice in (None, augmentation)
    ]
    matrix = torch.from_numpy(augmentation.matrix).float()
    assert_allclose(items[1]["augmentation"], matrix)

    for agent, frame in itertools.product(range(5), range(2)):
        before, after = (
            transform_points(
                item["points"][agent][frame][:50], item["ego_from_agent"][agent, frame]
            )
            for item in items
        )
        assert_allclose(transform_points(before, matrix), after, atol=2e-3)

    before, after = (
        transform_points(item["boxes"].double(), item["world_from_ego"]) for item in items
    )
    assert_allclose(before, after, atol=1e-3)


@WITH_AUGMENTATIONS
def test_egomotion_leads_between_augmented_frames(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    item = load_item(da, sample, points=False, labels=LABELS, augmentation=augmentation)
    plain = motion_labels(da, sample, LABELS).future_egomotion
    assert np.abs(plain).max() > 0.1
    assert_allclose(
        item["future_egomotion"],
        augmented_six_vectors(plain, augmentation),
        atol=1e-5,
    )


@WITH_AUGMENTATIONS
def test_segmentation_targets_are_augmented(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    grid = BevGrid()
    item = load_item(
        da,
        sample,
        points=False,
        bev_segmentation=grid,
        augmentation=augmentation,
    )
    expected = bev_segmentation(da, sample, grid, augmentation=augmentation)
    assert_array_equal(item["bev_segmentation"], expected.masks)


def test_draws_depend_only_on_seed_epoch_and_index(da: DeepAccident, tokens: list[str]) -> None:
    options = {
        "points": False,
        "boxes": None,
        "augmentation": RandomAugmentation(),
    }
    data = V2XDataset(da, tokens, V2XConfig(**options))
    matrices = torch.stack([item["augmentation"] for item in data])

    for epoch in (0, 1, 0):
        data.set_epoch(epoch)
        assert torch.equal(data[3]["augmentation"], matrices[3]) == (epoch == 0)

    other_seed = V2XDataset(da, tokens, V2XConfig(**options, seed=1))
    assert not torch.equal(other_seed[3]["augmentation"], matrices[3])


def test_random_augmentations_stay_in_their_ranges() -> None:
    draw = RandomAugmentation(rotation=0.2, scale=(0.9, 1.3), flip=0.25)
    generator = np.random.default_rng(0)

    draws = [draw(generator) for _ in range(2000)]

    values = np.array([[drawn.rotation, drawn.scale, drawn.flip] for drawn in draws])
    assert_allclose(
        [values.min(0), values.max(0)],
        [[-0.2, 0.9, 0], [0.2, 1.3, 1]],
        atol=2e-3,
    )
    assert 0.2 < values[:, 2].mean() < 0.3


def test_other_draws_and_epochs_are_refused(da: DeepAccident, sample: str) -> None:
    data = V2XDataset(da, [sample], V2XConfig(points=False, augmentation=lambda _: 3))
    assert_raises(
        (
            lambda: data[0],
            ConfigError,
            "augmentation: the function must return an Augmentation, but returned 3",
        )
    )

    for epoch in (-1, 0.5, "1", None):
        assert_raises(
            (partial(data.set_epoch, epoch), ConfigError, "epoch: expected a whole number from 0")
        )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"rotation": -1}, "rotation is -1"),
        ({"rotation": "x"}, "rotation: expected radians, found 'x'"),
        ({"scale": (1.1, 0.9)}, "scale is"),
        ({"scale": 1.1}, r"scale is 1\.1"),
        ({"flip": 2}, "flip is 2"),
        ({"flip": None}, "flip: expected a probability, found None"),
    ],
)
def test_impossible_random_augmentations_are_refused(
    fields: dict[str, object], message: str
) -> None:
    assert_raises((lambda: RandomAugmentation(**fields), ConfigError, message))
