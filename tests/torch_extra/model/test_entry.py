"""The model's inputs: their handedness, frames that did not arrive, and egomotion."""

from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close
from torch_extra.compared import are_identical

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

NUM_FRAMES = 3
"""Three frames, so that a frame can be missing between two others."""
AUGMENTATION = Augmentation(rotation=0.3, scale=1.04, flip=True)


@pytest.fixture(scope="module")
def item_config(config: ModelConfig) -> V2XConfig:
    return V2XConfig(
        agents="all",
        past=NUM_FRAMES,
        step=1,
        images=config.cameras.images,
        labels=replace(config.labels, receptive_field=NUM_FRAMES),
    )


@pytest.fixture(scope="module", params=[Augmentation(), AUGMENTATION], ids=["plain", "augmented"])
def batch(
    request: pytest.FixtureRequest, da: DeepAccident, moment: list[str], item_config: V2XConfig
) -> dict[str, Any]:
    config = replace(item_config, augmentation=request.param)
    return collate([V2XDataset(da, moment[1:2], config)[0]])


def points_at_pixel(inputs: ModelInputs) -> torch.Tensor:
    """Return the points that all cameras see at one pixel, in the frame of each agent."""
    cameras = inputs.cameras
    camera_points = torch.linalg.inv(cameras.intrinsics) @ torch.tensor([120.0, 70.0, 8.0])
    return (cameras.rotation @ camera_points[..., None])[..., 0] + cameras.translation


def test_a_left_handed_model_sees_mirrored_inputs(batch: dict[str, Any]) -> None:
    # cars of the release drive straight on, so that a turn is added to their motion
    turn = matrices_from_six(torch.tensor([0.1, 0.3, 0.02, 0.01, 0.02, 0.2]))
    turn = batch["augmentation"] @ turn @ torch.linalg.inv(batch["augmentation"])
    agent_from_past = batch["agent_from_past"].clone()
    agent_from_past[:, :, 0] = turn @ agent_from_past[:, :, 0]
    batch = batch | {"agent_from_past": agent_from_past}

    right, left = model_inputs(batch), model_inputs(batch, "left")

    for name, flip in {
        "ego_from_agent": flip_pose,
        "bev_transform": flip_pose,
        "egomotion": flip_six_vector,
    }.items():
        values = getattr(right, name).numpy()
        mirrored = flip(values)
        np.testing.assert_allclose(getattr(left, name).numpy(), mirrored, atol=1e-5)
        assert name == "bev_transform" or np.abs(mirrored - values).max() > 1e-3

    np.testing.assert_allclose(
        points_at_pixel(left).numpy(), flip_points(points_at_pixel(right).numpy()), atol=1e-4
    )
    np.testing.assert_array_equal(
        left.points[:, :3].numpy(), flip_points(right.points[:, :3].numpy())
    )
    select_unchanged = attrgetter(
        "images",
        "point_frames",
        "frame_valid",
        "ego_rows",
        "partners",
        "is_infrastructure",
        "delay",
        "cameras.intrinsics",
    )
    assert are_identical(select_unchanged(left), select_unchanged(right))


def test_a_right_handed_model_sees_the_batch_as_it_is(batch: dict[str, Any]) -> None:
    inputs = model_inputs(batch)

    cameras, ego_from_camera = inputs.cameras, batch["ego_from_camera"]
    for values, expected in (
        (inputs.images, batch["images"]),
        (inputs.bev_transform, batch["augmentation"]),
        (cameras.rotation, ego_from_camera[..., :3, :3]),
        (cameras.translation, ego_from_camera[..., :3, 3]),
        (cameras.intrinsics, batch["intrinsics"]),
    ):
        assert are_identical(values, expected)
    assert_close(inputs.ego_from_agent, batch["ego_from_agent"][:, :, -1])
    assert (inputs.ego_rows.tolist(), inputs.partners.tolist()) == (
        [[0, 0]],
        [[True] * 5],
    )
    is_infrastructure = [name == "infrastructure" for name in batch["agents"][0]]
    assert inputs.is_infrastructure[0].tolist() == is_infrastructure


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
    da: DeepAccident, moment: list[str], item_config: V2XConfig, batch: dict[str, Any]
) -> None:
    config = replace(item_config, images=None)

    egomotion = model_inputs(batch).egomotion

    assert not egomotion[:, :, -1].any()
    for column, name in enumerate(batch["agents"][0]):
        [item] = V2XDataset(da, [token for token in moment if f"/{name}/" in token], config)
        assert_close(
            egomotion[0, column, :-1],
            item["future_egomotion"][: NUM_FRAMES - 1],
            atol=1e-4,
            rtol=0,
        )
    assert egomotion[:, :, :-1, 0].abs().max() > 0.1  # an agent drives


@pytest.mark.parametrize(
    ("has_arrived", "is_valid"),
    [
        ([True, True, True], [True, True, True]),
        ([True, False, True], [False, False, True]),
        ([False, True, True], [False, True, True]),
        ([False, False, True], [False, False, True]),
        ([True, True, False], [False, False, False]),
    ],
)
def test_a_frame_that_did_not_arrive_is_the_present(
    batch: dict[str, Any], has_arrived: list[bool], is_valid: list[bool]
) -> None:
    """Frames before a gap are lost too; an agent without its present frame is no partner."""
    agent_valid = batch["agent_valid"].clone()
    agent_valid[0, 2] = torch.tensor(has_arrived)

    complete = model_inputs(batch)
    inputs = model_inputs(batch | {"agent_valid": agent_valid})

    all_frames = [True] * NUM_FRAMES
    assert inputs.frame_valid.tolist() == [
        [all_frames, all_frames, is_valid, all_frames, all_frames]
    ]
    assert inputs.partners.tolist() == [[True, True, has_arrived[-1], True, True]]

    frames = torch.arange(NUM_FRAMES).repeat(5, 1)
    frames[2, ~torch.tensor(is_valid)] = NUM_FRAMES - 1
    agents = torch.arange(5)[:, None]
    for select in map(attrgetter, ("images", "cameras.rotation", "cameras.intrinsics")):
        assert are_identical(select(inputs), select(complete)[0][agents, frames][None])
    assert torch.equal(inputs.egomotion, complete.egomotion * inputs.frame_valid[..., None])


def test_each_ego_has_its_own_poses_of_the_agents(
    da: DeepAccident, moment: list[str], item_config: V2XConfig
) -> None:
    egos = moment[1:4]
    [item] = AllEgosDataset(da, egos, replace(item_config, agents="+other"))

    inputs = model_inputs(collate_all_egos([item]))

    scenario, _, frame = moment[0].rsplit("/", 2)
    agents = [f"{scenario}/{name}/{frame}" for name in item["agents"]]
    assert [agents[column] for column in inputs.ego_rows[:, 1].tolist()] == egos
    expected = [[da.transform(ego, agent).matrix for agent in agents] for ego in egos]
    np.testing.assert_allclose(inputs.ego_from_agent, expected, atol=1e-4)
    assert inputs.partners[torch.arange(3), inputs.ego_rows[:, 1]].all()
