"""The facade as a user meets it: names, errors, ownership, pickling."""

import math
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused
from workers import num_boxes

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


def test_dataroots_that_are_none(tmp_path: Path, release_root: Path) -> None:
    assert_refused(
        (
            lambda: DeepAccident(dataroot=tmp_path / "nowhere"),
            DatarootError,
            ("nowhere: does not exist; give the fo",),
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
            r"unknown version 'v2'; known are v1, v1-mini$",
        ),
        (lambda: DeepAccident("v1-mini", release_root), VersionError, ("holds no mini release",)),
        (
            lambda: DeepAccident(dataroot=release_root, on_error="ignore"),
            ChoiceError,
            ("on_error: expected one of raise, skip, found 'ignore'",),
        ),
        *(
            (
                lambda path=path: DeepAccident(path),
                VersionError,
                (f"write DeepAccident(dataroot='{path}')",),
            )
            for path in (str(release_root), Path("a/b"), "~", "./x")
        ),
        *(
            (
                lambda theirs=theirs: DeepAccident(theirs, release_root),
                VersionError,
                (f"; did you mean '{ours}'?",),
            )
            for theirs, ours in (("v1.0-mini", "v1-mini"), ("v1.0-trainval", "v1"))
        ),
    )


@pytest.mark.slow
def test_the_mini_release_is_a_version_of_its_own(own_release: Path) -> None:
    (own_release / "train").rename(own_release / "DeepAccident_mini")
    (own_release / "train.txt").unlink()
    whole, mini = (
        DeepAccident(version, own_release, verbose=False) for version in ("v1", "v1-mini")
    )
    assert len(whole.scenario) + len(mini.scenario) == 6
    assert {scenario["folder"] for scenario in mini.scenario} == {"DeepAccident_mini"}
    alone = DeepAccident("v1-mini", own_release / "DeepAccident_mini", verbose=False)
    assert len(alone.scenario) == len(mini.scenario) > 0


@pytest.mark.parametrize(
    ("token", "why"),
    [
        ("nonsense", "expected the form <scenario>/<agent>/<NNN>"),
        ("a/b/ego_vehicle/001", "this release has no scenario 'a/b'"),
        ("{scenario}/bus/001", "the scenario's agents are ego_vehicle, "),
        ("{scenario}/ego_vehicle/007", "the scenario's frames are 001 to 006"),
        ("{scenario}/ego_vehicle/1", "the scenario's frames are 001 to 006"),
        ("{scenario}/ego_vehicle/+01", "the scenario's frames"),
    ],
)
def test_unknown_sample_tokens(da: DeepAccident, token: str, why: str) -> None:
    token = token.format(scenario=da.scenario[0]["token"])
    told = ("table 'sample' has no token", why)
    calls = (
        lambda: da.get("sample", token),
        lambda: da.boxes(token),
        lambda: da.load_point_cloud(token),
    )
    assert_refused(*((call, TokenError, told) for call in calls))


def test_a_sensor_file_and_a_sample_are_not_taken_for_each_other(da: DeepAccident) -> None:
    sample, cloud = da.sample[0], da.get("sample_data", f"{da.sample[0]['token']}/lidar01")
    token = sample["token"]
    front = f"{token}/Camera_Front"
    of_file, of_sample = (
        r"it names a sensor file: leave out '/lidar01'$",
        r"it names a sample: add a channel, such .*'$",
    )
    form = r"expected the form <scenario>/<agent>/<NNN>{}$"
    actor = f"{sample['scenario_token']}/actor/x"
    assert_refused(
        (lambda: da.map_pointcloud_to_image(front, cloud), TokenError, of_file),
        (lambda: da.map_pointcloud_to_image(sample, front), TokenError, of_sample),
        (lambda: da.get("sample", f"{token}/7"), TokenError, form.format("")),
        (lambda: da.get("sample", f"{front}/lidar01"), TokenError, form.format("")),
        (lambda: da.get("sample_data", actor), TokenError, form.format("/<channel>")),
    )


def test_a_scenarios_name_alone_is_completed(da: DeepAccident) -> None:
    name = da.scenario[0]["name"]
    kinds = [one["scenario_type"] for one in da.scenario if one["name"] == name]
    calls = {
        "": lambda: da.get("scenario", name),
        "/ego_vehicle/003": lambda: da.get_sample(name, "ego_vehicle", 3),
        "/actor/7": lambda: da.get("instance", f"{name}/actor/7"),
        "/ego_vehicle/lidar01/2": lambda: da.get(
            "calibrated_sensor", f"{name}/ego_vehicle/lidar01/2"
        ),
    }
    assert_refused(
        *(
            (
                call,
                TokenError,
                (
                    "is not unique",
                    "; write " + " or ".join(f"'{kind}/{name}{rest}'" for kind in kinds),
                ),
            )
            for rest, call in calls.items()
        ),
        (lambda: da.get_sample("Town99", "ego_vehicle", 3), TokenError, ("expected the form",)),
    )


@pytest.mark.parametrize(
    "table", ["scenario", "sample_data", "instance", "annotation", "track", "calibrated_sensor"]
)
def test_unknown_tokens_of_other_tables(da: DeepAccident, table: str) -> None:
    token, told = getattr(da, table)[0]["token"], (f"table '{table}' has no token",)
    wrongs = (f"{token}9", f"{token}/1/1/1/1", token.replace("Town", "Village"), f"{token}/1", "")
    assert_refused(
        *((lambda wrong=wrong: da.get(table, wrong), TokenError, told) for wrong in wrongs)
    )


def test_unknown_tables_fields_channels_and_frames(da: DeepAccident) -> None:
    sample = da.sample[0]["token"]
    other = da.samples_of(da.get("frame", da.scenario[1]["first_frame_token"]))[0]
    assert_refused(
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
        (lambda: da.load_image(f"{sample}/lidar01"), ChoiceError, ("lidar01 holds no images",)),
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
        (lambda: da.sample["token"], TableError, ("'sample' counts its rows", "found 'token'")),
        (
            lambda: da.load_point_cloud(sample, "Camera_Front"),
            ChoiceError,
            ("frame: expected one of world, ego, lid",),
        ),
        (
            lambda: da.get("sample", "x"),
            KeyError,
            ("table 'sample' has no token",),
        ),  # ours, and the built-in kind
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
            objects, boxes = da.get_boxes(sample, frame, visible), da.boxes(sample, frame, visible)
            assert boxes.token == [box.token for box in objects] == [box.token for box in boxes]
            assert [repr(box) for box in boxes] == [repr(box) for box in objects]
            for box in objects:
                record = da.get("annotation", box.token)
                assert (record["sample_token"], record["actor_id"]) == (
                    sample["token"],
                    box.actor_id,
                )
                assert record["instance_token"] == box.instance_token
    assert da.cooperative_boxes(sample).token is None


def test_missing_and_broken_sensor_files_are_named(own_release: Path) -> None:
    release = DeepAccident(dataroot=own_release, verbose=False)
    sample = release.sample[0]["token"]
    image, cloud = (
        release.get_sample_data_path(f"{sample}/{channel}")
        for channel in ("Camera_Front", "lidar01")
    )
    cloud.parent.mkdir(parents=True)
    cloud.write_bytes(b"")
    missing = (f"{image.name}: no such file; unpack the archive",)
    assert_refused(
        (lambda: release.load_image(f"{sample}/Camera_Front"), MissingFileError, missing),
        (lambda: release.load_bev(sample), MissingFileError, ("no such file",)),
        (
            lambda: release.load_point_cloud(sample),
            SensorFileError,
            (cloud.name, "is empty", "; restore the file"),
        ),
    )


def test_arguments_of_a_wrong_kind_are_our_errors(da: DeepAccident) -> None:
    record, number = (
        ("expected a token or a record with one, found",),
        ("frame: expected a number from 1, found",),
    )
    assert_refused(
        *(
            (lambda odd=odd: da.get("sample", odd), TokenError, record)
            for odd in (None, 3, b"token", {}, {"name": "x"})
        ),
        *(
            (lambda o=o: da.get_sample(da.scenario[0], "ego_vehicle", o), TokenError, number)
            for o in (1.7, "1", None)
        ),
    )
    assert da.get_sample(da.scenario[0], "ego_vehicle", np.int64(2))["token"].endswith(
        "/ego_vehicle/002"
    )


def test_a_sample_is_found_by_its_time_to_the_impact(da: DeepAccident) -> None:
    accident, normal = da.find(collision=True)[0], da.find(collision=False)[0]
    for sample in filter(lambda sample: sample["time_to_impact"] is not None, da.sample[:20]):
        scenario, agent, _ = sample["token"].rsplit("/", 2)
        assert da.get_sample(scenario, agent, time_to_impact=sample["time_to_impact"]) == sample
    at = partial(da.get_sample, accident, "ego_vehicle")
    assert (
        at(time_to_impact=0)["token"]
        == f"{accident['token']}/ego_vehicle/{accident['num_frames']:03d}"
    )
    assert_refused(
        (
            lambda: da.get_sample(normal, "ego_vehicle", time_to_impact=0),
            NotAvailableError,
            ("no collision", "frame="),
        ),
        (lambda: at(1, time_to_impact=0.1), TokenError, ("frame: expected", "time_to_impact=")),
        *[
            (partial(at, time_to_impact=wrong), TokenError, ("time_to_impact: expected",))
            for wrong in (-0.1, 0.05, 99, math.inf, math.nan, "1")
        ],
    )


def test_records_are_the_callers(da: DeepAccident) -> None:
    record = da.get("annotation", da.annotation[0]["token"])
    expected = list(record["translation"])
    record["translation"][0] += 100
    record.clear()
    assert da.annotation[0]["translation"] == expected


def test_arrays_are_read_only_and_the_tables_keep_their_values(da: DeepAccident) -> None:
    sample = da.sample[0]
    names = ("center", "size", "rotation", "velocity", "actor_id", "camera_visible", "row")
    boxes = [da.boxes(sample, frame) for frame in ("lidar", "ego", "world")]
    assert {getattr(each, name).flags.writeable for each in boxes for name in names} == {False}
    image = da.load_image(f"{sample['token']}/Camera_Front")
    image[:] = 0  # the caller's own
    assert da.load_image(f"{sample['token']}/Camera_Front").any()


def test_a_pickle_is_small_and_opens_again(da: DeepAccident) -> None:
    content = pickle.dumps(da)
    assert (len(content) < 2000, pickle.loads(content).get("sample", da.sample[3]["token"])) == (
        True,
        da.sample[3],
    )


@pytest.mark.parametrize("method", ["spawn", "fork"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_workers_get_their_own_copy(da: DeepAccident, method: str) -> None:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context(method)) as pool:
        counts = list(pool.map(num_boxes, [da] * 3, range(3)))
    assert counts == [num_boxes(da, row) for row in range(3)]


def test_tables_behave_like_sequences(da: DeepAccident) -> None:
    scenarios = da.scenario
    assert {
        len(scenarios),
        len(list(scenarios)),
        len(scenarios[:]),
        da.arrow("scenario").num_rows,
    } == {4}
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
    records = getattr(da, table)[:400]
    for value in {repr(record[field]): record[field] for record in records[:40]}.values():
        expected = [record["token"] for record in getattr(da, table) if record[field] == value]
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
    """LiDAR points of a box lie in it in whichever frame, and its centre projects to the same
    pixel.
    """
    for sample in da.samples_of(da.scenario[0]["first_frame_token"]):
        for frame in ("world", "ego", "lidar"):
            cloud, boxes = da.load_point_cloud(sample, frame), da.boxes(sample, frame)
            assert cloud.frame == frame
            well_hit = boxes.num_lidar_pts > 20
            assert well_hit.any()
            counts = boxes.contains(cloud.xyz).sum(axis=1)
            np.testing.assert_allclose(counts[well_hit], boxes.num_lidar_pts[well_hit], atol=1)
        assert da.load_image(f"{sample['token']}/{CAMERAS[0]}").shape == (36, 64, 3)
        assert da.load_bev(sample).semantic.shape == (1200, 1200)


@pytest.mark.parametrize("channel", ["Camera_Back", "lidar01"])
def test_a_sensor_file_is_named_by_its_sample_and_channel_too(
    da: DeepAccident, channel: str
) -> None:
    sample = da.sample[1]
    token = f"{sample['token']}/{channel}"
    path, boxes, intrinsic = da.get_sample_data(token)
    for named in (sample, sample["token"]):
        same_path, same_boxes, same_intrinsic = da.get_sample_data(named, channel)
        assert (da.get_sample_data_path(named, channel), same_path) == (path, path)
        assert [repr(box) for box in same_boxes] == [repr(box) for box in boxes]
        np.testing.assert_array_equal(same_intrinsic, intrinsic)
    assert (intrinsic is None) == (channel == "lidar01")
    if channel != "lidar01":
        np.testing.assert_array_equal(da.load_image(sample, channel), da.load_image(token))
    for call in (da.get_sample_data_path, da.get_sample_data, da.load_image, da.camera):
        assert_refused(
            (
                lambda call=call: call(sample, "CAM_FRONT"),
                TokenError,
                ("the channels are Camera_Front, ",),
            ),
            (lambda call=call: call(sample), TokenError, ("it names a sample: add a channel",)),
        )


def test_a_camera_is_its_calibs(da: DeepAccident) -> None:
    sample = da.sample[0]
    record = da.get("sample_data", f"{sample['token']}/Camera_Front")
    camera = da.camera(record)
    assert (camera.width, camera.height) == (record["width"], record["height"]) == (64, 36)
    for other in (camera, da.camera(record["token"]), da.camera(sample, "Camera_Front")):
        np.testing.assert_array_equal(other.intrinsic, da.get_sample_data(record)[2])
    seen = camera.boxes_in_image(da.boxes(sample, frame="Camera_Front"))
    assert 0 < seen.sum() < len(seen)
    told = "camera: expected one of Camera_Front, "
    assert_refused(
        *(
            (
                lambda channel=channel: da.camera(sample, channel),
                ChoiceError,
                (told, f"found {channel}"),
            )
            for channel in ("lidar01", "BEV_instance_camera")
        )
    )
