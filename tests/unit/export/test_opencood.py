"""OPV2V's folders, read by a reader that knows OpenCOOD's conventions; CARLA's poses against its
own formula.
"""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from opencood_reader import agents_of, counts_of, facts_of, points_of, timestamps_of, world_from
from refusals import assert_refused
from strategies import matrices

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.export.bulk import Exported, export_release
from deepaccident_devkit.export.opencood import OpenCood, carla_six
from deepaccident_devkit.geometry.conventions import flip_pose
from deepaccident_devkit.taxonomy import AGENTS, OWN_ACTOR_ID, UNTRACKED_ID
from deepaccident_devkit.testing import SmallRelease, write_small_release

pytestmark = pytest.mark.slow

PLACES = dict(zip(("1", "2", "3", "4", "-1"), AGENTS, strict=True))


@pytest.fixture(scope="module")
def exported(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export_release(da, tmp_path_factory.mktemp("opencood") / "out", OpenCood(), workers=1)


@pytest.fixture(scope="module")
def scenario(da: DeepAccident, exported: Exported) -> Path:
    """The folder of an accident."""
    record = next(record for record in da.scenario if record["collision"])
    (found,) = exported.folder.glob(f"*/{record['token'].replace('/', '__')}")
    return found


def expected_counts(da: DeepAccident, sample: str) -> dict[int, int]:
    """Vehicle → points, as the labels count them."""
    boxes = da.boxes(sample)
    kept = (boxes.num_lidar_pts > 0) & ~np.isin(boxes.actor_id, (OWN_ACTOR_ID, UNTRACKED_ID))
    kept &= np.isin(boxes.category_names, ("car", "truck", "van"))
    return dict(zip(boxes.actor_id[kept].tolist(), boxes.num_lidar_pts[kept].tolist(), strict=True))


def disagreement(da: DeepAccident, scenario: Path) -> float:
    """The share of boxes in which a reader finds another number of points than the labels say."""
    token, wrong, total = scenario.name.replace("__", "/", 1), 0, 0
    for place, agent in PLACES.items():
        for timestamp in timestamps_of(scenario, place):
            facts = facts_of(scenario, place, timestamp)
            expected = expected_counts(da, f"{token}/{agent}/{int(timestamp):03d}")
            found = counts_of(facts, points_of(scenario, place, timestamp))
            assert found.keys() == expected.keys()
            wrong += sum(
                abs(found[actor] - count) > 1 + 0.02 * count for actor, count in expected.items()
            )
            total += len(expected)
    assert total > 100
    return wrong / total


def test_boxes_hold_the_points_that_their_labels_count(da: DeepAccident, scenario: Path) -> None:
    assert disagreement(da, scenario) == 0


def test_agents_share_a_world(scenario: Path) -> None:
    """The same vehicle is at the same place in the files of all agents that see it."""
    places: dict[int, list[list[float]]] = {}
    for place in PLACES:
        for actor, vehicle in facts_of(scenario, place, "000006")["vehicles"].items():
            places.setdefault(actor, []).append(vehicle["location"])
    shared = [found for found in places.values() if len(found) > 1]
    assert len(shared) > 3
    assert max(np.ptp(found, axis=0).max() for found in shared) < 0.5


def test_every_moment_has_all_files_and_the_pole_is_the_last(scenario: Path) -> None:
    assert agents_of(scenario) == list(PLACES)
    ends = (".yaml", ".json", ".pcd", *(f"_camera{number}.png" for number in range(6)))
    names = {f"{moment:06d}{end}" for moment in range(1, 7) for end in ends}
    assert [{path.name for path in (scenario / place).iterdir()} for place in PLACES] == [
        names
    ] * len(PLACES)


def test_json_says_the_same_with_ids_as_words(scenario: Path) -> None:
    told, again = facts_of(scenario, "1", "000003"), facts_of(scenario, "1", "000003", "json")
    assert again == {
        **told,
        "vehicles": {str(actor): vehicle for actor, vehicle in told["vehicles"].items()},
    }


def test_cameras_are_where_their_extrinsics_say(da: DeepAccident, scenario: Path) -> None:
    """A point before the front camera is in the middle of its image, by either of the two poses."""
    facts = facts_of(scenario, "1", "000001")
    camera = facts["camera0"]
    ahead = world_from(camera["cords"]) @ [10.0, 0, 0, 1]
    x, y, z, _ = (
        np.array(camera["extrinsic"]) @ np.linalg.inv(world_from(facts["lidar_pose"])) @ ahead
    )
    u, v, depth = np.array(camera["intrinsic"]) @ [y, -z, x]
    assert np.allclose([x, y, z], [10, 0, 0], atol=1e-9)
    assert np.allclose(
        [u / depth, v / depth], [camera["intrinsic"][0][2], camera["intrinsic"][1][2]]
    )


def test_images_are_links_to_those_of_the_release(
    da: DeepAccident, scenario: Path, exported: Exported
) -> None:
    source = da.get_sample_data_path(
        f"{scenario.name.replace('__', '/', 1)}/ego_vehicle/002/Camera_BackRight"
    )
    assert (scenario / "1" / "000002_camera1.png").samefile(source)
    assert exported.tally.linked == {"hard": len(list(exported.folder.rglob("*.png")))}


def test_splits_have_their_folders(da: DeepAccident, exported: Exported) -> None:
    theirs = {"train": "train", "val": "validate", "test": "test"}
    found = {
        path.parent.relative_to(exported.folder).as_posix()
        for path in exported.folder.rglob("data_protocol.yaml")
    }
    assert found == {
        f"{theirs[each['split']]}/{each['token'].replace('/', '__')}" for each in da.scenario
    }


def test_ego_can_be_another_vehicle_and_classes_more(da: DeepAccident, tmp_path: Path) -> None:
    token = next(record["token"] for record in da.scenario if record["split"] == "train")
    agents, chosen = ("other_vehicle", "ego_vehicle"), (f"token={token}",)
    form = OpenCood(ego="other_vehicle", classes=("pedestrian", "car"), agents=agents, where=chosen)
    (folder,) = export_release(da, tmp_path / "out", form).folder.glob("train/*")
    assert agents_of(folder) == ["1", "2"]
    actors = {
        actor for sample in (1, 2) for actor in facts_of(folder, str(sample), "000006")["vehicles"]
    }
    walkers = da.boxes(f"{token}/ego_vehicle/006")
    seen = walkers.actor_id[
        (np.array(walkers.category_names) == "pedestrian") & (walkers.num_lidar_pts > 0)
    ]
    assert set(seen.tolist()) - {UNTRACKED_ID} <= actors


def test_a_partial_release_is_written_and_counted(da_partial: DeepAccident, tmp_path: Path) -> None:
    left_out = export_release(da_partial, tmp_path / "out", OpenCood()).tally.left_out
    for kind, count in {"agents of scenarios": 1, "images": 6, "point clouds": 6}.items():
        assert left_out[f"{kind} that are not in this release"] == count * len(da_partial.scenario)


@pytest.mark.parametrize(
    ("gone", "agents", "moments", "warned"),
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
    gone: dict[str, list[int]],
    agents: list[str],
    moments: list[str],
    warned: bool,
) -> None:
    """Of three moments of two agents in each of three scenarios; loaders take no cloud for one
    without points.
    """
    wanted = SmallRelease(
        agents=("ego_vehicle", "other_vehicle"), channels=("lidar01", "Camera_Front")
    )
    write_small_release(tmp_path / "release", wanted)
    for agent, numbers in gone.items():
        for number in numbers:
            for path in (tmp_path / "release").glob(f"*/{agent}/lidar01/*/*_{number:03d}.npz"):
                path.unlink()
    dataset = DeepAccident("v1", tmp_path / "release", verbose=False)
    whole = export_release(dataset, tmp_path / "whole", OpenCood(without_clouds=True), workers=1)
    if not agents:
        assert_refused(
            (
                lambda: export_release(dataset, tmp_path / "out", OpenCood(), workers=1),
                NotAvailableError,
                "no moment of these scenarios and agents has its point clouds",
            )
        )
        return
    made = export_release(dataset, tmp_path / "out", OpenCood(), workers=1)
    folders = [path.parent for path in made.folder.glob("*/*/data_protocol.yaml")]
    assert len(folders) == len(dataset.scenario)
    for folder in folders:
        assert agents_of(folder) == agents
        for agent in agents:
            clouds = sorted(path.stem for path in (folder / agent).glob("*.pcd"))
            assert timestamps_of(folder, agent) == clouds == moments
    written = len(agents) * len(moments) * len(folders)
    assert made.tally.samples == written
    assert (
        made.tally.left_out["samples of agents or moments without point clouds"]
        == whole.tally.samples - written
    )
    assert ("most of the export" in caplog.text) == warned


def test_without_labels_there_are_poses_and_clouds(
    unlabelled: DeepAccident, tmp_path: Path
) -> None:
    made = export_release(
        unlabelled, tmp_path / "out", OpenCood(agents=("ego_vehicle",), without_clouds=True)
    )
    assert (
        made.tally.left_out["labels that are not in this release"] == len(unlabelled.scenario) * 4
    )
    (folder, *_) = made.folder.glob("*/*/1")
    facts = facts_of(folder.parent, "1", "000002")
    assert facts["vehicles"] == {}
    before, after = (
        facts_of(folder.parent, "1", name)["true_ego_pos"][:2] for name in ("000001", "000003")
    )
    assert facts["ego_speed"] == pytest.approx(np.hypot(*np.subtract(after, before)) / 0.2 * 3.6)


DEGREES = st.floats(-179.9, 179.9)


def carla_matrix(x: float, y: float, z: float, roll: float, yaw: float, pitch: float) -> np.ndarray:
    """What `carla.Transform.get_matrix` gives: metres and degrees, left-handed, as its `Transform`
    computes it.
    """
    (cr, cy, cp), (sr, sy, sp) = (
        np.cos(np.radians([roll, yaw, pitch])),
        np.sin(np.radians([roll, yaw, pitch])),
    )
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


@given(
    roll=DEGREES,
    yaw=DEGREES,
    pitch=st.floats(-89, 89),
    place=st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_a_carla_transform_there_and_back(
    roll: float, yaw: float, pitch: float, place: tuple[float, ...]
) -> None:
    six = carla_six(flip_pose(carla_matrix(*place, roll, yaw, pitch)))
    assert_allclose(six, [*place, roll, yaw, pitch], rtol=0, atol=1e-9)


@given(matrices())
def test_a_pose_there_and_back(pose: np.ndarray) -> None:
    """Also near pitches of 90°, where angles are not unique; arcsin is flat there, and keeps eight
    digits.
    """
    assert_allclose(flip_pose(carla_matrix(*carla_six(pose))), pose, rtol=0, atol=1e-7)
