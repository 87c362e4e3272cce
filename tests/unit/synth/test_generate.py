import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, MissingFileError
from deepaccident_devkit.release import find_release, read_calib, read_image, read_label, read_meta, read_split_file
from deepaccident_devkit.synth import SynthConfig, generate, make_release
from deepaccident_devkit.synth.generate import Unfinished
from deepaccident_devkit.synth.plan import plan_scenarios
from deepaccident_devkit.synth.scenario import _KEPT, _Recorder, build_scenario, parts_of, record_scenario
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CAMERAS, CHANNELS, LIDAR, MINI_SPLITS, SPLITS
from deepaccident_devkit.validation import release_completeness, validate_release

pytestmark = pytest.mark.slow


def test_every_file_is_there_and_nothing_else(release_root, scenarios, config, digests):
    frames = range(1, config.frames + 1)
    expected = {s.meta_path for s in scenarios} | {release_root / f"{name}.txt" for name in (*SPLITS, *MINI_SPLITS)}
    for scenario in scenarios:
        for agent in AGENTS:
            for frame in frames:
                expected |= {scenario.label_path(agent, frame), scenario.calib_path(agent, frame)}
                expected |= {scenario.channel_path(agent, channel, frame) for channel in CHANNELS}
    assert {release_root / name for name in digests(release_root)} == expected
    assert [path.name for path in release_root.parent.iterdir()] == [release_root.name]


def test_accident_and_twin_share_name_and_scene(scenarios):
    assert [s.scenario_type for s in scenarios] == ["type1_subtype1_accident", "type1_subtype1_normal"]
    assert scenarios[0].name == scenarios[1].name
    accident, normal = (read_meta(s.meta_path) for s in scenarios)
    assert normal.collision is None
    assert set(normal.planned_agents) == {"ego_vehicle", "other_vehicle"}
    assert " colliding agents: " in scenarios[1].meta_path.read_text()
    assert set(accident.collision.ids) == {accident.agent_ids[0], accident.agent_ids[2]}
    assert set(accident.collision.agents) == {"ego_vehicle", "other_vehicle"}
    assert accident.agent_ids == normal.agent_ids
    assert (accident.weather, accident.spawn_side) == (normal.weather, normal.spawn_side)
    assert accident.simulated_frames == 13
    assert accident.road_type == "four-way junction"


def test_layout_b_has_a_folder_a_split(tmp_path):
    config = SynthConfig(scenarios=5, frames=1, layout="B", sensors=False)
    release = find_release(make_release(tmp_path / "b", config, workers=1))
    assert release.layout == "B"
    assert [s.folder for s in sorted(release.scenarios, key=lambda s: s.name[-5:])] == ["train"] * 2 + ["val"] * 2 + [
        "test"
    ]
    for split, path in release.split_files.items():
        tokens = {s.token for s in release.scenarios if s.folder == split.removesuffix("_mini")}
        assert set(read_split_file(path)) == tokens
    assert len(read_label(release.scenarios[-1].label_path("infrastructure", 1))) > 5


def test_a_release_for_the_released_code_has_its_split_files_twice(tmp_path):
    """Calib files are those of 1600x900 images, whether images are there or not."""
    config = SynthConfig(scenarios=4, frames=1, sensors=False, for_released_code=True)
    root = make_release(tmp_path / "released", config, workers=1)
    release = find_release(root)
    assert release.layout == "A"
    for split in (*SPLITS, *MINI_SPLITS):
        assert release.split_files[split] == root / f"{split}.txt"
        copy = root / "split_txt_files" / f"{split}.txt"
        assert copy.read_bytes() == release.split_files[split].read_bytes()
        assert bool(copy.read_bytes()) == (split != "test")
    intrinsic = read_calib(release.scenarios[0].calib_path("ego_vehicle", 1)).intrinsic
    for channel in CAMERAS:
        assert intrinsic[channel][:2, 2] == pytest.approx((800, 450))
    assert validate_release(root, workers=1).is_good


def test_images_for_the_released_code_have_its_size(tmp_path):
    config = SynthConfig(scenarios=1, frames=1, for_released_code=True)
    (scenario,) = find_release(make_release(tmp_path / "released", config, workers=1)).scenarios
    for agent in AGENTS:
        for channel in CAMERAS:
            assert read_image(scenario.channel_path(agent, channel, 1)).shape == (900, 1600, 3)


def test_same_seed_same_bytes_with_any_number_of_workers(tmp_path, digests):
    """Two and three processes share one scenario."""
    config = SynthConfig(scenarios=1, frames=4, image_size=(32, 18), seed=7)
    one, two, three = (digests(make_release(tmp_path / str(count), config, workers=count)) for count in (1, 2, 3))
    assert one == two == three


def test_one_scenario_gives_work_to_several_processes():
    assert parts_of(SynthConfig(frames=None)) == parts_of(SynthConfig(frames=60)) >= 4
    assert parts_of(SynthConfig(frames=2)) == 2
    assert parts_of(SynthConfig(frames=60, sensors="none")) == 1


@pytest.fixture
def break_off(monkeypatch):
    """Makes a release until the disk is full, at the second frame of the second scenario."""

    def make(out: Path, config: SynthConfig) -> None:
        recorded = []
        record = _Recorder.record

        def record_until_full(recorder, frame):
            recorded.append(frame)
            if len(recorded) == config.frames + 2:
                raise OSError("disk full")
            record(recorder, frame)

        with monkeypatch.context() as patch:
            patch.setattr(_Recorder, "record", record_until_full)
            with pytest.raises(ConfigError, match=r"cannot be written \(disk full\); make room there"):
                make_release(out, config, workers=1)

    return make


def test_a_broken_off_release_is_gone_on_with(tmp_path, break_off, digests, monkeypatch):
    """The parts that are whole are not made again, and no byte tells."""
    config = SynthConfig(scenarios=2, frames=3, image_size=(32, 18), seed=7)
    whole = digests(make_release(tmp_path / "whole", config, workers=1))
    out, recorded = tmp_path / "broken", []
    break_off(out, config)
    assert not out.exists()
    (part,) = (tmp_path / ".broken.unfinished" / "parts").glob("*_normal_*")
    (half_made := part.with_name(part.name.replace("1of3", "2of3"))).mkdir()
    (half_made / "half.tmp").write_text("left by the break")

    def record(job):
        recorded.append((job.plan.token, job.first))
        return record_scenario(job)

    monkeypatch.setattr(generate, "record_scenario", record)
    assert make_release(out, config, workers=1) == out
    assert recorded == [(plan_scenarios(config)[1].token, first) for first in (2, 3)]
    assert digests(out) == whole
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken", "whole"]


@pytest.fixture
def unwritable(tmp_path):
    """A folder where a scenario's frames from the third on cannot be written: a file lies where a folder must be."""
    config = SynthConfig(scenarios=1, frames=4, image_size=(32, 18), seed=7)
    unfinished = Unfinished(tmp_path / "out")
    name = next(iter(generate._parts(unfinished, config, plan_scenarios(config)[0])))
    return tmp_path / "out", config, unfinished.part(name.replace("1of", "3of"))


def test_a_worker_that_fails_leaves_no_half_written_scenario(unwritable, digests, tmp_path):
    """In another process; once the fault is gone, the release is finished, and no byte tells."""
    out, config, place = unwritable
    place.parents[1].mkdir(parents=True)
    place.parent.write_text("in the way")
    with pytest.raises((OSError, ConfigError), match=place.parent.name):
        make_release(out, config, workers=2)
    assert not out.exists()
    unfinished = Unfinished(out)
    assert not unfinished.release.exists()
    place.parent.unlink(missing_ok=True)
    make_release(out, config, workers=2)
    assert digests(out) == digests(make_release(tmp_path / "whole", config, workers=1))
    assert not unfinished.folder.exists()


def test_a_scenario_that_could_not_be_moved_in_is_not_made_again(tmp_path, digests, monkeypatch):
    config = SynthConfig(scenarios=1, frames=1, sensors=False)
    with monkeypatch.context() as patch:
        patch.setattr(Unfinished, "gather", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            make_release(tmp_path / "out", config, workers=1)
    assert _KEPT.made_ready.cache_info().currsize == 0
    with monkeypatch.context() as patch:
        patch.setattr(generate, "record_scenario", lambda _: pytest.fail("made again"))
        make_release(tmp_path / "out", config, workers=1)
    assert digests(tmp_path / "out") == digests(make_release(tmp_path / "whole", config, workers=1))


def test_gathering_goes_on_after_a_break(tmp_path):
    """Some files are moved already; what is there is neither lost nor doubled."""
    unfinished = Unfinished(tmp_path / "out")
    for part, name in (("one", "a/x"), ("one", "a/y"), ("two", "a/z"), ("two", "b/x")):
        path = unfinished.part(part) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(part)
    (unfinished.release / "a").mkdir(parents=True)
    (unfinished.part("one") / "a" / "x").rename(unfinished.release / "a" / "x")
    for _ in range(2):
        unfinished.gather(["one", "two"])
        files = {p.relative_to(unfinished.release).as_posix() for p in unfinished.release.rglob("?") if p.is_file()}
        assert files == {"a/x", "a/y", "a/z", "b/x"}
    assert not any((unfinished.folder / "parts").iterdir())


def test_one_of_a_configuration_with_other_fields_does_not_go_on_either(tmp_path, break_off):
    """As left by a state of the package in which a field was not there yet."""
    out, config = tmp_path / "out", SynthConfig(scenarios=2, frames=2, sensors=False)
    break_off(out, config)
    path = tmp_path / ".out.unfinished" / "config.json"
    there = json.loads(path.read_text())
    del there["unplanned"]
    path.write_text(json.dumps(there))
    with pytest.raises(ConfigError, match=r"another configuration \(unplanned: None there, 0.1 asked for\)"):
        make_release(out, config)


def test_another_configuration_does_not_go_on_with_it(tmp_path, break_off):
    out, config = tmp_path / "out", SynthConfig(scenarios=2, frames=2, sensors=False)
    break_off(out, config)
    with pytest.raises(
        ConfigError, match=r"another configuration \(seed: 0 there, 1 asked for\); ask for the same to finish it"
    ):
        make_release(out, replace(config, seed=1), workers=1)
    for sensors in ("all", "cameras"):
        with pytest.raises(ConfigError, match=f"sensors: 'none' there, '{sensors}' asked for"):
            make_release(out, replace(config, sensors=sensors), workers=1)
    assert not out.exists()


def test_an_unlabelled_test_split_has_calib_images_and_points_alone(tmp_path):
    """As the real one has; the other splits lack nothing."""
    config = SynthConfig(scenarios=5, frames=1, image_size=(32, 18), layout="B", unlabelled_test=True)
    root = make_release(tmp_path / "out", config, workers=1)
    test = {path.parent.parent.name for path in (root / "test").rglob("*_001.*")}
    assert test == {"calib", *CHANNELS} - {"BEV_instance_camera"}
    assert not list((root / "test").rglob("meta"))
    train = {path.parent.parent.name for path in (root / "train").rglob("*_001.*")}
    assert train == {"calib", "label", *CHANNELS}
    assert len(list((root / "train").rglob("meta/*.txt"))) == 2
    assert len(DeepAccident("v1", root, verbose=False).split_scenarios("test")) == 1


def test_exact_releases_differ_in_calib_and_counts_alone(tmp_path):
    usual, exact = (
        find_release(
            make_release(tmp_path / str(exact), SynthConfig(scenarios=1, frames=4, sensors=False, seed=7, exact=exact))
        ).scenarios[0]
        for exact in (False, True)
    )
    counts = []
    for agent, frame in itertools.product(AGENTS, range(1, 5)):
        one, other = (read_label(scenario.label_path(agent, frame)) for scenario in (usual, exact))
        for name in ("center", "size", "yaw", "velocity", "actor_id", "camera_visible"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        counts.append((one.num_lidar_pts != other.num_lidar_pts).mean())
        assert read_calib(exact.calib_path(agent, frame), raw=True)["lidar_to_ego"][0, 0] == 1
    assert 0.01 < np.mean(counts) < 0.4
    first, second = (read_calib(exact.calib_path("ego_vehicle", frame), raw=True) for frame in (1, 4))
    np.testing.assert_array_equal(first["lidar_to_Camera_Back"], second["lidar_to_Camera_Back"])
    first, second = (read_calib(usual.calib_path("ego_vehicle", frame), raw=True) for frame in (1, 4))
    assert 0 < np.abs(first["lidar_to_Camera_Back"] - second["lidar_to_Camera_Back"]).max() < 3e-4


@pytest.mark.parametrize(
    ("sensors", "endings"), [("none", (".txt", ".pkl")), ("cameras", (".txt", ".pkl", ".jpg"))], ids=str
)
def test_with_fewer_sensors_the_other_files_are_the_same(tmp_path, release_root, config, digests, sensors, endings):
    fewer = digests(make_release(tmp_path / sensors, replace(config, sensors=sensors), workers=1))
    full = digests(release_root)
    assert fewer == {name: content for name, content in full.items() if name.endswith(endings)}


def test_a_release_of_images_alone_is_as_a_partial_download(tmp_path):
    """Nothing is wrong with it; what is missing is named, and labels can be made."""
    config = SynthConfig(scenarios=2, frames=1, image_size=(32, 18), sensors="cameras")
    root = make_release(tmp_path / "out", config, workers=1)
    assert validate_release(root, deep=True, workers=1).is_good
    counts = [each for split in release_completeness(root).splits.values() for each in split.files]
    assert {each.channel for each in counts if each.missing} == {LIDAR, BEV_CAMERA}
    assert all(each.missing == each.expected for each in counts if each.channel in (LIDAR, BEV_CAMERA))
    da = DeepAccident("v1", root, verbose=False)
    sample = da.sample[0]["token"]
    assert len(da.boxes(sample)) > 3
    assert da.load_image(f"{sample}/Camera_Front").shape == (18, 32, 3)
    with pytest.raises(MissingFileError, match=r"lidar01.*no such file"):
        da.load_point_cloud(sample)


def test_a_folder_with_something_in_it_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(ConfigError, match="not an empty folder; choose another folder"):
        make_release(tmp_path, SynthConfig(scenarios=1, frames=1, sensors=False))
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_an_empty_folder_is_filled(tmp_path):
    out = tmp_path / "empty"
    out.mkdir()
    make_release(out, SynthConfig(scenarios=1, frames=1, sensors=False))
    assert find_release(out).scenarios


def test_a_long_recording_waits_before_it_starts():
    config = SynthConfig(scenarios=1, frames=999)
    scenario = build_scenario(config, plan_scenarios(config)[0])
    row = scenario.actors.row_of(scenario.agents["ego_vehicle"])
    start, end = (scenario.actors.at(time).velocities[row] for time in (0.0, 99.8))
    assert np.abs(start).max() == 0
    assert np.hypot(*end) > 6.9
