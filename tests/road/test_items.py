"""Items of a nuScenes export, read with the real nuScenes devkit, equal the items of the original
release.
"""

import numpy as np
import pytest
import torch
from nuscenes import NuScenes
from torch.utils.data import DataLoader

from deepaccident_devkit.motion import motion_labels
from deepaccident_devkit.plugins.nuscenes.items import NuScenesDataset
from deepaccident_devkit.taxonomy import CAMERAS, CATEGORIES, LIDAR, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.training.torch import ImageConfig, V2XConfig, V2XDataset, collate

CONFIG = V2XConfig(past=2, images=ImageConfig(dtype="uint8"), labels="fiery", visible=None)
VAN, CAR = CATEGORIES.index("van"), CATEGORIES.index("car")


def keyframes(pair) -> list[str]:
    return [record["token"] for record in pair.road.sample if record["labelled"]]


def test_items_of_keyframes_are_the_releases(pair) -> None:
    tokens = keyframes(pair)
    road_items = V2XDataset(pair.road, tokens, CONFIG)
    our_items = V2XDataset(
        pair.release,
        [pair.ours[token] for token in tokens],
        CONFIG,
    )
    for road, ours in zip(road_items, our_items, strict=True):
        assert road["agents"] == ours["agents"] == ("ego_vehicle",)
        for name in ("agent_valid", "images", "segmentation", "instance", "label_valid"):
            assert torch.equal(road[name], ours[name]), name
        for name in ("world_from_ego", "ego_from_agent", "agent_from_past", "intrinsics"):
            torch.testing.assert_close(
                road[name],
                ours[name],
                rtol=1e-6,
                atol=1e-6,
            )
        for name in ("centerness", "offset", "flow", "future_egomotion"):  # of single precision
            torch.testing.assert_close(
                road[name],
                ours[name],
                rtol=0,
                atol=5e-5,
            )

        is_other = ours["actor_ids"] != OWN_ACTOR_ID  # nuScenes does not annotate the ego
        without_vans = torch.where(
            ours["categories"] == VAN,
            CAR,
            ours["categories"],
        )
        assert torch.equal(road["categories"], without_vans[is_other])

        our_boxes = ours["boxes"][is_other][:, :7]
        torch.testing.assert_close(
            road["boxes"][:, :7],
            our_boxes,
            rtol=1e-6,
            atol=1e-5,
        )
        for road_points, our_points in zip(road["points"][0], ours["points"][0], strict=True):
            torch.testing.assert_close(road_points, our_points, rtol=1e-6, atol=1e-4)


def test_sensor_poses_equal_the_tables(pair) -> None:
    """The release's calib files jitter by 1e-5, but nuScenes has one row for each sensor, like the
    table `calibrated_sensor`.
    """
    for token in keyframes(pair):
        for channel in (*CAMERAS, LIDAR):
            data = pair.release.get("sample_data", f"{pair.ours[token]}/{channel}")
            row = pair.release.get("calibrated_sensor", data["calibrated_sensor_token"])
            pose = pair.road.ego_from(token, channel).matrix
            np.testing.assert_allclose(
                pose,
                np.array(row["matrix"]),
                rtol=1e-6,
                atol=1e-6,
            )


def test_velocities_equal_what_nuscenes_derives(pair) -> None:
    nusc = NuScenes("v1.0-deepaccident", str(pair.folder), verbose=False)
    num_known = 0
    for token in keyframes(pair):
        annotations = nusc.get("sample", pair.road.nuscenes_token(token))["anns"]
        expected = [nusc.box_velocity(annotation)[:2] for annotation in annotations]
        expected = np.array(expected).reshape(-1, 2)
        velocity = pair.road.boxes(token).velocity[:, :2]
        np.testing.assert_allclose(velocity, expected, rtol=1e-6, atol=1e-6)
        num_known += int(np.isfinite(expected).all(axis=1).sum())

    assert num_known > 100


def test_actors_are_the_same_and_untracked_ones_get_an_id(pair) -> None:
    for token in keyframes(pair):
        road_boxes = pair.road.boxes(token)
        our_boxes = pair.release.boxes(pair.ours[token])
        our_boxes = our_boxes.select(our_boxes.actor_id != OWN_ACTOR_ID)
        assert len(road_boxes) == len(our_boxes)

        id_pairs = set(zip(road_boxes.actor_id.tolist(), our_boxes.actor_id.tolist(), strict=True))
        tracked = [(road_id, our_id) for road_id, our_id in id_pairs if our_id != UNTRACKED_ID]
        road_ids = {road_id for road_id, _ in tracked}
        our_ids = {our_id for _, our_id in tracked}

        assert len(road_ids) == len(our_ids) == len(tracked)
        assert (road_boxes.actor_id > 0).all()


def test_labels_are_fierys_cell_by_cell(pair) -> None:
    """The release's labels by FIERY's rules equal FIERY's own (tests/parity/test_fiery.py)."""
    for token in keyframes(pair):
        road = motion_labels(pair.road, token, "fiery")
        ours = motion_labels(
            pair.release,
            pair.ours[token],
            "fiery",
        )
        np.testing.assert_array_equal(road.instance, ours.instance)
        np.testing.assert_array_equal(road.label_valid, ours.label_valid)


def test_a_split_of_nuscenes_is_a_dataset(pair) -> None:
    nusc = NuScenes("v1.0-deepaccident", str(pair.folder), verbose=False)
    dataset = NuScenesDataset(
        nusc, "train", V2XConfig(images=ImageConfig(resize=(36, 64)), labels="fiery")
    )
    assert len(dataset) == 7 * len(pair.road.split_scenarios("train"))

    batch = next(iter(DataLoader(dataset, batch_size=2, collate_fn=collate, num_workers=1)))
    assert batch["images"].shape == (2, 1, 1, 6, 3, 36, 64)
    assert batch["agent_valid"].tolist() == [[[True]], [[True]]]


@pytest.mark.parametrize("channel", [CAMERAS[0], LIDAR], ids=["camera", "lidar"])
def test_between_keyframes_there_are_no_files(pair, channel: str) -> None:
    between = keyframes(pair)[0][:-3] + "002"
    assert not pair.road.get("sample", between)["labelled"]
    assert not pair.road.sensor_path(between, channel).exists()
    frames = pair.road.sensor_frames(pair.road.scenario[0])
    assert frames["ego_vehicle", channel] == (1, 6, 11, 16, 21, 26, 31)
