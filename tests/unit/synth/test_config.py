from pathlib import Path

import pytest

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.synth import SynthConfig


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("scenarios", 0, "scenarios: 0 is not possible; choose a number of at least 1"),
        ("frames", 0, "frames: 0 is not possible; choose a number from 1 to 999"),
        ("frames", 1000, "frames: 1000"),
        ("seed", -1, "seed: -1"),
        ("image_size", (15, 9), "width: 15"),
        ("image_size", (16, 8), "height: 8"),
        ("image_size", (16,), r"expected \(width, height\)"),
        ("layout", "C", "layout: expected one of A, B, found 'C'"),
        ("sensors", "lidar", "sensors: expected one of all, cameras, none, found 'lidar'"),
        ("view", "close", "view: expected one of open, hidden, or None, found 'close'"),
        ("designs", (1, 13), "designs: 13 is not possible; choose a number from 1 to 12"),
        ("unplanned", 1.5, "unplanned: 1.5 is not a share; choose a number from 0 to 1"),
    ],
)
def test_what_cannot_be_made_is_refused(field, value, sentence):
    with pytest.raises(ConfigError, match=sentence):
        SynthConfig(**{field: value})


def test_smallest_and_largest_are_accepted():
    SynthConfig(scenarios=1, frames=1, image_size=(16, 9))
    SynthConfig(frames=999)
    SynthConfig(frames=None)


def test_sensors_may_be_said_by_yes_and_no():
    assert SynthConfig(sensors=True) == SynthConfig() == SynthConfig(sensors="all")
    assert SynthConfig(sensors=False) == SynthConfig(sensors="None") != SynthConfig(sensors="cameras")
    assert SynthConfig(sensors=False).sensors == "none"


def test_a_scenario_file_and_designs_exclude_each_other():
    with pytest.raises(ConfigError, match="spec, designs: a release is made of a scenario file or of designs; choose"):
        SynthConfig(spec=Path("own.yaml"), designs=(1,))


def test_a_release_for_the_released_code_has_its_images_and_its_layout():
    config = SynthConfig(for_released_code=True)
    assert (config.pixels, config.layout) == ((1600, 900), "A")
    assert SynthConfig(for_released_code=True, image_size=(1600, 900)).pixels == (1600, 900)
    assert SynthConfig().pixels == (480, 270)
    assert SynthConfig(image_size=(64, 36)).pixels == (64, 36)


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("image_size", (480, 270), r"needs \(1600, 900\), found \(480, 270\)"),
        ("layout", "B", "needs A, found B"),
        ("unlabelled_test", True, "needs False, found True"),
    ],
)
def test_what_the_released_code_cannot_read_is_refused(field, value, sentence):
    with pytest.raises(ConfigError, match=f"^{field}, for_released_code: the released code {sentence} .*leave one of"):
        SynthConfig(**{field: value}, for_released_code=True)
