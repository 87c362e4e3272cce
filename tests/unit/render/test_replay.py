"""Replays: what the page has of places, views, pictures and verdicts, and that it asks for nothing else."""

import base64
import hashlib
import io
import json
import math
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.replay import replay
from deepaccident_devkit.errors import ChoiceError, ConfigError, EvaluationError, NotAvailableError, TokenError
from deepaccident_devkit.evaluation import Accident, box_truth, instances_of
from deepaccident_devkit.evaluation.detection import DetectedBoxes
from deepaccident_devkit.evaluation.frames import labels_at_present
from deepaccident_devkit.evaluation.results import ResultsWriter, read_results
from deepaccident_devkit.geometry import Boxes
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, motion_labels
from deepaccident_devkit.render.colors import CATEGORY_COLORS, COLLIDER_COLOR, COMPANION_COLOR
from deepaccident_devkit.render.replay import render_replay, sensors
from deepaccident_devkit.render.replay.recording import recording_of
from deepaccident_devkit.render.replay.replay import SIZE_LIMIT, replay_page
from deepaccident_devkit.render.replay.sensors import camera_pictures
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x.tracks import scenario_tracks


def data_of(page: Path | str) -> dict[str, Any]:
    text = page if isinstance(page, str) else page.read_text(encoding="utf-8")
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    data: dict[str, Any] = json.loads(found)
    return data


def accident(dataset: DeepAccident) -> str:
    return next(each["token"] for each in dataset.scenario if each["collision"])


def normal(dataset: DeepAccident) -> str:
    return next(each["token"] for each in dataset.scenario if not each["collision"])


def picture(coded: str) -> Image.Image:
    return Image.open(io.BytesIO(base64.b64decode(coded)))


@pytest.fixture(scope="module")
def page(da: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "new folder" / "replay.html"
    assert render_replay(da, accident(da), path) == path
    return path


@pytest.fixture(scope="module")
def data(page: Path) -> dict[str, Any]:
    return data_of(page)


# the scene


def test_actors_are_where_their_tracks_say(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    origin = recording_of(da, scenario, None).origin
    tracks = scenario_tracks(da, scenario)
    assert sorted(actor["id"] for actor in data["actors"]) == np.unique(tracks.actor_id).tolist()
    for actor in data["actors"]:
        rows = np.flatnonzero(tracks.actor_id == actor["id"])
        shown = [frame + 1 for frame, state in enumerate(actor["states"]) if state is not None]
        assert shown == tracks.index[rows].tolist()
        states = np.array([state[:3] for state in actor["states"] if state is not None])
        boxes = tracks.boxes.select(rows)
        assert_allclose(states[:, :2] / 100 + origin, boxes.center[:, :2], atol=0.00501)
        assert_allclose(states[:, 2] / 1000, boxes.yaw, atol=0.000501)
        assert_allclose([actor["length"] / 100, actor["width"] / 100], boxes.size[0, :2], atol=0.00501)
        assert actor["title"].startswith(f"{boxes.category_names[0]} {actor['id']}")


def test_agents_are_where_they_drive(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    origin = recording_of(da, scenario, None).origin
    assert [agent["name"] for agent in data["agents"]] == list(AGENTS)
    assert len({agent["short"] for agent in data["agents"]}) == len({agent["color"] for agent in data["agents"]}) == 5
    for agent in data["agents"]:
        for frame, pose in enumerate(agent["poses"], 1):
            there = da.world_from(f"{scenario}/{agent['name']}/{frame:03d}", "ego")
            assert_allclose(np.array(pose[:2]) / 100 + origin, there.translation[:2], atol=0.00501)
            assert pose[2] / 1000 == pytest.approx(math.atan2(there.matrix[1, 0], there.matrix[0, 0]), abs=0.000501)


def test_who_sees_whom_is_the_released_rule(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    for bit, agent in enumerate(AGENTS):
        for frame in range(6):
            seen = {actor["id"] for actor in data["actors"] if actor["seen"][frame] >> bit & 1}
            visible = da.visible_instances(f"{scenario}/{agent}/{frame + 1:03d}", agents=[agent])
            assert seen == {int(token.rsplit("/", 1)[1]) for token in visible}
            assert seen  # or nothing is tested


def test_the_pair_is_red_and_first_and_its_companions_are_green(da: DeepAccident, data: dict[str, Any]) -> None:
    pair = da.get("scenario", accident(da))["collision"]["ids"]
    behind = [agent["actor"] for agent in data["agents"] if agent["name"].endswith("_behind")]
    assert [actor["id"] for actor in data["actors"][:2]] == sorted(pair)
    for actor in data["actors"]:
        color = CATEGORY_COLORS[actor["category"]]
        color = COMPANION_COLOR if actor["id"] in behind else color
        assert actor["color"] == (COLLIDER_COLOR if actor["id"] in pair else color)
    assert {actor["id"] for actor in data["actors"] if actor["role"] == "companion"} == set(behind)


def test_the_countdown_ends_at_the_impact(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    assert data["countdown"] == [0.5, 0.4, 0.3, 0.2, 0.1, 0.0]
    contact = da.collision(scenario)
    assert contact is not None
    origin = recording_of(da, scenario, None).origin
    assert_allclose(np.array(data["impact"]) / 100 + origin, contact.point[:2], atol=0.00501)
    facts = dict(data["facts"])
    collision = da.get("scenario", scenario)["collision"]
    first, second = collision["ids"]
    first_role, second_role = (agent.removesuffix("_vehicle") for agent in collision["agents"])
    kind, other_kind = collision["classes"]
    assert facts["Ends"] == f"{kind} {first} ({first_role}) and {other_kind} {second} ({second_role}) collide"
    assert facts["Speeds"].startswith(f"{kind} {first} {contact.speeds[0]:.1f} m/s")
    assert facts["Weather"].startswith(da.get("scenario", scenario)["weather"])


def test_where_nobody_collides_nothing_is_red(da_b: DeepAccident, tmp_path: Path) -> None:
    data = data_of(render_replay(da_b, normal(da_b), tmp_path / "normal.html"))
    assert data["countdown"] == [None] * 4
    assert data["impact"] is None
    assert dict(data["facts"])["Ends"] == "without a collision"
    assert {actor["role"] for actor in data["actors"]} == {"companion", "other"}
    assert COLLIDER_COLOR not in {actor["color"] for actor in data["actors"]}


def test_points_lie_on_those_of_the_lidar(da: DeepAccident, data: dict[str, Any]) -> None:
    scenario = accident(da)
    origin = recording_of(da, scenario, None).origin
    for frame, coded in enumerate(data["points"], 1):
        shown = np.frombuffer(base64.b64decode(coded), dtype="<i2").reshape(-1, 2) / 10 + origin
        sample = f"{scenario}/ego_vehicle/{frame:03d}"
        height = da.load_point_cloud(sample, "ego").xyz[:, 2]
        raised = da.load_point_cloud(sample, "world").xyz[height > np.percentile(height, 5) + 0.3]
        assert 100 < len(shown) <= 1500
        apart = np.linalg.norm(shown[::10, None] - raised[None, :, :2], axis=-1).min(axis=1)
        assert apart.max() < 0.0708  # half a decimetre along both axes


# the pictures


def test_the_first_agent_has_six_cameras_and_the_others_one(da: DeepAccident, data: dict[str, Any]) -> None:
    titles = [[camera["title"] for camera in cameras] for cameras in data["cameras"]]
    assert titles == [[channel.removeprefix("Camera_") for channel in CAMERAS], *[["Front"]] * 4]
    shown, true = {}, {}
    for agent, cameras in zip(AGENTS, data["cameras"], strict=True):
        for camera in cameras:
            for frame in (1, 6):
                token = f"{accident(da)}/{agent}/{frame:03d}/Camera_{camera['title']}"
                shown[token] = np.asarray(picture(camera["pictures"][frame - 1]), dtype=float)
                true[token] = da.load_image(token)
    assert len(shown) == 20
    for token, pixels in shown.items():
        assert min(true, key=lambda other: np.abs(true[other] - pixels).mean()) == token
    assert any("all but the front camera of ego behind, other" in note for note in data["notes"])


def test_width_and_quality_are_as_asked(da: DeepAccident, tmp_path: Path) -> None:
    path = render_replay(da, accident(da), tmp_path / "a.html", agents=["infrastructure"], image_width=40, quality=30)
    data = data_of(path)
    assert [agent["name"] for agent in data["agents"]] == ["infrastructure"]
    assert [camera["title"] for camera in data["cameras"][0]] == [each.removeprefix("Camera_") for each in CAMERAS]
    assert picture(data["cameras"][0][0]["pictures"][0]).size == (40, 22)
    assert "Pictures are up to 40 pixels wide, of JPEG quality 30." in data["notes"]
    assert "Agents not shown: ego, ego behind, other, other behind." in data["notes"]


@pytest.mark.parametrize("how", [{}, {"width": 48}, {"quality": 60}])
def test_pictures_keep_the_limit_and_at_last_become_fewer(da: DeepAccident, how: dict[str, int]) -> None:
    recording = recording_of(da, accident(da), None)
    sizes = []
    for limit in (math.inf, 45_000, 20_000, 8_000, 5_000):
        taken = camera_pictures(recording, limit, **how)
        weight = sum(
            len(each) for cameras in taken.jpegs.values() for all_ in cameras.values() for each in all_ if each
        )
        assert weight <= limit
        assert taken.settings is not None
        sizes.append(weight)
        assert set(taken.jpegs) == set(AGENTS)
        others = len(taken.jpegs["ego_vehicle"]) == len(CAMERAS)
        assert others != taken.settings.front_only
        given = [each is not None for each in taken.jpegs["infrastructure"][CAMERAS[0]]]
        assert given == [frame % taken.settings.every == 0 for frame in range(6)]
    assert sizes == sorted(sizes, reverse=True)
    assert taken.settings.every > 1
    assert camera_pictures(recording, 10, **how).jpegs == {}


def test_a_wrong_estimate_does_not_break_the_limit(da: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    """The size of all is estimated from a black picture, which is smaller than any other."""
    monkeypatch.setattr(sensors, "_probes", lambda _: [np.zeros((36, 64, 3), dtype=np.uint8)])
    taken = camera_pictures(recording_of(da, accident(da), None), 50_000)
    sizes = [len(each) for cameras in taken.jpegs.values() for all_ in cameras.values() for each in all_ if each]
    assert len(sizes) == 60
    assert 25_000 < sum(sizes) <= 50_000


def test_forty_frames_of_real_size_go_by_mail(tmp_path: Path) -> None:
    """Pictures of 1600×900 with noise, which hardly compresses, at all cameras of all frames."""
    root = make_release(tmp_path / "release", SynthConfig(scenarios=1, frames=40, sensors=False, seed=1), workers=1)
    dataset = DeepAccident("v1", root, verbose=False)
    scenario = accident(dataset)
    noise = np.random.default_rng(0).integers(0, 256, (56, 100, 3), dtype=np.uint8)
    source = tmp_path / "noise.jpg"
    Image.fromarray(noise).resize((1600, 900), Image.Resampling.BICUBIC).save(source, quality=90)
    for number, agent in enumerate(AGENTS):
        for channel in CAMERAS if number == 0 else CAMERAS[:1]:
            for frame in range(1, 41):
                path = dataset.get_sample_data_path(f"{scenario}/{agent}/{frame:03d}/{channel}")
                path.parent.mkdir(parents=True, exist_ok=True)
                os.link(source, path)
    page = render_replay(dataset, None, tmp_path / "replay.html")
    assert 0.5 * SIZE_LIMIT < page.stat().st_size <= SIZE_LIMIT == 15_000_000
    data = data_of(page)
    assert [len(cameras) for cameras in data["cameras"]] == [6, 1, 1, 1, 1]
    assert all(coded is not None for cameras in data["cameras"] for each in cameras for coded in each["pictures"])
    assert picture(data["cameras"][0][0]["pictures"][0]).width >= 320


# what is missing


def test_labels_alone_are_enough(da_b: DeepAccident, tmp_path: Path) -> None:
    data = data_of(render_replay(da_b, None, tmp_path / "replay.html"))
    assert data["scenario"] == accident(da_b)
    assert (data["cameras"], data["points"]) == ([[]] * 5, None)
    assert any(note.startswith("No pictures: none of the 40 camera files is here") for note in data["notes"])
    assert any(note.startswith("No LiDAR points: no file of ego is here") for note in data["notes"])
    assert all(any(state for state in actor["states"]) for actor in data["actors"])


def test_a_missing_picture_leaves_a_hole(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "release"
    shutil.copytree(da.dataroot, root, copy_function=os.link, ignore=shutil.ignore_patterns(".deepaccident"))
    part = DeepAccident("v1", root, verbose=False)
    gone = part.get_sample_data_path(f"{accident(part)}/other_vehicle/003/Camera_Front")
    gone.unlink()
    part.get_sample_data_path(f"{accident(part)}/ego_vehicle/002/lidar01").unlink()
    data = data_of(render_replay(part, None, tmp_path / "replay.html"))
    there = [coded is not None for coded in data["cameras"][2][0]["pictures"]]
    assert there == [True, True, False, True, True, True]
    assert [cloud is not None for cloud in data["points"]] == [True, False, True, True, True, True]
    assert "1 of 60 camera files are missing in the release; unpack the cameras' archives." in data["notes"]


def test_without_labels_there_are_the_agents(own_release: Path, tmp_path: Path) -> None:
    for folder in sorted(own_release.rglob("label")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    data = data_of(render_replay(dataset, None, tmp_path / "replay.html"))
    assert data["actors"] == []
    assert [len(agent["poses"]) for agent in data["agents"]] == [4] * 5
    assert data["notes"][0] == "The release has no labels of this scenario: nobody's boxes, and not who sees whom."
    assert any(note.startswith("How the accident happened is not known: ") for note in data["notes"])
    assert data["countdown"][-1] == 0


# the page


def test_the_same_call_gives_the_same_bytes(da: DeepAccident, page: Path, tmp_path: Path) -> None:
    again = render_replay(da, da.get("scenario", accident(da)), str(tmp_path / "again.html"), progress=True)
    assert again.read_bytes() == page.read_bytes()


def test_the_policy_allows_this_script_and_style_alone(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules.pop("default-src") == "'none'"
    assert rules.pop("img-src") == "data:"
    for name, tag in (("style-src", "style"), ("script-src", "script")):
        (content,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert rules.pop(name) == f"'sha256-{digest}'"
    assert rules == {"base-uri": "'none'", "form-action": "'none'"}
    assert not re.search(r"(?:https?:)?//\w|\bsrc=|\bhref=|@import|url\(|\bon\w+=", re.sub(r"//.*\n", "", text))


def test_text_stays_text() -> None:
    wild = "</script><script>alert(1)</script> & <!--title--> \u2028 é"
    text = replay_page(wild, {"scenario": wild})
    assert data_of(text) == {"scenario": wild}
    assert "alert(1)</script>" not in text
    assert "<title>&lt;/script&gt;&lt;script&gt;alert(1)" in text
    assert text.isascii() is False  # the script itself has signs that are not
    assert text.count("<script") == 2


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"scenario": "type1_subtype1_accident/nowhere"}, TokenError, "nowhere"),
        ({"agents": ["pedestrian"]}, ChoiceError, "agent: expected one of ego_vehicle"),
        ({"image_width": 4}, ConfigError, "image_width: expected pixels from 32, or None for what fits, found 4"),
        ({"quality": 0}, ConfigError, "quality: expected a JPEG quality from 1 to 95, or None for what fits, found 0"),
        ({"path": "."}, ChoiceError, "is a folder; name a file in it, such as replay.html"),
    ],
)
def test_what_cannot_be_is_refused(
    arguments: dict[str, Any], error: type[Exception], match: str, da: DeepAccident, tmp_path: Path
) -> None:
    with pytest.raises(error, match=match):
        render_replay(da, **{"scenario": None, "path": tmp_path / "no.html", **arguments})
    assert list(tmp_path.iterdir()) == []


def test_a_release_without_an_accident_needs_a_name(own_release: Path, tmp_path: Path) -> None:
    for folder in sorted(own_release.rglob("*_accident")):
        shutil.rmtree(folder)
    dataset = DeepAccident("v1", own_release, verbose=False)
    with pytest.raises(NotAvailableError, match="no scenario ends in an accident that a meta file names; name one"):
        render_replay(dataset, None, tmp_path / "no.html")


# verdicts


def foreseen(dataset: DeepAccident, token: str, *, away: float = 0.0, **other: Any) -> Accident:
    """The true accident of a sample, so many metres away, or with other numbers."""
    truth = box_truth(dataset, token).accident
    assert truth is not None
    told = {"positions": truth.positions + np.array([away, 0.0]), "time": truth.time, "ids": truth.ids, **other}
    return Accident(**told)


@pytest.fixture(scope="module")
def predictions(da_motion: DeepAccident) -> dict[str, list[Accident]]:
    ego = f"{accident(da_motion)}/ego_vehicle"
    return {
        f"{ego}/020": [foreseen(da_motion, f"{ego}/020", score=0.75)],
        f"{ego}/025": [foreseen(da_motion, f"{ego}/025", away=20.0)],
        f"{ego}/030": [],
        f"{accident(da_motion)}/infrastructure/030": [
            foreseen(da_motion, f"{ego}/030", away=90.0, ids=None),
            *(Accident(positions=np.full((2, 2), far), time=1.0, score=0.1) for far in (200.0, 300.0, 400.0)),
        ],
    }


def test_each_sample_has_its_verdict(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    data = data_of(render_replay(da_motion, None, tmp_path / "a.html", prediction=predictions))
    samples = data["prediction"]["samples"]
    assert [(each["frame"], each["agent"], each["verdict"]) for each in samples] == [
        (19, 0, "TP"),
        (24, 0, "FP + FN"),
        (29, 0, "FN"),
        (29, 4, "4 FP + FN"),
    ]
    right, far, missed, many = samples
    assert [alarm["right"] for alarm in (*right["alarms"], *far["alarms"])] == [True, False]
    assert right["alarms"][0]["text"] == (
        "foreseen in 1.5 s, score 0.75: places off by 0.0 m, time by +0.0 s; names "
        f"{' and '.join(str(each) for each in da_motion.get('scenario', accident(da_motion))['collision']['ids'])}"
        ", who collide"
    )
    assert "places off by 40.0 m" in far["alarms"][0]["text"]
    assert missed["text"] == "ego at frame 30: an accident comes in 0.5 s"
    assert (len(many["alarms"]), many["more"]) == (3, 1)
    assert "names nobody known" in many["alarms"][0]["text"]
    # the true places are those of the pair at the end, in the page's own ground: centimetres; a slope takes a few
    pair = [actor["states"][-1][:2] for actor in data["actors"] if actor["role"] == "pair"]
    assert_allclose(sorted(right["truth"]), sorted(pair), atol=8)
    assert_allclose(sorted(right["alarms"][0]["places"]), sorted(pair), atol=8)
    assert right["truth"] == right["alarms"][0]["places"]


def test_alarms_without_an_accident_are_false_or_not_judged(da_motion: DeepAccident, tmp_path: Path) -> None:
    ego = f"{normal(da_motion)}/ego_vehicle"
    anywhere = np.array([[1.0, 2.0], [3.0, 4.0]])
    given = {
        f"{ego}/010": [Accident(positions=anywhere, time=1.0)],
        f"{ego}/030": [Accident(positions=anywhere, time=1.9)],
        f"{ego}/031": [],
    }
    path = render_replay(da_motion, normal(da_motion), tmp_path / "a.html", prediction=given)
    samples = data_of(path)["prediction"]["samples"]
    assert [each["verdict"] for each in samples] == ["FP", "not judged", "TN"]
    assert samples[1]["alarms"][0]["text"].startswith("foreseen in 1.9 s, score 1: for later than the recording shows")
    assert all(each["truth"] is None for each in samples)


def test_results_files_give_the_same_page(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        for token, alarms in predictions.items():
            writer.add(token, alarms)
    by_token = render_replay(da_motion, None, tmp_path / "a.html", prediction=predictions)
    by_file = render_replay(da_motion, None, tmp_path / "b.html", prediction=read_results(tmp_path / "results.json"))
    assert by_file.read_bytes() == by_token.read_bytes()


def test_motion_is_read_for_accidents(da_motion: DeepAccident, tmp_path: Path) -> None:
    """The pair as the labels draw it, and nobody else, as prediction: the true accident is foreseen."""
    config = MotionLabelConfig()
    ego = f"{accident(da_motion)}/ego_vehicle"
    (other,) = set(da_motion.get("scenario", accident(da_motion))["collision"]["ids"]) - {
        da_motion.get("agent", ego)["actor_id"]
    }
    given = {}
    with ResultsWriter(tmp_path / "motion", "motion", grid=config.grid) as writer:
        for frame in (20, 30):
            token = f"{ego}/{frame:03d}"
            label = labels_at_present(motion_labels(da_motion, token, config))
            pair = np.isin(label.instance, [label.id_map[OWN_BOX_ID], label.id_map[other]])
            given[token] = instances_of(np.where(pair, label.instance, 0), config.grid)
            writer.add(token, given[token])
    by_token = render_replay(da_motion, None, tmp_path / "a.html", prediction=given)
    by_file = render_replay(da_motion, None, tmp_path / "b.html", prediction=read_results(tmp_path / "motion"))
    assert [each["verdict"] for each in data_of(by_token)["prediction"]["samples"]] == ["TP", "TP"]
    assert by_file.read_bytes() == by_token.read_bytes()


def test_predictions_of_something_else_are_refused(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    with pytest.raises(
        NotAvailableError, match=r"prediction: none is of a sample of .* and ego_vehicle, ego_vehicle_b"
    ):
        render_replay(da_motion, normal(da_motion), tmp_path / "a.html", prediction=predictions)
    token = next(iter(predictions))
    boxes = Boxes.from_arrays(np.zeros((0, 3)), np.zeros((0, 3)), [], frame="world")
    with ResultsWriter(tmp_path / "boxes.json", "detection") as writer:
        writer.add(token, DetectedBoxes(boxes=boxes, scores=np.zeros(0)))
    with pytest.raises(EvaluationError, match="holds detection results; accident is evaluated from motion or accident"):
        render_replay(da_motion, None, tmp_path / "a.html", prediction=read_results(tmp_path / "boxes.json"))
    with pytest.raises(EvaluationError, match="expected a MotionOutput or a list of Accidents, found list with int"):
        render_replay(da_motion, None, tmp_path / "a.html", prediction={token: [7]})  # type: ignore[dict-item]


# the command


def test_the_command_writes_the_page(
    da_motion: DeepAccident, predictions: dict[str, list[Accident]], tmp_path: Path
) -> None:
    with ResultsWriter(tmp_path / "results.json", "accident") as writer:
        for token, alarms in predictions.items():
            writer.add(token, alarms)
    out = tmp_path / "replay.html"
    arguments = [str(da_motion.dataroot), accident(da_motion), "--out", str(out), "--results"]
    ran = CliRunner().invoke(
        replay, [*arguments, str(tmp_path / "results.json"), "--agents", "ego_vehicle,infrastructure"]
    )
    assert ran.exit_code == 0, ran.output
    assert f"written: {out}, " in ran.output
    data = data_of(out)
    assert [agent["name"] for agent in data["agents"]] == ["ego_vehicle", "infrastructure"]
    assert [each["verdict"] for each in data["prediction"]["samples"]] == ["TP", "FP + FN", "FN", "4 FP + FN"]
    assert_array_equal([each["agent"] for each in data["prediction"]["samples"]], [0, 0, 0, 1])


def test_the_command_takes_the_first_accident_and_a_configuration(da_motion: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "replay.html"
    ran = CliRunner().invoke(replay, [str(da_motion.dataroot), "--out", str(out), "--agents", "+other"])
    assert ran.exit_code == 0, ran.output
    data = data_of(out)
    assert data["scenario"] == accident(da_motion)
    assert [agent["name"] for agent in data["agents"]] == ["ego_vehicle", "other_vehicle"]
    assert data["prediction"] is None
