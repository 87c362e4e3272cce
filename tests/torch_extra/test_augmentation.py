"""A = flip · scale · rotation: everything that stands in an ego frame moves together."""

import itertools
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused
from torch_extra.compared import same

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

AUGMENTED = pytest.mark.parametrize(
    "augmentation",
    [
        Augmentation(rotation=0.4),
        Augmentation(flip=True),
        Augmentation(rotation=-1.1, scale=1.2, flip=True),
    ],
    ids=["turned", "mirrored", "all"],
)
augmentations = st.builds(
    Augmentation, rotation=st.floats(-3.2, 3.2), scale=st.floats(0.5, 2), flip=st.booleans()
)
LABELS = MotionLabelConfig(receptive_field=2, future_frames=2, step=1, protocol="clean")


def boxes_of(rows: torch.Tensor, margin: float = 0.0) -> Boxes:
    rows = rows.double().numpy()
    return Boxes.from_arrays(
        rows[:, :3], np.maximum(rows[:, 3:6] + margin, 0), rows[:, 6], frame="ego"
    )


@given(augmentations, st.floats(-3, 3), st.floats(0.5, 20))
def test_a_box_heads_where_it_drives(augmentation: Augmentation, yaw: float, speed: float) -> None:
    velocity = [[speed * np.cos(yaw), speed * np.sin(yaw), 0]]
    boxes = Boxes.from_arrays([[5.0, 2, 1]], [[4.0, 2, 1.5]], [yaw], frame="ego", velocity=velocity)
    [row] = augmented_boxes(boxes, augmentation)
    assert_allclose(
        row[7:], np.hypot(*row[7:]) * np.array([np.cos(row[6]), np.sin(row[6])]), atol=1e-9
    )
    assert_allclose(np.hypot(*row[7:]), speed * augmentation.scale)
    assert_allclose(row[3:6], np.array([4, 2, 1.5]) * augmentation.scale)


@given(augmentations, st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_six_vectors_are_those_of_the_augmented_poses(
    augmentation: Augmentation, six: list[float]
) -> None:
    plain = conventions.matrices_of_six(six)
    pose = augmented_pose(plain, augmentation)
    assert_allclose(
        conventions.matrices_of_six(augmented_six_vectors(six, augmentation)), pose, atol=1e-9
    )
    assert_allclose(pose @ augmentation.matrix, augmentation.matrix @ plain, atol=1e-9)


@AUGMENTED
def test_points_stay_in_their_boxes(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    plain, moved = (
        V2XDataset(da, [sample], V2XConfig(visible=None, augmentation=chosen))[0]
        for chosen in (None, augmentation)
    )
    before, after = (
        boxes_of(item["boxes"], 0.02 * scale).contains(
            item["points"][0][0][:, :3].double()
        )  # points lie on the faces
        for item, scale in ((plain, 1), (moved, augmentation.scale))
    )
    assert before.sum() > 200
    assert (before != after).sum() <= 0.001 * before.sum()
    assert_array_equal(plain["points"][0][0][:, 3], moved["points"][0][0][:, 3])


@AUGMENTED
def test_points_hit_the_pixels_that_they_hit(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    config = {"agents": "+other", "images": ImageConfig(resize=(18, 40), crop=(2, 3, 14, 30))}
    plain, moved = (
        V2XDataset(da, [sample], V2XConfig(**config, augmentation=chosen))[0]
        for chosen in (None, augmentation)
    )
    assert same(
        [plain[key] for key in ("images", "intrinsics")],
        [moved[key] for key in ("images", "intrinsics")],
    )
    for a, c in itertools.product(range(2), range(6)):
        before, after = (
            torch.nn.functional.pad(item["points"][a][0].double()[:, :3], (0, 1), value=1)
            @ item["image_from_ego"][a, 0, c].double().T
            for item in (plain, moved)
        )
        assert_allclose(before[:, 2], after[:, 2], atol=1e-3)
        pixels, again = (
            hit[before[:, 2] > 1, :2] / hit[before[:, 2] > 1, 2:3] for hit in (before, after)
        )
        inside = (pixels.abs() < 100).all(dim=1)
        assert_allclose(pixels[inside], again[inside], atol=0.01)


def placed(points: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    """(N, 3…) points in the frame that a matrix leads to."""
    return points[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]


@AUGMENTED
def test_poses_lead_between_augmented_frames(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    items = [
        V2XDataset(da, [sample], V2XConfig(agents="all", past=2, step=2, augmentation=chosen))[0]
        for chosen in (None, augmentation)
    ]
    matrix = torch.from_numpy(augmentation.matrix).float()
    assert_allclose(items[1]["augmentation"], matrix)
    for a, p in itertools.product(range(5), range(2)):
        before, after = (
            placed(item["points"][a][p][:50], item["ego_from_agent"][a, p]) for item in items
        )
        assert_allclose(placed(before, matrix), after, atol=2e-3)
    assert_allclose(
        *[placed(item["boxes"].double(), item["world_from_ego"]) for item in items], atol=1e-3
    )


@AUGMENTED
def test_egomotion_leads_between_augmented_frames(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    item = V2XDataset(
        da, [sample], V2XConfig(points=False, labels=LABELS, augmentation=augmentation)
    )[0]
    plain = motion_labels(da, sample, LABELS).future_egomotion
    assert np.abs(plain).max() > 0.1
    assert_allclose(item["future_egomotion"], augmented_six_vectors(plain, augmentation), atol=1e-5)


@AUGMENTED
def test_segmentation_targets_are_augmented(
    da: DeepAccident, sample: str, augmentation: Augmentation
) -> None:
    config = V2XConfig(points=False, bev_segmentation=BevGrid(), augmentation=augmentation)
    expected = bev_segmentation(da, sample, BevGrid(), augmentation=augmentation)
    assert_array_equal(V2XDataset(da, [sample], config)[0]["bev_segmentation"], expected.masks)


def test_draws_depend_on_seed_epoch_and_index_alone(da: DeepAccident, tokens: list[str]) -> None:
    config = {"points": False, "boxes": None, "augmentation": RandomAugmentation()}
    data = V2XDataset(da, tokens, V2XConfig(**config))
    drawn = torch.stack([item["augmentation"] for item in data])
    for epoch in (0, 1, 0):
        data.set_epoch(epoch)
        assert torch.equal(data[3]["augmentation"], drawn[3]) == (epoch == 0)
    assert not torch.equal(
        V2XDataset(da, tokens, V2XConfig(**config, seed=1))[3]["augmentation"], drawn[3]
    )


def test_random_augmentations_stay_in_their_ranges() -> None:
    draw, generator = (
        RandomAugmentation(rotation=0.2, scale=(0.9, 1.3), flip=0.25),
        np.random.default_rng(0),
    )
    drawn = np.array(
        [[one.rotation, one.scale, one.flip] for one in (draw(generator) for _ in range(2000))]
    )
    assert_allclose([drawn.min(0), drawn.max(0)], [[-0.2, 0.9, 0], [0.2, 1.3, 1]], atol=2e-3)
    assert 0.2 < drawn[:, 2].mean() < 0.3


def test_other_draws_and_epochs_are_refused(da: DeepAccident, sample: str) -> None:
    data = V2XDataset(da, [sample], V2XConfig(points=False, augmentation=lambda _: 3))
    assert_refused(
        (
            lambda: data[0],
            ConfigError,
            "augmentation: its function must return an Augmentation, and returned 3",
        ),
        *(
            (partial(data.set_epoch, epoch), ConfigError, "epoch: expected a whole number from 0")
            for epoch in (-1, 0.5, "1", None)
        ),
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
def test_random_augmentations_that_cannot_be(fields: dict[str, object], message: str) -> None:
    assert_refused((lambda: RandomAugmentation(**fields), ConfigError, message))
