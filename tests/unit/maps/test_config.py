"""The settings of a map."""

import pytest

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.maps import TownMapConfig


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("resolution", 0.05, "resolution: expected a number of at least 0.1, found 0.05"),
        ("resolution", float("nan"), "resolution: expected a number of at least 0.1, found nan"),
        ("travel", 0.0, "travel: expected a number above 0, found 0"),
        ("period", -1.0, "period: expected a number above 0, found -1"),
        ("period", float("inf"), "period: expected a number above 0, found inf"),
        ("travel", "far", "travel: expected a number, found 'far'"),
    ],
)
def test_what_is_no_setting(name: str, value: object, words: str) -> None:
    with pytest.raises(ConfigError, match=f"^{words}$"):
        TownMapConfig(**{name: value})  # type: ignore[arg-type]


def test_whole_numbers_are_taken_for_the_same_setting() -> None:
    assert repr(TownMapConfig(travel=20)) == repr(TownMapConfig(travel=20.0))
