"""Test kit: releases of less than 1 MB in both layouts, healthy or broken in a named way.

They are for tests of loaders. A pytest plugin (`plugin`, which pytest loads wherever the devkit is
installed) provides fixtures, and `strategies` draws contents with hypothesis; the functions here
need neither. See docs/testing.md.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deepaccident_devkit.testing.breakages import (
        BREAKAGES,
        Breakage,
        BrokenRelease,
        break_release,
        broken_release,
    )
    from deepaccident_devkit.testing.releases import SmallRelease, write_small_release

# Public name → the module that defines it.
_MODULES = {
    **dict.fromkeys(
        ("BREAKAGES", "Breakage", "BrokenRelease", "break_release", "broken_release"), "breakages"
    ),
    **dict.fromkeys(("SmallRelease", "write_small_release"), "releases"),
}

__all__ = [
    "BREAKAGES",
    "Breakage",
    "BrokenRelease",
    "SmallRelease",
    "break_release",
    "broken_release",
    "write_small_release",
]


def __getattr__(name: str) -> Any:
    """Import a public name's module on first use, because pytest always imports this package."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
