"""What of a scenario goes into an exported file, and what the errors say."""

import logging
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap_reading import cloud_of, read_mcap, xyz_of

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
from deepaccident_devkit.export.mcap import McapConfig, export_mcap
from deepaccident_devkit.motion import MotionHeads, motion_labels
from deepaccident_devkit.taxonomy import AGENTS, LIDAR

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(scope="module")
def scenario(da: DeepAccident) -> str:
    return da.scenario[0]["token"]


def exported(da: DeepAccident, scenario: str, folder: Path, **choices: Any) -> Any:
    """A small file: one agent, one frame, no sensors unless asked for."""
    small = {"agents": ["ego_vehicle"], "channels": [], "frames": [2], **choices}
    return read_mcap(export_mcap(da, scenario, folder / "small.mcap", **small))


def test_an_unknown_scenario_is_refused(da: DeepAccident, tmp_path: Path) -> None:
    with pytest.raises(TokenError, match="no token 'nowhere/nothing'"):
        export_mcap(da, "nowhere/nothing", tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


def test_agents_channels_and_frames_can_be_chosen(da: DeepAccident, scenario: str, tmp_path: Path) -> None:
    chosen = {"agents": "+infrastructure", "channels": [LIDAR, "Camera_Back"], "frames": range(2, 6, 2)}
    file = exported(da, scenario, tmp_path, **chosen)
    images = {topic for topic in file.messages if topic.endswith("/image")}
    clouds = {topic for topic in file.messages if topic.endswith(f"{LIDAR}/points")}
    assert images == {"/ego_vehicle/Camera_Back/image", "/infrastructure/Camera_Back/image"}
    assert clouds == {f"/ego_vehicle/{LIDAR}/points", f"/infrastructure/{LIDAR}/points"}
    steps = [record.log_time for record, _ in file.messages["/tf"]]
    assert np.diff(steps).tolist() == [2 * 10**8]
    assert len({transform.child_frame_id for transform in file.only("/tf")[0].transforms}) == 2 * 8


def test_actors_are_those_that_the_chosen_agents_annotated(da: DeepAccident, scenario: str, tmp_path: Path) -> None:
    (message,) = exported(da, scenario, tmp_path, agents=["infrastructure"]).only("/actors")
    assert len(message.entities) == len(da.boxes(f"{scenario}/infrastructure/002"))


@pytest.mark.slow
def test_scenarios_without_labels_have_poses_and_no_boxes(own_release: Path, tmp_path: Path) -> None:
    for folder in list(own_release.glob("*/*/*/label")):
        shutil.rmtree(folder)
    unlabelled = DeepAccident("v1", own_release, verbose=False)
    token = unlabelled.scenario[0]["token"]
    file = exported(unlabelled, token, tmp_path, motion_labels="deepaccident", frames=[1, 2])
    assert len(file.only("/tf")) == 2
    assert [len(message.entities) for message in file.only("/actors")] == [0, 0]
    assert [len(message.data) for message in file.only("/actors/points")] == [0, 0]
    assert not [topic for topic in file.messages if "annotations" in topic or "motion" in topic]


def test_a_normal_scenario_has_no_countdown(da: DeepAccident, tmp_path: Path) -> None:
    token = next(record["token"] for record in da.scenario if record["collision"] is None)
    file = exported(da, token, tmp_path)
    assert "/time_to_impact" not in file.messages
    (facts,) = (message.message for message in file.only("/log"))
    assert facts.startswith(f"{token}: ")
    assert facts.endswith("no collision is known")


def test_the_code_on_the_page_runs(da: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (DOCS / "pictures.md").read_text(encoding="utf-8")
    code = "\n".join(re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE))
    assert "deepaccident_demo/release" in code
    monkeypatch.chdir(tmp_path)
    exec(compile(code.replace("deepaccident_demo/release", str(da.dataroot)), "pictures.md", "exec"), {})  # noqa: S102
    assert len(read_mcap(tmp_path / "accident.mcap").only("/actors")) == 6


def test_the_page_lists_every_topic(da: DeepAccident, scenario: str, tmp_path: Path) -> None:
    page = (DOCS / "pictures.md").read_text(encoding="utf-8")
    file = exported(da, scenario, tmp_path, channels=None, motion_labels="deepaccident")
    for topic in file.messages:
        general = re.sub("Camera_[A-Za-z]+", "<camera>", topic.replace("ego_vehicle", "<agent>"))
        assert f"| `{general}` |" in page


def test_every_nth_point(da: DeepAccident, scenario: str, tmp_path: Path) -> None:
    file = exported(da, scenario, tmp_path, channels=[LIDAR], points=7)
    (message,) = file.only(f"/ego_vehicle/{LIDAR}/points")
    stored = da.load_point_cloud(f"{scenario}/ego_vehicle/002", "lidar").xyz
    np.testing.assert_allclose(xyz_of(cloud_of(message)), stored[::7], atol=1e-4)


@pytest.mark.parametrize(
    ("choices", "sentence"),
    [
        ({"agent": "ego_vehicle"}, "export_mcap has no 'agent'; there are agents, "),
        ({"channels": "lidar01"}, "channels: expected names of channels, found 'lidar01'"),
        ({"channels": ["BEV_instance_camera"]}, "channels: expected one of Camera_Front, .*found 'BEV_instance_"),
        ({"frames": 3}, r"frames: expected frame numbers from 1, such as range\(1, 11\), found 3"),
        ({"frames": [1.5]}, "frames: expected whole numbers from 1, found 1.5"),
        ({"frames": []}, "frames: expected at least one frame number"),
        ({"frames": [6, 7]}, "frames: expected numbers from 1 to 6, found 7"),
        ({"frames": [0]}, "frames: expected numbers from 1 to 6, found 0"),
        ({"points": 0}, "points: expected a number from 1, for every n-th point, found 0"),
        ({"points": "some"}, "points: expected n for every n-th point, found 'some'"),
        ({"agents": ["ego"]}, "agent: expected one of ego_vehicle, .*found 'ego'"),
        ({"motion_labels": "mine"}, "expected one of .*found 'mine'"),
    ],
)
def test_choices_that_cannot_be_are_refused(
    da: DeepAccident, scenario: str, tmp_path: Path, choices: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ChoiceError, match=sentence):
        export_mcap(da, scenario, tmp_path / "a.mcap", **choices)
    assert not list(tmp_path.iterdir())


def test_missing_files_are_left_out_and_told(
    da_b: DeepAccident, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    token = da_b.scenario[0]["token"]
    with caplog.at_level(logging.WARNING):
        file = read_mcap(export_mcap(da_b, token, tmp_path / "a.mcap", channels=["Camera_Front", LIDAR], frames=[1, 2]))
    assert not [topic for topic in file.messages if "Camera" in topic or LIDAR in topic]
    assert len(file.only("/actors")) == 2
    (record,) = caplog.records
    assert "10 of 10 of Camera_Front, 10 of 10 of lidar01" in record.getMessage()


def test_a_damaged_image_is_an_error_and_the_old_file_stays(
    da: DeepAccident, scenario: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    damaged = tmp_path / "damaged.jpg"
    damaged.write_bytes(b"\xff\xd8no picture")
    old = tmp_path / "a.mcap"
    old.write_bytes(b"before")
    monkeypatch.setattr(type(da), "sensor_path", lambda *_: damaged)
    with pytest.raises(SensorFileError, match=r"damaged\.jpg: not a readable image .*; restore the file"):
        export_mcap(da, scenario, old, channels=["Camera_Front"])
    assert old.read_bytes() == b"before"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["a.mcap", "damaged.jpg"]


def test_something_else_in_an_images_place_is_an_error(
    da: DeepAccident, scenario: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(da), "sensor_path", lambda *_: tmp_path)
    with pytest.raises(SensorFileError, match=r"not a regular file \(a folder\); restore the file"):
        export_mcap(da, scenario, tmp_path / "a.mcap", channels=["Camera_Front"])


def test_a_predicted_motion_is_drawn_on_its_cells(da: DeepAccident, scenario: str, tmp_path: Path) -> None:
    sample = f"{scenario}/ego_vehicle/002"
    labels = motion_labels(da, sample).to_present()
    instances = MotionOutput(grid=labels.config.grid, instances=labels.instance[None])
    heads = MotionOutput(grid=labels.config.grid, heads=(MotionHeads.from_labels(labels),))
    drawn = []
    for prediction in (instances, heads):
        (message,) = exported(da, scenario, tmp_path, prediction={sample: prediction}).only(
            "/ego_vehicle/prediction/motion/points"
        )
        assert message.frame_id == "ego_vehicle"
        drawn.append(cloud_of(message))
    for cloud in drawn:
        index, _ = labels.config.grid.index_of(xyz_of(cloud[cloud["frame"] == 0]))
        present = np.zeros(labels.instance[0].shape, dtype=bool)
        present[tuple(index.T)] = True
        np.testing.assert_array_equal(present, labels.instance[0] > 0)


def test_predicted_accidents_stand_where_they_are_foreseen(da: DeepAccident, scenario: str, tmp_path: Path) -> None:
    foreseen = Accident(positions=np.array([[10.0, 2.0], [13.0, -1.0]]), time=1.5, score=0.75, ids=(3, 9))
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        writer.add(f"{scenario}/ego_vehicle/002", [foreseen])
    file = exported(da, scenario, tmp_path, prediction=read_results(tmp_path / "results.json"), frames=[1, 2])
    ((record, message),) = file.messages["/ego_vehicle/prediction/accidents"]
    (entity,) = message.entities
    assert record.log_time == file.messages["/tf"][1][0].log_time
    assert entity.frame_id == "ego_vehicle"
    places = [[sphere.pose.position.x, sphere.pose.position.y] for sphere in entity.spheres]
    np.testing.assert_allclose(places, foreseen.positions)
    assert entity.texts[0].text == "accident in 1.5 s (score 0.75)"
    assert ("actor_ids", "3, 9") in [(pair.key, pair.value) for pair in entity.metadata]


def test_detected_boxes_are_drawn_in_their_own_frame(da: DeepAccident, scenario: str, tmp_path: Path) -> None:
    boxes = DetectedBoxes.from_arrays([[5, 1, 0]], [[4, 2, 1.5]], [0.5], [0.9], category=["van"], frame="lidar")
    file = exported(da, scenario, tmp_path, prediction={f"{scenario}/ego_vehicle/002": boxes})
    ((entity,),) = (message.entities for message in file.only("/ego_vehicle/prediction/boxes"))
    assert entity.frame_id == f"ego_vehicle/{LIDAR}"
    assert (entity.cubes[0].pose.position.x, entity.cubes[0].size.y) == (5, 2)
    cloud = xyz_of(cloud_of(file.only("/ego_vehicle/prediction/boxes/points")[0]))
    nearest = np.linalg.norm(cloud[None] - boxes.boxes.corners()[0][:, None], axis=-1).min(axis=1)
    assert (nearest < 1e-4).all()


def test_predictions_that_are_none_are_refused(da: DeepAccident, scenario: str, tmp_path: Path) -> None:
    sample = f"{scenario}/ego_vehicle/002"
    with pytest.raises(ConfigError, match=r"prediction: expected Results, or a mapping .*, found list"):
        exported(da, scenario, tmp_path, prediction=[sample])
    with pytest.raises(ConfigError, match="a list of Accident or DetectedBoxes for each sample, found str"):
        exported(da, scenario, tmp_path, prediction={sample: "an accident"})
    with pytest.raises(NotAvailableError, match=f"prediction: has nothing of {scenario} at these agents and frames"):
        exported(da, scenario, tmp_path, prediction={sample: []}, frames=[3])


@pytest.mark.parametrize("package", ["mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "google.protobuf"])
def test_without_the_extra_the_error_names_it(
    da: DeepAccident, scenario: str, tmp_path: Path, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(sys.modules):
        if name.startswith(("deepaccident_devkit.export.mcap.", f"{package}.")) and not name.endswith(".config"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[mcap\]'"):
        export_mcap(da, scenario, tmp_path / "a.mcap")


def test_the_configuration_is_in_order_and_of_all_agents() -> None:
    config = McapConfig(channels=[LIDAR, "Camera_Back", LIDAR], frames=[3, 1, 3])
    assert (config.channels, config.frames) == (("Camera_Back", LIDAR), (1, 3))
    assert config.frame_numbers(3) == (1, 3)
    assert McapConfig().frame_numbers(2) == (1, 2)


def test_the_verb_writes_the_first_accident(da: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    arguments = ["mcap", da.dataroot, "--out", out, "--frame-range", "2..3", "--channels", "lidar01", "--points", "10"]
    done = CliRunner().invoke(export, [str(each) for each in (*arguments, "--agents", "ego_vehicle,infrastructure")])
    assert done.exit_code == 0, done.output
    first = next(record["token"] for record in da.scenario if record["collision"] is not None)
    assert f"{out}: {first}, " in done.output
    file = read_mcap(out)
    assert len(file.only("/tf")) == 2
    assert {topic for topic in file.messages if LIDAR in topic} == {
        f"/{agent}/{LIDAR}/points" for agent in ("ego_vehicle", AGENTS[-1])
    }


def test_the_verb_takes_a_scenario_and_predictions(da: DeepAccident, tmp_path: Path) -> None:
    token, out = da.scenario[1]["token"], tmp_path / "a.mcap"
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        writer.add(f"{token}/ego_vehicle/002", [])
    arguments = [da.dataroot, token, "--out", out, "--frame-range", 2, "--results", tmp_path / "results.json"]
    done = CliRunner().invoke(export, ["mcap", *map(str, arguments), "--channels", "Camera_Front"])
    assert done.exit_code == 0, done.output
    file = read_mcap(out)
    assert file.metadata["deepaccident_devkit"]["scenario"] == token
    assert len(file.only("/ego_vehicle/prediction/accidents")) == 1


def test_the_verb_refuses_what_it_cannot_read(tmp_path: Path) -> None:
    done = CliRunner().invoke(export, ["mcap", str(tmp_path), "--out", "a.mcap", "--frame-range", "4..2"])
    assert done.exit_code == 2
    assert "expected frame numbers such as 20..40, found '4..2'" in done.output


def test_the_verb_refuses_agents_that_do_not_exist(tmp_path: Path) -> None:
    with pytest.raises(ChoiceError, match=r"--agents: expected .*, found 'nobody'"):
        export.main(["mcap", str(tmp_path), "--out", "a.mcap", "--agents", "nobody"], standalone_mode=False)
