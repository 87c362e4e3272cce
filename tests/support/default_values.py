"""All defaults and constants of a package as texts, for comparison with a table in a test."""

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType, ModuleType

import numpy as np

MAX_CHARACTERS = 200
"""Characters of a constant; longer ones are tables that have their own tests."""


def package_values(name: str) -> dict[str, str]:
    """Return the values that a module, or a package with its modules, defines.

    These are the defaults of each public function, class and method, and the value of each
    constant, by name; names without a value are left out.
    """
    package = importlib.import_module(name)
    modules = [package]
    for info in pkgutil.iter_modules(getattr(package, "__path__", ())):
        if not info.name.startswith("_"):
            modules.append(importlib.import_module(f"{name}.{info.name}"))

    values: dict[str, str] = {}
    for module in modules:
        values.update(_constants(module))
        values.update(_defaults(module))
    return {name: value for name, value in values.items() if value}


def _constants(module: ModuleType) -> Iterator[tuple[str, str]]:
    for node in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body:
        for target in getattr(node, "targets", [getattr(node, "target", None)]):
            if isinstance(target, ast.Name) and target.id.isupper() and target.id[0] != "_":
                value = getattr(module, target.id)
                text = repr(value.item() if isinstance(value, np.generic) else value)
                is_readable = len(text) <= MAX_CHARACTERS and not {*text} & {*"<\n"}
                yield f"{_short_name(module)}.{target.id}", text if is_readable else ""


def _defaults(module: ModuleType) -> Iterator[tuple[str, str]]:
    for path, function in _callables(module):
        parameters = [
            parameter
            for parameter in inspect.signature(function).parameters.values()
            if parameter.default is not parameter.empty and " at 0x" not in repr(parameter.default)
        ]
        defaults = [f"{parameter.name}={parameter.default!r}" for parameter in parameters]
        yield f"{_short_name(module)}.{path}", ", ".join(defaults)


def _callables(module: ModuleType) -> Iterator[tuple[str, Callable[..., object]]]:
    """Yield the public functions, classes with a constructor, and methods of a module."""
    for name, value in vars(module).items():
        is_own = getattr(value, "__module__", "") == module.__name__
        if name[0] == "_" or not is_own or not isinstance(value, FunctionType | type):
            continue
        if isinstance(value, FunctionType) or "__init__" in vars(value):
            yield name, value
        for method, member in vars(value).items():
            if method[0] != "_" and isinstance(member, FunctionType | classmethod | staticmethod):
                yield f"{name}.{method}", getattr(value, method)


def _short_name(module: ModuleType) -> str:
    return module.__name__.rpartition(".")[2]
