import itertools
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.expected_errors import assert_raises

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
def test_every_file_is_present_and_nothing_else(release_root, scenarios, config, digests):
    completeness = release_completeness(release_root, workers=1)
    assert (completeness.scenarios, completeness.whole) == (2, 2)

    files_per_agent = 2 + len(CHANNELS)
    files_per_scenario = 1 + config.frames * len(AGENTS) * files_per_agent
    split_files = {f"{name}.txt" for name in (*SPLITS, *MINI_SPLITS)}
    assert len(digests(release_root)) == len(split_files) + 2 * files_per_scenario
    assert {path.name for path in release_root.glob("*.txt")} == split_files
    assert [path.name for path in release_root.parent.iterdir()] == [release_root.name]


@pytest.mark.slow
def test_accident_and_twin_share_name_and_scene(scenarios):
    name = scenarios[0].name
    assert [(scenario.scenario_type, scenario.name) for scenario in scenarios] == [
        ("type1_subtype1_accident", name),
        ("type1_subtype1_normal", name),
    ]

    accident, normal = (read_meta(scenario.meta_path) for scenario in scenarios)
    agents = {"ego_vehicle", "other_vehicle"}
    assert normal.collision is None
    assert set(normal.planned_agents) == set(accident.collision.agents) == agents
    assert set(accident.collision.ids) == {accident.agent_ids[0], accident.agent_ids[2]}
    for field in ("agent_ids", "weather", "spawn_side", "road_type"):
        assert getattr(accident, field) == getattr(normal, field)


@pytest.mark.slow
def test_layout_b_has_a_folder_for_each_split(tmp_path):
    config = SynthConfig(scenarios=5, frames=1, layout="B", sensors=False)
    release = find_release(make_release(tmp_path / "b", config, workers=1))
    scenarios = sorted(release.scenarios, key=lambda scenario: scenario.name[-5:])
    folders = [scenario.folder for scenario in scenarios]
    assert (release.layout, folders) == ("B", ["train", "train", "val", "val", "test"])

    for split, path in release.split_files.items():
        folder = split.removesuffix("_mini")
        assert set(read_split_file(path)) == {
            scenario.token for scenario in release.scenarios if scenario.folder == folder
        }
    assert len(read_label(release.scenarios[-1].label_path("infrastructure", 1))) > 5


@pytest.mark.slow
def test_a_release_for_the_released_code_has_its_split_files_twice(tmp_path):
    """Calib files describe images of 1600x900 pixels even if there are no images."""
    config = SynthConfig(
        scenarios=4, frames=1, sensors=False, for_released_code=True, designed=True
    )
    root = make_release(tmp_path / "released", config, workers=1)
    release = find_release(root)
    assert release.layout == "A"
    for split in (*SPLITS, *MINI_SPLITS):
        path = root / f"{split}.txt"
        content = path.read_bytes()
        assert (root / "split_txt_files" / f"{split}.txt").read_bytes() == content
        assert release.split_files[split] == path
        assert bool(content) == (split != "test")

    intrinsic = read_calib(release.scenarios[0].calib_path("ego_vehicle", 1)).intrinsic
    centers = [intrinsic[channel][:2, 2] for channel in CAMERAS]
    np.testing.assert_allclose(centers, [(800, 450)] * len(CAMERAS))
    assert validate_release(root, workers=1).is_good


@pytest.mark.slow
def test_same_seed_same_bytes_with_any_number_of_workers(tmp_path, digests):
    """Three processes share one scenario."""
    config = SynthConfig(scenarios=1, frames=4, image_size=(32, 18), seed=7)
    one = make_release(tmp_path / "1", config, workers=1)
    three = make_release(tmp_path / "3", config, workers=3)
    assert digests(one) == digests(three)


@pytest.mark.slow
def test_another_configuration_does_not_go_on_with_it(tmp_path, stop_at):
    out = tmp_path / "out"
    config = SynthConfig(scenarios=2, frames=2, sensors=False)
    stop_at(out, 1, config)
    assert_raises(
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
def test_an_unlabelled_test_split_has_only_calib_images_and_points(tmp_path):
    """The real one is like that; the other splits lack nothing."""
    config = SynthConfig(
        scenarios=5, frames=1, image_size=(32, 18), layout="B", unlabelled_test=True
    )
    root = make_release(tmp_path / "out", config, workers=1)

    for split, kinds, meta_files in (
        ("train", {"calib", "label", *CHANNELS}, 2),
        ("test", {"calib", *CHANNELS} - {BEV_CAMERA}, 0),
    ):
        folder = root / split
        assert {path.parts[-3] for path in folder.rglob("*_001.*")} == kinds
        assert len([*folder.rglob("meta/*.txt")]) == meta_files

    assert len(DeepAccident("v1", root, verbose=False).split_scenarios("test")) == 1


@pytest.mark.slow
def test_rounded_numbers_are_the_same_ones_with_fewer_digits(tmp_path):
    def record_scenario(decimals):
        config = SynthConfig(scenarios=1, frames=2, sensors=False, seed=7, decimals=decimals)
        root = make_release(tmp_path / str(decimals), config, workers=1)
        return find_release(root).scenarios[0]

    full = record_scenario(None)
    rounded = record_scenario(4)
    for agent, frame in itertools.product(AGENTS, (1, 2)):
        full_label = read_label(full.label_path(agent, frame))
        label = read_label(rounded.label_path(agent, frame))
        for name in ("agent_velocity", "center", "size", "yaw", "velocity"):
            expected = getattr(full_label, name).round(4)
            np.testing.assert_array_equal(expected, getattr(label, name))

        full_calib = read_calib(full.calib_path(agent, frame), raw=True)
        calib = read_calib(rounded.calib_path(agent, frame), raw=True)
        for name, matrix in full_calib.items():
            assert np.array_equal(matrix.round(4), calib[name])
    assert not validate_release(rounded.root, workers=1).findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fields", "files"),
    [
        ({"sensors": "none"}, r"\.(txt|pkl)$"),
        ({"sensors": "cameras"}, r"\.(txt|pkl|jpg)$"),
        ({"sensors": "clouds"}, r"\.(txt|pkl)$|/lidar01/"),
        ({"sensors": "accidents"}, r"_accident/|\.(txt|pkl)$"),
        # sensor steps are counted back from the last of three frames
        ({"sensor_step": 2}, r"\.(txt|pkl)$|_00[13]\.\w+$"),
        ({"sensor_step": 9, "sensors": "cameras"}, r"\.(txt|pkl)$|_003\.jpg$"),
    ],
    ids=str,
)
def test_with_fewer_sensors_the_other_files_are_the_same(
    tmp_path, release_root, config, digests, fields, files
):
    fewer = make_release(tmp_path / "fewer", replace(config, **fields), workers=1)
    expected = {
        name: content for name, content in digests(release_root).items() if re.search(files, name)
    }

    assert digests(fewer) == expected


@pytest.mark.slow
def test_frames_without_sensors_are_missing_files_and_no_errors(tmp_path):
    config = SynthConfig(
        scenarios=2, frames=3, seed=3, image_size=(32, 18), sensors="cameras", sensor_step=2
    )
    root = make_release(tmp_path / "out", config, workers=1)
    findings = validate_release(root, deep=True, workers=1).findings
    assert {(finding.code, finding.severity) for finding in findings} == {
        ("sensor-frames-missing", "warning")
    }

    missing_channels = set()
    for split in release_completeness(root).splits.values():
        for count in split.files:
            if count.missing and count.missing == count.expected:
                missing_channels.add(count.channel)
    assert missing_channels == {LIDAR, BEV_CAMERA}


# Executors, several processes and interrupted calls all make the same bytes as one call.

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
    """The names of the parts that are recorded in this process, in order."""
    names: list[str] = []
    record = generate.record_scenario

    def record_and_note(job):
        names.append(job.root.name)
        record(job)

    monkeypatch.setattr(generate, "record_scenario", record_and_note)
    return names


@pytest.fixture
def stop_at(monkeypatch):
    """A function that starts a release and stops it, as Ctrl-C does, after a number of parts."""
    record = generate.record_scenario

    def stop(out: Path, count: int, config: SynthConfig = LABELS) -> None:
        remaining = iter(range(count))

        def record_or_stop(job):
            if next(remaining, None) is None:
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
    def make_or_arrive_late(_: int) -> Path | None:
        try:
            return make(out)
        except ConfigError as error:
            assert "exists and is not an empty folder" in str(error)  # noqa: PT017 - it began when all was done
            return None

    with ThreadPoolExecutor(3) as threads:
        assert out in list(threads.map(make_or_arrive_late, range(3)))
    assert len(recorded) == len(set(recorded)) == 3
    assert digests(out) == whole
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.slow
def test_an_interrupted_release_is_continued(out, unfinished, whole, digests, recorded, stop_at):
    """An interrupted part has some of its files, some of them half-written, and no note."""
    stop_at(out, 2)
    assert not out.exists()
    recorded.clear()

    notes = unfinished.folder / "kept"
    cut, finished = sorted(path.name for path in notes.iterdir())
    (notes / cut).unlink()
    shutil.rmtree(next(unfinished.part(cut).rglob("calib")))
    for name in (cut, finished):
        temporary_path(next(unfinished.part(name).rglob("*_001.txt"))).touch()

    assert digests(make(out)) == whole
    assert len(recorded) == 2
    assert cut in recorded
    assert finished not in recorded


def test_a_call_that_makes_nothing_leaves_nothing(out, stop_at):
    stop_at(out, 0)
    assert list(out.parent.iterdir()) == []


def test_a_worker_of_a_stopped_call_leaves_no_note(unfinished):
    message = "was removed while the release was being made; run the command again"
    assert_raises(
        (lambda: unfinished.note("a part"), ConfigError, (message,)),
    )
    assert not unfinished.folder.exists()
