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
    ],
)
def test_what_cannot_be_made_is_refused(field, value, sentence):
    with pytest.raises(ConfigError, match=sentence):
        SynthConfig(**{field: value})


def test_smallest_and_largest_are_accepted():
    SynthConfig(scenarios=1, frames=1, image_size=(16, 9))
    SynthConfig(frames=999)
