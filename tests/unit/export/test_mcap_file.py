"""What is in an exported file, read back by the format's own library."""

from datetime import datetime, timezone
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from mcap_reading import McapFile, cloud_of, matrix_of, read_mcap, xyz_of
from PIL import Image

from deepaccident_devkit import DeepAccident
from deepaccident_devkit._version import __version__
from deepaccident_devkit.export.mcap import EPOCH, export_mcap
from deepaccident_devkit.motion import motion_labels
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR
from deepaccident_devkit.v2x import cooperative_boxes, visible_instances

FRAMES = 6
RED = tuple(bytes.fromhex(COLLIDER_COLOR[1:]))


@pytest.fixture(scope="module")
def scenario(da: DeepAccident) -> str:
    return next(record["token"] for record in da.scenario if record["collision"] is not None)


@pytest.fixture(scope="module")
def path(da: DeepAccident, scenario: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    wanted = tmp_path_factory.mktemp("mcap") / "new folder" / "accident.mcap"
    made = export_mcap(da, scenario, wanted, motion_labels="deepaccident")
    assert made == wanted
    return made


@pytest.fixture(scope="module")
def file(path: Path) -> McapFile:
    return read_mcap(path)


def sample(scenario: str, agent: str, index: int) -> str:
    return f"{scenario}/{agent}/{index:03d}"


def test_every_topic_has_a_message_a_frame_and_the_schema_of_its_kind(file: McapFile) -> None:
    expected = {"/log": "Log", "/tf": "FrameTransforms", "/actors": "SceneUpdate", "/actors/points": "PointCloud"}
    for agent in AGENTS:
        expected[f"/{agent}/pose"] = "PoseInFrame"
        expected[f"/{agent}/{LIDAR}/points"] = "PointCloud"
        expected[f"/{agent}/annotations"] = "SceneUpdate"
        expected[f"/{agent}/annotations/points"] = "PointCloud"
        expected[f"/{agent}/motion_labels/points"] = "PointCloud"
        for camera in CAMERAS:
            expected[f"/{agent}/{camera}/image"] = "CompressedImage"
            expected[f"/{agent}/{camera}/calibration"] = "CameraCalibration"
    wanted = {topic: f"foxglove.{name}" for topic, name in expected.items()}
    assert file.schemas == {**wanted, "/time_to_impact": "google.protobuf.DoubleValue"}
    counts = {topic: len(messages) for topic, messages in file.messages.items() if topic != "/log"}
    assert set(counts.values()) == {FRAMES}


def test_the_file_is_compressed_and_indexed_for_seeking(file: McapFile) -> None:
    summary = file.summary
    assert summary.statistics.message_count == len(file.log_times) == sum(map(len, file.messages.values()))
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert all(chunk.message_index_length > 0 for chunk in summary.chunk_indexes)
    assert [index.name for index in summary.metadata_indexes] == ["deepaccident_devkit"]


def test_there_is_one_timeline_of_ten_frames_a_second(file: McapFile) -> None:
    assert file.log_times == sorted(file.log_times)
    frames = [EPOCH * 10**9 + number * 10**8 for number in range(FRAMES)]
    for topic, messages in file.messages.items():
        records = [record for record, _ in messages]
        assert {record.publish_time - record.log_time for record in records} == {0}
        if topic != "/log":
            assert [record.log_time for record in records] == frames
            assert [record.sequence for record in records] == list(range(FRAMES))
    stamps = [image.timestamp.ToNanoseconds() for image in file.only("/ego_vehicle/Camera_Front/image")]
    assert stamps == frames
    assert datetime.fromtimestamp(EPOCH, tz=timezone.utc) == datetime(2024, 1, 1, tzinfo=timezone.utc)


def test_transforms_are_those_of_the_dataset(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for index, message in enumerate(file.only("/tf"), start=1):
        parent_from = {
            each.child_frame_id: (each.parent_frame_id, matrix_of(each.translation, each.rotation))
            for each in message.transforms
        }
        assert len(parent_from) == len(AGENTS) * (1 + len(CAMERAS) + 1)
        for agent in AGENTS:
            parent, world_from_ego = parent_from[agent]
            assert parent == "world"
            expected = da.world_from(sample(scenario, agent, index), "ego").matrix
            np.testing.assert_allclose(world_from_ego, expected, atol=1e-5)
            for channel in (*CAMERAS, LIDAR):
                parent, ego_from_sensor = parent_from[f"{agent}/{channel}"]
                assert parent == agent
                expected = da.world_from(sample(scenario, agent, index), channel).matrix
                np.testing.assert_allclose(world_from_ego @ ego_from_sensor, expected, atol=1e-4)


def test_poses_are_those_of_the_agents(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for agent in AGENTS:
        for index, message in enumerate(file.only(f"/{agent}/pose"), start=1):
            assert message.frame_id == "world"
            pose = matrix_of(message.pose.position, message.pose.orientation)
            expected = da.world_from(sample(scenario, agent, index), "ego").matrix
            np.testing.assert_allclose(pose, expected, atol=1e-5)


def test_images_are_the_files_bytes(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for agent in AGENTS:
        for camera in CAMERAS:
            for index, image in enumerate(file.only(f"/{agent}/{camera}/image"), start=1):
                stored = da.get_sample_data_path(f"{sample(scenario, agent, index)}/{camera}")
                assert image.data == stored.read_bytes()
                assert (image.format, image.frame_id) == ("jpeg", f"{agent}/{camera}")


def test_calibrations_project_into_the_images(da: DeepAccident, scenario: str, file: McapFile) -> None:
    image = file.only("/infrastructure/Camera_Back/image")[2]
    message = file.only("/infrastructure/Camera_Back/calibration")[2]
    assert (message.width, message.height) == Image.open(BytesIO(image.data)).size
    assert message.frame_id == image.frame_id
    _, _, intrinsic = da.get_sample_data(f"{sample(scenario, 'infrastructure', 3)}/Camera_Back")
    record = da.get("sample_data", f"{sample(scenario, 'infrastructure', 3)}/Camera_Back")
    assert intrinsic is not None
    scale = message.width / record["width"]
    expected = np.diag([scale, scale, 1.0]) @ intrinsic
    np.testing.assert_allclose(np.reshape(message.K, (3, 3)), expected, atol=1e-9)
    np.testing.assert_allclose(np.reshape(message.P, (3, 4))[:, :3], expected, atol=1e-9)
    np.testing.assert_array_equal(np.reshape(message.R, (3, 3)), np.eye(3))


def test_an_image_that_was_stored_smaller_has_a_calibration_of_its_size(
    da: DeepAccident, scenario: str, file: McapFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = tmp_path / "small.jpg"
    Image.new("RGB", (32, 18)).save(small)
    monkeypatch.setattr(type(da), "sensor_path", lambda *_: small)
    made = read_mcap(
        export_mcap(da, scenario, tmp_path / "a.mcap", agents=["ego_vehicle"], channels=["Camera_Front"], frames=[1])
    )
    half, whole = (each.only("/ego_vehicle/Camera_Front/calibration")[0] for each in (made, file))
    assert (half.width, half.height, whole.width, whole.height) == (32, 18, 64, 36)
    np.testing.assert_allclose(np.array(half.K)[:6], np.array(whole.K)[:6] / 2)


def test_clouds_have_all_points(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for agent in AGENTS:
        for index, message in enumerate(file.only(f"/{agent}/{LIDAR}/points"), start=1):
            stored, cloud = da.load_point_cloud(sample(scenario, agent, index), "lidar"), cloud_of(message)
            assert message.frame_id == f"{agent}/{LIDAR}"
            assert len(cloud) == len(stored) > 0
            np.testing.assert_allclose(xyz_of(cloud), stored.xyz, atol=1e-4)
            np.testing.assert_array_equal(cloud["intensity"], stored.intensity)


def test_actors_are_the_union_of_all_annotations(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for index, message in enumerate(file.only("/actors"), start=1):
        boxes = cooperative_boxes(da, sample(scenario, "ego_vehicle", index))
        assert len(message.entities) == len(boxes) > 0
        assert len({entity.id for entity in message.entities}) == len(boxes)
        for row, entity in enumerate(message.entities):
            (cube,) = entity.cubes
            pose = matrix_of(cube.pose.position, cube.pose.orientation)
            assert entity.frame_id == "world"
            np.testing.assert_allclose(pose[:3, 3], boxes.center[row], atol=1e-9)
            np.testing.assert_allclose(np.arctan2(pose[1, 0], pose[0, 0]), boxes.yaw[row], atol=1e-6)
            np.testing.assert_allclose([cube.size.x, cube.size.y, cube.size.z], boxes.size[row])
            facts = {pair.key: pair.value for pair in entity.metadata}
            assert facts["category"] == boxes.category_names[row]
            assert facts["num_lidar_pts"] == str(boxes.num_lidar_pts[row])
            if boxes.actor_id[row] != -1:
                assert entity.id == facts["actor_id"] == str(boxes.actor_id[row])
        assert [deletion.type for deletion in message.deletions] == [1]  # whoever has gone is not drawn any more


def test_actors_say_who_sees_them(da: DeepAccident, scenario: str, file: McapFile) -> None:
    seen_by = {agent: set() for agent in AGENTS}
    for entity in file.only("/actors")[1].entities:
        facts = {pair.key: pair.value for pair in entity.metadata}
        for agent in filter(None, facts["seen_by"].split(", ")):
            seen_by[agent].add(int(entity.id))
    for agent in AGENTS:
        tokens = visible_instances(da, sample(scenario, agent, 2), agents=[agent])
        assert seen_by[agent] == {int(token.rsplit("/", 1)[1]) for token in tokens}
    assert any(seen_by.values())


def test_the_colliding_pair_is_red_and_other_recorders_have_their_hues(
    da: DeepAccident, scenario: str, file: McapFile
) -> None:
    pair = da.get("scenario", scenario)["collision"]["ids"]
    agents = {each["actor_id"]: each["name"] for each in da.agent if each["scenario_token"] == scenario}
    colors, words = {}, {}
    for entity in file.only("/actors")[-1].entities:
        color = entity.cubes[0].color
        colors[entity.id] = "#" + bytes(round(255 * each) for each in (color.r, color.g, color.b)).hex()
        words[entity.id] = entity.texts[0].text
    assert [name for name, color in colors.items() if color == COLLIDER_COLOR] == sorted(map(str, pair), key=int)
    behind = {str(actor): AGENT_COLORS[agents[actor]] for actor in agents.keys() - {None, *pair}}
    assert {name: color for name, color in colors.items() if color in AGENT_COLORS.values()} == behind
    assert len(behind) == 2
    assert all("collides" in words[str(actor)] for actor in pair)
    cloud = cloud_of(file.only("/actors/points")[-1])
    red = (cloud["red"] == RED[0]) & (cloud["green"] == RED[1]) & (cloud["blue"] == RED[2]) & (cloud["alpha"] == 255)
    boxes = cooperative_boxes(da, sample(scenario, "ego_vehicle", FRAMES))
    two = boxes.select(np.isin(boxes.actor_id, pair))
    corners = two.corners().reshape(-1, 3)
    nearest = np.linalg.norm(xyz_of(cloud[red])[None] - corners[:, None], axis=-1).min(axis=1)
    assert (nearest < 1e-3).all()  # lines end at the corners


def test_annotations_are_each_agents_own(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for agent in AGENTS:
        boxes = da.boxes(sample(scenario, agent, 4), "lidar")
        message = file.only(f"/{agent}/annotations")[3]
        assert len(message.entities) == len(boxes)
        for row, entity in enumerate(message.entities):
            assert entity.frame_id == f"{agent}/{LIDAR}"
            facts = {pair.key: pair.value for pair in entity.metadata}
            assert facts["label_id"] == str(boxes.actor_id[row])
            assert facts["camera_visible"] == str(bool(boxes.camera_visible[row])).lower()
            points = np.array([[point.x, point.y, point.z] for point in entity.lines[0].points])
            np.testing.assert_allclose(points[:24].mean(axis=0), boxes.center[row], atol=1e-9)


def test_trails_lead_through_the_actors_centres(da: DeepAccident, scenario: str, file: McapFile) -> None:
    actor = da.get("scenario", scenario)["collision"]["ids"][0]
    centers = da.trajectory(f"{scenario}/actor/{actor}").center
    entity = next(entity for entity in file.only("/actors")[2].entities if entity.id == str(actor))
    _, trail, path = entity.lines
    assert (len(trail.points), len(path.points)) == (3, FRAMES - 2)
    places = [[point.x, point.y, point.z] for point in (*trail.points, *path.points[1:])]
    np.testing.assert_allclose(places, centers, atol=1e-9)


def test_motion_labels_are_points_on_their_cells(da: DeepAccident, scenario: str, file: McapFile) -> None:
    labels = motion_labels(da, sample(scenario, "ego_vehicle", 1), "deepaccident").to_present()
    message = file.only("/ego_vehicle/motion_labels/points")[0]
    cloud, grid = cloud_of(message), labels.config.grid
    assert message.frame_id == "ego_vehicle"
    index, inside = grid.index_of(xyz_of(cloud))
    assert inside.all()
    drawn = np.zeros_like(labels.instance)
    drawn[cloud["frame"], index[:, 0], index[:, 1]] = cloud["instance"]
    expected = np.where(labels.label_valid[:, None, None], labels.instance, 0)
    np.testing.assert_array_equal(drawn, expected)
    assert (expected[0] > 0).any()
    assert len(cloud) == np.count_nonzero(expected)


def test_the_countdown_ends_at_the_impact(da: DeepAccident, scenario: str, file: McapFile) -> None:
    values = [message.value for message in file.only("/time_to_impact")]
    assert values == pytest.approx([0.5, 0.4, 0.3, 0.2, 0.1, 0.0])
    texts = [message.message for message in file.only("/log")]
    assert texts[0].startswith(f"{scenario}: town ")
    assert texts[1] == "0.5 s to the impact"
    pair = da.get("scenario", scenario)["collision"]["ids"]
    assert texts[-1].startswith("impact: ")
    assert all(str(actor) in texts[-1] for actor in pair)


def test_the_metadata_tell_where_the_file_is_from(scenario: str, file: McapFile) -> None:
    told = file.metadata["deepaccident_devkit"]
    assert (told["devkit_version"], told["scenario"], told["release_version"]) == (__version__, scenario, "v1")
    assert len(bytes.fromhex(told["fingerprint"])) == 16


def test_the_same_choices_give_the_same_bytes(da: DeepAccident, scenario: str, path: Path, tmp_path: Path) -> None:
    again = export_mcap(da, da.get("scenario", scenario), tmp_path / "again.mcap", motion_labels="deepaccident")
    assert again.read_bytes() == path.read_bytes()
