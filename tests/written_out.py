"""Every default and every constant of a package in words, to be compared with what a test has
written out.
"""

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType, ModuleType

import numpy as np

MOST = 200
"""Characters of a constant; longer ones are tables, whose tests have them."""


def written_out(name: str) -> dict[str, str]:
    """Of a module, or of a package's modules: public function, class or method → its defaults;
    constant → its value.
    """
    module = importlib.import_module(name)
    inside = [each.name for each in pkgutil.iter_modules(getattr(module, "__path__", ()))]
    modules = [
        module,
        *(importlib.import_module(f"{name}.{each}") for each in inside if each[0] != "_"),
    ]
    return {
        each: words
        for one in modules
        for each, words in [*_constants(one), *_defaults(one)]
        if words
    }


def _constants(module: ModuleType) -> Iterator[tuple[str, str]]:
    for node in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body:
        for target in getattr(node, "targets", [getattr(node, "target", None)]):
            if isinstance(target, ast.Name) and target.id.isupper() and target.id[0] != "_":
                value = getattr(module, target.id)
                words = repr(value.item() if isinstance(value, np.generic) else value)
                yield (
                    f"{_short(module)}.{target.id}",
                    words if len(words) <= MOST and not {*words} & {*"<\n"} else "",
                )


def _defaults(module: ModuleType) -> Iterator[tuple[str, str]]:
    own = {
        name: value
        for name, value in vars(module).items()
        if getattr(value, "__module__", "") == module.__name__
    }
    for name, value in own.items():
        if name[0] == "_" or not isinstance(value, FunctionType | type):
            continue
        methods = [
            each for each, inner in vars(value).items() if each[0] != "_" and _function(inner)
        ]
        for path, function in (
            (name, value),
            *((f"{name}.{each}", getattr(value, each)) for each in methods),
        ):
            if isinstance(function, type) and "__init__" not in vars(function):
                continue
            found = inspect.signature(function).parameters.values()
            given = [
                each
                for each in found
                if each.default is not each.empty and " at 0x" not in repr(each.default)
            ]
            yield (
                f"{_short(module)}.{path}",
                ", ".join(f"{each.name}={each.default!r}" for each in given),
            )


def _function(value: object) -> bool:
    return isinstance(value, FunctionType | classmethod | staticmethod)


def _short(module: ModuleType) -> str:
    return module.__name__.rpartition(".")[2]
