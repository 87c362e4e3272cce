"""Deprecated calls name both versions and the caller's line, and are removed in time."""

import ast
from pathlib import Path

import pytest

import deepaccident_devkit
from deepaccident_devkit.deprecations import warn_deprecated

PACKAGE = Path(deepaccident_devkit.__file__).parent


def old() -> None:
    warn_deprecated("old()", "new()", since="0.1", gone_in="0.2")


def test_the_warning_names_both_versions_and_the_callers_line() -> None:
    with pytest.warns(DeprecationWarning, match="old") as told:
        old()
    assert str(told[0].message) == "old() is deprecated since 0.1 and gone in 0.2; use new()"
    assert told[0].filename == __file__


def test_nothing_is_deprecated_for_longer_than_it_says() -> None:
    here = version(deepaccident_devkit.__version__)
    found = 0
    for path in PACKAGE.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and getattr(call.func, "id", None) == "warn_deprecated":
                named = {one.arg: ast.literal_eval(one.value) for one in call.keywords}
                assert version(named["since"]) <= here < version(named["gone_in"]), f"{path}: remove what is deprecated"
                found += 1
    assert found


def version(text: str) -> tuple[int, ...]:
    """The first two numbers."""
    return tuple(int(part) for part in text.split(".")[:2])
