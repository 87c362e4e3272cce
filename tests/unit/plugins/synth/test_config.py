from pathlib import Path

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.synth import SynthConfig

RELEASED = ("for_released_code: the released code needs ", "remove one of")


@pytest.mark.parametrize(
    ("fields", "names"),
    [
        ({"scenarios": 0}, ("scenarios: 0 is not possible", "at least 1")),
        ({"frames": 0}, ("frames: 0 is not possible", "from 1 to 999")),
        ({"frames": 1000}, ("frames: 1000",)),
        ({"seed": -1}, ("seed: -1",)),
        ({"sensor_step": 0}, ("sensor_step: 0 is not possible", "at least 1")),
        ({"decimals": 2}, ("decimals: 2 is not possible", "from 3 to 15")),
        ({"image_size": (15, 9)}, ("width: 15",)),
        ({"image_size": (16, 8)}, ("height: 8",)),
        ({"image_size": (16,)}, ("expected (width, height)",)),
        ({"layout": "C"}, ("layout: expected one of A, B, found 'C'",)),
        (
            {"sensors": "lidar"},
            ("sensors: expected one of all, accidents, cameras, clouds, none, found 'lidar'",),
        ),
        ({"view": "close"}, ("view: expected one of open, hidden, or None, found 'close'",)),
        ({"designs": (1, 13)}, ("designs: 13 is not possible", "from 1 to 12")),
        ({"unplanned": 1.5}, ("unplanned: 1.5 is not a share", "from 0 to 1")),
        ({"spec": Path("own.yaml"), "designs": (1,)}, ("spec, designs: ", "choose")),
        (
            {"for_released_code": True, "image_size": (480, 270)},
            ("image_size, ", "(1600, 900), found (480,", *RELEASED),
        ),
        ({"for_released_code": True, "layout": "B"}, ("layout, ", "A, found B", *RELEASED)),
        (
            {"for_released_code": True, "unlabelled_test": True},
            ("unlabelled_test, ", "False, found True", *RELEASED),
        ),
    ],
)
def test_what_cannot_be_made_is_refused(fields, names):
    assert_raises(
        (lambda: SynthConfig(**fields), ConfigError, names),
    )


@pytest.mark.parametrize(
    "fields",
    [{"scenarios": 1, "frames": 1, "image_size": (16, 9)}, {"frames": 999}, {"frames": None}],
)
def test_smallest_and_largest_are_accepted(fields):
    assert SynthConfig(**fields).frames == fields["frames"]


def test_sensors_may_be_said_by_yes_and_no():
    names = {
        value: SynthConfig(sensors=value).sensors
        for value in (True, "all", False, "None", "cameras")
    }
    assert names == {
        True: "all",
        "all": "all",
        False: "none",
        "None": "none",
        "cameras": "cameras",
    }
    assert SynthConfig(sensors=True) == SynthConfig()


@pytest.mark.parametrize(
    ("fields", "pixels"),
    [
        ({"for_released_code": True}, (1600, 900)),
        ({"for_released_code": True, "image_size": (1600, 900)}, (1600, 900)),
        ({}, (480, 270)),
        ({"image_size": (64, 36)}, (64, 36)),
    ],
)
def test_a_release_for_the_released_code_has_its_images_and_its_layout(fields, pixels):
    config = SynthConfig(**fields)
    assert (config.pixels, config.layout) == (pixels, "A")
