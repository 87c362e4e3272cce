"""What is said beside the warnings: near nothing is of the first number in which the truth beats nothing."""

import pytest

from deepaccident_devkit.evaluation.metrics.headlines import Headline
from deepaccident_devkit.evaluation.runs.sanity.report import NOTHING_WRONG, verdict_of


def headline(name: str, value: float | None, *, higher: bool | None = True) -> Headline:
    return Headline(name=name, value=value, unit="%", higher_is_better=higher, path=name)


def verdict(*given: Headline, explained: bool = False, warned: bool = False) -> str:
    empty = {"error": None, "near": 0.0, "far": 10.0}
    perfect = {"error": 0.0, "near": 0.0, "far": 90.0}
    return verdict_of(given, empty, perfect, explained=explained, warned=warned, checks=7)


@pytest.mark.parametrize(("value", "told"), [(None, True), (10.0, True), (13.9, True), (14.1, False), (90.0, False)])
def test_near_nothing_is_less_than_a_twentieth_of_the_way(value: float | None, told: bool) -> None:
    said = verdict(headline("error", 3.0, higher=False), headline("near", 0.0), headline("far", value))
    assert said.startswith("Near nothing: far is ") == told
    assert ("none of the 7 checks explains it." in said) == told
    assert (said == NOTHING_WRONG) == (not told)


def test_a_warning_that_explains_it_is_enough() -> None:
    assert verdict(headline("far", 10.0), explained=True, warned=True) == ""


def test_a_warning_that_does_not_explain_it_is_not() -> None:
    assert verdict(headline("far", 10.0), warned=True).startswith("Near nothing: far is 0 % of the way")
    assert verdict(headline("far", 60.0), warned=True) == ""
