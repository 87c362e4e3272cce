"""Check that calls fail with the expected error and message."""

from collections.abc import Callable

import pytest

from support.text_contents import missing_parts


def assert_raises(
    *cases: tuple[Callable[[], object], type[Exception], str | tuple[str, ...]],
) -> None:
    """Assert that each call raises its kind of error with its message.

    Args:
        *cases: Call, kind of error, and a pattern of the message or a tuple of plain parts of it.
    """
    for call, error, message in cases:
        pattern = message if isinstance(message, str) else None
        parts = () if isinstance(message, str) else message
        with pytest.raises(error, match=pattern) as raised:
            call()
        missing = missing_parts(str(raised.value), *parts)
        assert not missing, f"{raised.value} does not name {missing}"
