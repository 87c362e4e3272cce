import itertools
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth import SynthConfig, generate, make_release
from deepaccident_devkit.plugins.synth.generate import Unfinished
from deepaccident_devkit.release import (
    find_release,
    read_calib,
    read_label,
    read_meta,
    read_split_file,
)
from deepaccident_devkit.support.files import temporary_path
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CAMERAS,
    CHANNELS,
    LIDAR,
    MINI_SPLITS,
    SPLITS,
)
from deepaccident_devkit.validation import release_completeness, validate_release


@pytest.mark.slow
def test_every_file_is_there_and_nothing_else(release_root, scenarios, config, digests):
    found = release_completeness(release_root, workers=1)
    assert (found.scenarios, found.whole) == (2, 2)
    names = {f"{name}.txt" for name in (*SPLITS, *MINI_SPLITS)}
    assert len(digests(release_root)) == len(names) + 2 * (
        1 + config.frames * len(AGENTS) * (2 + len(CHANNELS))
    )
    assert {path.name for path in release_root.glob("*.txt")} == names
    assert [path.name for path in release_root.parent.iterdir()] == [release_root.name]


@pytest.mark.slow
def test_accident_and_twin_share_name_and_scene(scenarios):
    assert [(s.scenario_type, s.name) for s in scenarios] == [
        (f"type1_subtype1_{kind}", scenarios[0].name) for kind in ("accident", "normal")
    ]
    accident, normal = (read_meta(s.meta_path) for s in scenarios)
    assert normal.collision is None
    assert (
        set(normal.planned_agents)
        == set(accident.collision.agents)
        == {"ego_vehicle", "other_vehicle"}
    )
    assert set(accident.collision.ids) == {accident.agent_ids[0], accident.agent_ids[2]}
    shared = [
        (each.agent_ids, each.weather, each.spawn_side, each.road_type)
        for each in (accident, normal)
    ]
    assert shared[0] == shared[1]


@pytest.mark.slow
def test_layout_b_has_a_folder_a_split(tmp_path):
    config = SynthConfig(scenarios=5, frames=1, layout="B", sensors=False)
    release = find_release(make_release(tmp_path / "b", config, workers=1))
    folders = [s.folder for s in sorted(release.scenarios, key=lambda s: s.name[-5:])]
    assert (release.layout, folders) == ("B", ["train", "train", "val", "val", "test"])
    for split, path in release.split_files.items():
        assert set(read_split_file(path)) == {
            s.token for s in release.scenarios if s.folder == split.removesuffix("_mini")
        }
    assert len(read_label(release.scenarios[-1].label_path("infrastructure", 1))) > 5


@pytest.mark.slow
def test_a_release_for_the_released_code_has_its_split_files_twice(tmp_path):
    """Calib files are those of 1600x900 images, whether images are there or not."""
    config = SynthConfig(
        scenarios=4, frames=1, sensors=False, for_released_code=True, designed=True
    )
    root = make_release(tmp_path / "released", config, workers=1)
    release = find_release(root)
    assert release.layout == "A"
    for split in (*SPLITS, *MINI_SPLITS):
        content = (root / f"{split}.txt").read_bytes()
        assert (root / "split_txt_files" / f"{split}.txt").read_bytes() == content
        assert (release.split_files[split], bool(content)) == (
            root / f"{split}.txt",
            split != "test",
        )
    intrinsic = read_calib(release.scenarios[0].calib_path("ego_vehicle", 1)).intrinsic
    np.testing.assert_allclose(
        [intrinsic[channel][:2, 2] for channel in CAMERAS], [(800, 450)] * len(CAMERAS)
    )
    assert validate_release(root, workers=1).is_good


@pytest.mark.slow
def test_same_seed_same_bytes_with_any_number_of_workers(tmp_path, digests):
    """Three processes share one scenario."""
    config = SynthConfig(scenarios=1, frames=4, image_size=(32, 18), seed=7)
    one, three = (
        digests(make_release(tmp_path / str(count), config, workers=count)) for count in (1, 3)
    )
    assert one == three


@pytest.mark.slow
def test_another_configuration_does_not_go_on_with_it(tmp_path, stop_at):
    out, config = tmp_path / "out", SynthConfig(scenarios=2, frames=2, sensors=False)
    stop_at(out, 1, config)
    assert_refused(
        (
            lambda: make_release(out, replace(config, seed=1), workers=1),
            ConfigError,
            ("seed: 0, asked for 1",),
        ),
        (
            lambda: make_release(out, replace(config, sensors="all"), workers=1),
            ConfigError,
            ("'none', asked for 'all'",),
        ),
    )
    assert not out.exists()


@pytest.mark.slow
def test_an_unlabelled_test_split_has_calib_images_and_points_alone(tmp_path):
    """As the real one has; the other splits lack nothing."""
    config = SynthConfig(
        scenarios=5, frames=1, image_size=(32, 18), layout="B", unlabelled_test=True
    )
    root = make_release(tmp_path / "out", config, workers=1)
    kinds = {
        split: {path.parts[-3] for path in (root / split).rglob("*_001.*")}
        for split in ("train", "test")
    }
    assert kinds == {
        "train": {"calib", "label", *CHANNELS},
        "test": {"calib", *CHANNELS} - {BEV_CAMERA},
    }
    assert [len([*(root / split).rglob("meta/*.txt")]) for split in ("train", "test")] == [2, 0]
    assert len(DeepAccident("v1", root, verbose=False).split_scenarios("test")) == 1


@pytest.mark.slow
def test_rounded_numbers_are_the_same_ones_with_fewer_digits(tmp_path):
    def made(decimals):
        config = SynthConfig(scenarios=1, frames=2, sensors=False, seed=7, decimals=decimals)
        return find_release(make_release(tmp_path / str(decimals), config, workers=1)).scenarios[0]

    full, rounded = made(None), made(4)
    for agent, frame in itertools.product(AGENTS, (1, 2)):
        one, other = (read_label(scenario.label_path(agent, frame)) for scenario in (full, rounded))
        for name in ("agent_velocity", "center", "size", "yaw", "velocity"):
            np.testing.assert_array_equal(getattr(one, name).round(4), getattr(other, name))
        one, other = (
            read_calib(scenario.calib_path(agent, frame), raw=True) for scenario in (full, rounded)
        )
        assert all(np.array_equal(matrix.round(4), other[name]) for name, matrix in one.items())
    assert not validate_release(rounded.root, workers=1).findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fields", "files"),
    [
        ({"sensors": "none"}, r"\.(txt|pkl)$"),
        ({"sensors": "cameras"}, r"\.(txt|pkl|jpg)$"),
        ({"sensors": "clouds"}, r"\.(txt|pkl)$|/lidar01/"),
        ({"sensors": "accidents"}, r"_accident/|\.(txt|pkl)$"),
        (
            {"sensor_step": 2},
            r"\.(txt|pkl)$|_00[13]\.\w+$",
        ),  # counted back from the last of three frames
        ({"sensor_step": 9, "sensors": "cameras"}, r"\.(txt|pkl)$|_003\.jpg$"),
    ],
    ids=str,
)
def test_with_fewer_sensors_the_other_files_are_the_same(
    tmp_path, release_root, config, digests, fields, files
):
    fewer = digests(make_release(tmp_path / "fewer", replace(config, **fields), workers=1))
    assert fewer == {
        name: content for name, content in digests(release_root).items() if re.search(files, name)
    }


@pytest.mark.slow
def test_sensors_of_some_frames_alone_are_missing_files_and_no_errors(tmp_path):
    config = SynthConfig(
        scenarios=2, frames=3, seed=3, image_size=(32, 18), sensors="cameras", sensor_step=2
    )
    root = make_release(tmp_path / "out", config, workers=1)
    found = validate_release(root, deep=True, workers=1)
    assert {(each.code, each.severity) for each in found.findings} == {
        ("sensor-frames-missing", "warning")
    }
    counts = [
        each
        for split in release_completeness(root).splits.values()
        for each in split.files
        if each.missing
    ]
    assert {each.channel for each in counts if each.missing == each.expected} == {LIDAR, BEV_CAMERA}


# On executors and by several processes: the very bytes of one call, whatever was interrupted.

LABELS = SynthConfig(scenarios=3, frames=2, sensors=False, seed=7)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, digests) -> dict[str, bytes]:
    return digests(make_release(tmp_path_factory.mktemp("whole") / "out", LABELS, workers=1))


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def unfinished(out) -> Unfinished:
    return Unfinished(out)


@pytest.fixture
def recorded(monkeypatch) -> list[str]:
    """The parts that are recorded in this process, in order."""
    names: list[str] = []
    record = generate.record_scenario

    def record_and_tell(job):
        names.append(job.root.name)
        record(job)

    monkeypatch.setattr(generate, "record_scenario", record_and_tell)
    return names


@pytest.fixture
def stop_at(monkeypatch):
    """Stop as Ctrl-C does, once so many parts are recorded."""
    record = generate.record_scenario

    def stop(out: Path, count: int, config: SynthConfig = LABELS) -> None:
        left = iter(range(count))

        def record_or_stop(job):
            if next(left, None) is None:
                raise KeyboardInterrupt
            record(job)

        with monkeypatch.context() as patch:
            patch.setattr(generate, "record_scenario", record_or_stop)
            with pytest.raises(KeyboardInterrupt):
                make(out, config)

    return stop


def make(out: Path, config: SynthConfig = LABELS) -> Path:
    return make_release(out, config, workers=1)


@pytest.mark.slow
def test_an_executor_makes_the_same_bytes(out, whole, digests):
    with ThreadPoolExecutor(2) as executor:
        assert digests(make_release(out, LABELS, executor=executor)) == whole
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.slow
def test_several_calls_share_the_parts(out, whole, digests, recorded):
    def make_or_come_late(_: int) -> Path | None:
        try:
            return make(out)
        except ConfigError as error:
            assert "exists and is not an empty folder" in str(error)  # noqa: PT017 - it began when all was done
            return None

    with ThreadPoolExecutor(3) as threads:
        assert out in list(threads.map(make_or_come_late, range(3)))
    assert len(recorded) == len(set(recorded)) == 3
    assert (digests(out), [path.name for path in out.parent.iterdir()]) == (whole, ["out"])


@pytest.mark.slow
def test_what_broke_off_goes_on(out, unfinished, whole, digests, recorded, stop_at):
    """Of a part that was cut off some files are there, some half-written, and no note."""
    stop_at(out, 2)
    assert not out.exists()
    del recorded[:]
    cut, kept = sorted(path.name for path in (unfinished.folder / "kept").iterdir())
    (unfinished.folder / "kept" / cut).unlink()
    shutil.rmtree(next(unfinished.part(cut).rglob("calib")))
    for name in (cut, kept):
        temporary_path(next(unfinished.part(name).rglob("*_001.txt"))).touch()
    assert digests(make(out)) == whole
    assert (len(recorded), cut in recorded, kept in recorded) == (2, True, False)


def test_a_call_that_makes_nothing_leaves_nothing(out, stop_at):
    stop_at(out, 0)
    assert list(out.parent.iterdir()) == []


def test_a_worker_whose_caller_was_stopped_marks_nothing_in_what_comes_later(unfinished):
    told = ("was removed while parts of the release were recorded; make it again",)
    assert_refused((lambda: unfinished.note("a part"), ConfigError, told))
    assert not unfinished.folder.exists()
