"""Export MCAP files and read them back with the official library."""

import ast
import json
import logging
import re
import sys
from dataclasses import replace
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.command_calls import invoke_command
from support.expected_errors import assert_raises
from support.mcap_reader import McapFile, read_cloud, read_matrix, read_mcap, read_positions

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    MissingExtraError,
    NotAvailableError,
    SensorFileError,
    TokenError,
)
from deepaccident_devkit.evaluation.detection import (
    DetectedBoxes,
    detection_protocol,
    detection_truth,
)
from deepaccident_devkit.evaluation.forecasting import Forecast
from deepaccident_devkit.evaluation.forecasting.truth import forecasting_truth
from deepaccident_devkit.evaluation.planning import Plan, planning_scene
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.export.mcap import EPOCH, export_mcap
from deepaccident_devkit.export.mcap.layouts import write_layouts
from deepaccident_devkit.motion import MotionHeads, motion_labels
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR, MAP_COLORS
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CAMERAS,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    POLE_HEIGHT,
)
from deepaccident_devkit.v2x import cooperative_boxes

NUM_FRAMES = 6
IRREGULAR_TOPICS = ("/log", "/road/points")
"""Topics that do not have one message for each frame."""
PAGE = (Path(__file__).parents[3] / "docs" / "pictures.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def scenario(da: DeepAccident) -> str:
    return next(record["token"] for record in da.scenario if record["collision"] is not None)


@pytest.fixture(scope="module")
def path(da: DeepAccident, scenario: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mcap") / "new folder" / "accident.mcap"
    assert export_mcap(da, scenario, out, motion_labels="deepaccident") == out
    return out


@pytest.fixture(scope="module")
def recording(path: Path) -> McapFile:
    return read_mcap(path)


def sample_token(scenario: str, agent: str, number: int) -> str:
    return f"{scenario}/{agent}/{number:03d}"


def export_small(da: DeepAccident, scenario: str, folder: Path, **choices: Any) -> McapFile:
    """Export one agent and one frame without sensors, unless `choices` ask for more."""
    defaults = {"agents": ["ego_vehicle"], "channels": [], "frames": [2]}
    return read_mcap(export_mcap(da, scenario, folder / "small.mcap", **{**defaults, **choices}))


def test_every_topic_has_a_message_a_frame_and_the_schema_of_its_kind(recording: McapFile) -> None:
    agent_schemas = {
        "pose": "foxglove.PoseInFrame",
        f"{LIDAR}/points": "foxglove.PointCloud",
        "annotations": "foxglove.SceneUpdate",
        "motion_labels/points": "foxglove.PointCloud",
    }
    for camera in CAMERAS:
        agent_schemas[f"{camera}/image"] = "foxglove.CompressedImage"
        agent_schemas[f"{camera}/calibration"] = "foxglove.CameraCalibration"
    expected = {
        "/log": "foxglove.Log",
        "/tf": "foxglove.FrameTransforms",
        "/actors": "foxglove.SceneUpdate",
        "/actors/points": "foxglove.PointCloud",
        "/road/points": "foxglove.PointCloud",
        "/time_to_impact": "google.protobuf.DoubleValue",
    }
    for agent in AGENTS:
        expected |= {f"/{agent}/{name}": schema for name, schema in agent_schemas.items()}
        if agent != INFRASTRUCTURE:
            expected[f"/{agent}/speed"] = "google.protobuf.DoubleValue"

    assert recording.schemas == expected
    for topic, messages in recording.messages.items():
        assert topic in IRREGULAR_TOPICS or len(messages) == NUM_FRAMES, topic


def test_there_is_one_timeline_of_ten_frames_a_second(recording: McapFile) -> None:
    assert recording.log_times == sorted(recording.log_times)

    times_ns = [EPOCH * 10**9 + number * 10**8 for number in range(NUM_FRAMES)]
    for topic, messages in recording.messages.items():
        records = [record for record, _ in messages]
        assert {record.publish_time - record.log_time for record in records} == {0}
        if topic not in IRREGULAR_TOPICS:
            sequence = [(record.sequence, record.log_time) for record in records]
            assert sequence == list(enumerate(times_ns))
    images = recording.decoded("/ego_vehicle/Camera_Front/image")

    assert [image.timestamp.ToNanoseconds() for image in images] == times_ns


def test_transforms_and_poses_equal_the_dataset(
    da: DeepAccident, scenario: str, recording: McapFile
) -> None:
    for number, message in enumerate(recording.decoded("/tf"), start=1):
        parents = {}
        poses = {}
        for transform in message.transforms:
            parents[transform.child_frame_id] = transform.parent_frame_id
            pose = read_matrix(transform.translation, transform.rotation)
            poses[transform.child_frame_id] = pose

        assert len(poses) == len(AGENTS) * (1 + len(CAMERAS) + 1)

        for agent in AGENTS:
            posed = recording.decoded(f"/{agent}/pose")[number - 1]
            assert parents[agent] == posed.frame_id == "world"

            token = sample_token(scenario, agent, number)
            expected = da.world_from(token, "ego").matrix
            np.testing.assert_allclose(poses[agent], expected, atol=1e-5)

            pose = read_matrix(posed.pose.position, posed.pose.orientation)
            np.testing.assert_allclose(pose, expected, atol=1e-5)

            for channel in (*CAMERAS, LIDAR):
                sensor = f"{agent}/{channel}"
                assert parents[sensor] == agent
                expected = da.world_from(token, channel).matrix
                np.testing.assert_allclose(poses[agent] @ poses[sensor], expected, atol=1e-4)


def test_images_are_the_files_bytes(da: DeepAccident, scenario: str, recording: McapFile) -> None:
    for agent, camera in product(AGENTS, CAMERAS):
        images = recording.decoded(f"/{agent}/{camera}/image")
        for number, image in enumerate(images, start=1):
            token = sample_token(scenario, agent, number)
            assert image.data == da.get_sample_data_path(token, camera).read_bytes()
            assert (image.format, image.frame_id) == ("jpeg", f"{agent}/{camera}")


def test_calibrations_project_into_the_images(
    da: DeepAccident, scenario: str, recording: McapFile
) -> None:
    image = recording.decoded("/infrastructure/Camera_Back/image")[2]
    calibration = recording.decoded("/infrastructure/Camera_Back/calibration")[2]
    assert (calibration.width, calibration.height) == Image.open(BytesIO(image.data)).size
    assert calibration.frame_id == image.frame_id

    camera = da.camera(sample_token(scenario, "infrastructure", 3), "Camera_Back")
    scale = calibration.width / camera.width
    expected = np.diag([scale, scale, 1.0]) @ camera.intrinsic
    np.testing.assert_allclose(
        np.reshape(calibration.K, (3, 3)),
        expected,
        atol=1e-9,
    )
    np.testing.assert_allclose(
        np.reshape(calibration.P, (3, 4))[:, :3],
        expected,
        atol=1e-9,
    )


def test_a_smaller_image_has_a_calibration_of_its_size(
    da: DeepAccident,
    scenario: str,
    recording: McapFile,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    picture = tmp_path / "small.jpg"
    Image.new("RGB", (32, 18)).save(picture)
    monkeypatch.setattr(type(da), "sensor_path", lambda *_: picture)
    small = export_small(
        da,
        scenario,
        tmp_path,
        channels=["Camera_Front"],
        frames=[1],
    )
    topic = "/ego_vehicle/Camera_Front/calibration"
    half = small.decoded(topic)[0]
    whole = recording.decoded(topic)[0]

    assert (half.width, half.height) == (32, 18)
    assert (whole.width, whole.height) == (64, 36)
    np.testing.assert_allclose(np.array(half.K)[:6], np.array(whole.K)[:6] / 2)


def test_clouds_have_all_points(da: DeepAccident, scenario: str, recording: McapFile) -> None:
    for agent in AGENTS:
        for number, message in enumerate(recording.decoded(f"/{agent}/{LIDAR}/points"), start=1):
            stored = da.load_point_cloud(sample_token(scenario, agent, number), "lidar")
            cloud = read_cloud(message)
            assert message.frame_id == f"{agent}/{LIDAR}"
            assert len(cloud) == len(stored) > 0
            # the export rounds to 1/32
            np.testing.assert_allclose(
                read_positions(cloud),
                stored.xyz,
                rtol=0,
                atol=1 / 64,
            )
            np.testing.assert_allclose(
                cloud["intensity"],
                stored.intensity,
                rtol=0,
                atol=1 / 64,
            )


def test_road_and_speed_equal_the_bev_camera_and_the_boxes(
    da: DeepAccident, scenario: str, recording: McapFile
) -> None:
    (message,) = recording.decoded("/road/points")
    cloud = read_cloud(message)
    colors = np.column_stack([cloud[name] for name in ("red", "green", "blue")])
    is_road = (colors == tuple(bytes.fromhex(MAP_COLORS["road"][1:]))).all(axis=1)
    token = sample_token(scenario, "ego_vehicle", 1)
    ego_from_world = da.world_from(token, "ego").inverse()
    positions = ego_from_world.apply(read_positions(cloud)[is_road])[:, :2]
    positions = positions[np.abs(positions).max(axis=1) < 50]
    rows, columns = np.rint(599.5 - positions.T / 0.1).astype(int)
    tags = da.load_bev(token).semantic[rows, columns]

    assert len(tags) > 1000
    assert np.mean(tags == TAGS["road"]) > 0.9

    boxes = da.boxes(token, "world")
    speed = np.linalg.norm(boxes.velocity[boxes.actor_id == OWN_ACTOR_ID])
    assert recording.decoded("/ego_vehicle/speed")[0].value == pytest.approx(speed, abs=0.1)


def test_layouts_beside_the_file_name_its_topics(path: Path, recording: McapFile) -> None:
    layout = json.loads(path.with_suffix(".foxglove.json").read_text())
    panels = layout["configById"]
    topics = set(panels["3D!scene"]["topics"])
    for plot in panels["Plot!values"]["paths"]:
        topics.add(plot["value"].removesuffix(".value"))
    for panel in ("Image!0", "Image!1"):
        mode = panels[panel]["imageMode"]
        topics |= {mode["imageTopic"], mode["calibrationTopic"]}
    script = path.with_suffix(".rerun.py").read_text()
    topics |= set(re.findall(r"'(/[^']+)'", script))

    assert topics <= recording.messages.keys()
    assert {"/road/points", "/actors", "/ego_vehicle/speed", "/time_to_impact"} <= topics


@pytest.mark.parametrize(
    "name", ['a"""; print(1); """', "b'\\", "c{d}%s", "new\nline", "caf\xe9 \udcff"]
)
def test_a_file_name_cannot_become_code_in_its_script(name: str, tmp_path: Path) -> None:
    write_layouts(tmp_path / f"{name}.mcap", [])
    module = ast.parse((tmp_path / f"{name}.rerun.py").read_text())
    statements = [ast.unparse(node) for node in module.body if isinstance(node, ast.Expr)]
    assert statements == [repr(ast.get_docstring(module, clean=False))]

    calls = [node for node in ast.walk(module) if isinstance(node, ast.Call)]
    [call] = [node for node in calls if ast.unparse(node.func).endswith("with_name")]
    assert [ast.literal_eval(argument) for argument in call.args] == [f"{name}.mcap"]


def test_actors_are_the_union_of_all_annotations(
    da: DeepAccident, scenario: str, recording: McapFile
) -> None:
    for number, message in enumerate(recording.decoded("/actors"), start=1):
        boxes = cooperative_boxes(da, sample_token(scenario, "ego_vehicle", number))
        entity_ids = {entity.id for entity in message.entities}
        assert len(message.entities) == len(entity_ids) == len(boxes) > 0

        for row, entity in enumerate(message.entities):
            (cube,) = entity.cubes
            pose = read_matrix(cube.pose.position, cube.pose.orientation)
            yaw = np.arctan2(pose[1, 0], pose[0, 0])
            np.testing.assert_allclose(
                pose[:3, 3],
                boxes.center[row],
                atol=1e-9,
            )
            np.testing.assert_allclose(
                yaw,
                boxes.yaw[row],
                atol=1e-6,
            )

            size = [
                cube.size.x,
                cube.size.y,
                cube.size.z,
            ]
            np.testing.assert_allclose(size, boxes.size[row])

            facts = {pair.key: pair.value for pair in entity.metadata}
            assert entity.frame_id == "world"
            assert facts["category"] == boxes.category_names[row]
            assert facts["num_lidar_pts"] == str(boxes.num_lidar_pts[row])

            actor = boxes.actor_id[row]
            assert actor == -1 or entity.id == facts["actor_id"] == str(actor)


def test_colliders_are_red_and_other_recording_agents_have_their_colours(
    da: DeepAccident, scenario: str, recording: McapFile
) -> None:
    colors = {}
    for entity in recording.decoded("/actors")[-1].entities:
        color = entity.cubes[0].color
        channels = [round(255 * share) for share in (color.r, color.g, color.b)]
        colors[entity.id] = "#" + bytes(channels).hex()
    colliders = da.get("scenario", scenario)["collision"]["ids"]
    red_ids = [actor for actor, color in colors.items() if color == COLLIDER_COLOR]

    assert red_ids == sorted(map(str, colliders), key=int)

    expected = {}
    for agent in da.agent:
        actor = agent["actor_id"]
        if agent["scenario_token"] == scenario and actor not in {None, *colliders}:
            expected[str(actor)] = AGENT_COLORS[agent["name"]]
    hues = AGENT_COLORS.values()

    assert {actor: color for actor, color in colors.items() if color in hues} == expected


def test_annotations_are_each_agents_own(
    da: DeepAccident, scenario: str, recording: McapFile
) -> None:
    for agent in AGENTS:
        boxes = da.boxes(sample_token(scenario, agent, 4), "lidar")
        message = recording.decoded(f"/{agent}/annotations")[3]
        assert len(message.entities) == len(boxes)

        for row, entity in enumerate(message.entities):
            facts = {pair.key: pair.value for pair in entity.metadata}
            assert entity.frame_id == f"{agent}/{LIDAR}"
            assert facts["label_id"] == str(boxes.actor_id[row])
            assert facts["camera_visible"] == str(bool(boxes.camera_visible[row])).lower()
            points = np.array([[point.x, point.y, point.z] for point in entity.lines[0].points])
            np.testing.assert_allclose(
                points[:24].mean(axis=0),
                boxes.center[row],
                atol=1e-9,
            )


def test_motion_labels_are_points_on_their_cells(
    da: DeepAccident, scenario: str, recording: McapFile
) -> None:
    token = sample_token(scenario, "ego_vehicle", 1)
    labels = motion_labels(da, token, "deepaccident").to_present()
    message = recording.decoded("/ego_vehicle/motion_labels/points")[0]
    assert message.frame_id == "ego_vehicle"

    cloud = read_cloud(message)
    cells, is_inside = labels.config.grid.index_of(read_positions(cloud))
    assert is_inside.all()

    drawn = np.zeros_like(labels.instance)
    drawn[cloud["frame"], cells[:, 0], cells[:, 1]] = cloud["instance"]
    expected = np.where(
        labels.label_valid[:, None, None],
        labels.instance,
        0,
    )
    np.testing.assert_array_equal(drawn, expected)
    assert (expected[0] > 0).any()
    assert len(cloud) == np.count_nonzero(expected)


def test_the_countdown_ends_at_the_impact(
    da: DeepAccident, scenario: str, recording: McapFile
) -> None:
    times_s = [message.value for message in recording.decoded("/time_to_impact")]
    assert times_s == pytest.approx([0.5, 0.4, 0.3, 0.2, 0.1, 0.0])

    facts, first, *_, last = [message.message for message in recording.decoded("/log")]
    assert facts.startswith(f"{scenario}: town ")
    assert first == "0.5 s to the impact"

    one, other = da.get("scenario", scenario)["collision"]["ids"]
    assert re.fullmatch(rf"impact: .*\b({one}\b.*\b{other}|{other}\b.*\b{one})\b.*", last)


def test_agents_channels_and_frames_can_be_chosen(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    recording = export_small(
        da,
        scenario,
        tmp_path,
        agents="+infrastructure",
        channels=[LIDAR, "Camera_Back"],
        frames=range(2, 6, 2),
    )
    endings = ("/image", f"{LIDAR}/points")

    assert {topic for topic in recording.messages if topic.endswith(endings)} == {
        "/ego_vehicle/Camera_Back/image",
        f"/ego_vehicle/{LIDAR}/points",
        "/infrastructure/Camera_Back/image",
        f"/infrastructure/{LIDAR}/points",
    }

    times_ns = [record.log_time for record, _ in recording.messages["/tf"]]
    assert np.diff(times_ns).tolist() == [2 * 10**8]

    transforms = recording.decoded("/tf")[0].transforms
    assert len({transform.child_frame_id for transform in transforms}) == 2 * 8


@pytest.mark.slow
def test_scenarios_without_labels_have_poses_and_no_boxes(
    unlabelled_dataset: DeepAccident, tmp_path: Path
) -> None:
    scenario = unlabelled_dataset.scenario[0]["token"]
    choices = {"motion_labels": "deepaccident", "frames": [1, 2]}
    recording = export_small(unlabelled_dataset, scenario, tmp_path, **choices)
    assert len(recording.decoded("/tf")) == 2
    assert [len(message.entities) for message in recording.decoded("/actors")] == [0, 0]
    assert [len(message.data) for message in recording.decoded("/actors/points")] == [0, 0]
    assert not [
        topic for topic in recording.messages if "annotations" in topic or "motion" in topic
    ]


def test_the_code_on_the_page_runs(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE))
    assert "deepaccident_demo/release" in code
    code = code.replace("deepaccident_demo/release", str(da.dataroot))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "pictures.md", "exec"), {})  # noqa: S102
    assert len(read_mcap(tmp_path / "accident.mcap").decoded("/actors")) == 6


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"agent": "ego_vehicle"}, "'agent'.*agents"),
        ({"channels": 1}, "channels: .*Camera_Front.*1"),
        ({"channels": ["BEV_instance_camera"]}, "channels: .*'BEV_instance_"),
        ({"frames": 3}, "frames: .*3"),
        ({"frames": [1.5]}, "frames: .*1.5"),
        ({"frames": []}, "frames: .*at least one"),
        ({"frames": [6, 7]}, "frames: .*1 to 6.*7"),
        ({"frames": [0]}, "frames: .*1 to 6.*0"),
        ({"points": 0}, "points: .*0"),
        ({"points": "some"}, "points: .*'some'"),
        ({"agents": ["ego"]}, "agents: .*'ego'"),
        ({"motion_labels": "mine"}, "'mine'"),
    ],
)
def test_impossible_choices_are_refused(
    da: DeepAccident, scenario: str, tmp_path: Path, choices: dict[str, Any], message: str
) -> None:
    with pytest.raises(ChoiceError, match=message):
        export_mcap(da, scenario, tmp_path / "a.mcap", **choices)
    assert not list(tmp_path.iterdir())


def test_missing_files_are_left_out_with_a_warning(
    da_b: DeepAccident, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    choices = {"agents": AGENTS, "channels": ["Camera_Front", LIDAR], "frames": [1, 2]}
    with caplog.at_level(logging.WARNING):
        recording = export_small(
            da_b,
            da_b.scenario[0]["token"],
            tmp_path,
            **choices,
        )
    assert not [topic for topic in recording.messages if "Camera" in topic or LIDAR in topic]
    (record,) = caplog.records
    assert "10 of 10 Camera_Front files, 10 of 10 lidar01 files" in record.getMessage()


def test_an_unreadable_image_is_an_error_and_the_old_file_stays(
    da: DeepAccident, scenario: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged = tmp_path / "damaged.jpg"
    damaged.write_bytes(b"\xff\xd8no picture")
    old_file = tmp_path / "a.mcap"
    old_file.write_bytes(b"before")

    def export() -> None:
        export_mcap(da, scenario, old_file, channels=["Camera_Front"])

    for path, message in (
        (damaged, "damaged.jpg: not a readable image"),
        (tmp_path, "not a regular file (a folder)"),
    ):
        monkeypatch.setattr(type(da), "sensor_path", lambda *_, path=path: path)
        assert_raises((export, SensorFileError, (message, "restore the file")))

    assert {file.name: file.read_bytes()[:6] for file in tmp_path.iterdir()} == {
        "a.mcap": b"before",
        "damaged.jpg": b"\xff\xd8no p",
    }


def test_a_predicted_motion_is_drawn_on_its_cells(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    token = sample_token(scenario, "ego_vehicle", 2)
    labels = motion_labels(da, token).to_present()
    grid = labels.config.grid
    for output in (
        MotionOutput(grid=grid, instances=labels.instance[None]),
        MotionOutput(grid=grid, heads=(MotionHeads.from_labels(labels),)),
    ):
        recording = export_small(da, scenario, tmp_path, prediction={token: output})
        (message,) = recording.decoded("/ego_vehicle/prediction/motion/points")
        assert message.frame_id == "ego_vehicle"
        cloud = read_cloud(message)
        cells, _ = grid.index_of(read_positions(cloud[cloud["frame"] == 0]))
        is_occupied = np.zeros(labels.instance[0].shape, dtype=bool)
        is_occupied[tuple(cells.T)] = True
        np.testing.assert_array_equal(is_occupied, labels.instance[0] > 0)


def test_predicted_accidents_are_drawn_at_their_positions(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    accident = Accident(
        positions=np.array([[10.0, 2.0], [13.0, -1.0]]), time=1.5, score=0.75, ids=(3, 9)
    )
    path = tmp_path / "results.json"
    with ResultsWriter(path, "accident") as writer:
        writer.add(sample_token(scenario, "ego_vehicle", 2), [accident])
    results = read_results(path)
    recording = export_small(
        da,
        scenario,
        tmp_path,
        prediction=results,
        frames=[1, 2],
    )
    ((record, message),) = recording.messages["/ego_vehicle/prediction/marks"]
    true, entity = message.entities
    second_transform, _ = recording.messages["/tf"][1]

    assert record.log_time == second_transform.log_time
    assert entity.frame_id == "ego_vehicle"

    positions = [sphere.pose.position for sphere in entity.spheres]
    np.testing.assert_allclose([[point.x, point.y] for point in positions], accident.positions)
    facts = {pair.key: pair.value for pair in entity.metadata}
    assert (facts["label"], facts["time"]) == ("predicted collision", "1.500")
    assert {pair.key: pair.value for pair in true.metadata}["label"] == "actual collision"
    assert [alarm.value for alarm in recording.decoded("/ego_vehicle/prediction/alarm")] == [0.75]


def test_detected_boxes_are_drawn_right_false_and_missed(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    token = sample_token(scenario, "ego_vehicle", 2)
    true_boxes = detection_truth(da, token, detection_protocol("released"))
    (row, *_) = np.flatnonzero(np.hypot(*true_boxes.center[:, :2].T) < 30)
    boxes = true_boxes.select(np.array([row, row]))
    boxes = replace(boxes, center=boxes.center + np.array([[0.0, 0, 0], [0, 25, 0]]))
    right, false = boxes
    in_world = boxes.transform(da.world_from(token, boxes.frame), "world")
    detected = DetectedBoxes(boxes=in_world, scores=np.array([0.9, 0.8]))

    recording = export_small(da, scenario, tmp_path, prediction={token: detected})

    (message,) = recording.decoded("/ego_vehicle/prediction/boxes")
    centers = {}
    for entity in message.entities:
        assert entity.frame_id == f"ego_vehicle/{LIDAR}"
        if entity.cubes:
            position = entity.cubes[0].pose.position
            centers[entity.id.split()[0]] = (position.x, position.y, position.z)
    np.testing.assert_allclose(centers["right"], right.center, atol=1e-6)
    np.testing.assert_allclose(centers["false"], false.center, atol=1e-6)
    assert {*centers} == {"right", "false", "collision"}
    cloud = read_cloud(recording.decoded("/ego_vehicle/prediction/boxes/points")[0])
    offsets = read_positions(cloud)[None] - boxes.corners()[0][:, None]
    distances_m = np.linalg.norm(offsets, axis=-1)
    assert (distances_m.min(axis=1) < 1e-4).all()


def read_paths(recording: McapFile) -> list[tuple[tuple[float, ...], np.ndarray]]:
    """Read the colours (RGBA) and positions of an agent's drawn paths."""
    (message,) = recording.decoded("/ego_vehicle/prediction/paths")
    paths = []
    for entity in message.entities:
        assert entity.frame_id == "ego_vehicle"
        (line,) = entity.lines
        points = np.array([[point.x, point.y] for point in line.points])
        color = (line.color.r, line.color.g, line.color.b, line.color.a)
        paths.append((color, np.vstack([points[::2], points[-1:]])))
    return paths


def test_plans_and_forecasts_are_drawn_where_predictions_and_records_say(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    token = sample_token(scenario, "ego_vehicle", 2)
    times = np.array([1.0, 2.0])
    path = np.array([[5.0, 0.5], [11.0, 2.0]])
    truth = forecasting_truth(da, token)
    present = np.concatenate([truth.present[0], path[0]]).reshape(2, 2)
    forecast = Forecast(
        actor_id=int(truth.actor_id[0]),
        times=times,
        paths=np.stack([path, path + 1.0]),
        probabilities=[0.8, 0.2],
    )
    recorded = planning_scene(da, token).recorded[:, :2]
    true_path = np.concatenate([present[:1], truth.path[0]])
    for prediction, expected, opacities in (
        (Plan(times=times, path=path), [np.vstack([np.zeros(2), path]), recorded], [1, 1]),
        (forecast, [path, path + 1.0, true_path[np.isfinite(true_path[:, 0])]], [1, 0.4, 1]),
    ):
        recording = export_small(da, scenario, tmp_path, prediction={token: [prediction]})
        paths = read_paths(recording)
        cloud = read_cloud(recording.decoded("/ego_vehicle/prediction/paths/points")[0])
        points = read_positions(cloud)[None, :, :2]
        for positions, opacity in zip(expected, opacities, strict=True):
            (color,) = [
                color
                for color, drawn in paths
                if len(drawn) == len(positions) and np.allclose(drawn, positions, atol=1e-5)
            ]
            assert color[3] == pytest.approx(opacity)
            distances = np.linalg.norm(points - positions[:, None], axis=-1)
            assert distances.min(axis=1).max() < 1e-4
        if isinstance(prediction, Plan):
            assert paths[1][0] == (1, 1, 1, 1)


def test_marks_of_an_earlier_frame_are_removed(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    first, second = (sample_token(scenario, "ego_vehicle", number) for number in (2, 3))
    alarm = Accident(positions=np.array([[5.0, 1.0], [6.0, 1.0]]), time=0.1, score=0.9)
    plan = Plan(times=np.array([1.0]), path=np.array([[0.0, 90.0]]))
    predictions: Any = {first: [alarm], second: [plan]}
    recording = export_small(da, scenario, tmp_path, prediction=predictions, frames=[2, 3])
    counts = [len(marks.entities) for marks in recording.decoded("/ego_vehicle/prediction/marks")]
    assert counts[0] >= 1
    assert counts[1] == 0


@pytest.mark.slow
def test_a_release_without_the_truth_still_shows_the_prediction(
    unlabelled_dataset: DeepAccident, tmp_path: Path
) -> None:
    scenario = unlabelled_dataset.scenario[0]["token"]
    token = sample_token(scenario, "infrastructure", 1)
    alarm = Accident(positions=np.array([[5.0, 1.0], [6.0, 1.0]]), time=1.0, score=0.9)
    recording = export_small(
        unlabelled_dataset,
        scenario,
        tmp_path,
        prediction={token: [alarm]},
        agents=["infrastructure"],
        frames=[1],
    )
    (marks,) = recording.decoded("/infrastructure/prediction/marks")
    (entity,) = marks.entities
    heights = [sphere.pose.position.z for sphere in entity.spheres]
    assert heights == [1.0 - POLE_HEIGHT] * 2


def test_unknown_scenarios_and_invalid_predictions_are_refused(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    token = sample_token(scenario, "ego_vehicle", 2)

    def export(prediction: Any, **choices: Any) -> McapFile:
        return export_small(da, scenario, tmp_path, prediction=prediction, **choices)

    assert_raises(
        (
            lambda: export_mcap(da, "nowhere/nothing", tmp_path / "a.mcap"),
            TokenError,
            "no token 'nowhere/nothing'",
        ),
        (
            lambda: export([token]),
            ConfigError,
            ("prediction", "expected Results, or a mapping", "found list"),
        ),
        (
            lambda: export({token: "an accident"}),
            ChoiceError,
            ("DetectedBoxes, or a list of Accidents", "found str"),
        ),
        (
            lambda: export({token: []}, frames=[3]),
            NotAvailableError,
            ("prediction", scenario, "agents and frames"),
        ),
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("package", ["mcap", "foxglove_schemas_protobuf"])
def test_without_the_extra_the_error_names_it(
    da: DeepAccident, scenario: str, tmp_path: Path, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    prefixes = ("deepaccident_devkit.export.mcap.", f"{package}.")
    for name in list(sys.modules):
        if name.startswith(prefixes) and not name.endswith(".config"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)

    with pytest.raises(MissingExtraError, match=re.escape("pip install '.[mcap]'")):
        export_mcap(da, scenario, tmp_path / "a.mcap")


def test_the_command_exports_the_first_accident_or_a_chosen_scenario(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    token = da.scenario[1]["token"]
    results = tmp_path / "results.json"
    with ResultsWriter(results, "accident") as writer:
        writer.add(sample_token(token, "ego_vehicle", 2), [])
    options = (
        *("--frame-range", "2..3", "--channels", LIDAR, "--points", 10),
        *("--agents", "ego_vehicle,infrastructure"),
    )

    def export(path: Path, *arguments: object) -> McapFile:
        invoke_command("export", "mcap", da.dataroot, *arguments, "--out", path, *options)
        return read_mcap(path)

    first = export(tmp_path / "first.mcap")

    assert first.metadata["deepaccident_devkit"]["scenario"] == scenario

    recording = export(tmp_path / "a.mcap", token, "--results", results)
    assert recording.metadata["deepaccident_devkit"]["scenario"] == token
    assert len(recording.decoded("/tf")) == 2
    assert {topic for topic in recording.messages if LIDAR in topic} == {
        f"/ego_vehicle/{LIDAR}/points",
        f"/{AGENTS[-1]}/{LIDAR}/points",
    }
    assert [alarm.value for alarm in recording.decoded("/ego_vehicle/prediction/alarm")] == [0.0]
    curves = json.loads((tmp_path / "a.foxglove.json").read_text())["configById"]["Plot!values"]
    assert curves["paths"][-1]["value"] == "/ego_vehicle/prediction/alarm.value"
