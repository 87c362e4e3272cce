"""Which windows a recording has."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.frames import keyframes
from deepaccident_devkit.export.questions import WindowRules
from deepaccident_devkit.export.questions.observed import digest


def presents(rules: WindowRules, last: int) -> list[int]:
    return [each.present for each in rules.windows(last)]


def test_presents_are_counted_back_from_the_last_frame_which_is_none() -> None:
    assert presents(WindowRules(observe=2.0), 57) == [27, 37, 47]
    assert presents(WindowRules(observe=2.0, stride=0.5), 40) == [25, 30, 35]
    assert presents(WindowRules(observe=2.0, stride=0.5), 41) == [21, 26, 31, 36]
    assert presents(WindowRules(observe=5.0), 51) == []


def test_the_moments_of_a_window() -> None:
    (window,) = WindowRules(observe=1.5).windows(26)
    assert (window.frames, window.times) == ((1, 6, 11, 16), [-1.5, -1.0, -0.5, 0.0])
    assert WindowRules(observe=0).windows(11)[0].frames == (1,)


@given(st.integers(0, 130), st.integers(0, 12), st.integers(1, 6))
def test_windows_lie_in_the_recording_before_its_end(last: int, observe: int, stride: int) -> None:
    windows = WindowRules(observe=observe, stride=stride / 2).windows(last)
    for window in windows:
        assert window.frames[0] >= 1
        assert window.present < last
        assert window.present in keyframes(last)  # where evaluations have their samples
        assert len(window.frames) == observe * 2 + 1
        assert set(map(int.__sub__, window.frames[1:], window.frames)) <= {5}
    assert len({window.present for window in windows}) == len(windows)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"observe": 0.3}, "observe: expected seconds from 0 in steps of 0.5, found 0.3"),
        ({"observe": -1}, "observe: expected seconds from 0"),
        ({"observe": float("nan")}, "observe: expected"),
        ({"stride": 0}, "stride: expected seconds from 0.5 in steps of 0.5, found 0"),
        ({"stride": 0.7}, "stride: expected seconds from 0.5"),
        ({"ahead": 0}, "ahead: expected a whole number from 1, found 0"),
    ],
)
def test_impossible_rules(options: dict[str, float], sentence: str) -> None:
    with pytest.raises(ConfigError, match=f"^{sentence}"):
        WindowRules(**options)  # type: ignore[arg-type]


def test_a_digest_depends_on_the_seed_and_on_each_word() -> None:
    found = [digest("0", "a", "bc"), digest("1", "a", "bc"), digest("0", "ab", "c"), digest("0", "a", "bd")]
    assert len(set(found)) == 4
    assert digest("0", "a", "bc") == found[0]
    assert all(len(each) == 16 and set(each) <= set("0123456789abcdef") for each in found)
