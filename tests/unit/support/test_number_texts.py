"""Numbers and intervals as people read them: few digits, real minus signs, no sign on zero."""

import math

import pytest

from deepaccident_devkit.support.text import interval_text, number_text


@pytest.mark.parametrize(
    ("value", "text", "signed_text"),
    [
        (0.25, "0.25", "+0.25"),
        (-0.25, "−0.25", "−0.25"),
        (0.0, "0.00", "0.00"),
        (-0.001, "0.00", "0.00"),
        (0.004, "0.00", "0.00"),
        (None, "–", "–"),
        (math.nan, "–", "–"),
        (math.inf, "never", "never"),
    ],
)
def test_a_number_has_a_sign_if_its_digits_have_one(
    value: float | None, text: str, signed_text: str
) -> None:
    assert number_text(value, 2) == text
    assert number_text(value, 2, "+") == signed_text


def test_an_interval_is_unknown_if_one_of_its_ends_is() -> None:
    assert interval_text(-0.5, 0.25) == "[−0.500, 0.250]"
    assert interval_text(-0.5, 0.25, 1, "+") == "[−0.5, +0.2]"
    for low, high in ((None, 0.5), (0.5, None), (math.nan, 0.5), (0.5, math.nan)):
        assert interval_text(low, high) == "–"
