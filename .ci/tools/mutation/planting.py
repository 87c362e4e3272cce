"""How a mutant gets into a process that has imported the package already, and to whoever holds its
functions.

The mutant's module is executed once more, aside. Where a function's code or defaults differ from
those there are, the function that is there gets the new ones; a constant of plain values replaces
the old one in all modules that have it by that name, and in records such as protocols field by
field. What was computed from it on import elsewhere stays.
"""

import ast
import dataclasses
import sys
from collections.abc import Mapping
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

_PLAIN = (bool, int, float, str, bytes, type(None))


def plant(module: ModuleType, tree: ast.Module) -> bool:
    """Make a module as the tree says; whether anything differs that can be changed."""
    made = {
        "__name__": module.__name__,
        "__file__": module.__file__,
        "__package__": module.__package__,
    }
    exec(compile(tree, str(module.__file__), "exec"), made)  # noqa: S102 - our own source
    planted = False
    for name, new in made.items():
        old = vars(module).get(name)
        if name.startswith("__") or old is new:
            continue
        if _differ(old, new):
            for other in list(sys.modules.values()):
                if getattr(other, "__dict__", {}).get(name) is old:
                    setattr(other, name, new)
            planted = True
        else:
            planted |= _adapt(old, new, module.__name__)
    return planted


def _differ(old: Any, new: Any) -> bool:
    """Whether two plain values differ."""
    if not (_is_plain(old) and _is_plain(new)):
        return False
    if isinstance(old, np.ndarray):
        return not np.array_equal(old, new)
    return bool(old != new) or type(old) is not type(new)


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple | list | frozenset | set):
        return all(map(_is_plain, value))
    if isinstance(value, Mapping):
        return all(_is_plain(each) for each in (*value, *value.values()))
    return type(value) in {*_PLAIN, np.ndarray}


def _adapt(old: Any, new: Any, home: str) -> bool:
    """Give something the code, the defaults and the plain values of its new version; whether any
    differs.
    """
    if (
        old is new or type(old).__qualname__ != type(new).__qualname__
    ):  # a record is of its module's own class
        return False
    if isinstance(old, FunctionType):
        return _adapt_function(old, new)
    if isinstance(old, type):
        return old.__module__ == home and _adapt_class(old, new, home)
    if isinstance(old, Mapping):
        return sum(_adapt(old[key], new[key], home) for key in old if key in new) > 0
    if dataclasses.is_dataclass(old):
        return (
            sum(_adapt_field(old, new, field.name, home) for field in dataclasses.fields(old)) > 0
        )
    inside = ("fget", "fset", "__func__", "__wrapped__", "func")
    return (
        sum(_adapt(getattr(old, name, None), getattr(new, name, None), home) for name in inside) > 0
    )


def _adapt_function(old: FunctionType, new: FunctionType) -> bool:
    defaults = tuple(map(_other, old.__defaults__ or (), new.__defaults__ or ()))
    by_name = {
        name: _other(value, new.__kwdefaults__[name])
        for name, value in (old.__kwdefaults__ or {}).items()
    }
    if (new.__code__, defaults, by_name) == (
        old.__code__,
        old.__defaults__ or (),
        old.__kwdefaults__ or {},
    ):
        return False
    old.__code__, old.__defaults__, old.__kwdefaults__ = new.__code__, defaults, by_name
    return True


def _other(old: Any, new: Any) -> Any:
    return new if _differ(old, new) else old


def _adapt_class(old: type, new: type, home: str) -> bool:
    planted = False
    for name, value in vars(new).items():
        there = vars(old).get(name)
        if _differ(there, value) and not name.startswith("__"):
            setattr(old, name, value)
            planted = True
        else:
            planted |= _adapt(there, value, home)
    return planted


def _adapt_field(old: Any, new: Any, name: str, home: str) -> bool:
    there, value = getattr(old, name), getattr(new, name)
    if _differ(there, value):
        object.__setattr__(old, name, value)
        return True
    return _adapt(there, value, home)
