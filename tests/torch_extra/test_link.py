"""Link effects: partners' data late, misplaced, lost; the truth untouched."""

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.torch import ImageConfig, RandomAugmentation, V2XConfig, V2XDataset, collate_fusion
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.v2x import Link

LABELS = MotionLabelConfig(receptive_field=2, future_frames=2, step=1)


def test_late_data_are_an_earlier_frames(da: DeepAccident, sample: str) -> None:
    images = ImageConfig(dtype="uint8")
    late = V2XDataset(da, [sample], V2XConfig(agents="all", link=Link(latency=0.2), images=images))[0]
    for a, name in enumerate(late["agents"]):
        sent = da.get_sample(da.scenario[0], name, 2 if a else 4)
        assert_allclose(late["points"][a][0][:, :3], da.load_point_cloud(sent, "ego").xyz, atol=1e-4)
        assert_allclose(late["ego_from_agent"][a, 0], da.transform(sample, sent).matrix, atol=1e-4)
        image = da.load_image(f"{sent['token']}/Camera_Back")
        assert_array_equal(late["images"][a, 0, 3].permute(1, 2, 0), image)


def test_pose_noise_does_not_reach_a_senders_own_motion(da: DeepAccident, sample: str) -> None:
    """With latency, the last data are two frames old, and the motion ends there."""
    noise = Link(latency=0.1, pose_noise=1.0, seed=2)
    item = V2XDataset(da, [sample], V2XConfig(agents="all", past=2, step=2, link=noise, points=False))[0]
    for a, name in enumerate(item["agents"]):
        late = 0 if a == 0 else 1
        last, before = (da.get_sample(da.scenario[0], name, frame - late) for frame in (4, 2))
        assert_allclose(item["agent_from_past"][a, 0], da.transform(last, before).matrix, atol=1e-4)
        assert_allclose(item["agent_from_past"][a, 1], np.eye(4))


def test_points_where_the_ego_places_them(da: DeepAccident, sample: str) -> None:
    """All agents' points in the ego frame are the devkit's aggregated cloud, link and all."""
    link = Link(latency=0.1, pose_noise=0.5, seed=2)
    item = V2XDataset(da, [sample], V2XConfig(agents="all", link=link, augmentation=RandomAugmentation()))[0]
    batch = collate_fusion([item])
    parts = []
    for i, cloud in enumerate(batch["points"]):
        ego_from_agent = batch["pairwise_t_matrix"][0, i, 0].double()
        parts.append(cloud[-1][:, :3].double() @ ego_from_agent[:3, :3].T + ego_from_agent[:3, 3])
    matrix = item["augmentation"].double().numpy()
    expected = da.aggregate_point_cloud(sample, agents=item["agents"], link=link, frame="ego").xyz
    assert_allclose(torch.cat(parts), expected @ matrix[:3, :3].T, atol=5e-3)


def test_noise_misplaces_partners_alone(da: DeepAccident, sample: str) -> None:
    plain, noisy = (
        V2XDataset(da, [sample], V2XConfig(agents="all", link=link))[0] for link in (None, Link(pose_noise=0.5))
    )
    off = (plain["ego_from_agent"] - noisy["ego_from_agent"])[:, 0, :3, 3].norm(dim=1)
    assert off[0] == 0
    assert ((off[1:] > 0.3) & (off[1:] < 0.7)).all()
    assert_array_equal(plain["points"][1][0], noisy["points"][1][0])


def test_a_lost_message_leaves_nothing(da: DeepAccident, sample: str) -> None:
    link = Link(packet_loss=0.5, seed=1)
    config = V2XConfig(agents="all", link=link, past=2, step=1, images=ImageConfig())
    item = V2XDataset(da, [sample], config)[0]
    scenario = da.scenario[0]["token"]
    expected = [
        [a == 0 or not link.loses(scenario, name, frame) for frame in (3, 4)] for a, name in enumerate(item["agents"])
    ]
    assert item["agent_valid"].tolist() == expected
    lost = ~item["agent_valid"]
    assert lost[:, -1].any()
    assert not lost[:, -1].all()
    assert not item["images"][lost].any()
    assert all(len(item["points"][a][p]) == 0 for a, p in lost.nonzero().tolist())
    assert_array_equal(item["ego_from_agent"][lost], np.broadcast_to(np.eye(4), (int(lost.sum()), 4, 4)))
    batch = collate_fusion([item])
    there = item["agent_valid"][:, -1]
    assert batch["record_len"].tolist() == [int(there.sum())]
    assert batch["agents"] == [tuple(name for name, kept in zip(item["agents"], there, strict=True) if kept)]
    assert_array_equal(batch["images"], item["images"][there])
    assert_array_equal(batch["agent_valid"], item["agent_valid"][there])
    assert [len(cloud[-1]) > 0 for cloud in batch["points"]] == [True] * int(there.sum())


def test_boxes_and_labels_stay_the_truth(da: DeepAccident, sample: str) -> None:
    link = Link(latency=0.2, pose_noise=1.0, packet_loss=0.9)
    config = {"agents": "all", "points": False, "labels": LABELS, "boxes": "cooperative"}
    plain, late = (V2XDataset(da, [sample], V2XConfig(**config, link=chosen))[0] for chosen in (None, link))
    for name in ("boxes", "actor_ids", "instance", "flow", "future_egomotion"):
        assert_array_equal(plain[name], late[name])


def test_samples_before_the_first_data_are_refused_at_once(da: DeepAccident) -> None:
    scenario, late = da.scenario[0]["token"], {"link": Link(latency=0.3)}
    tokens = [f"{scenario}/ego_vehicle/{frame:03d}" for frame in range(1, 7)]
    behind, named = (
        V2XConfig(agents="+behind", **late),
        ("3 of the 6 samples", "first 0.3 s", scenario, "leave them out"),
    )
    assert_refused((lambda: V2XDataset(da, tokens, behind), ConfigError, named))
    assert all(item["agent_valid"].all() for item in V2XDataset(da, tokens, V2XConfig(**late)))
    later = V2XDataset(da, tokens[3:], V2XConfig(agents="+behind", **late, past=2, step=1))
    assert later[0]["agent_valid"].tolist() == [[True, True], [False, True]]
