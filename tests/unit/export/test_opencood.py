"""Read OPV2V's folders by OpenCOOD's conventions, and compare poses with CARLA's own formula."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from support.opencood_reader import (
    count_contents,
    read_agents,
    read_facts,
    read_points,
    read_timestamps,
    world_from,
)
from support.strategies import matrices

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.opencood import OpenCood, carla_poses
from deepaccident_devkit.geometry.conventions import flip_pose
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.testing import SmallRelease, write_small_release

pytestmark = pytest.mark.slow

AGENTS_BY_FOLDER = dict(zip(("1", "2", "3", "4", "-1"), AGENTS, strict=True))


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export_release(
        da,
        tmp_path_factory.mktemp("opencood") / "out",
        OpenCood(),
        workers=1,
    )


@pytest.fixture(scope="module")
def scenario(da: DeepAccident, exported: Exported) -> Path:
    """The folder of an accident."""
    record = next(record for record in da.scenario if record["collision"])
    (folder,) = exported.folder.glob(f"*/{record['token'].replace('/', '__')}")
    return folder


def read_label_counts(da: DeepAccident, sample: str) -> dict[int, int]:
    """Return the labels' number of points by vehicle."""
    boxes = da.boxes(sample)
    is_vehicle = np.isin(boxes.category_names, ("car", "truck", "van"))
    is_vehicle &= ~np.isin(boxes.actor_id, (OWN_ACTOR_ID, UNTRACKED_ID))
    boxes = boxes.select(is_vehicle & (boxes.num_lidar_pts > 0))
    return dict(zip(boxes.actor_id.tolist(), boxes.num_lidar_pts.tolist(), strict=True))


def test_boxes_hold_the_points_that_their_labels_count(da: DeepAccident, scenario: Path) -> None:
    token = scenario.name.replace("__", "/", 1)
    num_boxes = 0
    for folder, agent in AGENTS_BY_FOLDER.items():
        for timestamp in read_timestamps(scenario, folder):
            facts = read_facts(scenario, folder, timestamp)
            counts = count_contents(facts, read_points(scenario, folder, timestamp))
            expected = read_label_counts(da, f"{token}/{agent}/{int(timestamp):03d}")
            assert counts.keys() == expected.keys()
            for actor, count in expected.items():
                assert abs(counts[actor] - count) <= 1 + 0.02 * count
            num_boxes += len(expected)

    assert num_boxes > 100


def test_agents_share_a_world(scenario: Path) -> None:
    """A vehicle is at the same place in the files of all agents that see it."""
    locations: dict[int, list[list[float]]] = {}
    for folder in AGENTS_BY_FOLDER:
        for actor, vehicle in read_facts(scenario, folder, "000006")["vehicles"].items():
            locations.setdefault(actor, []).append(vehicle["location"])
    shared = [group for group in locations.values() if len(group) > 1]

    assert len(shared) > 3
    assert max(np.ptp(group, axis=0).max() for group in shared) < 0.5


def test_every_moment_has_all_files_and_the_pole_is_the_last(scenario: Path) -> None:
    assert read_agents(scenario) == list(AGENTS_BY_FOLDER)
    endings = (".yaml", ".json", ".pcd", *(f"_camera{number}.png" for number in range(6)))
    names = {f"{moment:06d}{ending}" for moment in range(1, 7) for ending in endings}
    for folder in AGENTS_BY_FOLDER:
        assert {path.name for path in (scenario / folder).iterdir()} == names


def test_json_equals_yaml_except_for_text_ids(scenario: Path) -> None:
    expected = dict(read_facts(scenario, "1", "000003"))
    vehicles = expected["vehicles"]
    expected["vehicles"] = {str(actor): vehicle for actor, vehicle in vehicles.items()}
    assert read_facts(scenario, "1", "000003", "json") == expected


def test_cameras_are_where_their_extrinsics_say(da: DeepAccident, scenario: Path) -> None:
    """A point before the front camera is in the middle of its image by either of the two poses."""
    facts = read_facts(scenario, "1", "000001")
    camera = facts["camera0"]
    point_in_world = world_from(camera["cords"]) @ [10.0, 0, 0, 1]
    lidar_from_world = np.linalg.inv(world_from(facts["lidar_pose"]))
    x, y, z, _ = np.array(camera["extrinsic"]) @ lidar_from_world @ point_in_world
    assert np.allclose([x, y, z], [10, 0, 0], atol=1e-9)

    intrinsic = np.array(camera["intrinsic"])
    u, v, depth = intrinsic @ [y, -z, x]
    assert np.allclose([u / depth, v / depth], intrinsic[:2, 2])


def test_images_are_links_to_the_release(
    da: DeepAccident, scenario: Path, exported: Exported
) -> None:
    token = scenario.name.replace("__", "/", 1)
    source = da.get_sample_data_path(f"{token}/ego_vehicle/002", "Camera_BackRight")
    assert (scenario / "1" / "000002_camera1.png").samefile(source)
    assert exported.tally.linked == {"hard": len(list(exported.folder.rglob("*.png")))}


def test_splits_have_their_folders(da: DeepAccident, exported: Exported) -> None:
    split_folders = {"train": "train", "val": "validate", "test": "test"}
    expected = set()
    for record in da.scenario:
        folder = exported.folder / split_folders[record["split"]]
        expected.add(folder / record["token"].replace("/", "__"))
    assert {path.parent for path in exported.folder.rglob("data_protocol.yaml")} == expected


def test_ego_can_be_another_vehicle_and_classes_more(da: DeepAccident, tmp_path: Path) -> None:
    token = next(record["token"] for record in da.scenario if record["split"] == "train")
    form = OpenCood(
        ego="other_vehicle",
        classes=("pedestrian", "car"),
        agents=("other_vehicle", "ego_vehicle"),
        where=(f"token={token}",),
    )
    (folder,) = export_release(da, tmp_path / "out", form).folder.glob("train/*")

    assert read_agents(folder) == ["1", "2"]

    actors = set()
    for agent in ("1", "2"):
        actors |= read_facts(folder, agent, "000006")["vehicles"].keys()
    boxes = da.boxes(f"{token}/ego_vehicle/006")
    is_pedestrian = np.array(boxes.category_names) == "pedestrian"
    pedestrians = boxes.actor_id[is_pedestrian & (boxes.num_lidar_pts > 0)]

    assert set(pedestrians.tolist()) - {UNTRACKED_ID} <= actors


def test_a_partial_release_is_written_and_counted(da_partial: DeepAccident, tmp_path: Path) -> None:
    left_out = export_release(da_partial, tmp_path / "out", OpenCood()).tally.left_out
    for kind, count in {"agents of scenarios": 1, "images": 6, "point clouds": 6}.items():
        assert left_out[f"{kind} that are not in this release"] == count * len(da_partial.scenario)


@pytest.mark.parametrize(
    ("removed_clouds", "agents", "moments", "warned"),
    [
        ({"ego_vehicle": [2]}, ["1", "3"], ["000001", "000003"], False),
        ({"ego_vehicle": [1, 2], "other_vehicle": [2]}, ["1", "3"], ["000003"], True),
        ({"other_vehicle": [1, 2, 3]}, ["1"], ["000001", "000002", "000003"], False),
        ({"ego_vehicle": [1], "other_vehicle": [2, 3]}, [], [], True),
    ],
)
def test_all_agents_have_the_same_moments_and_each_its_cloud(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    removed_clouds: dict[str, list[int]],
    agents: list[str],
    moments: list[str],
    warned: bool,
) -> None:
    """Each of three scenarios has two agents with three moments; loaders need every cloud."""
    root = tmp_path / "release"
    write_small_release(
        root,
        SmallRelease(agents=("ego_vehicle", "other_vehicle"), channels=("lidar01", "Camera_Front")),
    )
    for agent, numbers in removed_clouds.items():
        for number in numbers:
            for path in root.glob(f"*/{agent}/lidar01/*/*_{number:03d}.npz"):
                path.unlink()
    dataset = DeepAccident("v1", root, verbose=False)
    whole = export_release(dataset, tmp_path / "whole", OpenCood(without_clouds=True), workers=1)
    if not agents:
        with pytest.raises(
            NotAvailableError, match="no moment of these scenarios and agents has its point clouds"
        ):
            export_release(dataset, tmp_path / "out", OpenCood(), workers=1)
        return

    done = export_release(dataset, tmp_path / "out", OpenCood(), workers=1)
    folders = [path.parent for path in done.folder.glob("*/*/data_protocol.yaml")]

    assert len(folders) == len(dataset.scenario)

    for folder in folders:
        assert read_agents(folder) == agents
        for agent in agents:
            clouds = sorted(path.stem for path in (folder / agent).glob("*.pcd"))
            assert read_timestamps(folder, agent) == clouds == moments
    num_samples = len(agents) * len(moments) * len(folders)

    assert done.tally.samples == num_samples

    num_left_out = done.tally.left_out["samples of agents or moments without point clouds"]
    assert num_left_out == whole.tally.samples - num_samples
    assert ("most of the export" in caplog.text) == warned


def test_without_labels_there_are_poses_and_clouds(
    unlabelled_dataset: DeepAccident, tmp_path: Path
) -> None:
    done = export_release(
        unlabelled_dataset, tmp_path / "out", OpenCood(agents=("ego_vehicle",), without_clouds=True)
    )
    num_missing = done.tally.left_out["labels that are not in this release"]
    assert num_missing == len(unlabelled_dataset.scenario) * 4

    scenario = next(done.folder.glob("*/*/1")).parent
    before, present, after = (
        read_facts(scenario, "1", name) for name in ("000001", "000002", "000003")
    )
    assert present["vehicles"] == {}

    distance_m = np.hypot(*np.subtract(after["true_ego_pos"], before["true_ego_pos"])[:2])
    assert present["ego_speed"] == pytest.approx(distance_m / 0.2 * 3.6)


DEGREES = st.floats(-179.9, 179.9)


@given(
    roll=DEGREES,
    yaw=DEGREES,
    pitch=st.floats(-89, 89),
    position=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_a_carla_pose_survives_the_conversion_to_a_matrix(
    roll: float, yaw: float, pitch: float, position: tuple[float, ...]
) -> None:
    carla_pose = [*position, roll, yaw, pitch]
    pose = flip_pose(world_from(carla_pose))
    assert_allclose(carla_poses(pose), carla_pose, rtol=0, atol=1e-9)


@given(matrices())
def test_a_matrix_survives_the_conversion_to_a_carla_pose(pose: np.ndarray) -> None:
    """Angles are not unique near pitches of 90°, where arcsin is flat and keeps eight digits."""
    carla_pose = carla_poses(pose)
    assert_allclose(flip_pose(world_from(carla_pose)), pose, rtol=0, atol=1e-7)
