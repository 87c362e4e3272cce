"""Which words a text has."""

from collections.abc import Container
from typing import Any


def missing_parts(whole: Container[Any], *parts: Any) -> list[Any]:
    """Return the parts that are not in a text, a list or a set."""
    return [part for part in parts if part not in whole]


def contained_parts(whole: Container[Any], *parts: Any) -> list[Any]:
    """Return the parts that are in a text, a list or a set."""
    return [part for part in parts if part in whole]
