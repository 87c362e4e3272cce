"""The model's door: its frame, frames that did not arrive, and egomotion."""

from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close
from torch_extra.compared import same

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry.conventions import (
    flip_points,
    flip_pose,
    flip_six_vector,
    flip_vectors2,
    flip_yaw,
)
from deepaccident_devkit.motion import Augmentation
from deepaccident_devkit.plugins.model.inputs import ModelInputs, mirrored_boxes, model_inputs
from deepaccident_devkit.plugins.model.network import ModelConfig
from deepaccident_devkit.plugins.model.warps import matrices_from_six
from deepaccident_devkit.training.torch import (
    AllEgosDataset,
    V2XConfig,
    V2XDataset,
    collate,
    collate_all_egos,
)

PAST = 3
TURNED = Augmentation(rotation=0.3, scale=1.04, flip=True)


@pytest.fixture(scope="module")
def given(config: ModelConfig) -> V2XConfig:
    """Three frames, so that there may be a gap."""
    labels = replace(config.labels, receptive_field=PAST)
    return V2XConfig(agents="all", past=PAST, step=1, images=config.cameras.images, labels=labels)


@pytest.fixture(scope="module", params=[Augmentation(), TURNED], ids=["plain", "augmented"])
def batch(
    request: pytest.FixtureRequest, da: DeepAccident, moment: list[str], given: V2XConfig
) -> dict[str, Any]:
    """Of one item; with an augmentation, too."""
    return collate([V2XDataset(da, moment[1:2], replace(given, augmentation=request.param))[0]])


def points(inputs: ModelInputs) -> torch.Tensor:
    """What cameras see in the middle of a pixel, in each agent's frame."""
    cameras = inputs.cameras
    seen = torch.linalg.inv(cameras.intrinsics) @ torch.tensor([120.0, 70.0, 8.0])
    return (cameras.rotation @ seen[..., None])[..., 0] + cameras.translation


def test_a_left_handed_model_sees_all_in_the_mirror(batch: dict[str, Any]) -> None:
    """Against the functions of the devkit's one place of signs."""
    bend = matrices_from_six(
        torch.tensor([0.1, 0.3, 0.02, 0.01, 0.02, 0.2])
    )  # cars of the release drive straight on
    augmented = batch["augmentation"] @ bend @ torch.linalg.inv(batch["augmentation"])
    bent = batch | {"agent_from_past": batch["agent_from_past"].clone()}
    bent["agent_from_past"][:, :, 0] = augmented @ bent["agent_from_past"][:, :, 0]
    right, left = model_inputs(bent), model_inputs(bent, "left")
    for name, flip in {
        "ego_from_agent": flip_pose,
        "bev_transform": flip_pose,
        "egomotion": flip_six_vector,
    }.items():
        mirrored = flip(getattr(right, name).numpy())
        np.testing.assert_allclose(getattr(left, name).numpy(), mirrored, atol=1e-5)
        assert (
            name == "bev_transform" or np.abs(mirrored - getattr(right, name).numpy()).max() > 1e-3
        )
    np.testing.assert_allclose(points(left).numpy(), flip_points(points(right).numpy()), atol=1e-4)
    np.testing.assert_array_equal(
        left.points[:, :3].numpy(), flip_points(right.points[:, :3].numpy())
    )
    unchanged = attrgetter(
        "images",
        "point_frames",
        "frame_valid",
        "ego_rows",
        "partners",
        "is_infrastructure",
        "delay",
        "cameras.intrinsics",
    )
    assert same(unchanged(left), unchanged(right))


def test_a_right_handed_model_sees_the_batch_as_it_is(batch: dict[str, Any]) -> None:
    inputs, cameras = model_inputs(batch), batch["ego_from_camera"]
    found = attrgetter(
        "images", "bev_transform", "cameras.rotation", "cameras.translation", "cameras.intrinsics"
    )
    poses = (cameras[..., :3, :3], cameras[..., :3, 3])
    assert same(
        found(inputs), (batch["images"], batch["augmentation"], *poses, batch["intrinsics"])
    )
    assert_close(inputs.ego_from_agent, batch["ego_from_agent"][:, :, -1])
    assert (inputs.ego_rows.tolist(), inputs.partners.tolist()) == ([[0, 0]], [[True] * 5])
    assert [name == "infrastructure" for name in batch["agents"][0]] == inputs.is_infrastructure[
        0
    ].tolist()


def test_boxes_are_mirrored_as_the_devkit_does() -> None:
    boxes = torch.randn(6, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert mirrored_boxes(boxes, "right") is boxes
    left = mirrored_boxes(boxes, "left")
    columns = (
        flip_points(boxes[:, :3]),
        boxes[:, 3:6],
        flip_yaw(boxes[:, 6]),
        flip_vectors2(boxes[:, 7:]),
    )
    np.testing.assert_array_equal(left.numpy(), np.column_stack(columns))
    assert torch.equal(mirrored_boxes(left, "left"), boxes)


def test_egomotion_is_that_of_the_labels_without_the_augmentation(
    da: DeepAccident, moment: list[str], given: V2XConfig, batch: dict[str, Any]
) -> None:
    """Each agent's own, against the labels of a sample of that agent."""
    rows = model_inputs(batch).egomotion
    assert not rows[:, :, -1].any()
    for column, name in enumerate(batch["agents"][0]):
        [item] = V2XDataset(
            da, [each for each in moment if f"/{name}/" in each], replace(given, images=None)
        )
        assert_close(rows[0, column, :-1], item["future_egomotion"][: PAST - 1], atol=1e-4, rtol=0)
    assert rows[:, :, :-1, 0].abs().max() > 0.1  # somebody drives


@pytest.mark.parametrize(
    ("arrived", "valid"),
    [
        ([True, True, True], [True, True, True]),
        ([True, False, True], [False, False, True]),
        ([False, True, True], [False, True, True]),
        ([False, False, True], [False, False, True]),
        ([True, True, False], [False, False, False]),
    ],
)
def test_a_frame_that_did_not_arrive_is_the_present(
    batch: dict[str, Any], arrived: list[bool], valid: list[bool]
) -> None:
    """What lies before a gap cannot be joined, and so is lost too; without a present, the agent is
    no partner.
    """
    changed = batch | {"agent_valid": batch["agent_valid"].clone()}
    changed["agent_valid"][0, 2] = torch.tensor(arrived)
    whole, inputs = model_inputs(batch), model_inputs(changed)
    every = [True] * PAST
    assert inputs.frame_valid.tolist() == [[every, every, valid, every, every]]
    assert inputs.partners.tolist() == [[True, True, arrived[-1], True, True]]
    source = torch.arange(PAST).repeat(5, 1)
    source[2] = torch.tensor([frame if there else PAST - 1 for frame, there in enumerate(valid)])
    sent = torch.arange(5)[:, None], source
    found = attrgetter("images", "cameras.rotation", "cameras.intrinsics")
    assert same(found(inputs), tuple(each[0][sent][None] for each in found(whole)))
    assert torch.equal(inputs.egomotion, whole.egomotion * inputs.frame_valid[..., None])


def test_egos_have_their_own_places(da: DeepAccident, moment: list[str], given: V2XConfig) -> None:
    """Poses of each ego, whichever agent's frame the moment is given in."""
    [item] = AllEgosDataset(da, moment[1:4], replace(given, agents="+other"))
    inputs = model_inputs(collate_all_egos([item]))
    agents = [next(each for each in moment if f"/{name}/" in each) for name in item["agents"]]
    assert [agents[column] for column in inputs.ego_rows[:, 1].tolist()] == moment[1:4]
    expected = [[da.transform(ego, agent).matrix for agent in agents] for ego in moment[1:4]]
    np.testing.assert_allclose(inputs.ego_from_agent, expected, atol=1e-4)
    assert inputs.partners[torch.arange(3), inputs.ego_rows[:, 1]].all()
