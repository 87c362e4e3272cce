"""Calls that are refused, each by its error with its sentence."""

from collections.abc import Callable

import pytest


def assert_refused(*cases: tuple[Callable[[], object], type[Exception], str]) -> None:
    """Each call raises its kind of error, in whose message the pattern is found."""
    for make, error, sentence in cases:
        with pytest.raises(error, match=sentence):
            make()
