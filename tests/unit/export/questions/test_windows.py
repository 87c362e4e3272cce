"""Which windows a recording has."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.keyframes import keyframes
from deepaccident_devkit.export.questions import WindowRules
from deepaccident_devkit.export.questions.observed import digest


def presents(rules: WindowRules, last: int) -> list[int]:
    return [each.present for each in rules.windows(last, "recording", "seed")]


@pytest.mark.parametrize(
    ("rules", "last", "expected"),
    [
        (WindowRules(observe=2.0), 57, [27, 37, 47]),
        (WindowRules(observe=2.0, stride=0.5), 40, [25, 30, 35]),
        (WindowRules(observe=2.0, stride=0.5), 41, [21, 26, 31, 36]),
        (WindowRules(observe=2.0, stride=0.5, partial_past=True), 12, [2, 7]),
        (WindowRules(observe=5.0), 51, []),
    ],
)
def test_presents_are_counted_back_from_the_last_frame_which_is_none(
    rules: WindowRules, last: int, expected: list[int]
) -> None:
    assert [each.present for each in rules.windows(last, "recording", "seed")] == expected


def test_the_moments_of_a_window() -> None:
    (window,) = WindowRules(observe=1.5, rate=2).windows(26, "recording", "seed")
    assert (window.frames, window.times) == ((1, 6, 11, 16), [-1.5, -1.0, -0.5, 0.0])
    cut = WindowRules(observe=1.5, rate=2, partial_past=True).windows(26, "recording", "seed")[0]
    assert (cut.frames, cut.times) == ((1, 6), [-0.5, 0.0])
    assert WindowRules(observe=0).windows(11, "recording", "seed")[0].frames == (1,)


@given(st.integers(0, 130), st.integers(0, 12), st.sampled_from([1, 2, 5, 10]), st.integers(1, 6), st.booleans())
def test_windows_lie_in_the_recording_before_its_end(
    last: int,
    observe: int,
    rate: int,
    stride: int,
    partial: bool,
) -> None:
    rules = WindowRules(observe=observe, rate=rate, stride=stride / 2, partial_past=partial)
    windows = rules.windows(last, "recording", "seed")
    for window in windows:
        assert window.frames[0] >= 1
        assert window.present < last
        assert window.present in keyframes(last)  # where evaluations have their samples
        assert set(map(int.__sub__, window.frames[1:], window.frames)) <= {10 // rate}
        assert partial or len(window.frames) == observe * rate + 1
    assert len({window.present for window in windows}) == len(windows)


def test_some_windows_are_drawn_by_the_seed_alone() -> None:
    rules = WindowRules(observe=1.0, stride=0.5, most=3)
    everything = presents(WindowRules(observe=1.0, stride=0.5), 100)
    drawn = [tuple(each.present for each in rules.windows(100, "recording", seed)) for seed in "abcdefgh"]
    assert all(len(each) == 3 and sorted(each) == list(each) and set(each) <= set(everything) for each in drawn)
    assert len(set(drawn)) > 1
    assert drawn == [tuple(each.present for each in rules.windows(100, "recording", seed)) for seed in "abcdefgh"]
    assert rules.windows(100, "recording", "a") != rules.windows(100, "another", "a")
    assert presents(rules, 26) == [11, 16, 21]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"rate": 3}, "rate: expected 1, 2, 5 or 10 moments a second, found 3"),
        ({"rate": 0}, "rate: expected 1, 2, 5 or 10"),
        ({"observe": 0.3}, "observe: expected seconds from 0 in steps of 0.5, found 0.3"),
        ({"observe": -1}, "observe: expected seconds from 0"),
        ({"observe": float("nan")}, "observe: expected"),
        ({"stride": 0}, "stride: expected seconds from 0.5 in steps of 0.5, found 0"),
        ({"stride": 0.7}, "stride: expected seconds from 0.5"),
        ({"ahead": 0}, "ahead: expected a whole number from 1, found 0"),
        ({"most": 0}, "most: expected a whole number from 1, found 0"),
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
