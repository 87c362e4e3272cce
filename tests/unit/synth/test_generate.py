import numpy as np
import pytest

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.release import find_release, read_label, read_meta, read_split_file
from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.synth.scenario import build_scenario, plan_scenarios
from deepaccident_devkit.taxonomy import AGENTS, CHANNELS, MINI_SPLITS, SPLITS

TINY = {"scenarios": 2, "frames": 2, "image_size": (32, 18)}


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
    assert accident.collision.ids == (accident.agent_ids[0], accident.agent_ids[2])
    assert accident.collision.agents == ("ego_vehicle", "other_vehicle")
    assert accident.agent_ids == normal.agent_ids
    assert (accident.weather, accident.spawn_side) == (normal.weather, normal.spawn_side)
    assert accident.simulated_frames == 13
    assert accident.road_type == "four-way junction"


def test_splits_go_by_pairs():
    plans = plan_scenarios(SynthConfig(scenarios=400))
    assert [plan.split for plan in plans[:6]] == ["train", "train", "val", "val", "test", "test"]
    assert all(a.split == b.split and a.name == b.name for a, b in zip(plans[::2], plans[1::2], strict=True))
    share = {split: sum(plan.split == split for plan in plans) / len(plans) for split in SPLITS}
    assert share == pytest.approx({"train": 0.7, "val": 0.15, "test": 0.15}, abs=0.02)
    assert len({plan.token for plan in plans}) == 400
    assert {plan.subtype for plan in plans[::4]} == {1}
    assert {plan.subtype for plan in plans[2::4]} == {2}


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


def test_same_seed_same_bytes_with_any_number_of_workers(tmp_path, digests):
    config = SynthConfig(**TINY, seed=7)
    one = digests(make_release(tmp_path / "one", config, workers=1))
    two = digests(make_release(tmp_path / "two", config, workers=2))
    assert one == two


def test_another_seed_another_release(tmp_path, digests):
    releases = [
        digests(make_release(tmp_path / str(seed), SynthConfig(scenarios=1, frames=1, sensors=False, seed=seed)))
        for seed in (1, 2)
    ]
    assert not {content for name, content in releases[0].items() if "label" in name} & set(releases[1].values())


def test_without_sensors_the_other_files_are_the_same(tmp_path, release_root, config, digests):
    bare = SynthConfig(
        scenarios=config.scenarios, frames=config.frames, image_size=config.image_size, seed=config.seed, sensors=False
    )
    without = digests(make_release(tmp_path / "bare", bare, workers=1))
    full = digests(release_root)
    assert without == {name: content for name, content in full.items() if name.endswith((".txt", ".pkl"))}


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
