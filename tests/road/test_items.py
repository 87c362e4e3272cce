"""Items of nuScenes' format, through the real nuScenes devkit, are those of the release that it was
exported from.
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


def keys(pair) -> list[str]:
    return [record["token"] for record in pair.road.sample if record["labelled"]]


def test_items_of_keyframes_are_the_releases(pair) -> None:
    tokens = keys(pair)
    road, ours = (V2XDataset(each, of, CONFIG) for each, of in (
        (pair.road, tokens), (pair.release, [pair.ours[token] for token in tokens])
    ))  # fmt: skip
    for one, other in zip(road, ours, strict=True):
        assert one["agents"] == other["agents"] == ("ego_vehicle",)
        for name in ("agent_valid", "images", "segmentation", "instance", "label_valid"):
            assert torch.equal(one[name], other[name]), name
        for name in ("world_from_ego", "ego_from_agent", "agent_from_past", "intrinsics"):
            torch.testing.assert_close(one[name], other[name], rtol=1e-6, atol=1e-6)
        for name in ("centerness", "offset", "flow", "future_egomotion"):  # of single precision
            torch.testing.assert_close(one[name], other[name], rtol=0, atol=5e-5)
        others = other["actor_ids"] != OWN_ACTOR_ID  # nuScenes does not annotate the ego
        given = torch.where(other["categories"] == VAN, CAR, other["categories"])[
            others
        ]  # it has no vans
        assert torch.equal(one["categories"], given)
        torch.testing.assert_close(
            one["boxes"][:, :7], other["boxes"][others][:, :7], rtol=1e-6, atol=1e-5
        )
        for mine, theirs in zip(one["points"][0], other["points"][0], strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-6, atol=1e-4)


def test_poses_of_sensors_are_those_of_the_tables(pair) -> None:
    """The release's calib files jitter by 1e-5; nuScenes has one row a sensor, as
    `calibrated_sensor` has.
    """
    for token in keys(pair):
        for channel in (*CAMERAS, LIDAR):
            row = pair.release.get("sample_data", f"{pair.ours[token]}/{channel}")[
                "calibrated_sensor_token"
            ]
            meant = np.array(pair.release.get("calibrated_sensor", row)["matrix"])
            np.testing.assert_allclose(
                pair.road.ego_from(token, channel).matrix, meant, rtol=1e-6, atol=1e-6
            )


def test_velocities_are_those_that_nuscenes_derives(pair) -> None:
    nusc = NuScenes("v1.0-deepaccident", str(pair.folder), verbose=False)
    known = 0
    for token in keys(pair):
        rows = nusc.get("sample", pair.road.nuscenes_token(token))["anns"]
        want = np.array([nusc.box_velocity(row)[:2] for row in rows]).reshape(-1, 2)
        found = pair.road.boxes(token).velocity[:, :2]
        np.testing.assert_allclose(found, want, rtol=1e-6, atol=1e-6)
        known += int(np.isfinite(want).all(axis=1).sum())
    assert known > 100


def test_actors_are_the_same_and_untracked_ones_get_an_id(pair) -> None:
    for token in keys(pair):
        road, ours = pair.road.boxes(token), pair.release.boxes(pair.ours[token])
        ours = ours.select(ours.actor_id != OWN_ACTOR_ID)
        assert len(road) == len(ours)
        pairs = {*zip(road.actor_id.tolist(), ours.actor_id.tolist(), strict=True)}
        tracked = {(mine, theirs) for mine, theirs in pairs if theirs != UNTRACKED_ID}
        assert (
            len({mine for mine, _ in tracked})
            == len({theirs for _, theirs in tracked})
            == len(tracked)
        )
        assert (road.actor_id > 0).all()


def test_labels_are_fierys_cell_by_cell(pair) -> None:
    """Those of the release by FIERY's rules, which equal FIERY's own
    (tests/parity/test_fiery.py).
    """
    for token in keys(pair):
        mine, theirs = (motion_labels(each, of, "fiery") for each, of in (
            (pair.road, token), (pair.release, pair.ours[token])
        ))  # fmt: skip
        np.testing.assert_array_equal(mine.instance, theirs.instance)
        np.testing.assert_array_equal(mine.label_valid, theirs.label_valid)


def test_a_split_of_nuscenes_is_a_dataset(pair) -> None:
    nusc = NuScenes("v1.0-deepaccident", str(pair.folder), verbose=False)
    data = NuScenesDataset(
        nusc, "train", V2XConfig(images=ImageConfig(resize=(36, 64)), labels="fiery")
    )
    assert len(data) == 7 * len(pair.road.split_scenarios("train"))
    batch = next(iter(DataLoader(data, batch_size=2, collate_fn=collate, num_workers=1)))
    assert batch["images"].shape == (2, 1, 1, 6, 3, 36, 64)
    assert batch["agent_valid"].tolist() == [[[True]], [[True]]]


@pytest.mark.parametrize("what", ["camera", "lidar"])
def test_between_keyframes_there_are_no_files(pair, what: str) -> None:
    between = keys(pair)[0][:-3] + "002"
    assert not pair.road.get("sample", between)["labelled"]
    channel = CAMERAS[0] if what == "camera" else LIDAR
    assert not pair.road.sensor_path(between, channel).exists()
    frames = pair.road.sensor_frames(pair.road.scenario[0])
    assert frames["ego_vehicle", channel] == (1, 6, 11, 16, 21, 26, 31)
