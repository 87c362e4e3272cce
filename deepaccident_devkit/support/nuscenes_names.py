"""Names of the nuScenes devkit that this devkit does not have, and what to use here; docs/reading.md has all."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Final, NoReturn, ParamSpec, TypeVar

from deepaccident_devkit.errors import KeywordError, MissingNameError
from deepaccident_devkit.support.text import meant_text

_T = TypeVar("_T")
P = ParamSpec("P")
_PAGE: Final = "docs/reading.md"
_HINTS: Final = json.loads(Path(__file__).with_suffix(".json").read_bytes())


def _hints(of: str) -> Mapping[str, str]:
    return {name: hint for hint, names in _HINTS[of].items() for name in names}


# nuScenes' tables → what to use here.
TABLES: Final = _hints("tables")
# Attributes of nuScenes' `NuScenes` and `NuScenesExplorer` → what to use here.
DATASET: Final = _hints("dataset")
# Attributes of nuScenes' `Box` → what to use here.
BOX: Final = _hints("box")
# Attributes of nuScenes' `LidarPointCloud` → what to use here.
CLOUD: Final = _hints("cloud")
# Arguments of nuScenes' methods → what to use here.
KEYWORDS: Final = _hints("keywords")
# Fields of nuScenes' records → what to use here.
FIELD_HINTS: Final = _hints("fields")
# What to use here in place of making nuScenes' `Box`.
BOX_MADE: Final = (
    "boxes[0] picks one, and nuScenes' Box(center, wlh, orientation) is Box.from_wlh(center, wlh, orientation, "
    f"frame='ego') (see {_PAGE})"
)


class AbsentName:
    """Stands in a class for a name of nuScenes' class: to read it raises MissingNameError, so `hasattr` is False.

    A `__getattr__` of the class would do the same, but make all its other attributes slower.
    """

    def __init__(self, name: str, counterpart: str) -> None:
        """Note the name, and what to use here."""
        self._name = name
        self._counterpart = counterpart

    def __get__(self, instance: object, owner: type) -> NoReturn:
        raise missing_name(owner, self._name, self._counterpart)


def without_names(counterparts: Mapping[str, str]) -> Callable[[type[_T]], type[_T]]:
    """A decorator of a class that has none of these names, and says so with the counterpart of each."""

    def put(owner: type[_T]) -> type[_T]:
        for name, counterpart in counterparts.items():
            setattr(owner, name, AbsentName(name, counterpart))
        return owner

    return put


def missing_name(owner: type, name: str, counterpart: str) -> MissingNameError:
    """The error of a class that has no such name."""
    return MissingNameError(f"{owner.__name__} has no {name!r}: {counterpart} (see {_PAGE})")


def with_keywords_named(function: Callable[P, _T], module: str | None = None) -> Callable[P, _T]:
    """Return the same function, which raises a KeywordError for an argument that it does not have.

    Of an argument of nuScenes' the error says what to use, of others which one may be meant. `module` is where the
    result lies, and where pickle finds it; None for the place of the function itself.
    """
    known = signature(function).parameters
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in known.values())
    called = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]

    @wraps(function)
    def checked(*arguments: P.args, **named: P.kwargs) -> _T:
        for name in sorted(named.keys() - known.keys()) if named else ():
            if name in KEYWORDS:
                raise KeywordError(
                    f"{called} has no argument {name!r}: {KEYWORDS[name]} (see {_PAGE})"
                )
            if not takes_any:
                raise KeywordError(f"{called} has no argument {name!r}{meant_text(name, known)}")
        return function(*arguments, **named)

    checked.__module__ = module or function.__module__
    return checked


def table_remedy(name: object) -> str:
    """What to say of a table that is nuScenes'; empty for all others."""
    counterpart = TABLES.get(name) if isinstance(name, str) else None
    return f"; of nuScenes' table {name!r}: {counterpart} (see {_PAGE})" if counterpart else ""


def field_remedy(name: object) -> str:
    """What to say of a record's field that is nuScenes'; empty for all others."""
    counterpart = FIELD_HINTS.get(name) if isinstance(name, str) else None
    return f": {counterpart} (see {_PAGE})" if counterpart else ""
