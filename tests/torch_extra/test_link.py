"""Link effects: partners' data late, misplaced, lost; the truth untouched."""

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused
from torch_extra.compared import same

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
    images = ImageConfig(dtype="uint8")
    late = V2XDataset(da, [sample], V2XConfig(agents="all", link=Link(latency=0.2), images=images))[
        0
    ]
    for a, name in enumerate(late["agents"]):
        sent = da.get_sample(da.scenario[0], name, 2 if a else 4)
        assert_allclose(
            late["points"][a][0][:, :3], da.load_point_cloud(sent, "ego").xyz, atol=1e-4
        )
        assert_allclose(late["ego_from_agent"][a, 0], da.transform(sample, sent).matrix, atol=1e-4)
        assert_array_equal(
            late["images"][a, 0, 3].permute(1, 2, 0), da.load_image(f"{sent['token']}/Camera_Back")
        )


def test_pose_noise_does_not_reach_a_senders_own_motion(da: DeepAccident, sample: str) -> None:
    """With latency, the last data are two frames old, and the motion ends there."""
    config = V2XConfig(
        agents="all", past=2, step=2, link=Link(latency=0.1, pose_noise=1.0, seed=2), points=False
    )
    item = V2XDataset(da, [sample], config)[0]
    for a, name in enumerate(item["agents"]):
        last, before = (da.get_sample(da.scenario[0], name, frame - (a > 0)) for frame in (4, 2))
        assert_allclose(
            item["agent_from_past"][a], [da.transform(last, before).matrix, np.eye(4)], atol=1e-4
        )


def test_points_where_the_ego_places_them(da: DeepAccident, sample: str) -> None:
    """All agents' points in the ego frame are the devkit's aggregated cloud, link and all."""
    link = Link(latency=0.1, pose_noise=0.5, seed=2)
    item = V2XDataset(
        da, [sample], V2XConfig(agents="all", link=link, augmentation=RandomAugmentation())
    )[0]
    batch = collate_fusion([item])
    poses = batch["pairwise_t_matrix"][0, :, 0].double()
    parts = [
        cloud[-1][:, :3].double() @ pose[:3, :3].T + pose[:3, 3]
        for cloud, pose in zip(batch["points"], poses, strict=True)
    ]
    expected = da.aggregate_point_cloud(sample, agents=item["agents"], link=link, frame="ego").xyz
    assert_allclose(
        torch.cat(parts), expected @ item["augmentation"].double().numpy()[:3, :3].T, atol=5e-3
    )


def test_a_lost_message_leaves_nothing(da: DeepAccident, sample: str) -> None:
    link = Link(packet_loss=0.5, seed=1)
    item = V2XDataset(
        da, [sample], V2XConfig(agents="all", link=link, past=2, step=1, images=ImageConfig())
    )[0]
    assert item["agent_valid"].tolist() == [
        [a == 0 or not link.loses(da.scenario[0]["token"], name, frame) for frame in (3, 4)]
        for a, name in enumerate(item["agents"])
    ]
    lost, there = ~item["agent_valid"], item["agent_valid"][:, -1]
    assert set(there.tolist()) == {True, False}
    assert not item["images"][lost].any()
    assert not any(len(item["points"][a][p]) for a, p in lost.nonzero().tolist())
    assert_array_equal(
        item["ego_from_agent"][lost], np.broadcast_to(np.eye(4), (int(lost.sum()), 4, 4))
    )


def test_boxes_and_labels_stay_the_truth(da: DeepAccident, sample: str) -> None:
    link = Link(latency=0.2, pose_noise=1.0, packet_loss=0.9)
    config = {"agents": "all", "points": False, "labels": LABELS, "boxes": "cooperative"}
    plain, late = (
        V2XDataset(da, [sample], V2XConfig(**config, link=chosen))[0] for chosen in (None, link)
    )
    truth = ("boxes", "actor_ids", "instance", "flow", "future_egomotion")
    assert same([plain[name] for name in truth], [late[name] for name in truth])


def test_samples_before_the_first_data_are_refused_at_once(da: DeepAccident) -> None:
    scenario, late = da.scenario[0]["token"], {"link": Link(latency=0.3)}
    tokens = [f"{scenario}/ego_vehicle/{frame:03d}" for frame in range(1, 7)]
    behind = V2XConfig(agents="+behind", **late, past=2, step=1)
    named = ("3 of the 6 samples", "first 0.3 s", scenario, "leave them out")
    assert_refused((lambda: V2XDataset(da, tokens, behind), ConfigError, named))
    assert all(item["agent_valid"].all() for item in V2XDataset(da, tokens, V2XConfig(**late)))
    assert V2XDataset(da, tokens[3:], behind)[0]["agent_valid"].tolist() == [
        [True, True],
        [False, True],
    ]


def test_senders_are_those_whose_present_an_item_has(
    da: DeepAccident, da_partial: DeepAccident, sample: str
) -> None:
    for dataset, agents, link, most in (
        (da, "all", None, 5),
        (da, "all", Link(packet_loss=0.5, seed=1, budget=2500, payload=1000), 3),
        (da_partial, "available", None, 3),  # the pole has no points
    ):
        samples = [sample, sample.replace("ego_vehicle", "other_vehicle")]
        data = V2XDataset(dataset, samples, V2XConfig(agents=agents, link=link, on_missing="skip"))
        items = [data[row] for row in range(len(data))]
        expected = [
            tuple(
                name
                for name, there in zip(item["agents"], item["agent_valid"][:, -1], strict=True)
                if there
            )
            for item in items
        ]
        assert data.senders() == expected
        assert 1 < max(map(len, expected)) <= most
