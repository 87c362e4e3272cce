"""`deepaccident synth`: from the words of the command line to a release."""

import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.plugins.synth.benchmark import described_release
from deepaccident_devkit.plugins.synth.cli import synth
from deepaccident_devkit.plugins.synth.spec import design_text, parse_spec
from deepaccident_devkit.release import find_release


@pytest.fixture
def made(monkeypatch) -> list[SynthConfig]:
    """The configurations of the releases that were asked for; none is made."""
    configs: list[SynthConfig] = []

    def make_release(out: Path, config: SynthConfig, **_options: object) -> Path:
        configs.append(config)
        return out

    monkeypatch.setattr(sys.modules[synth.callback.__module__], "make_release", make_release)
    return configs


def test_verb_writes_a_release_and_names_the_next_step(tmp_path):
    out, words = tmp_path / "a b", "--scenarios 1 --frames 1 --layout B --seed 3 --sensors none"
    result = CliRunner().invoke(synth, [str(out), *words.split()])
    told = (f"deepaccident info {out}", f"{out}: 1 scenario of 1 frame with five agents, layout B")
    assert [each for each in told if each not in result.output] == []
    assert ("slow" in result.stderr, find_release(out).layout) == (False, "B")


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
def test_every_option_reaches_the_configuration(tmp_path, made, monkeypatch, words, config):
    monkeypatch.chdir(tmp_path)
    Path("3").write_text(design_text(1), encoding="utf-8")
    result = CliRunner().invoke(synth, ["out", *words.split()])
    assert result.exit_code == 0, result.output
    assert made == [SynthConfig(**{"frames": None, **config})]


@pytest.mark.slow
def test_a_benchmark_is_made_and_compared(tmp_path, monkeypatch):
    """One that is there is compared alone; which differences there are is told, and what else was
    asked for refused.
    """
    config = SynthConfig(scenarios=1, frames=2, image_size=(32, 18), seed=6)
    small = make_release(tmp_path / "small", config, workers=1)
    module = sys.modules[synth.callback.__module__]
    monkeypatch.setattr(module, "BENCHMARKS", {"v1": config})
    wanted = described_release(small, workers=1)
    monkeypatch.setattr(module, "published", lambda name: {"v1": wanted}[name])

    def run(*words: str):
        return CliRunner().invoke(
            synth, [str(tmp_path / "out"), "--benchmark", "v1", "--workers", "1", *words]
        )

    assert (
        "--seed changes nothing with --benchmark, which says all of it" in run("--seed", "6").stderr
    )
    first = run("--sensors", "clouds")
    assert (first.exit_code, first.stdout.splitlines()[0]) == (
        0,
        (
            f"{tmp_path / 'out'}: is the benchmark v1 as published, 1 scenario: "
            f"labels, num_lidar_pts, clouds"
        ),
    )
    [label] = (tmp_path / "out").glob("*/infrastructure/label/*/*_002.txt")
    label.write_text(label.read_text().replace("car ", "van ", 1))
    second = run()
    assert second.exit_code == 1
    told = (
        "out: is not the benchmark v1 as published, 1 difference:\n",
        "scenario00001: boxes differ\n",
        "v1/lock.txt",
    )
    assert [each for each in told if each not in second.stderr] == []


def test_labels_without_embree_are_said_to_take_long(tmp_path, made, monkeypatch):
    monkeypatch.setattr(sys.modules[synth.callback.__module__], "has_embree", lambda: False)
    result = CliRunner().invoke(synth, [str(tmp_path), "--sensors", "none"])
    assert (
        "slow without the package embreex; in a checkout: pip install '.[synth]'" in result.stderr
    )
    assert made == [SynthConfig(frames=None, sensors=False)]


MINE = """\
road: {signalized: false}
actors:
  - {role: ego, from: west, max_speed: 9}
  - {role: other, category: van, from: south, max_speed: 9}
meet: {offset: 0}
background: {vehicles: 0, two_wheelers: 0, parked: 2, walking: 1, crossing: 0}
"""


@pytest.fixture
def mine(tmp_path, monkeypatch) -> Path:
    """A scenario file in the working folder."""
    monkeypatch.chdir(tmp_path)
    path = Path("mine.yaml")
    path.write_text(MINE, encoding="utf-8")
    return path


def test_a_file_that_is_no_scenario_is_refused(mine):
    mine.write_text(MINE.replace("van", "cyclist"), encoding="utf-8")
    told = "mine.yaml:4: actors[1].category: the role other cannot be a cyclist"
    assert told in str(CliRunner().invoke(synth, ["out", "--design", "mine.yaml"]).exception)
    assert not Path("out").exists()


def test_a_design_is_shown_as_a_file_to_begin_with():
    shown = CliRunner().invoke(synth, ["--show-design", "9"]).output
    assert (shown, parse_spec(shown).design) == (design_text(9), 9)
