"""The facade as a user meets it: names, errors, ownership, pickling."""

import math
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.expected_errors import assert_raises
from support.worker_functions import num_boxes

from deepaccident_devkit import DeepAccident, DeepAccidentError
from deepaccident_devkit.errors import (
    ChoiceError,
    DatarootError,
    FieldError,
    MissingFileError,
    NotAvailableError,
    SensorFileError,
    TableError,
    TokenError,
    VersionError,
)
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS


def test_wrong_dataroots_and_versions_are_refused(tmp_path: Path, release_root: Path) -> None:
    assert_raises(
        (
            lambda: DeepAccident(dataroot=tmp_path / "nowhere"),
            DatarootError,
            ("nowhere: does not exist; pass the fo",),
        ),
        (
            lambda: DeepAccident(dataroot=tmp_path),
            DatarootError,
            ("no scenario found", "<scenario_type>/<agent>/calib"),
        ),
        (lambda: DeepAccident(dataroot=release_root / "train.txt"), DatarootError, ("is a file",)),
        (
            lambda: DeepAccident("v2", release_root),
            VersionError,
            r"unknown version 'v2'; expected v1, v1-mini$",
        ),
        (
            lambda: DeepAccident("v1-mini", release_root),
            VersionError,
            ("contains no mini release",),
        ),
        (
            lambda: DeepAccident(dataroot=release_root, on_error="ignore"),
            ChoiceError,
            ("on_error: expected one of raise, skip, found 'ignore'",),
        ),
    )
    for path in (str(release_root), Path("a/b"), "~", "./x"):
        advice = f"write DeepAccident(dataroot='{path}')"
        assert_raises((partial(DeepAccident, path), VersionError, (advice,)))
    for version, suggestion in (("v1.0-mini", "v1-mini"), ("v1.0-trainval", "v1")):
        advice = f"; did you mean '{suggestion}'?"
        assert_raises((partial(DeepAccident, version, release_root), VersionError, (advice,)))


@pytest.mark.slow
def test_the_mini_release_is_a_version_of_its_own(own_release: Path) -> None:
    (own_release / "train").rename(own_release / "DeepAccident_mini")
    (own_release / "train.txt").unlink()

    full = DeepAccident("v1", own_release, verbose=False)
    mini = DeepAccident("v1-mini", own_release, verbose=False)
    mini_only = DeepAccident("v1-mini", own_release / "DeepAccident_mini", verbose=False)

    assert len(full.scenario) + len(mini.scenario) == 6
    assert {scenario["folder"] for scenario in mini.scenario} == {"DeepAccident_mini"}
    assert len(mini_only.scenario) == len(mini.scenario) > 0


@pytest.mark.parametrize(
    ("token", "reason"),
    [
        ("nonsense", "expected the form <scenario>/<agent>/<NNN>"),
        ("a/b/ego_vehicle/001", "this release has no scenario 'a/b'"),
        ("{scenario}/bus/001", "the scenario's agents are ego_vehicle, "),
        ("{scenario}/ego_vehicle/007", "the scenario's frames are 001 to 006"),
        ("{scenario}/ego_vehicle/1", "the scenario's frames are 001 to 006"),
        ("{scenario}/ego_vehicle/+01", "the scenario's frames"),
    ],
)
def test_unknown_sample_tokens(da: DeepAccident, token: str, reason: str) -> None:
    token = token.format(scenario=da.scenario[0]["token"])
    message = ("table 'sample' has no token", reason)
    assert_raises(
        (lambda: da.get("sample", token), TokenError, message),
        (lambda: da.boxes(token), TokenError, message),
        (lambda: da.load_point_cloud(token), TokenError, message),
    )


def test_a_sensor_file_and_a_sample_are_not_taken_for_each_other(da: DeepAccident) -> None:
    sample = da.sample[0]
    token = sample["token"]
    cloud = da.get("sample_data", f"{token}/lidar01")
    image = f"{token}/Camera_Front"
    actor = f"{sample['scenario_token']}/actor/x"
    names_file = r"this is the token of a sensor file: remove '/lidar01'$"
    names_sample = r"this is the token of a sample: add a channel, such .*'$"
    sample_form = r"expected the form <scenario>/<agent>/<NNN>$"
    file_form = r"expected the form <scenario>/<agent>/<NNN>/<channel>$"

    assert_raises(
        (lambda: da.map_pointcloud_to_image(image, cloud), TokenError, names_file),
        (lambda: da.map_pointcloud_to_image(sample, image), TokenError, names_sample),
        (lambda: da.get("sample", f"{token}/7"), TokenError, sample_form),
        (lambda: da.get("sample", f"{image}/lidar01"), TokenError, sample_form),
        (lambda: da.get("sample_data", actor), TokenError, file_form),
    )


def test_a_scenario_name_without_its_type_is_completed_in_the_message(da: DeepAccident) -> None:
    name = da.scenario[0]["name"]
    scenario_types = [
        scenario["scenario_type"] for scenario in da.scenario if scenario["name"] == name
    ]
    calls = {
        name: lambda: da.get("scenario", name),
        f"{name}/ego_vehicle/003": lambda: da.get_sample(name, "ego_vehicle", 3),
        f"{name}/actor/7": lambda: da.get("instance", f"{name}/actor/7"),
        f"{name}/ego_vehicle/lidar01/2": lambda: da.get(
            "calibrated_sensor", f"{name}/ego_vehicle/lidar01/2"
        ),
    }
    for token, call in calls.items():
        suggestions = " or ".join(f"'{scenario_type}/{token}'" for scenario_type in scenario_types)
        assert_raises((call, TokenError, ("is not unique", f"; write {suggestions}")))
    assert_raises(
        (lambda: da.get_sample("Town99", "ego_vehicle", 3), TokenError, ("expected the form",)),
    )


@pytest.mark.parametrize(
    "table", ["scenario", "sample_data", "instance", "annotation", "track", "calibrated_sensor"]
)
def test_unknown_tokens_of_other_tables(da: DeepAccident, table: str) -> None:
    token = getattr(da, table)[0]["token"]
    unknown_tokens = (
        f"{token}9",
        f"{token}/1/1/1/1",
        token.replace("Town", "Village"),
        f"{token}/1",
        "",
    )
    message = (f"table '{table}' has no token",)
    for unknown_token in unknown_tokens:
        assert_raises((partial(da.get, table, unknown_token), TokenError, message))


def test_unknown_tables_fields_channels_and_frames(da: DeepAccident) -> None:
    sample = da.sample[0]["token"]
    other = da.samples_of(da.get("frame", da.scenario[1]["first_frame_token"]))[0]
    assert_raises(
        (
            lambda: da.get("scene", "x"),
            TableError,
            ("no table 'scene'; there are scenario, agent",),
        ),
        (
            lambda: da.field2token("scenario", "rain", 1),
            FieldError,
            ("no field 'rain'; it has token, name",),
        ),
        (
            lambda: da.load_image(f"{sample}/Camera_Side"),
            TokenError,
            ("the channels are Camera_Front, ",),
        ),
        (lambda: da.load_image(f"{sample}/lidar01"), ChoiceError, ("lidar01 has no images",)),
        (
            lambda: da.boxes(sample, "camera"),
            ChoiceError,
            ("frame: expected one of world, ego, lidar, Camera_Front",),
        ),
        (
            lambda: da.boxes(sample, visible="lidar"),
            ChoiceError,
            ("visible: expected one of camera, released, or N",),
        ),
        (
            lambda: da.boxes(sample, velocity="mine"),
            ChoiceError,
            ("velocity: expected one of decoded, derived, lab",),
        ),
        (
            lambda: da.split_scenarios("validation"),
            ChoiceError,
            ("split: expected one of train, val, test", "all, or a split file", "'val'?"),
        ),
        (
            lambda: da.transform(sample, other),
            ChoiceError,
            ("expected two samples of one scenario",),
        ),
        (lambda: da.sensor[8], IndexError, ("table 'sensor' has 8 rows, asked for row 8",)),
        (lambda: da.sample["token"], TableError, ("'sample' takes row numbers", "found 'token'")),
        (
            lambda: da.load_point_cloud(sample, "Camera_Front"),
            ChoiceError,
            ("frame: expected one of world, ego, lid",),
        ),
        (
            lambda: da.get("sample", "x"),
            KeyError,
            ("table 'sample' has no token",),
        ),  # the built-in kind, and the devkit's
        (lambda: da.get("sample", "x"), DeepAccidentError, ("table 'sample' has no token",)),
    )


def test_boxes_know_their_tokens(da: DeepAccident) -> None:
    for sample in da.samples_of(da.scenario[0]["first_frame_token"]):
        for frame, visible in (
            ("world", None),
            ("lidar", None),
            ("Camera_Front", "camera"),
            ("ego", "released"),
        ):
            box_list = da.get_boxes(sample, frame, visible)
            boxes = da.boxes(sample, frame, visible)
            assert boxes.token == [box.token for box in box_list] == [box.token for box in boxes]
            assert [repr(box) for box in boxes] == [repr(box) for box in box_list]
            for box in box_list:
                record = da.get("annotation", box.token)
                assert record["sample_token"] == sample["token"]
                assert record["actor_id"] == box.actor_id
                assert record["instance_token"] == box.instance_token
    assert da.cooperative_boxes(sample).token is None


def test_missing_and_broken_sensor_files_are_named(own_release: Path) -> None:
    release = DeepAccident(dataroot=own_release, verbose=False)
    sample = release.sample[0]["token"]
    image = release.get_sample_data_path(f"{sample}/Camera_Front")
    cloud = release.get_sample_data_path(f"{sample}/lidar01")
    cloud.parent.mkdir(parents=True)
    cloud.write_bytes(b"")

    assert_raises(
        (
            lambda: release.load_image(f"{sample}/Camera_Front"),
            MissingFileError,
            (f"{image.name}: no such file; unpack the archive",),
        ),
        (lambda: release.load_bev(sample), MissingFileError, ("no such file",)),
        (
            lambda: release.load_point_cloud(sample),
            SensorFileError,
            (cloud.name, "is empty", "; restore the file"),
        ),
    )


def test_arguments_of_a_wrong_kind_are_our_errors(da: DeepAccident) -> None:
    message = ("expected a token or a record with one, found",)
    for token in (None, 3, b"token", {}, {"name": "x"}):
        assert_raises((partial(da.get, "sample", token), TokenError, message))

    get_ego_sample = partial(da.get_sample, da.scenario[0], "ego_vehicle")
    message = ("frame: expected a number from 1, found",)
    for frame in (1.7, "1", None):
        assert_raises((partial(get_ego_sample, frame), TokenError, message))
    assert get_ego_sample(np.int64(2))["token"].endswith("/ego_vehicle/002")


def test_a_sample_is_found_by_its_time_to_the_impact(da: DeepAccident) -> None:
    for sample in da.sample[:20]:
        if sample["time_to_impact"] is not None:
            scenario, agent, _ = sample["token"].rsplit("/", 2)
            assert da.get_sample(scenario, agent, time_to_impact=sample["time_to_impact"]) == sample

    accident, normal = da.find(collision=True)[0], da.find(collision=False)[0]
    get_ego_sample = partial(da.get_sample, accident, "ego_vehicle")
    last_token = f"{accident['token']}/ego_vehicle/{accident['num_frames']:03d}"
    assert get_ego_sample(time_to_impact=0)["token"] == last_token
    assert_raises(
        (
            lambda: da.get_sample(normal, "ego_vehicle", time_to_impact=0),
            NotAvailableError,
            ("no collision", "frame="),
        ),
        (
            lambda: get_ego_sample(1, time_to_impact=0.1),
            TokenError,
            ("frame: expected", "time_to_impact="),
        ),
    )
    for time in (-0.1, 0.05, 99, math.inf, math.nan, "1"):
        call = partial(get_ego_sample, time_to_impact=time)
        assert_raises((call, TokenError, ("time_to_impact: expected",)))


def test_a_caller_may_change_its_records(da: DeepAccident) -> None:
    record = da.get("annotation", da.annotation[0]["token"])
    expected = list(record["translation"])
    record["translation"][0] += 100
    record.clear()
    assert da.annotation[0]["translation"] == expected


def test_arrays_are_read_only_and_the_tables_keep_their_values(da: DeepAccident) -> None:
    sample = da.sample[0]
    names = ("center", "size", "rotation", "velocity", "actor_id", "camera_visible", "row")
    for frame in ("lidar", "ego", "world"):
        boxes = da.boxes(sample, frame)
        assert {getattr(boxes, name).flags.writeable for name in names} == {False}
    image = da.load_image(f"{sample['token']}/Camera_Front")
    image[:] = 0  # this array belongs to the caller
    assert da.load_image(f"{sample['token']}/Camera_Front").any()


def test_a_pickle_is_small_and_opens_again(da: DeepAccident) -> None:
    content = pickle.dumps(da)
    assert len(content) < 2000
    assert pickle.loads(content).get("sample", da.sample[3]["token"]) == da.sample[3]


@pytest.mark.parametrize("method", ["spawn", "fork"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_workers_get_their_own_copy(da: DeepAccident, method: str) -> None:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context(method)) as pool:
        counts = list(pool.map(num_boxes, [da] * 3, range(3)))
    assert counts == [num_boxes(da, row) for row in range(3)]


def test_tables_behave_like_sequences(da: DeepAccident) -> None:
    scenarios = da.scenario
    assert len(scenarios) == len(list(scenarios)) == len(scenarios[:]) == 4
    assert da.arrow("scenario").num_rows == 4
    assert scenarios[-1] == scenarios[3] == scenarios[2:][1]
    assert repr(scenarios).startswith("<table 'scenario': 4 rows of token, name")


@pytest.mark.parametrize(
    ("table", "field"),
    [
        ("scenario", "weather"),
        ("scenario", "num_frames"),
        ("scenario", "designed_accident"),
        ("scenario", "collision"),
        ("sample", "agent_token"),
        ("sample", "prev"),
        ("annotation", "category"),
        ("annotation", "actor_id"),
        ("annotation", "camera_visible"),
        ("sample_data", "filename"),
        ("sample_data", "width"),
        ("agent", "actor_id"),
    ],
)
def test_field2token_agrees_with_the_records(da: DeepAccident, table: str, field: str) -> None:
    records = getattr(da, table)
    values = {repr(record[field]): record[field] for record in records[:40]}
    for value in values.values():
        expected = [record["token"] for record in records if record[field] == value]
        assert da.field2token(table, field, value) == expected
    assert da.field2token(table, field, "no such value") == []


def test_get_sample_and_samples_of(da: DeepAccident) -> None:
    scenario = da.scenario[2]
    samples = da.samples_of(scenario["last_frame_token"])
    assert [sample["agent"] for sample in samples] == list(AGENTS)
    assert (
        samples[1]
        == da.get_sample(scenario, "ego_vehicle_behind", 6)
        == da.get_sample(scenario["token"], AGENTS[1], 6)
    )


def test_sensor_data_is_where_it_should_be(da: DeepAccident) -> None:
    """The LiDAR points of a box lie in it in every frame."""
    for sample in da.samples_of(da.scenario[0]["first_frame_token"]):
        for frame in ("world", "ego", "lidar"):
            cloud = da.load_point_cloud(sample, frame)
            boxes = da.boxes(sample, frame)
            has_many_points = boxes.num_lidar_pts > 20
            counts = boxes.contains(cloud.xyz).sum(axis=1)

            assert cloud.frame == frame
            assert has_many_points.any()
            np.testing.assert_allclose(
                counts[has_many_points], boxes.num_lidar_pts[has_many_points], atol=1
            )
        assert da.load_image(f"{sample['token']}/{CAMERAS[0]}").shape == (36, 64, 3)
        assert da.load_bev(sample).semantic.shape == (1200, 1200)


@pytest.mark.parametrize("channel", ["Camera_Back", "lidar01"])
def test_a_sensor_file_is_named_by_its_sample_and_channel_too(
    da: DeepAccident, channel: str
) -> None:
    sample = da.sample[1]
    token = f"{sample['token']}/{channel}"
    path, boxes, intrinsic = da.get_sample_data(token)
    for sample_or_token in (sample, sample["token"]):
        same_path, same_boxes, same_intrinsic = da.get_sample_data(sample_or_token, channel)
        assert da.get_sample_data_path(sample_or_token, channel) == same_path == path
        assert [repr(box) for box in same_boxes] == [repr(box) for box in boxes]
        np.testing.assert_array_equal(same_intrinsic, intrinsic)
    assert (intrinsic is None) == (channel == "lidar01")
    if channel != "lidar01":
        np.testing.assert_array_equal(da.load_image(sample, channel), da.load_image(token))

    for method in (da.get_sample_data_path, da.get_sample_data, da.load_image, da.camera):
        unknown_channel = partial(method, sample, "CAM_FRONT")
        no_channel = partial(method, sample)
        assert_raises(
            (unknown_channel, TokenError, ("the channels are Camera_Front, ",)),
            (no_channel, TokenError, ("this is the token of a sample: add a channel",)),
        )


def test_a_camera_agrees_with_its_calib(da: DeepAccident) -> None:
    sample = da.sample[0]
    record = da.get("sample_data", f"{sample['token']}/Camera_Front")
    camera = da.camera(record)
    assert (camera.width, camera.height) == (record["width"], record["height"]) == (64, 36)
    for other in (camera, da.camera(record["token"]), da.camera(sample, "Camera_Front")):
        np.testing.assert_array_equal(other.intrinsic, da.get_sample_data(record)[2])
    in_image = camera.boxes_in_image(da.boxes(sample, frame="Camera_Front"))
    assert 0 < in_image.sum() < len(in_image)
    for channel in ("lidar01", "BEV_instance_camera"):
        message = ("camera: expected one of Camera_Front, ", f"found {channel}")
        assert_raises((partial(da.camera, sample, channel), ChoiceError, message))
