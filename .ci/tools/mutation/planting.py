"""Planting of a mutant into a process that has already imported the package.

The mutant's module is executed once more in a namespace of its own. Where the code or the defaults
of a function differ, the existing function object gets the new ones, so that everybody who holds it
calls the mutant. A constant of plain values is replaced in all modules that have it by that name,
and in records such as protocols field by field. Values that other modules computed from it on
import stay as they are.
"""

import ast
import dataclasses
import sys
from collections.abc import Mapping
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

_PLAIN_TYPES = (bool, int, float, str, bytes, type(None))


def plant(module: ModuleType, tree: ast.Module) -> bool:
    """Change a module to what the tree defines; return whether anything was changed."""
    namespace = {
        "__name__": module.__name__,
        "__file__": module.__file__,
        "__package__": module.__package__,
    }
    exec(compile(tree, str(module.__file__), "exec"), namespace)  # noqa: S102 - our own source
    planted = False
    for name, new in namespace.items():
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
    """Return whether two plain values differ."""
    if not (_is_plain(old) and _is_plain(new)):
        return False
    if isinstance(old, np.ndarray):
        return not np.array_equal(old, new)
    return bool(old != new) or type(old) is not type(new)


def _is_plain(value: Any) -> bool:
    """Return whether a value consists of numbers, texts and arrays in containers."""
    if isinstance(value, tuple | list | frozenset | set):
        return all(map(_is_plain, value))
    if isinstance(value, Mapping):
        return all(_is_plain(item) for item in (*value, *value.values()))
    return type(value) in {*_PLAIN_TYPES, np.ndarray}


def _adapt(old: Any, new: Any, home: str) -> bool:
    """Give an object the code, defaults and plain values of its new version.

    Returns:
        Whether anything differs.
    """
    # by name, since a record is of its module's own class
    if old is new or type(old).__qualname__ != type(new).__qualname__:
        return False
    if isinstance(old, FunctionType):
        return _adapt_function(old, new)
    if isinstance(old, type):
        return old.__module__ == home and _adapt_class(old, new, home)
    if isinstance(old, Mapping):
        adapted = [_adapt(old[key], new[key], home) for key in old if key in new]
        return any(adapted)
    if dataclasses.is_dataclass(old):
        names = [field.name for field in dataclasses.fields(old)]
        adapted = [_adapt_field(old, new, name, home) for name in names]
        return any(adapted)
    wrapped = ("fget", "fset", "__func__", "__wrapped__", "func")
    pairs = [(getattr(old, name, None), getattr(new, name, None)) for name in wrapped]
    adapted = [_adapt(old_part, new_part, home) for old_part, new_part in pairs]
    return any(adapted)


def _adapt_function(old: FunctionType, new: FunctionType) -> bool:
    """Give a function the code and the defaults of its new version; return whether any differ."""
    old_defaults, old_keywords = old.__defaults__ or (), old.__kwdefaults__ or {}
    defaults = tuple(map(_changed_value, old_defaults, new.__defaults__ or ()))
    keywords = {
        name: _changed_value(value, new.__kwdefaults__[name])
        for name, value in old_keywords.items()
    }
    if (new.__code__, defaults, keywords) == (old.__code__, old_defaults, old_keywords):
        return False
    old.__code__, old.__defaults__, old.__kwdefaults__ = new.__code__, defaults, keywords
    return True


def _changed_value(old: Any, new: Any) -> Any:
    """Return the new value if both are plain and differ, otherwise the old object."""
    if _differ(old, new):
        return new
    return old


def _adapt_class(old: type, new: type, home: str) -> bool:
    """Give a class the members of its new version; return whether any differ."""
    planted = False
    for name, new_member in vars(new).items():
        old_member = vars(old).get(name)
        if _differ(old_member, new_member) and not name.startswith("__"):
            setattr(old, name, new_member)
            planted = True
        else:
            planted |= _adapt(old_member, new_member, home)
    return planted


def _adapt_field(old: Any, new: Any, name: str, home: str) -> bool:
    """Give a field of a record its new value; return whether it differs."""
    old_value, new_value = getattr(old, name), getattr(new, name)
    if _differ(old_value, new_value):
        object.__setattr__(old, name, new_value)
        return True
    return _adapt(old_value, new_value, home)
