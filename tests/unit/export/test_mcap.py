"""Files of MCAP, read back by the format's own library: what is in them, what goes in, and what
errors say.
"""

import ast
import json
import logging
import re
import sys
from functools import partial
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap_reading import McapFile, cloud_of, matrix_of, read_mcap, xyz_of
from PIL import Image
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.export import export
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    MissingExtraError,
    NotAvailableError,
    SensorFileError,
    TokenError,
)
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.predictions import Accident, MotionOutput
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.export.mcap import EPOCH, export_mcap
from deepaccident_devkit.export.mcap.layouts import write_layouts
from deepaccident_devkit.motion import MotionHeads, motion_labels
from deepaccident_devkit.release.npz import TAGS
from deepaccident_devkit.render.styles import AGENT_COLORS, COLLIDER_COLOR, MAP_COLORS
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, INFRASTRUCTURE, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.v2x import cooperative_boxes

FRAMES = 6
ONCE = ("/log", "/road/points")
"""Topics without a message a frame."""


@pytest.fixture(scope="module")
def scenario(da: DeepAccident) -> str:
    return next(record["token"] for record in da.scenario if record["collision"] is not None)


@pytest.fixture(scope="module")
def path(da: DeepAccident, scenario: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    wanted = tmp_path_factory.mktemp("mcap") / "new folder" / "accident.mcap"
    assert export_mcap(da, scenario, wanted, motion_labels="deepaccident") == wanted
    return wanted


@pytest.fixture(scope="module")
def file(path: Path) -> McapFile:
    return read_mcap(path)


def sample(scenario: str, agent: str, index: int) -> str:
    return f"{scenario}/{agent}/{index:03d}"


def test_every_topic_has_a_message_a_frame_and_the_schema_of_its_kind(file: McapFile) -> None:
    cloud, update = "PointCloud", "SceneUpdate"
    of_agent = {"pose": "PoseInFrame", f"{LIDAR}/points": cloud, "annotations": update}
    of_agent |= {
        "motion_labels/points": cloud,
        **{f"{camera}/image": "CompressedImage" for camera in CAMERAS},
    }
    of_agent |= {f"{camera}/calibration": "CameraCalibration" for camera in CAMERAS}
    expected = {
        "/log": "Log",
        "/tf": "FrameTransforms",
        "/actors": update,
        "/actors/points": cloud,
        "/road/points": cloud,
    }
    expected |= {f"/{agent}/{name}": kind for agent in AGENTS for name, kind in of_agent.items()}
    wanted = {topic: f"foxglove.{name}" for topic, name in expected.items()}
    numbers = [
        "/time_to_impact",
        *(f"/{agent}/speed" for agent in AGENTS if agent != INFRASTRUCTURE),
    ]
    assert file.schemas == {**wanted, **dict.fromkeys(numbers, "google.protobuf.DoubleValue")}
    assert {len(messages) for topic, messages in file.messages.items() if topic not in ONCE} == {
        FRAMES
    }


def test_there_is_one_timeline_of_ten_frames_a_second(file: McapFile) -> None:
    assert file.log_times == sorted(file.log_times)
    frames = [EPOCH * 10**9 + number * 10**8 for number in range(FRAMES)]
    for topic, messages in file.messages.items():
        assert {record.publish_time - record.log_time for record, _ in messages} == {0}
        if topic not in ONCE:
            assert [(record.sequence, record.log_time) for record, _ in messages] == [
                *enumerate(frames)
            ]
    assert [
        image.timestamp.ToNanoseconds() for image in file.only("/ego_vehicle/Camera_Front/image")
    ] == frames


def test_transforms_and_poses_are_those_of_the_dataset(
    da: DeepAccident, scenario: str, file: McapFile
) -> None:
    for index, message in enumerate(file.only("/tf"), start=1):
        parent_from = {
            each.child_frame_id: (each.parent_frame_id, matrix_of(each.translation, each.rotation))
            for each in message.transforms
        }
        assert len(parent_from) == len(AGENTS) * (1 + len(CAMERAS) + 1)
        for agent in AGENTS:
            parent, world_from_ego = parent_from[agent]
            told = file.only(f"/{agent}/pose")[index - 1]
            assert (parent, told.frame_id) == ("world", "world")
            expected = da.world_from(sample(scenario, agent, index), "ego").matrix
            for pose in (world_from_ego, matrix_of(told.pose.position, told.pose.orientation)):
                np.testing.assert_allclose(pose, expected, atol=1e-5)
            for channel in (*CAMERAS, LIDAR):
                parent, ego_from_sensor = parent_from[f"{agent}/{channel}"]
                assert parent == agent
                expected = da.world_from(sample(scenario, agent, index), channel).matrix
                np.testing.assert_allclose(world_from_ego @ ego_from_sensor, expected, atol=1e-4)


def test_images_are_the_files_bytes(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for agent in AGENTS:
        for camera in CAMERAS:
            for index, image in enumerate(file.only(f"/{agent}/{camera}/image"), start=1):
                assert (
                    image.data
                    == da.get_sample_data_path(
                        f"{sample(scenario, agent, index)}/{camera}"
                    ).read_bytes()
                )
                assert (image.format, image.frame_id) == ("jpeg", f"{agent}/{camera}")


def test_calibrations_project_into_the_images(
    da: DeepAccident, scenario: str, file: McapFile
) -> None:
    image, message = (
        file.only(f"/infrastructure/Camera_Back/{kind}")[2] for kind in ("image", "calibration")
    )
    assert (message.width, message.height) == Image.open(BytesIO(image.data)).size
    assert message.frame_id == image.frame_id
    camera = da.camera(sample(scenario, "infrastructure", 3), "Camera_Back")
    scale = message.width / camera.width
    expected = np.diag([scale, scale, 1.0]) @ camera.intrinsic
    np.testing.assert_allclose(np.reshape(message.K, (3, 3)), expected, atol=1e-9)
    np.testing.assert_allclose(np.reshape(message.P, (3, 4))[:, :3], expected, atol=1e-9)


def test_an_image_that_was_stored_smaller_has_a_calibration_of_its_size(
    da: DeepAccident, scenario: str, file: McapFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = tmp_path / "small.jpg"
    Image.new("RGB", (32, 18)).save(small)
    monkeypatch.setattr(type(da), "sensor_path", lambda *_: small)
    made = read_mcap(
        export_mcap(
            da,
            scenario,
            tmp_path / "a.mcap",
            agents=["ego_vehicle"],
            channels=["Camera_Front"],
            frames=[1],
        )
    )
    half, whole = (each.only("/ego_vehicle/Camera_Front/calibration")[0] for each in (made, file))
    assert (half.width, half.height, whole.width, whole.height) == (32, 18, 64, 36)
    np.testing.assert_allclose(np.array(half.K)[:6], np.array(whole.K)[:6] / 2)


def test_clouds_have_all_points(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for agent in AGENTS:
        for index, message in enumerate(file.only(f"/{agent}/{LIDAR}/points"), start=1):
            stored, cloud = (
                da.load_point_cloud(sample(scenario, agent, index), "lidar"),
                cloud_of(message),
            )
            assert message.frame_id == f"{agent}/{LIDAR}"
            assert len(cloud) == len(stored) > 0
            np.testing.assert_allclose(
                xyz_of(cloud), stored.xyz, rtol=0, atol=1 / 64
            )  # rounded to 1/32
            np.testing.assert_allclose(cloud["intensity"], stored.intensity, rtol=0, atol=1 / 64)


def test_road_and_speeds_are_those_of_bev_camera_and_boxes(
    da: DeepAccident, scenario: str, file: McapFile
) -> None:
    (message,) = file.only("/road/points")
    cloud, first = cloud_of(message), sample(scenario, "ego_vehicle", 1)
    colors = np.column_stack([cloud[name] for name in ("red", "green", "blue")])
    road = (colors == tuple(bytes.fromhex(MAP_COLORS["road"][1:]))).all(axis=1)
    near = da.world_from(first, "ego").inverse().apply(xyz_of(cloud)[road])
    row, column = np.rint(599.5 - near[np.abs(near[:, :2]).max(axis=1) < 50, :2].T / 0.1).astype(
        int
    )
    seen = da.load_bev(first).semantic[row, column]
    assert (len(seen) > 1000, np.mean(seen == TAGS["road"]) > 0.9) == (True, True)
    own = da.boxes(first, "world").velocity[da.boxes(first).actor_id == OWN_ACTOR_ID]
    assert file.only("/ego_vehicle/speed")[0].value == pytest.approx(np.linalg.norm(own), abs=0.1)


def test_layouts_beside_the_file_name_its_topics(path: Path, file: McapFile) -> None:
    layout = json.loads(path.with_suffix(".foxglove.json").read_text())
    panels, script = layout["configById"], path.with_suffix(".rerun.py").read_text()
    named = {
        *panels["3D!scene"]["topics"],
        *(one["value"].removesuffix(".value") for one in panels["Plot!values"]["paths"]),
    }
    named |= {
        panels[f"Image!{number}"]["imageMode"][kind]
        for number in (0, 1)
        for kind in ("imageTopic", "calibrationTopic")
    }
    named |= {*re.findall(r"'(/[^']+)'", script)}
    assert named <= {*file.messages}
    assert {"/road/points", "/actors", "/ego_vehicle/speed", "/time_to_impact"} <= named


@pytest.mark.parametrize(
    "name", ['a"""; print(1); """', "b'\\", "c{d}%s", "new\nline", "caf\xe9 \udcff"]
)
def test_no_name_of_a_file_is_code_in_its_script(name: str, tmp_path: Path) -> None:
    write_layouts(tmp_path / f"{name}.mcap", [])
    module = ast.parse((tmp_path / f"{name}.rerun.py").read_text())
    statements = [ast.unparse(each) for each in module.body if isinstance(each, ast.Expr)]
    assert statements == [repr(ast.get_docstring(module, clean=False))]
    calls = [each for each in ast.walk(module) if isinstance(each, ast.Call)]
    [names] = [each.args for each in calls if ast.unparse(each.func).endswith("with_name")]
    assert [ast.literal_eval(each) for each in names] == [f"{name}.mcap"]


def test_actors_are_the_union_of_all_annotations(
    da: DeepAccident, scenario: str, file: McapFile
) -> None:
    for index, message in enumerate(file.only("/actors"), start=1):
        boxes = cooperative_boxes(da, sample(scenario, "ego_vehicle", index))
        assert (
            len(message.entities)
            == len({entity.id for entity in message.entities})
            == len(boxes)
            > 0
        )
        for row, entity in enumerate(message.entities):
            (cube,) = entity.cubes
            pose, size = matrix_of(cube.pose.position, cube.pose.orientation), cube.size
            np.testing.assert_allclose(pose[:3, 3], boxes.center[row], atol=1e-9)
            np.testing.assert_allclose(
                np.arctan2(pose[1, 0], pose[0, 0]), boxes.yaw[row], atol=1e-6
            )
            np.testing.assert_allclose([size.x, size.y, size.z], boxes.size[row])
            facts = {pair.key: pair.value for pair in entity.metadata}
            told = (entity.frame_id, facts["category"], facts["num_lidar_pts"])
            assert told == ("world", boxes.category_names[row], str(boxes.num_lidar_pts[row]))
            assert boxes.actor_id[row] == -1 or entity.id == facts["actor_id"] == str(
                boxes.actor_id[row]
            )


def test_the_colliding_pair_is_red_and_other_recorders_have_their_hues(
    da: DeepAccident, scenario: str, file: McapFile
) -> None:
    pair = da.get("scenario", scenario)["collision"]["ids"]
    agents = {
        each["actor_id"]: each["name"] for each in da.agent if each["scenario_token"] == scenario
    }
    entities = {entity.id: entity for entity in file.only("/actors")[-1].entities}
    channels = {
        name: attrgetter("r", "g", "b")(each.cubes[0].color) for name, each in entities.items()
    }
    colors = {
        name: "#" + bytes(round(255 * each) for each in color).hex()
        for name, color in channels.items()
    }
    assert [name for name, color in colors.items() if color == COLLIDER_COLOR] == sorted(
        map(str, pair), key=int
    )
    behind = {str(actor): AGENT_COLORS[agents[actor]] for actor in agents.keys() - {None, *pair}}
    assert {
        name: color for name, color in colors.items() if color in AGENT_COLORS.values()
    } == behind


def test_annotations_are_each_agents_own(da: DeepAccident, scenario: str, file: McapFile) -> None:
    for agent in AGENTS:
        boxes = da.boxes(sample(scenario, agent, 4), "lidar")
        message = file.only(f"/{agent}/annotations")[3]
        assert len(message.entities) == len(boxes)
        for row, entity in enumerate(message.entities):
            facts = {pair.key: pair.value for pair in entity.metadata}
            told = (entity.frame_id, facts["label_id"], facts["camera_visible"])
            assert told == (
                f"{agent}/{LIDAR}",
                str(boxes.actor_id[row]),
                str(bool(boxes.camera_visible[row])).lower(),
            )
            points = np.array([[point.x, point.y, point.z] for point in entity.lines[0].points])
            np.testing.assert_allclose(points[:24].mean(axis=0), boxes.center[row], atol=1e-9)


def test_motion_labels_are_points_on_their_cells(
    da: DeepAccident, scenario: str, file: McapFile
) -> None:
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
    assert ((expected[0] > 0).any(), len(cloud)) == (True, np.count_nonzero(expected))


def test_the_countdown_ends_at_the_impact(da: DeepAccident, scenario: str, file: McapFile) -> None:
    assert [message.value for message in file.only("/time_to_impact")] == pytest.approx(
        [0.5, 0.4, 0.3, 0.2, 0.1, 0.0]
    )
    facts, first, *_, last = [message.message for message in file.only("/log")]
    assert (facts.startswith(f"{scenario}: town "), first) == (True, "0.5 s to the impact")
    one, other = da.get("scenario", scenario)["collision"]["ids"]
    assert re.fullmatch(rf"impact: .*\b({one}\b.*\b{other}|{other}\b.*\b{one})\b.*", last)


def exported(da: DeepAccident, scenario: str, folder: Path, **choices: Any) -> Any:
    """A small file: one agent, one frame, no sensors unless asked for."""
    small = {"agents": ["ego_vehicle"], "channels": [], "frames": [2], **choices}
    return read_mcap(export_mcap(da, scenario, folder / "small.mcap", **small))


def test_agents_channels_and_frames_can_be_chosen(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    chosen = {
        "agents": "+infrastructure",
        "channels": [LIDAR, "Camera_Back"],
        "frames": range(2, 6, 2),
    }
    file = exported(da, scenario, tmp_path, **chosen)
    sensors = {topic for topic in file.messages if topic.endswith(("/image", f"{LIDAR}/points"))}
    names = "Camera_Back/image", f"{LIDAR}/points"
    assert sensors == {
        f"/{agent}/{name}" for agent in ("ego_vehicle", "infrastructure") for name in names
    }
    assert np.diff([record.log_time for record, _ in file.messages["/tf"]]).tolist() == [2 * 10**8]
    assert len({transform.child_frame_id for transform in file.only("/tf")[0].transforms}) == 2 * 8


@pytest.mark.slow
def test_scenarios_without_labels_have_poses_and_no_boxes(
    unlabelled: DeepAccident, tmp_path: Path
) -> None:
    file = exported(
        unlabelled,
        unlabelled.scenario[0]["token"],
        tmp_path,
        motion_labels="deepaccident",
        frames=[1, 2],
    )
    counts = (
        [len(each.entities) for each in file.only("/actors")],
        [len(each.data) for each in file.only("/actors/points")],
    )
    assert (len(file.only("/tf")), *counts) == (2, [0, 0], [0, 0])
    assert not [topic for topic in file.messages if "annotations" in topic or "motion" in topic]


PAGE = (Path(__file__).parents[3] / "docs" / "pictures.md").read_text(encoding="utf-8")


def test_the_code_on_the_page_runs(
    da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE))
    assert "deepaccident_demo/release" in code
    monkeypatch.chdir(tmp_path)
    exec(  # noqa: S102
        compile(code.replace("deepaccident_demo/release", str(da.dataroot)), "pictures.md", "exec"),
        {},
    )
    assert len(read_mcap(tmp_path / "accident.mcap").only("/actors")) == 6


@pytest.mark.parametrize(
    ("choices", "sentence"),
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
def test_choices_that_cannot_be_are_refused(
    da: DeepAccident, scenario: str, tmp_path: Path, choices: dict[str, Any], sentence: str
) -> None:
    assert_refused(
        (lambda: export_mcap(da, scenario, tmp_path / "a.mcap", **choices), ChoiceError, sentence)
    )
    assert not list(tmp_path.iterdir())


def test_missing_files_are_left_out_and_told(
    da_b: DeepAccident, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    token = da_b.scenario[0]["token"]
    with caplog.at_level(logging.WARNING):
        file = read_mcap(
            export_mcap(
                da_b, token, tmp_path / "a.mcap", channels=["Camera_Front", LIDAR], frames=[1, 2]
            )
        )
    assert not [topic for topic in file.messages if "Camera" in topic or LIDAR in topic]
    (record,) = caplog.records
    assert "10 of 10 of Camera_Front, 10 of 10 of lidar01" in record.getMessage()


def test_a_damaged_image_or_a_folder_in_its_place_is_an_error_and_the_old_file_stays(
    da: DeepAccident, scenario: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged, old = tmp_path / "damaged.jpg", tmp_path / "a.mcap"
    damaged.write_bytes(b"\xff\xd8no picture")
    old.write_bytes(b"before")
    for path, said in (
        (damaged, "damaged.jpg: not a readable image"),
        (tmp_path, "not a regular file (a folder)"),
    ):
        monkeypatch.setattr(type(da), "sensor_path", lambda *_, path=path: path)
        export = partial(export_mcap, da, scenario, old, channels=["Camera_Front"])
        assert_refused((export, SensorFileError, (said, "restore the file")))
    assert {each.name: each.read_bytes()[:6] for each in tmp_path.iterdir()} == {
        "a.mcap": b"before",
        "damaged.jpg": b"\xff\xd8no p",
    }


def test_a_predicted_motion_is_drawn_on_its_cells(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    sample = f"{scenario}/ego_vehicle/002"
    labels = motion_labels(da, sample).to_present()
    instances, heads = labels.instance[None], (MotionHeads.from_labels(labels),)
    for given in ({"instances": instances}, {"heads": heads}):
        file = exported(
            da,
            scenario,
            tmp_path,
            prediction={sample: MotionOutput(grid=labels.config.grid, **given)},
        )
        (message,) = file.only("/ego_vehicle/prediction/motion/points")
        assert message.frame_id == "ego_vehicle"
        cloud = cloud_of(message)
        index, _ = labels.config.grid.index_of(xyz_of(cloud[cloud["frame"] == 0]))
        present = np.zeros(labels.instance[0].shape, dtype=bool)
        present[tuple(index.T)] = True
        np.testing.assert_array_equal(present, labels.instance[0] > 0)


def test_predicted_accidents_stand_where_they_are_foreseen(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    foreseen = Accident(
        positions=np.array([[10.0, 2.0], [13.0, -1.0]]), time=1.5, score=0.75, ids=(3, 9)
    )
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        writer.add(f"{scenario}/ego_vehicle/002", [foreseen])
    file = exported(
        da, scenario, tmp_path, prediction=read_results(tmp_path / "results.json"), frames=[1, 2]
    )
    ((record, message),) = file.messages["/ego_vehicle/prediction/accidents"]
    (entity,) = message.entities
    assert (record.log_time, entity.frame_id) == (
        file.messages["/tf"][1][0].log_time,
        "ego_vehicle",
    )
    places = [[sphere.pose.position.x, sphere.pose.position.y] for sphere in entity.spheres]
    np.testing.assert_allclose(places, foreseen.positions)
    assert ("actor_ids", "3, 9") in [(pair.key, pair.value) for pair in entity.metadata]


def test_detected_boxes_are_drawn_in_their_own_frame(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    boxes = DetectedBoxes.from_arrays(
        [[5, 1, 0]], [[4, 2, 1.5]], [0.5], [0.9], category=["van"], frame="lidar"
    )
    file = exported(da, scenario, tmp_path, prediction={f"{scenario}/ego_vehicle/002": boxes})
    ((entity,),) = (message.entities for message in file.only("/ego_vehicle/prediction/boxes"))
    cube = entity.cubes[0]
    assert (entity.frame_id, cube.pose.position.x, cube.size.y) == (f"ego_vehicle/{LIDAR}", 5, 2)
    cloud = xyz_of(cloud_of(file.only("/ego_vehicle/prediction/boxes/points")[0]))
    assert (
        np.linalg.norm(cloud[None] - boxes.boxes.corners()[0][:, None], axis=-1).min(axis=1) < 1e-4
    ).all()


def test_unknown_scenarios_and_predictions_that_are_none_are_refused(
    da: DeepAccident, scenario: str, tmp_path: Path
) -> None:
    sample = f"{scenario}/ego_vehicle/002"

    def predicted(prediction: Any, **choices: Any) -> Any:
        return exported(da, scenario, tmp_path, prediction=prediction, **choices)

    assert_refused(
        (
            lambda: export_mcap(da, "nowhere/nothing", tmp_path / "a.mcap"),
            TokenError,
            "no token 'nowhere/nothing'",
        ),
        (
            lambda: predicted([sample]),
            ConfigError,
            ("prediction", "expected Results, or a mapping", "found list"),
        ),
        (
            lambda: predicted({sample: "an accident"}),
            ConfigError,
            ("Accident or DetectedBoxes", "found str"),
        ),
        (
            lambda: predicted({sample: []}, frames=[3]),
            NotAvailableError,
            ("prediction", scenario, "agents and frames"),
        ),
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("package", ["mcap", "foxglove_schemas_protobuf"])
def test_without_the_extra_the_error_names_it(
    da: DeepAccident, scenario: str, tmp_path: Path, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(sys.modules):
        if name.startswith(
            ("deepaccident_devkit.export.mcap.", f"{package}.")
        ) and not name.endswith(".config"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    assert_refused(
        (
            lambda: export_mcap(da, scenario, tmp_path / "a.mcap"),
            MissingExtraError,
            ("pip install '.[mcap]'",),
        )
    )


def test_the_verb_writes_what_is_asked_for(da: DeepAccident, tmp_path: Path) -> None:
    token = da.scenario[1]["token"]
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        writer.add(f"{token}/ego_vehicle/002", [])
    words = [
        "--frame-range",
        "2..3",
        "--channels",
        LIDAR,
        "--points",
        "10",
        "--agents",
        "ego_vehicle,infrastructure",
    ]
    for name, chosen in (
        ("first", []),
        ("a", [token, "--results", str(tmp_path / "results.json")]),
    ):
        out = ["--out", str(tmp_path / f"{name}.mcap"), *words]
        CliRunner().invoke(
            export, ["mcap", str(da.dataroot), *chosen, *out], catch_exceptions=False
        )
    first, file = (read_mcap(tmp_path / f"{name}.mcap") for name in ("first", "a"))
    accident = next(record["token"] for record in da.scenario if record["collision"] is not None)
    told = [each.metadata["deepaccident_devkit"]["scenario"] for each in (first, file)]
    assert (told, len(file.only("/tf"))) == ([accident, token], 2)
    assert {topic for topic in file.messages if LIDAR in topic} == {
        f"/{agent}/{LIDAR}/points" for agent in ("ego_vehicle", AGENTS[-1])
    }
    assert len(file.only("/ego_vehicle/prediction/accidents")) == 1
