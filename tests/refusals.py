"""Calls that are refused, each by its error with its sentence."""

from collections.abc import Callable

import pytest


def assert_refused(
    *cases: tuple[Callable[[], object], type[Exception], str | tuple[str, ...]],
) -> None:
    """Each call raises its kind of error, in whose message the pattern is found, or each of some
    plain words.
    """
    for make, error, sentence in cases:
        with pytest.raises(error, match=sentence if isinstance(sentence, str) else None) as raised:
            make()
        missing = (
            []
            if isinstance(sentence, str)
            else [word for word in sentence if word not in str(raised.value)]
        )
        assert not missing, f"{raised.value} does not name {missing}"
