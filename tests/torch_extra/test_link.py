"""A link delays, misplaces and loses the data of partners, and leaves the truth as it is."""

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises
from torch_extra.compared import are_identical
from torch_extra.items import load_item

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.training.torch import (
    ImageConfig,
    RandomAugmentation,
    V2XConfig,
    V2XDataset,
    collate_fusion,
)
from deepaccident_devkit.v2x import Link

LABELS = MotionLabelConfig(receptive_field=2, future_frames=2, step=1)


def test_late_data_are_an_earlier_frames(da: DeepAccident, sample: str) -> None:
    item = load_item(
        da, sample, agents="all", link=Link(latency=0.2), images=ImageConfig(dtype="uint8")
    )

    for row, name in enumerate(item["agents"]):
        frame = 4 if row == 0 else 2
        sent = da.get_sample(da.scenario[0], name, frame)
        cloud = da.load_point_cloud(sent, "ego")
        assert_allclose(item["points"][row][0][:, :3], cloud.xyz, atol=1e-4)
        assert_allclose(
            item["ego_from_agent"][row, 0], da.transform(sample, sent).matrix, atol=1e-4
        )
        assert_array_equal(
            item["images"][row, 0, 3].permute(1, 2, 0),
            da.load_image(f"{sent['token']}/Camera_Back"),
        )


def test_pose_noise_does_not_reach_a_senders_own_motion(da: DeepAccident, sample: str) -> None:
    """Partners' data arrive one frame late, so that their own motion ends a frame earlier."""
    item = load_item(
        da,
        sample,
        agents="all",
        past=2,
        step=2,
        link=Link(latency=0.1, pose_noise=1.0, seed=2),
        points=False,
    )

    for row, name in enumerate(item["agents"]):
        delay = 0 if row == 0 else 1
        last, before = (da.get_sample(da.scenario[0], name, frame - delay) for frame in (4, 2))
        assert_allclose(
            item["agent_from_past"][row], [da.transform(last, before).matrix, np.eye(4)], atol=1e-4
        )


def test_points_lie_where_the_ego_places_them(da: DeepAccident, sample: str) -> None:
    """All agents' points in the ego frame are the devkit's own aggregated cloud."""
    link = Link(latency=0.1, pose_noise=0.5, seed=2)
    item = load_item(da, sample, agents="all", link=link, augmentation=RandomAugmentation())

    batch = collate_fusion([item])

    poses = batch["pairwise_t_matrix"][0, :, 0].double()
    clouds = [
        frames[-1][:, :3].double() @ pose[:3, :3].T + pose[:3, 3]
        for frames, pose in zip(batch["points"], poses, strict=True)
    ]
    points = da.aggregate_point_cloud(sample, agents=item["agents"], link=link, frame="ego").xyz
    assert_allclose(
        torch.cat(clouds),
        points @ item["augmentation"].double().numpy()[:3, :3].T,
        atol=5e-3,
    )


def test_a_lost_message_leaves_nothing(da: DeepAccident, sample: str) -> None:
    link = Link(packet_loss=0.5, seed=1)
    item = load_item(
        da,
        sample,
        agents="all",
        link=link,
        past=2,
        step=1,
        images=ImageConfig(),
    )

    scenario = da.scenario[0]["token"]
    arrived = [
        [row == 0 or not link.loses(scenario, name, frame) for frame in (3, 4)]
        for row, name in enumerate(item["agents"])
    ]
    assert item["agent_valid"].tolist() == arrived
    assert {frames[-1] for frames in arrived} == {True, False}

    is_lost = ~item["agent_valid"]
    assert not item["images"][is_lost].any()
    for agent, frame in is_lost.nonzero().tolist():
        assert len(item["points"][agent][frame]) == 0
    poses = item["ego_from_agent"][is_lost]
    assert_array_equal(poses, np.broadcast_to(np.eye(4), poses.shape))


def test_boxes_and_labels_stay_the_truth(da: DeepAccident, sample: str) -> None:
    late_link = Link(latency=0.2, pose_noise=1.0, packet_loss=0.9)
    fields = {
        "agents": "all",
        "points": False,
        "labels": LABELS,
        "boxes": "cooperative",
    }
    plain, late = (load_item(da, sample, **fields, link=link) for link in (None, late_link))
    for key in ("boxes", "actor_ids", "instance", "flow", "future_egomotion"):
        assert are_identical(plain[key], late[key])


def test_samples_before_the_first_data_are_refused_at_once(da: DeepAccident) -> None:
    scenario = da.scenario[0]["token"]
    tokens = [f"{scenario}/ego_vehicle/{frame:03d}" for frame in range(1, 7)]
    link = Link(latency=0.3)
    config = V2XConfig(agents="+behind", link=link, past=2, step=1)

    assert_raises(
        (
            lambda: V2XDataset(da, tokens, config),
            ConfigError,
            ("3 of the 6 samples", "first 0.3 s", scenario, "exclude these samples"),
        )
    )

    single_items = V2XDataset(da, tokens, V2XConfig(link=link))
    assert all(item["agent_valid"].all() for item in single_items)
    item = V2XDataset(da, tokens[3:], config)[0]
    assert item["agent_valid"].tolist() == [[True, True], [False, True]]


def test_senders_are_the_agents_with_present_data(
    da: DeepAccident, da_partial: DeepAccident, sample: str
) -> None:
    tokens = [sample, sample.replace("ego_vehicle", "other_vehicle")]
    for dataset, agents, link, max_senders in (
        (da, "all", None, 5),
        (da, "all", Link(packet_loss=0.5, seed=1, budget=2500, payload=1000), 3),
        (da_partial, "available", None, 3),  # the pole has no points
    ):
        data = V2XDataset(
            dataset,
            tokens,
            V2XConfig(agents=agents, link=link, on_missing="skip"),
        )

        expected = []
        for item in data:
            pairs = zip(item["agents"], item["agent_valid"][:, -1], strict=True)
            expected.append(tuple(name for name, is_present in pairs if is_present))
        assert data.senders() == expected
        assert 1 < max(map(len, expected)) <= max_senders
