"""Which words a text has."""

from collections.abc import Container
from typing import Any


def lacking(whole: Container[Any], *parts: Any) -> list[Any]:
    """Those of some parts that are not in a text, a list or a set: none, where all are."""
    return [part for part in parts if part not in whole]


def holding(whole: Container[Any], *parts: Any) -> list[Any]:
    """Those of some parts that are in a text, a list or a set."""
    return [part for part in parts if part in whole]
