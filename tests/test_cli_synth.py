"""`deepaccident synth`: from the words of the command line to a release."""

import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from support.text_contents import missing_parts

from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.benchmark import described_release
from deepaccident_devkit.plugins.synth.cli import synth
from deepaccident_devkit.plugins.synth.spec import design_text, parse_spec
from deepaccident_devkit.release import find_release


@pytest.fixture
def requested_configs(monkeypatch) -> list[SynthConfig]:
    """Configurations of the releases that the command asks for; no release is made."""
    configs: list[SynthConfig] = []

    def make_release(out: Path, config: SynthConfig, **_options: object) -> Path:
        configs.append(config)
        return out

    monkeypatch.setattr(sys.modules[synth.callback.__module__], "make_release", make_release)
    return configs


def test_verb_writes_a_release_and_names_the_next_step(tmp_path):
    out = tmp_path / "a b"
    words = "--scenarios 1 --frames 1 --layout B --seed 3 --sensors none"
    result = CliRunner().invoke(synth, [str(out), *words.split()])
    assert f"deepaccident info {out}" in result.output
    assert f"wrote {out} (1 scenario of 1 frame with five agents, layout B)" in result.output
    assert "slow" not in result.stderr
    assert find_release(out).layout == "B"


@pytest.mark.parametrize(
    ("words", "config"),
    [
        ("", {}),
        (
            "--scenarios 6 --frames 12 --size 64x36 --layout B",
            {"scenarios": 6, "frames": 12, "image_size": (64, 36), "layout": "B"},
        ),
        (
            "--seed 7 --unlabelled-test --view open --unplanned 0.5",
            {"seed": 7, "unlabelled_test": True, "view": "open", "unplanned": 0.5},
        ),
        ("--design 3 --design 9", {"designs": (3, 9)}),
        ("--design ./3", {"spec": Path("3")}),
        ("--sensors Cameras", {"sensors": "cameras"}),
        ("--sensors none", {"sensors": False}),
        ("--for-released-code", {"for_released_code": True}),
        (
            "--for-released-code --size 1600x900 --layout A",
            {"for_released_code": True, "image_size": (1600, 900)},
        ),
    ],
)
def test_every_option_reaches_the_configuration(
    tmp_path, requested_configs, monkeypatch, words, config
):
    monkeypatch.chdir(tmp_path)
    Path("3").write_text(design_text(1), encoding="utf-8")
    result = CliRunner().invoke(synth, ["out", *words.split()])
    assert result.exit_code == 0, result.output
    assert requested_configs == [SynthConfig(**{"frames": None, **config})]


@pytest.mark.slow
def test_a_benchmark_is_made_and_compared(tmp_path, monkeypatch):
    """An existing release is only compared, and its differences are listed."""
    config = SynthConfig(scenarios=1, frames=2, image_size=(32, 18), seed=6)
    small_release = make_release(tmp_path / "small", config, workers=1)
    description = described_release(small_release, workers=1)
    module = sys.modules[synth.callback.__module__]
    monkeypatch.setattr(module, "BENCHMARKS", {"v1": config})
    monkeypatch.setattr(module, "published", lambda name: {"v1": description}[name])
    out = tmp_path / "out"

    def run(*words: str):
        command = [str(out), "--benchmark", "v1", "--workers", "1", *words]
        return CliRunner().invoke(synth, command)

    message = "--seed has no effect with --benchmark, which defines all settings"
    assert message in run("--seed", "6").stderr

    result = run("--sensors", "clouds")
    assert result.exit_code == 0
    assert result.stdout.splitlines()[0] == (
        f"{out}: same as the published benchmark v1 (1 scenario: labels, num_lidar_pts, clouds)"
    )

    [label] = out.glob("*/infrastructure/label/*/*_002.txt")
    label.write_text(label.read_text().replace("car ", "van ", 1))
    result = run()
    assert result.exit_code == 1
    expected = (
        "out: differs from the published benchmark v1 (1 difference):\n",
        "scenario00001: boxes differ\n",
        "v1/lock.txt",
    )
    assert missing_parts(result.stderr, *expected) == []


def test_labels_without_embree_are_announced_as_slow(tmp_path, requested_configs, monkeypatch):
    monkeypatch.setattr(sys.modules[synth.callback.__module__], "has_embree", lambda: False)
    result = CliRunner().invoke(synth, [str(tmp_path), "--sensors", "none"])
    message = "warning: slow without the package embreex; run pip install '.[synth]' in a checkout"
    assert message in result.stderr
    assert requested_configs == [SynthConfig(frames=None, sensors=False)]


SCENARIO_TEXT = """\
road: {signalized: false}
actors:
  - {role: ego, from: west, max_speed: 9}
  - {role: other, category: van, from: south, max_speed: 9}
meet: {offset: 0}
background: {vehicles: 0, two_wheelers: 0, parked: 2, walking: 1, crossing: 0}
"""


@pytest.fixture
def scenario_file(tmp_path, monkeypatch) -> Path:
    """A scenario file in the working folder."""
    monkeypatch.chdir(tmp_path)
    path = Path("mine.yaml")
    path.write_text(SCENARIO_TEXT, encoding="utf-8")
    return path


def test_a_file_that_is_no_scenario_is_refused(scenario_file):
    scenario_file.write_text(SCENARIO_TEXT.replace("van", "cyclist"), encoding="utf-8")
    result = CliRunner().invoke(synth, ["out", "--design", "mine.yaml"])
    message = "mine.yaml:4: actors[1].category: the role other cannot be a cyclist"
    assert message in str(result.exception)
    assert not Path("out").exists()


def test_a_design_is_printed_as_a_file_to_begin_with():
    output = CliRunner().invoke(synth, ["--show-design", "9"]).output
    assert output == design_text(9)
    assert parse_spec(output).design == 9
