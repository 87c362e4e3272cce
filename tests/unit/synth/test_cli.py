import pytest
from click.testing import CliRunner

from deepaccident_devkit.cli.synth import synth
from deepaccident_devkit.release import find_release


def test_verb_writes_a_release_and_names_the_next_step(tmp_path):
    out = tmp_path / "a b"
    result = CliRunner().invoke(
        synth, [str(out), "--scenarios", "1", "--frames", "1", "--layout", "B", "--seed", "3", "--no-sensors"]
    )
    assert result.exit_code == 0, result.output
    assert f"deepaccident info {out}" in result.output
    assert find_release(out).layout == "B"


@pytest.mark.parametrize("size", ["480", "480x", "axb", "480x270x3"])
def test_bad_image_size_is_a_usage_error(tmp_path, size):
    result = CliRunner().invoke(synth, [str(tmp_path / "out"), "--image-size", size])
    assert result.exit_code == 2
    assert "expected width x height such as 480x270" in result.output


def test_help_names_every_option():
    text = CliRunner().invoke(synth, ["--help"]).output
    for option in ("--scenarios", "--frames", "--image-size", "--layout", "--seed", "--no-sensors", "--workers"):
        assert option in text
